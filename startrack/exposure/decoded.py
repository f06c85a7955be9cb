"""The value that every decoder returns, and the checks that decoders share."""

from __future__ import annotations

import struct
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from startrack.core.types import MAX_PIXELS, BadInput

MAX_FILE_BYTES = 8 * MAX_PIXELS + 2**24  # the largest image at the widest pixel type, and its headers
EXACT_IN_FLOAT32 = 2**24
UPRIGHT = 1  # EXIF and TIFF orientation of an image stored as seen
FRACTIONS_WARNING = (
    "floating-point pixels from 0 to 1 are no sensor's counts: gain, noise and saturation are not known; give the "
    "counts themselves (integers, or floating point in ADU)"
)
COLOUR_WARNING = "colour image: the plain mean of its three channels is used"


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
    """Raise BadInput bad_image unless the image has 1 to 200 Mpx. Called with header values, before decoding."""
    if width_px < 1 or height_px < 1:
        raise bad_image(f"holds no pixels ({width_px} x {height_px})")
    if width_px * height_px > MAX_PIXELS:
        size, most = width_px * height_px / 1e6, MAX_PIXELS / 1e6
        raise bad_image(f"{width_px} x {height_px} is {size:.1f} Mpx, more than the {most:.0f} allowed")


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
    """`orientation_warnings` of what `read_exif` returns (`PIL.Image.Exif`); unreadable EXIF costs only a warning."""
    try:
        return orientation_warnings(read_exif().get(0x0112))
    except (OSError, SyntaxError, ValueError, TypeError, LookupError, struct.error) as error:
        return (f"EXIF data cannot be read ({error}); ignored",)
