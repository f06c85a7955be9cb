"""How far the ground leaves the surface between the posts of a height map: told by the map itself, made coarser."""

from __future__ import annotations

import numpy as np

from startrack.terrain.heightmap import HeightMap
from startrack.types import Array

LEAST_M = 0.1
SMOOTH = 0.5  # natural ground is no smoother: errors fall with the distance of the posts, not with its square
FEWEST_POSTS = 9  # a side


def error_between_posts_m(height_map: HeightMap) -> float:
    """RMS error [m] of the ground midway between posts, where it is bilinear in the map and is not in truth.

    With every other post left out, the posts left out tell the error of a grid twice as coarse; with three of four
    left out that of one four times as coarse; their ratio carries it on to the grid itself.
    """
    h = height_map.heights_m.astype(np.float64)
    if min(h.shape) < FEWEST_POSTS:
        rows, columns = (np.diff(h, axis=axis) for axis in (0, 1))
        return max(float(np.sqrt(0.5 * (np.nanmean(rows**2) + np.nanmean(columns**2)))), LEAST_M)
    twice, four_times = _left_out_rms(h), _left_out_rms(h[::2, ::2])
    falls = float(np.clip(twice / max(four_times, 1e-9), SMOOTH, 1.0))
    return max(twice * falls, LEAST_M)


def _left_out_rms(h: Array) -> float:
    """RMS [m] of the posts midway in rows, in columns and in cells of every other post (r, c), against these."""
    h = h[: len(h) - 1 + len(h) % 2, : h.shape[1] - 1 + h.shape[1] % 2]
    kept = h[::2, ::2]
    across, down = 0.5 * (kept[:, 1:] + kept[:, :-1]), 0.5 * (kept[1:] + kept[:-1])
    middle = 0.5 * (across[1:] + across[:-1])
    off = [h[::2, 1::2] - across, h[1::2, ::2] - down, h[1::2, 1::2] - middle]
    return float(np.sqrt(np.nanmean(np.concatenate([np.ravel(o) for o in off]) ** 2)))
