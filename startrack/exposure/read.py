"""From a file to an `Exposure`: open, find the type from its first bytes, decode strictly, find the metadata."""

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
    bad_image,
    check_size,
    grey_float32,
    largest_value,
)
from startrack.exposure.metadata import RAW_SUFFIXES, Facts, resolve_facts, stem
from startrack.files import printable
from startrack.types import TIME_SIGMA_S, BadInput, Exposure

PNG = (b"\x89PNG\r\n\x1a\n",)
TIFF = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")
JPEG = (b"\xff\xd8\xff",)
FITS = (b"SIMPLE  =", b"\x1f\x8b", b"BZh")


def read_exposure(
    path: str | os.PathLike[str],
    *,
    time_utc: datetime | None = None,
    time_sigma_s: float | None = None,
    exposure_s: float | None = None,
    camera: str | None = None,
    terrain: str | None = None,
) -> Exposure:
    """The image at `path` (PNG, TIFF, JPEG or FITS by its content, or camera raw by its suffix) with its metadata.

    Pixels (H, W) are the counts in the file [ADU], 16 bits kept; pixel (0, 0) is the first of the first row stored,
    in FITS too; orientation tags are ignored. `time_utc` (mid-exposure), `time_sigma_s` (of the clock), `exposure_s`,
    `camera` and `terrain` replace the values of sidecar and header, which are then not read. `warnings` lists ignored
    facts and causes.

    Raises:
        BadInput: bad_image with file and cause in one line; no_time if a sidecar's time is not UTC.
        ValueError: `time_sigma_s` is no usable number of seconds.
    """
    given = Facts(time_utc=time_utc, time_sigma_s=time_sigma_s, exposure_s=exposure_s, camera=camera, terrain=terrain)
    try:
        raw = _read_bytes(path)
        decoded = _decode(raw, Path(path).suffix.lower() in RAW_SUFFIXES)
    except BadInput as error:
        raise BadInput(error.reason, " ".join(f"{printable(path)}: {error}".split())) from error
    facts = resolve_facts(Path(path), decoded.header, given)
    pixels, notes = _level_mosaic(decoded, facts)
    return Exposure(
        pixels_adu=pixels,
        name=stem(Path(path)),
        path=os.fspath(path),
        time_utc=facts.time_utc,
        time_sigma_s=TIME_SIGMA_S if facts.time_sigma_s is None else facts.time_sigma_s,
        exposure_s=facts.exposure_s,
        camera=facts.camera,
        terrain=facts.terrain,
        saturation_adu=decoded.saturation_adu,
        sha256=hashlib.sha256(raw).hexdigest(),
        warnings=decoded.warnings + notes + facts.warnings,
    )


def exposure_of(pixels: NDArray[Any], *, time_utc: datetime | None = None, name: str = "array") -> Exposure:
    """The counts `pixels` (H, W) [ADU], or colours (H, W, 3), as an exposure with `time_utc` and `name` alone.

    `sha256` is that of type, shape and values. Raises BadInput bad_image.
    """
    flat_grey = pixels.ndim == 2 or (pixels.ndim == 3 and pixels.shape[2] == 3)
    if not flat_grey or pixels.dtype.kind not in "uif":
        raise bad_image(f"an array of {pixels.dtype} {pixels.shape}; startrack takes numbers (H, W) or (H, W, 3)")
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


def _level_mosaic(decoded: Decoded, facts: Facts) -> tuple[NDArray[np.float32], tuple[str, ...]]:
    """The pixels (a mosaic's at one level and gain), and a warning if they were changed."""
    colour_already = decoded.mosaic is None and COLOUR_WARNING in decoded.warnings
    if colour_already or not (decoded.mosaic or facts.bayer_pattern):
        return decoded.pixels_adu, ()
    from startrack.exposure.mosaic import MOSAIC_WARNING, equalize_mosaic

    return equalize_mosaic(decoded.pixels_adu, decoded.saturation_adu), (MOSAIC_WARNING,)


def _read_bytes(path: str | os.PathLike[str]) -> bytes:
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


def _decode(raw: bytes, camera_raw: bool) -> Decoded:
    """The decoded file. Camera raw files are known by their suffix: they are TIFFs with a thumbnail as their picture.

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
