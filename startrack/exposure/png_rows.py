"""Picture data of a PNG: inflated by ISA-L, which takes half of zlib's time, and the rows' filters undone, compiled."""

from __future__ import annotations

from typing import Any

import numpy as np
from isal import isal_zlib
from numpy.typing import NDArray

from startrack.exposure.decoding import bad_image
from startrack.kernels.library import kernel

DAMAGED = "damaged PNG: its picture data cannot be decoded"


def decode_rows(
    compressed: bytes, width: int, height: int, depth: int, channels: int
) -> NDArray[np.unsignedinteger] | NDArray[np.float32]:
    """Samples from the `compressed` data of a PNG of 8 or 16 bits that is not interlaced.

    Grey ones (H, W) as float32, which holds them exactly; colours (H, W, channels) as they are stored. Raises BadInput
    bad_image where the data are damaged, too short or too long.
    """
    sample_bytes = depth // 8
    row_bytes = width * channels * sample_bytes
    data = inflate_rows(compressed, height * (row_bytes + 1))
    dtype = np.float32 if channels == 1 else np.uint8 if depth == 8 else np.uint16
    samples = np.empty((height, width * channels), dtype=dtype)
    rows = np.frombuffer(data, np.uint8).reshape(height, row_bytes + 1)
    if not unfilter(rows, channels * sample_bytes, sample_bytes, samples):
        raise bad_image(DAMAGED)
    return samples if channels == 1 else samples.reshape(height, width, channels)


def inflate_rows(compressed: bytes, size: int) -> bytes:
    """The `size` bytes of filtered rows. Raises BadInput bad_image where the data are damaged, too short or too long.

    No more than these bytes is inflated.
    """
    stream = isal_zlib.decompressobj()
    try:
        data: bytes = stream.decompress(compressed, size + 1)
    except isal_zlib.error as cause:  # type: ignore[misc]
        raise bad_image(DAMAGED) from cause
    if len(data) != size or not stream.eof:
        raise bad_image(DAMAGED)
    return data


def unfilter(rows: NDArray[np.uint8], pixel_bytes: int, sample_bytes: int, samples: NDArray[Any]) -> bool:
    """Undo the filters of the `rows` (H, 1 + bytes) and write the samples (H, n); False where a filter is unknown.

    The filters are none, the byte to the left, above, their mean, and Paeth's predictor (W3C PNG, section 9).
    """
    scratch = np.zeros((2, rows.shape[1] - 1 + pixel_bytes), np.uint8)  # two rows, and zeros to their left
    return bool(UNFILTER[samples.dtype.name, sample_bytes](rows, pixel_bytes, scratch, samples))


UNFILTER = {  # by the type of the samples, and their bytes in the file
    (dtype, sample_bytes): kernel(
        f"unfilter_{colours}_{8 * sample_bytes}", "rows: uint8[height, length + 1]", "pixel_bytes: int64",
        "scratch: out uint8[2, room]", f"samples: out {dtype}[height, samples]", result="bool",
    )
    for colours, dtype, sample_bytes in (
        ("grey", "float32", 1), ("grey", "float32", 2), ("colour", "uint8", 1), ("colour", "uint16", 2)
    )
}  # fmt: skip
