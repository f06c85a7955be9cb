"""An attitude refined with all stars: one-to-one matches of detections and stars by position and brightness."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from startrack.core.types import Array, Bools, Centroids, Ints
from startrack.estimation.adjust import CHI2_2DOF_MEDIAN, SMALLEST_EXTRA_PX2, STAR_OUTLIER_CHI2
from startrack.estimation.match import BRIGHTER_MAG, CandidatePairs, PhotometricScale, brightness_agreement
from startrack.identification.attitude_search import FIRST_GATE_PX, GATE_PX, INLIER_PX, AttitudeHypothesis, Sources
from startrack.kernels.library import kernel

MATCH_ROUNDS = 4  # of matching and rotating; one suffices if the bright stars determine the attitude
SETTLED_PX = 0.15


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
    R = hypothesis.R_cam_icrs
    photometry = PhotometricScale.from_matches(
        d.flux_e, d.saturated, stars.v_mag[hypothesis.star], hypothesis.detection
    )
    limit, complete = np.searchsorted(stars.v_mag, [photometry.limit_mag, photometry.complete_mag]).tolist()
    near = hypothesis.near
    if near is None or near.depth < limit:
        near = sources.patterns.neighbours(sources.rays_cam @ R, sources.neighbour_radius_rad, limit)
    detection, star = near.ray, near.star
    rays_icrs, v_mag = stars.rays_icrs.take(star, axis=0), stars.v_mag[star]
    v_sigma_mag = stars.v_sigma_mag[star] + d.brightness_sigma_mag
    xy_px = d.xy_px.take(detection, axis=0)
    for _ in range(MATCH_ROUNDS):
        distance = distances_in_gate(xy_px, *sources.camera.project(rays_icrs @ R.T))
        pairs = CandidatePairs(detection, star, distance, v_mag, v_sigma_mag, photometry)
        matched = pairs.one_to_one_pairs
        if len(matched) < sources.min_matches:
            return None
        agree, variance, refined, change = rotate_by_inliers(
            matched, detection, distance, sources.variance_px2, sources.rays_cam, rays_icrs, R
        )
        if np.count_nonzero(agree) < sources.min_matches:
            return None
        if change / scale.axis_rad_per_px < SETTLED_PX:
            break
        R = refined
    visible = stars.rays_icrs[:complete] @ R[2] > np.cos(sources.camera.max_angle_rad)
    inlier, named = name_matches(
        np.square(distance[matched]), sources.variance_px2[detection[matched]], pairs.brightness_misfit[matched], agree,
        variance,
    )  # fmt: skip
    return AttitudeMatch(refined, pairs, matched, named, inlier, variance, stars.v_mag[:complete][visible])


def distances_in_gate(xy_px: Array, px: Array, inside: Bools) -> Array:
    """Distances (k,) of detections (k, 2) and predicted stars (k, 2); infinite beyond GATE_PX and outside the frame."""
    off = px - xy_px
    distance = np.sqrt(off[:, 0] * off[:, 0] + off[:, 1] * off[:, 1])
    return np.where(inside & (distance <= GATE_PX), distance, np.inf)


def rotate_by_inliers(
    which: Ints, detection: Ints, distance: Array, variance_px2: Array, rays_cam: Array, rays_icrs: Array, R: Array
) -> tuple[Bools, Array, Array, float]:
    """Whether the pairs `which` (m,) are no outliers, variances (m,), their attitude (3, 3), and its change from `R`.

    The variance is per axis [px^2], the common error added. This is estimated as in `extra_variance_px2`, but in closed
    form: for one variance per star. `detection`, `distance` (k,) and `rays_icrs` (k, 3) are of all pairs.
    """
    m = len(which)
    agree, variance, refined = np.empty(m, bool), np.empty(m), np.empty((3, 3))
    change = _rotate_by_inliers(
        which, detection, distance, variance_px2, *map(np.ascontiguousarray, (rays_cam, rays_icrs, R)), FIRST_GATE_PX,
        CHI2_2DOF_MEDIAN, SMALLEST_EXTRA_PX2, STAR_OUTLIER_CHI2, np.empty((2, m)), agree, variance, refined,
    )  # fmt: skip
    return agree, variance, refined, change


def name_matches(
    squared_px2: Array, stated_px2: Array, misfit: Array, agree: Bools, variance_px2: Array
) -> tuple[Bools, Bools]:
    """Whether pairs (m,) are inliers, and whether these get a name, by their distances and variances (m,) [px^2]."""
    inlier = squared_px2 < np.maximum(INLIER_PX**2, STAR_OUTLIER_CHI2 * stated_px2)
    # Position and brightness may not both be at the edge of what is allowed.
    edge = squared_px2 / (STAR_OUTLIER_CHI2 * variance_px2) + np.square(misfit)
    return inlier, inlier & agree & (edge < 1.0)


def agreement_of(centroids: Centroids, v_mag: Array, measured_mag: Array, dimmed_mag: float = BRIGHTER_MAG) -> float:
    """Fraction of random pairs that agree in brightness; 1 where the brightness is not known."""
    known = np.isfinite(centroids.brightness_sigma_mag)
    return brightness_agreement(v_mag, measured_mag, dimmed_mag) if known else 1.0


_rotate_by_inliers = kernel(
    "rotate_by_inliers", "which: int64[m]", "detection: int64[k]", "distance: float64[k]", "variance_px2: float64[n]",
    "rays_cam: float64[n, 3]", "rays_icrs: float64[k, 3]", "R: float64[3, 3]", "gate_px: float64",
    "median_chi2: float64", "least_extra: float64", "outlier_chi2: float64", "scratch: out float64[2, m]",
    "agree: out bool[m]", "variance: out float64[m]", "refined: out float64[3, 3]", result="float64",
)  # fmt: skip
