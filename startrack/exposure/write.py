"""From an `Exposure` to a file: PNG, TIFF or FITS with its metadata, written atomically; and sidecars."""

from __future__ import annotations

import bz2
import gzip
import json
import os
from collections.abc import Callable
from datetime import timedelta
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from startrack.core.files import check_free, is_path, printable, relative_path, write_atomically
from startrack.core.types import BadInput, Exposure
from startrack.exposure.metadata import Facts
from startrack.exposure.sidecar import sidecars
from startrack.frames import format_utc

PACKED = {".gz": lambda data: gzip.compress(data, compresslevel=1, mtime=0), ".bz2": bz2.compress}


def write_exposure(path: str | os.PathLike[str], exposure: Exposure, *, overwrite: bool = False) -> Path:
    """Write the image by suffix (.png, .tif, .tiff, .fits, .fits.gz, .fits.bz2) with its metadata; return its path.

    PNG holds 16-bit counts (8-bit ones if the exposure was read from such a file), rounded; TIFF and FITS too, or
    float32 if the pixels are not such counts. Camera and terrain paths are written relative to the file. The same
    exposure gives the same bytes.

    Raises:
        BadInput: bad_image if the file exists and not `overwrite`, the suffix is not known, the pixels do not fit the
            type, or the file cannot be written.
    """
    target = Path(path)
    packing = target.suffix.lower() if target.suffix.lower() in PACKED else ""
    suffix = Path(target.stem).suffix.lower() if packing else target.suffix.lower()
    encoder = _ENCODERS.get(suffix)
    if encoder is None or (packing and suffix not in FITS_SUFFIXES):
        raise BadInput("bad_image", f"{printable(target)}: startrack writes .png, .tif, .fits, .fits.gz and .fits.bz2")
    check_free(target, overwrite=overwrite)
    try:
        data = encoder(exposure.pixels_adu, exposure.saturation_adu, header_entries(exposure, target.parent))
    except ValueError as error:
        raise BadInput("bad_image", f"{printable(target)}: {error}") from error
    write_atomically(target, PACKED[packing](data) if packing else data, overwrite=overwrite)
    return target


def write_sidecar(image: str | os.PathLike[str], facts: Facts | Exposure, *, overwrite: bool = False) -> Path:
    """Write the known metadata `facts` to NAME.json beside the image NAME.png, and return the sidecar's path.

    Raises BadInput bad_image if the file exists and not `overwrite`, or if it cannot be written.
    """
    target = sidecars(Path(image))[-1]
    values = {
        "time_utc": None if facts.time_utc is None else format_utc(facts.time_utc),
        "time_sigma_s": None if facts.time_utc is None else _stated_time_sigma_s(facts),
        "exposure_s": facts.exposure_s,
        "camera": _relative_path(facts.camera, target.parent),
        "terrain": _relative_path(facts.terrain, target.parent),
        "mask": relative_path(facts.mask, target.parent) if isinstance(facts.mask, str) else None,
        **{key: relative_path(path, target.parent) for key in ("dark", "flat") if (path := getattr(facts, key, None))},
        "bayer_pattern": facts.bayer_pattern if isinstance(facts, Facts) else None,
    }
    text = json.dumps({k: v for k, v in values.items() if v is not None}, ensure_ascii=False, allow_nan=False)
    write_atomically(target, text.encode("utf-8") + b"\n", overwrite=overwrite)
    return target


def header_entries(exposure: Exposure, folder: Path) -> dict[str, str | float]:
    """The known metadata under the names of a FITS header, with both dates; paths relative to `folder`."""
    entries: dict[str, str | float] = {}
    if exposure.time_utc is not None:
        entries["TIMESYS"] = "UTC"
        if exposure.exposure_s is not None:
            start = exposure.time_utc - timedelta(seconds=exposure.exposure_s / 2)
            entries["DATE-OBS"] = format_utc(start).removesuffix("Z")  # FITS has no zone letter
        entries["DATE-AVG"] = format_utc(exposure.time_utc).removesuffix("Z")
        if exposure.time_sigma_is_stated:
            entries["STTSIG"] = float(exposure.time_sigma_s)
    if exposure.exposure_s is not None:
        entries["EXPTIME"] = float(exposure.exposure_s)
    for key, reference in (("STCAMERA", exposure.camera), ("STTERRAI", exposure.terrain)):
        relative = _relative_path(reference, folder)
        if relative is not None:
            entries[key] = relative
    return entries


def _stated_time_sigma_s(facts: Facts | Exposure) -> float | None:
    """The sigma of the clock that somebody states; None of an exposure with the default."""
    return facts.time_sigma_s if isinstance(facts, Facts) or facts.time_sigma_is_stated else None


def _relative_path(reference: str | None, folder: Path) -> str | None:
    """A path as seen from `folder`, with forward slashes; a shipped name as it is."""
    if reference is None or not is_path(reference):
        return reference
    relative = relative_path(reference, folder)
    return relative if is_path(relative) else f"./{relative}"


def _counts(pixels: NDArray[np.float32], saturation_adu: float | None) -> NDArray[Any]:
    """The pixels rounded to the integers a file holds; ValueError if they do not fit."""
    if not np.isfinite(pixels).all():
        raise ValueError("pixels that are NaN or infinite cannot be written")
    lowest, highest = float(pixels.min()), float(pixels.max())
    if lowest < -0.5 or highest >= 65535.5:
        raise ValueError(f"values from {lowest:g} to {highest:g} do not fit 16 bits; write TIFF or FITS")
    eight = saturation_adu == 255 and highest < 255.5
    return np.rint(pixels).astype(np.uint8 if eight else np.uint16)


def _counts_or_float(pixels: NDArray[np.float32], saturation_adu: float | None) -> NDArray[Any]:
    fit = saturation_adu is not None and pixels.min() >= 0 and pixels.max() <= 65535
    return _counts(pixels, saturation_adu) if fit and np.array_equal(pixels, np.rint(pixels)) else pixels


def _png(pixels: NDArray[np.float32], saturation_adu: float | None, entries: dict[str, str | float]) -> bytes:
    import cv2

    from startrack.exposure.png import add_text

    # Noise does not compress beyond its entropy: run lengths and Huffman coding take half the time of a search for
    # matches, and the file is no larger.
    fast = [cv2.IMWRITE_PNG_COMPRESSION, 1, cv2.IMWRITE_PNG_STRATEGY, cv2.IMWRITE_PNG_STRATEGY_RLE]
    done, data = cv2.imencode(".png", _counts(pixels, saturation_adu), fast)
    if not done:
        raise ValueError("OpenCV cannot encode this image as PNG")
    return add_text(data.tobytes(), {key: str(value) for key, value in entries.items()})


def _tiff(pixels: NDArray[np.float32], saturation_adu: float | None, entries: dict[str, str | float]) -> bytes:
    import tifffile

    file = BytesIO()
    stored = _counts_or_float(pixels, saturation_adu)
    tifffile.imwrite(file, stored, photometric="minisblack", description=json.dumps(entries), metadata=None)
    return file.getvalue()


def _fits(pixels: NDArray[np.float32], saturation_adu: float | None, entries: dict[str, str | float]) -> bytes:
    from astropy.io import fits

    unit = fits.PrimaryHDU(_counts_or_float(pixels, saturation_adu))
    for key, value in entries.items():
        unit.header[key] = (value, _COMMENTS.get(key))
    unit.add_datasum(when="")  # the default comment holds today's date, and equal input must give equal bytes
    unit.add_checksum(when="", override_datasum=True)
    file = BytesIO()
    unit.writeto(file)
    return file.getvalue()


_COMMENTS = {  # none beside a path, which may need the whole card
    "TIMESYS": "time scale of the dates",
    "DATE-OBS": "start of exposure",
    "DATE-AVG": "middle of exposure",
    "STTSIG": "[s] standard deviation of the clock's error",
    "EXPTIME": "[s] exposure",
}
FITS_SUFFIXES = {".fits", ".fit", ".fts"}
_Encoder = Callable[[NDArray[np.float32], float | None, dict[str, str | float]], bytes]
_ENCODERS: dict[str, _Encoder] = {".png": _png, ".tif": _tiff, ".tiff": _tiff, **dict.fromkeys(FITS_SUFFIXES, _fits)}
