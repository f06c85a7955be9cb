"""The shape of the ground on a map: light and shade, and contours with their heights."""

from __future__ import annotations

from typing import TYPE_CHECKING

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from startrack.core.types import Array, Bools
from startrack.output.picture.canvas import CAPTION_SIZE, DIM_INK, FLOOR, INK, MAP, SHIFT_BITS, Canvas, box_around

if TYPE_CHECKING:
    from startrack.output.picture.maps import MapView
    from startrack.terrain import Terrain

Image = NDArray[np.float32]
RELIEF_CELL_PX = 2  # the ground is computed at every second pixel
GENTLE_SLOPE = 0.02  # gentler ground looks flat
RELIEF_LIGHT = 3.0  # slopes that face the light, as a multiple of the floor's colour
MAX_LEVELS = 12.0
CONTOUR_WEIGHT = 0.45
LABEL_SIZE = CAPTION_SIZE - 2.0
LABELLED_PX = 90  # shorter contours get no label, those of twice the length and more two
LABEL_TRIES = 60  # places along a contour


def ground_of_view(view: MapView, terrain: Terrain, shape: tuple[int, int]) -> tuple[Image, Bools]:
    """Heights [m] of a `terrain` at the cells of a map `view` of `shape` (H, W) pixels, and where there is ground."""
    cells = max(2, shape[0] // RELIEF_CELL_PX), max(2, shape[1] // RELIEF_CELL_PX)
    return ground_cells(terrain, view.half_m, cells, view.centre_m)


def ground_cells(
    terrain: Terrain, half_m: ArrayLike, shape: tuple[int, int], centre_m: tuple[float, float] = (0.0, 0.0)
) -> tuple[Image, Bools]:
    """Heights [m] (H, W) within `half_m` east and north of the centre, north up, and where there is ground."""
    x, y = (np.linspace(-half, half, n) for half, n in zip(np.asarray(half_m), shape[::-1], strict=True))
    points_m = np.stack(np.meshgrid(x, y[::-1]), axis=-1).reshape(-1, 2) + np.asarray(centre_m)
    known = np.asarray(terrain.allowed(points_m), dtype=bool)
    ground_m = np.zeros(len(known), dtype=np.float32)
    ground_m[known] = terrain.ground_m(points_m[known])
    return ground_m.reshape(shape), known.reshape(shape)


def hill_shading(ground_m: Image, known: Bools, half_m: ArrayLike) -> Image:
    """Light (H, W), 0 to 1, on cells lit from the north-west as maps are; carried some cells beyond the ground."""
    east_m, north_m = (2 * half / (n - 1) for half, n in zip(np.asarray(half_m), known.shape[::-1], strict=True))
    down, east = np.gradient(ground_m)
    facing, inner = east / east_m + down / north_m, _erode(known)
    steep = max(float(np.percentile(np.abs(facing[inner]), 95)) if inner.any() else 0.0, GENTLE_SLOPE)
    light = np.maximum(0.5 + 0.5 * np.tanh(1.2 * facing / steep), 0.05)
    return extrapolate(light.astype(np.float32), inner)


def edge_cover(known: Bools, size: tuple[int, int]) -> Array:
    """1 on known ground and 0 beside it, (H, W) of the given size (W, H), with a smooth edge."""
    soft = _resize(np.asarray(cv2.GaussianBlur(known.astype(np.float32), (0, 0), 1.5)), size)
    return np.clip((soft - 0.5) * 4 + 0.5, 0, 1).astype(np.float64)


def draw_relief(window: Canvas, view: MapView, ground_m: Image, known: Bools) -> None:
    """The relief; the map's colour where there is no ground."""
    size = window.size
    lit = (_resize(hill_shading(ground_m, known, view.half_m), size) * edge_cover(known, size))[:, :, None]
    window.pixels[:] = (np.array(MAP) + lit * (RELIEF_LIGHT * np.array(FLOOR) - MAP)).astype(np.uint8)


def draw_contours(canvas: Canvas, window: Canvas, view: MapView, ground_m: Image, known: Bools) -> float | None:
    """Contours of `ground_m` where it is `known`, with their heights [m]; their step [m], or None of flat ground.

    Lines are drawn on the `window` that the `view` fills, heights are written on the whole `canvas`.
    """
    inner = _erode(known)
    if not inner.any():
        return None
    low, high = float(ground_m[inner].min()), float(ground_m[inner].max())
    if high - low < 1.0:
        return None
    from skimage.measure import find_contours

    step_m = _contour_step_m(high - low)
    fine = _resize(extrapolate(ground_m, known), window.size)
    inside = edge_cover(inner, window.size) > 0.5
    cover, left_top = np.zeros(fine.shape, dtype=np.uint8), np.array(view.box[:2])
    for number in np.arange(np.floor(low / step_m) + 1, np.ceil(high / step_m)):
        lines = [line[:, ::-1] for line in find_contours(fine, number * step_m, mask=inside)]
        fixed = [np.rint(line * 2**SHIFT_BITS).astype(np.int32) for line in lines]
        cv2.polylines(cover, fixed, False, 255, 1, cv2.LINE_AA, SHIFT_BITS)
        for line in lines:
            _label_contour(canvas, view, line + left_top, f"{number * step_m + 0.0:g}")
    weight = (CONTOUR_WEIGHT / 255 * cover)[:, :, None]
    window.pixels[:] = (window.pixels + weight * (np.array(DIM_INK) - window.pixels)).astype(np.uint8)
    return step_m


def _label_contour(canvas: Canvas, view: MapView, line: Array, text: str) -> None:
    """Write a height on its contour (n, 2) on the canvas, once or twice, where there is room."""
    left, top, right, bottom = view.box
    length_px = float(np.hypot(*np.diff(line, axis=0).T).sum())
    at = line[:: max(1, len(line) // LABEL_TRIES)]
    half_px = 0.36 * LABEL_SIZE * len(text) + 8.0
    at = at[(np.abs(at - view.middle) < np.array([right - left, bottom - top]) / 2 - half_px - 6.0).all(axis=1)]
    for _ in range(min(2, int(length_px / LABELLED_PX))):
        free = [place for place in at if canvas.is_free(box_around(place, half_px))]
        if not free:
            return
        # North-east of the middle first, then as far from there as the contour goes.
        x, y = free[int(np.argmax([place[0] - place[1] for place in free]))]
        canvas.text((x, y), text, LABEL_SIZE, INK, "mm", halo=True)
        at = at[np.hypot(*(at - (x, y)).T) > 0.4 * (right - left)]


def _contour_step_m(range_m: float) -> float:
    """The smallest of 1, 2, 5 times a power of ten that leaves no more than MAX_LEVELS contours."""
    power = 10.0 ** np.floor(np.log10(range_m / MAX_LEVELS))
    return float(next(m for m in (1.0, 2.0, 5.0, 10.0) if m * power * MAX_LEVELS >= range_m) * power)


def _erode(known: Bools) -> Bools:
    """The mask without the cells at its edge, whose slopes would be those of a cliff that does not exist."""
    return cv2.erode(known.astype(np.uint8), np.ones((3, 3), np.uint8), borderType=cv2.BORDER_REPLICATE) > 0


def extrapolate(values: Image, known: Bools) -> Image:
    """Known values, carried a few cells beyond their edge."""
    filled, weight = np.where(known, values, 0).astype(np.float32), known.astype(np.float32)
    for reach in (3, 7, 15):
        near = cv2.blur(weight, (reach, reach))
        carried = cv2.blur(filled, (reach, reach)) / np.maximum(near, 1e-6)
        new = (weight == 0) & (near > 1e-6)
        filled[new], weight[new] = carried[new], 1.0
    return filled


def _resize(image: Image, size: tuple[int, int]) -> Image:
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_CUBIC), dtype=np.float32)
