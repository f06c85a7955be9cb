"""Triangles of rays, whose sides do not depend on the attitude; and indexes of the catalogue's, for a known scale."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from startrack.core.types import Array, Bools, Ints, Stars
from startrack.identification.star_grid import StarGrid
from startrack.kernels.library import kernel

CLOSE_PAIR_RAD = np.radians(0.05)  # stars this close are one detection
LONGEST_SIDE_OF_FIELD = 0.8  # of a field's diameter: longer sides seldom fit into it
CLOSURE_PROBABILITY = 0.59  # that two neighbours of a star in the plane are neighbours of each other
PAIRS_WANTED = 180_000
DEEPEST_PAIR = 5000
WIDEST_PAIR_RAD = np.radians(110.0)
CUBE_DIAGONAL = 3.0**0.5  # of differences of three sides, to the largest of them
MOST_PAIRS_BY_CHANCE = 500_000  # of one lookup; a fisheye of 2048 pixels has 200,000 with a rough calibration
NARROWEST_PAIR_1 = 0.07  # of the widest; closer pairs determine the roll poorly


@dataclass(frozen=True, kw_only=True)
class Triangles:
    """Triangles of stars, vertices ordered by the opposite side, shortest first."""

    vertices: Ints  # (n, 3) indices of the rays
    sides_rad: Array  # (n, 3) ascending
    handedness: Array  # (n,) sign of the triple product of the ordered vertices; the mirror image has the other sign

    def __len__(self) -> int:
        return len(self.vertices)

    def take(self, which: Any) -> Triangles:
        """The triangles selected by a mask or index array."""
        return Triangles(**{name: values[which] for name, values in vars(self).items()})


def triangles(rays: Array, longest_rad: float, most: int = 2_000_000) -> Triangles:
    """All triangles of the rays (n, 3) with sides shorter than `longest_rad` (below 90 degrees).

    At most `most`, those of the earliest (brightest) rays first. Flat triangles and those with two nearly equal sides
    are left out: their handedness, or the order of their vertices, is not determined.
    """
    vertices = _triples(rays, 2 * np.sin(longest_rad / 2), most)
    a, b, c = rays[vertices[:, 0]], rays[vertices[:, 1]], rays[vertices[:, 2]]
    sides = np.stack([_angle(b, c), _angle(c, a), _angle(a, b)], axis=1)
    order = np.argsort(sides, axis=1)
    sides = np.take_along_axis(sides, order, axis=1)
    vertices = np.take_along_axis(vertices, order, axis=1)
    (ax, ay, az), (bx, by, bz), (cx, cy, cz) = (rays[vertices[:, k]].T for k in range(3))
    # Of the triple product; numpy's determinant takes three times as long.
    volume = ax * (by * cz - bz * cy) + ay * (bz * cx - bx * cz) + az * (bx * cy - by * cx)
    good = (np.abs(volume) > 0.05 * sides[:, 2] ** 2 * 0.5) & (np.diff(sides, axis=1).min(axis=1) > 0.01 * sides[:, 2])
    return Triangles(vertices=vertices[good], sides_rad=sides[good], handedness=np.sign(volume[good]))


def sides_of_few(rays: Array, fresh: int, longest: float) -> tuple[Ints, Array]:
    """Triples (m, 3) of a few dozen rays (n, 3) with sides below `longest` and a vertex from index `fresh` on.

    Then their sides (m, 3), which are chords, ascending. Vertices are in the order of the opposite side, as in
    Triangles.
    """
    n = len(rays)
    room = n * (n - 1) * (n - 2) // 6
    vertices, sides = np.empty((room, 3), np.int64), np.empty((room, 3))
    m = _sides_of_few(np.ascontiguousarray(rays), fresh, longest, np.empty((n, n)), vertices, sides)
    return vertices[:m], sides[:m]


def are_same_handed(one: Array, other: Array) -> Bools:
    """Whether triples of rays (m, 3, 3) have triple products of the same sign."""
    same = np.empty(len(one), bool)
    _are_same_handed(np.ascontiguousarray(one), np.ascontiguousarray(other), same)
    return same


def triad_attitude(cam: Array, icrs: Array) -> Array:
    """R_cam_icrs (m, 3, 3) from the first two of the rays (m, k, 3): fast, and accurate enough for a comparison.

    Source: Black 1964, AIAA J. 2, 1350 (TRIAD).
    """

    def frame(rays: Array) -> Array:
        a = rays[:, 0]
        c = np.cross(a, rays[:, 1])
        c /= np.linalg.norm(c, axis=1, keepdims=True)
        return np.stack([a, c, np.cross(a, c)], axis=2)

    return frame(cam) @ np.swapaxes(frame(icrs), 1, 2)


def _triples(rays: Array, chord: float, most: int) -> Ints:
    """Index triples i < j < k (m, 3) of rays that are pairwise closer than the chord."""
    from scipy.spatial import cKDTree

    pairs = cKDTree(rays).query_pairs(chord, output_type="ndarray").astype(np.int64)
    if not len(pairs):
        return np.zeros((0, 3), dtype=np.int64)
    pairs = np.sort(pairs, axis=1)
    pairs = pairs[np.lexsort((pairs[:, 1], pairs[:, 0]))]
    n = len(rays)
    # Each pair (i, j) is extended by every later partner k of i, and kept where (j, k) is a pair too.
    first, second = _later_partners(pairs[:, 0])
    j, k = pairs[first, 1], pairs[second, 1]
    keys = pairs[:, 0] * n + pairs[:, 1]
    wanted = j * n + k
    at = np.minimum(np.searchsorted(keys, wanted), len(keys) - 1)
    closed = keys[at] == wanted
    triples = np.stack([pairs[first, 0], j, k], axis=1)[closed]
    if len(triples) > most:
        triples = triples[np.argsort(triples.max(axis=1), kind="stable")[:most]]
    return triples


def number_runs(first: Ints, count: Ints) -> Ints:
    """The numbers of all runs, one after another; run i begins at `first` (m,) and has `count` (m,) of them."""
    return np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count) + np.repeat(first, count)


def _later_partners(pivot: Ints) -> tuple[Ints, Ints]:
    """All pairs of indices (m,), (m,), one before the other, of equal ones among ascending numbers (n,)."""
    own = np.arange(len(pivot))
    later = np.searchsorted(pivot, pivot, side="right") - own - 1
    return np.repeat(own, later), number_runs(own + 1, later)


def _angle(a: Array, b: Array) -> Array:
    """Angles (n,) between unit vectors (n, 3), exact at all sizes (Kahan), without a slow cross product."""
    apart, together = a - b, a + b
    short, long = np.einsum("ni,ni->n", apart, apart), np.einsum("ni,ni->n", together, together)
    return 2.0 * np.arctan2(np.sqrt(short), np.sqrt(long))


@dataclass(frozen=True)
class PatternSize:
    """Numbers of stars and of triangles of an index."""

    stars_in_field: int
    min_stars: int  # of the whole sky
    max_stars: int
    triangles: int
    widest_rad: float


# The brightest few, with sides nearly as long as the field allows: a long triangle seldom matches by chance.
BRIGHT = PatternSize(20, 150, 40_000, 200_000, np.radians(75.0))
# More stars, shorter sides: where walls, clouds or false stars leave too few of the brightest.
DEEP = PatternSize(60, 700, 60_000, 400_000, np.radians(45.0))


def to_cube(sides: Array, longest_chord: float) -> Array:
    """The sides (n, 3), at most `longest_chord`, as points of the cube that a StarGrid divides, from -1 to 1."""
    return sides * (2.0 / longest_chord) - 1.0


@dataclass(frozen=True)
class PatternIndex:
    """Triangles of the brightest stars of the sky, looked up by their sides, which are chords of the unit sphere."""

    rays_icrs: Array  # (m, 3) of the pattern stars
    longest_chord: float  # of the sides
    vertices: Ints  # (n, 3) indices into rays_icrs, ordered by the opposite side, shortest first
    sides: Array  # (n, 3) chords, ascending
    grid: StarGrid  # of the sides as points of a cube, by `to_cube`

    def candidates(self, sides: Array, tolerance: float, most: int) -> tuple[Ints, Ints]:
        """Pairs (row of the sides (m, 3), triangle) that agree within the tolerance, best relative agreement first.

        At most `most` for each row, those that agree best. Where chance alone would give more than
        MOST_PAIRS_BY_CHANCE, the tolerance is smaller: the pairs that agree less than so many others decide nothing.
        """
        density = len(sides) * len(self.sides) / MOST_PAIRS_BY_CHANCE  # sides spread over an eighth of the cube
        tolerance = min(tolerance, 0.25 * self.longest_chord / max(density, 1.0) ** (1 / 3))
        reach = CUBE_DIAGONAL * tolerance * 2.0 / self.longest_chord
        near = self.grid.neighbours(to_cube(sides, self.longest_chord), reach)
        off, kept = np.empty(len(near.ray)), np.empty(len(near.ray), np.int64)
        _largest_differences(np.ascontiguousarray(sides), self.sides, near.ray, near.star, tolerance, off)
        order, count = off.argsort(kind="stable"), np.empty(len(sides), np.int64)
        kept = kept[: _keep_closest(order, off, near.ray, most, count, kept)]
        return near.ray[kept], near.star[kept]


def build_index(stars: Stars, field_sr: float, size: PatternSize) -> PatternIndex:
    """The index of the brightest stars (sorted, brightest first) for a camera that sees `field_sr`."""
    star = separate_bright_stars(
        stars, int(np.clip(size.stars_in_field * 4 * np.pi / field_sr, size.min_stars, size.max_stars))
    )
    rays = stars.rays_icrs[star]
    neighbours = np.sqrt(6 * size.triangles / (CLOSURE_PROBABILITY * len(star)))
    longest_side = min(
        size.widest_rad,
        2 * np.arcsin(np.sqrt(min(neighbours / len(star), 1.0))),
        LONGEST_SIDE_OF_FIELD * np.sqrt(4 * field_sr / np.pi),
    )
    found = triangles(rays, longest_side)
    sides = 2 * np.sin(found.sides_rad / 2)
    longest_chord = float(2 * np.sin(longest_side / 2))
    return PatternIndex(rays, longest_chord, found.vertices, sides, StarGrid(to_cube(sides, longest_chord)))


@dataclass(frozen=True)
class PairIndex:
    """Pairs of bright stars, by separation; both orders of each. For frames so poor that no indexed triangle fits."""

    rays_icrs: Array  # (m, 3)
    pairs: Ints  # (k, 2) indices into rays_icrs
    sides: Array  # (k,) chords, ascending
    narrowest: float

    def triangles(self, rays_cam: Array, tolerance: float) -> tuple[Ints, Ints]:
        """Triangles of the rays (n, 3), the first among them, and of the catalogue, (c, 3) each, whose sides agree.

        Two pairs with one star at the pivot form a triangle if their other ends are as far apart as in the image.
        """
        apart = rays_cam[:, None] - rays_cam
        chords = np.sqrt(np.einsum("ijk,ijk->ij", apart, apart))
        wide = np.flatnonzero((chords[0] > self.narrowest) & (chords[0] < self.sides[-1] + tolerance))
        first = np.searchsorted(self.sides, chords[0, wide] - tolerance)
        count = np.searchsorted(self.sides, chords[0, wide] + tolerance) - first
        end, pair = np.repeat(wide, count), self.pairs[number_runs(first, count)]
        order = np.argsort(pair[:, 0], kind="stable")
        end, pair = end[order], pair[order]
        one, other = _later_partners(pair[:, 0])
        wanted = chords[end[one], end[other]]  # 0 for an end and itself
        apart = self.rays_icrs[pair[one, 1]] - self.rays_icrs[pair[other, 1]]
        found = np.sqrt(np.einsum("ij,ij->i", apart, apart))
        fits = (np.abs(found - wanted) < tolerance) & (wanted > 0)
        one, other = one[fits], other[fits]
        image = np.stack([np.zeros(len(one), dtype=np.int64), end[one], end[other]], axis=1)
        return image, np.stack([pair[one, 0], pair[one, 1], pair[other, 1]], axis=1)


def build_pairs(stars: Stars, field_sr: float) -> PairIndex:
    """Index of the pairs no wider than the field, of as many bright stars as give about PAIRS_WANTED pairs."""
    from scipy.spatial import cKDTree

    diameter = 2 * np.arccos(np.clip(1 - field_sr / (2 * np.pi), -1, 1))
    widest = min(WIDEST_PAIR_RAD, float(diameter))
    within = 0.5 * (1 - np.cos(widest))  # fraction of the sphere that contains a star's partners
    star = separate_bright_stars(stars, int(min(np.sqrt(2 * PAIRS_WANTED / within), DEEPEST_PAIR)))
    rays = stars.rays_icrs[star]
    pairs = cKDTree(rays).query_pairs(2 * np.sin(widest / 2), output_type="ndarray").astype(np.int64)
    pairs = np.concatenate([pairs, pairs[:, ::-1]])
    sides = np.linalg.norm(rays[pairs[:, 0]] - rays[pairs[:, 1]], axis=1)
    order = np.argsort(sides, kind="stable")
    narrowest = 2 * np.sin(NARROWEST_PAIR_1 * widest / 2)
    order = order[np.searchsorted(sides[order], narrowest) :]
    return PairIndex(rays, pairs[order], sides[order], float(narrowest))


def separate_bright_stars(stars: Stars, depth: int) -> Ints:
    """Indices of the brightest stars; of each close pair only the brighter, as a camera does not resolve them."""
    from scipy.spatial import cKDTree

    rays = stars.rays_icrs[: 2 * depth]
    pairs = cKDTree(rays).query_pairs(CLOSE_PAIR_RAD, output_type="ndarray")
    keep = np.ones(len(rays), dtype=bool)
    if len(pairs):
        keep[pairs.max(axis=1)] = False
    return np.flatnonzero(keep)[:depth]


_sides_of_few = kernel(
    "sides_of_few", "rays: float64[n, 3]", "fresh: int64", "longest: float64", "chord: out float64[n, n]",
    "vertices: out int64[room, 3]", "sides: out float64[room, 3]", result="int64",
)  # fmt: skip
_are_same_handed = kernel("are_same_handed", "one: float64[m, 3, 3]", "other: float64[m, 3, 3]", "same: out bool[m]")
_largest_differences = kernel(
    "largest_differences", "sides: float64[m, 3]", "known: float64[n, 3]", "row: int64[k]", "found: int64[k]",
    "tolerance: float64", "off: out float64[k]",
)  # fmt: skip
_keep_closest = kernel(
    "keep_closest", "order: int64[n]", "off: float64[n]", "row: int64[n]", "each: int64", "count: out int64[rows]",
    "kept: out int64[n]", result="int64",
)  # fmt: skip
