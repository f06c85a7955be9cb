"""Refinement of a rough attitude: neighbours looked up once, then a few rounds of matching and Wahba's solution."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from startrack.camera import Camera
from startrack.core.types import Array, Bools, Centroids, Ints
from startrack.estimation.adjust import CHI2_2DOF_MEDIAN, OUTLIER_CHI2, SMALLEST_EXTRA_PX2
from startrack.estimation.match import CandidatePairs, PhotometricScale, upper_median
from startrack.frames import wahba
from startrack.identification.attitude_search import AttitudeHypothesis
from startrack.identification.index import CatalogPatterns, pixel_scale_of

MIN_MATCHES = 6
FIRST_GATE_PX, GATE_PX = 3.0, 6.0
INLIER_PX, INLIER_CHI2 = 1.5, 16.0  # largest distance of a detection from its star; the larger limit applies
BLEND_SIGMAS = 3.0  # of the PSF: radius within which stars share one detection
ROUNDS = 4  # of matching and rotating; one suffices if the bright stars determine the attitude
SETTLED_PX = 0.15
MAX_DRIFT_PX = 0.7  # change of the attitude up to which the neighbours remain valid


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


@dataclass(frozen=True)
class AttitudeRefiner:
    """Refinement by position and brightness: AttitudeHypothesis -> AttitudeMatch."""

    camera: Camera
    centroids: Centroids
    rays_cam: Array  # (n, 3)
    variance_px2: Array  # (n,) per axis
    patterns: CatalogPatterns

    def __call__(self, hypothesis: AttitudeHypothesis) -> AttitudeMatch | None:
        """Match all stars, starting from the bright ones that coincide; None where too few agree."""
        d, stars, scale = self.centroids, self.patterns.stars, pixel_scale_of(self.camera)
        R = wahba(self.rays_cam[hypothesis.detection], stars.rays_icrs[hypothesis.star])
        photometry = PhotometricScale.from_matches(
            d.flux_e, d.saturated, stars.v_mag[hypothesis.star], hypothesis.detection
        )
        limit, complete = np.searchsorted(stars.v_mag, [photometry.limit_mag, photometry.complete_mag]).tolist()
        near = hypothesis.near
        drift_px = np.abs(hypothesis.R_cam_icrs - R).max() / scale.axis_rad_per_px
        if near is None or near.depth < limit or drift_px > MAX_DRIFT_PX:
            radius_rad = neighbour_radius_px(d.psf_sigma_px) * scale.largest_rad_per_px
            near = self.patterns.neighbours(self.rays_cam @ R, radius_rad, limit)
        detection, star = near.ray, near.star
        rays_icrs, v_mag = stars.rays_icrs[star], stars.v_mag[star]
        v_sigma_mag = stars.v_sigma_mag[star] + d.brightness_sigma_mag
        xy_px = d.xy_px[detection]
        for _ in range(ROUNDS):
            px, inside = self.camera.project(rays_icrs @ R.T)
            off = px - xy_px
            distance = np.sqrt(np.einsum("ni,ni->n", off, off))
            distance[~inside | (distance > GATE_PX)] = np.inf
            pairs = CandidatePairs(detection, star, distance, v_mag, v_sigma_mag, photometry)
            matched = pairs.one_to_one_pairs
            if len(matched) < MIN_MATCHES:
                return None
            agree, variance = self._select_inliers(pairs, matched)
            used = matched[agree]
            if len(used) < MIN_MATCHES:
                return None
            refined = wahba(self.rays_cam[detection[used]] / variance[agree][:, None], rays_icrs[used])
            if np.abs(refined - R).max() / scale.axis_rad_per_px < SETTLED_PX:
                break
            R = refined
        visible = stars.rays_icrs[:complete] @ R[2] > np.cos(self.camera.max_angle_rad)
        squared, misfit = np.square(pairs.distance_px[matched]), pairs.brightness_misfit[matched]
        inlier = squared < np.maximum(INLIER_PX**2, INLIER_CHI2 * self.variance_px2[detection[matched]])
        # Position and brightness may not both be at the edge of what is allowed.
        named = inlier & agree & (squared / (OUTLIER_CHI2 * variance) + misfit * misfit < 1.0)
        return AttitudeMatch(refined, pairs, matched, named, inlier, variance, stars.v_mag[:complete][visible])

    def _select_inliers(self, pairs: CandidatePairs, which: Ints) -> tuple[Bools, Array]:
        """Which of the pairs are no outliers, and their variance per axis [px^2], the common error added.

        The common error is estimated as in `extra_variance_px2`, but in closed form: for one variance per star.
        """
        distance = pairs.distance_px[which]
        stated = self.variance_px2[pairs.detection[which]]
        first = distance < FIRST_GATE_PX
        if not first.any():
            return first, stated
        squared = np.square(distance)
        extra = upper_median(squared[first]) / CHI2_2DOF_MEDIAN - upper_median(stated[first])
        variance = stated + max(extra, SMALLEST_EXTRA_PX2)
        return first & (squared < OUTLIER_CHI2 * variance), variance


def neighbour_radius_px(psf_sigma_px: float) -> float:
    """Distance from a detection within which stars are looked up at a rough attitude."""
    return max(GATE_PX, BLEND_SIGMAS * psf_sigma_px) + 1.0
