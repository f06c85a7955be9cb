"""Picture data of a PNG: inflated by ISA-L, which takes half of zlib's time, and the rows' filters undone, compiled."""

from __future__ import annotations

# mypy: disable-error-code="no-untyped-def"
import numpy as np
from isal import isal_zlib
from numba import njit
from numpy.typing import NDArray

from startrack.exposure.decoded import bad_image

DAMAGED = "damaged PNG: its picture data cannot be decoded"


def decode_rows(compressed: bytes, width: int, height: int, depth: int, channels: int) -> NDArray[np.unsignedinteger]:
    """Samples (H, W) or (H, W, channels) of 8 or 16 bits from the `compressed` data of a PNG that is not interlaced.

    Raises BadInput bad_image where the data are damaged, too short or too long.
    """
    sample_bytes = depth // 8
    row_bytes = width * channels * sample_bytes
    size = height * (row_bytes + 1)
    stream = isal_zlib.decompressobj()
    try:
        data = stream.decompress(compressed, size + 1)
    except isal_zlib.error as cause:  # type: ignore[misc]
        raise bad_image(DAMAGED) from cause
    if len(data) != size or not stream.eof:
        raise bad_image(DAMAGED)
    samples = np.empty((height, width * channels), dtype=np.uint8 if depth == 8 else np.uint16)
    rows = np.frombuffer(data, np.uint8).reshape(height, row_bytes + 1)
    if not unfilter(rows, channels * sample_bytes, sample_bytes, samples):
        raise bad_image(DAMAGED)
    return samples.reshape((height, width, channels) if channels > 1 else (height, width))


@njit(cache=True, nogil=True)
def unfilter(rows, pixel_bytes, sample_bytes, samples):
    """Undo the filters of the `rows` (H, 1 + bytes) and write the samples (H, n); False where a filter is unknown.

    The filters are none, the byte to the left, above, their mean, and Paeth's predictor (W3C PNG, section 9).
    """
    height, length = rows.shape[0], rows.shape[1] - 1
    before, row = np.zeros(length + pixel_bytes, np.uint8), np.zeros(length + pixel_bytes, np.uint8)
    known = True
    for y in range(height):
        kind = rows[y, 0]
        known = known and kind <= 4
        if kind == 3 and pixel_bytes == 2:  # of 16-bit grey pictures with noise: two chains of bytes in registers
            high, low = np.int64(0), np.int64(0)
            for x in range(0, length, 2):
                high = (np.int64(rows[y, x + 1]) + ((high + np.int64(before[x + 2])) >> 1)) & 255
                low = (np.int64(rows[y, x + 2]) + ((low + np.int64(before[x + 3])) >> 1)) & 255
                row[x + 2], row[x + 3] = high, low
        else:
            for x in range(length):
                left, above = np.int64(row[x]), np.int64(before[x + pixel_bytes])
                guess = np.int64(0)
                if kind == 1:
                    guess = left
                elif kind == 2:
                    guess = above
                elif kind == 3:
                    guess = (left + above) >> 1
                elif kind == 4:
                    corner = np.int64(before[x])
                    to_left, to_above = abs(above - corner), abs(left - corner)
                    to_corner = abs(left + above - 2 * corner)
                    if to_left <= to_above and to_left <= to_corner:
                        guess = left
                    else:
                        guess = above if to_above <= to_corner else corner
                row[x + pixel_bytes] = np.uint8(np.int64(rows[y, x + 1]) + guess)
        if sample_bytes == 1:
            for x in range(samples.shape[1]):
                samples[y, x] = row[x + pixel_bytes]
        else:
            for x in range(samples.shape[1]):
                samples[y, x] = (np.int64(row[2 * x + pixel_bytes]) << 8) + np.int64(row[2 * x + 1 + pixel_bytes])
        row, before = before, row
    return known
