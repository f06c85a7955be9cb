"""Errors that all azimuths share, at which the area is searched: of the horizon of a map, and of a wide clock."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from startrack.core.types import Array, Evidence
from startrack.localization.likelihood import PositionLikelihood
from startrack.localization.neighbourhood import Neighbourhood, SectorRows
from startrack.localization.search import (
    BEAMS,
    LAST_STEP_M,
    Guess,
    beam_search,
    choose_apart,
    explains_sectors,
)
from startrack.localization.sector_moments import solve_linear
from startrack.localization.shared_errors import SharedErrors
from startrack.terrain import Terrain

NEARBY_M = 40.0  # horizons are prepared that far about a position


@dataclass(frozen=True, eq=False)
class LinearSolution:
    """Position and shared errors that explain the rows near a position, by the linear model of the sectors."""

    position_m: Array  # (2,)
    bias_rad: float  # how much higher than the map's the horizon stands
    later_s: float  # how much later than that of the rows the true time is

    @classmethod
    def near(cls, rows: Evidence, terrain: Terrain, position_m: Array) -> LinearSolution:
        """About a position (2,)."""
        errors = SharedErrors.of(terrain, rows.clock)
        around = Neighbourhood(terrain, position_m, NEARBY_M)
        design = np.vstack([around.slopes, around.error_slopes_rad(errors)]).T
        prior = np.diag(np.r_[np.full(2, terrain.reach_m), errors.sigma()] ** -2.0)
        found, _, _ = solve_linear(SectorRows(around, rows).moments, design, np.append(np.zeros(2), errors.mean), prior)
        values = {one.name: float(value) for one, value in zip(errors.listed, found[2:], strict=True)}
        return cls(position_m + found[:2], values.get("bias_rad", 0.0), values.get("clock_s", 0.0))


def lower_evidence(evidence: Evidence, bias_rad: float) -> Evidence:
    """The rows as they stand above the map's horizon where the true one is `bias_rad` higher."""
    return replace(evidence, elevation_rad=evidence.elevation_rad - bias_rad) if bias_rad else evidence


def find_start(likelihood: PositionLikelihood, *, all_beams: bool = False) -> tuple[PositionLikelihood, Guess]:
    """The likelihood at the likeliest error of the horizon, and good positions by it.

    The wider beams follow where narrow ones find no position that explains all sectors. With `all_beams` they follow in
    any case, and the positions are those of all: a wrong one may explain all sectors too.
    """
    best, found, points = likelihood, Guess(np.zeros((0, 2)), np.zeros(0)), np.zeros((0, 2))
    for beam in BEAMS:
        at_bias, guess = at_likeliest_bias(likelihood, beam_search(likelihood, beam))
        points = np.vstack([points, guess.points_m])
        if guess.best > found.best:
            best, found = at_bias, guess
        if explains_sectors(found, likelihood) and not all_beams:
            return best, found
    if all_beams:
        score = best.exact_scores(points)
        apart = choose_apart(points, score, LAST_STEP_M)
        found = Guess(points[apart], score[apart])
    return best, found


def at_likeliest_bias(likelihood: PositionLikelihood, guess: Guess) -> tuple[PositionLikelihood, Guess]:
    """The likelihood of rows above the horizon with its likeliest error, and the guess by it.

    The error is that at the best position of the `guess`; where it explains the rows no better than none, none.
    """
    terrain = likelihood.terrain
    if terrain.common_sigma_rad == 0.0 or not len(guess.points_m):
        return likelihood, guess
    solution = LinearSolution.near(likelihood.evidence, terrain, guess.points_m[0])
    lowered = likelihood.with_rows(lower_evidence(likelihood.evidence, solution.bias_rad))
    points = np.vstack([solution.position_m, guess.points_m])
    points = points[np.asarray(terrain.allowed(points))]
    score = lowered.exact_scores(points) - 0.5 * (solution.bias_rad / terrain.common_sigma_rad) ** 2
    if score.max() < guess.best:
        return likelihood, guess
    order = np.argsort(-score, kind="stable")
    return lowered, Guess(points[order], score[order])
