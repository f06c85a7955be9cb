"""Kinds of images and of other programs' camera files that are read: help texts and messages take their names here."""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple


def any_of(names: Iterable[str]) -> str:
    """Text of two or more names, as "A, B or C"."""
    *first, last = names
    return f"{', '.join(first)} or {last}"


class Format(NamedTuple):
    """Files of images of one kind: the first bytes that they may have, and the suffixes of their names."""

    starts: tuple[bytes, ...]
    suffixes: tuple[str, ...]


FORMATS = {  # by their kind, whose module of startrack.exposure, in lower case, has the function `decode`
    "PNG": Format((b"\x89PNG\r\n\x1a\n",), (".png",)),
    "TIFF": Format((b"II*\0", b"MM\0*", b"II+\0", b"MM\0+"), (".tif", ".tiff")),
    "FITS": Format((b"SIMPLE  =", b"\x1f\x8b", b"BZh"), (".fits", ".fit", ".fts")),
    "JPEG": Format((b"\xff\xd8\xff",), (".jpg", ".jpeg")),
}
RAW_SUFFIXES = {".dng", ".cr2", ".cr3", ".crw", ".nef", ".arw", ".orf", ".rw2", ".raf", ".pef", ".srw"}
KINDS_TEXT = any_of([*FORMATS, "camera raw"])
PROGRAMS = {  # whose camera files are read, by the keys of FOREIGN_FORMATS of startrack.camera.formats
    "ros": "ROS", "kalibr": "Kalibr", "colmap": "COLMAP", "opencv": "OpenCV", "platepar": "RMS",
}  # fmt: skip
PROGRAMS_TEXT = any_of(PROGRAMS.values())
