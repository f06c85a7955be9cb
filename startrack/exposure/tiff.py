"""TIFF and BigTIFF: structure and common pixels by tifffile; by OpenCV where a codec is missing (LZW, for one)."""

from __future__ import annotations

import logging
import math
import struct
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from io import BytesIO
from typing import Any

import numpy as np
from numpy.typing import NDArray

from startrack.core.declaration import value_text
from startrack.exposure.decoding import (
    Decoded,
    bad_image,
    check_size,
    grey_float32,
    largest_value,
    orientation_warnings,
)
from startrack.exposure.facts import facts_in_text

MOSAIC = 32803
REFUSED = {0: "white-is-zero", 3: "palette", 4: "a mask", 5: "CMYK", 6: "YCbCr", 8: "CIELab"}  # by photometric type
CHANNELS = {1: 1, 2: 3, MOSAIC: 1}  # 1: black is zero, 2: red, green, blue
MAX_PAGES = 1000  # with reduced copies of the picture
DEFLATE = (8, 32946)
PACK_BITS = 32773
COMPRESSIONS = {1, PACK_BITS, *DEFLATE}  # 1: none; tifffile needs nothing more for these
MAX_STRIPS = 2**16  # tiles of 64 px of a picture of 200 Mpx are 49,000
MAX_SPARE_BYTES = 2**26  # of a tile beyond the picture that it is cropped to
PREDICTORS = {1, 2}  # none, horizontal: tifffile has these itself
NOWHERE = logging.NullHandler()  # added once
READ = "integers of 8, 16 or 32 bits and floating point"
TYPES = {"uint8", "uint16", "uint32", "int8", "int16", "int32", "float16", "float32", "float64"}


def decode(raw: bytes) -> Decoded:
    """Pixels of a TIFF with one grey or colour picture of whole bytes; metadata from its ImageDescription.

    Raises BadInput bad_image if it is truncated, has alpha, palette or CMYK, or holds several pictures (reduced copies
    do not count).
    """
    import tifffile

    logging.getLogger("tifffile").addHandler(NOWHERE)  # the exception has the cause of what it prints
    with tifffile.TiffFile(BytesIO(raw)) as tiff:
        _check_chain(tiff, raw)
        page = _only_page(tiff)
        _check_kind(page)
        _check_strips(page, len(raw))
        _check_packed_strips(page, raw)
        stored = _pixels(page, raw)
        orientation = page.tags.get(274)
        header, mosaic = facts_in_text(page.description), int(page.photometric) == MOSAIC
    pixels, colour = grey_float32(stored)
    return Decoded(
        pixels_adu=pixels,
        saturation_adu=largest_value(stored.dtype),
        header=header,
        warnings=orientation_warnings(None if orientation is None else int(orientation.value)) + colour,
        mosaic=mosaic or None,
    )


def _check_chain(tiff: Any, raw: bytes) -> None:
    """Check that the last directory is complete and marked as the last: tifffile drops pictures that it cannot find."""
    if not len(tiff.pages):
        raise bad_image("truncated or damaged TIFF: its directory is not in the file")
    form, last = tiff.tiff, tiff.pages[-1].offset
    (tags,) = struct.unpack_from(form.tagnoformat, raw, last)
    if any(struct.unpack_from(form.offsetformat, raw, last + form.tagnosize + tags * form.tagsize)):
        raise bad_image("truncated or damaged TIFF: one of its directories is not in the file")


def _only_page(tiff: Any) -> Any:
    if len(tiff.pages) > MAX_PAGES:
        raise bad_image(f"TIFF holds more than {MAX_PAGES} pictures; startrack reads files with one")
    full = [page for page in tiff.pages if not page.is_reduced]
    if len(full) != 1:
        raise bad_image(f"TIFF holds {len(full)} pictures; startrack reads files with one")
    page = full[0]
    check_size(page.imagewidth, page.imagelength)
    # A stack can hide behind one page: ImageJ and tifffile write its true shape into the description.
    hidden = max((math.prod(entry.get("shape", ())) for entry in tiff.shaped_metadata or ()), default=0)
    if tiff.is_imagej and (tiff.imagej_metadata or {}).get("images", 1) > 1:
        hidden = page.size * tiff.imagej_metadata["images"]
    if hidden > page.size:
        raise bad_image("TIFF holds a stack of pictures; startrack reads files with one")
    return page


def _check_kind(page: Any) -> None:
    photometric, channels = int(page.photometric), page.samplesperpixel
    if photometric not in CHANNELS:
        kind = REFUSED.get(photometric, f"photometric type {photometric}")
        raise bad_image(f"TIFF is {kind}; startrack reads plain grey or colour")
    if channels != CHANNELS[photometric]:
        raise bad_image(f"TIFF has {channels} channels (alpha?); startrack reads plain grey or colour")
    if page.imagedepth != 1:
        raise bad_image("TIFF holds a volume; startrack reads pictures")
    if page.dtype is None or page.dtype.name not in TYPES or page.bitspersample != page.dtype.itemsize * 8:
        raise bad_image(f"TIFF has {page.bitspersample}-bit samples of type {page.dtype}; startrack reads {READ}")


def _check_strips(page: Any, file_bytes: int) -> None:
    """Check that every strip or tile is in the file: a decoder would fill a missing one with a constant."""
    if page.is_tiled:
        check_size(page.tilewidth, page.tilelength)  # a tile may be larger than the picture it is cropped to
    starts, counts = page.dataoffsets, page.databytecounts
    if not starts or len(starts) != len(counts) or len(starts) != math.prod(page.chunked):
        raise bad_image("damaged TIFF: strips of the picture are missing")
    for start, count in zip(starts, counts, strict=True):
        if start <= 0 or count <= 0 or start + count > file_bytes:
            raise bad_image("truncated TIFF: a strip of the picture lies beyond the end of the file")
    if page.compression == 1 and sum(counts) < page.size * page.dtype.itemsize:
        raise bad_image("damaged TIFF: its strips are shorter than the picture")


def _check_packed_strips(page: Any, raw: bytes) -> None:
    """Check that no strip or tile decodes to more than its part of the picture: tifffile inflates each one whole."""
    part_bytes = math.prod(page.chunks) * page.dtype.itemsize
    if len(page.dataoffsets) > MAX_STRIPS:
        raise bad_image(f"damaged TIFF: {len(page.dataoffsets)} strips, more than the {MAX_STRIPS} allowed")
    if part_bytes > page.nbytes + MAX_SPARE_BYTES:
        raise bad_image(f"damaged TIFF: tiles of {part_bytes} bytes for a picture of {page.nbytes}")
    for start, count in zip(page.dataoffsets, page.databytecounts, strict=True):
        if page.compression in DEFLATE:
            packed = memoryview(raw)[start : start + count]
            if len(zlib.decompressobj().decompress(packed, part_bytes + 1)) > part_bytes:
                raise bad_image("damaged TIFF: a strip inflates to more than its part of the picture")
        if page.compression == PACK_BITS and count > 2 * part_bytes:
            raise bad_image("damaged TIFF: a strip has more bytes than its part of the picture")


def _pixels(page: Any, raw: bytes) -> NDArray[Any]:
    """Pixels (H, W) or (H, W, 3) as stored, in native byte order."""
    if page.compression in COMPRESSIONS and page.predictor in PREDICTORS:
        stored = page.asarray()
        if page.axes == "SYX":  # channels in separate planes
            stored = np.moveaxis(stored, 0, -1)
    else:
        import cv2

        with _silence_opencv(cv2):
            decoded = cv2.imdecode(np.frombuffer(raw, np.uint8), cv2.IMREAD_UNCHANGED)
        if decoded is None:
            cause = f"TIFF is damaged or its compression ({value_text(page.compression)}) is unknown here"
            raise bad_image(f"{cause}; save it uncompressed")
        stored = np.asarray(decoded)
    want = (page.imagelength, page.imagewidth, 3)[: 3 if page.samplesperpixel == 3 else 2]
    if stored.shape != want or stored.dtype.newbyteorder("=") != page.dtype.newbyteorder("="):
        raise bad_image(f"damaged TIFF: decodes to {stored.shape} of {stored.dtype}")
    return stored


@contextmanager
def _silence_opencv(cv2: Any) -> Iterator[None]:
    """Keep OpenCV from printing about a failed decoding: the exception has the cause."""
    log = cv2.utils.logging
    level = log.setLogLevel(log.LOG_LEVEL_SILENT)
    try:
        yield
    finally:
        log.setLogLevel(level)
