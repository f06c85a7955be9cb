"""Least squares over one lens and one attitude per image, plain or robust."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from startrack.calibration.normal import Normal, Terms
from startrack.calibration.observations import Observations
from startrack.camera import Camera
from startrack.camera.parameters import with_update
from startrack.frames import R_from_rotvec
from startrack.types import Array

ROUNDS = 40
SETTLED_PX = 1e-6
NEARLY_SETTLED_PX = 2e-3  # of a robust fit, which only has to tell wrong matches from right ones
CAUCHY_CHI2 = 5.0  # chi^2 (two axes) at which the robust loss has halved a star's weight
CHI2_2DOF_MEDIAN = 1.3863
FIRST_DAMPING, MOST_DAMPING = 1e-6, 1e6


@dataclass(frozen=True, kw_only=True)
class State:
    """A camera and the attitudes R_cam_icrs (images, 3, 3) of its images."""

    camera: Camera
    R_cam_icrs: Array

    def rays_cam(self, points: Observations) -> Array:
        """Directions (n, 3) of the observations in their cameras' axes."""
        return np.einsum("nij,nj->ni", self.R_cam_icrs[points.image], points.rays_icrs)

    def residual_px(self, points: Observations, rays_cam: Array | None = None) -> Array:
        """Measured minus predicted (n, 2), also outside the frame and the calibrated angle."""
        rays_cam = self.rays_cam(points) if rays_cam is None else rays_cam
        return points.xy_px - self.camera.project_unlimited(rays_cam)

    def terms(self, points: Observations, rays_cam: Array, free: tuple[str, ...]) -> Terms:
        """Derivatives of the observations' pixels by the free parameters and the attitudes."""
        return Terms.at(self.camera, rays_cam, points.image, len(self.R_cam_icrs), free)

    def stepped(self, free: tuple[str, ...], lens: Array, turns_rad: Array) -> State:
        """The state after a step of the free parameters (m,) and of the attitudes (images, 3)."""
        turned = R_from_rotvec(turns_rad) @ self.R_cam_icrs
        return replace(
            self, camera=with_update(self.camera, dict(zip(free, lens.tolist(), strict=True))), R_cam_icrs=turned
        )


@dataclass(frozen=True, kw_only=True)
class Solution:
    """Where the least squares settled."""

    state: State
    terms: Terms
    normal: Normal  # at the solution
    residual_px: Array  # (n, 2)
    chi2: Array  # (n,) with the weights' own sigma
    weight: Array  # (n, 2, 2) used


def solve(
    start: State, points: Observations, free: tuple[str, ...], extra_px2: float = 0.0, robust: bool = False
) -> Solution:
    """Levenberg-Marquardt from `start`; `robust`: Cauchy's loss, so that wrong matches do not pull.

    `extra_px2`: variance per axis beyond the stated one.
    """
    inverse: Array = np.linalg.inv(points.covariance_px2 + extra_px2 * np.eye(2)).astype(np.float64)
    state, damping = start, FIRST_DAMPING
    rays_cam = state.rays_cam(points)
    residual = state.residual_px(points, rays_cam)
    chi2, cost = _cost(residual, inverse, robust)
    settled = False
    for _ in range(ROUNDS):
        terms = state.terms(points, rays_cam, free)
        weight = inverse / (1.0 + chi2 / CAUCHY_CHI2)[:, None, None] if robust else inverse
        normal = terms.normal(weight, residual)
        if settled:
            break
        while damping < MOST_DAMPING:
            lens, turns = normal.damped(damping).solve()
            trial = state.stepped(free, lens, turns)
            trial_rays = trial.rays_cam(points)
            trial_residual = trial.residual_px(points, trial_rays)
            trial_chi2, trial_cost = _cost(trial_residual, inverse, robust)
            if trial_cost <= cost * (1 + 1e-12) and _rises(trial.camera):
                break
            damping = max(damping * 10.0, 1e-6)
        else:
            break
        damping = max(damping / 30.0, 1e-12)
        shift = float(np.sqrt(np.mean(np.square(trial_residual - residual)))) if len(residual) else 0.0
        state, rays_cam, residual, chi2, cost = trial, trial_rays, trial_residual, trial_chi2, trial_cost
        settled = shift < (NEARLY_SETTLED_PX if robust else SETTLED_PX)
    return Solution(state=state, terms=terms, normal=normal, residual_px=residual, chi2=chi2, weight=weight)


def _rises(camera: Camera) -> bool:
    """Whether the lens's polynomial rises at all; a step must not fold the image onto itself near the axis."""
    return min(camera.focal_px) > 0 and camera.lens.max_invertible_rad > 0.2


def _cost(residual: Array, inverse: Array, robust: bool) -> tuple[Array, float]:
    chi2 = np.einsum("ni,nij,nj->n", residual, inverse, residual)
    return chi2, float(np.sum(CAUCHY_CHI2 * np.log1p(chi2 / CAUCHY_CHI2)) if robust else np.sum(chi2))


def scatter_px2(residual: Array, covariance_px2: Array, fitted: int) -> float:
    """Variance per axis [px^2] to add to every centroid so that the median chi^2 (two axes) is as expected.

    `fitted`: number of parameters, whose share the residuals (n, 2) lack.
    """
    n = len(residual)
    expected = CHI2_2DOF_MEDIAN * max(1.0 - fitted / (2.0 * n), 0.1)
    axes_px2, axes = np.linalg.eigh(covariance_px2)
    squared = np.square(np.einsum("nij,ni->nj", axes, residual))
    return _variance(lambda extra: float(np.median(np.sum(squared / (axes_px2 + extra), axis=1))), expected)


def mean_scatter_px2(residual: Array, covariance_px2: Array, fitted: int) -> float:
    """As scatter_px2, so that the sum of chi^2 equals the degrees of freedom; for residuals without wrong ones."""
    axes_px2, axes = np.linalg.eigh(covariance_px2)
    squared = np.square(np.einsum("nij,ni->nj", axes, residual))
    expected = max(2.0 * len(residual) - fitted, 1.0)
    return _variance(lambda extra: float(np.sum(squared / (axes_px2 + extra))), expected)


def _variance(statistic: Callable[[float], float], expected: float) -> float:
    """The variance at which the falling statistic meets what is expected; 0 where it is below from the start."""
    low, high = 1e-10, 1.0
    if statistic(low) <= expected:
        return 0.0
    while statistic(high) > expected and high < 1e8:
        high *= 4.0
    for _ in range(60):
        middle = np.sqrt(low * high)
        low, high = (middle, high) if statistic(middle) > expected else (low, middle)
        if high < 1.0005 * low:
            break
    return float(high)
