"""The commands as used by scripts: exit codes, refusals, printed and written output."""

import json
import os
import re
import shutil
import subprocess
import sys
import tomllib
from importlib import metadata
from pathlib import Path

import cv2
import numpy as np
import pytest

from startrack.cli.main import main
from startrack.cli.studies import doctor
from startrack.kernels.library import LEVEL

ROOT = Path(__file__).parent.parent
SAMPLES = ROOT / "sample_images"
SIZE = 256
CAMERA = f"""
format = 1
name = "small"
size_px = [{SIZE}, {SIZE}]
focal_px = [80.0, 80.0]
centre_px = [127.5, 127.5]
max_angle_deg = 92.5
[sensor]
zero_point_e_per_s = 44000.0
gain_e_per_adu = 0.5
bias_adu = 100.0
read_noise_e = 2.5
"""
FACTS = {"time_utc": "2030-01-01T00:00:00Z", "exposure_s": 1.0, "camera": "small.toml", "terrain": "shackleton-thesis"}
OK, ERROR, USAGE, REFUSED, BAD_INPUT = 0, 1, 2, 3, 4


@pytest.fixture
def folder(tmp_path, monkeypatch):
    (tmp_path / "small.toml").write_text(CAMERA)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def write_image(name, pixels, **facts):
    """An image with a sidecar; a fact given as None is left out."""
    path = Path(name)
    path.parent.mkdir(parents=True, exist_ok=True)
    ok, data = cv2.imencode(path.suffix, pixels)
    assert ok
    path.write_bytes(data.tobytes())
    known = {key: value for key, value in (FACTS | facts).items() if value is not None}
    path.with_suffix(".json").write_text(json.dumps(known))
    return name


def black_image(name="black.png", shape=(SIZE, SIZE), **facts):
    return write_image(name, np.zeros(shape, np.uint16), **facts)


def noise(name="noise.png", seed=1, **facts):
    pixels = np.random.default_rng(seed).normal(200, 12, (SIZE, SIZE))
    return write_image(name, pixels.round().astype(np.uint16), **facts)


def stars(name="stars.png", **facts):
    """A few random point sources: enough for `detect`, not for `identify`."""
    rng = np.random.default_rng(2)
    y, x = np.mgrid[:SIZE, :SIZE]
    pixels = rng.normal(200, 12, (SIZE, SIZE))
    for cx, cy in rng.uniform(20, SIZE - 20, (12, 2)):
        pixels += 900 * np.exp(-0.5 * ((x - cx) ** 2 + (y - cy) ** 2))
    return write_image(name, pixels.round().astype(np.uint16), **facts)


def truncated_image(name="cut.png"):
    noise(name)
    whole = Path(name).read_bytes()
    Path(name).write_bytes(whole[: len(whole) // 2])
    return name


def run(capsys, *words):
    """Exit code, the JSON objects or lines on stdout, and stderr."""
    code = main(list(words))
    out, err = capsys.readouterr()
    return code, out.splitlines(), err


def reason(capsys, *words):
    """Exit code and reason of one image; the written file must agree with the printed record."""
    code, lines, err = run(capsys, *words, "--json", "--no-plots")
    assert err == ""
    (line,) = lines
    record = json.loads(line)
    assert record["status"] == "refused"
    assert record["message"]
    assert "\n" not in record["message"]
    assert record.get("position") is None
    return code, record["reason"]


def shell(*words, cwd, **environment):
    """The real command in a process of its own."""
    return subprocess.run(
        [sys.executable, "-m", "startrack.cli.main", *words],
        cwd=cwd, capture_output=True, text=True, env={**os.environ, "PYTHONPATH": str(ROOT), **environment},
    )  # fmt: skip


# --- what cannot be solved is refused --------------------------------------------------------------------------------


def test_a_black_frame_holds_no_stars(folder, capsys):
    assert reason(capsys, "locate", black_image()) == (REFUSED, "no_stars")


@pytest.mark.parametrize("size", [(1, 1), (20, 7), (2, 40), (9, 9)])
@pytest.mark.parametrize("words", [("detect",), ("identify", "--fov", "60")])
def test_a_tiny_frame_holds_no_stars(folder, capsys, size, words):
    pixels = np.random.default_rng(1).poisson(100.0, size[::-1]).astype(np.uint8)
    assert cv2.imwrite("tiny.png", pixels)
    assert reason(capsys, words[0], "tiny.png", *words[1:]) == (REFUSED, "no_stars")


def test_a_saturated_frame_holds_no_stars(folder, capsys):
    image = write_image("day.png", np.full((SIZE, SIZE), 65535, np.uint16))
    assert reason(capsys, "locate", image) == (REFUSED, "no_stars")


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_pure_noise_is_never_a_sky(folder, capsys, seed):
    code, why = reason(capsys, "locate", noise(seed=seed))
    assert (code, why) in {(REFUSED, "no_stars"), (REFUSED, "not_identified")}


def test_point_sources_that_are_no_sky_are_not_identified(folder, capsys):
    assert reason(capsys, "locate", stars()) == (REFUSED, "not_identified")
    assert reason(capsys, "identify", "stars.png") == (REFUSED, "not_identified")


# --- bad input -------------------------------------------------------------------------------------------------------


def test_what_is_no_image_is_bad_input(folder, capsys):
    Path("empty.png").write_bytes(b"")
    Path("text.png").write_text("not a picture")
    Path("folder.png").mkdir()
    for image in (truncated_image(), "missing.png", "empty.png", "text.png", "folder.png"):
        assert reason(capsys, "locate", image) == (BAD_INPUT, "bad_image"), image


@pytest.mark.parametrize(
    ("facts", "expected"),
    [
        ({"time_utc": None}, "no_time"),
        ({"time_utc": "2030-01-01T00:00:00+02:00"}, "no_time"),
        ({"time_utc": "yesterday"}, "no_time"),
        ({"camera": None}, "no_calibration"),
        ({"camera": "nobodys.toml"}, "no_calibration"),
        ({"camera": "nobodys-camera"}, "no_calibration"),
        ({"camera": "broken.toml"}, "bad_calibration"),
        ({"camera": "fisheye-2048"}, "size_mismatch"),
        ({"terrain": None}, "bad_terrain"),
        ({"terrain": "nowhere"}, "bad_terrain"),
        ({"terrain": "broken.toml"}, "bad_terrain"),
    ],
)
def test_missing_or_wrong_facts_are_named(folder, capsys, facts, expected):
    Path("broken.toml").write_text("format = 1\nsize_px = [")
    assert reason(capsys, "locate", stars(**facts)) == (BAD_INPUT, expected)


def test_a_sidecar_that_cannot_be_read_is_bad_input(folder, capsys):
    stars()
    Path("stars.json").write_text("{")
    assert reason(capsys, "locate", "stars.png") == (BAD_INPUT, "bad_image")


def test_flags_come_before_the_sidecar(folder, capsys):
    image = stars(time_utc="rubbish", camera="nobodys", terrain="nowhere")
    flags = ["--time", "2030-01-01T00:00:00", "--camera", "small.toml", "--terrain", "shackleton-thesis"]
    assert reason(capsys, "locate", image, *flags) == (REFUSED, "not_identified")
    assert reason(capsys, "locate", image, *flags, "--time", "2030-01-01T00:00:00+01:00") == (BAD_INPUT, "no_time")


def test_identify_and_detect_need_no_time_and_detect_no_camera(folder, capsys):
    assert reason(capsys, "identify", stars(time_utc=None)) == (REFUSED, "not_identified")
    code, (line,), _ = run(capsys, "detect", stars("bare.png", camera=None, time_utc=None), "--json")
    assert code == OK
    assert len(json.loads(line)["detections"]) == 12


# --- several images --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("kinds", "expected"),
    [("ok", OK), ("ok dark", REFUSED), ("dark cut ok", BAD_INPUT), ("cut ok dark ok", BAD_INPUT), ("ok ok", OK)],
)
def test_the_exit_code_is_that_of_the_worst_image(folder, capsys, kinds, expected):
    make = {"ok": stars, "dark": black_image, "cut": truncated_image}
    images = [make[kind](f"{k}-{kind}.png") for k, kind in enumerate(kinds.split())]
    code, lines, err = run(capsys, "detect", *images, "--json", "--no-plots")
    assert (code, err) == (expected, "")
    records = [json.loads(line) for line in lines]
    assert [record["image"] for record in records] == images
    assert [record["status"] for record in records] == ["ok" if "ok" in image else "refused" for image in images]
    assert len({tuple(record) for record in records}) == 1  # the same keys, solved, refused or unread


@pytest.mark.parametrize("words", [["--help"], ["schema", "fix"]])
def test_a_closed_output_is_a_closed_pipe(folder, words):
    command = f'"{sys.executable}" -m startrack.cli.main {" ".join(words)} >&-'
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    done = subprocess.run(command, shell=True, capture_output=True, text=True, env=environment, check=False)
    assert (done.returncode, done.stderr) == (5, "")


def test_without_json_there_is_one_line_for_each_image(folder, capsys):
    code, lines, err = run(capsys, "detect", stars(), black_image(), "missing.png", "--no-plots")
    assert code == BAD_INPUT
    assert err == "files in startrack-out\n"
    assert ["  next: " in line for line in lines] == [False, False, True]  # no_stars: its message contains the advice
    starts = [["stars.png", "ok"], ["black.png", "refused"], ["missing.png", "refused"]]
    assert [line.split()[:2] for line in lines] == starts
    code, lines, err = run(capsys, "detect", "stars.png", "black.png", "--no-plots", "--quiet")
    assert (code, lines) == (REFUSED, [])
    assert err.startswith("black.png  refused  no_stars: ")


# --- names and files -------------------------------------------------------------------------------------------------


def test_names_may_hold_spaces_and_any_letter(folder, capsys):
    image = stars("nuit étoilée 星空/mon image.v1.png", camera="../small.toml")
    code, _, _ = run(capsys, "detect", image, "-D", "résultats à moi")
    assert code == OK
    names = sorted(path.name for path in Path("résultats à moi").iterdir())
    assert names == ["mon image.v1.annotated.png", "mon image.v1.detections.json"]


def test_equal_stems_keep_their_suffix_and_equal_names_a_number(folder, capsys):
    images = [stars("a.png"), stars("a.tif"), stars("b/c.png", camera="../small.toml"), stars("d.png")]
    images.append(stars("e/d.png", camera="../small.toml"))
    code, _, _ = run(capsys, "detect", *images, "--no-plots")
    assert code == OK
    written = sorted(path.name for path in Path("startrack-out").iterdir())
    ends = (".detections.json",)
    assert written == sorted(f"{stem}{end}" for stem in ("a.png", "a.tif", "c", "d.png", "d.png-2") for end in ends)


def test_a_result_is_renewed_but_never_that_of_another_image(folder, capsys):
    stars("one/x.png", camera="../small.toml")
    stars("two/x.png", camera="../small.toml")
    pixels = cv2.imread("two/x.png", cv2.IMREAD_UNCHANGED)
    write_image("two/x.png", pixels[::-1].copy(), camera="../small.toml")
    result = Path("startrack-out/x.detections.json")
    assert run(capsys, "detect", "one/x.png", "--no-plots")[0] == OK
    first = json.loads(result.read_text())["provenance"]["image_sha256"]
    assert run(capsys, "detect", "one/x.png", "--no-plots")[0] == OK
    code, lines, err = run(capsys, "detect", "two/x.png", "--no-plots")
    assert code != OK
    assert "x.detections.json" in " ".join([*lines, err])
    assert json.loads(result.read_text())["provenance"]["image_sha256"] == first
    assert run(capsys, "detect", "two/x.png", "--no-plots", "-O")[0] == OK
    assert json.loads(result.read_text())["provenance"]["image_sha256"] != first


def test_a_refused_image_leaves_its_reason_in_the_file_too(folder, capsys):
    assert reason(capsys, "locate", black_image()) == (REFUSED, "no_stars")
    record = json.loads(Path("startrack-out/black.fix.json").read_text())
    assert (record["status"], record["reason"]) == ("refused", "no_stars")
    assert record["provenance"]["time_utc"] == "2030-01-01T00:00:00.000000Z"
    assert not Path("startrack-out/black.stars.ecsv").exists()


@pytest.mark.parametrize(
    ("command", "flag"),
    [("locate", "-c"), ("locate", "-t"), ("locate", "--mask"), ("locate", "--flat"), ("identify", "-c"),
     ("identify", "--mask"), ("detect", "-c"), ("detect", "--mask"), ("detect", "--dark")],
)  # fmt: skip
def test_a_file_of_a_flag_that_is_missing_leaves_earlier_results(folder, capsys, command, flag):
    black_image()
    assert run(capsys, command, "black.png")[0] == REFUSED
    out = Path("startrack-out")
    for suffix in (".wcs", ".stars.ecsv", ".annotated.png"):
        (out / f"black{suffix}").write_text("of a solution")
    before = {path: path.read_bytes() for path in out.iterdir()}
    code, lines, _ = run(capsys, command, "black.png", flag, "./cratr.toml", "--json")
    assert (code, "cratr.toml" in json.loads(lines[0])["message"]) == (BAD_INPUT, True)
    assert {path: path.read_bytes() for path in out.iterdir()} == before
    assert run(capsys, command, "black.png", flag, "./cratr.toml", "-D", "new")[0] == BAD_INPUT
    assert not Path("new").exists()


def test_the_same_image_gives_the_same_bytes(folder, capsys):
    shutil.copy(stars(), "again.png")
    texts = []
    for out in ("a", "b"):
        assert run(capsys, "detect", "stars.png", "-D", out)[0] == OK
        record = json.loads(Path(out, "stars.detections.json").read_text())
        assert record.pop("timing_ms")["detect"] > 0
        texts.append(json.dumps(record))
    assert texts[0] == texts[1]
    assert Path("a/stars.annotated.png").read_bytes() == Path("b/stars.annotated.png").read_bytes()


# --- the command itself ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("words", ["", "nothing", "locate", "locate x.png --nothing", "schema nothing", "render -n -1"])
def test_wrong_usage_has_exit_code_2_and_advice(folder, words):
    done = shell(*words.split(), cwd=folder)
    assert done.returncode == USAGE
    assert "usage: startrack" in done.stdout or "\ntry 'startrack" in done.stderr
    assert "Traceback" not in done.stderr


@pytest.mark.parametrize(
    ("words", "command"),
    [
        ("locate x.png -o y", "startrack locate"),
        ("calibrate show x.toml --nothing", "startrack calibrate show"),
        ("terrain build x --nothing", "startrack terrain build"),
        ("--nothing locate x.png", "startrack"),
    ],
)
def test_an_unknown_flag_is_named_with_the_help_of_its_command(capsys, words, command):
    with pytest.raises(SystemExit) as end:
        main(words.split())
    assert end.value.code == USAGE
    assert capsys.readouterr().err.splitlines() == [
        f"{command}: error: unrecognized arguments: {'-o y' if '-o' in words else '--nothing'}",
        f"try '{command} --help'",
    ]
    with pytest.raises(SystemExit) as end:  # the help that it names exists
        main([*command.split()[1:], "--help"])
    assert end.value.code == 0 and capsys.readouterr().out.startswith(f"usage: {command} ")


@pytest.mark.parametrize("word", ["lcoate", "verify"])
def test_an_unknown_command_shows_the_names_of_the_commands(capsys, word):
    with pytest.raises(SystemExit) as end:
        main([word, "x.png"])
    said = capsys.readouterr().err
    assert end.value.code == USAGE
    assert f"no command is called '{word}'; there are: locate, batch, track, identify," in said
    assert "calibrate verify" not in said


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("identify stars.png --fov 180 -c fisheye-2048", "give one of them"),
        ("locate stars.png --fov 180", "startrack calibrate --fov 180"),
    ],
)
def test_a_field_of_view_where_it_does_not_help_is_wrong_usage(folder, capsys, words, said):
    stars()
    with pytest.raises(SystemExit) as end:
        main(words.split())
    assert end.value.code == USAGE
    assert said in capsys.readouterr().err


@pytest.mark.parametrize("command", ["locate", "identify", "detect"])
def test_a_folder_that_takes_no_results_is_named_before_any_work(folder, capsys, command):
    stars()
    with pytest.raises(SystemExit) as end:
        main([command, "stars.png", "-D", "/proc", "--json"])
    assert end.value.code == USAGE
    out, err = capsys.readouterr()
    assert out == ""
    assert "/proc: results cannot be written to this folder" in err.splitlines()[0]


def test_no_refusal_shows_a_traceback(folder):
    images = [truncated_image(), black_image(), noise(), "missing.png", stars("s.png", time_utc=None)]
    done = shell("locate", *images, "--no-plots", cwd=folder)
    assert done.returncode == BAD_INPUT
    assert len(done.stdout.splitlines()) == len(images)
    assert done.stderr == "files in startrack-out\n"
    advice = [line.partition("  next: ")[2] for line in done.stdout.splitlines() if "  next: " in line]
    assert advice and len(advice) == len(set(advice))


def test_unwritable_output_is_reported_in_one_line(folder):
    stars()
    Path("file").write_text("")
    done = shell("detect", "stars.png", "-D", "file/below", cwd=folder)
    assert done.returncode == USAGE
    assert "Traceback" not in done.stderr + done.stdout
    assert "file/below" in done.stderr + done.stdout


def test_a_plain_terminal_is_enough(folder):
    """An ASCII locale must not turn a result into an error."""
    stars()
    done = shell("detect", "stars.png", "--no-plots", cwd=folder, LC_ALL="C", PYTHONUTF8="0", PYTHONIOENCODING="ascii")
    assert (done.returncode, done.stderr) == (OK, "files in startrack-out\n")


def test_a_name_beyond_ascii_under_an_ascii_locale(folder):
    black_image("spä✶.png")
    ascii_locale = {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}
    done = shell("detect", "spä✶.png", "--no-plots", cwd=folder, **ascii_locale)
    assert (done.returncode, done.stderr) == (REFUSED, "files in startrack-out\n")
    assert "refused  no_stars" in done.stdout
    assert json.loads((folder / "startrack-out" / "spä✶.detections.json").read_text())["reason"] == "no_stars"


def test_version_and_help(folder):
    assert shell("--version", cwd=folder).stdout.startswith("startrack 0.")
    for command in ("locate", "identify", "detect", "render", "doctor", "schema"):
        done = shell(command, "--help", cwd=folder)
        assert (done.returncode, done.stderr) == (OK, "")


def test_the_module_is_the_command_too(folder):
    done = subprocess.run(
        [sys.executable, "-m", "startrack", "--version"], cwd=folder, capture_output=True, text=True,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
    )  # fmt: skip
    assert (done.returncode, done.stdout[:12], done.stderr) == (OK, "startrack 0.", "")


@pytest.mark.parametrize("action", ["verify", "show", "convert", "board"])
def test_each_action_of_calibrate_has_its_own_help(capsys, action):
    with pytest.raises(SystemExit, match="0"):
        main(["calibrate", action, "--help"])
    text = capsys.readouterr().out
    assert text.startswith(f"usage: startrack calibrate {action} ")
    assert ("--to" in text) == (action == "convert")
    assert ("--pattern" in text) == (action == "board")


def test_calibrate_takes_images_without_an_action(capsys):
    with pytest.raises(SystemExit, match="0"):
        main(["calibrate", "--help"])
    assert "usage: startrack calibrate [options] IMAGE..." in capsys.readouterr().out


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="this system has no /dev/full")
def test_a_full_disk_behind_stdout_is_named(folder):
    with open("/dev/full", "w") as full:
        command = [sys.executable, "-m", "startrack", "schema"]
        done = subprocess.run(
            command, cwd=folder, stdout=full, stderr=subprocess.PIPE, text=True,
            env={**os.environ, "PYTHONPATH": str(ROOT)},
        )  # fmt: skip
    assert (done.returncode, done.stderr) == (
        BAD_INPUT,
        "startrack: the output cannot be written (No space left on device)\n",
    )


@pytest.mark.parametrize(
    ("shell", "answers"),
    [
        ({}, {"loc": "locate", "locate --ima": "--image-topic"}),  # bash and zsh
        (
            {"_ARGCOMPLETE_SHELL": "fish", "_ARGCOMPLETE_DFS": "\t", "_ARGCOMPLETE_SUPPRESS_SPACE": "1"},
            {
                "loc": "locate\tpicture to position and attitude",
                "locate --ima": "--image-topic\ttopic of the images in a ROS bag that has several",
            },
        ),
    ],
    ids=["bash", "fish"],
)
def test_shell_completion_knows_the_commands(folder, tmp_path, shell, answers):
    """As the functions of register-python-argcomplete call it: the completions are written to descriptor 8."""
    pytest.importorskip("argcomplete", reason="the extra `completion` is not installed")
    answer = tmp_path / "answer"
    command = f"exec 8>{answer} 9>/dev/null; exec {sys.executable} -m startrack"
    for words, expected in answers.items():
        line = f"startrack {words}"
        asked = {"COMP_LINE": line, "COMP_POINT": str(len(line)), "_ARGCOMPLETE": "1", "_ARGCOMPLETE_IFS": "\n"}
        env = {**os.environ, **asked, **shell, "PYTHONPATH": str(ROOT)}
        subprocess.run(["bash", "-c", command], cwd=folder, check=False, env=env)
        assert answer.read_text().strip() == expected


def test_the_help_shows_the_doors_and_every_command_once(capsys):
    from startrack.cli.main import COMMANDS, DOORS, GROUPS

    assert sorted(name for names in GROUPS.values() for name in names) == sorted(COMMANDS)
    with pytest.raises(SystemExit, match="0"):
        main(["--help"])
    text = capsys.readouterr().out
    assert DOORS in text and text.index("  demo ") < text.index("  locate ")
    for name in COMMANDS:
        assert len(re.findall(rf"^  {name} +\S.*$", text, flags=re.MULTILINE)) == 1
    assert "star exposure" not in text


@pytest.mark.parametrize(
    ("command", "usage", "example"),
    [
        ("locate", "startrack locate [options] [IMAGE...]", "startrack locate sample_images/near-centre.png"),
        ("horizon", "startrack horizon [options] IMAGE... -o FILE", "startrack horizon NIGHT.jpg... --fov 180"),
        ("predict", "startrack predict [options] -t FILE -c FILE --time UTC", "startrack predict -t shackleton"),
    ],
)
def test_the_help_of_a_command_begins_with_what_it_needs_and_an_example(capsys, command, usage, example):
    with pytest.raises(SystemExit, match="0"):
        main([command, "--help"])
    head, _, _ = capsys.readouterr().out.partition("options:\n")
    assert head.startswith(f"usage: {usage}\n") and f"\nexample:\n  {example}" in head


def test_doctor_prints_one_line_for_each_extra(capsys, monkeypatch):
    from startrack.cli.studies.doctor import OPTIONAL, extra_lines, print_check

    def version(name):
        if name == "rosbags":
            raise metadata.PackageNotFoundError(name)
        return "1.0"

    monkeypatch.setattr(doctor.metadata, "version", version)
    lines = extra_lines()
    assert [line.split()[1] for line in lines] == [*OPTIONAL]
    (missing,) = [line for line in lines if line.split()[0] == "-"]
    assert missing.split()[1] == "ros" and "pip install '.[ros]'" in missing
    print_check({"name": "packages", "ok": True, "message": ", ".join(f"package-{k} 1.0" for k in range(20))})
    shown = capsys.readouterr().out.splitlines()
    assert len(shown) > 1 and max(map(len, shown)) <= 100
    assert all(line.startswith(20 * " ") for line in shown[1:])


def test_doctor_knows_the_packages_and_extras_of_the_project():
    from startrack.cli.studies.doctor import OPTIONAL, REQUIRED

    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert {*REQUIRED} == {re.split("[><=]", one)[0] for one in project["dependencies"]}
    extras = {*project["optional-dependencies"]} - {"test", "dev", "bench", "browser"}
    assert {*OPTIONAL} == extras
    assert re.findall(r"^\| `(\w+)` \|", (ROOT / "docs/installation.md").read_text(), flags=re.MULTILINE) == [*OPTIONAL]


def test_doctor_finds_all_well(folder, capsys):
    assert main(["doctor", "--json"]) == OK
    record = json.loads(capsys.readouterr().out)
    assert [check["name"] for check in record["checks"] if not check["ok"]] == []
    assert {"catalogue", "cameras", "terrains", "library", "self-test"} <= {check["name"] for check in record["checks"]}
    library = next(check["message"] for check in record["checks"] if check["name"] == "library")
    assert LEVEL in library and "-ffp-contract=off" in library


def test_doctor_prepares_a_terrain(folder, capsys, monkeypatch):
    monkeypatch.setattr(doctor, "_self_test", lambda: "left out")
    assert main(["doctor", "-t", "shackleton-thesis"]) == OK
    assert "horizons of shackleton-thesis are ready" in capsys.readouterr().out


def test_without_the_library_a_command_ends_with_what_helps(folder):
    """As of a checkout whose C sources have changed; the command that is named makes the library."""
    code = "import startrack.kernels.build as b; b.source_key = lambda: 'of-other-sources'"
    for words, expected in ((["locate", "a.png"], 1), (["--version"], OK), (["doctor", "-q"], 1)):
        script = f"{code}; from startrack.cli.main import main; raise SystemExit(main({words}))"
        run = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, cwd=folder,
                             env={**os.environ, "PYTHONPATH": str(ROOT)})  # fmt: skip
        assert run.returncode == expected
        if expected:
            assert f"type `{sys.executable} -m startrack.kernels.build` in {ROOT}" in run.stderr + run.stdout
            assert "internal error" not in run.stderr and "Traceback" not in run.stderr


# --- round trips -----------------------------------------------------------------------------------------------------


def test_render_then_locate(folder, capsys):
    """The default camera and crater, no flag but the seed; a plain ASCII locale, as on a robot."""
    assert main(["render", "--seed", "11", "-o", "rover 1.png"]) == OK
    truth = json.loads(Path("rover 1.truth.json").read_text())
    capsys.readouterr()
    code, (line,), err = run(capsys, "locate", "rover 1.png", "--json")
    assert (code, err) == (OK, "")
    record = json.loads(line)
    position = record["position"]
    error_m = np.hypot(position["east_m"] - truth["east_m"], position["north_m"] - truth["north_m"])
    assert error_m < min(position["radius999_m"], 40.0)
    for key, tolerance_deg in (("heading_deg", 0.01), ("pitch_deg", 0.005), ("roll_body_deg", 0.005)):
        assert record["attitude"][key] == pytest.approx(truth[key], abs=tolerance_deg)
    assert abs(np.dot(record["attitude"]["quat_xyzw_cam_icrs"], truth["quat_xyzw_cam_icrs"])) > 1 - 1e-9
    assert record["stars"]["identified"] > 500
    assert json.loads(Path("startrack-out/rover 1.fix.json").read_text()) == record


@pytest.mark.parametrize("name", ["near-centre", "tilted"])
def test_the_samples_are_located_without_a_flag(folder, capsys, name):
    code, (line,), _ = run(capsys, "locate", str(SAMPLES / f"{name}.png"), "--json", "--no-plots")
    assert code == OK
    record = json.loads(line)
    truth = json.loads((SAMPLES / f"{name}.truth.json").read_text())
    position = record["position"]
    miss_m = np.array([position["east_m"], position["north_m"]]) - truth["position_enu_m"][:2]
    assert np.hypot(*miss_m) < min(position["radius999_m"], 40.0)
    assert miss_m @ np.linalg.solve(position["covariance_m2"], miss_m) < 13.8  # 99.9 % of chi^2 with 2 dof
    assert position["up_m"] == pytest.approx(1.5)


def test_a_wrong_time_rotates_the_position_about_the_axis_of_a_round_crater(folder, capsys):
    """Near the pole the sky rotates by 3.3 degrees in six hours; in a round crater this is not noticeable.

    The Moon's rotation: 13.17635815 degrees a day (IAU 2015 report, Archinal et al. 2018, table 2).
    """
    image = str(SAMPLES / "near-wall.png")
    truth = json.loads((SAMPLES / "near-wall.truth.json").read_text())
    code, (line,), _ = run(capsys, "locate", image, "--time", "2029-09-08T09:12:45Z", "--json", "--no-plots")
    assert code == OK
    found, attitude = json.loads(line)["position"], json.loads(line)["attitude"]
    rotation_deg = np.degrees(
        np.arctan2(found["east_m"], found["north_m"]) - np.arctan2(truth["east_m"], truth["north_m"])
    )
    expected = 13.17635815 * 6 / 24
    assert abs(rotation_deg) == pytest.approx(expected, abs=0.2)
    assert attitude["heading_deg"] - truth["heading_deg"] == pytest.approx(rotation_deg, abs=0.2)
    true_m, found_m = (np.hypot(place["east_m"], place["north_m"]) for place in (truth, found))
    assert found_m == pytest.approx(true_m, abs=20)


def test_the_flag_of_the_evidence_has_the_sources_of_the_settings():
    from startrack.chain.stages import EVIDENCE_SOURCES
    from startrack.cli.flags import EVIDENCE

    assert EVIDENCE.options["choices"] == EVIDENCE_SOURCES


def test_the_help_has_the_programs_whose_camera_files_are_read():
    from startrack.camera.formats import FOREIGN_FORMATS
    from startrack.core.file_kinds import PROGRAMS, PROGRAMS_TEXT

    assert list(FOREIGN_FORMATS) == list(PROGRAMS)
    assert PROGRAMS_TEXT == "ROS, Kalibr, COLMAP, OpenCV or RMS"


def test_the_flags_of_the_odometry_have_the_defaults_of_the_track():
    from startrack.cli.flags import ODOMETRY
    from startrack.core import ODOMETRY_FLOOR_M, ODOMETRY_SIGMA

    assert [one.options["default"] for one in ODOMETRY] == [ODOMETRY_SIGMA, ODOMETRY_FLOOR_M]
