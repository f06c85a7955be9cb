"""Pairs of the sky's brightest stars: for frames with too few stars for triangles of neighbours."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from startrack.identify.index import bright_stars_apart
from startrack.types import Array, Ints, Stars

PAIRS_WANTED = 180_000
DEEPEST = 5000
NARROWEST_RAD = np.radians(8.0)  # closer pairs fix the roll poorly; less in small fields
WIDEST_RAD = np.radians(110.0)


@dataclass(frozen=True)
class PairIndex:
    """Pairs of bright stars, by separation."""

    star: Ints  # (m,) indices of the stars in Stars
    rays_icrs: Array  # (m, 3)
    pairs: Ints  # (k, 2) indices into rays_icrs
    sides_rad: Array  # (k,) ascending
    narrowest_rad: float
    widest_rad: float

    def candidates(self, rays_cam: Array, tolerance_rad: float) -> tuple[Ints, Ints]:
        """Pairs of the rays (n, 3) and of the catalogue (c, 2), (c, 2) whose sides agree, in both orders."""
        i, j = np.triu_indices(len(rays_cam), 1)
        side = _angle(rays_cam[i], rays_cam[j])
        wide = (side > self.narrowest_rad) & (side < self.widest_rad)
        i, j, side = i[wide], j[wide], side[wide]
        first = np.searchsorted(self.sides_rad, side - tolerance_rad)
        count = np.searchsorted(self.sides_rad, side + tolerance_rad) - first
        own = np.repeat(np.arange(len(i)), count)
        at = np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count) + np.repeat(first, count)
        image = np.stack([i[own], j[own]], axis=1)
        catalogue = self.pairs[at]
        return np.concatenate([image, image]), np.concatenate([catalogue, catalogue[:, ::-1]])


def build_pairs(stars: Stars, field_sr: float) -> PairIndex:
    """Pairs no wider than the field, of as many bright stars as keep their number at bay."""
    diameter = 2 * np.arccos(np.clip(1 - field_sr / (2 * np.pi), -1, 1))
    widest = min(WIDEST_RAD, float(diameter))
    narrowest = min(NARROWEST_RAD, widest / 4)
    within = 0.5 * (1 - np.cos(widest))  # part of the sphere that a star's partners come from
    star = bright_stars_apart(stars, int(min(np.sqrt(2 * PAIRS_WANTED / within), DEEPEST)))
    rays = stars.rays_icrs[star]
    i, j = _close(rays, widest)
    side = _angle(rays[i], rays[j])
    order = np.argsort(side)
    order = order[np.searchsorted(side[order], narrowest) :]
    return PairIndex(star, rays, np.stack([i[order], j[order]], axis=1), side[order], narrowest, widest)


def _close(rays: Array, widest_rad: float) -> tuple[Ints, Ints]:
    from scipy.spatial import cKDTree

    pairs = cKDTree(rays).query_pairs(2 * np.sin(widest_rad / 2), output_type="ndarray").astype(np.int64)
    return pairs[:, 0], pairs[:, 1]


def _angle(a: Array, b: Array) -> Array:
    return np.arctan2(np.linalg.norm(np.cross(a, b), axis=1), np.einsum("ni,ni->n", a, b))
