"""The rows of a PNG: every filter against Pillow's decoder and the definition, and rows that are refused."""

from __future__ import annotations

import io
import struct
import zlib

import numpy as np
import pytest
from PIL import Image

from startrack.core.errors import BadInput
from startrack.exposure.png import SIGNATURE, chunk
from startrack.exposure.png import decode as decode_png

WIDTH, HEIGHT = 23, 40


def filtered_rows(depth: int, channels: int, seed: int) -> np.ndarray:
    """Rows with all five filters and random bytes, each after the number of its filter."""
    rng = np.random.default_rng(seed)
    rows = rng.integers(0, 256, (HEIGHT, 1 + WIDTH * channels * depth // 8), dtype=np.uint8)
    rows[:, 0] = rng.integers(0, 5, HEIGHT)
    return rows


def png(rows: bytes, depth: int = 16, channels: int = 1) -> bytes:
    ihdr = struct.pack(">IIBBBBB", WIDTH, HEIGHT, depth, 2 if channels == 3 else 0, 0, 0, 0)
    return SIGNATURE + chunk(b"IHDR", ihdr) + chunk(b"IDAT", zlib.compress(rows)) + chunk(b"IEND", b"")


def paeth(left: int, above: int, corner: int) -> int:
    """Paeth's predictor: of the three neighbours that nearest to left + above - corner (W3C PNG, section 9.4)."""
    return min((left, above, corner), key=lambda one: abs(left + above - corner - one))


def undo_filters(rows: np.ndarray, pixel_bytes: int) -> np.ndarray:
    """The bytes of the `rows` by the definition of the filters."""
    found = np.zeros((len(rows) + 1, rows.shape[1] - 1 + pixel_bytes), dtype=int)
    for y, row in enumerate(rows.astype(int)):
        for x, value in enumerate(row[1:], pixel_bytes):
            left, above, corner = found[y + 1, x - pixel_bytes], found[y, x], found[y, x - pixel_bytes]
            predicted = (0, left, above, (left + above) // 2, paeth(left, above, corner))[row[0]]
            found[y + 1, x] = (value + predicted) % 256
    return found[1:, pixel_bytes:].astype(np.uint8)


@pytest.mark.parametrize("depth", [8, 16])
@pytest.mark.parametrize("channels", [1, 3])
def test_every_filter_gives_the_pixels_of_its_definition(depth: int, channels: int) -> None:
    rows = filtered_rows(depth, channels, 10 * depth + channels)
    pixels = undo_filters(rows, channels * depth // 8).view(f">u{depth // 8}").reshape(HEIGHT, WIDTH, channels)
    got = decode_png(png(rows.tobytes(), depth, channels)).pixels_adu
    expected = pixels.sum(axis=-1, dtype=np.float32) / np.float32(channels)
    expected[(pixels == 2**depth - 1).any(axis=-1)] = 2**depth - 1
    np.testing.assert_array_equal(got, expected)


def test_a_grey_picture_has_the_pixels_that_pillow_reads() -> None:
    raw = png(filtered_rows(16, 1, 3).tobytes())
    np.testing.assert_array_equal(decode_png(raw).pixels_adu, np.asarray(Image.open(io.BytesIO(raw))))


@pytest.mark.parametrize(
    "header",
    [(WIDTH, HEIGHT, 16, 0, 1, 0, 0), (WIDTH, HEIGHT, 16, 0, 0, 1, 0), (WIDTH, HEIGHT, 16, 0, 0, 0, 2),
     (1_000_001, 1, 16, 0, 0, 0, 0)],
)  # fmt: skip
def test_a_header_that_libpng_does_not_read_is_refused(
    header: tuple[int, ...], capfd: pytest.CaptureFixture[str]
) -> None:
    rows = bytes(header[1] * (1 + 2 * header[0]))
    raw = SIGNATURE + chunk(b"IHDR", struct.pack(">IIBBBBB", *header)) + chunk(b"IDAT", zlib.compress(rows))
    with pytest.raises(BadInput, match="method or width"):
        decode_png(raw + chunk(b"IEND", b""))
    assert capfd.readouterr().err == ""  # of libpng


@pytest.mark.parametrize("fault", ["short", "long", "filter"])
def test_rows_of_another_size_or_filter_are_refused(fault: str, capfd: pytest.CaptureFixture[str]) -> None:
    rows = filtered_rows(16, 1, 0)
    data = {"short": rows[:-1].tobytes(), "long": rows.tobytes() + b"0"}.get(fault)
    if data is None:
        rows[7, 0] = 5
        data = rows.tobytes()
    with pytest.raises(BadInput, match="damaged PNG"):
        decode_png(png(data))
    assert capfd.readouterr().err == ""  # of libpng
