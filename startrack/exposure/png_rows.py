"""Filters of the rows of a PNG undone, compiled: half of the time that OpenCV takes with inflating them again."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from startrack.kernels.library import kernel


def undo_filters(data: bytes, height: int, channels: int, sample_bytes: int) -> NDArray[Any] | None:
    """Samples of `height` filtered rows of bytes, each after the number of its filter; None where one is unknown.

    Grey ones (H, W) as float32, which holds them exactly; colours (H, W, channels) as they are stored. The filters are
    none, the byte to the left, above, their mean, and Paeth's predictor (W3C PNG, section 9).
    """
    rows = np.frombuffer(data, np.uint8).reshape(height, -1)
    row_bytes, pixel_bytes = rows.shape[1] - 1, channels * sample_bytes
    dtype = np.float32 if channels == 1 else np.uint8 if sample_bytes == 1 else np.uint16
    samples = np.empty((height, row_bytes // sample_bytes), dtype)
    scratch = np.zeros((2, row_bytes + pixel_bytes), np.uint8)  # two rows, and zeros to their left
    if not UNFILTER[samples.dtype.name, sample_bytes](rows, pixel_bytes, scratch, samples):
        return None
    return samples if channels == 1 else samples.reshape(height, -1, channels)


UNFILTER = {  # by the type of the samples, and their bytes in the file
    (dtype, sample_bytes): kernel(
        f"unfilter_{colours}_{8 * sample_bytes}", "rows: uint8[height, length + 1]", "pixel_bytes: int64",
        "scratch: out uint8[2, room]", f"samples: out {dtype}[height, samples]", result="bool",
    )
    for colours, dtype, sample_bytes in (
        ("grey", "float32", 1), ("grey", "float32", 2), ("colour", "uint8", 1), ("colour", "uint16", 2)
    )
}  # fmt: skip
