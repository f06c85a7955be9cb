"""Files in unusual places: pipes, folders and deep nesting where results are expected, and full disks."""

from __future__ import annotations

import json
import os
import pickle
import resource
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import chdir, contextmanager
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest
from astropy.table import Table
from batch_helpers import frames
from earth_helpers import in_projection

from startrack.cli.main import main
from startrack.core.errors import BadInput, BadOutput, NotLocated
from startrack.core.files import write_atomically
from startrack.exposure import read_exposure
from startrack.output import remove_companions, write_results
from startrack.terrain import read_map, write_bands, write_map

ROOT = Path(__file__).parent.parent
MAP = ROOT / "terrain" / "site01-10m.tif"
INTERNAL_ERROR, BAD_INPUT, NOT_ALL = 1, 4, 5
DEEP = "[" * 100_000
OUTPUTS = (  # commands that write one file, up to its name
    "horizon {image} --fov 180 --site=34,-111 -o", "calibrate {image} --fov 180 -o",
    "calibrate board {image} --pattern 9x6 -o", "calibrate convert fisheye-2048 --to ros -o",
    "render -t shackleton-thesis -o", "report {folder} -o",
    "terrain import {image} --latitude -89 --longitude 0 -o",
)  # fmt: skip

WITH_PATHS = (  # commands that print the path of a folder or a file
    "detect {folder} -D {folder}/out", "identify {image} --fov 180 -D {image}", "locate {image} -D {folder}/out -v",
    "batch {folder} -D {folder}/out -j 1 -v", "batch {folder} -D {image}", "track {folder} -D {folder}/out",
    "render -c {calib} -t {terrain} -o {folder}/a.png", "terrain show {terrain} -D {folder}/out",
    "terrain state {terrain}", "terrain build {terrain}", "calibrate show {calib}", "report {folder}",
    "calibrate convert {calib} --to ros -o {folder}/a.yaml", "reproduce methods -D {image}",
    "terrain import {map} --latitude -89.66 --longitude 129.78 -o {folder}/a\x1b.toml --sigma 1 --radius 500",
    "predict -c {calib} -t {terrain} --time 2030-01-01T00:00:00Z --draws 1 --spacing 9000 -j 1 -D {folder}/out",
)  # fmt: skip


@contextmanager
def time_limit(seconds: int) -> Iterator[None]:
    """An exception where the block hangs."""

    def end(*_: object) -> None:
        raise TimeoutError

    before = signal.signal(signal.SIGALRM, end)
    signal.alarm(seconds)
    try:
        yield
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)


def put(path: Path, kind: str) -> None:
    """Something that is no result at the path of one."""
    path.parent.mkdir(parents=True, exist_ok=True)
    if kind == "pipe":
        os.mkfifo(path)
    elif kind == "folder":
        path.mkdir()
    elif kind == "loop":
        path.symlink_to(path.name)
    elif kind == "socket":
        with chdir(path.parent), socket.socket(socket.AF_UNIX) as server:  # paths of sockets are short
            server.bind(path.name)
    elif kind == "full folder":
        path.mkdir()
        (path / "file").write_text("")
    else:
        path.write_text(DEEP)


@pytest.mark.parametrize("kind", ["pipe", "folder", "deep JSON"])
@pytest.mark.parametrize("overwrite", [[], ["-O"]])
def test_what_is_no_result_is_not_replaced_and_does_not_hang(tmp_path, capsys, kind, overwrite):
    (image,) = frames(tmp_path, 1)
    record = tmp_path / "out" / "00.detections.json"
    put(record, kind)
    with time_limit(60):
        code = main(["detect", str(image), "-D", str(tmp_path / "out"), "--no-plots", *overwrite])
    out = capsys.readouterr().out
    if overwrite and kind == "deep JSON":
        assert (code, json.loads(record.read_text())["reason"]) == (3, "no_stars")
    else:
        assert (code, len(out.splitlines())) == (BAD_INPUT, 1)
        assert "00.detections.json" in out


def test_a_folder_in_place_of_a_companion_is_named(tmp_path, capsys):
    (image,) = frames(tmp_path, 1)
    put(tmp_path / "out" / "00.annotated.png", "folder")
    assert main(["detect", str(image), "-D", str(tmp_path / "out")]) == BAD_INPUT
    (line,) = capsys.readouterr().out.splitlines()
    assert "bad_image" in line and "00.annotated.png: cannot be replaced" in line


@pytest.mark.parametrize("kind", ["pipe", "folder", "socket", "loop"])
@pytest.mark.parametrize("name", ["00.detections.json", "00.annotated.png"])
def test_only_regular_files_are_replaced(tmp_path, capsys, kind, name):
    """With advice that helps where -O is given too."""
    (image,) = frames(tmp_path, 1)
    path = tmp_path / "out" / name
    put(path, kind)
    before = path.lstat()
    with time_limit(60):
        assert main(["detect", str(image), "-D", str(tmp_path / "out"), "-O"]) == BAD_INPUT
    printed = capsys.readouterr()
    (line,) = printed.out.splitlines()
    assert "next:" not in printed.err  # the advice of bad_image is about pictures
    assert f"{name}: cannot be replaced: it is no regular file; remove it, or write elsewhere" in line
    assert "-O" not in line
    after = path.lstat()  # a link's time of reading may be another
    assert (after.st_mode, after.st_ino, after.st_mtime_ns) == (before.st_mode, before.st_ino, before.st_mtime_ns)


@pytest.mark.parametrize("kind", ["pipe", "folder", "socket", "loop"])
def test_a_sidecar_that_is_no_regular_file_is_named(tmp_path, kind):
    (image,) = frames(tmp_path, 1)
    image.with_suffix(".json").unlink(missing_ok=True)
    put(image.with_suffix(".json"), kind)
    with time_limit(60), pytest.raises(BadInput, match=r"00\.json: is no regular file") as refusal:
        read_exposure(image)
    assert refusal.value.reason == "bad_image"


@pytest.mark.parametrize("key", ["camera", "terrain", "mask", "dark"])
@pytest.mark.parametrize(
    "value", ["/dev/zero", "../../../../../etc/passwd", "../pipe", "..", "loop.toml", "a\nb/c.toml"]
)
def test_a_sidecar_that_names_anything_else_is_refused_in_one_line(tmp_path, capsys, key, value):
    """Paths outside its folder are read as any other: as a camera, a terrain or a picture, or not at all."""
    (image,) = frames(tmp_path / "images", 1)
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "images" / "loop.toml").symlink_to("loop.toml")
    facts = {"time_utc": "2030-01-01T00:00:00Z", "camera": "fisheye-2048", "terrain": "shackleton-thesis"}
    image.with_suffix(".json").write_text(json.dumps(facts | {key: value}))
    with time_limit(60):
        code = main(["locate", str(image), "-D", str(tmp_path / "out"), "--no-plots"])
    (line,) = capsys.readouterr().out.splitlines()
    assert code == BAD_INPUT and line.isprintable() and "root:" not in line


CONTROL = "a\nb\x1b[31m\x07c"


@pytest.mark.parametrize("command", ["detect", "locate", "identify", "batch", "track", "calibrate", "horizon"])
@pytest.mark.parametrize("content", ["picture", "other"])
def test_control_characters_in_names_are_escaped(tmp_path, capsys, command, content):
    """Whatever a command prints about an image, none of it moves the cursor, and a name stays in its line."""
    (image,) = frames(tmp_path / "images", 1)
    named = image.with_name(f"{CONTROL}.png")
    image.rename(named)
    named.with_suffix(".json").write_text(json.dumps({"time_utc": "2030-01-01T00:00:00Z", "camera": "fisheye-2048"}))
    if content == "other":
        named.write_bytes(b"no picture")
    more = {"calibrate": ["--fov", "180", "-o", str(tmp_path / "c.toml")], "batch": ["-j", "1", "-v"],
            "horizon": ["--fov", "180", "--site=34,-111", "-o", str(tmp_path / "h.csv")]}  # fmt: skip
    source = named.parent if command == "batch" else named
    folder = [] if command in ("calibrate", "horizon") else ["-D", str(tmp_path / "out")]
    assert main([command, str(source), *folder, *more.get(command, [])]) != 0
    printed = capsys.readouterr()
    text = printed.out + printed.err
    assert "a\\nb\\x1b[31m\\x07c" in text or "c.toml  refused  no_stars" in text
    assert all(line.isprintable() for line in text.splitlines()) and "\nb" not in text


def check_printed(capsys: pytest.CaptureFixture[str]) -> str:
    """What was printed, none of which moves the cursor or breaks a name into lines."""
    text = "".join(capsys.readouterr())
    assert all(line.isprintable() for line in text.splitlines()) and "\nb" not in text
    return text


def test_a_located_picture_has_any_name(tmp_path, capsys):
    """In tables, pages and maps too; folders have such names as well."""
    folder, out = tmp_path / CONTROL, tmp_path / "out" / CONTROL
    folder.mkdir()
    for name, sample in ((CONTROL, "near-centre"), ("c", "near-wall")):
        for suffix in (".png", ".json"):
            (folder / f"{name}{suffix}").write_bytes((ROOT / "sample_images" / f"{sample}{suffix}").read_bytes())
    escaped = "a\\nb\\x1b[31m\\x07c"
    assert main(["track", str(folder), "-D", str(out)]) == 0
    assert f"{escaped}  used" in check_printed(capsys)
    assert sorted(Table.read(out / "track.ecsv")["image"]) == [escaped, "c"]
    assert main(["batch", str(folder), "-D", str(out), "-j", "1", "--no-plots", "-v"]) == 0
    assert sorted(Table.read(out / "results.ecsv")["image"]) == [f"{escaped}.png", "c.png"]
    assert main(["report", str(out)]) == 0
    assert "left out" not in check_printed(capsys)
    words = ["-D", str(out / "one"), "--no-plots", "--format", "kml", "-v"]
    assert main(["locate", str(folder / f"{CONTROL}.png"), *words]) == 0
    check_printed(capsys)
    assert escaped in "".join(ElementTree.parse(out / "one" / f"{CONTROL}.kml").getroot().itertext())


@pytest.mark.parametrize("words", WITH_PATHS)
def test_control_characters_in_paths_are_escaped(tmp_path, capsys, words):
    folder = tmp_path / CONTROL
    (image,) = frames(folder, 1)
    places = {"image": image, "folder": folder, "map": MAP}
    for kind, name in (("calib", "fisheye-2048"), ("terrain", "shackleton-thesis")):
        places[kind] = folder / f"{CONTROL}{kind}.toml"  # its stem is the name where it states none
        places[kind].write_bytes((ROOT / kind / f"{name}.toml").read_bytes().replace(b"name =", b"#"))
    try:
        code = main([word.format(**places) for word in words.split()])
    except SystemExit as end:
        code = end.code
    assert code != INTERNAL_ERROR and check_printed(capsys)


def test_a_rendered_picture_names_files_of_any_name(tmp_path):
    """Its sidecar is read again."""
    folder = tmp_path / CONTROL
    folder.mkdir()
    (folder / "camera.toml").write_bytes((ROOT / "calib" / "fisheye-2048.toml").read_bytes())
    words = ["-c", str(folder / "camera.toml"), "-t", "shackleton-thesis", "--time", "2030-01-01T00:00:00Z"]
    assert main(["render", *words, "-o", str(tmp_path / "a.png"), "--no-faint-stars"]) == 0
    assert read_exposure(tmp_path / "a.png").camera == str(folder / "camera.toml")


def test_writers_at_once_leave_a_whole_file(tmp_path):
    """Of eight that write one file, one is last; a reader sees a whole file at any time, and no temporary one stays."""
    path, texts = tmp_path / "a.json", [str(k).encode() * 100_000 for k in range(8)]
    write_atomically(path, texts[0], overwrite=True)
    with ThreadPoolExecutor(8) as pool:
        writers = [pool.submit(write_atomically, path, text, overwrite=True) for text in texts for _ in range(10)]
        seen = {path.read_bytes() for _ in range(100)}
        for writer in writers:
            writer.result()
    assert {*seen, path.read_bytes()} <= {*texts}
    assert list(tmp_path.iterdir()) == [path]


def test_locate_and_batch_state_the_same_paths(tmp_path):
    """Of camera and terrain, named in a sidecar or by flags, from whatever folder the command runs."""
    (image,) = frames(tmp_path / "images", 1)
    for kind, name in (("calib", "fisheye-2048"), ("terrain", "shackleton-thesis")):
        (tmp_path / f"{kind}.toml").write_bytes((ROOT / kind / f"{name}.toml").read_bytes())
    named = {"camera": "../calib.toml", "terrain": "../images/../terrain.toml", "time_utc": "2030-01-01T00:00:00Z"}
    image.with_suffix(".json").write_text(json.dumps(named))
    with chdir(tmp_path):
        main(["locate", "images/00.png", "-D", "one", "--no-plots", "-q"])
        main(["batch", "images", "-D", "many", "--no-plots", "-j", "1", "-q"])
    records = [json.loads((tmp_path / out / "00.fix.json").read_text())["provenance"] for out in ("one", "many")]
    assert records[0] == records[1]
    assert records[0]["camera"] == os.path.realpath(tmp_path / "calib.toml")
    assert records[0]["terrain"] == os.path.realpath(tmp_path / "terrain.toml")


@pytest.mark.slow
@pytest.mark.parametrize("name", ["00.fix.json", "manifest.json"])
@pytest.mark.parametrize("kind", ["pipe", "full folder", "deep JSON"])
def test_a_batch_does_not_hang_or_fail_on_what_is_no_result(tmp_path, capsys, kind, name):
    frames(tmp_path / "images", 2)
    out = tmp_path / "out"
    put(out / name, kind)
    with time_limit(120):
        code = main(["batch", str(tmp_path / "images"), "-D", str(out), "-j", "1", "-v"])
    err = "".join(capsys.readouterr())
    assert code in (BAD_INPUT, NOT_ALL)
    assert "internal error" not in err and "Traceback" not in err
    if kind == "full folder":
        assert name in err and "No space left" not in err
    assert json.loads((out / "01.fix.json").read_text())["reason"] == "no_stars"


@pytest.mark.parametrize(
    ("words", "fault"),
    [
        (words, fault)
        for words in OUTPUTS
        for fault in ("/proc/a", "folder", "file/below", "long", "unknown suffix", "existing")
        # calibrate and report take any suffix; report replaces its file
        if not (words.startswith(("calibrate", "report")) and fault == "unknown suffix")
        if not (words.startswith("report") and fault == "existing")
    ],
)
def test_an_output_path_at_fault_is_wrong_usage(tmp_path, capsys, words, fault):
    """In one line with the cause, exit code 2, and nothing is written."""
    suffix = {"horizon": ".csv", "render": ".png", "report": ".html"}.get(words.split()[0], ".toml")
    (image,) = frames(tmp_path / "images", 1)
    (tmp_path / f"folder{suffix}").mkdir()
    (tmp_path / "file").write_text("")
    (tmp_path / f"existing{suffix}").write_text("before")
    name = {"long": "x" * 300 + suffix, "unknown suffix": "a.xyz"}.get(fault, fault + suffix)
    before = sorted(tmp_path.rglob("*"))
    command = words.format(image=image, folder=tmp_path / "images").split()
    try:
        code = main([*command, str(tmp_path / name)])
    except SystemExit as end:
        code = end.code
    out, err = capsys.readouterr()
    assert (code, out) == (2, "")
    assert "error: " in err.splitlines()[0] and "Traceback" not in err
    assert sorted(tmp_path.rglob("*")) == before
    assert (tmp_path / f"existing{suffix}").read_text() == "before"


def test_a_folder_in_place_of_a_table_is_named(tmp_path, capsys):
    frames(tmp_path / "images", 1)
    put(tmp_path / "out" / "results.ecsv", "full folder")
    assert main(["batch", str(tmp_path / "images"), "-D", str(tmp_path / "out"), "-j", "1"]) in (BAD_INPUT, NOT_ALL)
    err = capsys.readouterr().err
    assert "results.ecsv" in err
    assert "full" not in err and "space" not in err


@contextmanager
def file_limit(largest_kb: int) -> Iterator[None]:
    """In the block no file may be larger: stands for a full disk. Bytecode that is cut would spoil later imports."""
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "dont_write_bytecode", True)
        patch.setenv("PYTHONDONTWRITEBYTECODE", "1")
        resource.setrlimit(resource.RLIMIT_FSIZE, (1024 * largest_kb, limits[1]))
        try:
            yield
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, limits)


@pytest.mark.parametrize("largest_kb", [4, 100, 900])
def test_a_full_disk_leaves_no_part_of_a_fix(located, tmp_path, largest_kb):
    """For the record, for the star table, or for the picture alone."""
    path = tmp_path / "small.fix.json"
    write_results(located.result, path)
    sizes = {one.name: one.stat().st_size for one in tmp_path.iterdir()}
    assert min(sizes.values()) < 1024 * largest_kb < max(sizes.values())
    remove_companions(path)
    path.unlink()
    with file_limit(largest_kb), pytest.raises(BadInput, match=r"cannot be written \(File too large\)") as refusal:
        write_results(located.result, path)
    assert (refusal.value.reason, refusal.value.reason.exit_code) == ("disk_full", BAD_INPUT)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("projection", ["moon", "EPSG:32616"])
def test_a_map_on_a_full_disk_is_named_and_leaves_nothing(tmp_path, projection):
    """Maps of the Earth are made by rasterio, which says that a write failed and not why."""
    raster = read_map(MAP) if projection == "moon" else in_projection(projection, 75.0)
    with file_limit(4):
        for write in (write_map, lambda path, one: write_bands(path, one, dict.fromkeys("ab", one.heights_m))):
            with pytest.raises(BadInput, match=r"a\.tif: cannot be written \(File too large\)") as refusal:
                write(tmp_path / "a.tif", raster)
            assert refusal.value.reason == "disk_full"
    assert list(tmp_path.iterdir()) == []


def test_an_import_on_a_full_disk_leaves_nothing(tmp_path, capsys):
    words = ["--latitude", "-89.46", "--longitude", "-137.49", "-o", str(tmp_path / "z.toml")]
    with file_limit(4):
        assert main(["terrain", "import", str(MAP), *words]) == BAD_INPUT
    assert f"disk_full: {tmp_path}/z-1.tif: cannot be written (File too large)" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("kind", ["pipe", "loop"])
@pytest.mark.parametrize("name", ["predict.tif", "predict.ecsv"])
def test_predict_refuses_names_that_take_no_file_before_it_draws(tmp_path, capsys, kind, name):
    put(tmp_path / name, kind)
    words = ["-t", "shackleton-thesis", "-c", "fisheye-2048", "--time", "2030-01-01T00:00:00Z", "--draws", "1000"]
    with time_limit(60):
        assert main(["predict", *words, "-D", str(tmp_path)]) == 2
    assert f"{name}: cannot be replaced: it is no regular file" in capsys.readouterr().err
    assert [one.name for one in tmp_path.iterdir()] == [name]


def test_a_colour_jpeg_takes_a_bounded_memory(tmp_path):
    """At the peak 3 bytes a pixel as stored, 4 decoded by Pillow, 4 as floating point: 2.2 GB for 200 Mpx."""
    import cv2

    side = 6000
    path = tmp_path / "large.jpg"
    path.write_bytes(cv2.imencode(".jpg", np.full((side, side, 3), 40, np.uint8))[1].tobytes())
    code = (
        "import resource, sys; import numpy, PIL.JpegImagePlugin; from startrack.exposure import read_exposure; "
        "used = lambda: 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss; before = used(); "
        "read_exposure(sys.argv[1]); print(used() - before)"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, str(path)], capture_output=True, text=True, check=True,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
    )  # fmt: skip
    assert float(done.stdout) / side**2 < 11.0


def test_devices_are_no_images(tmp_path):
    with time_limit(20), pytest.raises(BadInput, match="/dev/zero"):
        read_exposure("/dev/zero")


@pytest.mark.parametrize(
    "error",
    [
        BadInput("bad_image", "no picture"),
        BadOutput("bad_terrain", "name another folder", "give -D"),
        NotLocated("two positions", reason="inconsistent_evidence"),
    ],
    ids=lambda error: type(error).__name__,
)
def test_failures_pass_between_processes(error: Any) -> None:
    again = pickle.loads(pickle.dumps(error))
    assert (type(again), str(again), vars(again)) == (type(error), str(error), vars(error))
