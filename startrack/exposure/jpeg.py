"""JPEG: read by Pillow, the one decoder at hand that refuses a truncated file.

OpenCV returns a truncated JPEG whole, its missing part a flat grey: a wall, to a program that looks for hidden stars.
Pillow does so too where an end marker follows the cut, so the picture is decoded twice (see FILLER).
"""

from __future__ import annotations

import struct
from io import BytesIO
from typing import Any

import numpy as np
from numpy.typing import NDArray

from startrack.exposure.decoded import Decoded, check_size, exif_warnings, grey_float32, largest_value, refuse
from startrack.exposure.metadata import facts_in_text

START_OF_SCAN, END_OF_IMAGE = 0xDA, b"\xff\xd9"
PARAMETERLESS = {0x01, *range(0xD0, 0xD8)}  # markers without a length: TEM and the restarts
# Where data are missing before the end marker, decoders make up a flat rest and say nothing. Bytes put there show it:
# a complete picture is the same with them, an incomplete one takes them for its own. Restart markers, each of the
# eight, for a picture cut where it expects one.
FILLER = b"".join(bytes((37 * i + 11) % 251 for i in range(128)) + bytes((0xFF, 0xD0 + k)) for k in range(8))


def decode_jpeg(raw: bytes) -> Decoded:
    """Pixels of a grey or colour JPEG, 0..255; facts from its comment. `BadInput` if truncated, damaged or CMYK."""
    image = _open(raw)
    check_size(*image.size)
    if image.mode not in ("L", "RGB"):
        raise refuse(f"JPEG is {image.mode}; startrack reads plain grey or colour")
    end = raw.find(END_OF_IMAGE, _scan_start(raw))
    if end < 0:
        raise refuse("truncated JPEG: the file ends before its end marker")
    stored = _load(image)
    if not np.array_equal(stored, _load(_open(raw[:end] + FILLER + raw[end:]))):
        raise refuse("truncated JPEG: its end marker comes before the end of the picture")
    pixels, colour = grey_float32(stored)
    comment = image.info.get("comment", b"")
    return Decoded(
        pixels_adu=pixels,
        saturation_adu=largest_value(stored.dtype),
        header=facts_in_text(comment.decode("utf-8", "replace") if isinstance(comment, bytes) else str(comment)),
        warnings=exif_warnings(image.getexif) + colour,
    )


def _open(raw: bytes) -> Any:
    # The class itself, not Image.open: the latter's size limit is a process-wide setting, and not ours.
    from PIL.JpegImagePlugin import JpegImageFile

    return JpegImageFile(BytesIO(raw))


def _load(image: Any) -> NDArray[np.uint8]:
    try:
        image.load()
    except OSError as error:
        raise refuse(f"truncated or damaged JPEG: {error}") from error
    return np.asarray(image)


def _scan_start(raw: bytes) -> int:
    """Offset of the first scan; an end marker before it belongs to a thumbnail."""
    at = 2
    while at + 4 <= len(raw):
        if raw[at] != 0xFF:
            raise refuse("damaged JPEG: a marker is missing")
        marker = raw[at + 1]
        if marker == START_OF_SCAN:
            return at
        if marker == 0xFF:  # padding
            at += 1
        elif marker in PARAMETERLESS:
            at += 2
        else:
            at += 2 + struct.unpack_from(">H", raw, at + 2)[0]
    raise refuse("truncated JPEG: the file ends before its picture")
