"""Attitudes that matching triangles suggest, held against the bright stars: all arrays small, few calls."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np

from startrack.frames import wahba
from startrack.identification.index import Near, PatternIndex, Patterns
from startrack.identification.scale import Scale
from startrack.identification.triangles import sides_of_few, triangles
from startrack.types import Array, Ints

PREFIXES = (0, 7, 10, 14, 20, 28)  # brightest detections that form triangles, round by round
WINDOW, FRESH = 24, 12  # ranks that form triangles beyond, and how many of them are new each time
DEEPEST = 240
ROUGH_DEPTH, ROUGH_REACH_RAD, ROUGH_PART = 120, np.radians(20.0), 0.4
PIVOTS = 16  # brightest detections about which triangles of any stars are tried
MATCHES_EACH, ROUGH_MATCHES_EACH = 3, 8  # of an image's triangle
MOST_IMAGE_TRIANGLES, MOST_ROUGH = 20_000, 3000  # short triangles of the image; their matches that are tried
VERIFIED = 256  # detections held against the stars
SIFTED, AT_ONCE = 64, 64  # detections that sift a crowd of hypotheses first, and how many of these at once
DEPTH_FACTOR = 4  # catalogue stars per detection of the whole sky's: some are hidden, or too faint
FEWEST_HITS = 6
GIVEN = 3  # a triangle's own stars are hits whatever it is
PLAUSIBLE = 1e-2  # chance of a match that is worth refining; the refined one is judged by the real limit


@dataclass(frozen=True)
class Turned:
    """A rough attitude, and what coincides at it."""

    R_cam_icrs: Array
    detection: Ints  # (k,)
    star: Ints  # (k,)
    near: Near | None  # all stars about the detections, where they were looked up


@dataclass
class AttitudeSearch:
    """Hypotheses, and their verification against the bright stars."""

    rays_cam: Array  # (n, 3) of the detections inside the image circle, brightest first
    patterns: Patterns
    scale: Scale
    reach_rad: float  # stars so near a detection matter
    tried: int = 0  # matching triangles so far
    mirrored: list[tuple[Array, Array, int, float]] = field(default_factory=list)  # would fit a mirror image

    def attitudes(self, tolerance_px: float, rough_px: float) -> Iterator[Turned]:
        """Attitudes that chance hardly explains.

        First by long triangles of the brightest few, then of ever fainter ones and with more of the catalogue's stars,
        then by triangles that are in no list; last by short ones, for rays in error by `rough_px`: there a rough
        calibration still fits.
        """
        brightest, beyond = list(self._prefixes()), list(self._windows())
        for windows in (brightest, beyond):
            for deep in (False, True):
                for first, fresh, end in windows:
                    index = self.patterns.deep if deep else self.patterns.bright
                    yield from self._by_triangles(index, first, fresh, end, tolerance_px * self.scale.on_axis)
        yield from self._by_pairs(tolerance_px * self.scale.on_axis)
        yield from self._by_neighbours(rough_px * self.scale.on_axis)

    def mirror_images(self) -> Iterator[Turned]:
        """The same of triangles that fit a mirror image, among those that the search has met."""
        flip = np.array([-1.0, 1.0, 1.0])
        for cam, icrs, first, tolerance in self.mirrored:
            yield from self._plausible(cam * flip, icrs, self.rays_cam * flip, first, tolerance)

    def _prefixes(self) -> Iterator[tuple[int, int, int]]:
        n = len(self.rays_cam)
        return ((0, done, min(end, n)) for done, end in pairwise(PREFIXES) if done < n)

    def _windows(self) -> Iterator[tuple[int, int, int]]:
        n = min(len(self.rays_cam), DEEPEST)
        start = PREFIXES[-1] - (WINDOW - FRESH)
        return ((k, WINDOW - FRESH, min(k + WINDOW, n)) for k in range(start, n - WINDOW + FRESH, FRESH))

    def _by_triangles(
        self, index: PatternIndex, first: int, fresh: int, end: int, tolerance: float
    ) -> Iterator[Turned]:
        """From triangles of the detections `first` to `end` that have a vertex from the `fresh`-th of them on."""
        vertices, sides = sides_of_few(self.rays_cam[first:end], fresh)
        ordered = np.sort(sides, axis=1)
        short = np.flatnonzero(ordered[:, 2] < index.reach)
        left, right = index.candidates(ordered[short], tolerance, MATCHES_EACH)
        if len(left):
            left = short[left]
            order = np.argsort(sides[left], axis=1)
            vertex = vertices[left[:, None], order] + first
            icrs = index.rays_icrs[index.vertices[right]]
            yield from self._handed(self.rays_cam[vertex], icrs, index.handed[right], first, tolerance)

    def _by_pairs(self, tolerance: float) -> Iterator[Turned]:
        index, few = self.patterns.pairs, self.rays_cam[:PIVOTS]
        for pivot in range(len(few) - 2):
            image, catalogue = index.triangles(few[pivot:], tolerance)
            if len(image):
                icrs = index.rays_icrs[catalogue]
                yield from self._handed(few[image + pivot], icrs, np.linalg.det(icrs), 0, tolerance)

    def _by_neighbours(self, tolerance: float) -> Iterator[Turned]:
        index = self.patterns.deep
        reach = min(ROUGH_REACH_RAD, ROUGH_PART * self.scale.diameter_rad)
        image = triangles(self.rays_cam[:ROUGH_DEPTH], reach, MOST_IMAGE_TRIANGLES)
        left, right = index.candidates(2 * np.sin(image.sides_rad / 2), tolerance, ROUGH_MATCHES_EACH)
        self.tried += max(len(left) - MOST_ROUGH, 0)
        left, right = left[:MOST_ROUGH], right[:MOST_ROUGH]
        if len(left):
            icrs = index.rays_icrs[index.vertices[right]]
            yield from self._handed(self.rays_cam[image.vertices[left]], icrs, index.handed[right], 0, tolerance)

    def _handed(self, cam: Array, icrs: Array, handed: Array, first: int, tolerance: float) -> Iterator[Turned]:
        """Triangles cam (m, 3, 3) of the same hand as the catalogue's (m,) are tried, the others put aside."""
        self.tried += len(cam)
        same = np.linalg.det(cam) * handed > 0
        if np.count_nonzero(same) < len(same):
            self.mirrored.append((cam[~same], icrs[~same], first, tolerance))
            cam, icrs = cam[same], icrs[same]
        yield from self._plausible(cam, icrs, self.rays_cam, first, tolerance)

    def _plausible(self, cam: Array, icrs: Array, rays_cam: Array, first: int, tolerance: float) -> Iterator[Turned]:
        """Of the attitudes that turn the rays icrs (m, 3, 3) to cam (m, 3, 3), those that the bright stars support."""
        some, radius = rays_cam[: first + VERIFIED], 2.0 * tolerance
        depth = int(DEPTH_FACTOR * 4 * np.pi / self.patterns.field_sr * len(some))
        for R in self._sifted(cam, icrs, some[max(first - WINDOW, 0) : first + SIFTED], radius, depth):
            near = self.patterns.near(some @ R, self.reach_rad, depth)
            on = near.chord < radius
            hits = min(int(np.count_nonzero(on)), len(some))
            if hits >= FEWEST_HITS and self._odds(hits - GIVEN, len(some), near.depth, radius) < PLAUSIBLE:
                yield Turned(R, near.ray[on], near.star[on], near if len(some) == len(rays_cam) else None)

    def _sifted(self, cam: Array, icrs: Array, some: Array, radius: float, depth: int) -> Iterator[Array]:
        """R_cam_icrs of the closest match, which is nearly always right; then those that some detections support."""
        if len(cam):
            yield wahba(cam[0], icrs[0])
        tree = self.patterns.tree(depth)
        for start in range(1, len(cam), AT_ONCE):
            R = wahba(cam[start : start + AT_ONCE], icrs[start : start + AT_ONCE])
            distance = tree.query(some @ R, distance_upper_bound=radius)[0]
            hits = np.count_nonzero(distance < radius, axis=1)
            best = np.argsort(-hits, kind="stable")
            odds = self._odds(np.maximum(hits[best] - GIVEN, 1), len(some), tree.n, radius)
            yield from R[best[odds < PLAUSIBLE]]

    def _odds(self, further: Ints | int, rays: int, depth: int, radius: float) -> Array:
        """Probability that chance makes so many further rays hit one of the `depth` brightest stars, in any trial."""
        from scipy.special import betainc

        odds: Array = self.tried * betainc(further, rays - GIVEN + 1 - further, min(depth * radius**2 / 4, 1.0))
        return odds
