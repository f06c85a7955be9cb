"""The catalogue's side of an identification: triangles of bright stars by their sides, and trees of stars by depth."""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from startrack.identification.triangles import triangles
from startrack.identification.weak_cache import KeptPerObject
from startrack.types import Array, Ints, Stars

if TYPE_CHECKING:
    from startrack.identification.pairs import PairIndex

CLOSE_PAIR_RAD = np.radians(0.05)
SHALLOWEST = 1000  # brightest stars in the smallest tree; each next one holds twice as many
NEIGHBOURS = 10  # of a ray; more only in clusters
KEPT_PATTERNS = 4
WHOLE_FIELD = 0.8  # of a field's diameter: sides that often fit into it
CLOSED = 0.59  # of two neighbours of a star in the plane, the probability that they are each other's


@dataclass(frozen=True)
class PatternSize:
    """How many stars form how many triangles."""

    stars_in_field: int
    fewest: int  # of the whole sky
    most: int
    triangles: int
    widest_rad: float


# The brightest few, with sides nearly as long as the field allows: so long a triangle leaves little to chance.
BRIGHT = PatternSize(20, 150, 40_000, 200_000, np.radians(75.0))
# More stars, shorter sides: where walls, clouds or false stars leave too few of the brightest.
DEEP = PatternSize(60, 700, 60_000, 400_000, np.radians(45.0))


@dataclass(frozen=True)
class PatternIndex:
    """Triangles of the brightest stars of the sky, found by their sides: chords, which no arctangent slows down."""

    star: Ints  # (m,) indices of the pattern stars in Stars
    rays_icrs: Array  # (m, 3)
    reach: float  # longest side
    vertices: Ints  # (n, 3) indices into rays_icrs, ordered by the opposite side, shortest first
    handed: Array  # (n,) sign of the triple product
    tree: Any  # scipy.spatial.cKDTree over the sides (n, 3), ascending

    def candidates(self, sides: Array, tolerance: float, most: int) -> tuple[Ints, Ints]:
        """Pairs (row of the sides (m, 3), triangle) that agree within the tolerance; the closest, largest ones first.

        At most `most` of each row: one look-up of fixed size takes a tenth of the time of a complete one.
        """
        distance, found = self.tree.query(sides, most, p=np.inf, distance_upper_bound=tolerance)
        distance = distance.ravel()
        close = np.flatnonzero(distance < tolerance)
        close = close[np.argsort(distance[close] / sides[close // most, 0])]
        return close // most, found.ravel()[close]


def build_index(stars: Stars, field_sr: float, size: PatternSize) -> PatternIndex:
    """The index of the brightest stars (sorted, brightest first) for a camera that sees `field_sr`."""
    from scipy.spatial import cKDTree

    star = bright_stars_apart(stars, int(np.clip(size.stars_in_field * 4 * np.pi / field_sr, size.fewest, size.most)))
    rays = stars.rays_icrs[star]
    neighbours = np.sqrt(6 * size.triangles / (CLOSED * len(star)))
    reach = min(
        size.widest_rad,
        2 * np.arcsin(np.sqrt(min(neighbours / len(star), 1.0))),
        WHOLE_FIELD * np.sqrt(4 * field_sr / np.pi),
    )
    found = triangles(rays, reach)
    sides = 2 * np.sin(found.sides_rad / 2)
    return PatternIndex(star, rays, float(2 * np.sin(reach / 2)), found.vertices, found.handed, cKDTree(sides))


def bright_stars_apart(stars: Stars, depth: int) -> Ints:
    """The brightest stars, of each close pair only the brighter: a camera sees one light there."""
    from scipy.spatial import cKDTree

    rays = stars.rays_icrs[: 2 * depth]
    pairs = cKDTree(rays).query_pairs(CLOSE_PAIR_RAD, output_type="ndarray")
    keep = np.ones(len(rays), dtype=bool)
    if len(pairs):
        keep[pairs.max(axis=1)] = False
    return np.flatnonzero(keep)[:depth]


class Patterns:
    """All of it for a camera that sees `field_sr`, worked out when first asked for."""

    def __init__(self, stars: Stars, field_sr: float) -> None:
        """`stars` are sorted, brightest first."""
        self.stars, self.field_sr = stars, field_sr
        self._trees: dict[int, Any] = {}

    @cached_property
    def bright(self) -> PatternIndex:
        """Of the brightest few."""
        return build_index(self.stars, self.field_sr, BRIGHT)

    @cached_property
    def deep(self) -> PatternIndex:
        """Of more stars."""
        return build_index(self.stars, self.field_sr, DEEP)

    @cached_property
    def pairs(self) -> PairIndex:
        """Pairs of bright stars."""
        from startrack.identification.pairs import build_pairs

        return build_pairs(self.stars, self.field_sr)

    def tree(self, count: int) -> Any:
        """scipy.spatial.cKDTree of at least the `count` brightest stars: a short list needs only a shallow one."""
        from scipy.spatial import cKDTree

        level = SHALLOWEST << max((count - 1) // SHALLOWEST, 0).bit_length()
        if level not in self._trees:
            self._trees[level] = cKDTree(self.stars.rays_icrs[:level])
        return self._trees[level]

    def near(self, rays_icrs: Array, radius_rad: float, count: int) -> Near:
        """All pairs of a ray (n, 3) and a star closer than the radius, of the `count` brightest stars and some more."""
        return _near(self.tree(count), rays_icrs, 2 * np.sin(radius_rad / 2), NEIGHBOURS)


@dataclass(frozen=True)
class Near:
    """Rays and the stars beside them."""

    ray: Ints  # (k,) ascending
    star: Ints  # (k,)
    chord: Array  # (k,) between them
    depth: int  # number of the brightest stars that were searched


def _near(tree: Any, rays_icrs: Array, chord: float, most: int) -> Near:
    distance, star = tree.query(rays_icrs, most, distance_upper_bound=chord)
    close = np.flatnonzero(distance < chord)  # a missing neighbour is infinitely far
    ray = close // most
    near = Near(ray, star.ravel()[close], distance.ravel()[close], tree.n)
    crowded = np.flatnonzero(distance[:, -1] < chord)
    if not len(crowded):
        return near
    more = _near(tree, rays_icrs[crowded], chord, 4 * most)  # in star clusters
    plain = np.isin(ray, crowded, invert=True)
    ray = np.concatenate([ray[plain], crowded[more.ray]])
    order = np.argsort(ray, kind="stable")
    star = np.concatenate([near.star[plain], more.star])
    distance = np.concatenate([near.chord[plain], more.chord])
    return Near(ray[order], star[order], distance[order], near.depth)


def patterns_of(stars: Stars, field_sr: float) -> Patterns:
    """The patterns of these very stars; the last few are kept."""
    key = (_fingerprint_of(stars), field_sr)
    if key not in _KEPT:
        _KEPT[key] = Patterns(stars, field_sr)
        while len(_KEPT) > KEPT_PATTERNS:
            _KEPT.popitem(last=False)
    _KEPT.move_to_end(key)
    return _KEPT[key]


_KEPT: OrderedDict[tuple[object, float], Patterns] = OrderedDict()
_fingerprint_of = KeptPerObject(lambda stars: (stars.rays_icrs.shape, stars.rays_icrs[:2000].tobytes()))
