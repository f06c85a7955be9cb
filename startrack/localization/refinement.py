"""A fix refined by the light of the sky at the skyline near it: stars and sky in one posterior on a small area."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from startrack.localization.explored import Explored
from startrack.localization.initial_guess import Guess
from startrack.localization.likelihood import PositionLikelihood
from startrack.localization.local_posterior import local_posterior
from startrack.localization.nuisance import mix_shifted
from startrack.localization.position_prior import weigh_by_prior
from startrack.localization.summary import summarize
from startrack.terrain import Terrain
from startrack.types import Array, Evidence, Fix

NODES = 5  # traced horizons along each side of the ellipse's square
STEP_M = 1.0  # at which the horizon's change with the position is taken
REACH_SIGMAS = 5.5  # of the expected posterior, to the ends of the ellipse that is scored
BOX_SIGMAS = 1.0  # side of the boxes, of the shorter axis
MIN_BOX_SIGMAS = 0.5  # of the posterior, in a box's side: smaller boxes are needed for a narrower one
MOST_BOXES = 20_000  # of an ellipse; a longer one is scored by the general method
RIM_SIGMAS, RIM_MASS = 4.5, 1e-3  # more of the probability out there: the expected posterior is too small


def refine_fix(
    evidence: Evidence,
    fix: Fix,
    terrain: Terrain,
    position_m: Array,
    covariance_m2: Array,
    smear_m2: Array,
    horizon_error_rad: float,
    spread: Callable[[Explored], Explored] = lambda found: found,
) -> Fix:
    """The `fix` replaced by the posterior from `evidence` near a good position on a `terrain`.

    Args:
        evidence: rows near the skyline of the position, of stars and of the sky's light.
        fix: by the stars alone, whose search it keeps.
        terrain: with the evidence's enu.
        position_m: (2,) close to the best one.
        covariance_m2: (2, 2) about that of the posterior by the rows.
        smear_m2: (2, 2) covariance of the position from errors that the rows share.
        horizon_error_rad: by which the rows were put lower, for the common error of the map.
        spread: a posterior to the one over a further error that the rows share.

    Raises NotLocated as `summarize` does.
    """

    explored = _explore_near(PositionLikelihood.from_evidence(evidence, terrain), position_m, covariance_m2)
    if evidence.near is not None:
        explored = weigh_by_prior(explored, evidence.near)
    sizes, axes = np.linalg.eigh(smear_m2)
    for size, axis in zip(sizes, axes.T, strict=True):
        explored = mix_shifted(explored, np.sqrt(max(size, 0.0)) * axis, terrain)
    explored = spread(explored)
    refined = summarize(
        explored.centres_m, 2 * explored.half_m, explored.log_likelihood, fix.dropped_probability or 0.0, terrain
    )
    return replace(
        refined, search=fix.search, horizon_error_rad=horizon_error_rad, clock=explored.clock
    )  # fmt: skip


def _explore_near(likelihood: PositionLikelihood, position_m: Array, covariance_m2: Array) -> Explored:
    """The posterior in the ellipse where it is expected; where it does not fit in there, on squares of its own size."""
    half = max(0.5 * BOX_SIGMAS * float(np.sqrt(np.linalg.eigvalsh(covariance_m2)[0])), likelihood.terrain.finest_m)
    reach = REACH_SIGMAS * np.sqrt(np.diag(covariance_m2))
    counts = np.ceil(reach / (2 * half)).astype(int)
    if np.prod(2.0 * counts + 1) <= MOST_BOXES:
        lines = [2 * half * np.arange(-count, count + 1) for count in counts]
        offsets = np.stack(np.meshgrid(*lines), axis=-1).reshape(-1, 2)
        sigmas = np.sqrt(np.einsum("ni,ij,nj->n", offsets, np.linalg.inv(covariance_m2), offsets))
        centres = position_m + offsets[sigmas < REACH_SIGMAS]
        allowed = np.asarray(likelihood.terrain.allowed(centres))
        score = likelihood.near(position_m, float(reach.max()) + 2 * half, across=NODES).scores(centres[allowed])
        weight = np.exp(score - score.max(initial=-np.inf))
        rim = sigmas[sigmas < REACH_SIGMAS][allowed] > RIM_SIGMAS
        if _is_resolved(centres[allowed], weight, half) and weight[rim].sum() < RIM_MASS * weight.sum():
            return Explored(centres[allowed], half, score, -np.inf, "beam")
    return local_posterior(likelihood, Guess(position_m[None], np.zeros(1)), -np.inf, float(reach.max()))


def _is_resolved(centres_m: Array, weight: Array, half_m: float) -> bool:
    """Whether the probability spreads over boxes in every direction, by half their side at least."""
    if not weight.sum() > 0.0:
        return False
    off = centres_m - np.average(centres_m, axis=0, weights=weight)
    spread = (off * weight[:, None]).T @ off / weight.sum()
    return bool(np.linalg.eigvalsh(spread)[0] > np.square(MIN_BOX_SIGMAS * 2 * half_m))


def horizon_slopes(terrain: Terrain, position_m: Array, azimuth_rad: Array) -> Array:
    """Change of a terrain's horizon (n, 2) [rad/m] with the position (2,), east and north, at the azimuths (n,)."""
    steps = STEP_M * np.array([[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]])
    horizon = terrain.horizon_rad((position_m + steps)[:, None], azimuth_rad)
    return np.stack([horizon[0] - horizon[1], horizon[2] - horizon[3]], axis=1) / (2 * STEP_M)
