"""Attitudes: triangles of detections that match the catalogue's, tested against bright stars, refined with all stars.

All arrays are small and the number of numpy calls is kept low: a typical search ends with its first triangles.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise

import numpy as np

from startrack.camera import Camera
from startrack.core.types import Array, Bools, Centroids, Ints
from startrack.estimation.adjust import CHI2_2DOF_MEDIAN, SMALLEST_EXTRA_PX2, STAR_OUTLIER_CHI2
from startrack.estimation.false_alarm import PATTERN_MATCHES, expected_false_alarms
from startrack.estimation.match import (
    BRIGHTER_MAG,
    CandidatePairs,
    PhotometricScale,
    brightness_agreement,
    upper_median,
)
from startrack.frames import wahba
from startrack.identification.index import CatalogPatterns, Neighbours, PixelScale
from startrack.identification.triangles import PatternIndex, sides_of_few, triangles

PREFIXES = (0, 7, 10, 14, 20, 28)  # number of brightest detections that form triangles, round by round
WINDOW_RANKS = 24  # ranks of brightness that form triangles beyond these, half of them new in each window
NEW_RANKS = WINDOW_RANKS // 2
DEEPEST_RANK = 10 * WINDOW_RANKS
ROUGH_SIDE_RAD, ROUGH_FRACTION = np.radians(20.0), 0.4  # longest sides of short triangles, the second of the field
PIVOTS = 16  # brightest detections about which triangles of catalogue pairs are tried
MATCHES_EACH, ROUGH_MATCHES_EACH = 3, 8  # catalogue triangles looked up for a triangle of detections
MAX_IMAGE_TRIANGLES, MAX_ROUGH = 20_000, 3000  # short triangles of detections; their matches that are tried
VERIFIED_DETECTIONS = 256  # detections tested against the stars
PRETESTED = VERIFIED_DETECTIONS // 4  # detections in the first test of many hypotheses; as many are tested together
DEPTH_FACTOR = 4  # catalogue stars per detection (of the whole sky): some are hidden or too faint
MIN_MATCHES = 6
PLAUSIBLE = 1e-2  # expected false alarms below which a hypothesis is refined; the final limit is tested later
GATE_PX = 6.0  # from a predicted star, in which detections are matched
FIRST_GATE_PX = GATE_PX / 2
INLIER_PX = 1.5  # largest distance of a detection on its star
ONE_SOURCE_SIGMAS = 3.0  # of the PSF: radius within which stars share one detection
MATCH_ROUNDS = 4  # of matching and rotating; one suffices if the bright stars determine the attitude
SETTLED_PX = 0.15
MAX_DRIFT_PX = 0.7  # change of the attitude up to which the neighbours remain valid


@dataclass(frozen=True)
class Sources:
    """Detections inside the image circle of a camera, brightest first, and the stars that they may be."""

    centroids: Centroids
    rays_cam: Array  # (n, 3)
    camera: Camera
    scale: PixelScale
    patterns: CatalogPatterns

    @cached_property
    def variance_px2(self) -> Array:
        """Variance (n,) of a position, the mean of both axes."""
        covariance = self.centroids.covariance_px2
        return 0.5 * (covariance[:, 0, 0] + covariance[:, 1, 1])

    @property
    def neighbour_radius_rad(self) -> float:
        """Distance from a detection within which stars are looked up at a rough attitude."""
        return (max(GATE_PX, ONE_SOURCE_SIGMAS * self.centroids.psf_sigma_px) + 1.0) * self.scale.largest_rad_per_px

    def mirror_image(self) -> Sources:
        """The same detections seen by the mirror-image camera."""
        camera = replace(self.camera, mirrored=not self.camera.mirrored)
        return replace(self, camera=camera, rays_cam=camera.unproject(self.centroids.xy_px))


@dataclass(frozen=True)
class AttitudeHypothesis:
    """A rough attitude with the pairs that coincide."""

    R_cam_icrs: Array
    detection: Ints  # (k,)
    star: Ints  # (k,)
    near: Neighbours | None  # all stars near the detections, where they were looked up


class AttitudeSearch:
    """Hypotheses of the attitude, in order of likelihood."""

    def __init__(self, sources: Sources) -> None:
        self.sources, self.rays_cam, self.patterns, self.scale = (
            sources, sources.rays_cam, sources.patterns, sources.scale,
        )  # fmt: skip
        self.tried = 0  # matching triangles so far

    def hypotheses(self, tolerance_px: float, rough_px: float) -> Iterator[AttitudeHypothesis]:
        """Attitudes that are unlikely by chance.

        First from long triangles of the few brightest detections, then of fainter ones and with more catalogue stars,
        then from triangles assembled from catalogue pairs; last from short ones, for rays with errors of `rough_px`:
        over short distances a rough calibration is still accurate.
        """
        n = len(self.rays_cam)
        brightest = [(0, done, min(end, n)) for done, end in pairwise(PREFIXES) if done < n]
        most, overlap = min(n, DEEPEST_RANK), WINDOW_RANKS - NEW_RANKS
        beyond = [
            (first, overlap, min(first + WINDOW_RANKS, most))
            for first in range(PREFIXES[-1] - overlap, most - overlap, NEW_RANKS)
        ]
        tolerance = tolerance_px * self.scale.axis_rad_per_px
        for windows in (brightest, beyond):
            for deep in (False, True):
                for first, fresh, end in windows:
                    index = self.patterns.deep_index if deep else self.patterns.bright_index
                    yield from self._attitudes_from_triangles(index, first, fresh, end, tolerance)
        yield from self._attitudes_from_pairs(tolerance)
        yield from self._attitudes_from_short_triangles(rough_px * self.scale.axis_rad_per_px)

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
        image = triangles(self.rays_cam[: DEEPEST_RANK // 2], longest, MAX_IMAGE_TRIANGLES)
        left, right = index.candidates(2 * np.sin(image.sides_rad / 2), tolerance, ROUGH_MATCHES_EACH)
        self.tried += max(len(left) - MAX_ROUGH, 0)
        left, right = left[:MAX_ROUGH], right[:MAX_ROUGH]
        if len(left):
            cam, icrs = self.rays_cam[image.vertices[left]], index.rays_icrs[index.vertices[right]]
            yield from self._test_triangles(cam, icrs, index.handedness[right], 0, tolerance)

    def _test_triangles(
        self, cam: Array, icrs: Array, handedness: Array, first: int, tolerance: float
    ) -> Iterator[AttitudeHypothesis]:
        """Attitudes that rotate rays icrs (m, 3, 3), of this handedness (m,), to cam (m, 3, 3), by bright stars."""
        self.tried += len(cam)
        same = np.linalg.det(cam) * handedness > 0
        cam, icrs, rays_cam = cam[same], icrs[same], self.rays_cam
        some, radius = rays_cam[: first + VERIFIED_DETECTIONS], 2.0 * tolerance
        depth = int(DEPTH_FACTOR * 4 * np.pi / self.patterns.field_sr * len(some))
        for R in self._supported_attitudes(
            cam, icrs, some[max(first - WINDOW_RANKS, 0) : first + PRETESTED], radius, depth
        ):
            near = self.patterns.neighbours(some @ R, self.sources.neighbour_radius_rad, depth)
            hit = near.chord < radius
            hits = min(int(np.count_nonzero(hit)), len(some))
            if hits < MIN_MATCHES:
                continue
            if self._false_alarms(hits - PATTERN_MATCHES, len(some), near.depth, radius) < PLAUSIBLE:
                yield AttitudeHypothesis(R, near.ray[hit], near.star[hit], near if len(some) == len(rays_cam) else None)

    def _supported_attitudes(self, cam: Array, icrs: Array, some: Array, radius: float, depth: int) -> Iterator[Array]:
        """R_cam_icrs of the closest match, which is nearly always right, then of matches that detections support."""
        if len(cam):
            yield wahba(cam[0], icrs[0])
        tree = self.patterns.tree(depth)
        for start in range(1, len(cam), PRETESTED):
            R = wahba(cam[start : start + PRETESTED], icrs[start : start + PRETESTED])
            distance = tree.query(some @ R, distance_upper_bound=radius)[0]
            hits = np.count_nonzero(distance < radius, axis=1)
            best = np.argsort(-hits, kind="stable")
            expected = self._false_alarms(np.maximum(hits[best] - PATTERN_MATCHES, 1), len(some), tree.n, radius)
            yield from R[best[expected < PLAUSIBLE]]

    def _false_alarms(self, further: Ints | int, rays: int, depth: int, radius: float) -> Array:
        """Expected number of trials in which so many further rays hit one of the `depth` brightest stars by chance."""
        return expected_false_alarms(self.tried, further, rays, min(depth * radius**2 / 4, 1.0))


@dataclass(frozen=True)
class AttitudeMatch:
    """An attitude with its matches."""

    R_cam_icrs: Array
    pairs: CandidatePairs
    matched: Ints  # (m,) indices of pairs: mutually nearest, agreeing in brightness, within GATE_PX
    named: Bools  # (m,) close enough to be identified
    inlier: Bools  # (m,) as close as the stated centroid errors predict
    variance_px2: Array  # (m,) per axis, the error common to all stars added
    visible_v_mag: Array  # of the stars in the image circle that are bright enough to be detected


def refine_attitude(sources: Sources, hypothesis: AttitudeHypothesis) -> AttitudeMatch | None:
    """Match all stars by position and brightness, starting from the bright ones that coincide.

    None where too few agree.
    """
    d, stars, scale = sources.centroids, sources.patterns.stars, sources.scale
    R = wahba(sources.rays_cam[hypothesis.detection], stars.rays_icrs[hypothesis.star])
    photometry = PhotometricScale.from_matches(
        d.flux_e, d.saturated, stars.v_mag[hypothesis.star], hypothesis.detection
    )
    limit, complete = np.searchsorted(stars.v_mag, [photometry.limit_mag, photometry.complete_mag]).tolist()
    near = hypothesis.near
    drift_px = np.abs(hypothesis.R_cam_icrs - R).max() / scale.axis_rad_per_px
    if near is None or near.depth < limit or drift_px > MAX_DRIFT_PX:
        near = sources.patterns.neighbours(sources.rays_cam @ R, sources.neighbour_radius_rad, limit)
    detection, star = near.ray, near.star
    rays_icrs, v_mag = stars.rays_icrs[star], stars.v_mag[star]
    v_sigma_mag = stars.v_sigma_mag[star] + d.brightness_sigma_mag
    xy_px = d.xy_px[detection]
    for _ in range(MATCH_ROUNDS):
        px, inside = sources.camera.project(rays_icrs @ R.T)
        off = px - xy_px
        distance = np.sqrt(np.einsum("ni,ni->n", off, off))
        distance[~inside | (distance > GATE_PX)] = np.inf
        pairs = CandidatePairs(detection, star, distance, v_mag, v_sigma_mag, photometry)
        matched = pairs.one_to_one_pairs
        if len(matched) < MIN_MATCHES:
            return None
        agree, variance = _select_inliers(pairs, matched, sources.variance_px2)
        used = matched[agree]
        if len(used) < MIN_MATCHES:
            return None
        refined = wahba(sources.rays_cam[detection[used]] / variance[agree][:, None], rays_icrs[used])
        if np.abs(refined - R).max() / scale.axis_rad_per_px < SETTLED_PX:
            break
        R = refined
    visible = stars.rays_icrs[:complete] @ R[2] > np.cos(sources.camera.max_angle_rad)
    squared, misfit = np.square(pairs.distance_px[matched]), pairs.brightness_misfit[matched]
    inlier = squared < np.maximum(INLIER_PX**2, STAR_OUTLIER_CHI2 * sources.variance_px2[detection[matched]])
    # Position and brightness may not both be at the edge of what is allowed.
    named = inlier & agree & (squared / (STAR_OUTLIER_CHI2 * variance) + misfit * misfit < 1.0)
    return AttitudeMatch(refined, pairs, matched, named, inlier, variance, stars.v_mag[:complete][visible])


def _select_inliers(pairs: CandidatePairs, which: Ints, variance_px2: Array) -> tuple[Bools, Array]:
    """Which of the pairs are no outliers, and their variance per axis [px^2], the common error added.

    The common error is estimated as in `extra_variance_px2`, but in closed form: for one variance per star.
    """
    distance = pairs.distance_px[which]
    stated = variance_px2[pairs.detection[which]]
    first = distance < FIRST_GATE_PX
    if not first.any():
        return first, stated
    squared = np.square(distance)
    extra = upper_median(squared[first]) / CHI2_2DOF_MEDIAN - upper_median(stated[first])
    variance = stated + max(extra, SMALLEST_EXTRA_PX2)
    return first & (squared < STAR_OUTLIER_CHI2 * variance), variance


def agreement_of(centroids: Centroids, v_mag: Array, measured_mag: Array, dimmed_mag: float = BRIGHTER_MAG) -> float:
    """Fraction of random pairs that agree in brightness; 1 where the brightness is not known."""
    known = np.isfinite(centroids.brightness_sigma_mag)
    return brightness_agreement(v_mag, measured_mag, dimmed_mag) if known else 1.0
