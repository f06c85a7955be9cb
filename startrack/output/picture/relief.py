"""The shape of the ground as arrays for a map: heights, light and shade, and smooth edges."""

from __future__ import annotations

from typing import TYPE_CHECKING

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from startrack.core.types import Array, Bools

if TYPE_CHECKING:
    from startrack.terrain import Terrain

Image = NDArray[np.float32]
GENTLE_SLOPE = 0.02  # gentler ground looks flat


def ground_cells(
    terrain: Terrain, half_m: ArrayLike, shape: tuple[int, int], centre_m: tuple[float, float] = (0.0, 0.0)
) -> tuple[Image, Bools]:
    """Heights [m] (H, W) within `half_m` east and north of the centre, north up, and where there is ground."""
    points_m = cell_points(half_m, shape) + np.asarray(centre_m)
    known = np.asarray(terrain.allowed(points_m.reshape(-1, 2)), dtype=bool).reshape(shape)
    ground_m = np.zeros(shape, dtype=np.float32)
    ground_m[known] = terrain.ground_m(points_m[known])
    return ground_m, known


def cell_points(half_m: ArrayLike, shape: tuple[int, int]) -> Array:
    """Points (H, W, 2), east and north [m] of a map's centre, of its cells of `shape` (H, W), north up."""
    x, y = (np.linspace(-half, half, n) for half, n in zip(np.asarray(half_m), shape[::-1], strict=True))
    return np.stack(np.meshgrid(x, y[::-1]), axis=-1)


def hill_shading(ground_m: Image, known: Bools, half_m: ArrayLike) -> Image:
    """Light (H, W), 0 to 1, on cells lit from the north-west as maps are; carried some cells beyond the ground."""
    east_m, north_m = (2 * half / (n - 1) for half, n in zip(np.asarray(half_m), known.shape[::-1], strict=True))
    down, east = np.gradient(ground_m)
    facing, inner = east / east_m + down / north_m, inner_cells(known)
    steep = max(float(np.percentile(np.abs(facing[inner]), 95)) if inner.any() else 0.0, GENTLE_SLOPE)
    light = np.maximum(0.5 + 0.5 * np.tanh(1.2 * facing / steep), 0.05)
    return extrapolate_values(light.astype(np.float32), inner)


def edge_cover(known: Bools, size: tuple[int, int]) -> Array:
    """1 on known ground and 0 beside it, (H, W) of the given size (W, H), with a smooth edge."""
    soft = enlarge_image(np.asarray(cv2.GaussianBlur(known.astype(np.float32), (0, 0), 1.5)), size)
    return np.clip((soft - 0.5) * 4 + 0.5, 0, 1).astype(np.float64)


def inner_cells(known: Bools) -> Bools:
    """The mask without the cells at its edge, whose slopes would be those of a cliff that does not exist."""
    return cv2.erode(known.astype(np.uint8), np.ones((3, 3), np.uint8), borderType=cv2.BORDER_REPLICATE) > 0


def extrapolate_values(values: Image, known: Bools) -> Image:
    """Known values, carried a few cells beyond their edge."""
    filled, weight = np.where(known, values, 0).astype(np.float32), known.astype(np.float32)
    for reach in (3, 7, 15):
        near = cv2.blur(weight, (reach, reach))
        carried = cv2.blur(filled, (reach, reach)) / np.maximum(near, 1e-6)
        new = (weight == 0) & (near > 1e-6)
        filled[new], weight[new] = carried[new], 1.0
    return filled


def enlarge_image(image: Image, size: tuple[int, int]) -> Image:
    """The image, smooth, in a `size` (W, H)."""
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_CUBIC), dtype=np.float32)
