"""The catalogue's triangles in a k-d tree: asked with the sides of an image's triangle, it answers with stars."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import chain
from typing import Any

import numpy as np

from startrack.identify.triangles import Triangles, triangles
from startrack.types import Array, Ints, Stars

NEIGHBOURS_WANTED = 18.0  # pattern stars within the reach of each: enough triangles with most of the sky hidden
WIDEST_REACH_RAD = np.radians(40.0)
LEAN_STARS_IN_FIELD, FEWEST_LEAN_STARS, MOST_LEAN_STARS = 20, 150, 2500
LEAN_TRIANGLES = 120_000
WIDEST_LEAN_REACH_RAD = np.radians(75.0)
FEW_TRIANGLES = 2000  # up to which one look-up each is quicker than a tree of their own
CLOSE_PAIR_RAD = np.radians(0.05)


@dataclass(frozen=True)
class PatternIndex:
    """Triangles of the `depth` brightest stars of the sky."""

    star: Ints  # (m,) indices of the pattern stars in Stars
    rays_icrs: Array  # (m, 3)
    reach_rad: float
    triangles: Triangles
    tree: Any  # scipy.spatial.cKDTree over the triangles' sides

    def candidates(self, image: Triangles, tolerance_rad: float) -> tuple[Ints, Ints]:
        """Pairs (image triangle, catalogue triangle) that agree in handedness and, within the tolerance, in sides."""
        from scipy.spatial import cKDTree

        if not len(image) or not len(self.triangles):
            return np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64)
        if len(image) <= FEW_TRIANGLES:
            hits = list(self.tree.query_ball_point(image.sides_rad, tolerance_rad, p=np.inf))
        else:
            hits = cKDTree(image.sides_rad).query_ball_tree(self.tree, tolerance_rad, p=np.inf)
        left = np.repeat(np.arange(len(hits)), list(map(len, hits)))
        right = np.array(list(chain.from_iterable(hits)), dtype=np.int64)
        agree = image.handed[left] == self.triangles.handed[right]
        return left[agree], right[agree]


def build_index(stars: Stars, field_sr: float) -> PatternIndex:
    """Index over the brightest stars (sorted, brightest first), deep enough for a camera that sees `field_sr`.

    Wide fields need few stars and long sides, narrow ones many stars and short sides.
    """
    from scipy.spatial import cKDTree

    depth = int(np.clip(300 * (2 * np.pi / field_sr) ** 0.8, 300, 12000))
    star = bright_stars_apart(stars, depth)
    rays = stars.rays_icrs[star]
    cap = NEIGHBOURS_WANTED / len(star)  # fraction of the sphere that holds the wanted number of neighbours
    reach = min(WIDEST_REACH_RAD, 2 * np.arcsin(np.sqrt(cap)), 0.8 * np.sqrt(4 * field_sr / np.pi))
    found = triangles(rays, reach)
    return PatternIndex(star, rays, float(reach), found, cKDTree(found.sides_rad))


def build_bright_index(stars: Stars, field_sr: float) -> PatternIndex:
    """Index over the few brightest stars (sorted, brightest first), with sides nearly as long as the field allows.

    A short list's brightest detections are among them, and so long a triangle leaves little to chance.
    """
    from scipy.spatial import cKDTree

    depth = int(np.clip(LEAN_STARS_IN_FIELD * 4 * np.pi / field_sr, FEWEST_LEAN_STARS, MOST_LEAN_STARS))
    star = bright_stars_apart(stars, depth)
    rays = stars.rays_icrs[star]
    neighbours = np.sqrt(LEAN_TRIANGLES * 6 / len(star))
    reach = min(
        WIDEST_LEAN_REACH_RAD,
        2 * np.arcsin(np.sqrt(min(neighbours / len(star), 1.0))),
        0.8 * np.sqrt(4 * field_sr / np.pi),
    )
    found = triangles(rays, reach)
    return PatternIndex(star, rays, float(reach), found, cKDTree(found.sides_rad))


def bright_stars_apart(stars: Stars, depth: int) -> Ints:
    """The brightest stars, of each close pair only the brighter: a camera sees one light there."""
    from scipy.spatial import cKDTree

    rays = stars.rays_icrs[: 2 * depth]
    pairs = cKDTree(rays).query_pairs(CLOSE_PAIR_RAD, output_type="ndarray")
    keep = np.ones(len(rays), dtype=bool)
    if len(pairs):
        keep[pairs.max(axis=1)] = False
    return np.flatnonzero(keep)[:depth]
