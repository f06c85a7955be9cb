"""From a file to an `Exposure`: open, tell the type by its first bytes, decode strictly, resolve the facts."""

from __future__ import annotations

import hashlib
import os
import stat
import warnings
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from startrack.exposure.decoded import (
    COLOUR_WARNING,
    MAX_FILE_BYTES,
    Decoded,
    check_size,
    grey_float32,
    largest_value,
    refuse,
)
from startrack.exposure.metadata import RAW_SUFFIXES, Facts, resolve_facts, stem
from startrack.files import printable
from startrack.types import BadInput, Exposure

PNG = (b"\x89PNG\r\n\x1a\n",)
TIFF = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")
JPEG = (b"\xff\xd8\xff",)
FITS = (b"SIMPLE  =", b"\x1f\x8b", b"BZh")


def read_exposure(
    path: str | os.PathLike[str],
    *,
    time_utc: datetime | None = None,
    exposure_s: float | None = None,
    camera: str | None = None,
    terrain: str | None = None,
) -> Exposure:
    """The image at `path` (PNG, TIFF, JPEG or FITS, told by content, or camera raw) with its facts.

    Pixels are the counts in the file, 16 bits kept; pixel (0, 0) is the first of the first row stored, whatever an
    orientation tag says, and in FITS too. The keyword facts, if given, go before those of sidecar and header, which
    are then not even looked at; `time_utc` is mid-exposure. What was ignored, and why, is in `warnings`.

    Raises:
        BadInput: bad_image with the file and the cause in one line; no_time for a sidecar's time that is not UTC.
    """
    try:
        raw = _read_bytes(path)
        decoded = _decode(raw, Path(path).suffix.lower() in RAW_SUFFIXES)
    except BadInput as error:
        raise BadInput(error.reason, " ".join(f"{printable(path)}: {error}".split())) from error
    given = Facts(time_utc=time_utc, exposure_s=exposure_s, camera=camera, terrain=terrain)
    facts = resolve_facts(Path(path), decoded.header, given)
    pixels, notes = _of_one_colour(decoded, facts)
    return Exposure(
        pixels_adu=pixels,
        name=stem(Path(path)),
        path=os.fspath(path),
        time_utc=facts.time_utc,
        exposure_s=facts.exposure_s,
        camera=facts.camera,
        terrain=facts.terrain,
        saturation_adu=decoded.saturation_adu,
        sha256=hashlib.sha256(raw).hexdigest(),
        warnings=decoded.warnings + notes + facts.warnings,
    )


def exposure_of(pixels: NDArray[Any], *, time_utc: datetime | None = None, name: str = "array") -> Exposure:
    """Raw counts (H, W), or colours (H, W, 3), as an exposure without other facts. Raises BadInput (bad_image).

    `sha256` is that of type, shape and values: results of equal arrays are results of the same image.
    """
    flat_grey = pixels.ndim == 2 or (pixels.ndim == 3 and pixels.shape[2] == 3)
    if not flat_grey or pixels.dtype.kind not in "uif":
        raise refuse(f"an array of {pixels.dtype} {pixels.shape}; startrack takes numbers (H, W) or (H, W, 3)")
    check_size(pixels.shape[1], pixels.shape[0])
    grey, notes = grey_float32(pixels)
    return Exposure(
        pixels_adu=grey,
        name=name,
        time_utc=time_utc,
        saturation_adu=largest_value(pixels.dtype),
        sha256=hashlib.sha256(f"{pixels.dtype.str} {pixels.shape}".encode() + pixels.tobytes()).hexdigest(),
        warnings=notes,
    )


def _of_one_colour(decoded: Decoded, facts: Facts) -> tuple[NDArray[np.float32], tuple[str, ...]]:
    """The pixels with a mosaic's colours evened out, and a warning that they were."""
    colour_already = decoded.mosaic is None and COLOUR_WARNING in decoded.warnings
    if colour_already or not (decoded.mosaic or facts.bayer_pattern):
        return decoded.pixels_adu, ()
    from startrack.exposure.mosaic import MOSAIC_WARNING, evened

    return evened(decoded.pixels_adu, decoded.saturation_adu), (MOSAIC_WARNING,)


def _read_bytes(path: str | os.PathLike[str]) -> bytes:
    try:
        status = os.stat(path)
        if stat.S_ISDIR(status.st_mode):
            raise refuse("is a folder, not an image")
        if not stat.S_ISREG(status.st_mode):  # a pipe would block, a device never end
            raise refuse("is not a regular file")
        if status.st_size == 0:
            raise refuse("is empty")
        if status.st_size > MAX_FILE_BYTES:
            raise refuse(f"is {status.st_size / 1e9:.1f} GB, more than any image startrack reads")
        return Path(path).read_bytes()
    except OSError as error:
        raise refuse(f"cannot be opened ({error.strerror or error})") from error
    except ValueError as error:  # a NUL in the name
        raise refuse(f"cannot be opened ({error})") from error


def _decode(raw: bytes, of_camera: bool) -> Decoded:
    """Camera raw files are told by their suffix: within they are TIFFs, with a thumbnail where the picture should be.

    Only `BadInput` leaves: a decoder fed with damaged bytes raises whatever it pleases."""
    kind, decode = "image", _unknown
    try:
        if of_camera:
            from startrack.exposure.raw import decode_camera_raw

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
        with warnings.catch_warnings():  # what matters of them is a refusal, or in `Exposure.warnings`
            warnings.simplefilter("ignore")
            return decode(raw)
    except BadInput:
        raise
    except Exception as error:
        raise refuse(f"truncated or damaged {kind} ({type(error).__name__}: {str(error)[:200]})") from error


def _unknown(raw: bytes) -> Decoded:
    raise refuse("is not a PNG, TIFF, JPEG or FITS file, nor named as a camera raw file")
