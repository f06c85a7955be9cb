"""Strips and tiles of a TIFF page, checked before tifffile decodes them: it inflates each one whole."""

from __future__ import annotations

import math
from os import SEEK_END
from typing import Any

DEFLATE = (8, 32946)
PACK_BITS = 32773
TIFF_COMPRESSIONS = {1, PACK_BITS, *DEFLATE}  # 1: none; tifffile needs nothing more for these
MAX_STRIPS = 2**16  # tiles of 64 px of a picture of 200 Mpx are 49,000
MAX_SPARE_BYTES = 2**26  # of a tile beyond the picture that it is cropped to


def check_packed_strips(page: Any, file: Any) -> None:
    """Raise ValueError where strips or tiles would decode to more than the picture, or end beyond the file.

    `page` is a tifffile.TiffPage of any compression; `file` (open, binary) holds its bytes.
    """
    from isal import isal_zlib

    strips = tuple(zip(page.dataoffsets, page.databytecounts, strict=False))
    part_bytes = math.prod(page.chunks) * page.dtype.itemsize
    if len(strips) > MAX_STRIPS:
        raise ValueError(f"{len(strips)} strips, more than the {MAX_STRIPS} allowed")
    if part_bytes > page.nbytes + MAX_SPARE_BYTES:
        raise ValueError(f"tiles of {part_bytes} bytes for a picture of {page.nbytes}")
    file_bytes = file.seek(0, SEEK_END)
    if any(start + count > file_bytes for start, count in strips):  # tifffile makes room for all of it
        raise ValueError("a strip ends beyond the end of the file")
    for start, count in strips if page.compression in DEFLATE else ():
        file.seek(start)
        if len(isal_zlib.decompressobj().decompress(file.read(count), part_bytes + 1)) > part_bytes:
            raise ValueError("a strip inflates to more than its part of the picture")
    if page.compression == PACK_BITS and any(count > 2 * part_bytes for _, count in strips):
        raise ValueError("a strip has more bytes than its part of the picture")
