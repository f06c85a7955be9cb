"""From a file to its pixels and header: open, find the type from its first bytes, decode strictly."""

from __future__ import annotations

import os
import stat
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

from startrack.core.files import FilePath, printable
from startrack.core.types import BadInput
from startrack.exposure.decoded import MAX_FILE_BYTES, Decoded, bad_image
from startrack.exposure.sidecar import RAW_SUFFIXES

Stamp = tuple[int, ...]  # of a file: inode, size, time of its last change
T = TypeVar("T")
PNG = (b"\x89PNG\r\n\x1a\n",)
TIFF = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")
JPEG = (b"\xff\xd8\xff",)
FITS = (b"SIMPLE  =", b"\x1f\x8b", b"BZh")


def decode_file(path: FilePath) -> tuple[bytes, Decoded]:
    """The bytes of the image at `path`, and their content. Raises BadInput bad_image with file and cause."""
    try:
        raw = _read_bytes(path)
        return raw, decode_bytes(raw, camera_raw=Path(path).suffix.lower() in RAW_SUFFIXES)
    except BadInput as error:
        raise BadInput(error.reason, " ".join(f"{printable(path)}: {error}".split())) from error


def read_stamped(path: FilePath, read: Callable[[str, Stamp], T], kind: str, reason: str | None = None) -> T:
    """What `read` gives for the file at `path` and a stamp of its present state, by which it may keep results.

    Raises BadInput `reason` (None: that of the cause) with the `kind` of file and the cause.
    """
    try:
        found = os.stat(path)
        return read(os.fspath(path), (found.st_ino, found.st_size, found.st_mtime_ns))
    except BadInput as error:
        raise BadInput(reason or error.reason, f"{kind} {error}") from error
    except (OSError, ValueError) as error:  # ValueError: a NUL in the name
        cause = getattr(error, "strerror", None) or error
        raise BadInput(reason or "bad_image", f"{kind} {printable(path)}: cannot be opened ({cause})") from error


def _read_bytes(path: FilePath) -> bytes:
    try:
        status = os.stat(path)
        if stat.S_ISDIR(status.st_mode):
            raise bad_image("is a folder, not an image")
        if not stat.S_ISREG(status.st_mode):  # a pipe would block, a device never end
            raise bad_image("is not a regular file")
        if status.st_size == 0:
            raise bad_image("is empty")
        if status.st_size > MAX_FILE_BYTES:
            raise bad_image(f"is {status.st_size / 1e9:.1f} GB, more than any image startrack reads")
        return Path(path).read_bytes()
    except OSError as error:
        raise bad_image(f"cannot be opened ({error.strerror or error})") from error
    except ValueError as error:  # a NUL in the name
        raise bad_image(f"cannot be opened ({error})") from error


def decode_bytes(raw: bytes, *, camera_raw: bool = False) -> Decoded:
    """The decoded content of a file, of a camera's raw file where `camera_raw` is set.

    Camera raw files are known by their suffix: they are TIFFs with a thumbnail.

    Raises BadInput bad_image; whatever else a decoder raises for damaged bytes is turned into it.
    """
    kind, decode = "image", _refuse_unknown
    try:
        if camera_raw:
            from startrack.exposure.mosaic import decode_camera_raw

            kind, decode = "camera raw file", decode_camera_raw
        elif raw.startswith(PNG):
            from startrack.exposure.png import decode_png

            kind, decode = "PNG", decode_png
        elif raw.startswith(TIFF):
            from startrack.exposure.tiff import decode_tiff

            kind, decode = "TIFF", decode_tiff
        elif raw.startswith(JPEG):
            from startrack.exposure.jpeg import decode_jpeg

            kind, decode = "JPEG", decode_jpeg
        elif raw.startswith(FITS):
            from startrack.exposure.fits import decode_fits

            kind, decode = "FITS", decode_fits
        with warnings.catch_warnings():  # the decoders' checks refuse the file or fill `Exposure.warnings`
            warnings.simplefilter("ignore")
            return decode(raw)
    except BadInput:
        raise
    except Exception as error:
        raise bad_image(f"truncated or damaged {kind} ({type(error).__name__}: {str(error)[:200]})") from error


def _refuse_unknown(raw: bytes) -> Decoded:
    raise bad_image("is not a PNG, TIFF, JPEG or FITS file, nor named as a camera raw file")
