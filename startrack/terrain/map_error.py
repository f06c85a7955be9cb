"""How far the ground leaves the surface between the posts of a height map: told by the map itself, made coarser."""

from __future__ import annotations

import numpy as np

from startrack.terrain.map_resolution import carried_spacing
from startrack.terrain.raster import Raster
from startrack.types import Array, BadInput

LEAST_M = 0.1
SMOOTH = 0.5  # natural ground is no smoother: errors fall with the distance of the posts, not with its square
SMOOTHEST = 0.25  # a curve without any roughness: errors fall with the square
FEWEST_POSTS = 9  # a side
ALMOST = 0.25  # octaves: a spacing is known no better


def error_between_posts_m(height_map: Raster, spacing: float | None = None) -> float:
    """RMS error [m] of the ground midway between posts, where it is bilinear in the map and is not in truth.

    With every other post left out, the posts left out tell the error of a grid twice as coarse; with three of four
    left out that of one four times as coarse; their ratio carries it on to the grid itself. A map that was interpolated
    from posts further apart (`spacing` of them, in posts; None: `carried_spacing`) is judged as those are. Raises
    BadInput bad_terrain where there are no heights.
    """
    h = height_map.heights_m.astype(np.float64)
    if not np.isfinite(h).any():
        raise BadInput("bad_terrain", f"{height_map.source or 'the map'}: no post has a height here: give another map")
    if min(h.shape) < FEWEST_POSTS:
        steps = np.concatenate([np.ravel(np.diff(h, axis=axis)) for axis in (0, 1)])
        return max(_rms(steps), LEAST_M)
    apart = carried_spacing(h) if spacing is None else spacing
    if apart > 1:
        return max(_error_of_posts_further_apart(h, apart), LEAST_M)
    twice, four_times = _left_out_rms(h), _left_out_rms(h[::2, ::2])
    falls = float(np.clip(twice / max(four_times, 1e-9), SMOOTH, 1.0))
    return max(twice * falls, LEAST_M)


def _error_of_posts_further_apart(h: Array, apart: float) -> float:
    """RMS error [m] of a surface drawn smoothly through posts `apart` times as far from each other as the map's.

    The finest levels hold nothing but that surface; so the posts left out are asked at the first coarser one.
    """
    level = max(int(np.ceil(np.log2(apart) - ALMOST)), 0)
    step = 2**level
    # where among the map's posts the true ones stand is not known: between them the surface is too smooth
    shifted = [h[k::step, k::step] for k in range(step)]
    twice, four_times = max(
        (_left_out_rms(part, cubic=True), _left_out_rms(part[::2, ::2], cubic=True)) for part in shifted
    )
    falls = float(np.clip(twice / max(four_times, 1e-9), SMOOTHEST, 1.0))
    return float(twice * falls ** np.log2(2 * step / apart))


def _left_out_rms(h: Array, cubic: bool = False) -> float:
    """RMS [m] of the posts midway in rows, in columns and in cells of every other post (r, c), against these.

    Midway bilinear, or with `cubic` on the cubic through four posts.
    """
    h = h[: len(h) - 1 + len(h) % 2, : h.shape[1] - 1 + h.shape[1] % 2]
    kept, midway = h[::2, ::2], _midway_cubic if cubic else _midway
    down, across = midway(kept), midway(kept.T).T
    middle = midway(across)
    inner = slice(3, -3, 2) if cubic else slice(1, None, 2)
    off = [h[::2, inner] - across, h[inner, ::2] - down, h[inner, inner] - middle]
    return _rms(np.concatenate([np.ravel(o) for o in off]))


def _midway(h: Array) -> Array:
    return np.asarray(0.5 * (h[1:] + h[:-1]))


def _midway_cubic(h: Array) -> Array:
    return np.asarray((9 * (h[1:-2] + h[2:-1]) - h[:-3] - h[3:]) / 16)


def _rms(values: Array) -> float:
    """Of those that are known; 0 where none is."""
    known = values[np.isfinite(values)]
    return float(np.sqrt(np.mean(known**2))) if known.size else 0.0
