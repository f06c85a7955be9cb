"""Layers of the annotated picture, in private chunks of its PNG: the exposure without marks, the marks as coordinates.

Other programs skip these chunks. The HTML page draws the marks over the exposure at any magnification.
"""

from __future__ import annotations

import json
import zlib
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from startrack.core.errors import BadInput
from startrack.exposure.png import IHDR_END, chunk, chunks

PICTURE, OVERLAY = b"stPX", b"stOV"  # a JPEG; compressed JSON
JPEG_QUALITY = 88  # 270 kB of 1400 x 1400 px, in 10 ms; WebP has 150 kB and takes 200 ms


@dataclass(frozen=True)
class Layers:
    """The exposure (H, W, 3), red, green, blue, and the marks of `overlay_of`."""

    bare: NDArray[np.uint8]
    overlay: dict[str, Any]


def add_layers(png: bytes, layers: Layers) -> bytes:
    """The PNG file with the layers before its picture data."""
    ok, jpeg = cv2.imencode(".jpg", layers.bare[:, :, ::-1], [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
    if not ok:
        raise RuntimeError("OpenCV could not encode the picture as JPEG")
    text = json.dumps(layers.overlay, ensure_ascii=False, allow_nan=False, separators=(",", ":"))
    parts = chunk(PICTURE, jpeg.tobytes()) + chunk(OVERLAY, zlib.compress(text.encode("utf-8")))
    return png[:IHDR_END] + parts + png[IHDR_END:]


def layers_of(png: bytes) -> Layers | None:
    """The layers of a PNG file; None where it has none, or is damaged."""
    try:
        found = {kind: body for kind, body in chunks(png) if kind in (PICTURE, OVERLAY)}
    except BadInput:  # the page shows what there is
        return None
    if len(found) < 2:
        return None
    bare = cv2.imdecode(np.frombuffer(found[PICTURE], np.uint8), cv2.IMREAD_COLOR)
    overlay = json.loads(zlib.decompress(found[OVERLAY]))
    return None if bare is None else Layers(np.asarray(bare[:, :, ::-1], dtype=np.uint8), overlay)
