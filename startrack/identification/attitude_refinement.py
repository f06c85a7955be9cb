"""An attitude refined with all stars: one-to-one matches of detections and stars by position and brightness."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from startrack.core.types import Array, Bools, Centroids, Ints
from startrack.estimation.adjust import CHI2_2DOF_MEDIAN, SMALLEST_EXTRA_PX2, STAR_OUTLIER_CHI2
from startrack.estimation.match import (
    BRIGHTER_MAG,
    CandidatePairs,
    PhotometricScale,
    brightness_agreement,
    upper_median,
)
from startrack.identification.attitude_search import (
    FIRST_GATE_PX,
    GATE_PX,
    INLIER_PX,
    MIN_MATCHES,
    AttitudeHypothesis,
    Sources,
)
from startrack.identification.star_grid import rotation_between

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
        refined = rotation_between(sources.rays_cam[detection[used]], rays_icrs[used], 1.0 / variance[agree])
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
