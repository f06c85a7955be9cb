"""From matched stars to a lens: robust first, one clip, then plainly; the order by cross-validation."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from startrack.calibration.calibrated_radius import reach_rad
from startrack.calibration.cross_validation import folds, held_out_residual_px
from startrack.calibration.lens_models import Candidate, Model, best_model, extensions, model_of
from startrack.calibration.observations import Observations
from startrack.calibration.solve import Solution, State, mean_scatter_px2, scatter_px2, solve
from startrack.camera import Camera
from startrack.camera.parameters import with_covariance
from startrack.types import Array, Bools, NotIdentified

FEWEST = 12
CLIP_CHI2 = 20.0  # two axes: one good star in 20,000 is lost
FIRST_SIGMA_PX = 1.0
ROBUST_ROUNDS = 4
SMALLEST_PX2 = 1e-6
SCATTER_SIGMA = 3.0  # chi^2 beyond which the stated centroid errors are not believed


@dataclass(frozen=True, kw_only=True)
class LensFit:
    """A fitted camera with its attitudes, and how well it fits."""

    camera: Camera  # with covariance; calibrated to where stars reach
    R_cam_icrs: Array  # (images, 3, 3)
    turn_covariance_rad2: Array  # (images, 3, 3); of boards (images, 6, 6), with the places [squares]
    residual_px: Array  # (n, 2) measured minus predicted, of all observations
    used: Bools  # (n,) not clipped
    held_out_px: Array  # (n, 2) residual where the fit did not see the observation; of the clipped ones the plain one
    extra_sigma_px: float  # error per axis beyond the stated centroid errors
    chi2_per_dof: float  # with the stated centroid errors alone
    candidates: tuple[Candidate, ...]

    @property
    def held_out_rms_px(self) -> float:
        """RMS distance of the stars from where a fit without them puts them."""
        return float(np.sqrt(np.mean(np.sum(np.square(self.held_out_px[self.used]), axis=1))))

    @property
    def rms_px(self) -> float:
        """RMS distance of the used stars."""
        return float(np.sqrt(np.mean(np.sum(np.square(self.residual_px[self.used]), axis=1))))


def fit_lens(
    start: Camera, R_cam_icrs: Array, points: Observations, *, order: int | None = None, plain: bool = False
) -> LensFit:
    """The lens and the attitudes that fit the observations best, from a start that is roughly right.

    `order`: how many k; None: held-out data decide. `plain`: square pixels and a centred lens, whatever they say.
    Raises NotIdentified where fewer than 12 observations agree with each other.
    """
    state = State(camera=start, R_cam_icrs=np.asarray(R_cam_icrs, dtype=np.float64))
    return fit_state(state, points, order=order, plain=plain)


def fit_state(state: State, points: Observations, *, order: int | None = None, plain: bool = False) -> LensFit:
    """As fit_lens, from a state: a board's has places beside the attitudes."""
    if len(points) < FEWEST:
        raise NotIdentified(f"{len(points)} matched stars cannot fix a lens: at least {FEWEST} are needed")
    for _ in range(2):
        robust, extra = _robust(state, points, order)
        used = _agreeing(robust, points, extra)
        good = points.take(used)
        if len(good) < FEWEST:
            raise NotIdentified(f"only {len(good)} of {len(points)} matched stars agree on a lens", matched=len(good))
        model, best, candidates = best_model(robust.state, good, max(extra, SMALLEST_PX2), order, plain)
        if extensions(best.state.camera) == extensions(state.camera):
            break
        state = best.state  # the clip was that of a poorer model: once more with the better one
    return _finished(model, best, points, used, candidates)


def _robust(state: State, points: Observations, order: int | None) -> tuple[Solution, float]:
    """Solution with Cauchy's loss, and the variance per axis that the centroids have beyond the stated one."""
    extra = FIRST_SIGMA_PX**2
    for k in range(ROBUST_ROUNDS):
        free = model_of(state.camera, 1 + k if order is None else min(order, 1 + k)).free
        solution = solve(state, points, free, max(extra, SMALLEST_PX2), robust=True)
        state = solution.state
        extra = scatter_px2(solution.residual_px, points.covariance_px2, _count(solution))
    return solution, extra


def _agreeing(solution: Solution, points: Observations, extra: float) -> Bools:
    inverse = np.linalg.inv(points.covariance_px2 + max(extra, SMALLEST_PX2) * np.eye(2))
    return np.einsum("ni,nij,nj->n", solution.residual_px, inverse, solution.residual_px) < CLIP_CHI2


def _count(solution: Solution) -> int:
    return solution.terms.lens.shape[2] + solution.terms.turn.shape[2] * solution.terms.images


def _finished(
    model: Model, best: Solution, points: Observations, used: Bools, candidates: tuple[Candidate, ...]
) -> LensFit:
    """The last plain fit, with sigmas that the scatter supports, and its covariance."""
    good = points.take(used)
    dof = max(2 * len(good) - _count(best), 1)
    stated = good.covariance_px2 + SMALLEST_PX2 * np.eye(2)
    chi2 = float(np.einsum("ni,nij,nj->", best.residual_px, np.linalg.inv(stated), best.residual_px))
    believed = chi2 < dof + SCATTER_SIGMA * np.sqrt(2.0 * dof)
    extra = 0.0 if believed else mean_scatter_px2(best.residual_px, good.covariance_px2, _count(best))
    last = solve(best.state, good, model.free, max(extra, SMALLEST_PX2))
    rays = last.state.rays_cam(points)
    off_axis = np.arctan2(np.hypot(rays[:, 0], rays[:, 1]), rays[:, 2])
    residual = last.state.residual_px(points, rays)
    held = np.array(residual)
    held[used] = held_out_residual_px(last, folds(good, off_axis[used]))
    fitted, top = last.state.camera, last.state.camera.lens.max_invertible_rad
    reached = min(reach_rad(off_axis[used]), top)
    camera = replace(fitted, calibrated_angle_rad=reached, max_angle_rad=max(min(fitted.max_angle_rad, top), reached))
    return LensFit(
        camera=with_covariance(camera, model.free, last.normal.lens_covariance),
        R_cam_icrs=last.state.R_cam_icrs,
        turn_covariance_rad2=last.normal.turn_covariance,
        residual_px=residual,
        used=used,
        held_out_px=held,
        extra_sigma_px=float(np.sqrt(extra)),
        chi2_per_dof=chi2 / dof,
        candidates=candidates,
    )
