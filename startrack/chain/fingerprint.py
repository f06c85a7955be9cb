"""Hashes of all that decides an image's result: the content of its files, the flags, this version."""

from __future__ import annotations

import hashlib
import json
import os
import stat
from collections.abc import Iterable
from functools import lru_cache
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from startrack.catalog import has_deep_catalog
from startrack.core import __version__
from startrack.core.errors import BadInput
from startrack.core.file_kinds import RAW_SUFFIXES
from startrack.core.files import is_path, parse_toml, read_text, relative_path, split_camera
from startrack.exposure import IMAGE_KEYS, BagImage, Sidecar, sidecar_of
from startrack.terrain import files_of_terrain

MISSING = "?"  # in place of the hash of a file that cannot be read; once it can, the hash differs
FILES = ("camera", "terrain", *IMAGE_KEYS)  # facts that may be paths


def sha256_of(path: str | os.PathLike[str]) -> str:
    """SHA-256 of a file's content in hex; `MISSING` if it cannot be read, which the reader of the file reports.

    A height map is read once, not for every image.
    """
    try:
        found = os.stat(path)
        if not stat.S_ISREG(found.st_mode):  # opening a pipe would block
            return MISSING
        return _sha256_at_stamp(os.fspath(path), (found.st_ino, found.st_size, found.st_mtime_ns))
    except (OSError, ValueError):  # a NUL in the name
        return MISSING


@lru_cache(maxsize=64)
def _sha256_at_stamp(path: str, stamp: tuple[int, ...]) -> str:
    """SHA-256 in hex of the file at `path`, computed once for each `stamp` of its state."""
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def content_sha256(image: str, bag_image: BagImage | None) -> str:
    """SHA-256 of the file `image`, or of the message of `bag_image`; `MISSING` if the file cannot be read."""
    return sha256_of(image) if bag_image is None else bag_image.message.sha256


def job_sha256(image: str, image_sha256: str, facts: dict[str, Any], *others: object) -> str:
    """SHA-256 of image, sidecar, flags, version and extras, and of dark frame and flat field.

    `image_sha256` is the `content_sha256` of the `image`; `facts` are the flags by name, `others` further settings.
    `input_hashes` covers the other files that these name.
    """
    path = Path(image)
    sidecar = sidecar_of(path)
    files = {key: relative_path(facts[key], path.parent) for key in FILES if is_path(facts.get(key, ""))}
    flags = {**facts, **files}
    extras = [has_deep_catalog(), path.suffix.lower() in RAW_SUFFIXES and find_spec("rawpy") is not None]
    whole = [__version__, flags, *others, extras, image_sha256, sidecar and sha256_of(sidecar)]
    whole += _correction_hashes(path, facts)
    return hashlib.sha256(json.dumps(whole, default=str).encode()).hexdigest()


def _correction_hashes(image: Path, facts: dict[str, Any]) -> list[str]:
    """Key and SHA-256 of the dark frame and the flat field of an `image`, by flags, else by its sidecar."""
    try:
        sidecar = Sidecar.read(image)
        files = {key: facts.get(key) or sidecar.value(key) for key in ("dark", "flat")}
    except BadInput:  # refused when the image is read
        return []
    return [f"{key} {sha256_of(file)}" for key, file in files.items() if file]


def input_hashes(image: str, cameras: Iterable[str | None], terrain: str | None, *others: object) -> dict[str, str]:
    """Path to SHA-256 of the files of `cameras`, a `terrain` and `others`, and of those that they are read from.

    Shipped files do not count: they belong to the version. Paths are relative to the folder of the `image`, so that a
    tree may move.
    """
    named = [split_camera(reference)[0] for reference in cameras if reference and is_path(reference)]
    files = [
        Path(reference) for reference in (*named, terrain, *others) if isinstance(reference, str) and is_path(reference)
    ]
    files += [one for camera in named for one in _files_of_camera(Path(camera))]
    files += files_of_terrain(terrain) if terrain and is_path(terrain) else ()
    return {relative_path(file, Path(image).parent): sha256_of(file) for file in files}


def are_unchanged(image: str, hashes: dict[str, str]) -> bool:
    """Whether the files have the content they had: `hashes` is what `input_hashes` returned for the `image`."""
    folder = os.path.realpath(Path(image).parent)
    return all(sha256_of(Path(folder, path)) == sha256 for path, sha256 in hashes.items())


def _files_of_camera(camera: Path) -> list[Path]:
    """The mask and the obstacles that a camera file names, if any."""
    try:
        values = parse_toml(read_text(camera, "bad_calibration"), "bad_calibration") if camera.suffix == ".toml" else {}
    except BadInput:  # refused when it is loaded
        return []
    return [camera.parent / str(values[key]) for key in ("mask", "obstacles") if key in values]
