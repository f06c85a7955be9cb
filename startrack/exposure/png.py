"""PNG: strict check of all chunks and of the size of the picture's data; interlaced pixels by OpenCV.

Each chunk has a checksum: zlib.crc32 finds truncation and damage in about a millisecond.
Format: W3C PNG specification (third edition, 2025).
"""

from __future__ import annotations

import math
import struct
import zlib
from collections.abc import Iterable, Iterator, Mapping
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from startrack.exposure.decoding import Decoded, bad_image, check_size, exif_warnings, grey_float32
from startrack.exposure.facts import HEADER_KEYS
from startrack.kernels.library import kernel

SIGNATURE = b"\x89PNG\r\n\x1a\n"
COLOUR_TYPES = {0: "grey", 2: "colour", 3: "palette", 4: "grey with alpha", 6: "colour with alpha"}
MAX_FACT_BYTES = 4096  # of one fact; a compressed chunk is not inflated beyond it
LIBPNG_SIDE_PX = 1_000_000  # libpng's own limit
MAX_CHUNKS = 200_000  # libpng's of 8 KiB for a colour picture of 200 Mpx and 16 bits: 146,000
DAMAGED = "damaged PNG: its picture data cannot be decoded"
FILTERS = 5  # none, the byte to the left, above, their mean, and Paeth's predictor
WHOLE = ((0, 0, 1, 1),)  # first column and row of a pass over the picture, and their steps
ADAM7 = (0, 0, 8, 8), (4, 0, 8, 8), (0, 4, 4, 8), (2, 0, 4, 4), (0, 2, 2, 4), (1, 0, 2, 2), (0, 1, 1, 2)
Passes = tuple[tuple[int, int, int, int], ...]
IHDR_END = len(SIGNATURE) + 12 + 13  # text is spliced in after the header chunk


def decode(raw: bytes) -> Decoded:
    """Pixels and facts of a PNG file of 8 or 16 bits, grey or colour.

    `BadInput` if truncated or damaged, with alpha or palette, animated, or of fewer bits.
    """
    header: dict[str, str] = {}
    warnings: tuple[str, ...] = ()
    width = height = depth = channels = 0
    interlaced = False
    picture: list[memoryview] = []
    for kind, body in png_chunks(raw):
        if kind == b"IHDR":
            width, height, depth, channels, interlaced = _check_ihdr(body)
        elif kind == b"IDAT":
            picture.append(body)
        elif kind in (b"tEXt", b"zTXt", b"iTXt"):
            _read_text(kind, bytes(body), header)
        elif kind == b"tRNS":
            raise bad_image("PNG with a transparent colour (alpha): save it without transparency")
        elif kind == b"acTL":
            raise bad_image("animated PNG: several pictures in one file")
        elif kind == b"eXIf":
            warnings = exif_warnings(partial(_read_exif, bytes(body)))
        elif kind[:1].isupper() and kind != b"PLTE":
            raise bad_image(f"PNG needs a feature that startrack does not know ({kind!r})")
    # Gamma, colour profile and orientation are left out: they cannot change the pixels.
    data = b"".join(picture)
    rows = _inflate_rows(data, width, height, depth * channels, ADAM7 if interlaced else WHOLE)
    if interlaced:
        import cv2

        plain = b"".join((raw[:IHDR_END], chunk(b"IDAT", data), chunk(b"IEND", b"")))
        stored: Any = cv2.imdecode(np.frombuffer(plain, np.uint8), cv2.IMREAD_UNCHANGED)
    else:
        stored = _undo_filters(rows, height, channels, depth // 8)
    if stored is None or stored.shape[:2] != (height, width):
        raise bad_image(DAMAGED)
    pixels, colour = (stored, ()) if stored.dtype == np.float32 else grey_float32(stored)
    return Decoded(pixels_adu=pixels, saturation_adu=2.0**depth - 1.0, header=header, warnings=warnings + colour)


def add_text(png: bytes, texts: Mapping[str, str]) -> bytes:
    """The PNG file with one text chunk per entry, before its picture data."""
    return insert_png_chunks(png, [_text_chunk(keyword, text) for keyword, text in texts.items()])


def insert_png_chunks(png: bytes, added: Iterable[tuple[bytes, bytes]]) -> bytes:
    """The PNG file `png` with the chunks `added`, pairs of kind and body, before its picture data."""
    return png[:IHDR_END] + b"".join(chunk(*one) for one in added) + png[IHDR_END:]


def png_chunks(raw: bytes) -> Iterator[tuple[bytes, memoryview]]:
    """Kind and body of each chunk of the PNG file `raw` up to IEND, lengths and checksums verified."""
    view = memoryview(raw)
    at = len(SIGNATURE)
    for _ in range(MAX_CHUNKS):
        if at + 12 > len(raw):
            raise bad_image("truncated PNG: the file ends before its IEND chunk")
        (length,) = struct.unpack_from(">I", raw, at)
        kind, end = raw[at + 4 : at + 8], at + 8 + length
        if end + 4 > len(raw):
            raise bad_image("truncated PNG: the file ends within a chunk")
        if zlib.crc32(view[at + 4 : end]) != struct.unpack_from(">I", raw, end)[0]:
            raise bad_image("damaged PNG: the checksum of a chunk does not agree")
        if (kind == b"IHDR") != (at == len(SIGNATURE)):
            raise bad_image("damaged PNG: its header chunk is not the first one")
        if kind == b"IEND":
            return
        yield kind, view[at + 8 : end]
        at = end + 4
    raise bad_image(f"PNG has more than {MAX_CHUNKS} chunks")


def _check_ihdr(body: memoryview) -> tuple[int, int, int, int, bool]:
    """Width, height, bits of a sample, samples of a pixel, and whether the rows are interlaced."""
    if len(body) != 13:
        raise bad_image("damaged PNG: its header chunk has a wrong length")
    width, height, depth, colour_type = struct.unpack_from(">IIBB", body)
    check_size(width, height)
    if colour_type not in (0, 2):
        name = COLOUR_TYPES.get(colour_type, f"colour type {colour_type}")
        raise bad_image(f"PNG is {name}; startrack reads plain grey or colour")
    if depth not in (8, 16):
        raise bad_image(f"PNG has {depth} bits a pixel; startrack reads 8 or 16")
    if max(width, height) > LIBPNG_SIDE_PX or tuple(body[10:12]) != (0, 0) or body[12] > 1:
        raise bad_image("PNG of a method or width that the format's library does not know: save it anew")
    return width, height, depth, 3 if colour_type == 2 else 1, body[12] == 1


def _inflate_rows(compressed: bytes, width: int, height: int, pixel_bits: int, passes: Passes) -> bytes:
    """The filtered rows of all `passes`, each of whole bytes after the number of its filter.

    Raises BadInput bad_image for data that are damaged, too short or too long, or name an unknown filter; no more is
    inflated. OpenCV does not refuse data that are too long, and libpng prints a line about the other faults.
    """
    sides = [(-(-(height - y0) // dy), -(-(width - x0) // dx)) for x0, y0, dx, dy in passes]
    shapes = [(rows, 1 + columns * pixel_bits // 8) for rows, columns in sides if rows > 0 and columns > 0]
    size, stream = sum(map(math.prod, shapes)), zlib.decompressobj()
    try:
        data = stream.decompress(compressed, size + 1)
    except zlib.error as cause:
        raise bad_image(DAMAGED) from cause
    if len(data) != size or not stream.eof:
        raise bad_image(DAMAGED)
    at = 0
    for rows, row_bytes in shapes:
        filters = np.frombuffer(data, np.uint8, rows * row_bytes, at)[::row_bytes]
        if filters.max() >= FILTERS:
            raise bad_image(DAMAGED)
        at += rows * row_bytes
    return data


def _undo_filters(data: bytes, height: int, channels: int, sample_bytes: int) -> NDArray[Any]:
    """Samples of `height` filtered rows: grey ones (H, W) as float32, which holds them exactly, else (H, W, channels).

    Compiled, it takes half of the time in which OpenCV inflates the data again.
    """
    rows = np.frombuffer(data, np.uint8).reshape(height, -1)
    row_bytes, pixel_bytes = rows.shape[1] - 1, channels * sample_bytes
    dtype = np.float32 if channels == 1 else np.uint8 if sample_bytes == 1 else np.uint16
    samples = np.empty((height, row_bytes // sample_bytes), dtype)
    scratch = np.zeros((2, row_bytes + pixel_bytes), np.uint8)  # two rows, and zeros to their left
    UNFILTER[samples.dtype.name, sample_bytes](rows, pixel_bytes, scratch, samples)
    return samples if channels == 1 else samples.reshape(height, -1, channels)


def _read_text(kind: bytes, body: bytes, header: dict[str, str]) -> None:
    """Add the value of one text chunk to `header` if its key is known; the first of equal keys counts."""
    keyword, _, rest = body.partition(b"\0")
    key = HEADER_KEYS.get(keyword.decode("latin-1"))
    if key is None or key in header:
        return
    compressed, encoding = kind == b"zTXt", "latin-1"
    if kind == b"zTXt":
        rest = rest[1:]
    elif kind == b"iTXt":
        compressed, encoding = rest[:1] == b"\1", "utf-8"
        rest = rest[2:].partition(b"\0")[2].partition(b"\0")[2]
    if compressed:
        rest = zlib.decompressobj().decompress(rest, MAX_FACT_BYTES)
    header[key] = rest[:MAX_FACT_BYTES].decode(encoding)


def _text_chunk(keyword: str, text: str) -> tuple[bytes, bytes]:
    if text.isascii():
        return b"tEXt", keyword.encode("ascii") + b"\0" + text.encode("ascii")
    return b"iTXt", keyword.encode("ascii") + b"\0\0\0\0\0" + text.encode("utf-8")


def chunk(kind: bytes, body: bytes) -> bytes:
    """PNG chunk: length, kind, body, checksum of kind and body."""
    checksum = zlib.crc32(body, zlib.crc32(kind))
    return b"".join((struct.pack(">I", len(body)), kind, body, struct.pack(">I", checksum)))


def _read_exif(body: bytes) -> Any:
    from PIL import Image

    exif = Image.Exif()
    exif.load(body)
    return exif


UNFILTER = {  # by the type of the samples, and their bytes in the file
    (dtype, sample_bytes): kernel(
        f"unfilter_{colours}_{8 * sample_bytes}", "rows: uint8[height, length + 1]", "pixel_bytes: int64",
        "scratch: out uint8[2, room]", f"samples: out {dtype}[height, samples]",
    )
    for colours, dtype, sample_bytes in (
        ("grey", "float32", 1), ("grey", "float32", 2), ("colour", "uint8", 1), ("colour", "uint16", 2)
    )
}  # fmt: skip
