"""The view of an unknown lens: its attitude and lens of one bend, grown from a triangle to the whole field."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from startrack.camera import Camera, Lens, Pinhole, default_lens
from startrack.core.types import Array, Bools, Ints
from startrack.estimation.false_alarm import log_p_value_bound
from startrack.estimation.match import match_nearest
from startrack.estimation.radial_fit import (
    PINHOLE_BEND,
    angle_of,
    fit_radial,
    largest_angle_rad,
    project_radial,
    radius_of,
)
from startrack.identification.lens_guesses import Field

UNKNOWN_LENS = "unknown"  # name of a camera that no file states
FEWEST = 5  # matches
GATE_OVER_SIGMA = 4.0  # the gate over the sigma of the loss
GROWTH_STEPS = 3  # of the fit, for each set of matches
VIEW_MARGIN = 1.15  # of the frame: the focal length is not known
STARS_PER_DETECTION = 1.5
STARS_AT_HAND = 4.0  # times as many of the brightest of the whole sky as the field has of those that take part
MATCHES_FOR_ASPECT, MATCHES_FOR_BEND = 12, 25  # of a narrow field: fewer stars do not show them
FOCAL_SIGMA, ASPECT_SIGMA, CENTRE_SIGMA = 0.1, 0.1, 0.06  # before any star is known; of the centre in focal lengths
BEND_SIGMA, BENT_AWAY = 0.1, 0.03  # of the bend, and the sigma of the radius by it where that is wider
CURVE_POINTS, SMALLEST_ANGLE_RAD = 200, 0.02  # at which the lens of a camera file is fitted


@dataclass(frozen=True)
class LensView:
    """Attitude and lens of a frame (W, H)."""

    R_cam_icrs: Array
    lens: Array  # (5,) logarithms of focal length [px] and aspect, bend, centre [px], as in `fit_radial`
    mirrored: bool
    size_px: tuple[int, int]

    @property
    def focal_px(self) -> float:
        """Geometric mean of fx and fy [px]."""
        return float(np.exp(self.lens[0]))

    @property
    def corner_rad(self) -> float:
        """Angle off the axis of the farthest corner of the frame."""
        half = np.array(self.size_px) / 2
        off = np.abs(self.lens[3:] - half) + half
        return float(angle_of(np.hypot(*off) / self.focal_px, float(self.lens[2])))

    @property
    def handedness(self) -> float:
        """Sign of the x axis: -1 for a mirror image, else 1."""
        return -1.0 if self.mirrored else 1.0

    def project(self, rays_icrs: Array) -> tuple[Array, Bools]:
        """Pixels (n, 2) of rays (n, 3), and which lie in the frame and in the image circle."""
        px, inside = project_radial(rays_icrs, self.R_cam_icrs, self.lens, self.handedness, *self.size_px)
        return px, inside

    def fit(self, xy_px: Array, rays_icrs: Array, sigma_px: float, free: Bools, expected: Array) -> LensView:
        """The view fitted to the stars (n, 3) at the pixels (n, 2), some of them wrong, with a loss of this scale.

        `free` (5,): which lens parameters may change; `expected` (5,): their values before any star is known.
        """
        R, lens = self.R_cam_icrs.copy(), self.lens.copy()
        away = BENT_AWAY / min(self.corner_rad, 1.0) ** 2
        sigma = np.array([FOCAL_SIGMA, ASPECT_SIGMA, max(BEND_SIGMA, away), CENTRE_SIGMA, CENTRE_SIGMA])
        fit_radial(xy_px, rays_icrs, self.handedness, sigma_px, GROWTH_STEPS, free, expected, sigma, R, lens)
        return replace(self, R_cam_icrs=R, lens=lens)

    def camera(self, coefficients: int, widest_rad: float) -> Camera:
        """The camera of a file, as wide as its lens, with the `coefficients` that fit up to `widest_rad` best."""
        bend, scale = float(self.lens[2]), 1.0
        lens: Lens = Pinhole()
        if bend != PINHOLE_BEND:
            angle = np.linspace(SMALLEST_ANGLE_RAD, min(widest_rad, 0.98 * largest_angle_rad(bend)), CURVE_POINTS)
            lens, scale = default_lens().fit_curve(angle, radius_of(angle, bend), coefficients)
        fx, fy = scale * self.focal_px * np.exp(np.array([0.5, -0.5]) * self.lens[1])
        x, y = self.lens[3:].tolist()
        widest = lens.max_invertible_rad
        return Camera(
            name=UNKNOWN_LENS, size_px=self.size_px, focal_px=(float(fx), float(fy)), centre_px=(x, y),
            max_angle_rad=widest, calibrated_angle_rad=widest, lens=lens, mirrored=self.mirrored,
        )  # fmt: skip


@dataclass(frozen=True)
class LensHypothesis:
    """A view for which triangles voted, good near the direction `middle_icrs`."""

    view: LensView
    middle_icrs: Array  # (3,)
    agreeing: int  # triangles


@dataclass(frozen=True)
class GrowthStage:
    """Step of the growth: which stars take part, the gate, and what of the lens is fitted."""

    region_1: float  # about the triangle of the hypothesis, over the field's diameter; 0: the whole field
    gate_1: float  # over the field's diameter
    detections: int  # brightest that take part
    whole_lens: bool  # or the focal length alone
    most_log_p: float  # log p-value bound above which the hypothesis is given up
    rounds: int = 2  # of matching and fitting


BENT_STAGES = (  # of a lens whose bend is not known
    GrowthStage(0.25, 0.011, 60, False, 0.0),
    GrowthStage(0.39, 0.011, 60, True, -3.0),
    GrowthStage(0.0, 0.011, 80, True, -6.0),
    GrowthStage(0.0, 0.0055, 120, True, -10.0),
    GrowthStage(0.0, 0.0033, 200, True, -14.0),
)
STRAIGHT_STAGES = (  # of one that is nearly a pinhole
    GrowthStage(0.0, 0.010, 60, True, -4.0, 1),
    GrowthStage(0.0, 0.005, 120, True, -8.0, 1),
    GrowthStage(0.0, 0.0022, 400, True, -10.0, 2),
)
SMALLEST_GATE_PX = 2.5


def grow(
    hypothesis: LensHypothesis, xy_px: Array, stars_icrs: Array, field: Field, field_px: float
) -> tuple[LensView, Ints, Ints] | None:
    """The view after all stages with its matches (detection, star); None where it is given up.

    The detections (n, 2) and the stars (m, 3) are sorted, brightest first. `field_px`: the field's diameter.
    """
    view, is_narrow = hypothesis.view, field.is_narrow
    expected, start, stages = view.lens.copy(), view, STRAIGHT_STAGES if is_narrow else BENT_STAGES
    most = _stars_wanted(min(stages[-1].detections, len(xy_px)))
    stars_icrs = stars_icrs[: int(STARS_AT_HAND * most * 4 * np.pi / field.solid_angle_sr)]
    near = np.flatnonzero(stars_icrs @ view.R_cam_icrs[2] > np.cos(min(VIEW_MARGIN * view.corner_rad, np.pi)))
    rays_icrs = stars_icrs[near]
    detection, star = near[:0], near[:0]
    for stage in stages:
        some = xy_px[: stage.detections]
        gate_px = max(stage.gate_1 * field_px, SMALLEST_GATE_PX)
        region_cos = np.cos(stage.region_1 * field_px / start.focal_px) if stage.region_1 else -2.0
        for _ in range(stage.rounds):
            detection, star, predicted = _match(view, some, rays_icrs, gate_px, hypothesis.middle_icrs, region_cos)
            if len(star) < FEWEST:
                return None
            free = _free(stage, len(star), is_narrow)
            view = view.fit(some[detection], rays_icrs[star], gate_px / GATE_OVER_SIGMA, free, expected)
        px, _ = view.project(rays_icrs[star])
        distance = np.hypot(*(px - some[detection]).T)
        # The detections' density in the rectangle between their 5th and 95th percentiles.
        area_px2 = float(np.prod(np.ptp(np.percentile(some, (5, 95), axis=0), axis=0)) / 0.81) + 1.0
        if log_p_value_bound(distance, gate_px, predicted, len(some) / area_px2) > stage.most_log_p:
            return None
    return view, detection, near[star]


def _stars_wanted(detections: int) -> int:
    """Number of the brightest stars in view that so many detections are matched with."""
    return int(STARS_PER_DETECTION * detections) + 5


def _free(stage: GrowthStage, matches: int, is_narrow: bool) -> Bools:
    """Whether the stage fits each of the lens parameters (5,)."""
    if not stage.whole_lens:
        return np.array([True, False, False, False, False])
    if not is_narrow:
        return np.ones(5, dtype=bool)
    return np.array([True, matches >= MATCHES_FOR_ASPECT, matches >= MATCHES_FOR_BEND, False, False])


def _match(
    view: LensView, xy_px: Array, rays_icrs: Array, gate_px: float, middle_icrs: Array, region_cos: float
) -> tuple[Ints, Ints, int]:
    """Nearest (detection, star) within the gate, and the number of stars predicted.

    About as many of the brightest stars in view take part as there are detections (n, 2).
    """
    from scipy.spatial import cKDTree

    wanted = _stars_wanted(len(xy_px))
    count = 2 * wanted
    while True:
        count *= 2
        px, inside = view.project(rays_icrs[:count])
        some = np.flatnonzero(inside)[:wanted]
        if len(some) == wanted or count >= len(rays_icrs):
            break
    if region_cos > -1.0:
        some = some[rays_icrs[some] @ middle_icrs > region_cos]
    detection, star, _ = match_nearest(cKDTree(xy_px), px[some], gate_px)
    return detection, some[star], len(some)
