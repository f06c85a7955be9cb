"""One mutated file read, and the outcome judged: an answer, or a refusal with a reason and one line of cause."""

from __future__ import annotations

import contextlib
import io
import json
import shutil
import warnings
from collections.abc import Callable
from functools import cache
from pathlib import Path
from random import Random
from typing import Any

import numpy as np

from startrack.core.errors import BAD_INPUT_REASONS, BadInput, exit_code_of
from startrack.core.files import data_dir

from .access import Broken, no_access_beside
from .mutate import mutate
from .seeds import CYLINDER, FRAME, HEIGHT_MAP, hill_map, seeds

SUFFIXES = {"png": ".png", "jpeg": ".jpg", "tiff": ".tif", "fits": ".fits", "raw": ".dng"}
PROGRAMS = ("ros", "kalibr", "colmap", "opencv")
SAMPLE = Path(__file__).resolve().parents[2] / "sample_images" / "near-centre"
MAX_MESSAGE_CHARS = 1200  # with two paths of a temporary folder in it
OUT_OF_MEMORY = ("MemoryError", "Unable to allocate", "Insufficient memory", "bad_alloc", "cannot allocate")
NIGHT = "2030-06-01T00:00:00Z"
PREDICTED = ("--time", NIGHT, "--draws", "1", "--path", "way.csv", "--spacing", "200", "-j", "1")
COMMANDS = (
    ("locate", "image.png", "--json", "--no-plots"), ("identify", "image.png", "--json", "--no-plots"),
    ("detect", "image.png", "--json", "--no-plots"), ("locate", "image.png", "--no-plots"),
    ("terrain", "show", "terrain.toml", "--json", "--no-plots"), ("calibrate", "show", "camera.toml"),
    ("calibrate", "convert", "camera.toml", "--to", "opencv", "-q"), ("track", "image.png", "--no-plots"),
    ("calibrate", "image.png", "-c", "camera.toml", "-q", "-o"),
    ("horizon", "image.png", "-c", "camera.toml", "--site=34,-111", "-q", "-o"),
    ("report", "image.fix.json", "-q"),
    ("predict", "-t", "terrain.toml", "-c", "camera.toml", *PREDICTED, "--no-plots"),
    ("render", "-t", "terrain.toml", "-c", "camera.toml", "--time", NIGHT, "-q"),
)  # fmt: skip
FILES = (  # that are mutated, with the kind of their changes
    ("png", "image.png"), ("sidecar", "image.json"), ("camera", "camera.toml"), ("terrain", "terrain.toml"),
    ("sidecar", "image.fix.json"), ("terrain", "way.csv"),
)  # fmt: skip
INPUTS = (".png", ".toml", ".json", ".csv")
REFUSE_SAMPLES = ("horizon",)  # the Moon's sky is no sky of a site on the Earth


def prepare(folder: Path) -> None:
    """The sound files that stand beside the mutated one, and one use of every reader, so that all is imported."""
    (folder / "hill.tif").write_bytes(hill_map())
    (folder / "sound.png").write_bytes(seeds()["png"][0])
    (folder / "terrain.toml").write_text(CYLINDER)
    (folder / "camera.toml").write_bytes(seeds()["camera"][0])
    for kind, files in seeds().items():
        for number in range(len(files)):
            READERS[kind](files[number], number, folder)


def mutated(kind: str, seed: int, index: int) -> tuple[bytes, int]:
    """The file number `index` of a campaign with this `seed`, and the number of the valid file that was changed."""
    random = Random(f"{seed}/{kind}/{index}")
    files = seeds()[kind]
    number = random.randrange(len(files))
    return mutate(kind, files[number], random), number


def read(kind: str, data: bytes, number: int, folder: Path) -> str | None:
    """Read a file of a `kind` in `folder`; None for an answer, else the reason of the refusal.

    Raises Broken, and whatever the reader raises or warns of.
    """
    try:
        with no_access_beside(folder), warnings.catch_warnings():
            warnings.simplefilter("error")  # a library's warning on the terminal is no cause for users
            READERS[kind](data, number, folder)
    except BadInput as refusal:
        _judge(refusal)
        return str(refusal.reason)
    return None


def _judge(refusal: BadInput) -> None:
    message, cause = str(refusal), refusal.__cause__
    if refusal.reason not in BAD_INPUT_REASONS:
        raise Broken(f"reason {refusal.reason}") from refusal
    if not message or message != message.strip() or not message.isprintable() or len(message) > MAX_MESSAGE_CHARS:
        raise Broken(f"message {message[:300]!r} of {len(message)} characters") from refusal
    if isinstance(cause, MemoryError) or any(mark in f"{cause!r} {message}" for mark in OUT_OF_MEMORY):
        raise MemoryError(message) from refusal


def _read_image(suffix: str) -> Callable[[bytes, int, Path], None]:
    def read_one(data: bytes, number: int, folder: Path) -> None:
        from startrack.exposure import read_exposure

        path = folder / f"image{suffix}"
        path.write_bytes(data)
        exposure = read_exposure(path)
        if exposure.pixels_adu.ndim != 2 or not np.isfinite(exposure.pixels_adu).all():
            raise Broken(f"pixels {exposure.pixels_adu.shape} that are not finite")
        if any("\n" in warning for warning in exposure.warnings):
            raise Broken(f"warnings {exposure.warnings}")

    return read_one


def _read_sidecar(data: bytes, number: int, folder: Path) -> None:
    from startrack.exposure import read_exposure

    (folder / "sound.json").write_bytes(data)
    read_exposure(folder / "sound.png")


def _read_camera(data: bytes, number: int, folder: Path) -> None:
    from startrack.camera import load_camera

    path = folder / "mutated.toml"
    path.write_bytes(data)
    _use_camera(load_camera(path))


def _read_converted(data: bytes, number: int, folder: Path) -> None:
    """As the command `calibrate convert --from` does."""
    from startrack.camera import camera_from_foreign_text as from_text
    from startrack.camera import camera_text, load_camera

    try:
        text = data.decode()
    except UnicodeDecodeError:
        return
    written = camera_text(from_text(text, PROGRAMS[number], "converted"))
    path = folder / "mutated.toml"
    path.write_text(written, encoding="utf-8")
    _use_camera(load_camera(path))


def _use_camera(camera: Any) -> None:
    """Pixels to rays and back, and the text of the file."""
    from startrack.camera import camera_text

    width, height = camera.size_px
    pixels = np.array([[0.0, 0.0], camera.centre_px, [width - 1.0, height - 1.0]])
    with np.errstate(all="ignore"):
        rays = camera.unproject(pixels)
        camera.project(rays)
    if not np.isfinite(rays).all():
        raise Broken(f"rays {rays.tolist()}")
    camera_text(camera)


def _read_terrain(data: bytes, number: int, folder: Path) -> None:
    from startrack.terrain import load_terrain

    path = folder / "mutated.toml"
    path.write_bytes(data)
    load_terrain(path)


def _read_elevation(data: bytes, number: int, folder: Path) -> None:
    from startrack.terrain import load_terrain

    (folder / "mutated.tif").write_bytes(data)
    path = folder / "of-mutated.toml"
    path.write_text(HEIGHT_MAP.replace("hill.tif", "mutated.tif"))
    load_terrain(path)


READERS: dict[str, Callable[[bytes, int, Path], None]] = {
    **{kind: _read_image(suffix) for kind, suffix in SUFFIXES.items()},
    "sidecar": _read_sidecar, "camera": _read_camera, "converted": _read_converted, "terrain": _read_terrain,
    "elevation": _read_elevation,
}  # fmt: skip


# --- the whole command -----------------------------------------------------------------------------------------------


def run_command(seed: int, index: int, folder: Path) -> str | None:
    """One command on a folder of sound files of which one is mutated; the reason of a refusal. Raises Broken."""
    random = Random(f"{seed}/command/{index}")
    kind, name = random.choice(FILES)
    _write_sound(folder, small=kind == "png")
    (folder / name).write_bytes(mutate(kind, (folder / name).read_bytes(), random))
    with no_access_beside(folder):
        return _run(random.choice(COMMANDS), folder)


def run_sound_commands(folder: Path) -> None:
    """Every command on sound files, so that all is imported and compiled. Raises Broken."""
    for words in COMMANDS:
        run_sound(words, folder, small=True)
        reason = run_sound(words, folder, small=False)
        if reason is not None and words[0] not in REFUSE_SAMPLES:
            raise Broken(f"{words} refuses sound files: {reason}")


def run_sound(words: tuple[str, ...], folder: Path, *, small: bool) -> str | None:
    """One command on sound files, with a `small` image or a sample; the reason of a refusal. Raises Broken."""
    _write_sound(folder, small=small)
    return _run(words, folder)


def _run(command: tuple[str, ...], folder: Path) -> str | None:
    """Run a command in this process and judge it; the reason of a refusal."""
    from startrack.cli.main import main

    words = [str(folder / word) if Path(word).suffix in INPUTS else word for word in command]
    if command[0] == "report":
        words += ["-o", str(folder / "out" / "report.html")]
    elif command[:2] != ("calibrate", "show"):
        words += ["-D", str(folder / "out")] if "-o" not in words else [str(folder / f"out.{words[0]}.csv"), "-O"]
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        code = main(words)
    return _judge_command(words, code, out.getvalue(), err.getvalue(), folder)


def _write_sound(folder: Path, *, small: bool) -> None:
    """Image, sidecar, camera and terrain: a `small` image with a few points, or a sample that is located."""
    shutil.rmtree(folder / "out", ignore_errors=True)
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
    (folder / "image.json").write_text(json.dumps(facts | {"camera": "camera.toml", "terrain": "terrain.toml"}))
    (folder / "image.fix.json").write_text(_result_of_sample())
    (folder / "way.csv").write_text("east_m,north_m\n0,0\n150,0\n")


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
    if code not in (0, 3, 4) or any(mark in out + err for mark in ("Traceback", "internal error", "Warning")):
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
