"""Picture data of a PNG: inflated by ISA-L, which takes half of zlib's time, and the rows' filters undone, compiled."""

from __future__ import annotations

# mypy: disable-error-code="no-untyped-def"
import numpy as np
from isal import isal_zlib
from numpy.typing import NDArray

from startrack.core.kernels import njit
from startrack.exposure.decoding import bad_image

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


@njit(cache=True)
def unfilter(rows, pixel_bytes, sample_bytes, samples):
    """Undo the filters of the `rows` (H, 1 + bytes) and write the samples (H, n); False where a filter is unknown.

    The filters are none, the byte to the left, above, their mean, and Paeth's predictor (W3C PNG, section 9).
    """
    height, length = rows.shape[0], rows.shape[1] - 1
    # Both rows begin with zeros for the pixel to the left of the first.
    above, row = np.zeros(length + pixel_bytes, np.uint8), np.zeros(length + pixel_bytes, np.uint8)
    known = True
    for y in range(height):
        kind = rows[y, 0]
        known = known and kind <= 4
        if kind == 3 and pixel_bytes == 2:  # of 16-bit grey pictures with noise
            _undo_mean_16(rows[y], above, row, samples[y])
        else:
            _undo(rows[y], kind, pixel_bytes, above, row)
            if sample_bytes == 1:
                for x in range(samples.shape[1]):
                    samples[y, x] = row[x + pixel_bytes]
            else:
                for x in range(samples.shape[1]):
                    samples[y, x] = (np.int32(row[2 * x + pixel_bytes]) << 8) + row[2 * x + 1 + pixel_bytes]
        above, row = row, above
    return known


@njit(inner=True)
def _undo(filtered, kind, pixel_bytes, above, row):
    """Fill the `row` whose filtered bytes follow the first of `filtered`, below the row `above`."""
    for x in range(len(filtered) - 1):
        left, up = np.int64(row[x]), np.int64(above[x + pixel_bytes])
        guess = np.int64(0)
        if kind == 1:
            guess = left
        elif kind == 2:
            guess = up
        elif kind == 3:
            guess = (left + up) >> 1
        elif kind == 4:
            guess = _paeth(left, up, np.int64(above[x]))
        row[x + pixel_bytes] = np.uint8(np.int64(filtered[x + 1]) + guess)


@njit(inner=True)
def _paeth(left, up, corner):
    """Of three bytes the one nearest to left + up - corner."""
    to_left, to_up, to_corner = abs(up - corner), abs(left - corner), abs(left + up - 2 * corner)
    nearest = left
    if to_left > to_up or to_left > to_corner:
        nearest = up if to_up <= to_corner else corner
    return nearest


@njit(inner=True)
def _undo_mean_16(filtered, above, row, samples):
    """As `_undo` for the mean of 16-bit samples, which are written too: two chains of bytes in registers.

    Unsigned indices spare the test for negative ones.
    """
    one, two = np.uint64(1), np.uint64(2)
    high, low, mask = np.uint32(0), np.uint32(0), np.uint32(255)
    for x in range(np.uint64(len(samples))):
        p = two * x
        high = (np.uint32(filtered[p + one]) + ((high + np.uint32(above[p + two])) >> np.uint32(1))) & mask
        low = (np.uint32(filtered[p + two]) + ((low + np.uint32(above[p + two + one])) >> np.uint32(1))) & mask
        row[p + two], row[p + two + one] = high, low
        samples[x] = np.int32((high << np.uint32(8)) | low)
