"""Whether the noise of an exposure is that of a sensor: clipping, filtering and coarse steps show in its pixels."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from startrack.camera import Camera
from startrack.core.types import Array, Exposure, Ints
from startrack.detection.dead_parts import find_dead_parts

TILE_PX, TILES = 16, 16  # side of a sampled tile, and tiles across the image: 65,536 pixels, 2 ms
MIN_TILES = 16
CLIPPED_PART = 0.01  # of the pixels that hold the lowest value; a sensor's noise: below 0.001
MOST_EQUAL = 0.8  # part of the tiles that have one value each, the lowest, in a thresholded image
CORRELATION = 0.15  # of neighbouring pixels; at most 0.0 in rendered frames, 0.09 in a real one, 0.36 behind filters
FILTERED_CORRELATION = 0.3  # from here on the image itself is filtered, not noise added to that of the sensor
COARSE_STEPS = 0.5  # noise in steps of the values below which rounding rules
LOWEST_SIGMAS, HIGHEST_SIGMAS = 2.5, 1.0  # of the noise, for the correlation
FAR_PX = 7  # farther than any filter's kernel reaches
FEW_STARS_PERCENTILE = 25.0  # of the tiles' correlations
QUARTILE_SIGMAS = 0.6745
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
    corners = _tile_corners(exposure.recorded_adu, camera)
    tiles = _tiles_at(exposure.recorded_adu, corners)
    if len(tiles) < MIN_TILES:
        return None
    equal = np.ptp(tiles, axis=(1, 2)) == 0
    if MOST_EQUAL < equal.mean() < 1.0 and (tiles[equal] == tiles.min()).all():
        return Damage(f"the noise is removed: {100 * equal.mean():.0f} % of the image has one value", False)
    tiles = tiles[~equal]
    if len(tiles) < MIN_TILES:
        return None
    ordered = np.sort(tiles.reshape(len(tiles), -1), axis=1)
    lowest = ordered[:, 0].min()
    clipped = float(np.mean(ordered == lowest))
    middle, sigma = _middle_and_sigma(ordered)
    step = _smallest_step(ordered)
    if clipped > CLIPPED_PART and np.median(sigma) > COARSE_STEPS * step:
        return Damage(
            f"values are clipped at {lowest:g} ADU: {100 * clipped:.0f} % of the pixels hold this value", False
        )
    noisy = sigma > 0
    if np.count_nonzero(noisy) < len(tiles) / 2:
        return Damage(
            f"the noise is removed: most pixels of {100 * np.mean(~noisy):.0f} % of the image are equal", False
        )
    if exposure.correction is not None:
        tiles = _tiles_at(exposure.pixels_adu, corners[~equal])
        middle, sigma = _middle_and_sigma(np.sort(tiles.reshape(len(tiles), -1), axis=1))
        noisy &= sigma > 0
    correlation = _neighbour_correlation(tiles[noisy], middle[noisy], sigma[noisy])
    if correlation > CORRELATION:
        return Damage(
            f"the image is filtered or compressed: neighbouring pixels correlate by {correlation:.2f}",
            correlation < FILTERED_CORRELATION,
        )
    return None


def _tile_corners(pixels_adu: NDArray[np.float32], camera: Camera | None) -> Ints:
    """First pixels (n, 2), x and y, of tiles on a regular grid, without those that touch a dead part."""
    height, width = pixels_adu.shape
    if min(height, width) < 2 * TILE_PX:
        return np.empty((0, 2), dtype=np.int64)
    top, left = (np.linspace(0, n - TILE_PX, min(TILES, n // TILE_PX)).astype(int) for n in (height, width))
    corners = np.stack(np.meshgrid(left, top), axis=-1).reshape(-1, 2)
    if camera is not None:
        off_axis = [
            camera.angle_rad(corners + np.array(at) * (TILE_PX - 1.0)) for at in ((0, 0), (0, 1), (1, 0), (1, 1))
        ]
        corners = corners[np.max(off_axis, axis=0) < camera.max_angle_rad]
    dead = find_dead_parts(pixels_adu)
    return np.asarray(corners if dead is None else corners[~_tiles_at(dead, corners).any(axis=(1, 2))])


def _tiles_at(pixels: NDArray[Any], corners: Ints) -> NDArray[Any]:
    """Tiles (n, side, side) whose first pixels are `corners` (n, 2), x and y."""
    windows = np.lib.stride_tricks.sliding_window_view(pixels, (TILE_PX, TILE_PX))
    return np.asarray(windows[corners[:, 1], corners[:, 0]])


def _middle_and_sigma(ordered: NDArray[np.float32]) -> tuple[Array, Array]:
    """Middle and standard deviation of the noise (n,), (n,) by quartiles of ordered values (n, m)."""
    count = ordered.shape[1]
    sigma = (ordered[:, 3 * count // 4] - ordered[:, count // 4]) / (2 * QUARTILE_SIGMAS)
    return np.asarray(ordered[:, count // 2]), np.asarray(sigma)


def _smallest_step(ordered: NDArray[np.float32]) -> float:
    steps = np.diff(ordered[:: max(1, len(ordered) // 16)], axis=1)
    return float(steps[steps > 0].min())


def _neighbour_correlation(tiles: NDArray[np.float32], middle: Array, sigma: Array) -> float:
    """Correlation of pixels with the next ones in rows and columns: that of the tiles with few stars.

    Stars, on one side of the noise, are clipped; what pixels seven apart share (slopes) is taken out.
    """
    z = np.clip((tiles - middle[:, None, None]) / sigma[:, None, None], -LOWEST_SIGMAS, HIGHEST_SIGMAS)
    z -= z.mean(axis=(1, 2), keepdims=True)
    near, far = (_mean_products(z, shift) for shift in (1, FAR_PX))
    found = (near - far) / np.maximum(np.mean(np.square(z), axis=(1, 2)) - far, 1e-9)
    return float(np.percentile(found, FEW_STARS_PERCENTILE))


def _mean_products(z: NDArray[Any], shift: int) -> Array:
    """Mean products (n,) of pixels of tiles with those `shift` pixels on, in rows and columns."""
    across, down = z[:, :, shift:] * z[:, :, :-shift], z[:, shift:] * z[:, :-shift]
    return np.asarray(0.5 * (across.mean(axis=(1, 2)) + down.mean(axis=(1, 2))))
