"""Whether the noise of an exposure is that of a sensor: clipping, filtering and coarse steps show in its pixels."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from startrack.camera import Camera
from startrack.core.statistics import NORMAL_BY_MEDIAN
from startrack.core.types import Array, Exposure, Ints
from startrack.detection.background import BLOCK_PX
from startrack.detection.unusable import MOST_EQUAL, find_dead_parts

TILES = 16  # of BLOCK_PX across the image, and the least number of tiles that tell: 65,536 pixels, 2 ms
CLIPPED_PART = 0.01  # of the pixels that hold the lowest value; a sensor's noise: below 0.001
CORRELATION = 0.15  # of neighbouring pixels; at most 0.0 in rendered frames, 0.09 in a real one, 0.36 behind filters
FILTERED_CORRELATION = 2 * CORRELATION  # from here on the image itself is filtered, not noise added to the sensor's
COARSE_STEPS = 0.5  # noise in steps of the values below which rounding rules
LOWEST_SIGMAS, HIGHEST_SIGMAS = 2.5, 1.0  # of the noise, for the correlation
FAR_PX = 7  # farther than any filter's kernel reaches
FEW_STARS_PERCENTILE = 25.0  # of the tiles' correlations
ORIGINAL = "give the frame as the sensor recorded it"


@dataclass(frozen=True)
class Damage:
    """What processing did to the noise of an exposure."""

    cause: str  # in words, with a number
    has_levels: bool  # the levels of extended light, and their errors, are as the pixels show them

    @property
    def message(self) -> str:
        """The cause and what to give instead, one line."""
        return f"{self.cause}; {ORIGINAL}"


def find_damage(exposure: Exposure, camera: Camera | None = None) -> Damage | None:
    """The damage that shows in tiles of an `exposure` within the image circle of a `camera`; None: none shows.

    Tiles of one value (a masked border, a dead part) are left out, unless nearly all are. Clipping shows in the counts
    as recorded, filtering in the counts corrected by dark frame and flat field, whose patterns are no noise.
    """
    if min(exposure.size_px) < 2 * BLOCK_PX:
        return None
    corners = _tile_corners(exposure.recorded_adu, camera)
    tiles = _tiles_at(exposure.recorded_adu, corners)
    equal = np.ptp(tiles, axis=(1, 2)) == 0
    if len(tiles) >= TILES and MOST_EQUAL < equal.mean() < 1.0 and (tiles[equal] == tiles.min()).all():
        return Damage(f"the noise is removed: {100 * equal.mean():.0f} % of the image has one value", False)
    tiles, corners = tiles[~equal], corners[~equal]
    if len(tiles) < TILES:
        return None
    ordered, middle, sigma = _order_values(tiles)
    lowest = ordered[:, 0].min()
    clipped = float(np.mean(ordered == lowest))
    steps = np.diff(ordered[:: max(1, len(ordered) // 16)], axis=1)
    if clipped > CLIPPED_PART and np.median(sigma) > COARSE_STEPS * steps[steps > 0].min():
        cause = f"values are clipped at {lowest:g} ADU: {100 * clipped:.0f} % of the pixels hold this value"
        return Damage(cause, False)
    noisy = sigma > 0
    if np.count_nonzero(noisy) < len(tiles) / 2:
        cause = f"the noise is removed: most pixels of {100 * np.mean(~noisy):.0f} % of the image are equal"
        return Damage(cause, False)
    if exposure.correction is not None:
        tiles = _tiles_at(exposure.pixels_adu, corners)
        _, middle, sigma = _order_values(tiles)
        noisy &= sigma > 0
    correlation = _neighbour_correlation(tiles[noisy], middle[noisy], sigma[noisy])
    if correlation > CORRELATION:
        cause = f"the image is filtered or compressed: neighbouring pixels correlate by {correlation:.2f}"
        return Damage(cause, correlation < FILTERED_CORRELATION)
    return None


def _tile_corners(pixels_adu: NDArray[np.float32], camera: Camera | None) -> Ints:
    """First pixels (n, 2), x and y, of tiles on a regular grid, without those that touch a dead part."""
    height, width = pixels_adu.shape
    top, left = (np.linspace(0, n - BLOCK_PX, min(TILES, n // BLOCK_PX)).astype(int) for n in (height, width))
    corners = np.stack(np.meshgrid(left, top), axis=-1).reshape(-1, 2)
    if camera is not None:
        ends = np.array([(0, 0), (0, 1), (1, 0), (1, 1)]) * (BLOCK_PX - 1.0)
        corners = corners[camera.angle_rad(corners[:, None] + ends).max(axis=1) < camera.max_angle_rad]
    dead = find_dead_parts(pixels_adu)
    return np.asarray(corners if dead is None else corners[~_tiles_at(dead, corners).any(axis=(1, 2))])


def _tiles_at(pixels: NDArray[Any], corners: Ints) -> NDArray[Any]:
    """Tiles (n, side, side) whose first pixels are `corners` (n, 2), x and y."""
    windows = np.lib.stride_tricks.sliding_window_view(pixels, (BLOCK_PX, BLOCK_PX))
    return np.asarray(windows[corners[:, 1], corners[:, 0]])


def _order_values(tiles: NDArray[np.float32]) -> tuple[NDArray[np.float32], Array, Array]:
    """Values (n, m) of each tile in order, their middle (n,), and the sigma (n,) of the noise by their quartiles."""
    ordered = np.sort(tiles.reshape(len(tiles), -1), axis=1)
    low, middle, high = (ordered[:, k * BLOCK_PX**2 // 4] for k in (1, 2, 3))
    return ordered, np.asarray(middle), np.asarray(0.5 * NORMAL_BY_MEDIAN * (high - low))


def _neighbour_correlation(tiles: NDArray[np.float32], middle: Array, sigma: Array) -> float:
    """Correlation of pixels with the next ones in rows and columns: that of the tiles with few stars.

    Stars, on one side of the noise, are clipped; what pixels seven apart share (slopes) is taken out.
    """
    z = np.clip((tiles - middle[:, None, None]) / sigma[:, None, None], -LOWEST_SIGMAS, HIGHEST_SIGMAS)
    z -= z.mean(axis=(1, 2), keepdims=True)
    near, far = (
        0.5 * ((z[:, :, d:] * z[:, :, :-d]).mean(axis=(1, 2)) + (z[:, d:] * z[:, :-d]).mean(axis=(1, 2)))
        for d in (1, FAR_PX)
    )
    found = (near - far) / np.maximum(np.mean(np.square(z), axis=(1, 2)) - far, 1e-9)
    return float(np.percentile(found, FEW_STARS_PERCENTILE))
