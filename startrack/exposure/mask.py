"""Masks: which pixels of an image do not count, by the camera's mask and the image's own."""

from __future__ import annotations

import hashlib
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike

from startrack.core.files import FilePath, printable
from startrack.core.types import Array, BadInput, Bools, Correction, Mask
from startrack.exposure.decode_file import Stamp, decode_file, read_stamped
from startrack.exposure.decoded import bad_image

SKY_FROM = 128  # of 255: darker pixels of a mask's file do not count
LARGEST_VALUE = 255.0  # of an 8-bit file
KEPT_MASKS = 2  # the camera's and the image's


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


@lru_cache(maxsize=KEPT_MASKS)
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
