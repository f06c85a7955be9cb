"""FITS, plain or compressed (.gz, .bz2, tile-compressed .fz): read by astropy.

Rows stay in the order of the file: pixel (x, y) here is FITS pixel (x + 1, y + 1). FITS displays put the first row at
the bottom, so what this project calls the top of the image is the bottom of such a display.
Format: Pence et al. 2010, A&A 524, A42 (FITS 3.0), and Rots et al. 2015, A&A 574, A36 (time).
"""

from __future__ import annotations

import bz2
import gzip
import warnings
from io import BytesIO
from typing import IO, Any

import numpy as np

from startrack.exposure.decoded import MAX_FILE_BYTES, Decoded, check_size, grey_float32, refuse
from startrack.exposure.metadata import HEADER_KEYS

BLOCK_BYTES = 2880
MAX_HEADER_BYTES = 1000 * BLOCK_BYTES
GZIP, BZIP2 = b"\x1f\x8b", b"BZh"


def decode_fits(raw: bytes) -> Decoded:
    """Pixels and header of the only image of a FITS file: BZERO applied, native byte order, rows as stored.

    `BadInput` if truncated, damaged (DATASUM), a cube, with several images, or with undefined pixels (NaN, BLANK).
    """
    from astropy.io import fits

    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        raw = _inflate(raw)
        _check_first_size(raw)
        with fits.open(BytesIO(raw), memmap=False, checksum=True) as units:
            _check_complete(units, raw)
            unit = _only_image(units)
            check_size(*_plane_shape(unit)[::-1])
            header = _facts(units, unit)
            saturation = _saturation(unit.header)
            stored = np.asarray(unit.data)
            if any("Datasum verification failed" in str(w.message) for w in said):
                raise refuse("damaged FITS: its data do not agree with DATASUM")
    pixels, notes = grey_float32(stored.reshape(stored.shape[-2:]))
    return Decoded(pixels_adu=pixels, saturation_adu=saturation, header=header, warnings=notes)


def _inflate(raw: bytes) -> bytes:
    """The FITS file itself, decompressed if need be; an image too large is refused before it is."""
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
            raise refuse("compressed file without FITS data in it")
        if len(block) < BLOCK_BYTES:
            raise refuse("truncated FITS: the file ends within its header")
        head += block
    _check_first_size(head)
    rest = stream.read(MAX_FILE_BYTES)
    if stream.read(1):
        raise refuse(f"decompresses to more than {MAX_FILE_BYTES / 1e9:.1f} GB")
    return head + rest


def _has_end(block: bytes) -> bool:
    return any(block[at : at + 8] == b"END     " for at in range(0, len(block), 80))


def _check_first_size(head: bytes) -> None:
    from astropy.io import fits

    header = fits.Header.fromfile(BytesIO(head))
    if header["NAXIS"] >= 2:
        check_size(header["NAXIS1"], header["NAXIS2"])


def _only_image(units: Any) -> Any:
    """The one unit with image data, plain or tile-compressed."""
    images = [unit for unit in units if unit.is_image and unit.shape]
    if not images:
        raise refuse("FITS holds no image")
    if len(images) > 1:
        names = ", ".join(f"{unit.name or 'unnamed'} {_text_shape(unit)}" for unit in images)
        raise refuse(f"FITS holds {len(images)} images ({names}); startrack reads files with one")
    return images[0]


def _plane_shape(unit: Any) -> tuple[int, int]:
    """(H, W); axes of length 1 beyond the second are no cube."""
    shape = unit.shape
    if len(shape) < 2 or any(n != 1 for n in shape[:-2]):
        kind = "a spectrum" if len(shape) < 2 else "a cube"
        raise refuse(f"FITS holds {kind} ({_text_shape(unit)}); startrack reads flat grey images")
    return shape[-2], shape[-1]


def _text_shape(unit: Any) -> str:
    return " x ".join(str(n) for n in reversed(unit.shape))


def _check_complete(units: Any, raw: bytes) -> None:
    """Every unit, padding included, must lie within the file, and nothing else: astropy only warns."""
    end = 0
    for index in range(len(units)):
        place = units.fileinfo(index)
        end = max(end, place["datLoc"] + place["datSpan"])
    if end > len(raw):
        raise refuse("truncated FITS: the file ends before its data do")
    if raw[end:].strip(b"\0 "):
        raise refuse("damaged or truncated FITS: an extension cannot be read")


def _facts(units: Any, unit: Any) -> dict[str, Any]:
    """The facts in the image's own header, then in the primary one."""
    headers = (unit.header, units[0].header)
    keys = set(HEADER_KEYS.values())
    found = {key: next((h[key] for h in headers if key in h), None) for key in sorted(keys)}
    return {key: value for key, value in found.items() if isinstance(value, str | int | float)}  # not Undefined


def _saturation(header: Any) -> float | None:
    """Largest value the integers stand for [ADU]; ask before astropy rescales them and edits the header."""
    bits = int(header["BITPIX"])
    if bits < 0:
        return None
    largest = np.iinfo(np.uint8 if bits == 8 else f"i{bits // 8}").max
    return float(largest * header.get("BSCALE", 1) + header.get("BZERO", 0))
