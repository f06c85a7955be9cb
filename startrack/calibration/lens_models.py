"""Which lens model the data bear: every one is judged by stars that its fit did not see."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from startrack.calibration.cross_validation import folds, held_out_residual_px
from startrack.calibration.observations import Observations
from startrack.calibration.solve import Solution, State, solve
from startrack.camera import Camera, Decentring, KannalaBrandt, Pinhole
from startrack.types import Ints

MOST_ORDERS = 4
PINHOLE_LIMIT_RAD = np.radians(65.0)  # the tangent is no lens beyond
NEARLY_AS_GOOD_CHI2 = 4.0  # a longer polynomial this little worse is taken: its covariance owns up to the rim
RISES_BEYOND = 1.1  # of the outermost star: a polynomial that turns back sooner is a bad one
NARROW_RAD = np.radians(30.0)
EXTRA_CHI2 = 15.0  # by which the held-out chi^2 must fall before a lens is called decentred, or its pixels not square


@dataclass(frozen=True, kw_only=True)
class Model:
    """What is free in a lens."""

    order: int | None  # number of k; None: pinhole
    aspect: bool = False  # fx and fy apart
    decentred: bool = False

    @property
    def free(self) -> tuple[str, ...]:
        """Names of the free parameters."""
        focal = ("fx", "fy") if self.aspect else ("f",)
        bent = ("p1", "p2") if self.decentred else ()
        return (*focal, "cx", "cy", *(f"k{n + 1}" for n in range(self.order or 0)), *bent)

    @property
    def text(self) -> str:
        """For people."""
        lens = "pinhole" if self.order is None else f"Kannala-Brandt with {self.order} k"
        return lens + (", fx and fy apart" if self.aspect else "") + (", decentred" if self.decentred else "")

    def begin(self, state: State) -> State:
        """A state of this model, from one of another."""
        camera = state.camera
        if self.order is None:
            camera = replace(camera, lens=Pinhole())
        else:
            camera = replace(camera, lens=KannalaBrandt((*camera.lens.k, *(MOST_ORDERS * (0.0,)))[: self.order]))
        if not self.aspect:
            focal = float(np.sqrt(np.prod(camera.focal_px)))
            camera = replace(camera, focal_px=(focal, focal))
        if not self.decentred:
            camera = replace(camera, decentring=Decentring())
        return replace(state, camera=camera)


def model_of(camera: Camera, order: int | None) -> Model:
    """The model that a camera is of, with another number of k."""
    aspect = camera.focal_px[0] != camera.focal_px[1]
    return Model(order=order, aspect=aspect, decentred=bool(camera.decentring))


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

    `order`: the number of k, where it is decided already; `plain`: square pixels and a centred lens, likewise.
    """
    rays = state.rays_cam(points)
    off_axis = np.arctan2(np.hypot(rays[:, 0], rays[:, 1]), rays[:, 2])
    fold = folds(points, off_axis)

    def attempt(model: Model, start: State) -> _Tried:
        return _try(model, model.begin(start), points, extra_px2, fold)

    models = [Model(order=k) for k in range(MOST_ORDERS + 1)] if order is None else [Model(order=order)]
    if order is None and off_axis.max() < PINHOLE_LIMIT_RAD:
        models.insert(0, Model(order=None))
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
