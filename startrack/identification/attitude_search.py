"""Search for attitudes: triangles of detections that match the catalogue's, tested against the bright stars.

All arrays are small and the number of numpy calls is kept low: a typical search ends with its first triangles.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np

from startrack.core.types import Array, Ints
from startrack.estimation.false_alarm import PATTERN_MATCHES, expected_false_alarms
from startrack.frames import wahba
from startrack.identification.index import CatalogPatterns, Neighbours, PatternIndex, PixelScale
from startrack.identification.triangles import sides_of_few, triangles

PREFIXES = (0, 7, 10, 14, 20, 28)  # number of brightest detections that form triangles, round by round
WINDOW_RANKS, NEW_RANKS = 24, 12  # ranks of brightness that form triangles beyond these, and how many of them are new
DEEPEST_RANK = 240
ROUGH_DEPTH, ROUGH_SIDE_RAD, ROUGH_FRACTION = 120, np.radians(20.0), 0.4
PIVOTS = 16  # brightest detections about which triangles of catalogue pairs are tried
MATCHES_EACH, ROUGH_MATCHES_EACH = 3, 8  # catalogue triangles looked up for a triangle of detections
MAX_IMAGE_TRIANGLES, MAX_ROUGH = 20_000, 3000  # short triangles of detections; their matches that are tried
VERIFIED_DETECTIONS = 256  # detections tested against the stars
PRETESTED_DETECTIONS, PRETEST_BATCH = (
    64,
    64,
)  # detections in the first test of many hypotheses; hypotheses tested together
DEPTH_FACTOR = 4  # catalogue stars per detection (of the whole sky): some are hidden or too faint
MIN_HITS = 6
PLAUSIBLE = 1e-2  # expected false alarms below which a hypothesis is refined; the final limit is tested later


@dataclass(frozen=True)
class AttitudeHypothesis:
    """A rough attitude with the pairs that coincide."""

    R_cam_icrs: Array
    detection: Ints  # (k,)
    star: Ints  # (k,)
    near: Neighbours | None  # all stars near the detections, where they were looked up


@dataclass
class AttitudeSearch:
    """Hypotheses of the attitude, in order of likelihood."""

    rays_cam: Array  # (n, 3) of the detections inside the image circle, brightest first
    patterns: CatalogPatterns
    scale: PixelScale
    neighbour_radius_rad: float  # stars this near a detection matter
    tried: int = 0  # matching triangles so far
    mirrored: list[tuple[Array, Array, int, float]] = field(default_factory=list)  # matches of the other handedness

    def hypotheses(self, tolerance_px: float, rough_px: float) -> Iterator[AttitudeHypothesis]:
        """Attitudes that are unlikely by chance.

        First from long triangles of the few brightest detections, then of fainter ones and with more catalogue stars,
        then from triangles assembled from catalogue pairs; last from short ones, for rays with errors of `rough_px`:
        over short distances a rough calibration is still accurate.
        """
        brightest, beyond = list(self._prefixes()), list(self._windows())
        tolerance = tolerance_px * self.scale.axis_rad_per_px
        for windows in (brightest, beyond):
            for deep in (False, True):
                for first, fresh, end in windows:
                    index = self.patterns.deep_index if deep else self.patterns.bright_index
                    yield from self._attitudes_from_triangles(index, first, fresh, end, tolerance)
        yield from self._attitudes_from_pairs(tolerance)
        yield from self._attitudes_from_short_triangles(rough_px * self.scale.axis_rad_per_px)

    def mirrored_hypotheses(self) -> Iterator[AttitudeHypothesis]:
        """The same for the mirror image, from the stored triangles of the other handedness."""
        flip = np.array([-1.0, 1.0, 1.0])
        for cam, icrs, first, tolerance in self.mirrored:
            yield from self._plausible_attitudes(cam * flip, icrs, self.rays_cam * flip, first, tolerance)

    def _prefixes(self) -> Iterator[tuple[int, int, int]]:
        n = len(self.rays_cam)
        return ((0, done, min(end, n)) for done, end in pairwise(PREFIXES) if done < n)

    def _windows(self) -> Iterator[tuple[int, int, int]]:
        n = min(len(self.rays_cam), DEEPEST_RANK)
        start = PREFIXES[-1] - (WINDOW_RANKS - NEW_RANKS)
        return (
            (k, WINDOW_RANKS - NEW_RANKS, min(k + WINDOW_RANKS, n))
            for k in range(start, n - WINDOW_RANKS + NEW_RANKS, NEW_RANKS)
        )

    def _attitudes_from_triangles(
        self, index: PatternIndex, first: int, fresh: int, end: int, tolerance: float
    ) -> Iterator[AttitudeHypothesis]:
        """From triangles of the detections `first` to `end` that have a vertex from the `fresh`-th of them on."""
        vertices, sides = sides_of_few(self.rays_cam[first:end], fresh)
        ordered = np.sort(sides, axis=1)
        short = np.flatnonzero(ordered[:, 2] < index.longest_chord)
        left, right = index.candidates(ordered[short], tolerance, MATCHES_EACH)
        if len(left):
            left = short[left]
            order = np.argsort(sides[left], axis=1)
            vertex = vertices[left[:, None], order] + first
            icrs = index.rays_icrs[index.vertices[right]]
            yield from self._test_triangles(self.rays_cam[vertex], icrs, index.handedness[right], first, tolerance)

    def _attitudes_from_pairs(self, tolerance: float) -> Iterator[AttitudeHypothesis]:
        index, few = self.patterns.pairs, self.rays_cam[:PIVOTS]
        for pivot in range(len(few) - 2):
            image, catalogue = index.triangles(few[pivot:], tolerance)
            if len(image):
                icrs = index.rays_icrs[catalogue]
                yield from self._test_triangles(few[image + pivot], icrs, np.linalg.det(icrs), 0, tolerance)

    def _attitudes_from_short_triangles(self, tolerance: float) -> Iterator[AttitudeHypothesis]:
        index = self.patterns.deep_index
        longest = min(ROUGH_SIDE_RAD, ROUGH_FRACTION * self.scale.diameter_rad)
        image = triangles(self.rays_cam[:ROUGH_DEPTH], longest, MAX_IMAGE_TRIANGLES)
        left, right = index.candidates(2 * np.sin(image.sides_rad / 2), tolerance, ROUGH_MATCHES_EACH)
        self.tried += max(len(left) - MAX_ROUGH, 0)
        left, right = left[:MAX_ROUGH], right[:MAX_ROUGH]
        if len(left):
            cam, icrs = self.rays_cam[image.vertices[left]], index.rays_icrs[index.vertices[right]]
            yield from self._test_triangles(cam, icrs, index.handedness[right], 0, tolerance)

    def _test_triangles(
        self, cam: Array, icrs: Array, handedness: Array, first: int, tolerance: float
    ) -> Iterator[AttitudeHypothesis]:
        """Test the triangles cam (m, 3, 3) of the catalogue's handedness (m,); store the others in `mirrored`."""
        self.tried += len(cam)
        same = np.linalg.det(cam) * handedness > 0
        if np.count_nonzero(same) < len(same):
            self.mirrored.append((cam[~same], icrs[~same], first, tolerance))
            cam, icrs = cam[same], icrs[same]
        yield from self._plausible_attitudes(cam, icrs, self.rays_cam, first, tolerance)

    def _plausible_attitudes(
        self, cam: Array, icrs: Array, rays_cam: Array, first: int, tolerance: float
    ) -> Iterator[AttitudeHypothesis]:
        """Attitudes that rotate the rays icrs (m, 3, 3) to cam (m, 3, 3) and that bright stars support."""
        some, radius = rays_cam[: first + VERIFIED_DETECTIONS], 2.0 * tolerance
        depth = int(DEPTH_FACTOR * 4 * np.pi / self.patterns.field_sr * len(some))
        for R in self._supported_attitudes(
            cam, icrs, some[max(first - WINDOW_RANKS, 0) : first + PRETESTED_DETECTIONS], radius, depth
        ):
            near = self.patterns.neighbours(some @ R, self.neighbour_radius_rad, depth)
            hit = near.chord < radius
            hits = min(int(np.count_nonzero(hit)), len(some))
            if hits < MIN_HITS:
                continue
            if self._false_alarms(hits - PATTERN_MATCHES, len(some), near.depth, radius) < PLAUSIBLE:
                yield AttitudeHypothesis(R, near.ray[hit], near.star[hit], near if len(some) == len(rays_cam) else None)

    def _supported_attitudes(self, cam: Array, icrs: Array, some: Array, radius: float, depth: int) -> Iterator[Array]:
        """R_cam_icrs of the closest match, which is nearly always right, then of matches that detections support."""
        if len(cam):
            yield wahba(cam[0], icrs[0])
        tree = self.patterns.tree(depth)
        for start in range(1, len(cam), PRETEST_BATCH):
            R = wahba(cam[start : start + PRETEST_BATCH], icrs[start : start + PRETEST_BATCH])
            distance = tree.query(some @ R, distance_upper_bound=radius)[0]
            hits = np.count_nonzero(distance < radius, axis=1)
            best = np.argsort(-hits, kind="stable")
            expected = self._false_alarms(np.maximum(hits[best] - PATTERN_MATCHES, 1), len(some), tree.n, radius)
            yield from R[best[expected < PLAUSIBLE]]

    def _false_alarms(self, further: Ints | int, rays: int, depth: int, radius: float) -> Array:
        """Expected number of trials in which so many further rays hit one of the `depth` brightest stars by chance."""
        return expected_false_alarms(self.tried, further, rays, min(depth * radius**2 / 4, 1.0))
