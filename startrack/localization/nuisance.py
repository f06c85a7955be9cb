"""Errors that all rows share, estimated with the position and marginalised: the horizon's bias, the terrain's shape."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from startrack.localization.explored import Explored, log_sum
from startrack.localization.initial_guess import beam_search, is_likely_true, widening_guesses
from startrack.localization.likelihood import PositionLikelihood
from startrack.terrain import Terrain
from startrack.types import Array, Evidence, NotLocated

Explore = Callable[[Evidence, Terrain], Explored]
ExploreFrom = Callable[[Evidence, Terrain, Array | None], Explored]

PRIOR_SIGMAS = 3.0  # half width of the first grid
BIAS_NEARBY_M = 80.0  # horizons are prepared that far about a position; a position farther off is prepared anew
BIAS_CLOSE_M = 15.0  # where the bias found makes the fit worse than none by more than the next number
BIAS_LOSS_NATS = 1.0
BIAS_STEPS_M = (16.0, 4.0, 0.5)  # first and later first steps of a climb, and the last
BIAS_GRID = (7, 5.0, 0.75, 6)  # nodes; nats kept; shrinking that is enough; rounds
MIXED_SIGMAS, MIXED_NATS = np.linspace(-2.5, 2.5, 11), 10.0  # boxes less likely by more hold 5e-5 of the mass
SHAPE_NEARBY_M, SHAPE_STEPS_M = 600.0, (64.0, 2.0)
SHAPE_LLR = 0.3  # |llr| of rows that decide on shapes
SHAPE_GRID = (5, 8.0, 0.8, 8)
STEEPNESS_LEEWAY = 0.35  # d tan H / tan H = dH / (sin H cos H), at rims up to 20 degrees


@dataclass(frozen=True)
class HorizonBias:
    """How much higher the true horizon stands than the map's, as the stars see it."""

    bias_rad: float
    sigma_rad: float
    position_m: Array  # (2,) of the camera at that bias
    drift_m_per_rad: Array  # (2,) how the position moves with the bias
    log_likelihood: float  # of the best bias and position, without the prior of the bias


@dataclass(frozen=True)
class ShapeFit:
    """Shape of the terrain as the stars see it: how much steeper and how much larger it is, relative."""

    shape: Array  # (2,) for `Terrain.reshaped`
    covariance: Array  # (2, 2)


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
    lowered = lower_evidence(likelihood.evidence, found.bias_rad)
    fit = PositionLikelihood.from_evidence(lowered, likelihood.terrain).exact_scores(found.position_m[None])
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


def marginalize_horizon_bias(
    explore: ExploreFrom, evidence: Evidence, terrain: Terrain, bias: HorizonBias, others_m: Array
) -> Explored:
    """The position's posterior over all biases: explored at the likeliest one, and smeared along the drift.

    Exact where position and bias depend on each other linearly over the bias's own small uncertainty. `others_m` (n, 2)
    are further positions that the search begins with.
    """
    found = explore(lower_evidence(evidence, bias.bias_rad), terrain, np.vstack([bias.position_m, others_m]))
    found = found._replace(horizon_bias_rad=bias.bias_rad)
    return mix_shifted(found, bias.sigma_rad * bias.drift_m_per_rad, terrain)


def mix_shifted(found: Explored, sigma_m: Array, terrain: Terrain) -> Explored:
    """The posterior smeared by a normal shift of one standard deviation `sigma_m` (2,) along its direction."""
    keep = found.log_likelihood > np.max(found.log_likelihood, initial=-np.inf) - MIXED_NATS
    steps = MIXED_SIGMAS[:, None, None] * sigma_m
    if not keep.any() or np.abs(steps).max() < 0.5 * found.half_m:
        return found
    share = np.exp(-0.5 * MIXED_SIGMAS**2)
    share /= share.sum()
    smeared = (found.centres_m[keep] + steps).reshape(-1, 2)
    weights = (found.log_likelihood[keep] + np.log(share)[:, None]).ravel()
    inside = np.asarray(terrain.allowed(smeared))
    return found._replace(centres_m=smeared[inside], log_likelihood=weights[inside])


def marginalize_shape(explore: Explore, evidence: Evidence, terrain: Terrain) -> tuple[Explored, ShapeFit]:
    """The position's posterior over the shapes of a terrain, each with its share of the probability.

    Grids of shapes, each with its best position, zoom in on those that matter; over the last grid the exact posteriors
    are mixed. A shape with which no position explains the evidence has no share. Raises NotLocated where all are such.
    """
    nodes, parts = _explore_shapes(explore, evidence, terrain, _shapes_that_matter(evidence, terrain))
    log_prior = np.array([terrain.log_prior(node) for node in nodes])
    logs = [p.log_likelihood + prior + np.log(4 * p.half_m**2) for p, prior in zip(parts, log_prior, strict=True)]
    log_mass = np.array([log_sum(log) for log in logs])
    share = np.exp(log_mass - log_mass.max())
    share /= share.sum()
    mean = share @ nodes
    half = max(p.half_m for p in parts)
    dropped = log_sum(np.array([p.log_dropped + prior for p, prior in zip(parts, log_prior, strict=True)]))
    search = "beam" if any(p.search == "beam" for p in parts) else "proven"
    density = np.concatenate(logs) - np.log(4 * half**2)
    bias = float(share @ [p.horizon_bias_rad for p in parts])
    centres, shape = np.concatenate([p.centres_m for p in parts]), (float(mean[0]), float(mean[1]))
    mixed = Explored(centres, half, density, dropped, search, bias, shape)
    return mixed, ShapeFit(mean, np.einsum("n,ni,nj->ij", share, nodes - mean, nodes - mean))


def _explore_shapes(
    explore: Explore, evidence: Evidence, terrain: Terrain, nodes: Array
) -> tuple[Array, list[Explored]]:
    """The shapes (n, 2) that explain the evidence somewhere, and their posteriors."""
    kept, parts, refused = [], [], None
    for node in nodes:
        try:
            parts.append(explore(evidence, terrain.reshaped(node)))
            kept.append(node)
        except NotLocated as refusal:
            if refusal.reason == "insufficient_geometry":  # its share is not known
                raise
            refused = refusal
    if refused is not None and not parts:
        raise refused
    return np.array(kept), parts


def _shapes_that_matter(evidence: Evidence, terrain: Terrain) -> Array:
    """Nodes (n, 2) of an even grid that covers the joint posterior of shape and position."""
    half = PRIOR_SIGMAS * np.array(terrain.shape_sigma)
    guess = beam_search(PositionLikelihood.from_evidence(evidence, terrain))
    position = guess.points_m[0] if len(guess.points_m) else np.zeros(2)
    # Without floors the likelihood falls all the way to its top, so that a climb is not caught on the way.
    plain = PositionLikelihood.from_evidence(evidence.take(np.abs(evidence.llr) > SHAPE_LLR), terrain, epsilon=0.0)
    local = plain.near(position, SHAPE_NEARBY_M, STEEPNESS_LEEWAY * float(half.sum()))

    def fits(nodes: Array) -> Array:
        nonlocal position
        found = [local.with_terrain(terrain.reshaped(node)).climb(position, *SHAPE_STEPS_M) for node in nodes]
        scores = np.array([fit + terrain.log_prior(node) for (_, fit), node in zip(found, nodes, strict=True)])
        position = found[int(np.argmax(scores))][0]
        return scores

    return zoom_grid(fits, half, *SHAPE_GRID)[0]


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
