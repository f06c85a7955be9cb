"""The error of the horizon that all azimuths share, at which the area is searched."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from startrack.localization.explored import Explored
from startrack.localization.initial_guess import is_likely_true, widening_guesses
from startrack.localization.likelihood import PositionLikelihood
from startrack.types import Array, Evidence, NotLocated

ExploreFrom = Callable[[PositionLikelihood, Array | None], Explored]

PRIOR_SIGMAS = 3.0  # half width of the first grid
BIAS_NEARBY_M = 80.0  # horizons are prepared that far about a position; a position farther off is prepared anew
BIAS_CLOSE_M = 15.0  # where the bias found makes the fit worse than none by more than the next number
BIAS_LOSS_NATS = 1.0
BIAS_STEPS_M = (16.0, 4.0, 0.5)  # first and later first steps of a climb, and the last
BIAS_GRID = (7, 5.0, 0.75, 6)  # nodes; nats kept; shrinking that is enough; rounds


@dataclass(frozen=True)
class HorizonBias:
    """How much higher the true horizon stands than the map's, as the stars see it."""

    bias_rad: float
    sigma_rad: float
    position_m: Array  # (2,) of the camera at that bias
    drift_m_per_rad: Array  # (2,) how the position moves with the bias
    log_likelihood: float  # of the best bias and position, without the prior of the bias


def lower_evidence(evidence: Evidence, bias_rad: float) -> Evidence:
    """The rows as they stand above the map's horizon where the true one is `bias_rad` higher."""
    return replace(evidence, elevation_rad=evidence.elevation_rad - bias_rad) if bias_rad else evidence


def find_horizon_bias(likelihood: PositionLikelihood) -> tuple[HorizonBias, Array]:
    """The likeliest bias at the best position of a guess, and the other positions (n, 2) of the guess.

    A guess is judged with the bias that suits it: without the bias the true position explains the stars badly, and
    wider beams would follow that find nothing better. Raises NotLocated (outside_search_area).
    """
    bias, others_m = None, np.zeros((0, 2))
    for guess in widening_guesses(likelihood):
        if len(guess.points_m):
            bias, others_m = estimate_horizon_bias(likelihood, guess.points_m[0]), guess.points_m[1:]
            if is_likely_true(max(bias.log_likelihood, guess.best), likelihood):
                break
    if bias is None:
        raise NotLocated("no position in the search area is allowed", reason="outside_search_area")
    return bias, others_m


def estimate_horizon_bias(likelihood: PositionLikelihood, position_m: Array) -> HorizonBias:
    """The bias that fits best with its prior `Terrain.common_sigma_rad`, the position free near the one given (2,).

    Horizons are interpolated between traced ones. Beside near crests that can show a wrong bias: where the position
    given fits better without it, horizons are traced closer to that.
    """
    found = _bias_nearby(likelihood, position_m, BIAS_NEARBY_M, PRIOR_SIGMAS * likelihood.terrain.common_sigma_rad)
    if float(likelihood.exact_scores(position_m[None])[0]) > _exact_fit(likelihood, found) + BIAS_LOSS_NATS:
        return _bias_nearby(likelihood, position_m, BIAS_CLOSE_M, abs(found.bias_rad) + PRIOR_SIGMAS * found.sigma_rad)
    return found


def _exact_fit(likelihood: PositionLikelihood, found: HorizonBias) -> float:
    """Log-likelihood of a bias and its position with traced horizons, and with the prior of the bias [nats]."""
    sectors = likelihood.sectors
    lowered = PositionLikelihood.from_evidence(
        lower_evidence(likelihood.evidence, found.bias_rad),
        likelihood.terrain,
        2 * np.pi / sectors.count,
        sectors.epsilon,
    )
    fit = lowered.exact_scores(found.position_m[None])
    return float(fit[0]) - 0.5 * (found.bias_rad / likelihood.terrain.common_sigma_rad) ** 2


def _bias_nearby(likelihood: PositionLikelihood, position_m: Array, nearby_m: float, most_rad: float) -> HorizonBias:
    """The best bias of at most `most_rad`; horizons are prepared within `nearby_m` of a position."""
    prior = likelihood.terrain.common_sigma_rad
    first_step, next_step, last_step = BIAS_STEPS_M
    centre, step = position_m, min(first_step, 0.5 * nearby_m)
    local = likelihood.near(centre, nearby_m, most_rad)
    positions_m = np.zeros((0, 2))

    def fits(nodes: Array) -> Array:
        nonlocal centre, step, local, position_m, positions_m
        if np.abs(position_m - centre).max() > nearby_m:
            centre = position_m
            local = likelihood.near(centre, nearby_m, most_rad)
        e = local.evidence.elevation_rad
        found = [local.climb(position_m, step, last_step, e - bias) for bias in nodes[:, 0]]
        positions_m = np.array([point for point, _ in found])
        scores = np.array([fit for _, fit in found]) - 0.5 * (nodes[:, 0] / prior) ** 2
        position_m, step = positions_m[int(np.argmax(scores))], next_step
        return scores

    nodes, scores = zoom_grid(fits, np.array([most_rad]), *BIAS_GRID)
    biases = nodes[:, 0]
    weight = np.exp(scores - scores.max())
    weight /= weight.sum()
    bias = float(weight @ biases)
    off = biases - bias
    variance = float(weight @ off**2) + (biases[1] - biases[0]) ** 2 / 12
    mean_m = weight @ positions_m
    drift = (weight * off) @ (positions_m - mean_m) / variance
    best = float(np.max(scores + 0.5 * (biases / prior) ** 2))
    return HorizonBias(bias, float(np.sqrt(variance)), mean_m, drift, best)


def explore_biased(explore: ExploreFrom, likelihood: PositionLikelihood) -> Explored:
    """The boxes that may matter where the terrain's horizon may err at all azimuths together.

    They are searched at the likeliest error. `explore` searches by a likelihood, from good positions (n, 2). Raises
    NotLocated (outside_search_area).
    """
    terrain = likelihood.terrain
    if terrain.common_sigma_rad == 0.0:
        return explore(likelihood, None)
    bias, others_m = find_horizon_bias(likelihood)
    sectors = likelihood.sectors
    lowered = PositionLikelihood.from_evidence(
        lower_evidence(likelihood.evidence, bias.bias_rad), terrain, 2 * np.pi / sectors.count, sectors.epsilon
    )
    return explore(lowered, np.vstack([bias.position_m, others_m]))._replace(horizon_bias_rad=bias.bias_rad)


def zoom_grid(
    fits: Callable[[Array], Array], half: Array, across: int, kept_nats: float, enough: float, rounds: int
) -> tuple[Array, Array]:
    """Nodes (n, d) of the last of ever smaller even grids about the best nodes, and their fits (n,) [nats].

    The first grid reaches `half` (d,) to each side of zero; axes of no width have one node. Grids shrink to the nodes
    within `kept_nats` of the best, until one shrinks by less than to the part `enough`.
    """
    middle = np.zeros(len(half))
    for _ in range(rounds):
        lines = [np.linspace(-1.0, 1.0, across) if width > 0 else np.zeros(1) for width in half]
        nodes = middle + np.stack([axis.ravel() for axis in np.meshgrid(*lines)], axis=1) * half
        scores = fits(nodes)
        kept = nodes[scores > scores.max() - kept_nats]
        step = 2 * half / (across - 1)
        low = np.maximum(kept.min(axis=0) - step, middle - half)
        high = np.minimum(kept.max(axis=0) + step, middle + half)
        shrunk = (high - low)[half > 0] / (2 * half[half > 0])
        if shrunk.min() > enough:
            break
        middle, half = (low + high) / 2, (high - low) / 2
    return nodes, scores
