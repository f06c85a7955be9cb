"""The annotated picture as a page shows it: the sky without its panel, as a small file, and where its pixels lie."""

from __future__ import annotations

import base64
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from startrack.camera import load_camera
from startrack.output.picture.backdrop import fitted
from startrack.output.picture.panel import PANEL_WIDTH
from startrack.types import BadInput

CARD = 80  # bytes of a line of a FITS header
QUALITY = 82


def picture_of(picture: Path, wcs: Path, record: dict[str, Any], longest_px: int) -> dict[str, Any] | None:
    """`src` (a data URI), `width`, `height` [px of the picture], and, where the image's size is known, `scale`.

    The image's pixel (x, y) lies at scale (x + 1/2), scale (y + 1/2) from the picture's top-left corner. None without a
    picture.
    """
    import cv2

    data = np.frombuffer(picture.read_bytes(), dtype=np.uint8) if picture.is_file() else np.empty(0, np.uint8)
    whole = cv2.imdecode(data, cv2.IMREAD_COLOR) if data.size else None
    if whole is None or whole.shape[1] <= PANEL_WIDTH:
        return None
    size_px = image_size(wcs, record)
    sky, known = _sky(np.asarray(whole, dtype=np.uint8), size_px)
    shrink = min(1.0, longest_px / max(sky.shape[:2]))
    if shrink < 1:
        size = tuple(max(1, round(n * shrink)) for n in sky.shape[1::-1])
        sky = np.asarray(cv2.resize(sky, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)
    shown = {"src": data_uri(sky), "width": sky.shape[1], "height": sky.shape[0]}
    return {**shown, "scale": round(sky.shape[1] / size_px[0], 6)} if known and size_px is not None else shown


def image_size(wcs: Path, record: dict[str, Any]) -> tuple[int, int] | None:
    """Width and height of the image [px]: from NAME.wcs, the record's camera, or the camera file; None if unknown."""
    if wcs.is_file():
        cards = wcs.read_bytes().decode("ascii", "replace")
        found = {cards[k : k + 8].strip(): cards[k + 10 : k + 30].strip() for k in range(0, len(cards), CARD)}
        if found.get("IMAGEW", "").isdigit() and found.get("IMAGEH", "").isdigit():
            return int(found["IMAGEW"]), int(found["IMAGEH"])
    provenance = record.get("provenance")
    camera = record.get("camera")
    if isinstance(camera, dict) and isinstance(camera.get("size_px"), list) and len(camera["size_px"]) == 2:
        return int(camera["size_px"][0]), int(camera["size_px"][1])
    name = provenance.get("camera") if isinstance(provenance, dict) else None
    if not isinstance(name, str):
        return None
    try:
        return load_camera(name).size_px
    except BadInput:  # its file is not here: the picture is shown without stars to point at
        return None


def data_uri(pixels: NDArray[np.uint8]) -> str:
    """A picture (H, W, 3), blue first, or (H, W, 4) with its cover, as a WebP data URI: a fifth of the PNG."""
    import cv2

    ok, data = cv2.imencode(".webp", pixels, [cv2.IMWRITE_WEBP_QUALITY, QUALITY])
    if not ok:
        raise RuntimeError("OpenCV could not encode the picture as WebP")
    return f"data:image/webp;base64,{base64.b64encode(data.tobytes()).decode('ascii')}"


def _sky(whole: NDArray[np.uint8], size_px: tuple[int, int] | None) -> tuple[NDArray[np.uint8], bool]:
    """The part of the annotated picture that shows the exposure, and whether it is exactly that part."""
    left = whole[:, : whole.shape[1] - PANEL_WIDTH]
    if size_px is None:
        return left, False
    _, (width, height) = fitted(size_px)
    if width != left.shape[1] or height > left.shape[0]:
        return left, False
    top = (left.shape[0] - height) // 2
    return left[top : top + height], True
