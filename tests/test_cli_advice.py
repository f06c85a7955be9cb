"""What to do next: after a refusal, and without a command."""

from __future__ import annotations

import argparse
import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from startrack.chain import detect, stating_sky
from startrack.cli.console import Columns, print_outcome, print_warnings
from startrack.cli.main import main
from startrack.core.errors import NotIdentified, Reason, next_step
from startrack.exposure import read_exposure
from startrack.identification import NearSky, advise_on_fields

ACTIONS = {"calibrate": ("board", "verify", "show", "convert"), "terrain": ("show", "import", "build")}
LOWELL = str(Path(__file__).parents[1] / "sample_images/lowell-2018-08-06.fits.bz2")  # 180 degrees, on the Earth
SAMPLE = str(Path(__file__).parents[1] / "sample_images/near-wall.png")


def test_a_warning_of_all_images_is_printed_once_for_each_terrain(capsys: pytest.CaptureFixture[str]) -> None:
    args = argparse.Namespace(quiet=False)
    for image, terrain in (("1.png", "A"), ("2.png", "A"), ("3.png", "B")):
        print_warnings(args, terrain, ["its error is not stated"], of_all=True)
        print_warnings(args, image, ["its error is not stated", "no clock"])
    lines = ["A: its error is not stated", "1.png: no clock", "2.png: no clock", "B: its error is not stated"]
    assert capsys.readouterr().err.splitlines() == [*lines, "3.png: no clock"]


def test_startrack_alone_shows_where_to_start(capsys: pytest.CaptureFixture[str]) -> None:
    assert main([]) == 2
    shown = capsys.readouterr().out.splitlines()
    assert len(shown) == 5
    for word in ("locate", "calibrate", "identify", "demo", "--help"):  # three tasks, and where to see more
        assert any(f"startrack {word}" in line for line in shown)


@pytest.mark.parametrize("command", ACTIONS)
def test_a_command_with_actions_alone_shows_them(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([command]) == 2
    shown = capsys.readouterr()
    assert shown.err == "" and shown.out.startswith(f"usage: startrack {command} ")
    for action in ACTIONS[command]:
        assert f"startrack {command} {action} " in shown.out


def test_a_track_of_what_does_not_exist_names_it(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "nofolder"
    assert main(["track", str(path), "-D", str(tmp_path / "out")]) == 4
    (line, *_) = capsys.readouterr().err.splitlines()
    assert f"{path}: no such file or folder: give images, one folder of images, or one ROS bag" in line
    with pytest.raises(SystemExit) as end:
        main(["track", str(path), "--follow"])
    assert end.value.code == 2
    assert f"{path} is no folder" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_the_advice_on_several_positions_names_the_flag_that_chooses() -> None:
    assert "--near EAST,NORTH,SIGMA" in Reason.AMBIGUOUS.advice


def test_a_refusal_ends_with_what_to_do(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "no.png").write_bytes(b"no picture")
    words = ["locate", str(tmp_path / "no.png"), "-D", str(tmp_path / "out")]
    assert main(words) == 4
    out, err = capsys.readouterr()
    assert out.startswith("no.png  refused  bad_image: ") and out.endswith(f"  next: {Reason.BAD_IMAGE.advice}\n")
    assert err == ""  # no picture, no result, no files
    assert main([*words, "-q"]) == 4
    assert "next:" not in capsys.readouterr().err
    assert main([*words, "--json"]) == 4
    heard = capsys.readouterr()
    assert json.loads(heard.out)["advice"] == Reason.BAD_IMAGE.advice
    assert heard.err == ""


def test_of_a_missing_file_a_similar_name_is_the_advice(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "night-12.png").write_bytes(b"no picture")
    (tmp_path / "crater.toml").write_text("")
    out = ["-D", str(tmp_path / "out")]
    assert main(["locate", str(tmp_path / "other.png"), *out]) == 4
    advice = "  next: Check the name and the folder of the file.\n"
    assert capsys.readouterr() == (f"other.png  refused  bad_image: No such file{advice}", "")
    assert main(["locate", str(tmp_path / "nigth-12.png"), *out]) == 4
    heard = capsys.readouterr()
    assert heard == ("nigth-12.png  refused  bad_image: No such file: is night-12.png meant?\n", "")
    assert main(["terrain", "show", str(tmp_path / "cratr.toml")]) == 4
    assert capsys.readouterr().err.endswith("cratr.toml: No such file: is crater.toml meant?\n")
    (tmp_path / "link.png").symlink_to(tmp_path / "nowhere")
    assert main(["locate", str(tmp_path / "link.png"), *out]) == 4
    assert "No such file  next: " in capsys.readouterr().out


def test_a_solution_has_no_advice(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["identify", SAMPLE, "-D", str(tmp_path), "--json", "--no-plots"]) == 0
    assert json.loads(capsys.readouterr().out)["advice"] is None


@pytest.mark.parametrize("reason", list(Reason))
def test_advice_is_not_given_twice(reason: Reason) -> None:
    assert next_step(reason, "the file ends after 12 bytes") == reason.advice
    for message in ("no camera file is known: give -c FILE", "wrong terrain, time or camera file?", "see --time-sigma"):
        assert next_step(reason, message) == ""


def test_a_wrong_field_of_view_is_advised_to_try_another(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["calibrate", LOWELL, "--fov", "90", "-o", str(tmp_path / "c.toml"), "--no-plots"]) == 3
    heard = capsys.readouterr()
    assert "if the field of view may be another, try startrack identify --fov 40.5..198" in heard.out
    assert "camera file may be" not in heard.out + heard.err and "next:" not in heard.err


def test_identify_without_a_camera_file_names_the_flag_that_needs_none(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "sky.fits.bz2").write_bytes(Path(LOWELL).read_bytes())
    assert main(["identify", str(tmp_path / "sky.fits.bz2"), "-D", str(tmp_path)]) == 4
    assert "give -c FILE, a sidecar with camera, or --fov DEG" in capsys.readouterr().out


def test_a_lens_found_differs_from_no_file_and_leads_to_calibrate(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["identify", LOWELL, "--fov", "180", "-D", str(tmp_path), "--no-plots"]) == 0
    heard = capsys.readouterr()
    assert "differs from the camera file" not in heard.err
    assert "startrack calibrate IMAGE --fov 180 --site LAT,LON -o CAMERA.toml" in heard.out


def test_calibrate_names_the_path_of_the_camera_and_the_air_in_its_lens(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["calibrate", LOWELL, "--fov", "180", "-D", str(tmp_path), "--no-plots"]
    assert main(words) == 0
    heard = capsys.readouterr()
    assert heard.out.startswith(f"{tmp_path / 'camera.toml'}  ok  ")
    assert "the refraction of the air is in the lens: give --site" in heard.err
    assert main([*words, "-O", "--site=34.7443,-111.4223,2361"]) == 0
    assert "refraction" not in capsys.readouterr().err


def test_the_advice_of_a_command_comes_before_that_of_the_reason(capsys: pytest.CaptureFixture[str]) -> None:
    reason = Reason.INCONSISTENT_EVIDENCE
    for own, shown in (("Check the site.", "Check the site."), (reason.advice, reason.advice)):
        record = {"status": "refused", "reason": str(reason), "message": "they differ", "advice": own}
        assert print_outcome(argparse.Namespace(json=False, quiet=False), record, "a  refused") == 3
        assert capsys.readouterr() == (f"a  refused  next: {shown}\n", "")


REFUSAL = re.compile(
    r"(?P<name>\S.*?)  refused  (?P<reason>[a-z_]+): (?P<message>.*?)(?:  next: (?P<advice>[A-Z].*\.))?"
)


def test_eight_refusals_have_one_shape(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Name, reason, message, and the advice in the same line of the same stream unless the message contains it."""
    (tmp_path / "no.png").write_bytes(b"no picture")
    (tmp_path / "empty").mkdir()
    no, out = str(tmp_path / "no.png"), ["-D", str(tmp_path / "out")]
    refused = [
        (["locate", no, *out], "no.png", "bad_image", False),
        (["identify", str(tmp_path / "gone.png"), *out], "gone.png", "bad_image", False),
        (["locate", LOWELL, "-t", "nowhere", *out], Path(LOWELL).name, "bad_terrain", False),
        (["horizon", no, "-o", str(tmp_path / "h.csv")], "h.csv", "bad_image", False),
        (["calibrate", LOWELL, "--fov", "90", "--no-plots", "-o", str(tmp_path / "c.toml")],
         str(tmp_path / "c.toml"), "not_identified", False),
        (["batch", str(tmp_path / "empty"), *out], "startrack batch", "bad_image", True),
        (["report", str(tmp_path / "nothing")], "startrack report", "bad_image", True),
        (["track", no, *out], "no.png", "bad_image", True),
    ]  # fmt: skip
    for words, name, reason, is_error in refused:
        assert main(words) in (3, 4), words
        heard = capsys.readouterr()
        line = (heard.err if is_error else heard.out).splitlines()[0]
        shape = REFUSAL.fullmatch(line)
        assert shape is not None, line
        assert (shape["name"], shape["reason"]) == (name, reason)
        assert shape["advice"] or next_step(shape["reason"], shape["message"]) == "", line
        if name in ("startrack batch", "startrack report"):  # no picture is at fault
            assert "folder" in shape["advice"] and "in every pixel" not in shape["advice"]


def test_a_picture_of_the_earth_without_a_terrain_leads_to_the_commands_that_need_none(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["locate", LOWELL, "-D", str(tmp_path)]) == 4
    advice = capsys.readouterr().out.partition("  next: ")[2]
    assert "startrack identify" in advice and "startrack horizon" in advice


@pytest.mark.parametrize(
    ("flag", "file", "text"),
    [
        ("-c", "terrain/shackleton.toml", "give it with -t (a terrain file)"),
        ("-t", "calib/fisheye-2048.toml", "give it with -c (a camera file)"),
        ("-c", "sample_images/near-wall.png", "it is no text: is it a picture, or a map (see terrain import)?"),
        ("-t", "sample_images/near-wall.png", "it is no text: is it a picture, or a map (see terrain import)?"),
    ],
)
def test_a_file_of_another_kind_is_said_to_be_one(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], flag: str, file: str, text: str
) -> None:
    path = str(Path(__file__).parents[1] / file)
    assert main(["locate", SAMPLE, flag, path, "-D", str(tmp_path), "--no-plots"]) == 4
    heard = capsys.readouterr()
    assert text in heard.out and "next:" not in heard.err


def test_only_wide_sources_lead_to_the_focus() -> None:
    """And only ground in view, another field and another file are advised, each where it was not excluded."""
    exposure = read_exposure(SAMPLE)
    sharp = detect(exposure, None).detections
    for psf_sigma_px, is_advised in ((1.0, False), (4.0, True)):
        found = replace(sharp, psf_sigma_px=psf_sigma_px)
        with pytest.raises(NotIdentified) as refused, stating_sky(exposure, found):
            raise NotIdentified("no lens fits", advice="if the field of view may be another, try --fov 4..50")
        text = str(refused.value)
        assert ("focus" in text) == is_advised and "try --fov 4..50" in text and "if ground" in text
        assert f"{len(sharp)} point sources (SNR " in text and f"sigma of {psf_sigma_px} px" in text
        assert "in 2048 x 2048 px" in text


@pytest.mark.parametrize(
    ("low", "high", "text"), [(8.0, 25.0, "--fov 4..50"), (2.0, 280.0, ""), (3.0, 200.0, "--fov 2..280")]
)
def test_fields_that_were_tried_are_not_advised(low: float, high: float, text: str) -> None:
    advice = advise_on_fields(*np.radians([low, high]), None)
    assert text in advice and ("--fov" in advice) == bool(text)
    assert "near_sky" not in advice
    assert "leave out near_sky" in advise_on_fields(0.1, 0.4, NearSky.from_degrees([10.0, 20.0, 5.0]))


def test_lines_of_several_images_have_steady_columns() -> None:
    columns = Columns(["near-centre.png", "a.png"])
    first = "near-centre.png  ok  E 425.3 m  N -310.5 m  ±8.9 m (95 %)  heading 32.0°  2248 stars  1.2 s"
    second = "a.png  ok  E -6899.5 m  N 4700.6 m  ±13.0 m (95 %)  heading 205.0°  835 stars  11.2 s"
    lines = [columns.aligned(line) for line in (first, second)]
    places = [[line.index(word) for word in (" ok ", " m  N", " m  ±", " m (95", "°", " stars")] for line in lines]
    assert places[0] == places[1]
    assert [re.sub(r" +", "", line) for line in lines] == [re.sub(r" +", "", line) for line in (first, second)]
    assert columns.aligned("a.png  ok  1979 point sources\n  more  1 s").endswith("\n  more  1 s")
