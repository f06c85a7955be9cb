"""An attitude refined with all stars: one-to-one matches of detections and stars by position and brightness."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from startrack.core.kernels import njit
from startrack.core.types import Array, Bools, Centroids, Ints
from startrack.estimation.adjust import CHI2_2DOF_MEDIAN, SMALLEST_EXTRA_PX2, STAR_OUTLIER_CHI2
from startrack.estimation.match import CandidatePairs, PhotometricScale, brightness_agreement
from startrack.estimation.match_kernel import BRIGHTER_MAG
from startrack.identification.attitude_search import FIRST_GATE_PX, GATE_PX, INLIER_PX, AttitudeHypothesis, Sources
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
        matched, detection, distance, pairs.brightness_misfit, sources.variance_px2, agree, variance
    )
    return AttitudeMatch(refined, pairs, matched, named, inlier, variance, stars.v_mag[:complete][visible])


@njit(cache=True)
def distances_in_gate(xy_px, px, inside):  # type: ignore[no-untyped-def]
    """Distances (k,) of detections (k, 2) and predicted stars (k, 2); infinite beyond GATE_PX and outside the frame."""
    distance = np.empty(len(px))
    for i in range(len(px)):
        x, y = px[i, 0] - xy_px[i, 0], px[i, 1] - xy_px[i, 1]
        distance[i] = np.sqrt(x * x + y * y)
        if not inside[i] or distance[i] > GATE_PX:
            distance[i] = np.inf
    return distance


@njit(cache=True)
def rotate_by_inliers(which, detection, distance, variance_px2, rays_cam, rays_icrs, R):  # type: ignore[no-untyped-def]
    """Which of the pairs `which` (m,) are no outliers (m,), their variance (m,), their attitude, its change from `R`.

    The variance is per axis [px^2], the common error added. This is estimated as in `extra_variance_px2`, but in closed
    form: for one variance per star. `detection`, `distance` (k,) and `rays_icrs` (k, 3) are of all pairs.
    """
    m, n = len(which), 0
    agree, variance, squared = np.zeros(m, np.bool_), np.empty(m), np.empty(m)
    first_squared, first_stated = np.empty(m), np.empty(m)
    for i in range(m):
        variance[i], squared[i] = variance_px2[detection[which[i]]], distance[which[i]] ** 2
        if distance[which[i]] < FIRST_GATE_PX:
            first_squared[n], first_stated[n] = squared[i], variance[i]
            n += 1
    if n == 0:
        return agree, variance, np.zeros((3, 3)), np.inf
    extra = upper_median_of(first_squared[:n]) / CHI2_2DOF_MEDIAN - upper_median_of(first_stated[:n])
    cam, icrs, weight, n = np.empty((m, 3)), np.empty((m, 3)), np.empty(m), 0
    for i in range(m):
        variance[i] += max(extra, SMALLEST_EXTRA_PX2)
        agree[i] = distance[which[i]] < FIRST_GATE_PX and squared[i] < STAR_OUTLIER_CHI2 * variance[i]
        if agree[i]:
            weight[n] = 1.0 / variance[i]
            for a in range(3):
                cam[n, a], icrs[n, a] = rays_cam[detection[which[i]], a], rays_icrs[which[i], a]
            n += 1
    refined, change = rotation_between(cam[:n], icrs[:n], weight[:n]), 0.0
    for a in range(3):
        for b in range(3):
            change = max(change, abs(refined[a, b] - R[a, b]))
    return agree, variance, refined, change


@njit(cache=True, inner=True)
def upper_median_of(values):  # type: ignore[no-untyped-def]
    """The upper median of values (n,), which are reordered; numpy's sort takes five times as long to compile.

    Source: Hoare 1961, Communications of the ACM 4, 321 (FIND).
    """
    low, high, middle = 0, len(values) - 1, len(values) // 2
    while low < high:
        pivot, i, j = values[middle], low, high
        while i <= j:
            while values[i] < pivot:
                i += 1
            while pivot < values[j]:
                j -= 1
            if i <= j:
                values[i], values[j] = values[j], values[i]
                i, j = i + 1, j - 1
        if j < middle:
            low = i
        if middle < i:
            high = j
    return values[middle]


@njit(cache=True)
def name_matches(which, detection, distance, misfit, variance_px2, agree, variance):  # type: ignore[no-untyped-def]
    """`inlier` and `named` (m,) of AttitudeMatch, of the pairs `which` (m,), of which some `agree` (m,)."""
    inlier, named = np.empty(len(which), np.bool_), np.empty(len(which), np.bool_)
    for i in range(len(which)):
        squared, limit = distance[which[i]] ** 2, STAR_OUTLIER_CHI2 * variance_px2[detection[which[i]]]
        inlier[i] = squared < max(INLIER_PX**2, limit)
        # Position and brightness may not both be at the edge of what is allowed.
        edge = squared / (STAR_OUTLIER_CHI2 * variance[i]) + misfit[which[i]] ** 2
        named[i] = inlier[i] and agree[i] and edge < 1.0
    return inlier, named


def agreement_of(centroids: Centroids, v_mag: Array, measured_mag: Array, dimmed_mag: float = BRIGHTER_MAG) -> float:
    """Fraction of random pairs that agree in brightness; 1 where the brightness is not known."""
    known = np.isfinite(centroids.brightness_sigma_mag)
    return brightness_agreement(v_mag, measured_mag, dimmed_mag) if known else 1.0
