"""JPEG: read by Pillow, which refuses a truncated file.

OpenCV returns a truncated JPEG with flat grey in place of the missing part, which would look like a wall that hides
stars. Pillow does the same if an end marker follows the cut, so the picture is decoded twice (see FILLER).
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from io import BytesIO
from typing import Any

import numpy as np
from numpy.typing import NDArray

from startrack.exposure.decoding import Decoded, bad_image, check_size, exif_warnings, grey_float32, largest_value
from startrack.exposure.facts import facts_in_text

START_OF_SCAN, END_OF_IMAGE = 0xDA, b"\xff\xd9"
START_OF_SCAN_MARK = bytes((0xFF, START_OF_SCAN))
MAX_SCANS = 64  # a progressive picture has about ten
DECODED_ROWS = 512
PARAMETERLESS = {0x01, *range(0xD0, 0xD8)}  # markers without a length: TEM and the restarts
# If data are missing before the end marker, decoders fill the rest without a warning. These bytes, inserted there, show
# it: they do not change a complete picture, and become part of an incomplete one. They hold each of the eight restart
# markers, for a picture cut where it expects one.
FILLER = b"".join(bytes((37 * i + 11) % 251 for i in range(128)) + bytes((0xFF, 0xD0 + k)) for k in range(8))


def decode(raw: bytes) -> Decoded:
    """Pixels of a grey or colour JPEG, 0 to 255; metadata from its comment.

    Raises BadInput bad_image if it is truncated, damaged or CMYK.
    """
    image = _open_image(raw)
    check_size(*image.size)
    if image.mode not in ("L", "RGB"):
        raise bad_image(f"JPEG is {image.mode}; startrack reads plain grey or colour")
    if raw.count(START_OF_SCAN_MARK) > MAX_SCANS:  # each is decoded over the whole picture
        raise bad_image(f"JPEG has more than {MAX_SCANS} scans")
    end = raw.find(END_OF_IMAGE, _scan_start(raw))
    if end < 0:
        raise bad_image("truncated JPEG: the file ends before its end marker")
    stored = np.empty((image.height, image.width, 3)[: 2 if image.mode == "L" else 3], np.uint8)
    for rows, strip in _strips(image):
        stored[rows] = strip
    comment, exif = image.info.get("comment", b""), exif_warnings(image.getexif)
    del image  # a decoded picture in Pillow takes 4 bytes a pixel: never two at a time
    again = _open_image(raw[:end] + FILLER + raw[end:])
    if not all(np.array_equal(stored[rows], strip) for rows, strip in _strips(again)):
        raise bad_image("truncated JPEG: its end marker comes before the end of the picture")
    pixels, colour = grey_float32(stored)
    return Decoded(
        pixels_adu=pixels,
        saturation_adu=largest_value(stored.dtype),
        header=facts_in_text(comment.decode("utf-8", "replace") if isinstance(comment, bytes) else str(comment)),
        warnings=exif + colour,
    )


def _open_image(raw: bytes) -> Any:
    # The class itself, not Image.open: the latter's size limit is a process-wide setting, and not ours.
    from PIL.JpegImagePlugin import JpegImageFile

    return JpegImageFile(BytesIO(raw))


def _strips(image: Any) -> Iterator[tuple[slice, NDArray[np.uint8]]]:
    """Rows and pixels of the decoded picture, strip by strip: a copy of the whole would double the memory."""
    try:
        image.load()
    except OSError as error:
        raise bad_image(f"truncated or damaged JPEG: {error}") from error
    width, height = image.size
    for top in range(0, height, DECODED_ROWS):
        bottom = min(top + DECODED_ROWS, height)
        yield slice(top, bottom), np.asarray(image.crop((0, top, width, bottom)))


def _scan_start(raw: bytes) -> int:
    """Offset of the first scan; an end marker before it belongs to a thumbnail."""
    at = 2
    while at + 4 <= len(raw):
        if raw[at] != 0xFF:
            raise bad_image("damaged JPEG: a marker is missing")
        marker = raw[at + 1]
        if marker == START_OF_SCAN:
            return at
        if marker == 0xFF:  # padding
            at += 1
        elif marker in PARAMETERLESS:
            at += 2
        else:
            at += 2 + struct.unpack_from(">H", raw, at + 2)[0]
    raise bad_image("truncated JPEG: the file ends before its picture")
