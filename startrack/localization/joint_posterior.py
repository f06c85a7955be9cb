"""The posterior of position, shared errors and obstacles together, sampled about the places that a search leaves."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from startrack.localization.explored import Explored
from startrack.localization.free_skyline import free_log_likelihood
from startrack.localization.importance_sampling import (
    BoxDistribution,
    Gaussian,
    WeightedPoints,
    effective_points,
    moments,
    normal_sequence,
    sample,
)
from startrack.localization.other_times import is_linear, turned_model, turned_models
from startrack.localization.sector_moments import solve_linear
from startrack.localization.shared_errors import SharedErrors
from startrack.localization.skyline_model import SkylineModel
from startrack.terrain import Terrain
from startrack.types import Array, Clock, Evidence, NotLocated

REACH_M = 300.0  # of a group of boxes about its best one, with one neighbourhood
SMALLER = 0.3  # variance of a gross error that is none, beside that by the linear model
HIDDEN_COPIES = 6  # of each point, with values of the errors that the rows do not show
MOST_GROUPS, MOST_BOXES = 6, 160  # groups of boxes; boxes of a group that the chain is computed at
MOST_MODES, MODE_NATS = 4, 14.0  # of a group; less likely ones than the best by more are none
BOX_POINTS = 160  # drawn from the boxes
LINEAR_WIDER = 2.0  # variance about the solution of the linear model with which sampling begins
APART_BOXES = 3.0  # between two modes that sampling begins with
GROSS_ROUNDS = (120, 160, 200)
DOUBTFUL_NATS = 5.0  # by which a map beats a free skyline, below which other times are tried too
TIME_ROUNDS = 6  # in which the rows are turned to the time that a gross error of the clock shows
FEW, MORE_ROUNDS = 60.0, (300, 500, 900)  # effective points of the best hypothesis, below which it is sampled anew


@dataclass(frozen=True, eq=False)
class Hypothesis:
    """Points of the posterior where one fact, or none, has a gross error."""

    model: SkylineModel
    found: WeightedPoints  # the weights include the prior probability of the hypothesis

    @property
    def gross(self) -> str:
        """The fact; "": none."""
        return self.model.gross

    @cached_property
    def copies(self) -> int:
        """Of each point, with other values of the errors that the rows do not show."""
        return HIDDEN_COPIES if self.model.basis.hidden.shape[1] else 1

    @cached_property
    def log_weight(self) -> Array:
        """(n,) of all copies."""
        return np.repeat(self.found.log_weight, self.copies) - np.log(self.copies)

    @cached_property
    def _hidden(self) -> Array:
        """(n, b) coordinates of the errors that the rows do not show."""
        count, b = len(self.found.log_weight) * self.copies, self.model.basis.hidden.shape[1]
        return normal_sequence(b, 0, count)[0][:, :b] if b else np.zeros((count, 0))

    @cached_property
    def values(self) -> Array:
        """(n, k) of the shared errors."""
        return self.model.basis.values(np.repeat(self.found.points[:, 2:], self.copies, axis=0), self._hidden)

    @cached_property
    def unturned_m(self) -> Array:
        """(n, 2) positions before the turn by the clock's error in a round crater."""
        return np.asarray(
            np.repeat(self.found.points[:, :2], self.copies, axis=0) + self._hidden @ self.model.basis.drift_m
        )

    @cached_property
    def positions_m(self) -> Array:
        """(n, 2)."""
        return self.model.errors.turned(self.unturned_m, self.values)

    @property
    def later_s(self) -> float:
        """How much later the true time is than the stated one, in the mean."""
        return float(self.found.share @ self.values[:: self.copies, -1]) + self.model.later_s

    @property
    def suits_map(self) -> bool:
        """Whether the map's skyline explains the rows far better than any other one does, so that no time does."""
        shift, _ = self.model.with_image_errors(self.model.shifts((self.found.share @ self.found.points)[None]))
        free = free_log_likelihood(self.model.profiles, shift[0])
        return free < float(self.model.log_likelihood_of(shift)[0]) - DOUBTFUL_NATS


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
        model = SkylineModel(terrain, rows, centres_m[0], max(reach_m, 40.0), errors, image_errors=rows.image_errors)
        start = _start(model, centres_m, explored.half_m)
        if start is None:
            continue
        plain = _sample(model, references_m, start.modes, first=[start.boxes])
        found.append(plain)
        best = max(one.found.log_evidence for one in found)
        if number == 0 or plain.found.log_evidence > best - MODE_NATS:
            found.extend(_gross_hypotheses(plain, references_m))
    if not found:
        raise NotLocated("no position in the search area is allowed", reason="outside_search_area")
    found.sort(key=lambda one: -one.found.log_evidence)
    if found[0].found.effective < FEW:
        found[0] = _sample(found[0].model, references_m, [_moments_of(found[0])], rounds=MORE_ROUNDS)
    return found


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


def _linear(model: SkylineModel) -> tuple[Array, Array, Array]:
    """Parameters (2 + a,) by the linear model of the sectors, their covariance, and weights (SECTORS,)."""
    k = 2 + len(model.basis)
    mean, prior = np.zeros(k), np.diag(np.r_[np.full(2, model.terrain.reach_m**-2.0), np.ones(k - 2)])
    design = np.vstack([model.position_slopes, model.slopes_rad]).T
    if model.image_errors is not None:
        j = len(model.image_errors.mean)
        design, mean = np.hstack([design, model.image_rise]), np.append(mean, model.image_errors.mean)
        whole = np.zeros((k + j, k + j))
        whole[:k, :k], whole[k:, k:] = prior, np.linalg.inv(model.image_errors.covariance)
        prior = whole
    parameters, covariance, weight = solve_linear(model.moments, design, mean, prior)
    parameters[:2] += model.reference_m
    return parameters[:k], covariance[:k, :k], weight


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
    linear, covariance, weight = _linear(model)
    model.__dict__["clear"] = weight
    boxes = model.with_likely_errors(centres_m, weight)
    tried = np.vstack([boxes, linear])
    value = model.log_likelihood(tried) + model.basis.log_prior(tried[:, 2:])
    value = np.where(np.asarray(model.terrain.allowed(tried[:, :2])), value, -np.inf)
    if not np.isfinite(value).any():
        return None
    model.states(tried[int(np.argmax(value))])
    value, by_linear = value[:-1], value[-1]
    chosen: list[Array] = []
    for i in np.argsort(-value):
        if value[i] < value.max() - MODE_NATS or len(chosen) == MOST_MODES:
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
    drawn = BoxDistribution(boxes, half_m, share, np.asarray(np.linalg.cholesky(left)), BOX_POINTS)
    modes = [(one, whole) for one in chosen]
    if by_linear > value.max():
        modes = [(linear, LINEAR_WIDER * covariance), *modes[: MOST_MODES - 1]]
    return Start(modes, drawn)


def _sample(model: SkylineModel, references_m: Array, modes: Sequence[Gaussian], **how: Any) -> Hypothesis:
    """A hypothesis sampled, as `sample` is told `how`, where its reference is the nearest of all (g, 2)."""
    near, basis = model.rows.near, model.basis
    area = float(np.log(np.pi * model.terrain.reach_m**2))

    def log_density(parameters: Array) -> Array:
        position = parameters[:, :2]
        inside = np.asarray(model.terrain.allowed(position))
        away = np.linalg.norm(position[:, None] - references_m, axis=2)
        inside &= away.min(axis=1) == np.linalg.norm(position - model.reference_m, axis=1)
        value = np.full(len(parameters), -np.inf)
        if inside.any():
            value[inside] = model.log_likelihood(parameters[inside]) + model.log_offset - area
            value[inside] += basis.log_prior(parameters[inside, 2:])
            if near is not None:
                value[inside] += near.log_density(position[inside])
        return value

    return Hypothesis(model, sample(log_density, modes, **how))


def _moments_of(one: Hypothesis) -> Gaussian:
    """Mean and covariance of a hypothesis by its points, wide enough where few count."""
    mean, covariance = moments(one.found.points, one.found.share)
    _, linear, _ = _linear(one.model)
    return mean, covariance + 0.05 * linear


def _gross_hypotheses(plain: Hypothesis, references_m: Array) -> list[Hypothesis]:
    """The hypotheses of one gross error each."""
    model, found = plain.model, []
    for gross in model.errors.facts:
        own = np.array([one.fact == gross for one in model.errors.listed])
        if not model.error_slopes_rad[own].any():  # nothing shows it: the points are the same
            other = model.with_gross(gross)
            less = other.basis.log_probability - model.basis.log_probability
            found.append(Hypothesis(other, replace(plain.found, log_weight=plain.found.log_weight + less)))
            continue
        other = model.with_gross(gross)
        clock = _gross_clock(other)
        if clock is not None and not plain.suits_map:
            found.extend(_at_other_times(plain, other, clock, references_m))
        else:
            found.append(_sample(other, references_m, _gross_modes(plain, other), rounds=GROSS_ROUNDS))
    return found


def _at_other_times(plain: Hypothesis, model: SkylineModel, clock: Clock, references_m: Array) -> list[Hypothesis]:
    """The hypotheses of a gross error of the clock at times that are apart from each other."""
    found: list[Hypothesis] = []
    for turned in turned_models(model, clock):
        one = _at_settled_time(plain, turned, clock, references_m)
        at_s, others_s = one.later_s, [other.later_s for other in found]
        if not any(is_linear(clock, at_s - other_s) for other_s in others_s):
            found.append(one)
    return found


def _gross_clock(model: SkylineModel) -> Clock | None:
    """The clock where the gross error is its, on real ground: there the skyline is not linear in it."""
    clock, listed = model.errors.clock, model.errors.listed
    return clock if listed[-1].fact == model.gross and not model.terrain.axisymmetric else None


def _at_settled_time(plain: Hypothesis, model: SkylineModel, clock: Clock, references_m: Array) -> Hypothesis:
    """The hypothesis of a gross error of the clock, with the rows turned to the time that it shows."""
    for _ in range(TIME_ROUNDS):
        found = _sample(model, references_m, _gross_modes(plain, model))
        off_s = found.later_s - model.later_s
        if is_linear(clock, off_s):
            break
        model = turned_model(model, off_s)
    return found


def _gross_modes(plain: Hypothesis, other: SkylineModel) -> list[Gaussian]:
    """Modes with which the sampling of a gross error begins: by the linear model, and where it is none."""
    start, covariance, _ = _linear(other)
    mean = plain.found.share @ plain.found.points
    same = np.linalg.pinv(other.basis.shown) @ (plain.model.basis.shown @ mean[2:])
    return [(start, 2.0 * covariance), (np.append(mean[:2], same), SMALLER * covariance)]
