"""Stars in cells of a cube about the sky, and kernels that find those near rays and the attitude that they agree on."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from startrack.core.kernels import njit, read_only
from startrack.core.types import Array, Ints

FEWEST_CELLS, MOST_CELLS = 32, 64  # on a side of the cube
CELLS_OF_ROOT_1 = 0.5  # of the root of the number of stars: about one star in a cell that has some
SETTLING_ROUNDS = 10  # two or three suffice
LEAST_PAIRS = 3  # that settle an attitude
PAIRS_OF_RAY = 6  # room for them, at first
NEWTON_STEPS = 30  # three suffice where most pairs are right
EQUAL_1 = 1e-15


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
        """`rays_icrs` (n, 3): unit vectors."""
        cells = int(min(max(CELLS_OF_ROOT_1 * np.sqrt(len(rays_icrs)), FEWEST_CELLS), MOST_CELLS))
        first, star = bin_stars(read_only(rays_icrs), cells)
        self._cells = cells, first, star, rays_icrs[star]

    def neighbours(self, rays_icrs: Array, chord: float) -> Neighbours:
        """All pairs of a ray (m, 3) and a star closer than the `chord`."""
        room, k = -1, PAIRS_OF_RAY * len(rays_icrs)
        while k > room:
            room, pairs = k, (np.empty(k, np.int64), np.empty(k, np.int64), np.empty(k))
            k = find_stars(rays_icrs, chord, *self._cells, *pairs)
        return Neighbours(pairs[0][:k], pairs[1][:k], pairs[2][:k], len(self._cells[-1]))


@njit(cache=True)
def bin_stars(rays, cells):  # type: ignore[no-untyped-def]
    """The begin of each cell (`cells`^3 + 1,) in the list of stars (n,) by cells, which keeps their order."""
    cell = np.empty(len(rays), np.int64)
    first = np.zeros(cells**3 + 1, np.int32)
    for i in range(len(rays)):
        row = _cell_of(rays[i, 0], cells) * cells + _cell_of(rays[i, 1], cells)
        cell[i] = row * cells + _cell_of(rays[i, 2], cells)
        first[cell[i] + 1] += 1
    for c in range(cells**3):
        first[c + 1] += first[c]
    free = first.copy()
    star = np.empty(len(rays), np.int64)
    for i in range(len(rays)):
        star[free[cell[i]]] = i
        free[cell[i]] += 1
    return first, star


@njit(cache=True)
def find_stars(rays, chord, cells, first, star, star_rays, of_ray, of_star, apart):  # type: ignore[no-untyped-def]
    """The number k of pairs of a ray (m, 3) and a star closer than the chord; see `bin_stars`.

    Ray, star and distance of each are written to `of_ray`, `of_star` and `apart` (size,), as far as they have room.
    """
    k = 0
    for i in range(len(rays)):
        x, y, z = rays[i, 0], rays[i, 1], rays[i, 2]
        low, high = _cell_of(z - chord, cells), _cell_of(z + chord, cells) + 1
        for cx in range(_cell_of(x - chord, cells), _cell_of(x + chord, cells) + 1):
            for cy in range(_cell_of(y - chord, cells), _cell_of(y + chord, cells) + 1):
                row = (cx * cells + cy) * cells
                for at in range(first[row + low], first[row + high]):
                    dx, dy, dz = star_rays[at, 0] - x, star_rays[at, 1] - y, star_rays[at, 2] - z
                    squared = dx * dx + dy * dy + dz * dz
                    if squared < chord * chord:
                        if k < len(apart):
                            of_ray[k], of_star[k], apart[k] = i, star[at], np.sqrt(squared)
                        k += 1
    return k


@njit(inline="always")
def _cell_of(coordinate, cells):  # type: ignore[no-untyped-def]
    """Number of a cell along one side of the cube."""
    return min(max(int((coordinate + 1.0) * (0.5 * cells)), 0), cells - 1)


@njit(cache=True)
def rotation_between(cam, icrs, weight):  # type: ignore[no-untyped-def]
    """R_cam_icrs (3, 3) that minimises sum weight |cam - R icrs|^2 over the rays (k, 3), as `wahba` does."""
    profile, total = np.zeros((3, 3)), 0.0
    for i in range(len(cam)):
        total += weight[i]
        for a in range(3):
            for b in range(3):
                profile[a, b] += weight[i] * cam[i, a] * icrs[i, b]
    return _rotation_of(profile, total)


@njit(cache=True)
def settle_rotation(cam, icrs, hit, squared_radius):  # type: ignore[no-untyped-def]
    """R_cam_icrs of the pairs that it places within the radius, and which these are (k,).

    `cam`, `icrs` (k, 3): the rays of pairs of a detection and a star. It begins with the pairs that `hit` (k,), of
    which some may be wrong.
    """
    R, weight = np.zeros((3, 3)), np.empty(len(cam))
    for a in range(3):
        R[a, a] = 1.0
    for _ in range(SETTLING_ROUNDS):
        hits = 0
        for i in range(len(cam)):
            weight[i] = 1.0 if hit[i] else 0.0  # a second type of weights would be compiled by itself
            hits += hit[i]
        if hits < LEAST_PAIRS:
            break
        R, same, now = rotation_between(cam, icrs, weight), True, np.empty(len(cam), np.bool_)
        for i in range(len(cam)):
            squared = 0.0
            for a in range(3):
                off = cam[i, a] - R[a, 0] * icrs[i, 0] - R[a, 1] * icrs[i, 1] - R[a, 2] * icrs[i, 2]
                squared += off * off
            now[i] = squared < squared_radius
            same &= now[i] == hit[i]
        hit = now
        if same:
            break
    return R, hit


@njit(inline="always")
def _rotation_of(B, sum_of_weights):  # type: ignore[no-untyped-def]
    """The rotation R (3, 3) that maximises trace(R^T B), which is at most the `sum_of_weights`.

    Source: Markley 1993, J. Astronaut. Sci. 41, 261 (FOAM).
    """
    cofactor, norm, cofactor_norm = np.empty((3, 3)), 0.0, 0.0
    for a in range(3):
        c, d = (a + 1) % 3, (a + 2) % 3
        for b in range(3):
            e, f = (b + 1) % 3, (b + 2) % 3
            cofactor[a, b] = B[c, e] * B[d, f] - B[c, f] * B[d, e]
            norm += B[a, b] ** 2
            cofactor_norm += cofactor[a, b] ** 2
    determinant = B[0, 0] * cofactor[0, 0] + B[0, 1] * cofactor[0, 1] + B[0, 2] * cofactor[0, 2]
    trace = sum_of_weights
    for _ in range(NEWTON_STEPS):  # from above, where the quartic has its largest root
        over = trace * trace - norm
        slope = 4.0 * trace * over - 8.0 * determinant
        step = (over * over - 8.0 * trace * determinant - 4.0 * cofactor_norm) / slope if slope > 0.0 else 0.0
        trace -= step
        if abs(step) < EQUAL_1 * trace:
            break
    half = 0.5 * (trace * trace - norm)
    R, divisor = np.empty((3, 3)), half * trace - determinant
    for a in range(3):
        for b in range(3):
            cubic = 0.0
            for c in range(3):
                for d in range(3):
                    cubic += B[a, c] * B[d, c] * B[d, b]
            R[a, b] = ((half + norm) * B[a, b] + trace * cofactor[a, b] - cubic) / divisor
    return R
