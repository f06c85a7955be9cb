"""Lens and attitudes from matched stars: a robust fit, one rejection of outliers, then least squares.

The number of lens parameters is chosen by cross-validation.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from startrack.camera import Camera, with_covariance
from startrack.core.types import Array, Bools, NotIdentified
from startrack.estimation import adjust
from startrack.estimation.lens_models import (
    LEAST_SQUARES,
    LensModel,
    ModelScore,
    assign_folds,
    best_model,
    extensions_of,
    held_out_residual_px,
    model_of,
)
from startrack.estimation.normal_equations import Observations
from startrack.frames import off_axis_rad

MIN_LENS_STARS = 12
WRONG_MATCH_CHI2 = 20.0  # two axes: rejects one good star in 20,000
CAUCHY_CHI2 = 5.0  # chi-square at which the robust loss has halved a star's weight
ROBUST = adjust.Scheme(
    loss=adjust.cauchy_loss(CAUCHY_CHI2), settled_px=2e-3
)  # this fit only separates wrong matches from right ones
ROBUST_ROUNDS = 4
FIRST_SIGMA_PX = 1.0
SCATTER_SIGMAS = 3.0  # deviation of a chi-square up to which it is chance
MIN_BEYOND, FRACTION_BEYOND = 3, 0.01  # stars at the calibrated angle or farther off the axis
WIDEST_GAP_RAD = np.radians(8.0)


@dataclass(frozen=True, kw_only=True)
class LensFit:
    """A fitted camera with its attitudes, and the quality of the fit."""

    camera: Camera  # with covariance; calibrated up to the outermost stars
    R_cam_icrs: Array  # (images, 3, 3); of boards R_cam_board
    pose_covariance_rad2: Array  # (images, 3, 3); of boards (images, 6, 6), with the positions [squares]
    residual_px: Array  # (n, 2) measured minus predicted, of all observations
    used: Bools  # (n,) not rejected
    held_out_px: Array  # (n, 2) residual of a fit without the observation; of rejected ones the plain residual
    extra_sigma_px: float  # error per axis beyond the stated centroid errors
    chi2_per_dof: float  # with the stated centroid errors alone
    candidates: tuple[ModelScore, ...]  # all lens models tried

    @property
    def held_out_rms_px(self) -> float:
        """RMS distance of the used stars from their prediction by fits without them."""
        return float(np.sqrt(np.mean(np.sum(np.square(self.held_out_px[self.used]), axis=1))))

    @property
    def rms_px(self) -> float:
        """RMS distance of the used stars from their prediction."""
        return float(np.sqrt(np.mean(np.sum(np.square(self.residual_px[self.used]), axis=1))))


def fit_lens(
    start: Camera, R_cam_icrs: Array, points: Observations, *, coefficients: int | None = None, square: bool = False
) -> LensFit:
    """Lens and attitudes that fit the observations `points` best.

    `start` and `R_cam_icrs` (images, 3, 3) are a camera and attitudes that are roughly right.

    `coefficients`: number of parameters of the default lens; None: chosen by cross-validation. `square`: square
    pixels and a centred lens.
    Raises NotIdentified where fewer than 12 observations agree with each other.
    """
    state = adjust.State(camera=start, R_cam_icrs=np.asarray(R_cam_icrs, dtype=np.float64))
    return fit_state(state, points, coefficients=coefficients, square=square)


def fit_state(
    state: adjust.CameraState, points: Observations, *, coefficients: int | None = None, square: bool = False
) -> LensFit:
    """The same as fit_lens, from a state; that of boards has positions beside the attitudes."""
    if len(points) < MIN_LENS_STARS:
        raise NotIdentified(
            f"{len(points)} matched stars cannot determine a lens: at least {MIN_LENS_STARS} are needed"
        )
    for _ in range(2):
        robust_state, extra_px2 = state, FIRST_SIGMA_PX**2
        for k in range(ROBUST_ROUNDS):  # the polynomial grows
            free = model_of(robust_state.camera, 1 + k if coefficients is None else min(coefficients, 1 + k)).free
            robust = adjust.adjust(robust_state, points, free, ROBUST, extra_px2=extra_px2)
            robust_state = robust.state
            extra_px2 = adjust.extra_variance_px2(robust.residual_px, points.covariance_px2, robust.parameters)
        inverse = adjust.inverse_covariance(points.covariance_px2, extra_px2)
        used = adjust.chi_square(robust.residual_px, inverse) < WRONG_MATCH_CHI2
        good = points.take(used)
        if len(good) < MIN_LENS_STARS:
            raise NotIdentified(f"only {len(good)} of {len(points)} matched stars agree on a lens", matched=len(good))
        model, best, candidates = best_model(robust.state, good, extra_px2, coefficients, square)
        if extensions_of(best.state.camera) == extensions_of(state.camera):
            break
        state = best.state  # the outliers were rejected with a simpler model: repeat with the chosen one
    return _finish(model, best, points, used, candidates)


def _finish(
    model: LensModel, best: adjust.Solution, points: Observations, used: Bools, candidates: tuple[ModelScore, ...]
) -> LensFit:
    """The last fit, with sigmas that the scatter supports, its covariance, and the held-out residuals."""
    good = points.take(used)
    dof = max(2 * len(good) - best.parameters, 1)
    stated = adjust.inverse_covariance(good.covariance_px2, adjust.SMALLEST_EXTRA_PX2)
    chi2 = float(np.sum(adjust.chi_square(best.residual_px, stated)))
    believed = is_chance(chi2, dof)
    extra_px2 = (
        0.0
        if believed
        else adjust.extra_variance_px2(best.residual_px, good.covariance_px2, best.parameters, by_sum=True)
    )
    last = adjust.adjust(
        best.state, good, model.free, LEAST_SQUARES, extra_px2=max(extra_px2, adjust.SMALLEST_EXTRA_PX2)
    )
    rays = last.state.rays_cam(points)
    off_axis = off_axis_rad(rays)
    residual = last.state.residual_px(points, rays)
    held = np.array(residual)
    held[used] = held_out_residual_px(last, assign_folds(good, off_axis[used]))
    fitted, widest = last.state.camera, last.state.camera.lens.max_invertible_rad
    calibrated = min(calibrated_radius_rad(off_axis[used]), widest)
    edge = max(min(fitted.max_angle_rad, widest), calibrated)
    camera = replace(fitted, calibrated_angle_rad=calibrated, max_angle_rad=edge)
    return LensFit(
        camera=with_covariance(camera, model.free, last.equations.lens_covariance),
        R_cam_icrs=last.state.rotations,
        pose_covariance_rad2=last.equations.pose_covariance,
        residual_px=residual,
        used=used,
        held_out_px=held,
        extra_sigma_px=float(np.sqrt(extra_px2)),
        chi2_per_dof=chi2 / dof,
        candidates=candidates,
    )


def is_chance(chi2: float, freedom: int) -> bool:
    """Whether a chi-square exceeds its degrees of freedom by no more than chance makes it."""
    return bool(chi2 < freedom + SCATTER_SIGMAS * np.sqrt(2.0 * freedom))


def calibrated_radius_rad(off_axis_rad: Array) -> float:
    """Calibrated angle of stars at the angles (n,) off the axis: at least three of them, and 1 %, lie beyond it.

    It also ends at a gap of more than 8 degrees without stars: beyond that the lens would be extrapolated.
    """
    ordered = np.sort(off_axis_rad)
    beyond = max(MIN_BEYOND, int(np.ceil(FRACTION_BEYOND * len(ordered))))
    outermost = ordered[max(len(ordered) - beyond, 0)]
    outer = ordered[ordered >= ordered[len(ordered) // 2]]
    gaps = np.flatnonzero(np.diff(outer) > WIDEST_GAP_RAD)
    return float(min(outermost, outer[gaps[0]]) if len(gaps) else outermost)
