"""Verification of a lens found without a camera file: all stars matched, the trusted field measured, the p-value."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from startrack.camera import Camera
from startrack.core.types import Array, Bools, Centroids, Ints, Stars
from startrack.estimation.false_alarm import (
    PATTERN_MATCHES,
    coincidence_probability,
    density_per_sr,
    log_p_value,
)
from startrack.estimation.match import (
    DEPTH_BELOW_THRESHOLD_MAG,
    MIN_UNSATURATED,
    SIGNIFICANT_SNR,
    instrumental_mag,
    is_isolated,
    match_by_brightness,
)
from startrack.estimation.match_kernel import BRIGHTER_MAG
from startrack.identification.attitude_refinement import agreement_of
from startrack.identification.attitude_search import GATE_PX, INLIER_PX, ONE_SOURCE_SIGMAS
from startrack.identification.region_growing import FEWEST, GATE_OVER_SIGMA, fit_camera, match_in_view, with_file_lens

# Gate [px] and number of brightest detections; None: all, which match by brightness too.
FITS = ((4.0, 200), (2.5, 500), (1.8, 3000), (2.0, None), (INLIER_PX, None))
TESTED = 400  # brightest detections that the p-value rests on
SMALLEST_COINCIDENCE_PX, RADIUS_SIGMAS = 0.6, 2.5
ON_PLACE_FRACTION = 0.5  # of the stars near their predicted pixels, where the lens is right
STARS_OF_A_RING, MAX_RINGS = 8, 12
FREE_MATCHES = 8  # that a fit of attitude and lens produces by itself; a lens of fixed shape: as a triangle
MIN_TIMES_CHANCE = 3.0  # matches over those expected by chance
ORDERS = ((150, 4), (60, 3), (25, 2), (0, 1))  # coefficients of the polynomial from this many matches on
MIN_FOR_CENTRE = 30
FITTED_BEYOND_1 = 1.3  # of half the field of view: up to here a fitted lens may have stars
WIDEST_PSF_PX = 1.5  # for blends
RIVAL_MAG = float(-2.5 * np.log10(0.25))  # a neighbour with more than this part of a star's flux makes it ambiguous
STARS_FOR_SCALE, MATCHES_FOR_SCALE = 5000, 200  # brightest stars predicted, and matches used, for the photometric scale
UNEXPLAINED_MARGIN_MAG = 2.0  # fainter stars than this below a detection do not explain it


@dataclass(frozen=True)
class VerifiedLens:
    """Camera, attitude and matches with their p-value."""

    camera: Camera  # calibrated as far out as stars lie on their predicted pixels
    R_cam_icrs: Array
    detection: Ints
    star: Ints
    log_p: float  # that a random sky would be matched as well by one of all trials
    unexplained: int


@dataclass(frozen=True)
class FluxMatches:
    """Matches by position and flux, and the photometric scale of the frame."""

    detection: Ints  # (n,)
    star: Ints  # (n,)
    distance_px: Array  # (n,)
    zero_mag: float  # V of a star of unit flux
    predicted: int  # stars in the field brighter than the faintest detection
    coincident_px: Array  # (m,) distances of all matches, blends included
    agreement: float  # fraction of random pairs of a star and a detection that agree in brightness


def match_by_flux(
    centroids: Centroids, camera: Camera, stars: Stars, R_cam_icrs: Array, gate_px: float, blend_px: float
) -> FluxMatches:
    """Nearest pairs within the gate whose brightness agrees; blends within `blend_px` are left out.

    The photometric scale is the median over the brightest predicted stars of the frame itself.
    """
    from scipy.spatial import cKDTree

    tree, brightness = cKDTree(centroids.xy_px), instrumental_mag(centroids.flux_e)
    px, inside = camera.project(stars.rays_icrs[:STARS_FOR_SCALE] @ R_cam_icrs.T)
    seen = np.flatnonzero(inside)
    distance, nearest = tree.query(px[seen], distance_upper_bound=gate_px)
    hit = np.isfinite(distance)
    usable = hit.copy()
    usable[hit] = ~centroids.saturated[nearest[hit]]
    first = np.flatnonzero(usable if np.count_nonzero(usable) >= MIN_UNSATURATED else hit)[:MATCHES_FOR_SCALE]
    if len(first) < MIN_UNSATURATED:
        none = np.zeros(0, dtype=np.int64)
        return FluxMatches(none, none, np.zeros(0), 0.0, len(seen), np.zeros(0), 1.0)
    zero_mag = float(np.median(stars.v_mag[seen[first]] - brightness[nearest[first]]))
    faintest = zero_mag + float(np.max(brightness))
    limit = faintest + DEPTH_BELOW_THRESHOLD_MAG
    count = int(np.searchsorted(stars.v_mag, limit + RIVAL_MAG))
    px, inside = camera.project(stars.rays_icrs[:count] @ R_cam_icrs.T)
    seen = np.flatnonzero(inside)
    detection, star, distance = match_by_brightness(
        tree, px, seen, gate_px, star_mag=stars.v_mag,
        star_sigma_mag=stars.v_sigma_mag + centroids.brightness_sigma_mag, detection_mag=brightness + zero_mag,
        saturated=centroids.saturated, limit_mag=limit, tolerance_mag=BRIGHTER_MAG,
    )  # fmt: skip
    alone = is_isolated(centroids.xy_px[detection], star, px, seen, stars.v_mag, blend_px, RIVAL_MAG)
    bright = stars.v_mag[seen][stars.v_mag[seen] < limit - DEPTH_BELOW_THRESHOLD_MAG]
    return FluxMatches(
        detection[alone], star[alone], distance[alone], zero_mag, len(bright), distance,
        agreement_of(centroids, bright, brightness + zero_mag),
    )  # fmt: skip


def verify(
    camera: Camera, R: Array, matched: int, centroids: Centroids, stars: Stars, log_trials: float, widest_rad: float
) -> VerifiedLens | None:
    """The grown lens refined with all stars and verified; None where too few stars agree.

    `camera`, `R` and the number `matched` are the result of `grow`. `log_trials`: logarithm of the number of
    hypotheses so far. `widest_rad`: half the field of view, its tolerance added.
    """
    refined = _refine(camera, R, matched, centroids, stars, widest_rad)
    return None if refined is None else match_lens(*refined, centroids, stars, log_trials, widest_rad)


def match_lens(
    camera: Camera, R: Array, centroids: Centroids, stars: Stars, log_trials: float, widest_rad: float
) -> VerifiedLens | None:
    """The lens with all stars that lie where it and `R` place them; None where too few do.

    The other arguments are those of `verify`.
    """
    camera = _limit_angles(camera, widest_rad)
    tested = centroids.take(slice(TESTED))
    near = match_by_flux(tested, camera, stars, R, GATE_PX, 0.0)
    trusted_rad = trusted_radius(camera.angle_rad(centroids.xy_px[near.detection]), near.distance_px < INLIER_PX)
    if trusted_rad is None:
        return None
    trusted_rad = min(trusted_rad, camera.max_angle_rad)
    camera = replace(camera, calibrated_angle_rad=trusted_rad)
    matches = match_by_flux(centroids, camera, stars, R, INLIER_PX, blend_radius_px(centroids))
    inside = camera.angle_rad(centroids.xy_px[matches.detection]) <= trusted_rad
    if np.count_nonzero(inside) < FEWEST:
        return None
    some = match_by_flux(tested, replace(camera, max_angle_rad=trusted_rad), stars, R, INLIER_PX, 0.0)
    radius_px = coincidence_radius_px(matches.distance_px[inside])
    hits = int(np.count_nonzero(some.coincident_px < radius_px))
    rays = camera.unproject(tested.xy_px[camera.angle_rad(tested.xy_px) <= trusted_rad])
    radius_rad = radius_px * float(camera.mean_scale_rad_per_px(np.array(trusted_rad / 2)))
    each = some.agreement * float(coincidence_probability(density_per_sr(rays) * np.pi * radius_rad**2))
    free = FREE_MATCHES if camera.lens.parameters else PATTERN_MATCHES
    return VerifiedLens(
        camera=camera,
        R_cam_icrs=R,
        detection=matches.detection[inside],
        star=matches.star[inside],
        log_p=significance(hits, max(some.predicted, hits), each, free) + log_trials,
        unexplained=_count_unexplained(centroids, camera, stars, R, matches.zero_mag),
    )


def trusted_radius(off_axis: Array, on_place: Bools) -> float | None:
    """Distance from the axis up to which the stars (n,) near their predicted pixels lie on them; None: nowhere.

    The stars are divided into rings of equal numbers. The first ring with too few stars on their pixels ends the
    trusted field.
    """
    order = np.argsort(off_axis)
    on_place = on_place[order]
    trusted = None
    for ring in np.array_split(np.arange(len(order)), max(min(len(order) // STARS_OF_A_RING, MAX_RINGS), 1)):
        if not len(ring) or on_place[ring].mean() < ON_PLACE_FRACTION:
            break
        trusted = float(off_axis[order[ring[on_place[ring]][-1]]])
    return trusted


def significance(hits: int, predicted: int, each: float, free: int) -> float:
    """Log p-value of the hits; 0 unless they are several times as many as chance gives."""
    if hits < MIN_TIMES_CHANCE * predicted * each:
        return 0.0
    return float(log_p_value(hits, predicted, each, free))


def _refine(
    camera: Camera, R: Array, matched: int, centroids: Centroids, stars: Stars, widest_rad: float
) -> tuple[Camera, Array] | None:
    """Camera and attitude after smaller gates and longer lists; the last matches are by brightness too."""
    order = next(order for fewest, order in ORDERS if matched >= fewest)
    prior = camera = _limit_angles(with_file_lens(camera, order, widest_rad), widest_rad)
    for gate_px, count in FITS:
        if count is None:
            by_flux = match_by_flux(centroids, camera, stars, R, gate_px, blend_radius_px(centroids))
            detection, star = by_flux.detection, by_flux.star
        else:
            detection, star, _ = match_in_view(camera, R, centroids.xy_px[:count], stars.rays_icrs, gate_px)
        if len(star) < FEWEST:
            return None
        # Of a lens of fixed shape the focal length alone is free.
        centre = ("fy", "cx", "cy") if camera.lens.parameters and len(star) >= MIN_FOR_CENTRE else ()
        free = ("f", *camera.lens.parameters, *centre)
        xy_px, sigma_px = centroids.xy_px[detection], gate_px / GATE_OVER_SIGMA
        camera, R, _ = fit_camera(camera, R, xy_px, stars.rays_icrs[star], free, sigma_px, prior)
        camera = _limit_angles(camera, widest_rad)
    return camera, R


def _limit_angles(camera: Camera, widest_rad: float) -> Camera:
    """The camera with its largest angles where the frame ends or the polynomial turns."""
    width, height = camera.size_px
    corners = np.array([[0, 0], [width - 1, 0], [0, height - 1], [width - 1, height - 1]], dtype=float)
    corner_rad = float(np.max(camera.angle_rad(corners)))
    allowed = FITTED_BEYOND_1 * widest_rad if camera.lens.parameters else corner_rad
    widest = min(allowed, corner_rad, camera.lens.max_invertible_rad)
    return replace(camera, max_angle_rad=widest, calibrated_angle_rad=widest)


def blend_radius_px(centroids: Centroids) -> float:
    """Distance [px] within which stars share one detection."""
    return ONE_SOURCE_SIGMAS * min(centroids.psf_sigma_px, WIDEST_PSF_PX)


def coincidence_radius_px(distance_px: Array) -> float:
    """Distance [px] within which a star coincides with a detection, by those of the matches, `distance_px` (n,)."""
    rms_px = float(np.sqrt(np.mean(np.square(distance_px))))
    return float(np.clip(RADIUS_SIGMAS * rms_px, SMALLEST_COINCIDENCE_PX, INLIER_PX))


def _count_unexplained(centroids: Centroids, camera: Camera, stars: Stars, R: Array, zero_mag: float) -> int:
    """Number of significant detections without a catalogue star near that is bright enough to contribute."""
    from scipy.spatial import cKDTree

    significant = np.flatnonzero(centroids.snr > SIGNIFICANT_SNR)
    if not len(significant):
        return 0
    faintest = zero_mag - 2.5 * np.log10(centroids.flux_e[significant].min()) + UNEXPLAINED_MARGIN_MAG
    px, inside = camera.project(stars.rays_icrs[: int(np.searchsorted(stars.v_mag, faintest))] @ R.T)
    distance, _ = cKDTree(px[inside]).query(centroids.xy_px[significant], distance_upper_bound=INLIER_PX)
    return int(np.count_nonzero(~np.isfinite(distance)))
