"""FITS, plain or compressed (.gz, .bz2, tile-compressed .fz): read by astropy.

Rows stay in the order of the file: pixel (x, y) here is FITS pixel (x + 1, y + 1). FITS displays put the first row at
the bottom, so what this project calls the top of the image is the bottom of such a display.
Format: Pence et al. 2010, A&A 524, A42 (FITS 3.0), and Rots et al. 2015, A&A 574, A36 (time).
"""

from __future__ import annotations

import bz2
import gzip
import math
import re
import warnings
import zlib
from collections.abc import Callable
from io import BytesIO
from typing import IO, Any

import numpy as np

from startrack.exposure.decoding import Decoded, bad_image, check_size, grey_float32
from startrack.exposure.facts import HEADER_KEYS

BLOCK_BYTES = 2880
MAX_HEADER_BYTES = 1000 * BLOCK_BYTES  # of all units together: astropy takes 0.2 s for them
MAX_BYTES_BESIDE = 2**26  # of the units beside the largest one
MAX_PADDING_BYTES = 100 * BLOCK_BYTES  # zeros or blanks after the last unit
MAX_TILES = 2**15  # of a tile-compressed image, by default one a row
MAX_AXES, MAX_FIELDS = 99, 999  # largest legal is 999 for both; readers loop over them
INTEGER_CARD = re.compile(rb"(Z?NAXIS\d*|ZTILE\d|TFIELDS|BITPIX|PCOUNT|GCOUNT) *= *([+-]?\d+)")
STALE_SUM = (
    "the data do not agree with DATASUM in the header: a program changed the pixels and kept the old sum, or the file "
    "is damaged"
)
GZIP, BZIP2 = b"\x1f\x8b", b"BZh"


def decode(raw: bytes) -> Decoded:
    """Pixels and header of the only image of a FITS file: BZERO applied, native byte order, rows as stored.

    Data that do not agree with DATASUM are read with a warning. Raises BadInput bad_image if the file is truncated or
    damaged, a cube, or if it has several images or undefined pixels (NaN, BLANK).
    """
    from astropy.io import fits

    with warnings.catch_warnings(record=True) as issued:
        warnings.simplefilter("always")
        raw = _inflate(raw)
        with fits.open(BytesIO(raw), memmap=False, checksum=True) as units:
            _check_complete(units, raw)
            unit = _only_image(units)
            shape = unit.shape[-2:]
            check_size(*shape[::-1])
            if isinstance(unit, fits.CompImageHDU):
                _check_deflated_tiles(raw)
            header = _metadata(units, unit)
            saturation = _saturation(unit.header)
            stored = np.asarray(unit.data)
    if stored.shape[-2:] != shape:  # of a damaged tile-compressed image
        raise bad_image(f"damaged FITS: its data are {stored.shape}, its header gives {shape}")
    pixels, notes = grey_float32(stored.reshape(shape))
    if any("Datasum verification failed" in str(w.message) for w in issued):
        notes += (STALE_SUM,)
    return Decoded(pixels_adu=pixels, saturation_adu=saturation, header=header, warnings=notes)


def _inflate(raw: bytes) -> bytes:
    """The FITS file itself, decompressed if it is compressed. Raises BadInput bad_image for what no picture needs.

    Each unit is checked before its data are inflated, so that a small file cannot ask for much work.
    """
    stream: IO[bytes]
    if raw.startswith(GZIP):
        stream = gzip.GzipFile(fileobj=BytesIO(raw))  # type: ignore[assignment]
    elif raw.startswith(BZIP2):
        stream = bz2.BZ2File(BytesIO(raw))
    else:
        _check_units(lambda end: raw)
        return raw
    inflated = bytearray()

    def inflate_to(end: int) -> bytearray:
        inflated.extend(stream.read(max(end - len(inflated), 0)))
        return inflated

    if not inflate_to(BLOCK_BYTES).startswith(b"SIMPLE  ="):
        raise bad_image("compressed file without FITS data in it")
    _check_units(inflate_to)
    return bytes(inflated)


def _check_units(read_to: Callable[[int], bytes | bytearray]) -> None:
    """Refuse numbers of cards, units, axes, fields and bytes that a reader would loop over or allocate for minutes."""
    at = header_bytes = 0
    data_sizes: list[int] = []
    while read_to(at + BLOCK_BYTES)[at : at + 8] in (b"SIMPLE  ", b"XTENSION"):
        end = at
        while not _has_end(read_to(end + BLOCK_BYTES)[end : end + BLOCK_BYTES]):
            end += BLOCK_BYTES
            if header_bytes + end - at > MAX_HEADER_BYTES:
                break
            if end >= len(read_to(end + BLOCK_BYTES)):
                raise bad_image("truncated FITS: the file ends within a header")
        end += BLOCK_BYTES
        header_bytes += end - at
        if header_bytes > MAX_HEADER_BYTES:
            raise bad_image(f"FITS has more than {MAX_HEADER_BYTES / 1e6:.1f} MB of headers")
        data_sizes.append(_data_bytes(read_to(end)[at:end], is_first=at == 0))
        if (beside := sum(data_sizes) - max(data_sizes)) > MAX_BYTES_BESIDE:
            raise bad_image(f"FITS holds {beside / 1e6:.0f} MB beside its largest unit; startrack reads single images")
        at = end + -(-data_sizes[-1] // BLOCK_BYTES) * BLOCK_BYTES
    if len(read_to(at + MAX_PADDING_BYTES + 1)) > at + MAX_PADDING_BYTES:
        raise bad_image("damaged FITS: much follows the last unit that its headers declare")


def _has_end(block: bytes | bytearray) -> bool:
    return any(block[at : at + 8] == b"END     " for at in range(0, len(block), 80))


def _data_bytes(header: bytes | bytearray, *, is_first: bool) -> int:
    """Size of the data that a complete `header` declares. Raises BadInput bad_image for sizes that no picture has."""
    cards = (INTEGER_CARD.match(header, card, card + 80) for card in range(0, len(header), 80))
    numbers = {match[1].decode(): int(match[2]) for match in cards if match}
    axes, fields = numbers.get("NAXIS", 0), numbers.get("TFIELDS", 0)
    if not 0 <= axes <= MAX_AXES or not 0 <= fields <= MAX_FIELDS:
        raise bad_image(f"damaged FITS: NAXIS is {axes}, TFIELDS is {fields}")
    sides = [numbers.get(f"NAXIS{n + 1}", 0) for n in range(axes)]
    if is_first and axes >= 2:
        check_size(sides[0], sides[1])
    picture_px = 0 if fields else math.prod(sides)
    if "ZNAXIS1" in numbers:  # a tile-compressed image: a row each tile
        picture_px = numbers["ZNAXIS1"] * numbers.get("ZNAXIS2", 1)
        check_size(numbers["ZNAXIS1"], numbers.get("ZNAXIS2", 1))
        _check_tiles(numbers, picture_px)
    values = numbers.get("GCOUNT", 1) * (numbers.get("PCOUNT", 0) + math.prod(sides)) if axes else 0
    data_bytes = abs(numbers.get("BITPIX", 8)) // 8 * values
    if not 0 <= data_bytes <= 8 * picture_px + MAX_BYTES_BESIDE:
        raise bad_image(f"damaged FITS: a unit of {data_bytes} bytes for {picture_px} pixels")
    return data_bytes


def _check_tiles(numbers: dict[str, int], picture_px: int) -> None:
    """Refuse more tiles, or larger ones, than a tile-compressed picture needs; `numbers` by the keys of its header."""
    tiles, tile_px = numbers.get("NAXIS2", 0), numbers.get("ZTILE1", numbers["ZNAXIS1"]) * numbers.get("ZTILE2", 1)
    if not 0 <= tiles <= MAX_TILES or tile_px <= 0 or tiles * tile_px > 4 * picture_px + MAX_BYTES_BESIDE:
        raise bad_image(f"damaged FITS: {tiles} tiles of {tile_px} pixels for a picture of {picture_px}")


def _check_deflated_tiles(raw: bytes) -> None:
    """Refuse a tile that inflates to more than its pixels: astropy inflates each one whole."""
    from astropy.io import fits

    with fits.open(BytesIO(raw), memmap=False, disable_image_compression=True) as units:
        for unit in (unit for unit in units if "ZIMAGE" in unit.header):
            header = unit.header
            most = 8 * header.get("ZTILE1", header["ZNAXIS1"]) * header.get("ZTILE2", 1)
            for column in (one for one in unit.columns if "P" in one.format or "Q" in one.format):
                for cell in unit.data[column.name]:
                    packed = np.asarray(cell).tobytes()
                    if packed.startswith(GZIP) and len(zlib.decompressobj(31).decompress(packed, most + 1)) > most:
                        raise bad_image("damaged FITS: a tile inflates to more than its pixels")


def _only_image(units: Any) -> Any:
    """The one unit with image data, plain or tile-compressed; axes of length 1 beyond the second are no cube."""
    images = [unit for unit in units if unit.is_image and unit.shape]
    sizes = [" x ".join(str(n) for n in reversed(unit.shape)) for unit in images]
    if not images:
        raise bad_image("FITS holds no image")
    if len(images) > 1:
        names = ", ".join(f"{unit.name or 'unnamed'} {size}" for unit, size in zip(images, sizes, strict=True))
        raise bad_image(f"FITS holds {len(images)} images ({names}); startrack reads files with one")
    shape = images[0].shape
    if len(shape) < 2 or any(n != 1 for n in shape[:-2]):
        kind = "a spectrum" if len(shape) < 2 else "a cube"
        raise bad_image(f"FITS holds {kind} ({sizes[0]}); startrack reads flat grey images")
    return images[0]


def _check_complete(units: Any, raw: bytes) -> None:
    """Check that the file holds every unit with its padding, and nothing else: astropy only warns."""
    spans = [units.fileinfo(index) for index in range(len(units))]
    end = max((span["datLoc"] + span["datSpan"] for span in spans), default=0)
    if end > len(raw):
        raise bad_image("truncated FITS: the file ends before its data do")
    if raw[end:].strip(b"\0 "):
        raise bad_image("damaged or truncated FITS: an extension cannot be read")


def _metadata(units: Any, unit: Any) -> dict[str, Any]:
    """The metadata in the image's own header, else in the primary one."""
    headers = (unit.header, units[0].header)
    stated = str | int | float  # not Undefined
    found = {
        key: [h[key] for h in headers if isinstance(h.get(key), stated)] for key in sorted({*HEADER_KEYS.values()})
    }
    return {key: values[0] for key, values in found.items() if values}


def _saturation(header: Any) -> float | None:
    """Largest value that the integers can represent [ADU]; read before astropy rescales them and edits the header."""
    bits = int(header["BITPIX"])
    if bits < 0:
        return None
    largest = np.iinfo(np.uint8 if bits == 8 else f"i{bits // 8}").max
    return float(largest * header.get("BSCALE", 1) + header.get("BZERO", 0))
