"""The posterior of position, shared errors and obstacles together, sampled about the places that a search leaves."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from startrack.core.types import Array, Evidence, Explored, NotLocated
from startrack.localization.hypothesis import (
    WIDER,
    Cell,
    Hypothesis,
    heaviest_first,
    sample_gross_errors,
    sample_hypothesis,
)
from startrack.localization.importance_sampling import (
    ENOUGH,
    FEW,
    ROUNDS,
    BoxDistribution,
    Gaussian,
    moments,
    temper_weights,
)
from startrack.localization.likelihood.shared_errors import SharedErrors
from startrack.localization.likelihood.skyline_model import SkylineModel
from startrack.localization.likelihood.smooth_skyline import with_own_edge
from startrack.localization.search import FIT_M, NATS, choose_apart
from startrack.terrain import Terrain

REACH_M = 300.0  # of a group of boxes about its best one, with one neighbourhood
NEIGHBOURHOOD_SIGMAS, SMALLEST_M = 16.0, 1.0  # from the middle to the edge of a neighbourhood that is sampled
MOST_GROUPS, MOST_MODES = 6, 4  # groups of boxes, and modes of a group
MOST_BOXES = 160  # of a group, that the chain is computed at; and the points drawn from them
FIRST_ROUNDS = ROUNDS[:4]  # that show whether a group of boxes is likely, and how wide the posterior is
APART_BOXES = 3.0  # between two modes that sampling begins with
NO_OTHERS = np.zeros((0, 2))  # positions of other parts of the posterior
FEW_BOXES = 6.0  # that count at least, of the distribution of boxes


def sample_posterior(
    rows: Evidence, explored: Explored, terrain: Terrain, others_m: Array = NO_OTHERS
) -> list[Hypothesis]:
    """Hypotheses with their weighted points, the heaviest first; none nearer to a position of `others_m` (n, 2).

    Each group of boxes has the positions that are nearest to where its sampling starts.
    Raises NotLocated (outside_search_area) where no box is left.
    """
    groups = _group_boxes(explored, 4.0 * REACH_M if terrain.axisymmetric else REACH_M)
    if not groups:
        raise NotLocated(
            "no position in the search area is possible: widen [search] radius_m in the terrain file?",
            reason="outside_search_area",
        )
    errors = SharedErrors.of(terrain, rows.clock)
    begun = [
        _begin_group(terrain, rows, errors, centres_m, max(reach_m, FIT_M), explored.half_m)
        for centres_m, reach_m in groups
    ]
    starts = [one for one in begun if one is not None]
    if not starts:
        raise NotLocated("no position in the search area is allowed", reason="outside_search_area")
    found: list[tuple[Cell, Hypothesis]] = []
    for start, cell in zip(
        starts, Cell.of_each([one.model.around.reference_m for one in starts], others_m), strict=True
    ):
        best = max((one.log_evidence for _, one in found), default=-np.inf)
        plain = _sample_group(start, cell, best)
        own = [plain]
        if plain.log_evidence >= best - NATS:
            own += sample_gross_errors(plain, cell)
            own += _sample_own_edge(plain, start.model.around.half_m, explored, cell)
        found += [(cell, one) for one in own]
    best = max(one.log_evidence for _, one in found)
    return heaviest_first([_sample_again(one, cell, best) for cell, one in found])


def _sample_again(one: Hypothesis, cell: Cell, best: float) -> Hypothesis:
    """The hypothesis `one`, sampled again where few points count and it may matter beside the `best` log-evidence."""
    if one.sampled.effective >= FEW or one.log_evidence <= best - NATS:
        return one
    return sample_hypothesis(one.model, cell, [_moments_of(one)])


def _begin_group(
    terrain: Terrain, rows: Evidence, errors: SharedErrors, centres_m: Array, reach_m: float, half_m: float
) -> Start | None:
    """Start of the sampling of boxes (n, 2) that lie within `reach_m` of the first; None where none is allowed.

    In a round crater, where a model serves any distance, the reference is near the best point: rows of a sector stand
    above the skyline that has the shape of the reference's. On a height map the last rounds have a reference of their
    own.
    """
    at_m = centres_m[0]
    for _ in range(2):
        model = SkylineModel.of(terrain, rows, at_m, reach_m, errors, rows.image_errors)
        start = Start.among_boxes(model, centres_m, half_m)
        if start is None or not terrain.axisymmetric or np.abs(start.best_m - at_m).max() < FIT_M:
            break
        at_m = start.best_m
    return start


def _sample_own_edge(plain: Hypothesis, half_m: float, explored: Explored, cell: Cell) -> list[Hypothesis]:
    """Hypothesis that the sky's light has an edge of its own, within `half_m` of the plain one's reference; or none.

    Its points are drawn from all boxes that the search has left, as far as they are in the `cell`.
    """
    model = with_own_edge(plain, half_m)
    start = None if model is None else Start.among_boxes(model, explored.centres_m, explored.half_m)
    if start is None:
        return []
    found = sample_hypothesis(start.model, cell, start.modes, first=[start.boxes], enough=FEW)
    if found.log_evidence > plain.log_evidence:
        found = sample_hypothesis(found.model, cell, [_moments_of(found)])
    return [found]


def _group_boxes(explored: Explored, reach_m: float) -> list[tuple[Array, float]]:
    """Centres (n, 2) of boxes, the best first, and their reach [m] from it, in groups that one neighbourhood serves."""
    order = np.argsort(-explored.log_weight, kind="stable")
    centres = explored.centres_m[order]
    groups: list[tuple[Array, float]] = []
    reach_m = max(reach_m, 20.0 * explored.half_m)
    while len(centres) and len(groups) < MOST_GROUPS:
        away = np.abs(centres - centres[0]).max(axis=1)
        is_own = away <= reach_m
        groups.append((centres[is_own], float(away[is_own].max()) + 2 * explored.half_m))
        centres = centres[~is_own]
    return groups


@dataclass(frozen=True, eq=False)
class Start:
    """Start of the sampling of a group of boxes: its model, likely modes, and the boxes."""

    model: SkylineModel
    modes: list[Gaussian]
    boxes: BoxDistribution
    best_m: Array  # (2,) the likeliest position

    @classmethod
    def among_boxes(cls, model: SkylineModel, centres_m: Array, half_m: float) -> Start | None:
        """Start at the best of boxes (n, 2) by the chain, with errors that suit each; None where none is allowed."""
        if len(centres_m) > MOST_BOXES:
            step = len(centres_m) / MOST_BOXES
            centres_m, half_m = centres_m[(np.arange(MOST_BOXES) * step).astype(int)], half_m * np.sqrt(step)
        linear, covariance, weight = model.solve_linear()
        model = replace(model, sector_weight=weight)
        boxes = model.with_likely_errors(centres_m, weight)
        tried = np.vstack([boxes, linear])
        value = model.log_likelihood(tried) + model.basis.log_prior(tried[:, 2:])
        value = np.where(np.asarray(model.terrain.allowed(tried[:, :2])), value, -np.inf)
        of_boxes = value[:-1]
        if not np.isfinite(of_boxes).any():
            return None
        chosen = choose_apart(boxes[:, :2], of_boxes, APART_BOXES * 2 * half_m, NATS, MOST_MODES)
        share = temper_weights(of_boxes, FEW_BOXES)
        spread = moments(boxes[:, :2], share)[1] + half_m**2 / 3 * np.eye(2)
        if len(chosen) > 1:
            spread = np.minimum(np.trace(spread) / 2, (APART_BOXES * half_m) ** 2) * np.eye(2)
        wide = covariance.copy()
        wide[:2, :2] += spread
        modes = [(boxes[at], wide) for at in chosen]
        if value[-1] > of_boxes.max():
            modes = [(linear, WIDER * covariance), *modes[: MOST_MODES - 1]]
        of_errors = covariance[2:, 2:] - covariance[2:, :2] @ np.linalg.solve(covariance[:2, :2], covariance[:2, 2:])
        drawn = BoxDistribution(boxes, half_m, share, np.asarray(np.linalg.cholesky(of_errors)), MOST_BOXES)
        best = tried[int(np.argmax(value))]
        return cls(model.with_closing(model.states(best)), modes, drawn, best[:2])


def _sample_group(start: Start, cell: Cell, best: float) -> Hypothesis:
    """The plain hypothesis of a group of boxes, in its `cell`.

    A group is left at its first rounds where it is less likely than the `best` one before it by NATS. On a height map
    the last rounds are in a neighbourhood as small as the posterior, because horizons are interpolated in it.
    """
    model = start.model
    enough = FEW if model.seen.rows.is_first_look else ENOUGH
    sample_at_start = partial(sample_hypothesis, model, cell, start.modes, first=[start.boxes], enough=enough)
    if best == -np.inf and model.terrain.axisymmetric:
        return sample_at_start()
    plain = sample_at_start(rounds=FIRST_ROUNDS)
    if plain.log_evidence < best - NATS:
        return plain
    mean, covariance = _moments_of(plain)
    reach_m = max(NEIGHBOURHOOD_SIGMAS * float(np.sqrt(np.linalg.eigvalsh(covariance[:2, :2])[1])), SMALLEST_M)
    if model.terrain.axisymmetric or reach_m > 0.5 * model.around.half_m:
        return sample_at_start()
    closer, mode = _begin_closer(model, mean, covariance, reach_m)
    return sample_hypothesis(closer, cell, [mode], enough=enough)


def _begin_closer(model: SkylineModel, mean: Array, covariance: Array, reach_m: float) -> tuple[SkylineModel, Gaussian]:
    """The model of a closer neighbourhood, whose directions of errors may be others, and the mode there."""
    image = model.seen.image_errors
    closer = SkylineModel.of(model.terrain, model.seen.rows, mean[:2], reach_m, model.errors, image)
    _, whole, weight = closer.solve_linear()
    closer = replace(closer, sector_weight=weight)
    wider = whole.copy()
    wider[:2, :2] = covariance[:2, :2]
    wider[:2, 2:] = wider[2:, :2] = 0.0
    return closer, (closer.with_likely_errors(mean[None, :2], weight)[0], wider)


def _moments_of(one: Hypothesis) -> Gaussian:
    """Mean and covariance of a hypothesis by its points, wide enough where few count."""
    mean, covariance = moments(one.sampled.points, one.sampled.share)
    return mean, covariance + 0.05 * one.model.solve_linear().covariance
