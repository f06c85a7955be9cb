"""The posterior of position, shared errors and obstacles together, sampled about the places that a search leaves."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from startrack.core.types import Array, Evidence, NotLocated
from startrack.localization.horizon_bias import NEARBY_M
from startrack.localization.hypothesis import WIDER, Hypothesis, sample_gross_errors, sample_hypothesis, solve_model
from startrack.localization.importance_sampling import FEW, ROUNDS, BoxDistribution, Gaussian, effective_points, moments
from startrack.localization.search import NATS, Explored
from startrack.localization.shared_errors import SharedErrors
from startrack.localization.skyline_model import SkylineModel
from startrack.terrain import Terrain

REACH_M = 300.0  # of a group of boxes about its best one, with one neighbourhood
NEIGHBOURHOOD_SIGMAS = 16.0  # of a neighbourhood in which the posterior is sampled
MOST_GROUPS, MOST_MODES = 6, 4  # groups of boxes, and modes of a group
MOST_BOXES = 160  # of a group, that the chain is computed at; and the points drawn from them
FIRST_ROUNDS = ROUNDS[:2]  # that show whether a group of boxes is likely, and how wide the posterior is
APART_BOXES = 3.0  # between two modes that sampling begins with


def sample_posterior(explored: Explored, rows: Evidence, terrain: Terrain) -> list[Hypothesis]:
    """Hypotheses with their weighted points, the heaviest first.

    Raises NotLocated (outside_search_area) where no box is left.
    """
    groups = _group_boxes(explored, 4.0 * REACH_M if terrain.axisymmetric else REACH_M)
    if not groups:
        raise NotLocated("no position in the search area is possible: widen [search] radius_m in the terrain file?")
    errors = SharedErrors.of(terrain, rows.clock)
    references_m = np.array([centres_m[0] for centres_m, _ in groups])
    found: list[Hypothesis] = []
    for number, (centres_m, reach_m) in enumerate(groups):
        half_m = max(reach_m, NEARBY_M)
        model = SkylineModel(terrain, rows, centres_m[0], half_m, errors, image_errors=rows.image_errors)
        start = _start(model, centres_m, explored.half_m)
        if start is None:
            continue
        best = max((one.found.log_evidence for one in found), default=-np.inf)
        plain = _sample_group(model, start, references_m, number, best)
        found.append(plain)
        if plain.found.log_evidence >= best - NATS:
            found.extend(sample_gross_errors(plain, references_m))
    if not found:
        raise NotLocated("no position in the search area is allowed", reason="outside_search_area")
    found.sort(key=lambda one: -one.found.log_evidence)
    if found[0].found.effective < FEW:
        found[0] = sample_hypothesis(found[0].model, references_m, [_moments_of(found[0])])
    return found


def _sample_group(model: SkylineModel, start: Start, references_m: Array, number: int, best: float) -> Hypothesis:
    """The plain hypothesis of a group of boxes, with the reference `number` of all (g, 2), which may move.

    A further group is left at its first rounds where it is less likely than the `best` by NATS. On a height map
    the last rounds are in a neighbourhood as small as the posterior, because horizons are interpolated in it.
    """
    rounds = FIRST_ROUNDS if model.rows.is_first_look else ROUNDS
    if number == 0 and model.terrain.axisymmetric:
        return sample_hypothesis(model, references_m, start.modes, first=[start.boxes], rounds=rounds)
    plain = sample_hypothesis(model, references_m, start.modes, first=[start.boxes], rounds=FIRST_ROUNDS)
    if plain.found.log_evidence < best - NATS:
        return plain
    mean, covariance = _moments_of(plain)
    reach_m = max(NEIGHBOURHOOD_SIGMAS * float(np.sqrt(np.linalg.eigvalsh(covariance[:2, :2])[1])), NEARBY_M)
    if model.terrain.axisymmetric or reach_m > 0.5 * model.half_m:
        return sample_hypothesis(model, references_m, start.modes, first=[start.boxes], rounds=rounds)
    references_m[number] = mean[:2]
    closer = SkylineModel(
        model.terrain, model.rows, mean[:2], reach_m, model.errors, image_errors=model.image_errors
    )  # fmt: skip
    return sample_hypothesis(closer, references_m, [_begin_in(closer, mean, covariance)], rounds=rounds)


def _group_boxes(explored: Explored, reach_m: float) -> list[tuple[Array, float]]:
    """Centres (n, 2) of boxes, the best first, and their reach [m] from it, in groups that one neighbourhood serves."""
    order = np.argsort(-explored.log_likelihood, kind="stable")
    centres = explored.centres_m[order]
    groups: list[tuple[Array, float]] = []
    reach_m = max(reach_m, 20.0 * explored.half_m)
    while len(centres) and len(groups) < MOST_GROUPS:
        away = np.abs(centres - centres[0]).max(axis=1)
        near = away <= reach_m
        groups.append((centres[near], float(away[near].max()) + 2 * explored.half_m))
        centres = centres[~near]
    return groups


@dataclass(frozen=True, eq=False)
class Start:
    """Where the sampling of a group begins: likely modes, and its boxes."""

    modes: list[Gaussian]
    boxes: BoxDistribution


def _start(model: SkylineModel, centres_m: Array, half_m: float) -> Start | None:
    """The best boxes by the chain, each with the errors that suit it; None where none is allowed."""
    if len(centres_m) > MOST_BOXES:
        step = len(centres_m) / MOST_BOXES
        centres_m, half_m = centres_m[(np.arange(MOST_BOXES) * step).astype(int)], half_m * np.sqrt(step)
    linear, covariance, weight = solve_model(model)
    model.__dict__["clear"] = weight
    boxes = model.with_likely_errors(centres_m, weight)
    tried = np.vstack([boxes, linear])
    value = model.log_likelihood(tried) + model.basis.log_prior(tried[:, 2:])
    value = np.where(np.asarray(model.terrain.allowed(tried[:, :2])), value, -np.inf)
    if not np.isfinite(value[:-1]).any():
        return None
    model.states(tried[int(np.argmax(value))])
    value, by_linear = value[:-1], value[-1]
    chosen: list[Array] = []
    for i in np.argsort(-value):
        if value[i] < value.max() - NATS or len(chosen) == MOST_MODES:
            break
        if all(np.abs(boxes[i, :2] - one[:2]).max() > APART_BOXES * 2 * half_m for one in chosen):
            chosen.append(boxes[i])
    flat = value - value.max()
    while effective_points(flat) < min(6.0, 0.5 * np.isfinite(flat).sum()):
        flat = 0.6 * flat
    share = np.exp(flat) / np.exp(flat).sum()
    spread = moments(boxes[:, :2], share)[1] + half_m**2 / 3 * np.eye(2)
    if len(chosen) > 1:
        spread = np.minimum(np.trace(spread) / 2, (APART_BOXES * half_m) ** 2) * np.eye(2)
    whole = covariance.copy()
    whole[:2, :2] += spread
    left = covariance[2:, 2:] - covariance[2:, :2] @ np.linalg.solve(covariance[:2, :2], covariance[:2, 2:])
    drawn = BoxDistribution(boxes, half_m, share, np.asarray(np.linalg.cholesky(left)), MOST_BOXES)
    modes = [(one, whole) for one in chosen]
    if by_linear > value.max():
        modes = [(linear, WIDER * covariance), *modes[: MOST_MODES - 1]]
    return Start(modes, drawn)


def _begin_in(model: SkylineModel, mean: Array, covariance: Array) -> Gaussian:
    """The position of a mode with the errors that suit it in a `model` whose directions of errors may be others."""
    _, whole, weight = solve_model(model)
    model.__dict__["clear"] = weight
    wider = whole.copy()
    wider[:2, :2] = covariance[:2, :2]
    wider[:2, 2:] = wider[2:, :2] = 0.0
    return model.with_likely_errors(mean[None, :2], weight)[0], wider


def _moments_of(one: Hypothesis) -> Gaussian:
    """Mean and covariance of a hypothesis by its points, wide enough where few count."""
    mean, covariance = moments(one.found.points, one.found.share)
    _, linear, _ = solve_model(one.model)
    return mean, covariance + 0.05 * linear
