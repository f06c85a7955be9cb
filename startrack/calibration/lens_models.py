"""Choice of the lens model: every candidate is judged by stars that its fit did not use (cross-validation)."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from startrack.calibration.cross_validation import folds, held_out_residual_px
from startrack.calibration.observations import Observations
from startrack.calibration.solve import Solution, State, solve
from startrack.camera import Camera, Decentring, Lens
from startrack.camera.lenses import default_lens, lens_kinds
from startrack.types import Ints

NEARLY_AS_GOOD_CHI2 = 4.0  # a longer polynomial this little worse is taken: its covariance owns up to the rim
RISES_BEYOND = 1.1  # of the outermost star: a polynomial that turns back sooner is a bad one
NARROW_RAD = np.radians(30.0)
EXTRA_CHI2 = 15.0  # by which the held-out chi^2 must fall before a lens is called decentred, or its pixels not square


@dataclass(frozen=True, kw_only=True)
class Model:
    """What is free in a camera: the kind of lens, how many of its parameters, and two extensions."""

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
        extensions = (", fx and fy apart" if self.aspect else "") + (", decentred" if self.decentred else "")
        return self.lens.fit_text(self.size) + extensions

    def begin(self, state: State) -> State:
        """A state of this model, from one of another."""
        camera = replace(state.camera, lens=self.lens.fit_start(state.camera.lens, self.size))
        if not self.aspect:
            focal = float(np.sqrt(np.prod(camera.focal_px)))
            camera = replace(camera, focal_px=(focal, focal))
        if not self.decentred:
            camera = replace(camera, decentring=Decentring())
        return replace(state, camera=camera)


def model_of(camera: Camera, size: int) -> Model:
    """The model of a camera, with at most `size` free parameters of its lens."""
    kind = type(camera.lens)
    aspect, decentred = extensions(camera)
    return Model(lens=kind, size=kind.fit_size(size), aspect=aspect, decentred=decentred)


def extensions(camera: Camera) -> tuple[bool, bool]:
    """Whether fx and fy of a camera differ, and whether it is decentred."""
    return camera.focal_px[0] != camera.focal_px[1], bool(camera.decentring)


def candidate_models(outermost_rad: float) -> list[Model]:
    """Models for stars up to this angle off the axis: lenses of fixed shape first, then by number of parameters."""
    lenses = sorted(lens_kinds().values(), key=lambda lens: len(lens.fit_sizes()))
    return [Model(lens=lens, size=n) for lens in lenses if outermost_rad < lens.max_fit_rad for n in lens.fit_sizes()]


@dataclass(frozen=True, kw_only=True)
class Candidate:
    """One lens model that was tried."""

    name: str
    parameters: int
    held_out_chi2: float
    held_out_rms_px: float  # of the distance


@dataclass(frozen=True)
class _Tried:
    model: Model
    solution: Solution
    candidate: Candidate

    @property
    def score(self) -> float:
        return self.candidate.held_out_chi2


def best_model(
    state: State, points: Observations, extra_px2: float, order: int | None, plain: bool
) -> tuple[Model, Solution, tuple[Candidate, ...]]:
    """The model that predicts held-out stars best, fitted, and all that were tried.

    `order`: number of free parameters of the default lens if that is decided; None: all lenses are tried. `plain`:
    square pixels and a centred lens.
    """
    rays = state.rays_cam(points)
    off_axis = np.arctan2(np.hypot(rays[:, 0], rays[:, 1]), rays[:, 2])
    fold = folds(points, off_axis)

    def attempt(model: Model, start: State) -> _Tried:
        return _try(model, model.begin(start), points, extra_px2, fold)

    if order is None:
        models = candidate_models(float(off_axis.max()))
    else:
        models = [Model(lens=default_lens(), size=default_lens().fit_size(order))]
    tried = [attempt(model, state) for model in models]
    chosen = _longest_of_the_best(tried, float(off_axis.max()))
    for _ in range(0 if plain else 2):
        wider = [m for m in _extended(chosen.model) if m is not None]
        more = [attempt(model, chosen.solution.state) for model in wider]
        tried += more
        better = min(more, key=lambda t: t.score, default=chosen)
        if better.score > chosen.score - EXTRA_CHI2:
            break
        chosen = better
    return chosen.model, chosen.solution, tuple(t.candidate for t in tried)


def _extended(model: Model) -> tuple[Model | None, Model | None]:
    return (
        None if model.aspect else replace(model, aspect=True),
        None if model.decentred else replace(model, decentred=True),
    )


def _try(model: Model, start: State, points: Observations, extra_px2: float, fold: Ints) -> _Tried:
    solution = solve(start, points, model.free, extra_px2)
    held = held_out_residual_px(solution, fold)
    chi2 = np.einsum("ni,nij,nj->", held, solution.weight, held)
    candidate = Candidate(
        name=model.text,
        parameters=len(model.free),
        held_out_chi2=float(chi2),
        held_out_rms_px=float(np.sqrt(np.mean(np.sum(held**2, axis=1)))),
    )
    return _Tried(model, solution, candidate)


def _longest_of_the_best(tried: list[_Tried], outermost_rad: float) -> _Tried:
    enough = min(RISES_BEYOND * outermost_rad, np.pi - 0.01)
    sound = [t for t in tried if t.solution.state.camera.lens.max_invertible_rad > enough] or tried
    least = min(t.score for t in sound)
    good = [t for t in sound if t.score <= least + NEARLY_AS_GOOD_CHI2]
    # In a narrow field the terms look alike, and a long polynomial is a sum of large numbers: the shortest will do.
    return good[0] if outermost_rad < NARROW_RAD else good[-1]
