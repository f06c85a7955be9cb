"""Triangles assembled from pairs of catalogue stars, for frames with so few stars that no indexed triangle fits.

Each pair of a pivot and another detection is compared with the catalogue's pairs of equal length. Two such pairs with
the same catalogue star at the pivot form a triangle if their other ends are as far apart as in the image.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from startrack.core.types import Array, Ints, Stars
from startrack.identification.index import separate_bright_stars

PAIRS_WANTED = 180_000
DEEPEST = 5000
WIDEST_RAD = np.radians(110.0)
NARROWEST_FRACTION = 0.07  # of the widest; closer pairs determine the roll poorly


@dataclass(frozen=True)
class PairIndex:
    """Pairs of bright stars, by separation; both orders of each."""

    rays_icrs: Array  # (m, 3)
    pairs: Ints  # (k, 2) indices into rays_icrs
    sides: Array  # (k,) chords, ascending
    narrowest: float

    def triangles(self, rays_cam: Array, tolerance: float) -> tuple[Ints, Ints]:
        """Triangles of the rays (n, 3), the first among them, and of the catalogue, (c, 3) each, whose sides agree."""
        apart = rays_cam[:, None] - rays_cam
        chords = np.sqrt(np.einsum("ijk,ijk->ij", apart, apart))
        wide = np.flatnonzero((chords[0] > self.narrowest) & (chords[0] < self.sides[-1] + tolerance))
        first = np.searchsorted(self.sides, chords[0, wide] - tolerance)
        count = np.searchsorted(self.sides, chords[0, wide] + tolerance) - first
        at = np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count) + np.repeat(first, count)
        end, pair = np.repeat(wide, count), self.pairs[at]
        order = np.argsort(pair[:, 0], kind="stable")
        end, pair = end[order], pair[order]
        one, other = _pairs_within_groups(pair[:, 0])
        wanted = chords[end[one], end[other]]  # 0 for an end and itself
        apart = self.rays_icrs[pair[one, 1]] - self.rays_icrs[pair[other, 1]]
        found = np.sqrt(np.einsum("ij,ij->i", apart, apart))
        fits = (np.abs(found - wanted) < tolerance) & (wanted > 0)
        one, other = one[fits], other[fits]
        image = np.stack([np.zeros(len(one), dtype=np.int64), end[one], end[other]], axis=1)
        return image, np.stack([pair[one, 0], pair[one, 1], pair[other, 1]], axis=1)


def _pairs_within_groups(ordered: Ints) -> tuple[Ints, Ints]:
    """Indices (c,), (c,) of all pairs of equal values among the ascending values (n,)."""
    own = np.arange(len(ordered))
    later = np.searchsorted(ordered, ordered, side="right") - own - 1
    one = np.repeat(own, later)
    return one, np.arange(later.sum()) - np.repeat(np.cumsum(later) - later, later) + one + 1


def build_pairs(stars: Stars, field_sr: float) -> PairIndex:
    """Index of the pairs no wider than the field, of as many bright stars as give about PAIRS_WANTED pairs."""
    from scipy.spatial import cKDTree

    diameter = 2 * np.arccos(np.clip(1 - field_sr / (2 * np.pi), -1, 1))
    widest = min(WIDEST_RAD, float(diameter))
    within = 0.5 * (1 - np.cos(widest))  # fraction of the sphere that contains a star's partners
    star = separate_bright_stars(stars, int(min(np.sqrt(2 * PAIRS_WANTED / within), DEEPEST)))
    rays = stars.rays_icrs[star]
    pairs = cKDTree(rays).query_pairs(2 * np.sin(widest / 2), output_type="ndarray").astype(np.int64)
    pairs = np.concatenate([pairs, pairs[:, ::-1]])
    sides = np.linalg.norm(rays[pairs[:, 0]] - rays[pairs[:, 1]], axis=1)
    order = np.argsort(sides, kind="stable")
    narrowest = 2 * np.sin(NARROWEST_FRACTION * widest / 2)
    order = order[np.searchsorted(sides[order], narrowest) :]
    return PairIndex(rays, pairs[order], sides[order], float(narrowest))
