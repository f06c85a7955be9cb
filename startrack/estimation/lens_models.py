"""Choice of the lens model by cross-validation: each model predicts stars that its fit did not contain."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import repeat

import numpy as np

from startrack.camera import Camera, Decentring, Lens, default_lens, lens_kinds
from startrack.core.runner import map_in_threads
from startrack.core.types import Array, Ints
from startrack.estimation.adjust import SQUARES, CameraState, Scheme, Solution, adjust
from startrack.estimation.normal_equations import Observations
from startrack.frames import off_axis_rad

LENS_FOLDS = 10
EQUALLY_GOOD_CHI2 = 4.0  # up to this difference the longer polynomial is chosen: its covariance is valid up to the edge
RISES_BEYOND_1 = 1.1  # of the outermost star's angle: the polynomial must increase up to there
NARROW_RAD = np.radians(30.0)
EXTENSION_CHI2 = 15.0  # decrease of the held-out chi-square that justifies decentring or oblong pixels
LEAST_SQUARES = Scheme(loss=SQUARES)


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
        """Name in reports."""
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
    """Result of one lens model."""

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
