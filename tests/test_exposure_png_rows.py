"""The compiled decoder of PNG rows against OpenCV's, for every filter and kind of pixel."""

from __future__ import annotations

import struct
import zlib

import cv2
import numpy as np
import pytest

from startrack.core.errors import BadInput
from startrack.exposure.png import SIGNATURE, chunk
from startrack.exposure.png import decode as decode_png
from startrack.exposure.png_rows import decode_rows

WIDTH, HEIGHT = 23, 40


def png(depth: int, channels: int, seed: int) -> tuple[bytes, bytes]:
    """A file whose rows have all five filters and random bytes, and its compressed picture data."""
    rng = np.random.default_rng(seed)
    rows = rng.integers(0, 256, (HEIGHT, 1 + WIDTH * channels * depth // 8), dtype=np.uint8)
    rows[:, 0] = rng.integers(0, 5, HEIGHT)
    data = zlib.compress(rows.tobytes())
    ihdr = struct.pack(">IIBBBBB", WIDTH, HEIGHT, depth, 2 if channels == 3 else 0, 0, 0, 0)
    return SIGNATURE + chunk(b"IHDR", ihdr) + chunk(b"IDAT", data) + chunk(b"IEND", b""), data


@pytest.mark.parametrize("depth", [8, 16])
@pytest.mark.parametrize("channels", [1, 3])
def test_every_filter_gives_the_pixels_that_opencv_gives(depth: int, channels: int) -> None:
    file, data = png(depth, channels, 10 * depth + channels)
    expected = cv2.imdecode(np.frombuffer(file, np.uint8), cv2.IMREAD_UNCHANGED)
    got = decode_rows(data, WIDTH, HEIGHT, depth, channels)
    assert np.array_equal(got[..., ::-1] if channels == 3 else got, expected)
    assert decode_png(file).pixels_adu.shape == (HEIGHT, WIDTH)


@pytest.mark.parametrize("height", [HEIGHT - 1, HEIGHT + 1])
def test_data_of_another_size_are_refused(height: int) -> None:
    with pytest.raises(BadInput, match="damaged PNG"):
        decode_rows(png(16, 1, 0)[1], WIDTH, height, 16, 1)
