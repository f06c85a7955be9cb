"""What decides an image's result: the contents of all its files, the flags, this version; as hashes, to be compared."""

from __future__ import annotations

import hashlib
import json
import os
import stat
import tomllib
from collections.abc import Iterable
from functools import lru_cache
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from startrack import __version__
from startrack.catalog.gaia import has_deep_catalog
from startrack.exposure.metadata import RAW_SUFFIXES, sidecar_of
from startrack.files import is_path

MISSING = "?"  # in place of the hash of a file that cannot be read: there later, it is another input
FILES = ("camera", "terrain")  # facts that may be paths


def sha256_of(path: str | os.PathLike[str]) -> str:
    """SHA-256 of a file's content in hex, `MISSING` where it cannot be read: whoever needs it will say so."""
    try:
        if not stat.S_ISREG(os.stat(path).st_mode):  # a pipe would be waited for
            return MISSING
        with Path(path).open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except (OSError, ValueError):  # a NUL in the name
        return MISSING


def key_of(image: str, image_sha256: str, facts: dict[str, Any], *others: object) -> str:
    """SHA-256 of image, sidecar, flags, version and the extras that matter; `hashes_of` has camera and terrain."""
    path = Path(image)
    sidecar = sidecar_of(path)
    flags = {key: _from(path, value) if key in FILES and is_path(value) else value for key, value in facts.items()}
    extras = [has_deep_catalog(), path.suffix.lower() in RAW_SUFFIXES and find_spec("rawpy") is not None]
    whole = [__version__, flags, *others, extras, image_sha256, sidecar and sha256_of(sidecar)]
    return hashlib.sha256(json.dumps(whole, default=str).encode()).hexdigest()


def hashes_of(image: str, references: Iterable[str | None]) -> dict[str, str]:
    """Path to SHA-256 of the camera's and the terrain's file, height maps included; shipped ones belong to the version.

    Paths are as seen from the image's folder, so that a tree may move.
    """
    files = [Path(reference) for reference in references if reference and is_path(reference)]
    files += [named for file in tuple(files) for named in _maps(file)]
    return {_from(Path(image), file): _sha256_once(file) for file in files}


def unchanged(image: str, hashes: dict[str, str]) -> bool:
    """Whether the files of `hashes_of` are what they were."""
    folder = os.path.realpath(Path(image).parent)
    return all(_sha256_once(Path(folder, path)) == sha256 for path, sha256 in hashes.items())


def untouched_since(image: str | os.PathLike[str], result: str | os.PathLike[str]) -> bool:
    """Whether the image was neither written nor put in its place after its result; quick, for it reads neither."""
    try:
        of_image, of_result = os.stat(image), os.stat(result)
    except (OSError, ValueError):  # a NUL in the name
        return False
    return max(of_image.st_mtime_ns, of_image.st_ctime_ns) < of_result.st_mtime_ns


def _maps(terrain: Path) -> list[Path]:
    """The height maps that a terrain file names."""
    try:
        dem = tomllib.loads(terrain.read_text(encoding="utf-8")).get("dem")
    except (OSError, ValueError):  # no terrain file, or none that can be read: refused where it is loaded
        return []
    names = dem.get("file") if isinstance(dem, dict) else None
    return [terrain.parent / str(name) for name in (names if isinstance(names, list) else [names]) if name]


def _from(image: Path, file: str | Path) -> str:
    """A path as seen from the image's folder; real paths, for `..` leads astray where a folder is a link."""
    real = os.path.realpath(file)
    try:
        return Path(os.path.relpath(real, os.path.realpath(image.parent))).as_posix()
    except ValueError:  # another drive of Windows
        return real


def _sha256_once(path: Path) -> str:
    """A height map is read once, not for every image."""
    try:
        found = path.stat()
    except (OSError, ValueError):
        return MISSING
    return _sha256_as_of(path, (found.st_ino, found.st_size, found.st_mtime_ns))


@lru_cache(maxsize=64)
def _sha256_as_of(path: Path, stamp: tuple[int, ...]) -> str:
    return sha256_of(path)
