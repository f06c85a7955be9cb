"""Lens and attitudes from matched stars: a robust fit, one rejection of outliers, then least squares.

The lens model is chosen by cross-validation: each model predicts stars that its fit did not contain.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import repeat

import numpy as np

from startrack.camera import Camera, Decentring, Lens, default_lens, lens_kinds, with_covariance
from startrack.core.runner import map_in_threads
from startrack.core.types import Array, Bools, Ints, NotIdentified
from startrack.estimation.adjust import (
    SMALLEST_EXTRA_PX2,
    SQUARES,
    CameraState,
    Observations,
    Scheme,
    Solution,
    State,
    adjust,
    cauchy_loss,
    chi_square,
    extra_variance_px2,
    inverse_covariance,
)
from startrack.frames import off_axis_rad

LENS_FOLDS = 10
EQUALLY_GOOD_CHI2 = 4.0  # up to this difference the longer polynomial is chosen: its covariance is valid up to the edge
RISES_BEYOND_1 = 1.1  # of the outermost star's angle: the polynomial must increase up to there
NARROW_RAD = np.radians(30.0)
EXTENSION_CHI2 = 15.0  # decrease of the held-out chi-square that justifies decentring or oblong pixels
LEAST_SQUARES = Scheme(loss=SQUARES)
MIN_LENS_STARS = 12
WRONG_MATCH_CHI2 = 20.0  # two axes: rejects one good star in 20,000
CAUCHY_CHI2 = 5.0  # chi-square at which the robust loss has halved a star's weight
ROBUST = Scheme(loss=cauchy_loss(CAUCHY_CHI2), settled_px=2e-3)  # it only separates wrong matches from right ones
ROBUST_ROUNDS = 4
FIRST_SIGMA_PX = 1.0
SCATTER_SIGMAS = 3.0  # deviation of a chi-square up to which it is chance
MIN_BEYOND, FRACTION_BEYOND = 3, 0.01  # stars at the calibrated angle or farther off the axis
WIDEST_GAP_RAD = np.radians(8.0)


def assign_folds(points: Observations, angle_rad: Array) -> Ints:
    """Fold (n,) of each observation: every image and every ring is divided evenly among the folds."""
    order = np.lexsort((angle_rad, points.image))
    fold = np.empty(len(points), dtype=np.int64)
    fold[order] = np.arange(len(points)) % LENS_FOLDS
    return fold


def held_out_residual_px(solution: Solution, fold: Ints) -> Array:
    """Residual (n, 2) [px] of each observation with respect to lens and attitudes from the other folds.

    One Gauss-Newton step from the solution with all observations: there the fit is nearly linear.
    """
    terms, out = solution.terms, np.array(solution.residual_px)
    for k in range(LENS_FOLDS):
        held = np.flatnonzero(fold == k)
        if not len(held):
            continue
        part = terms.take(held)
        rest = solution.equations.subtract(part.normal_equations(solution.weight[held], solution.residual_px[held]))
        out[held] -= part.shift_px(*rest.solve())
    return out


@dataclass(frozen=True, kw_only=True)
class LensModel:
    """Free parameters of a camera: the kind of lens, how many of its parameters, and two extensions."""

    lens: type[Lens]
    size: int  # number of free parameters of the lens
    aspect: bool = False  # fx and fy separate
    decentred: bool = False

    @property
    def free(self) -> tuple[str, ...]:
        """Names of the free parameters."""
        focal = ("fx", "fy") if self.aspect else ("f",)
        decentring = ("p1", "p2") if self.decentred else ()
        return (*focal, "cx", "cy", *self.lens.parameter_names[: self.size], *decentring)

    @property
    def text(self) -> str:
        """Name of the model in reports."""
        added = (", fx and fy apart" if self.aspect else "") + (", decentred" if self.decentred else "")
        return self.lens.fit_text(self.size) + added

    def start_from(self, state: CameraState) -> CameraState:
        """A state of this model that is close to a state of another one."""
        camera = replace(state.camera, lens=self.lens.fit_start(state.camera.lens, self.size))
        if not self.aspect:
            focal = float(np.sqrt(np.prod(camera.focal_px)))
            camera = replace(camera, focal_px=(focal, focal))
        if not self.decentred:
            camera = replace(camera, decentring=Decentring())
        return replace(state, camera=camera)


def model_of(camera: Camera, size: int) -> LensModel:
    """The model of a camera, with at most `size` free parameters of its lens."""
    kind = type(camera.lens)
    aspect, decentred = extensions_of(camera)
    return LensModel(lens=kind, size=kind.fit_size(size), aspect=aspect, decentred=decentred)


def extensions_of(camera: Camera) -> tuple[bool, bool]:
    """Whether fx and fy of a camera differ, and whether it is decentred."""
    return camera.focal_px[0] != camera.focal_px[1], bool(camera.decentring)


@dataclass(frozen=True, kw_only=True)
class ModelScore:
    """The score of a lens model by stars that its fit did not contain."""

    name: str
    parameters: int
    held_out_chi2: float
    held_out_rms_px: float  # of the distance


@dataclass(frozen=True)
class _Fitted:
    model: LensModel
    solution: Solution
    score: ModelScore


def best_model(
    state: CameraState, points: Observations, extra_px2: float, coefficients: int | None, square: bool
) -> tuple[LensModel, Solution, tuple[ModelScore, ...]]:
    """The model that predicts held-out stars best, its solution, and the scores of all models tried.

    `coefficients`: number of free parameters of the default lens; None: all lenses are tried. `square`: square pixels
    and a centred lens.
    """
    rays = state.rays_cam(points)
    off_axis = off_axis_rad(rays)
    outermost, fold = float(off_axis.max()), assign_folds(points, off_axis)

    def fit(model: LensModel, start: CameraState) -> _Fitted:
        solution = adjust(model.start_from(start), points, model.free, LEAST_SQUARES, extra_px2=extra_px2)
        held = held_out_residual_px(solution, fold)
        score = ModelScore(
            name=model.text,
            parameters=len(model.free),
            held_out_chi2=float(np.einsum("ni,nij,nj->", held, solution.weight, held)),
            held_out_rms_px=float(np.sqrt(np.mean(np.sum(held**2, axis=1)))),
        )
        return _Fitted(model, solution, score)

    if coefficients is None:
        lenses = sorted(lens_kinds().values(), key=lambda lens: len(lens.fit_sizes()))  # those of fixed shape first
        models = [
            LensModel(lens=lens, size=n) for lens in lenses if outermost < lens.max_fit_rad for n in lens.fit_sizes()
        ]
    else:
        models = [LensModel(lens=default_lens(), size=default_lens().fit_size(coefficients))]
    fitted = list(map_in_threads(fit, models, repeat(state)))
    chosen = _choose_longest(fitted, outermost)
    for _ in range(0 if square else 2):
        base = chosen.model
        wider = [one for one in (replace(base, aspect=True), replace(base, decentred=True)) if one != base]
        more = list(map_in_threads(fit, wider, repeat(chosen.solution.state)))
        fitted += more
        better = min(more, key=lambda f: f.score.held_out_chi2, default=chosen)
        if better.score.held_out_chi2 > chosen.score.held_out_chi2 - EXTENSION_CHI2:
            break
        chosen = better
    return chosen.model, chosen.solution, tuple(f.score for f in fitted)


def _choose_longest(fitted: list[_Fitted], outermost_rad: float) -> _Fitted:
    """The longest of the equally good polynomials; in narrow fields, where the terms are degenerate, the shortest."""
    enough = min(RISES_BEYOND_1 * outermost_rad, np.pi - 0.01)
    sound = [f for f in fitted if f.solution.state.camera.lens.max_invertible_rad > enough] or fitted
    least = min(f.score.held_out_chi2 for f in sound)
    good = [f for f in sound if f.score.held_out_chi2 <= least + EQUALLY_GOOD_CHI2]
    return good[0] if outermost_rad < NARROW_RAD else good[-1]


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
    state = State(camera=start, R_cam_icrs=np.asarray(R_cam_icrs, dtype=np.float64))
    return fit_state(state, points, coefficients=coefficients, square=square)


def fit_state(
    state: CameraState, points: Observations, *, coefficients: int | None = None, square: bool = False
) -> LensFit:
    """Lens and attitudes that fit `points` best, as by `fit_lens`; a `state` of boards has positions besides."""
    if len(points) < MIN_LENS_STARS:
        raise NotIdentified(
            f"{len(points)} matched stars cannot determine a lens: at least {MIN_LENS_STARS} are needed"
        )
    for _ in range(2):
        robust_state, extra_px2 = state, FIRST_SIGMA_PX**2
        for k in range(ROBUST_ROUNDS):  # the polynomial grows
            free = model_of(robust_state.camera, 1 + k if coefficients is None else min(coefficients, 1 + k)).free
            robust = adjust(robust_state, points, free, ROBUST, extra_px2=extra_px2)
            robust_state = robust.state
            extra_px2 = extra_variance_px2(robust.residual_px, points.covariance_px2, robust.parameters)
        inverse = inverse_covariance(points.covariance_px2, extra_px2)
        used = chi_square(robust.residual_px, inverse) < WRONG_MATCH_CHI2
        good = points.take(used)
        if len(good) < MIN_LENS_STARS:
            raise NotIdentified(f"only {len(good)} of {len(points)} matched stars agree on a lens", matched=len(good))
        model, best, candidates = best_model(robust.state, good, extra_px2, coefficients, square)
        if extensions_of(best.state.camera) == extensions_of(state.camera):
            break
        state = best.state  # the outliers were rejected with a simpler model: repeat with the chosen one
    return _finish(model, best, points, used, candidates)


def _finish(
    model: LensModel, best: Solution, points: Observations, used: Bools, candidates: tuple[ModelScore, ...]
) -> LensFit:
    """The last fit, with sigmas that the scatter supports, its covariance, and the held-out residuals."""
    good = points.take(used)
    dof = max(2 * len(good) - best.parameters, 1)
    stated = inverse_covariance(good.covariance_px2, SMALLEST_EXTRA_PX2)
    chi2 = float(np.sum(chi_square(best.residual_px, stated)))
    believed = is_chance(chi2, dof)
    extra_px2 = (
        0.0 if believed else extra_variance_px2(best.residual_px, good.covariance_px2, best.parameters, by_sum=True)
    )
    last = adjust(best.state, good, model.free, LEAST_SQUARES, extra_px2=max(extra_px2, SMALLEST_EXTRA_PX2))
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
    """Calibrated angle [rad] of stars at angles (n,) off the axis: at least three of them, and 1 %, lie beyond it.

    It also ends at a gap of more than 8 degrees without stars: beyond that the lens would be extrapolated.
    """
    ordered = np.sort(off_axis_rad)
    beyond = max(MIN_BEYOND, int(np.ceil(FRACTION_BEYOND * len(ordered))))
    outermost = ordered[max(len(ordered) - beyond, 0)]
    outer = ordered[ordered >= ordered[len(ordered) // 2]]
    gaps = np.flatnonzero(np.diff(outer) > WIDEST_GAP_RAD)
    return float(min(outermost, outer[gaps[0]]) if len(gaps) else outermost)
