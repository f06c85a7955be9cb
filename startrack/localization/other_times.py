"""Times other than the stated one at which real ground explains the rows too: found by turning the rows over it."""

from __future__ import annotations

import numpy as np

from startrack.core.types import Array, Clock, Evidence
from startrack.localization.clock import turn_evidence
from startrack.localization.clock_track import Track
from startrack.localization.explored import Explored
from startrack.localization.initial_guess import Guess, local_posterior
from startrack.localization.likelihood import PositionLikelihood
from startrack.localization.sector_moments import solve_linear
from startrack.localization.skyline_model import SkylineModel
from startrack.terrain import Terrain

LINEAR_TURN_RAD = np.radians(0.05)  # of the sky: up to it the skyline of a map changes linearly with the time
STEP_RAD = np.radians(0.13)  # of the turn between two times that are tried
REACH_SIGMAS = 3.0  # of a gross error of the clock
APART_RAD = np.radians(0.3)  # of the turn between two times that are sampled
MOST_TIMES, TIME_NATS = 3, 12.0  # that are sampled; less likely ones than the best by more are not


def is_wide(clock: Clock, terrain: Terrain) -> bool:
    """Whether the stated error of a clock turns the sky over more than a skyline's shape is linear in."""
    if terrain.axisymmetric:
        return False
    return not is_linear(clock, clock.sigma_s)


def is_linear(clock: Clock, error_s: float) -> bool:
    """Whether the skyline of real ground is linear in an error of the clock of this size."""
    return abs(error_s) * float(np.linalg.norm(clock.turn_rad_s)) <= LINEAR_TURN_RAD


def explore_times(plain: PositionLikelihood, evidence: Evidence, clock: Clock) -> list[tuple[Evidence, Explored]]:
    """The rows turned to each likely time that a wide clock allows, and the boxes there.

    `plain` is the likelihood of the search. Raises NotLocated as `Track` does.
    """
    later_s, log_share, way_m = Track(evidence, plain.terrain, clock).likely_way()
    found: list[tuple[Evidence, Explored]] = []
    for at in _peaks(later_s, log_share, clock):
        rows = turn_evidence(evidence, float(later_s[at]))
        likelihood = replace_rows(plain, rows)
        found.append((rows, local_posterior(likelihood, Guess(way_m[at][None], np.zeros(1)), -np.inf)))
    return found


def replace_rows(likelihood: PositionLikelihood, rows: Evidence) -> PositionLikelihood:
    """The same likelihood of other rows."""
    sectors = likelihood.sectors
    return PositionLikelihood.from_evidence(rows, likelihood.terrain, 2 * np.pi / sectors.count, sectors.epsilon)


def turned_model(model: SkylineModel, later_s: float, is_rough: bool = False) -> SkylineModel:
    """The model with its rows turned to a later time; see `SkylineModel.is_rough`."""
    return model.with_rows(turn_evidence(model.rows, later_s), is_rough)


def turned_models(model: SkylineModel, clock: Clock) -> list[SkylineModel]:
    """The model at the likeliest times of a gross error of its `clock`, far enough from the stated one."""
    turn = float(np.linalg.norm(clock.turn_rad_s))
    count = int(np.ceil(REACH_SIGMAS * clock.gross_sigma_s * turn / STEP_RAD))
    later_s = np.arange(-count, count + 1) * STEP_RAD / turn
    fits = np.array([_fit(turned_model(model, later, is_rough=True)) for later in later_s])
    fits -= 0.5 * np.square(later_s / clock.gross_sigma_s)
    likely = [float(later_s[at]) for at in _peaks(later_s, fits, clock)]
    return [turned_model(model, later) for later in likely if later != 0.0]


def _fit(model: SkylineModel) -> float:
    """Log-likelihood of the rows where position and shared errors suit them, by the linear model of the sectors."""
    k = 2 + len(model.basis)
    design = np.vstack([model.position_slopes, model.slopes_rad]).T
    prior = np.diag(np.r_[np.full(2, model.terrain.reach_m**-2.0), np.ones(k - 2)])
    parameters, _, _ = solve_linear(model.moments, design, np.zeros(k), prior)
    parameters[:2] += model.reference_m
    return float(model.log_likelihood(parameters[None])[0]) + model.log_offset


def _peaks(later_s: Array, fits: Array, clock: Clock) -> list[int]:
    """The likeliest times that are apart from each other."""
    apart_s = APART_RAD / float(np.linalg.norm(clock.turn_rad_s))
    chosen: list[int] = []
    for at in np.argsort(-fits):
        if fits[at] < fits.max() - TIME_NATS or len(chosen) == MOST_TIMES:
            break
        if all(abs(later_s[at] - later_s[other]) > apart_s for other in chosen):
            chosen.append(int(at))
    return chosen
