"""Stars in cells of a cube about the sky: those near rays, and the attitude that they agree on."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from startrack.core.types import Array, Bools, Ints
from startrack.kernels.library import kernel

FEWEST_CELLS, MOST_CELLS = 32, 64  # on a side of the cube
CELLS_OF_ROOT_1 = 0.5  # of the root of the number of stars: about one star in a cell that has some
SETTLING_ROUNDS = 10  # two or three suffice
LEAST_PAIRS = 3  # that settle an attitude
PAIRS_OF_RAY = 6  # room for them, at first


@dataclass(frozen=True)
class Neighbours:
    """Pairs of a ray and a star near it."""

    ray: Ints  # (k,) ascending
    star: Ints  # (k,)
    chord: Array  # (k,) distance on the unit sphere
    depth: int  # number of the brightest stars that were searched


class StarGrid:
    """The brightest stars of a sky, by cells."""

    def __init__(self, rays_icrs: Array) -> None:
        """Sort the stars with unit vectors `rays_icrs` (n, 3) into cells."""
        cells = int(min(max(CELLS_OF_ROOT_1 * np.sqrt(len(rays_icrs)), FEWEST_CELLS), MOST_CELLS))
        first, star = np.empty(cells**3 + 1, np.int32), np.empty(len(rays_icrs), np.int64)
        _bin_stars(np.ascontiguousarray(rays_icrs), cells, first, star)
        self._cells = cells, first, star, rays_icrs[star]

    def neighbours(self, rays_icrs: Array, chord: float) -> Neighbours:
        """All pairs of a ray (m, 3) and a star closer than the `chord`."""
        rays_icrs = np.ascontiguousarray(rays_icrs)
        room, k = -1, PAIRS_OF_RAY * len(rays_icrs)
        while k > room:
            room, pairs = k, (np.empty(k, np.int64), np.empty(k, np.int64), np.empty(k))
            k = _find_stars(rays_icrs, chord, *self._cells, *pairs)
        return Neighbours(pairs[0][:k], pairs[1][:k], pairs[2][:k], len(self._cells[-1]))


def rotation_between(cam: Array, icrs: Array, weight: Array) -> Array:
    """R_cam_icrs (3, 3) that minimises sum weight |cam - R icrs|^2 over the rays (k, 3), as `wahba` does."""
    R = np.empty((3, 3))
    _rotation_between(np.ascontiguousarray(cam), np.ascontiguousarray(icrs), weight, R)
    return R


def settle_rotation(cam: Array, icrs: Array, hit: Bools, squared_radius: float) -> tuple[Array, Bools]:
    """R_cam_icrs of the pairs that it places within the radius, and which these are (k,).

    `cam`, `icrs` (k, 3): the rays of pairs of a detection and a star. It begins with the pairs that `hit` (k,), of
    which some may be wrong.
    """
    R, hit = np.empty((3, 3)), hit.copy()
    rays = np.ascontiguousarray(cam), np.ascontiguousarray(icrs)
    _settle_rotation(*rays, squared_radius, SETTLING_ROUNDS, LEAST_PAIRS, hit, R)
    return R, hit


_bin_stars = kernel(
    "bin_stars", "rays: float64[n, 3]", "cells: int64", "first: out int32[places + 1]", "star: out int64[n]"
)
_find_stars = kernel(
    "find_stars", "rays: float64[m, 3]", "chord: float64", "cells: int64", "first: int32[places + 1]",
    "star: int64[n]", "star_rays: float64[n, 3]", "of_ray: out int64[room]", "of_star: out int64[room]",
    "apart: out float64[room]", result="int64",
)  # fmt: skip
_RAYS = ("cam: float64[n, 3]", "icrs: float64[n, 3]")
_rotation_between = kernel("rotation_between", *_RAYS, "weight: float64[n]", "R: out float64[3, 3]")
_settle_rotation = kernel(
    "settle_rotation", *_RAYS, "squared_radius: float64", "rounds: int64", "fewest: int64", "hit: out bool[n]",
    "R: out float64[3, 3]",
)  # fmt: skip
