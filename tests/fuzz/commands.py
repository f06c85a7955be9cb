"""One whole command on files of which one is mutated, and the outcome judged as of a reader."""

from __future__ import annotations

import contextlib
import io
import json
import os
import shutil
from functools import cache, partial
from pathlib import Path
from random import Random
from unittest.mock import patch

import numpy as np

from startrack.core.errors import exit_code_of
from startrack.core.files import data_dir
from startrack.core.runner import Runner

from .access import Broken, no_access_beside
from .mutate import TEXTS, mutate
from .seeds import CYLINDER, FRAME, HEIGHT_MAP, hill_map, pillow, seeds
from .seeds_beside import ODOMETRY
from .targets import OUT_OF_MEMORY

SAMPLE = Path(__file__).resolve().parents[2] / "sample_images" / "near-centre"
SKY = SAMPLE.with_name("lowell-2018-08-06.fits.bz2")
NIGHT = "2030-06-01T00:00:00Z"
PREDICTED = ("--time", NIGHT, "--draws", "1", "--path", "way.csv", "--spacing", "200", "-j", "1")
CAMERA = ("-c", "camera.toml")
SHIPPED = "fisheye-2048"  # the camera of the sample, whose record is pointed
COMMANDS = (
    ("locate", "image.png", "--json", "--no-plots"), ("identify", "image.png", "--json", "--no-plots"),
    ("detect", "image.png", "--json", "--no-plots"), ("locate", "image.png", "--no-plots"),
    ("terrain", "show", "terrain.toml", "--json", "--no-plots"), ("calibrate", "show", "camera.toml"),
    ("calibrate", "convert", "camera.toml", "--to", "opencv", "-q"), ("track", "image.png", "--no-plots"),
    ("calibrate", "convert", SHIPPED, "--to", "platepar", "--attitude", "image.fix.json", "--site=-34,69", "-q"),
    ("calibrate", "convert", SHIPPED, "--to", "indi-allsky", "--attitude", "image.fix.json", "--site=-34,69"),
    ("calibrate", "convert", "camera.yaml", "--from", "ros", "-q"), ("calibrate", "verify", "image.png", *CAMERA),
    ("calibrate", "image.png", *CAMERA, "-q", "-o"),
    ("horizon", "sky.fits.bz2", "-c", "sky.toml", "--site=34.74,-111.42,2360", "-q", "-o"),
    ("identify", "image.png", "--fov=180", "--no-plots"), ("identify", "image.png", "--near-sky=94,-68,20", "-q"),
    ("locate", "image.png", "--near-attitude", "image.fix.json", "--near=400,-300,100", "-q", "--format=kml"),
    ("track", "image.png", "--odometry", "drive.tum", "--max-speed=2", "--no-plots"),
    ("terrain", "show", "map.toml", "--at", "0", "10"), ("terrain", "state", "terrain.toml", "--depth-sigma=30"),
    ("terrain", "import", "hill.tif", "--latitude=-90", "--longitude=0", "--radius=800", "--half=2000", "-q", "-o"),
    ("report", "image.fix.json", "-q"), ("report", ".", "-q"), ("batch", ".", "--no-plots", "--report", "-j", "1"),
    ("reproduce", "fig3.4", "--no-plots", "-j", "1"),
    ("predict", "-t", "terrain.toml", *CAMERA, *PREDICTED, "--no-plots"),
    ("render", "-t", "terrain.toml", *CAMERA, "--time", NIGHT, "-q"),
)  # fmt: skip
FILES = (  # that are mutated, with the kind of their changes
    ("png", "image.png"), ("sidecar", "image.json"), ("camera", "camera.toml"), ("terrain", "terrain.toml"),
    ("sidecar", "image.fix.json"), ("terrain", "way.csv"), ("camera", "camera.yaml"), ("odometry", "drive.tum"),
    ("table", "obstacles.csv"), ("correction", "mask.png"), ("correction", "dark.png"), ("elevation", "hill.tif"),
    ("terrain", "map.toml"),
)  # fmt: skip
SKY_FILES = (("fits", "sky.fits.bz2"), ("sidecar", "sky.json"), ("camera", "sky.toml"))  # of horizon
RESUMED = ("batch", "predict", "reproduce", "track")  # begin with the results of a run on sound files
ENTRIES = 0.1  # of the mutations: the file becomes something else
WITHOUT_OUTPUT = (("calibrate", "show"), ("calibrate", "verify"), ("terrain", "state"))
SUFFIXES = {"horizon": ".csv"}  # of what -o names
INPUTS = (".png", ".toml", ".json", ".csv", ".yaml", ".tum", ".tif", ".bz2")
WORDS = 0.3  # of the mutations: a value among the words of the command
REFUSE_SAMPLES = ("batch",)  # a picture without a sidecar


def words_of(seed: int, index: int) -> tuple[str, ...]:
    """The sound words of the command number `index` of a campaign with this `seed`."""
    return Random(f"{seed}/command/{index}").choice(COMMANDS)


def run_command(seed: int, index: int, folder: Path) -> str | None:
    """One command on sound files of which one is mutated, in `folder`; the reason of a refusal. Raises Broken.

    Of a command that goes on from its results one of these is mutated as often as an input.
    """
    random = Random(f"{seed}/command/{index}")
    words = random.choice(COMMANDS)
    results = _results_of(words, folder)
    stored = [("sidecar" if name.endswith(".json") else "raw", name) for name in results if is_read_again(name)]
    inputs = SKY_FILES if words[0] == "horizon" else FILES
    kind, name = random.choice(stored if stored and random.random() < 0.5 else inputs)
    here = _begin(words, folder, small=kind in ("png", "correction") and not results)
    values = [k for k, word in enumerate(words) if "=" in word]
    if values and random.random() < WORDS:
        words = _change_value(words, random.choice(values), random)
    elif random.random() < ENTRIES:
        _change_entry(here / name, random)
    else:
        (here / name).write_bytes(mutate(kind, (here / name).read_bytes(), random))
    with no_access_beside(folder, written=(here / "out", folder / "cache", *([here] if "state" in words else []))):
        return _run(words, here)


def _change_value(words: tuple[str, ...], which: int, random: Random) -> tuple[str, ...]:
    """The words with the value of one of them, of --flag=value the part after the sign, changed."""
    flag, sign, value = words[which].rpartition("=")
    changed = mutate("sidecar", value.encode(), random).replace(b"\0", b"").decode("utf-8", "replace")
    return *words[:which], flag + sign + changed, *words[which + 1 :]


def is_read_again(name: str) -> bool:
    """Whether a command reads the result of this `name` when it goes on."""
    return name.endswith((".json", ".npz"))


def _begin(words: tuple[str, ...], folder: Path, *, small: bool) -> Path:
    """Sound files, and the results that the command goes on from."""
    here = _write_sound(folder, small=small)
    if words[0] == "horizon":
        for name, sample in (("sky.fits.bz2", SKY), ("sky.json", SKY.with_name("lowell-2018-08-06.json"))):
            shutil.copyfile(sample, here / name)
        (here / "sky.toml").write_text((data_dir("calib") / "lowell-ldt.toml").read_text())
    for name, data in _results_of(words, folder).items():
        (here / name).parent.mkdir(parents=True, exist_ok=True)
        (here / name).write_bytes(data)
    return here


def _change_entry(path: Path, random: Random) -> None:
    """A file with another name, or a folder, a pipe or a link of its name in its place."""
    data, act = path.read_bytes(), random.randrange(6)
    path.unlink()
    if act == 0:
        name = random.choice((b"\xff\n.png", b"-D.png", b"\x1b[1m.png", b" .png", 240 * b"x" + b".png", *TEXTS))
        with contextlib.suppress(OSError, ValueError):  # no name of a file
            Path(os.fsdecode(os.fsencode(path.parent) + b"/" + name.replace(b"/", b""))).write_bytes(data)
    elif act == 1:
        path.mkdir()
    elif act == 2:
        os.mkfifo(path)
    else:
        path.symlink_to(("nowhere", path.name, "/dev/zero")[act - 3])


@cache
def _results_of(words: tuple[str, ...], folder: Path) -> dict[str, bytes]:
    """The files that a command of RESUMED on sound files writes, by their paths; none of another."""
    if words[0] not in RESUMED:
        return {}
    here = _write_sound(folder, small=False)
    _run(words, here)
    files = (path for path in sorted((here / "out").rglob("*")) if path.is_file())
    return {path.relative_to(here).as_posix(): path.read_bytes() for path in files}


def run_sound_commands(folder: Path) -> None:
    """Every command on sound files, so that all is imported and compiled. Raises Broken."""
    for words in COMMANDS:
        run_sound(words, folder, small=True)
        reason = run_sound(words, folder, small=False)
        if reason is not None and words[0] not in REFUSE_SAMPLES:
            raise Broken(f"{words} refuses sound files: {reason}")


def run_sound(words: tuple[str, ...], folder: Path, *, small: bool) -> str | None:
    """One command on sound files, with a `small` image or a sample; the reason of a refusal. Raises Broken."""
    return _run(words, _begin(words, folder, small=small))


def _run(command: tuple[str, ...], folder: Path) -> str | None:
    """Run a command in this process and judge it; the reason of a refusal."""
    from startrack.cli.main import main

    words = [str(folder / word) if word == "." or Path(word).suffix in INPUTS else word for word in command]
    if command[0] == "report":
        words += ["-o", str(folder / "out" / "report.html")]
    elif words[-1] == "-o":
        words += [str(folder / "out" / f"new{SUFFIXES.get(words[0], '.toml')}"), "-O"]
    elif command[:2] not in WITHOUT_OUTPUT:
        words += ["-D", str(folder / "out")]
    out, err = io.StringIO(), io.StringIO()
    in_process = patch("startrack.cli.pictures.batch.Runner", partial(Runner, in_process=True))  # under our limits
    with in_process, contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            code = main(words)
        except SystemExit as stop:  # of wrong usage, such as a folder with results of something else
            code = int(stop.code or 0)
    return _judge_command(words, code, out.getvalue(), err.getvalue(), folder)


def _write_sound(above: Path, *, small: bool) -> Path:
    """A new folder of image, sidecar, camera and terrain: a `small` image with a few points, or a sample.

    The sample is located; beside it there is a picture without a sidecar.
    """
    folder = above / "files"
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    (folder / "sound.png").write_bytes(_night())
    facts = {"time_utc": NIGHT, "exposure_s": 1.0}
    camera = COMMAND_CAMERA
    if small:
        (folder / "image.png").write_bytes(_night())
    else:
        shutil.copyfile(SAMPLE.with_suffix(".png"), folder / "image.png")
        facts = json.loads(SAMPLE.with_suffix(".json").read_text())
        camera = (data_dir("calib") / "fisheye-2048.toml").read_text()
    (folder / "camera.toml").write_text(camera)
    (folder / "terrain.toml").write_text(CYLINDER)
    named = {"camera": "camera.toml", "terrain": "terrain.toml", "obstacles": "obstacles.csv"}
    named |= {"mask": "mask.png", "dark": "dark.png"} if small else {}
    for name, pixels in (("mask.png", np.full(FRAME.shape, 255)), ("dark.png", FRAME // 300)):
        (folder / name).write_bytes(pillow(pixels, "PNG", eight=name == "mask.png"))
    (folder / "image.json").write_text(json.dumps(facts | named))
    (folder / "image.fix.json").write_text(_result_of_sample())
    (folder / "way.csv").write_text("east_m,north_m\n0,0\n150,0\n")
    (folder / "camera.yaml").write_bytes(seeds()["converted"][0])
    (folder / "drive.tum").write_text(ODOMETRY)
    (folder / "obstacles.csv").write_text("azimuth_deg,elevation_deg\n10,3\n12,3\n")
    (folder / "hill.tif").write_bytes(hill_map())
    (folder / "map.toml").write_text(HEIGHT_MAP)
    return folder


@cache
def _result_of_sample() -> str:
    """The record of the sample that is located."""
    from startrack import locate
    from startrack.output import result_dict

    return json.dumps(result_dict(locate(SAMPLE.with_suffix(".png")).result))


COMMAND_CAMERA = """format = 1
name = "small"
size_px = [60, 40]
focal_px = [30.0, 30.0]
centre_px = [29.5, 19.5]
max_angle_deg = 60.0
[sensor]
zero_point_e_per_s = 44000.0
gain_e_per_adu = 0.5
bias_adu = 100.0
read_noise_e = 2.5
"""


def _night() -> bytes:
    """A small picture with some point sources."""
    import cv2

    y, x = np.mgrid[: FRAME.shape[0], : FRAME.shape[1]]
    pixels = FRAME.astype(float) / 5
    for cx, cy in np.random.default_rng(2).uniform(5, 35, (8, 2)):
        pixels += 900 * np.exp(-0.5 * ((x - cx) ** 2 + (y - cy) ** 2))
    return bytes(cv2.imencode(".png", pixels.round().astype(np.uint16))[1])


def _judge_command(words: list[str], code: int, out: str, err: str, folder: Path) -> str | None:
    """The reason of a refusal, None for an answer. Raises Broken."""
    where = f"{words[:2]} code {code}, printed {out[-300:]!r}, {err[-600:]!r}"
    codes = (
        {0, 3, 4} | ({2, 5} if words[0] in RESUMED else set()) | ({2} if any("=" in word for word in words) else set())
    )
    if code not in codes or any(mark in out + err for mark in ("Traceback", "internal error", "Warning")):
        raise Broken(where)
    if any(mark in out + err for mark in OUT_OF_MEMORY):
        raise MemoryError(where)
    partial = [path.name for path in folder.rglob("*.part")]
    if partial:
        raise Broken(f"{where}: left {partial}")
    if "--json" not in words or words[0] == "terrain":
        if code and not 1 <= len((out + err).splitlines()) <= 12:
            raise Broken(where)
        return None if code == 0 else "refused"
    (line,) = out.splitlines()
    record = json.loads(line)
    reason = record["reason"]
    if exit_code_of(reason) != code or (reason and ("\n" in record["message"] or not record["message"])):
        raise Broken(where)
    return reason
