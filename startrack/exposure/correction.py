"""Masks of the pixels that count, and counts without the sensor's own charge, at one sensitivity.

    corrected = (recorded - dark) / flat + black        black: median of the dark; flat: 1 at its median

The black level stays, so that bias and noise of the camera file hold. Source: Howell 2006, Handbook of CCD Astronomy,
section 4.5.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache, partial
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from startrack.core.files import FilePath, printable
from startrack.core.types import Array, BadInput, Bools, Correction, Mask
from startrack.exposure.decoding import Stamp, bad_image, decode_file, read_stamped
from startrack.exposure.facts import header_number
from startrack.exposure.mosaic import PHASES

SKY_FROM = 128  # half of the range: darker pixels of a mask's file do not count
LARGEST_VALUE = 2.0 * SKY_FROM - 1.0  # of an 8-bit file
MIN_SENSITIVITY_1 = 0.05  # of the median: darker pixels of a flat field do not count
LIT_PERCENTILE = 99.0  # of a flat field: pixels above MIN_SENSITIVITY_1 of this are in the image circle
SATURATED_1 = 0.98  # of the largest value: a dark frame is saturated there
LONGEST_OTHER_1 = 1.1  # ratio of the exposure times of dark frame and image above which a warning is given
KEPT_FILES = 2  # of each kind: masks of camera and image; a night has one dark frame and flat field, seldom two
FLAT_ALONE = "flat field without a dark frame: the black level is divided too, unless the camera file has its bias_adu"
Picture = NDArray[np.float32]


def mask_of(masked: ArrayLike) -> Mask | None:
    """The mask of the pixels (H, W) that are `masked`; None where no pixel is."""
    whole = np.asarray(masked, dtype=np.bool_)
    if not whole.any():
        return None
    return Mask(
        masked=whole, sha256=hashlib.sha256(f"{whole.shape}".encode() + np.packbits(whole).tobytes()).hexdigest()
    )


def read_mask(path: FilePath, reason: str = "bad_image") -> Mask:
    """The mask in the 8-bit image at `path`. Raises BadInput `reason` if it is none, or if no pixel of it counts."""
    return read_stamped(path, _read_mask, "mask", reason)


@lru_cache(maxsize=KEPT_FILES)
def _read_mask(path: str, stamp: Stamp) -> Mask:
    """The mask at `path`, read once as long as the file keeps its `stamp`."""
    raw, decoded = decode_file(path)
    if decoded.saturation_adu != LARGEST_VALUE:
        raise bad_image(f"{printable(path)}: is not an 8-bit image")
    masked = decoded.pixels_adu < SKY_FROM
    if masked.all():
        cause = f"all pixels are below {SKY_FROM}, so none would count: 255 is sky, 0 masked"
        raise bad_image(f"{printable(path)}: {cause}")
    return Mask(masked=masked, sha256=hashlib.sha256(raw).hexdigest())


def combine_masks(
    of_image: str | Mask | None, of_camera: str | Mask | None, size_px: tuple[int, int],
    of_correction: Correction | None = None,
) -> Mask | None:  # fmt: skip
    """The pixels that the mask `of_image` or the mask `of_camera` hides, in an image of `size_px` (W, H); None: none.

    Pixels that a dark frame or flat field cannot correct (`of_correction`) do not count either, and are in no hash.
    A mask is its file's path, or the mask itself. Raises BadInput: bad_image and bad_calibration where a file is no
    mask, size_mismatch where it has another size than the image.
    """
    not_corrected = None if of_correction is None else of_correction.mask
    given = ((of_camera, "bad_calibration"), (of_image, "bad_image"), (not_corrected, "bad_image"))
    masks = [one if isinstance(one, Mask) else read_mask(one, reason) for one, reason in given if one is not None]
    for mask in masks:
        require_size("mask", mask.masked.shape, size_px)
    if len(masks) < 2:
        return masks[0] if masks else None
    masked = np.logical_or.reduce([mask.masked for mask in masks])
    return Mask(masked=masked, sha256="+".join(mask.sha256 for mask in masks if mask.sha256))


def require_size(kind: str, shape: tuple[int, ...], size_px: tuple[int, int]) -> None:
    """Raise BadInput size_mismatch unless an array of a `shape` (H, W) has the size (W, H) of the image."""
    height, width = shape
    if (width, height) != size_px:
        raise BadInput("size_mismatch", f"the {kind} is {width} x {height} px, the image {size_px[0]} x {size_px[1]}")


def touch_masked(masked: Bools, xy_px: Array, radius_px: int) -> Bools:
    """Whether a square of half width `radius_px` about each position `xy_px` (n, 2) holds a `masked` pixel (H, W)."""
    import cv2

    side = 2 * radius_px + 1
    around = cv2.dilate(masked.view(np.uint8), np.ones((side, side), np.uint8))
    height, width = masked.shape
    column, row = np.rint(np.clip(xy_px, 0, [width - 1, height - 1])).astype(np.int64).T
    return np.asarray(around[row, column] > 0)


@dataclass(frozen=True, eq=False)
class CalibrationFrame:
    """A dark frame, as its excess over its median, or a flat field, as sensitivity."""

    values: Picture  # (H, W) [ADU], or 1 at the median
    unusable: Bools | None  # (H, W): values are 0, or 1 of a flat; None where every pixel is usable
    median_adu: float
    sha256: str
    exposure_s: float | None  # by its header


def correct_counts(
    recorded_adu: Picture, saturation_adu: float | None, dark: FilePath | None,
    flat: FilePath | None, *, mosaic: bool = False,
) -> tuple[Picture, Correction]:  # fmt: skip
    """The corrected counts (H, W) [ADU], not clipped, and the correction; of `dark` and `flat` one may be None.

    Each colour of a `mosaic` has its own median of the flat. Pixels at `saturation_adu` stay at least there.
    Raises BadInput: bad_image where a file is no dark frame or flat field, size_mismatch where it has another size.
    """
    pixels, masked = np.array(recorded_adu), np.zeros(recorded_adu.shape, dtype=np.bool_)
    size_px = (pixels.shape[1], pixels.shape[0])
    dark_frame = None if dark is None else read_dark(dark)
    flat_frame = None if flat is None else read_flat(flat, mosaic=mosaic)
    if dark_frame is not None:
        require_size("dark frame", dark_frame.values.shape, size_px)
        pixels -= dark_frame.values
        if dark_frame.unusable is not None:
            masked |= dark_frame.unusable
    if flat_frame is not None:
        require_size("flat field", flat_frame.values.shape, size_px)
        black = np.float32(0.0 if dark_frame is None else dark_frame.median_adu)
        pixels -= black
        pixels /= flat_frame.values
        pixels += black
        if flat_frame.unusable is not None:
            masked |= flat_frame.unusable
    if saturation_adu is not None:
        np.maximum(pixels, np.float32(saturation_adu), out=pixels, where=recorded_adu >= saturation_adu)
    return pixels, Correction(
        recorded_adu=recorded_adu,
        mask=Mask(masked=masked, sha256="") if masked.any() else None,
        sensitivity_1=None if flat_frame is None else flat_frame.values,
        scales_black=dark_frame is None,
        dark_sha256=None if dark_frame is None else dark_frame.sha256,
        flat_sha256=None if flat_frame is None else flat_frame.sha256,
    )


def correction_warnings(dark: FilePath | None, flat: FilePath | None, exposure_s: float | None) -> tuple[str, ...]:
    """Warnings about a flat field alone, and a dark frame of another exposure time than `exposure_s` of the image."""
    if dark is None:
        return () if flat is None else (FLAT_ALONE,)
    stated = read_dark(dark).exposure_s
    if stated is None or exposure_s is None or max(stated, exposure_s) < LONGEST_OTHER_1 * min(stated, exposure_s):
        return ()
    return (f"the dark frame was exposed for {stated:g} s, the image for {exposure_s:g} s",)


def read_dark(path: FilePath) -> CalibrationFrame:
    """The dark frame in the image at `path`. Raises BadInput bad_image if it cannot be read, or is saturated."""
    return read_stamped(path, _read_dark, "dark frame")


def read_flat(path: FilePath, *, mosaic: bool = False) -> CalibrationFrame:
    """The flat field in the image at `path`, of a `mosaic` with a median for each colour.

    Raises BadInput bad_image if it cannot be read, or is dark.
    """
    return read_stamped(path, partial(_read_flat, mosaic), "flat field")


@lru_cache(maxsize=KEPT_FILES)
def _read_dark(path: str, stamp: Stamp) -> CalibrationFrame:
    """The dark frame at `path`, read once as long as the file keeps its `stamp`."""
    raw, decoded = decode_file(path)
    median = float(np.median(decoded.pixels_adu))
    excess = decoded.pixels_adu - np.float32(median)
    top = np.inf if decoded.saturation_adu is None else SATURATED_1 * decoded.saturation_adu
    return _frame(path, raw, excess, decoded.pixels_adu >= top, median, decoded.header, fill=0.0, cause="is saturated")


@lru_cache(maxsize=2 * KEPT_FILES)
def _read_flat(mosaic: bool, path: str, stamp: Stamp) -> CalibrationFrame:
    """The flat field at `path`, each colour of a mosaic 1 at its own median; read once while the `stamp` stays."""
    raw, decoded = decode_file(path)
    sensitivity = np.array(decoded.pixels_adu)
    parts = [sensitivity[i::2, j::2] for i, j in PHASES] if mosaic else [sensitivity]
    levels = [_lit_level(part, path) for part in parts]
    for part, level in zip(parts, levels, strict=True):
        part /= np.float32(level)
    dark, level = sensitivity < MIN_SENSITIVITY_1, float(np.mean(levels))
    return _frame(path, raw, sensitivity, dark, level, decoded.header, fill=1.0, cause="is dark")


def _lit_level(pixels_adu: Picture, path: str) -> float:
    """Median of the pixels within the image circle. Raises BadInput bad_image where no pixel is lit."""
    limit = MIN_SENSITIVITY_1 * float(np.percentile(pixels_adu, LIT_PERCENTILE))
    if limit <= 0:
        raise BadInput("bad_image", f"{printable(path)}: is dark, so it shows no sensitivities")
    return float(np.median(pixels_adu[pixels_adu > limit]))


def _frame(
    path: str, raw: bytes, values: Picture, unusable: Bools, median: float, header: Mapping[str, Any], *,
    fill: float, cause: str,
) -> CalibrationFrame:  # fmt: skip
    """The frame whose unusable pixels hold `fill`. Raises BadInput bad_image with `cause` where all are unusable."""
    if unusable.all():
        raise BadInput("bad_image", f"{printable(path)}: every pixel {cause}")
    values[unusable] = fill
    values.flags.writeable = False
    sha256, exposure_s = hashlib.sha256(raw).hexdigest(), header_number(header, "exposure_s", [])
    return CalibrationFrame(values, unusable if unusable.any() else None, median, sha256, exposure_s)
