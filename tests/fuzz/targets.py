"""One mutated file read, and the outcome judged: an answer, or a refusal with a reason and one line of cause."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from pathlib import Path
from random import Random
from typing import Any

import numpy as np

from startrack.core.errors import BAD_INPUT_REASONS, BadInput

from .access import Broken, no_access_beside
from .beside import READERS_BESIDE
from .mutate import mutate
from .seeds import CYLINDER, HEIGHT_MAP, hill_map, seeds
from .seeds_beside import OBSTACLES

SUFFIXES = {"png": ".png", "jpeg": ".jpg", "tiff": ".tif", "fits": ".fits", "raw": ".dng"}
PROGRAMS = ("ros", "kalibr", "colmap", "opencv", "platepar", "opencv")  # of the seeds in order
MAX_MESSAGE_CHARS = 1200  # with two paths of a temporary folder in it
OUT_OF_MEMORY = ("MemoryError", "Unable to allocate", "Insufficient memory", "bad_alloc", "cannot allocate")


def prepare(folder: Path) -> None:
    """The sound files that stand beside the mutated one, and one use of every reader, so that all is imported."""
    (folder / "hill.tif").write_bytes(hill_map())
    for name in ("sound.png", "frame.png"):  # with a sidecar, which other files mutate, and without
        (folder / name).write_bytes(seeds()["png"][0])
    (folder / "terrain.toml").write_text(CYLINDER)
    (folder / "obstacles.csv").write_text(OBSTACLES)
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
    """As the command `calibrate convert --from` does, and of the program that is found."""
    from startrack.camera import camera_from_foreign_text as from_text
    from startrack.camera import camera_text, load_camera
    from startrack.camera.formats import find_program

    try:
        text = data.decode()
    except UnicodeDecodeError:
        return
    written = camera_text(from_text(text, find_program(text) or PROGRAMS[number], "converted"))
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
    """As a terrain, and as the command `terrain state` does."""
    from startrack.terrain import load_terrain, state_errors, stateable_errors

    path = folder / "mutated.toml"
    path.write_bytes(data)
    load_terrain(path)
    text = data.decode()
    state_errors(text, {(error.table, error.key): 0.5 for error in stateable_errors(text) if error.is_missing})


def _read_elevation(data: bytes, number: int, folder: Path) -> None:
    from startrack.terrain import load_terrain

    (folder / "mutated.tif").write_bytes(data)
    path = folder / "of-mutated.toml"
    path.write_text(HEIGHT_MAP.replace("hill.tif", "mutated.tif"))
    load_terrain(path)


READERS: dict[str, Callable[[bytes, int, Path], None]] = {
    **{kind: _read_image(suffix) for kind, suffix in SUFFIXES.items()},
    "sidecar": _read_sidecar, "camera": _read_camera, "converted": _read_converted, "terrain": _read_terrain,
    "elevation": _read_elevation, **READERS_BESIDE,
}  # fmt: skip
