"""Narrow fields of roughly known width: views for which triangles vote are fitted as pinholes and verified."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from startrack.core.time_limit import check_time
from startrack.core.types import Array, Centroids, Ints, Stars
from startrack.estimation.false_alarm import (
    PATTERN_MATCHES,
    coincidence_probability,
    density_per_px2,
    log_p_value_bound,
)
from startrack.estimation.match import CandidatePairs, PhotometricScale, match_nearest
from startrack.identification.attitude_refinement import agreement_of
from startrack.identification.attitude_search import GATE_PX, INLIER_PX
from startrack.identification.hypotheses import SAME_VIEW_RAD, HypothesisSearch, Window
from startrack.identification.lens_guesses import PINHOLE, guess_lenses
from startrack.identification.region_growing import FEWEST, GATE_OVER_SIGMA, REGION_ROUNDS, PinholeView
from startrack.identification.similar_triangles import narrow_sizes, patterns_for
from startrack.identification.verify_unknown_lens import (
    MATCHES_FOR_SCALE,
    ORDERS,
    TESTED,
    VerifiedLens,
    blend_radius_px,
    coincidence_radius_px,
    significance,
    trusted_radius,
)

STARS_IN_FIELD, SIDE_OF_FIELD = 24, 0.4  # pattern stars; longest side of their triangles over the field's diameter
# Ranks of brightness whose triangles vote together.
VOTING_ROUNDS = tuple(Window(first, first, end) for first, end in ((0, 10), (0, 16), (8, 22), (0, 22), (20, 34)))
# Detections, stars for each, the gate (part of the frame's width, but at least pixels), and the largest log p-value
# bound of the matches in the inner half of the gate.
VIEW_STAGES = ((60, 1.5, 0.010, 6.0, -4.0), (120, 1.5, 0.005, 4.0, -8.0), (400, 2.0, 0.0, 2.5, -10.0))
VIEW_MARGIN = 1.15  # of the frame: the focal length is not known
SIGMA_PX = INLIER_PX / GATE_OVER_SIGMA  # scale of the loss of the last fits
SMALLEST_ERROR_PX = 0.1  # of a centroid against the lens
MIN_FOR_DISTORTION = ORDERS[2][0]  # matches from which a second coefficient is fitted
DISTORTED_RMS_1 = 0.7  # a distorted lens leaves less than this part of the residual


def narrow_lenses(
    centroids: Centroids, search: HypothesisSearch, fov_rad: float, field_sr: float, stars: Stars
) -> Iterator[VerifiedLens]:
    """Lenses of a narrow field that most of the bright stars support, likely ones first.

    `centroids` are its detections, brightest first; `field_sr` is the solid angle of the frame, rounded so that indexes
    serve many fields.
    """
    patterns = patterns_for(stars, narrow_sizes(field_sr, STARS_IN_FIELD, SIDE_OF_FIELD))
    (guess,) = guess_lenses(search.size_px, fov_rad, (PINHOLE,))
    seen: list[Array] = []
    for window in VOTING_ROUNDS:
        if window.first and len(search.xy_px) <= window.first + 4:
            continue
        for found in search.voted_hypotheses(patterns, guess, window):
            R, camera = found.R_cam_icrs, found.camera
            if any(np.trace(other.T @ R) > 3.0 - SAME_VIEW_RAD**2 for other in seen):
                continue
            seen.append(R)
            check_time()
            view = PinholeView(R, camera.focal_px[0], camera.mirrored, camera.size_px, 0.0)
            lens = _grow_view(view, centroids, stars, search.log_trials)
            if lens is not None:
                yield lens


def _grow_view(view: PinholeView, centroids: Centroids, stars: Stars, log_trials: float) -> VerifiedLens | None:
    """The view fitted with more stars and smaller gates, and verified; None where too few stars agree."""
    from scipy.spatial import cKDTree

    width, height = view.size_px
    corner = np.arctan(0.5 * VIEW_MARGIN * np.hypot(width, height) / view.focal_px)
    number = np.flatnonzero(stars.rays_icrs @ view.R_cam_icrs[2] > np.cos(corner))
    near = stars.take(number)
    for count, per_detection, fraction, least_px, most_log_p in VIEW_STAGES:
        gate_px = max(fraction * width, least_px)
        xy = centroids.xy_px[:count]
        px, inside = view.project(near.rays_icrs)
        some = np.flatnonzero(inside)[: int(per_detection * len(xy)) + 5]
        detection, star, distance = match_nearest(cKDTree(xy), px[some], gate_px)
        bound = log_p_value_bound(distance, gate_px, len(some), len(xy) / (width * height))
        if len(star) < FEWEST or bound > most_log_p:
            return None
        distorted = len(star) >= MIN_FOR_DISTORTION
        sigma_px = gate_px / GATE_OVER_SIGMA
        view = view.fit(xy[detection], near.rays_icrs[some[star]], sigma_px, distorted, REGION_ROUNDS)
    lens = _verify_view(view, centroids, near, log_trials)
    return None if lens is None else replace(lens, star=number[lens.star])


def _verify_view(view: PinholeView, centroids: Centroids, stars: Stars, log_trials: float) -> VerifiedLens | None:
    """The view refined with the stars near it of the right brightness, with its p-value; None where few agree."""
    pairs = _candidate_pairs(view, centroids, stars)
    if pairs is None:
        return None
    chosen = _select_unambiguous(centroids, pairs, _pairs_on_place(pairs))
    if len(chosen) < FEWEST:
        return None
    view = _fit_lens(view, centroids.xy_px[pairs.detection[chosen]], stars.rays_icrs[pairs.star[chosen]])
    pairs = _candidate_pairs(view, centroids, stars)
    if pairs is None:
        return None
    off_axis_px = np.linalg.norm(centroids.xy_px - view.centre_px, axis=1)
    near = pairs.one_to_one_pairs[pairs.detection[pairs.one_to_one_pairs] < TESTED]
    trusted_px = trusted_radius(off_axis_px[pairs.detection[near]], pairs.distance_px[near] < INLIER_PX)
    if trusted_px is None:
        return None
    chosen = _pairs_on_place(pairs)
    chosen = chosen[off_axis_px[pairs.detection[chosen]] <= trusted_px]
    if len(chosen) < FEWEST:
        return None
    radius_px = coincidence_radius_px(pairs.distance_px[chosen])
    hits = int(np.count_nonzero((pairs.detection[chosen] < TESTED) & (pairs.distance_px[chosen] < radius_px)))
    measured = pairs.scale.measured_mag[:TESTED]
    px, inside = view.project(stars.rays_icrs)
    inside &= np.linalg.norm(px - view.centre_px, axis=1) <= trusted_px
    bright = stars.v_mag[inside & (stars.v_mag < measured.max())]
    known_px = centroids.xy_px[:TESTED][off_axis_px[:TESTED] <= trusted_px]
    expected = density_per_px2(known_px, view.size_px) * np.pi * radius_px**2
    each = float(coincidence_probability(expected)) * agreement_of(centroids, bright, measured)
    log_p = significance(hits, max(len(bright), hits), each, PATTERN_MATCHES)
    chosen = _select_unambiguous(centroids, pairs, chosen)
    camera = view.camera()
    trusted_rad = float(camera.angle_rad(view.centre_px + np.array([trusted_px, 0.0])))
    return VerifiedLens(
        camera=replace(camera, calibrated_angle_rad=min(trusted_rad, camera.max_angle_rad)),
        R_cam_icrs=view.R_cam_icrs,
        detection=pairs.detection[chosen],
        star=pairs.star[chosen],
        log_p=log_p + log_trials,
        unexplained=pairs.count_unexplained(centroids.snr, INLIER_PX),
    )


def _candidate_pairs(view: PinholeView, centroids: Centroids, stars: Stars) -> CandidatePairs | None:
    """All pairs of a detection and a star near it; None where they are too few for a photometric scale."""
    from scipy.spatial import cKDTree

    px, inside = view.project(stars.rays_icrs)
    seen = np.flatnonzero(inside)
    tree = cKDTree(centroids.xy_px)
    found = tree.sparse_distance_matrix(cKDTree(px[seen]), GATE_PX, output_type="ndarray")
    found = found[np.lexsort((found["j"], found["i"]))]
    detection, star, distance = found["i"].astype(np.int64), seen[found["j"]], found["v"]
    close = np.flatnonzero(distance < INLIER_PX)
    if len(close) < FEWEST:
        return None
    close = close[np.argsort(star[close], kind="stable")][:MATCHES_FOR_SCALE]
    scale = PhotometricScale.from_matches(
        centroids.flux_e, centroids.saturated, stars.v_mag[star[close]], detection[close]
    )
    v_sigma_mag = stars.v_sigma_mag[star] + centroids.brightness_sigma_mag
    return CandidatePairs(detection, star, distance, stars.v_mag[star], v_sigma_mag, scale)


def _select_unambiguous(centroids: Centroids, pairs: CandidatePairs, which: Ints) -> Ints:
    """The one-to-one pairs with an unambiguous star."""
    some = centroids.covariance_px2[pairs.detection[which]]
    variance_px2 = 0.5 * (some[:, 0, 0] + some[:, 1, 1]) + SMALLEST_ERROR_PX**2
    return pairs.select_unambiguous(which, variance_px2, blend_radius_px(centroids))


def _pairs_on_place(pairs: CandidatePairs) -> Ints:
    """Indices of the one-to-one pairs whose star lies on its predicted pixel."""
    return pairs.one_to_one_pairs[pairs.distance_px[pairs.one_to_one_pairs] < INLIER_PX]


def _fit_lens(view: PinholeView, xy_px: Array, rays_icrs: Array) -> PinholeView:
    """The view fitted to the stars (n, 3) at the pixels (n, 2): a pinhole unless a distorted lens fits much better."""
    view = view.fit(xy_px, rays_icrs, SIGMA_PX, distorted=len(xy_px) >= MIN_FOR_DISTORTION)
    if not view.distortion:
        return view
    pinhole = replace(view, distortion=0.0).fit(xy_px, rays_icrs, SIGMA_PX, distorted=False, steps=REGION_ROUNDS)
    left = [np.sum(np.square(xy_px - v.project(rays_icrs)[0])) for v in (view, pinhole)]
    return view if len(xy_px) >= MIN_FOR_DISTORTION and left[0] < DISTORTED_RMS_1**2 * left[1] else pinhole
