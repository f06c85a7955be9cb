"""Attitudes: triangles of detections that match the catalogue's, tested against bright stars.

All arrays are small and the number of numpy calls is kept low: a typical search ends with its first triangles. Near a
rough attitude pairs of a detection and a star are tried instead: the right ones agree with each other in their
separations.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise

import numpy as np

from startrack.camera import Camera
from startrack.core.limits import check_time, stating_work
from startrack.core.types import Array, Centroids, Ints
from startrack.estimation.false_alarm import PATTERN_MATCHES, expected_false_alarms
from startrack.frames import wahba
from startrack.identification.index import CatalogPatterns, PixelScale
from startrack.identification.near_sky import NearSky
from startrack.identification.star_grid import Neighbours, rotation_between, settle_rotation
from startrack.identification.triangles import (
    PatternIndex,
    are_same_handed,
    sides_of_few,
    triad_attitude,
    triangles,
)

MOST_OFF_RAD = np.radians(12.0)  # of a rough attitude
MOST_OFF_OF_FIELD = 0.2  # of the field's diameter, at most
NEAR_DETECTIONS = 32  # brightest detections
NEAR_STARS_1 = 3  # brightest stars of the field for each of them
MOST_PAIRS = 200  # those closest together
AGREEING_1 = 0.5  # of the pairs that agree with the best one: a right pair agrees with all right ones
PREFIXES = (0, 7, 10, 14, 20, 28)  # number of brightest detections that form triangles, round by round
WINDOW_RANKS = 24  # ranks of brightness that form triangles beyond these, half of them new in each window
NEW_RANKS = WINDOW_RANKS // 2
DEEPEST_RANK = 10 * WINDOW_RANKS
BRIGHTEST = [(0, done, end) for done, end in pairwise(PREFIXES)]  # ranks: the first, how many are not new, the end
BEYOND = [
    (first, WINDOW_RANKS - NEW_RANKS, min(first + WINDOW_RANKS, DEEPEST_RANK))
    for first in range(PREFIXES[-1] + NEW_RANKS - WINDOW_RANKS, DEEPEST_RANK + NEW_RANKS - WINDOW_RANKS, NEW_RANKS)
]
ROUGH_SIDE_RAD, ROUGH_FRACTION = np.radians(20.0), 0.4  # longest sides of short triangles, the second of the field
PIVOTS = 16  # brightest detections about which triangles of catalogue pairs are tried
MATCHES_EACH, ROUGH_MATCHES_EACH = 3, 8  # catalogue triangles looked up for a triangle of detections
MATCHES_EACH_NEAR_SKY = 200  # of the whole sky, of which those in a stated part of it are tried
MAX_IMAGE_TRIANGLES, MAX_ROUGH = 20_000, 3000  # short triangles of detections; their matches that are tried
VERIFIED_DETECTIONS = 256  # detections tested against the stars
PRETESTED = VERIFIED_DETECTIONS // 4  # detections in the first test of many hypotheses; as many are tested together
DEPTH_FACTOR = 4  # catalogue stars per detection (of the whole sky): some are hidden or too faint
MIN_MATCHES = 6
MIN_MATCHES_NEAR_SKY = 5  # one star beyond a triangle can always be chance
PLAUSIBLE = 1e-2  # expected false alarms below which a hypothesis is refined; the final limit is tested later
GATE_PX = 6.0  # from a predicted star, in which detections are matched
FIRST_GATE_PX = GATE_PX / 2
INLIER_PX = 1.5  # largest distance of a detection on its star
ONE_SOURCE_SIGMAS = 3.0  # of the PSF: radius within which stars share one detection
SETTLING_LOOKUPS = 4  # one or two suffice
# Of a rough attitude that is the right one: 0.8 of rendered frames, 0.45 of coarse pixels. One that is a degree off
# fits the stars about one axis only.
LEAST_PART = 0.3
MAX_DRIFT_PX = 0.7  # change of the attitude up to which the neighbours remain valid


def agreeing_pairs(
    rays_cam: Array, R_cam_icrs: Array, patterns: CatalogPatterns, diameter_rad: float, tolerance: float
) -> tuple[Ints, Ints, int]:
    """The detections (k,) and stars (k,) of the largest group of pairs that one rotation explains; the number tried.

    `rays_cam` (n, 3): detections, brightest first. Stars are looked for about where the rough attitude `R_cam_icrs`
    places the detections, up to MOST_OFF_RAD or MOST_OFF_OF_FIELD of the field's `diameter_rad`. Any two pairs whose
    detections and stars are equally far apart, to a `tolerance` of the chord, propose an attitude: these are counted.
    """
    rays, radius = rays_cam[:NEAR_DETECTIONS], min(MOST_OFF_RAD, MOST_OFF_OF_FIELD * diameter_rad)
    depth = int(NEAR_STARS_1 * 4 * np.pi / patterns.field_sr * len(rays))
    near = patterns.neighbours(rays @ R_cam_icrs, radius, depth)
    bright = np.flatnonzero(near.star < depth)
    bright = np.sort(bright[np.argsort(near.chord[bright], kind="stable")[:MOST_PAIRS]])
    detection, star = near.ray[bright], near.star[bright]
    apart_cam, apart_icrs = (_chords(some) for some in (rays[detection], patterns.stars.rays_icrs[star]))
    agree = (np.abs(apart_cam - apart_icrs) < tolerance) & (detection[:, None] != detection) & (star[:, None] != star)
    votes = np.count_nonzero(agree, axis=1)
    if not votes.any():
        return detection[:0], star[:0], 0
    best = int(np.argmax(votes))
    group = np.flatnonzero((agree[best] | (np.arange(len(votes)) == best)) & (votes >= AGREEING_1 * votes[best]))
    group = group[np.argsort(-votes[group], kind="stable")]
    group = group[np.unique(detection[group], return_index=True)[1]]
    return detection[group], star[group], int(votes.sum()) // 2


def _chords(rays: Array) -> Array:
    """Distances (n, n) between unit vectors (n, 3)."""
    return np.sqrt(np.maximum(2.0 - 2.0 * (rays @ rays.T), 0.0))


@dataclass(frozen=True)
class Sources:
    """Detections inside the image circle of a camera, brightest first, and the stars that they may be."""

    centroids: Centroids
    rays_cam: Array  # (n, 3)
    camera: Camera
    scale: PixelScale
    patterns: CatalogPatterns
    near_sky: NearSky | None = None  # where the camera points; None: anywhere

    @cached_property
    def variance_px2(self) -> Array:
        """Variance (n,) of a position, the mean of both axes."""
        covariance = self.centroids.covariance_px2
        return 0.5 * (covariance[:, 0, 0] + covariance[:, 1, 1])

    @property
    def min_matches(self) -> int:
        """Fewest stars that an identification may have."""
        return MIN_MATCHES if self.near_sky is None else MIN_MATCHES_NEAR_SKY

    @property
    def sky_part(self) -> float:
        """Part of the sky in which the camera points; of the trials of the whole sky chance gives this part there."""
        return 1.0 if self.near_sky is None else self.near_sky.part

    @property
    def neighbour_radius_rad(self) -> float:
        """Distance from a detection within which stars are looked up at a rough attitude."""
        return (max(GATE_PX, ONE_SOURCE_SIGMAS * self.centroids.psf_sigma_px) + 1.0) * self.scale.largest_rad_per_px

    def mirror_image(self) -> Sources:
        """Copy with the same detections seen by the mirror-image camera."""
        camera = replace(self.camera, mirrored=not self.camera.mirrored)
        return replace(self, camera=camera, rays_cam=camera.unproject(self.centroids.xy_px))


@dataclass(frozen=True)
class AttitudeHypothesis:
    """A rough attitude with the pairs that coincide."""

    R_cam_icrs: Array
    detection: Ints  # (k,)
    star: Ints  # (k,)
    near: Neighbours | None  # all stars near the detections, where they were looked up
    part: float  # of the pairs of a bright detection and a star near it that coincide


class AttitudeSearch:
    """Hypotheses of the attitude, in order of likelihood."""

    def __init__(self, sources: Sources) -> None:
        self.sources, self.rays_cam, self.patterns, self.scale = (
            sources, sources.rays_cam, sources.patterns, sources.scale,
        )  # fmt: skip
        self.tried = 0  # matching triangles so far, of the whole sky

    def hypotheses(self, tolerance_px: float, rough_px: float) -> Iterator[AttitudeHypothesis]:
        """Attitudes that are unlikely by chance.

        First from long triangles of the few brightest detections, then of fainter ones and with more catalogue stars,
        then from triangles assembled from catalogue pairs; last from short ones, for rays with errors of `rough_px`:
        over short distances a rough calibration is still accurate.
        """
        with stating_work(lambda: f"{len(self.rays_cam)} point sources: {self.tried} matching triangles tried"):
            yield from self._hypotheses(tolerance_px, rough_px)

    def _hypotheses(self, tolerance_px: float, rough_px: float) -> Iterator[AttitudeHypothesis]:
        n, tolerance = len(self.rays_cam), tolerance_px * self.scale.axis_rad_per_px
        for windows in (BRIGHTEST, BEYOND):
            for deep in (False, True):
                for first, fresh, end in windows:
                    if first + fresh < n:
                        index = self.patterns.deep_index if deep else self.patterns.bright_index
                        yield from self._attitudes_from_triangles(index, first, fresh, end, tolerance)
        yield from self._attitudes_from_pairs(tolerance)
        yield from self._attitudes_from_short_triangles(rough_px * self.scale.axis_rad_per_px)

    def hypotheses_near(self, near_R_cam_icrs: Array, tolerance_px: float) -> Iterator[AttitudeHypothesis]:
        """A rough attitude itself, then the one at which the most bright detections beside stars agree.

        Only those that are unlikely by chance.
        """
        tolerance = tolerance_px * self.scale.axis_rad_per_px
        self.tried += 1
        for itself in self._test_attitudes([near_R_cam_icrs], 0, 2.0 * tolerance):
            if itself.part > LEAST_PART:
                yield itself
        detection, star, tried = agreeing_pairs(
            self.rays_cam, near_R_cam_icrs, self.patterns, self.scale.diameter_rad, tolerance
        )
        self.tried += tried
        if len(detection) >= PATTERN_MATCHES:
            R = wahba(self.rays_cam[detection], self.patterns.stars.rays_icrs[star])
            yield from self._test_attitudes([R], 0, 2.0 * tolerance)

    def _attitudes_from_triangles(
        self, index: PatternIndex, first: int, fresh: int, end: int, tolerance: float
    ) -> Iterator[AttitudeHypothesis]:
        """Attitudes from triangles of the detections `first` to `end` with a vertex from the `fresh`-th of them on."""
        check_time()
        some = self.rays_cam[first:end]
        vertices, sides = sides_of_few(some, fresh, index.longest_chord)
        left, right = index.candidates(sides, tolerance, self._matches_each(MATCHES_EACH))
        if len(left):
            cam, icrs = some[vertices[left]], index.rays_icrs[index.vertices[right]]
            yield from self._test_triangles(cam, icrs, first, tolerance)

    def _attitudes_from_pairs(self, tolerance: float) -> Iterator[AttitudeHypothesis]:
        index, few = self.patterns.pairs, self.rays_cam[:PIVOTS]
        for pivot in range(len(few) - 2):
            check_time()
            image, catalogue = index.triangles(few[pivot:], tolerance)
            if len(image):
                yield from self._test_triangles(few[image + pivot], index.rays_icrs[catalogue], 0, tolerance)

    def _attitudes_from_short_triangles(self, tolerance: float) -> Iterator[AttitudeHypothesis]:
        index = self.patterns.deep_index
        longest = min(ROUGH_SIDE_RAD, ROUGH_FRACTION * self.scale.diameter_rad)
        image = triangles(self.rays_cam[: DEEPEST_RANK // 2], longest, MAX_IMAGE_TRIANGLES)
        most = self._matches_each(ROUGH_MATCHES_EACH)
        left, right = index.candidates(2 * np.sin(image.sides_rad / 2), tolerance, most)
        self.tried += max(len(left) - MAX_ROUGH, 0)
        left, right = left[:MAX_ROUGH], right[:MAX_ROUGH]
        if len(left):
            cam, icrs = self.rays_cam[image.vertices[left]], index.rays_icrs[index.vertices[right]]
            yield from self._test_triangles(cam, icrs, 0, tolerance)

    def _test_triangles(self, cam: Array, icrs: Array, first: int, tolerance: float) -> Iterator[AttitudeHypothesis]:
        """Attitudes that rotate rays icrs (m, 3, 3) to cam (m, 3, 3), tested by bright stars; no mirror images."""
        self.tried += len(cam)
        same = are_same_handed(cam, icrs)
        if self.sources.near_sky is not None:
            same &= self.sources.near_sky.contains(triad_attitude(cam, icrs))
        some = self.rays_cam[max(first - WINDOW_RANKS, 0) : first + PRETESTED]
        supported = self._supported_attitudes(cam[same], icrs[same], some, 2.0 * tolerance, self._depth(first))
        yield from self._test_attitudes(supported, first, 2.0 * tolerance)

    def _matches_each(self, most: int) -> int:
        """Limit of matches of one triangle: `most`, or more where only a part of the sky is tried."""
        return most if self.sources.near_sky is None else MATCHES_EACH_NEAR_SKY

    def _depth(self, first: int) -> int:
        """Number of the brightest stars that the detections up to some beyond the `first` may be."""
        rays = len(self.rays_cam[: first + VERIFIED_DETECTIONS])
        return int(DEPTH_FACTOR * 4 * np.pi / self.patterns.field_sr * rays)

    def _test_attitudes(self, attitudes: Iterable[Array], first: int, radius: float) -> Iterator[AttitudeHypothesis]:
        """The `attitudes` at which more detections hit a star within the `radius` than chance makes likely."""
        rays = len(self.rays_cam[: first + VERIFIED_DETECTIONS])
        for R in attitudes:
            check_time()
            near = self._neighbours(R, first)
            hits = min(int(np.count_nonzero(near.chord < radius)), rays)
            if hits < self.sources.min_matches:
                continue
            if self._false_alarms(hits - PATTERN_MATCHES, rays, near.depth, radius) < PLAUSIBLE:
                settled = self._settle(R, near, first, radius)
                if len(settled.star) >= self.sources.min_matches:
                    yield settled

    def _neighbours(self, R: Array, first: int) -> Neighbours:
        """The stars near the detections up to some beyond the `first`, at the attitude `R`."""
        rays = self.rays_cam[: first + VERIFIED_DETECTIONS] @ R
        return self.patterns.neighbours(rays, self.sources.neighbour_radius_rad, self._depth(first))

    def _settle(self, R: Array, near: Neighbours, first: int, radius: float) -> AttitudeHypothesis:
        """The attitude that is the best for the stars which it places within the `radius` of a detection.

        It begins at `R`, with the stars `near` the detections there. Whatever attitude in its surroundings proposes it,
        the result is the same.
        """
        for _ in range(SETTLING_LOOKUPS):
            pairs = self.rays_cam.take(near.ray, axis=0), self.patterns.stars.rays_icrs.take(near.star, axis=0)
            before, (R, hit) = R, settle_rotation(*pairs, near.chord < radius, radius**2)
            if np.abs(R - before).max() < MAX_DRIFT_PX * self.scale.axis_rad_per_px:
                break
            near = self._neighbours(R, first)
        is_whole = len(self.rays_cam) <= first + VERIFIED_DETECTIONS
        part = np.count_nonzero(hit) / len(hit)
        return AttitudeHypothesis(R, near.ray[hit], near.star[hit], near if is_whole else None, part)

    def _supported_attitudes(self, cam: Array, icrs: Array, some: Array, radius: float, depth: int) -> Iterator[Array]:
        """R_cam_icrs of the closest match, which is nearly always right, then of matches that detections support."""
        if len(cam):
            yield rotation_between(cam[0], icrs[0], np.ones(len(cam[0])))
        for start in range(1, len(cam), PRETESTED):
            check_time()
            R = wahba(cam[start : start + PRETESTED], icrs[start : start + PRETESTED])
            near = self.patterns.neighbours((some @ R).reshape(-1, 3), 2 * np.arcsin(radius / 2), depth)
            hit = near.ray[np.diff(near.ray, prepend=-1) > 0]  # each once
            hits = np.bincount(hit // len(some), minlength=len(R))
            best = np.argsort(-hits, kind="stable")
            expected = self._false_alarms(np.maximum(hits[best] - PATTERN_MATCHES, 1), len(some), near.depth, radius)
            yield from R[best[expected < PLAUSIBLE]]

    def _false_alarms(self, further: Ints | int, rays: int, depth: int, radius: float) -> Array:
        """Expected number of trials in which so many further rays hit one of the `depth` brightest stars by chance."""
        trials = self.tried * self.sources.sky_part
        return expected_false_alarms(trials, further, rays, min(depth * radius**2 / 4, 1.0))
