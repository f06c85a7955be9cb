"""A fix refined by the light of the sky at the skyline near it: stars and sky in one posterior on a small area."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from startrack.localization.explored import Explored
from startrack.localization.initial_guess import Guess
from startrack.localization.likelihood import PositionLikelihood
from startrack.localization.local_posterior import local_posterior
from startrack.localization.nuisance import estimate_horizon_bias, marginalize_horizon_bias, mix_shifted
from startrack.localization.summary import summarize
from startrack.terrain import Terrain
from startrack.types import Array, Evidence, Fix

STEP_M = 1.0  # at which the horizon's change with the position is taken
FIRST_SIGMAS = 6.0  # half side of the first square, of the expected posterior


def refine_fix(
    evidence: Evidence, fix: Fix, terrain: Terrain, position_m: Array, sigma_m: float, smear_m2: Array
) -> Fix:
    """The `fix` replaced by the posterior from `evidence` near a good position on a `terrain`.

    Args:
        evidence: rows near the skyline of the position, of stars and of the sky's light.
        fix: by the stars alone, whose search it keeps.
        terrain: with the evidence's enu.
        position_m: (2,) close to the best one.
        sigma_m: about that of the posterior, along its longer axis.
        smear_m2: (2, 2) covariance of the position from errors that the rows share.

    Raises NotLocated as `summarize` does.
    """

    def explore(rows: Evidence, ground: Terrain, starts_m: Array | None) -> Explored:
        likelihood = PositionLikelihood.from_evidence(rows, ground)
        start = (position_m[None] if starts_m is None else starts_m)[:1]
        return local_posterior(likelihood, Guess(start, np.zeros(1)), -np.inf, FIRST_SIGMAS * sigma_m)

    if terrain.common_sigma_rad > 0.0:
        bias = estimate_horizon_bias(PositionLikelihood.from_evidence(evidence, terrain), position_m)
        explored = marginalize_horizon_bias(explore, evidence, terrain, bias, position_m[None])
    else:
        explored = explore(evidence, terrain, position_m[None])
    sizes, axes = np.linalg.eigh(smear_m2)
    for size, axis in zip(sizes, axes.T, strict=True):
        explored = mix_shifted(explored, np.sqrt(max(size, 0.0)) * axis, terrain)
    refined = summarize(
        explored.centres_m, 2 * explored.half_m, explored.log_likelihood, fix.dropped_probability or 0.0, terrain
    )
    return replace(refined, search=fix.search, horizon_error_rad=explored.horizon_bias_rad)


def horizon_slopes(terrain: Terrain, position_m: Array, azimuth_rad: Array) -> Array:
    """Change of a terrain's horizon (n, 2) [rad/m] with the position (2,), east and north, at the azimuths (n,)."""
    steps = STEP_M * np.array([[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]])
    horizon = terrain.horizon_rad((position_m + steps)[:, None], azimuth_rad)
    return np.stack([horizon[0] - horizon[1], horizon[2] - horizon[3]], axis=1) / (2 * STEP_M)
