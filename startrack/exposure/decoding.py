"""Decoding of a file to its pixels and header: open, find the type from its first bytes, decode strictly.

The decoders, one module each, return the value `Decoded` and share the checks here.
"""

from __future__ import annotations

import os
import stat
import struct
import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from importlib import import_module
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from startrack.core.file_kinds import FORMATS, KINDS_TEXT, RAW_SUFFIXES
from startrack.core.files import MAX_CAUSE_CHARS, FilePath, missing_text, printable
from startrack.core.limits import check_memory, memory_refusal
from startrack.core.types import MAX_PIXELS, BadInput

MAX_FILE_BYTES = 8 * MAX_PIXELS + 2**24  # the largest image at the widest pixel type, and its headers
EXACT_IN_FLOAT32 = 2 ** (np.finfo(np.float32).nmant + 1)
UPRIGHT = 1  # EXIF and TIFF orientation of an image stored as seen
FRACTIONS_WARNING = (
    "floating-point pixels from 0 to 1 are no sensor's counts: gain, noise and saturation are not known; give the "
    "counts themselves (integers, or floating point in ADU)"
)
COLOUR_WARNING = "colour image: the plain mean of its three channels is used"
Stamp = tuple[int, ...]  # of a file: inode, size, time of its last change
T = TypeVar("T")


@dataclass(frozen=True, kw_only=True)
class Decoded:
    """Pixels and raw header of one file, before its facts are resolved."""

    pixels_adu: NDArray[np.float32]  # (H, W) [ADU], all finite
    saturation_adu: float | None  # largest value the stored type can hold; None for floating point
    header: Mapping[str, Any] = field(default_factory=dict)  # keys as in a FITS header
    warnings: tuple[str, ...] = ()
    mosaic: bool | None = None  # whether the pixels are a mosaic of colours; None: unknown for this kind of file


def bad_image(cause: str) -> BadInput:
    """The exception for a file that cannot be read; `read_exposure` puts the file's name before the cause."""
    return BadInput("bad_image", cause)


def check_size(width_px: int, height_px: int) -> None:
    """Raise BadInput bad_image unless the image has 1 to 200 Mpx, out_of_memory where the memory is too small for it.

    Called with header values, before decoding.
    """
    if width_px < 1 or height_px < 1:
        raise bad_image(f"holds no pixels ({width_px} x {height_px})")
    if width_px * height_px > MAX_PIXELS:
        size, most = width_px * height_px / 1e6, MAX_PIXELS / 1e6
        raise bad_image(f"{width_px} x {height_px} is {size:.1f} Mpx, more than the {most:.0f} allowed")
    check_memory(width_px * height_px)


def grey_float32(stored: NDArray[Any]) -> tuple[NDArray[np.float32], tuple[str, ...]]:
    """Pixels (H, W) as float32 [ADU], and warnings, from (H, W) or (H, W, 3) of any integer or real type.

    8 and 16 bits stay exact. Colour becomes the mean of its channels, not rounded, and the largest value of the type
    where one of them is clipped there: such a pixel is saturated. Fractions from 0 to 1 are kept, with
    a warning, because their scale is not known. Raises BadInput bad_image for a pixel that is not finite.
    """
    warnings: list[str] = []
    with np.errstate(over="ignore"):  # values beyond float32 become infinite and are refused below
        if stored.ndim == 3:
            warnings.append(COLOUR_WARNING)
            pixels = stored[..., 0].astype(np.float32)
            for channel in (1, 2):  # sums of 16-bit values are exact in float32
                pixels += stored[..., channel]
            pixels /= np.float32(3)
            top = largest_value(stored.dtype)
            for channel in () if top is None else range(3):
                pixels[stored[..., channel] == top] = top
        else:
            pixels = np.ascontiguousarray(stored, dtype=np.float32)
    if stored.dtype.kind == "f":
        bad = pixels.size - int(np.count_nonzero(np.isfinite(pixels)))
        if bad:
            raise bad_image(
                f"{bad} of {pixels.size} pixels are NaN or infinite; fill them (by their neighbours' median, say) first"
            )
        if are_fractions(pixels):
            warnings.append(FRACTIONS_WARNING)
    elif stored.dtype.itemsize > 2 and float(np.abs(pixels).max()) > EXACT_IN_FLOAT32:
        warnings.append("values beyond 2^24 are rounded to 24 significant bits")
    return pixels, tuple(warnings)


def are_fractions(pixels_adu: NDArray[np.float32]) -> bool:
    """Whether all of `pixels_adu` (H, W) are from 0 to 1 and some above 0: a picture scaled for display, not counts."""
    return bool(0 < pixels_adu.max() <= 1 and pixels_adu.min() >= 0)


def largest_value(dtype: np.dtype[Any]) -> float | None:
    """Largest value of an integer type; None for floating point, which has no saturation of its own."""
    return float(np.iinfo(dtype).max) if dtype.kind in "ui" else None


def orientation_warnings(orientation: object) -> tuple[str, ...]:
    """A warning if the file has to be rotated for display: the calibration refers to the pixels as stored."""
    if orientation is None or orientation == UPRIGHT:
        return ()
    return (f"orientation tag {orientation} ignored: pixels are taken as the sensor stored them",)


def exif_warnings(read_exif: Callable[[], Any]) -> tuple[str, ...]:
    """Warnings of the orientation in what `read_exif` returns (`PIL.Image.Exif`); unreadable EXIF gives a warning."""
    try:
        return orientation_warnings(read_exif().get(0x0112))
    except (OSError, SyntaxError, ValueError, TypeError, LookupError, struct.error) as error:
        return (f"EXIF data cannot be read ({error}); ignored",)


def decode_file(path: FilePath) -> tuple[bytes, Decoded]:
    """The bytes of the image at `path`, and their content. Raises BadInput bad_image with file and cause."""
    try:
        raw = _read_bytes(path)
        return raw, decode_bytes(raw, camera_raw=Path(path).suffix.lower() in RAW_SUFFIXES)
    except BadInput as error:
        raise BadInput(error.reason, " ".join(f"{printable(path)}: {error}".split())) from error


def read_stamped(path: FilePath, read: Callable[[str, Stamp], T], kind: str, reason: str | None = None) -> T:
    """Result of `read` for the file at `path` and a stamp of its present state, by which it may keep results.

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
    except FileNotFoundError as error:
        raise bad_image(missing_text(path)) from error
    except (OSError, ValueError) as error:  # ValueError: a NUL in the name
        raise bad_image(f"cannot be opened ({getattr(error, 'strerror', None) or error})") from error


def decode_bytes(raw: bytes, *, camera_raw: bool = False) -> Decoded:
    """The decoded content of a file, of a camera's raw file where `camera_raw` is set.

    Camera raw files are known by their suffix: they are TIFFs with a thumbnail.

    Raises BadInput bad_image; whatever else a decoder raises for damaged bytes is turned into it. Or out_of_memory.
    """
    kind = next((kind for kind, one in FORMATS.items() if raw.startswith(one.starts)), None)
    if camera_raw:
        kind = "camera raw file"
    if kind is None:
        raise bad_image(f"is not a file of {KINDS_TEXT}, the last by its suffix")
    try:
        decoder = import_module(f"startrack.exposure.{'mosaic' if camera_raw else kind.lower()}")
        with warnings.catch_warnings():  # the decoders' checks refuse the file or fill `Exposure.warnings`
            warnings.simplefilter("ignore")
            decoded: Decoded = decoder.decode(raw)
            return decoded
    except BadInput:
        raise
    except Exception as error:
        raise memory_refusal(error) or bad_image(
            f"truncated or damaged {kind} ({type(error).__name__}: {str(error)[:MAX_CAUSE_CHARS]})"
        ) from error
