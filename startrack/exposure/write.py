"""Writer of an `Exposure` to a file: PNG, TIFF or FITS with its metadata, written atomically; and sidecars."""

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
from startrack.exposure.facts import ELSEWHERE, HEADER_OF, Facts
from startrack.exposure.sidecar import IMAGE_KEYS, NAMED_FILES, SIDECAR, sidecars
from startrack.frames import format_utc

PACKED = {".gz": lambda data: gzip.compress(data, compresslevel=1, mtime=0), ".bz2": bz2.compress}


def write_exposure(path: str | os.PathLike[str], exposure: Exposure, *, overwrite: bool = False) -> Path:
    """Write the image by suffix (.png, .tif, .tiff, .fits, .fits.gz, .fits.bz2) with its metadata; return its path.

    PNG holds 16-bit counts (8-bit ones if the exposure was read from such a file), rounded; TIFF and FITS too, or
    float32 if the pixels are not such counts. Camera and terrain paths are written relative to the file; those beside
    or below it alone, as no others are read from a header (`write_sidecar` writes all). The same exposure gives the
    same bytes.

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
    text = json.dumps(_stated_facts(facts, target.parent), ensure_ascii=False, allow_nan=False)
    write_atomically(target, text.encode("utf-8") + b"\n", overwrite=overwrite)
    return target


def header_entries(exposure: Exposure, folder: Path) -> dict[str, str | float]:
    """The known metadata under the names of a FITS header, with both dates; paths relative to `folder`."""
    stated = _stated_facts(exposure, folder)
    entries: dict[str, str | float] = {}
    if exposure.time_utc is not None:
        entries["TIMESYS"] = "UTC"
        if exposure.exposure_s is not None:
            entries["DATE-OBS"] = format_utc(exposure.time_utc - timedelta(seconds=exposure.exposure_s / 2))
    for key, name in HEADER_OF.items():
        if key in stated and not (key in NAMED_FILES and ELSEWHERE.search(stated[key])):
            entries[name] = stated[key] if isinstance(stated[key], str) else float(stated[key])
    dates = {name: str(entries[name]).removesuffix("Z") for name in ("DATE-OBS", "DATE-AVG") if name in entries}
    return entries | dates  # FITS has no zone letter


def _stated_facts(facts: Facts | Exposure, folder: Path) -> dict[str, Any]:
    """The known facts by the sidecar's keys, as they are written; paths relative to `folder`."""
    stated: dict[str, Any] = {}
    for key in SIDECAR.keys:
        value = getattr(facts, key, None)
        if key == "time_utc" and value is not None:
            value = format_utc(value)
        elif key == "time_sigma_s" and (facts.time_utc is None or not getattr(facts, "time_sigma_is_stated", True)):
            value = None
        elif key in NAMED_FILES:
            value = _relative_path(value, folder)
        elif key in IMAGE_KEYS:
            value = relative_path(value, folder) if isinstance(value, str) else None
        if value is not None:
            stated[key] = value
    return stated


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
