"""Verification of a lens found without a camera file: all stars matched, the trusted field measured, the p-value.

Centre, ratio of the focal lengths and decentring of a lens show in a wide field, and hardly in a narrow one, where a
shift of the centre looks like a rotation. Each of the three stays as it is of an ideal lens (in the middle, square
pixels, none) unless the stars make the contrary more probable; the covariance is that of all of them unknown.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import product

import numpy as np

from startrack.camera import Camera, Decentring, with_covariance
from startrack.core.types import Array, Bools, Centroids, Ints, Stars
from startrack.estimation.adjust import (
    HUBER_WITH_CUT,
    Observations,
    Prior,
    Scheme,
    Solution,
    State,
    adjust,
    cauchy_loss,
    observations_of_image,
)
from startrack.estimation.false_alarm import (
    PATTERN_MATCHES,
    coincidence_probability,
    density_per_px2,
    log_p_value,
)
from startrack.estimation.match import CandidatePairs, PhotometricScale
from startrack.estimation.prior_choice import solve_with_best_prior
from startrack.estimation.radial_fit import HALF_WEIGHT_CHI2, PINHOLE_BEND
from startrack.identification.attitude_refinement import agreement_of
from startrack.identification.attitude_search import GATE_PX, INLIER_PX, ONE_SOURCE_SIGMAS
from startrack.identification.lens_guesses import Field
from startrack.identification.lens_view import (
    FEWEST,
    GATE_OVER_SIGMA,
    MATCHES_FOR_ASPECT,
    MATCHES_FOR_BEND,
    LensView,
)

LENGTH_SIGMAS = {"f": 0.1, "fy": 0.1, "cx": 0.06, "cy": 0.06}  # prior sigmas in focal lengths; "fy": of fy - fx
# Of the polynomial, and of decentring, which also describes refraction that differs over a narrow field.
PRIOR_SIGMAS = {"k1": 0.1, "k2": 0.1, "k3": 0.05, "k4": 0.02, "p1": 0.002, "p2": 0.002}
SCHEME = Scheme(loss=HUBER_WITH_CUT, steps=12, settled_px=3e-4, estimates_extra=True)
CHOICES = (("cx", "cy"), ("fy",), ("p1", "p2"))  # what an ideal lens does not have; "fy": beyond the ratio of 1
BENT_GATES_PX, STRAIGHT_GATES_PX = (4.0, 2.5, 2.0, INLIER_PX), (INLIER_PX,)  # of the fits, in turn
TESTED = 400  # brightest detections that the p-value rests on
SMALLEST_COINCIDENCE_PX, RADIUS_SIGMAS = 0.6, 2.5
ON_PLACE_FRACTION = 0.7  # of the stars near their predicted pixels, where the lens is right
STARS_OF_A_RING = 10
FREE_MATCHES = 8  # that a fit of attitude and lens produces by itself; a lens of fixed shape: as a triangle
MIN_TIMES_CHANCE = 3.0  # matches over those expected by chance
ORDERS = ((150, 4), (60, 3), (25, 2), (0, 1))  # coefficients of the polynomial from this many matches on
MIN_FOR_CENTRE = 30
FITTED_BEYOND_1 = 1.3  # of half the field of view: up to here a fitted lens may have stars
WIDEST_PSF_PX = 1.5  # for blends
MATCHES_FOR_SCALE = 200  # brightest matches used for the photometric scale
SMALLEST_ERROR_PX = 0.1  # of a centroid against the lens
DISTORTED_RMS_1 = 0.7  # a distorted lens leaves less than this part of the residual of a pinhole
FIT = Scheme(loss=cauchy_loss(HALF_WEIGHT_CHI2), steps=4, settled_px=1e-3)


def fit_found_lens(
    camera: Camera, R_cam_icrs: Array, points: Observations, centre_px: tuple[float, float]
) -> tuple[Camera, Array]:
    """Camera with its marginal covariance, and attitude (3, 3), from least squares over both.

    `camera` and `R_cam_icrs` (3, 3) are roughly right for the stars `points` of one image; `centre_px` is where the
    lens's centre is expected. Raises NotIdentified where fewer than 3 stars agree.
    """
    free = ("f", "fy", "cx", "cy", *camera.lens.parameters, "p1", "p2")
    focal_px = camera.focal_px[0]
    expected = replace(camera, centre_px=centre_px, focal_px=(focal_px, focal_px), decentring=Decentring())
    whole = _fit(camera, R_cam_icrs, points, free, expected)
    prior = prior_of(whole.state.camera, expected, free)
    normal = np.asarray(np.linalg.inv(whole.equations.lens_covariance), dtype=np.float64)
    right, sigma = -normal @ prior.offset, prior.sigma.tolist()  # about the expected lens
    sets = [{name for names, shows in zip(CHOICES, shown, strict=True) if not shows for name in names}
            for shown in product((False, True), repeat=len(CHOICES))]  # fmt: skip
    roots = [np.diag([0.0 if name in fixed else s for name, s in zip(free, sigma, strict=True)]) for fixed in sets]
    fixed = sets[solve_with_best_prior(normal - np.diag(prior.precision), right, roots).prior]
    last = whole
    if fixed:
        start = whole.state.camera
        if "cx" in fixed:
            start = replace(start, centre_px=expected.centre_px)
        if "fy" in fixed:
            start = replace(start, focal_px=(start.focal_px[0], start.focal_px[0]))
        if "p1" in fixed:
            start = replace(start, decentring=expected.decentring)
        shown = tuple(name for name in free if name not in fixed)
        last = _fit(start, whole.state.R_cam_icrs[0], points, shown, expected)
    # About the lens that is stated, which may be off the mean of the unknown one.
    off = prior_of(whole.state.camera, last.state.camera, free).offset
    covariance = whole.equations.lens_covariance + np.outer(off, off)
    fitted = last.state.camera
    widest = fitted.lens.max_invertible_rad
    fitted = replace(
        fitted,
        max_angle_rad=min(camera.max_angle_rad, widest),
        calibrated_angle_rad=min(camera.calibrated_angle_rad, widest),
    )
    return with_covariance(fitted, free, covariance), last.state.R_cam_icrs[0]


def _fit(camera: Camera, R_cam_icrs: Array, points: Observations, free: tuple[str, ...], expected: Camera) -> Solution:
    """Adjustment of the `free` parameters and the attitude to `points`, with the prior of the camera `expected`."""
    start = State(camera=camera, R_cam_icrs=R_cam_icrs[None])
    return adjust(start, points, free, SCHEME, prior=prior_of(camera, expected, free))


def prior_of(camera: Camera, expected: Camera, free: tuple[str, ...]) -> Prior:
    """Prior of the free parameters: that of the camera `expected`, the adjustment starting at `camera`."""
    sigma = PRIOR_SIGMAS | {name: part * expected.focal_px[0] for name, part in LENGTH_SIGMAS.items()}
    now, then = (
        {
            "f": c.focal_px[0], "fy": c.focal_px[1] - c.focal_px[0], "cx": c.centre_px[0], "cy": c.centre_px[1],
            "p1": c.decentring.p1, "p2": c.decentring.p2, **c.lens.parameters,
        }
        for c in (camera, expected)
    )  # fmt: skip
    return Prior(np.array([sigma[n] for n in free]), np.array([then[n] - now[n] for n in free]))


@dataclass(frozen=True)
class VerifiedLens:
    """Camera, attitude and matches with their p-value."""

    camera: Camera  # calibrated as far out as stars lie on their predicted pixels
    R_cam_icrs: Array
    detection: Ints
    star: Ints
    log_p: float  # that a random sky would be matched as well by one of all trials
    unexplained: int
    scale: PhotometricScale


@dataclass(frozen=True)
class Verifier:
    """Verification of grown lenses with a list of centroids and the stars."""

    centroids: Centroids
    stars: Stars

    def __call__(
        self, view: LensView, detection: Ints, star: Ints, log_trials: float, field: Field
    ) -> VerifiedLens | None:
        """The grown `view`, refined with all stars and verified; None where too few agree.

        `detection` and `star` (n,) are its matches, `field` is that of its guess. `log_trials`: logarithm of the number
        of hypotheses so far.
        """
        largest_rad = 0.5 * field.largest_rad
        xy_px, rays_icrs = self.centroids.xy_px[detection], self.stars.rays_icrs[star]
        if field.is_narrow:
            view = _straighten(view, xy_px, rays_icrs)
        start = camera = _limit_angles(view.camera(1, largest_rad), largest_rad)
        R = view.R_cam_icrs
        bright = np.argsort(star, kind="stable")[:MATCHES_FOR_SCALE]
        scale = PhotometricScale.from_matches(
            self.centroids.flux_e, self.centroids.saturated, self.stars.v_mag[star[bright]], detection[bright]
        )
        for gate_px in BENT_GATES_PX if camera.lens.parameters else STRAIGHT_GATES_PX:
            pairs = self._pairs(camera, R, scale)
            chosen = pairs.one_to_one_pairs[pairs.distance_px[pairs.one_to_one_pairs] < gate_px]
            if len(chosen) < FEWEST:
                return None
            if camera is start:
                coefficients = next(order for fewest, order in ORDERS if len(chosen) >= fewest)
                start = camera = _limit_angles(view.camera(coefficients, largest_rad), largest_rad)
            camera, R = self._fit(camera, R, pairs, chosen, gate_px, start)
            camera = _limit_angles(camera, largest_rad)
        return self.match_lens(camera, R, scale, log_trials, field)

    def match_lens(
        self, camera: Camera, R: Array, scale: PhotometricScale, log_trials: float, field: Field
    ) -> VerifiedLens | None:
        """The lens with all stars that lie where it and `R` place them; None where too few do.

        `scale`: of the brightness; `log_trials`: logarithm of the number of hypotheses; `field`: that of the guess.
        """
        centroids = self.centroids
        camera = _limit_angles(camera, 0.5 * field.largest_rad)
        pairs = self._pairs(camera, R, scale)
        matched = pairs.one_to_one_pairs
        off_axis = camera.angle_rad(centroids.xy_px)
        tested = matched[pairs.detection[matched] < TESTED]
        trusted_rad = trusted_radius(off_axis[pairs.detection[tested]], pairs.distance_px[tested] < INLIER_PX)
        if trusted_rad is None:
            return None
        trusted_rad = min(trusted_rad, camera.max_angle_rad)
        chosen = matched[pairs.distance_px[matched] < INLIER_PX]
        chosen = chosen[off_axis[pairs.detection[chosen]] <= trusted_rad]
        if len(chosen) < FEWEST:
            return None
        radius_px = coincidence_radius_px(pairs.distance_px[chosen])
        hits = int(np.count_nonzero((pairs.detection[chosen] < TESTED) & (pairs.distance_px[chosen] < radius_px)))
        measured = scale.measured_mag[:TESTED]
        rays_icrs = self.stars.rays_icrs[: np.searchsorted(self.stars.v_mag, measured.max())]
        ahead = np.flatnonzero(rays_icrs @ R[2] >= np.cos(trusted_rad))
        _, inside = camera.project(rays_icrs[ahead] @ R.T)
        bright = self.stars.v_mag[ahead[inside]]
        known_px = centroids.xy_px[:TESTED][off_axis[:TESTED] <= trusted_rad]
        expected = density_per_px2(known_px, camera.size_px) * np.pi * radius_px**2
        each = float(coincidence_probability(expected)) * agreement_of(centroids, bright, measured)
        free = FREE_MATCHES if camera.lens.parameters else PATTERN_MATCHES
        named = self._select_unambiguous(pairs, chosen)
        return VerifiedLens(
            camera=replace(camera, calibrated_angle_rad=trusted_rad),
            R_cam_icrs=R,
            detection=pairs.detection[named],
            star=pairs.star[named],
            log_p=significance(hits, max(len(bright), hits), each, free) + log_trials,
            unexplained=pairs.count_unexplained(centroids.snr, INLIER_PX),
            scale=scale,
        )

    def _pairs(self, camera: Camera, R: Array, scale: PhotometricScale) -> CandidatePairs:
        """All pairs of a detection and a star near it that is bright enough to be seen."""
        from scipy.spatial import cKDTree

        centroids, stars = self.centroids, self.stars
        rays_icrs = stars.rays_icrs[: np.searchsorted(stars.v_mag, scale.limit_mag)]
        ahead = np.flatnonzero(rays_icrs @ R[2] > np.cos(min(camera.max_angle_rad, np.pi)))
        px, inside = camera.project(rays_icrs[ahead] @ R.T)
        seen = ahead[inside]
        found = cKDTree(centroids.xy_px).sparse_distance_matrix(cKDTree(px[inside]), GATE_PX, output_type="ndarray")
        found = found[np.lexsort((found["j"], found["i"]))]
        detection, star = found["i"].astype(np.int64), seen[found["j"]]
        v_sigma_mag = stars.v_sigma_mag[star] + centroids.brightness_sigma_mag
        return CandidatePairs(detection, star, found["v"], stars.v_mag[star], v_sigma_mag, scale)

    def _fit(
        self, camera: Camera, R: Array, pairs: CandidatePairs, chosen: Ints, gate_px: float, start: Camera
    ) -> tuple[Camera, Array]:
        """Camera and attitude fitted to the pairs `chosen` (n,), some of them wrong; `start`: before any fit."""
        free = ("f", *camera.lens.parameters)
        if len(chosen) >= (MIN_FOR_CENTRE if camera.lens.parameters else MATCHES_FOR_ASPECT):
            free += ("fy", "cx", "cy") if camera.lens.parameters else ("fy",)
        n, sigma_px = len(chosen), gate_px / GATE_OVER_SIGMA
        points = observations_of_image(
            self.centroids.xy_px[pairs.detection[chosen]], np.tile(sigma_px**2 * np.eye(2), (n, 1, 1)),
            self.stars.rays_icrs[pairs.star[chosen]],
        )  # fmt: skip
        state = State(camera=camera, R_cam_icrs=R[None])
        found = adjust(state, points, free, FIT, prior=prior_of(camera, start, free)).state
        return found.camera, found.R_cam_icrs[0]

    def _select_unambiguous(self, pairs: CandidatePairs, which: Ints) -> Ints:
        """The one-to-one pairs with an unambiguous star."""
        some = self.centroids.covariance_px2[pairs.detection[which]]
        variance_px2 = 0.5 * (some[:, 0, 0] + some[:, 1, 1]) + SMALLEST_ERROR_PX**2
        return pairs.select_unambiguous(which, variance_px2, blend_radius_px(self.centroids))


def _straighten(view: LensView, xy_px: Array, rays_icrs: Array) -> LensView:
    """A pinhole fitted to the stars (n, 3) at the pixels (n, 2), unless the bent lens `view` fits much better."""
    if view.lens[2] == PINHOLE_BEND:
        return view
    free = np.array([True, len(xy_px) >= MATCHES_FOR_ASPECT, len(xy_px) >= MATCHES_FOR_BEND, False, False])
    sigma_px = INLIER_PX / GATE_OVER_SIGMA
    straight = replace(view, lens=np.where(np.arange(len(view.lens)) == 2, PINHOLE_BEND, view.lens))
    straight = straight.fit(xy_px, rays_icrs, sigma_px, free & (np.arange(len(free)) != 2), straight.lens)
    bent = view.fit(xy_px, rays_icrs, sigma_px, free, view.lens)
    left = [np.sum(np.square(xy_px - one.project(rays_icrs)[0])) for one in (bent, straight)]
    return bent if left[0] < DISTORTED_RMS_1**2 * left[1] else straight


def trusted_radius(off_axis: Array, on_place: Bools) -> float | None:
    """Distance from the axis up to which the stars (n,) near their predicted pixels lie on them; None: nowhere.

    The stars are divided into rings of equal numbers. The first ring with too few stars on their pixels ends the
    trusted field.
    """
    order = np.argsort(off_axis)
    on_place = on_place[order]
    trusted = None
    for ring in np.array_split(np.arange(len(order)), max(len(order) // STARS_OF_A_RING, 1)):
        if not len(ring) or on_place[ring].mean() < ON_PLACE_FRACTION:
            break
        trusted = float(off_axis[order[ring[on_place[ring]][-1]]])
    return trusted


def significance(hits: int, predicted: int, each: float, free: int) -> float:
    """Log p-value of the hits; 0 unless they are several times as many as chance gives."""
    if hits < MIN_TIMES_CHANCE * predicted * each:
        return 0.0
    return float(log_p_value(hits, predicted, each, free))


def _limit_angles(camera: Camera, largest_rad: float) -> Camera:
    """The camera with its largest angles where the frame ends or the polynomial turns."""
    width, height = camera.size_px
    corners = np.array([[0, 0], [width - 1, 0], [0, height - 1], [width - 1, height - 1]], dtype=float)
    corner_rad = float(np.max(camera.angle_rad(corners)))
    allowed = FITTED_BEYOND_1 * largest_rad if camera.lens.parameters else corner_rad
    widest = min(allowed, corner_rad, camera.lens.max_invertible_rad)
    return replace(camera, max_angle_rad=widest, calibrated_angle_rad=widest)


def blend_radius_px(centroids: Centroids) -> float:
    """Distance [px] within which stars share one detection."""
    return ONE_SOURCE_SIGMAS * min(centroids.psf_sigma_px, WIDEST_PSF_PX)


def coincidence_radius_px(distance_px: Array) -> float:
    """Distance [px] within which a star coincides with a detection, by those of the matches, `distance_px` (n,)."""
    rms_px = float(np.sqrt(np.mean(np.square(distance_px))))
    return float(np.clip(RADIUS_SIGMAS * rms_px, SMALLEST_COINCIDENCE_PX, INLIER_PX))
