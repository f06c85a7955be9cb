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
from io import BytesIO
from typing import IO, Any

import numpy as np

from startrack.exposure.decoding import MAX_FILE_BYTES, Decoded, bad_image, check_size, grey_float32
from startrack.exposure.facts import HEADER_KEYS

BLOCK_BYTES = 2880
MAX_HEADER_BYTES = 1000 * BLOCK_BYTES
MAX_AXES, MAX_FIELDS = 99, 999  # largest legal is 999 for both; readers loop over them
INTEGER_CARD = re.compile(rb"(NAXIS\d*|TFIELDS|BITPIX|PCOUNT|GCOUNT) *= *([+-]?\d+)")
GZIP, BZIP2 = b"\x1f\x8b", b"BZh"


def decode(raw: bytes) -> Decoded:
    """Pixels and header of the only image of a FITS file: BZERO applied, native byte order, rows as stored.

    Raises BadInput bad_image if it is truncated, damaged (DATASUM), a cube, or if it has several images or undefined
    pixels (NaN, BLANK).
    """
    from astropy.io import fits

    with warnings.catch_warnings(record=True) as issued:
        warnings.simplefilter("always")
        raw = _inflate(raw)
        _check_headers(raw)
        with fits.open(BytesIO(raw), memmap=False, checksum=True) as units:
            _check_complete(units, raw)
            unit = _only_image(units)
            shape = unit.shape[-2:]
            check_size(*shape[::-1])
            header = _metadata(units, unit)
            saturation = _saturation(unit.header)
            stored = np.asarray(unit.data)
            if any("Datasum verification failed" in str(w.message) for w in issued):
                raise bad_image("damaged FITS: its data do not agree with DATASUM")
    if stored.shape[-2:] != shape:  # of a damaged tile-compressed image
        raise bad_image(f"damaged FITS: its data are {stored.shape}, its header gives {shape}")
    pixels, notes = grey_float32(stored.reshape(shape))
    return Decoded(pixels_adu=pixels, saturation_adu=saturation, header=header, warnings=notes)


def _inflate(raw: bytes) -> bytes:
    """The FITS file itself, decompressed if it is compressed; a too large image is refused before that."""
    stream: IO[bytes]
    if raw.startswith(GZIP):
        stream = gzip.GzipFile(fileobj=BytesIO(raw))  # type: ignore[assignment]
    elif raw.startswith(BZIP2):
        stream = bz2.BZ2File(BytesIO(raw))
    else:
        return raw
    head = b""
    while len(head) < MAX_HEADER_BYTES and not _has_end(head[-BLOCK_BYTES:]):
        block = stream.read(BLOCK_BYTES)
        if not head and not block.startswith(b"SIMPLE  ="):
            raise bad_image("compressed file without FITS data in it")
        if len(block) < BLOCK_BYTES:
            raise bad_image("truncated FITS: the file ends within its header")
        head += block
    _check_headers(head)
    rest = stream.read(MAX_FILE_BYTES)
    if stream.read(1):
        raise bad_image(f"decompresses to more than {MAX_FILE_BYTES / 1e9:.1f} GB")
    return head + rest


def _has_end(block: bytes) -> bool:
    return any(block[at : at + 8] == b"END     " for at in range(0, len(block), 80))


def _check_headers(raw: bytes) -> None:
    """Refuse numbers of axes, fields and pixels that a reader would loop over or allocate for minutes.

    Checks header by header before a reader opens the file; stops at the first header that is not complete in `raw`.
    """
    at = 0
    while raw[at : at + 8] in (b"SIMPLE  ", b"XTENSION"):
        start, end = at, at
        while not _has_end(raw[end : end + BLOCK_BYTES]):
            end += BLOCK_BYTES
            if end - start > MAX_HEADER_BYTES or end >= len(raw):
                return
        end += BLOCK_BYTES
        cards = (INTEGER_CARD.match(raw, card, card + 80) for card in range(start, end, 80))
        numbers = {match[1].decode(): int(match[2]) for match in cards if match}
        axes, fields = numbers.get("NAXIS", 0), numbers.get("TFIELDS", 0)
        if not 0 <= axes <= MAX_AXES or not 0 <= fields <= MAX_FIELDS:
            raise bad_image(f"damaged FITS: NAXIS is {axes}, TFIELDS is {fields}")
        sides = [numbers.get(f"NAXIS{n + 1}", 0) for n in range(axes)]
        if start == 0 and axes >= 2:
            check_size(sides[0], sides[1])
        values = numbers.get("GCOUNT", 1) * (numbers.get("PCOUNT", 0) + math.prod(sides)) if axes else 0
        data_bytes = abs(numbers.get("BITPIX", 8)) // 8 * values
        if data_bytes < 0:
            raise bad_image("damaged FITS: an extension of negative size")
        at = end + -(-data_bytes // BLOCK_BYTES) * BLOCK_BYTES


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
    found = {key: next((h[key] for h in headers if key in h), None) for key in sorted({*HEADER_KEYS.values()})}
    return {key: value for key, value in found.items() if isinstance(value, str | int | float)}  # not Undefined


def _saturation(header: Any) -> float | None:
    """Largest value that the integers can represent [ADU]; read before astropy rescales them and edits the header."""
    bits = int(header["BITPIX"])
    if bits < 0:
        return None
    largest = np.iinfo(np.uint8 if bits == 8 else f"i{bits // 8}").max
    return float(largest * header.get("BSCALE", 1) + header.get("BZERO", 0))
