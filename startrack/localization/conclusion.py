"""A fix or a refusal from the sampled posterior: everything is read off the same weighted points."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from startrack.core.statistics import relative_weights, shares
from startrack.core.types import (
    Array,
    Bools,
    ClockError,
    Explored,
    Fix,
    Ints,
    Mode,
    NotLocated,
    Sectors,
    ShownError,
    UnstatedFact,
)
from startrack.localization.hypothesis import Hypothesis
from startrack.localization.importance_sampling import moments
from startrack.localization.integrity import assess_integrity
from startrack.localization.wrong_files import require_files, require_map_in_view
from startrack.terrain import DIAMETER, Terrain

AMBIGUOUS_MASS = 0.01
NEGLIGIBLE_MODE = 2e-3  # of the probability: points apart that hold less belong to the nearest mode
USELESS_FRACTION = 0.5  # a 95 % circle wider than this part of the search radius says nothing worth having
SHOWN_SIGMAS = 2.0  # by which an error that nobody states is beyond its default
SUPPORT = 200  # points of a fix with which a later search of the same image begins


def require_inside(points_m: Array, weight: Array, terrain: Terrain) -> Bools:
    """Whether points (n, 2) [m] of these weights (n,) are within the search radius of the `terrain`.

    Raises NotLocated outside_search_area where most of the weight is beyond it.
    """
    outside = np.einsum("ni,ni->n", points_m, points_m) > terrain.search_radius_m**2
    if outside.any() and weight[outside].sum() > 0.5 * weight.sum():
        raise NotLocated(
            f"the stars place the camera outside the search area of {terrain.search_radius_m:.0f} m: "
            "is this the terrain of the image, and are its heights in metres? Else widen [search] radius_m in its file",
            reason="outside_search_area",
        )
    return np.asarray(~outside)


def camera_at(point_m: Array, terrain: Terrain) -> Array:
    """East, north and up (3,) [m] of the camera that stands at `point_m` (2,) of the `terrain`."""
    up_m = float(terrain.ground_m(point_m[None, :])[0]) + terrain.camera_height_m
    return np.array([point_m[0], point_m[1], up_m])


def link_points(points_m: Array, gap_m: float) -> Ints:
    """Labels (n,) of the connected groups of points closer than the gap.

    Points are first put into cells of the gap's size, so the cost does not grow with the number of pairs.
    """
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import cKDTree

    cell = np.floor(points_m / (0.5 * gap_m)).astype(np.int64)
    cell -= cell.min(axis=0)
    if cell.max() <= 2:
        return np.zeros(len(cell), dtype=np.int64)
    across = int(cell[:, 1].max()) + 1
    numbers, of = np.unique(cell[:, 0] * across + cell[:, 1], return_inverse=True)
    cells = np.stack([numbers // across, numbers % across], axis=1)
    pairs = cKDTree(cells).query_pairs(2.9, output_type="ndarray")
    graph = coo_matrix((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(len(cells), len(cells)))
    return np.asarray(connected_components(graph, directed=False)[1])[of].astype(np.int64)


@dataclass(frozen=True, eq=False)
class WeightedHypotheses:
    """The posterior by all hypotheses together, the heaviest first."""

    hypotheses: Sequence[Hypothesis]
    terrain: Terrain

    @cached_property
    def positions_m(self) -> Array:
        """Positions (n, 2) [m, enu] of the points of all hypotheses."""
        return np.concatenate([one.positions_m for one in self.hypotheses])

    @property
    def unscaled_radius95_m(self) -> float:
        """Radius [m] that holds 95 % in a crater of the stated width: rays do not show how wide it is."""
        positions = np.concatenate([_positions_without_fact(one, DIAMETER.key) for one in self.hypotheses])
        return self.radii(positions, self.share, self.share @ positions)[0]

    @cached_property
    def share(self) -> Array:
        """Shares (n,) of the points in the probability."""
        return shares(np.concatenate([one.copies_log_weight for one in self.hypotheses]))

    @property
    def best(self) -> Hypothesis:
        """The heaviest hypothesis."""
        return self.hypotheses[0]

    @cached_property
    def is_core(self) -> Array:
        """Whether points (n,) are of hypotheses with the same gross error as the best one, or like it with none."""
        gross = self.best.gross
        return np.concatenate([np.full(len(one.copies_log_weight), one.gross == gross) for one in self.hypotheses])

    @cached_property
    def label(self) -> Ints:
        """Mode (n,) of each point; the heaviest is 0."""
        points, share = self.positions_m[self.is_core], self.share[self.is_core]
        found = np.zeros(len(self.share), dtype=np.int64)
        found[self.is_core] = label_modes(points, share / share.sum())
        return found

    @cached_property
    def main(self) -> Array:
        """Whether points (n,) are in the main mode."""
        return self.is_core & (self.label == 0)

    def radii(self, positions_m: Array, share: Array, middle_m: Array) -> tuple[float, float]:
        """Radii [m] of the circles about a position (2,) that hold 95 and 99.9 % of weighted points (n, 2)."""
        away = np.linalg.norm(positions_m - middle_m, axis=1)
        order = np.argsort(away)
        running = np.cumsum(share[order]) / share.sum()
        low, high = np.interp([0.95, 0.999], running, away[order])
        return float(low), float(high)


def label_modes(points_m: Array, share: Array) -> Ints:
    """Mode (n,) of weighted points (n, 2): points linked by gaps no wider than the heaviest mode; 0 is the heaviest."""
    order = np.argsort(-share)
    kept = order[: int(np.searchsorted(np.cumsum(share[order]), 1.0 - NEGLIGIBLE_MODE)) + 1]
    points, weight = points_m[kept], share[kept]
    label = np.zeros(len(kept), dtype=np.int64)
    for sigmas in (1.0, 1.5, 2.5):  # far modes widen the first spread; the heaviest one's own decides in the end
        heaviest = label == np.argmax(np.bincount(label, weights=weight))
        gap = sigmas * float(np.sqrt(np.linalg.eigvalsh(moments(points[heaviest], weight[heaviest])[1])[1]))
        label = link_points(points, max(gap, 1e-3))
    mass = np.bincount(label, weights=weight)
    heavy = [int(i) for i in np.argsort(-mass, kind="stable") if mass[i] > NEGLIGIBLE_MODE] or [int(np.argmax(mass))]
    if len(heavy) == 1:
        return np.zeros(len(points_m), dtype=np.int64)
    from scipy.spatial import cKDTree

    away = [cKDTree(points[label == i]).query(points_m)[0] for i in heavy]
    return np.asarray(np.argmin(away, axis=0))


def conclude(found: Sequence[Hypothesis], terrain: Terrain, explored: Explored) -> Fix:
    """The fix by sampled hypotheses, the heaviest first, in a terrain, after a search that left the boxes `explored`.

    A first look is not compared with other explanations of what it shows, and has no protection level.
    Raises NotLocated: outside_search_area, insufficient_geometry, inconsistent_evidence.
    """
    whole = WeightedHypotheses(found, terrain)
    require_inside(whole.positions_m, whole.share, terrain)
    middle, covariance = moments(whole.positions_m[whole.main], whole.share[whole.main])
    radius95, radius999 = whole.radii(whole.positions_m, whole.share, middle)
    modes = _list_modes(whole)
    ambiguous = len(modes) > 1 and _share_beyond_circle(whole, middle) > AMBIGUOUS_MASS
    best, own = whole.best, _own_main(whole)
    parameters, own_covariance = moments(best.sampled.points[own], best.sampled.share[own])
    states = best.model.states(parameters)
    clear, lit = states[:, 0], best.model.lit(states)
    widest_m = USELESS_FRACTION * terrain.search_radius_m
    if not ambiguous and radius95 > widest_m and whole.unscaled_radius95_m > widest_m:
        raise NotLocated(_useless_text(whole))
    require_map_in_view(best.model, clear + lit)
    dropped, integrity = explored.dropped_probability, None
    if not best.model.seen.rows.is_first_look:
        require_files(found, best.sampled.likeliest(own))
        if not ambiguous:
            integrity = assess_integrity(
                best.model, parameters, own_covariance[:2, :2], clear, lit, covariance, radius999
            )
    blocked, lit_up = Sectors(1.0 - clear - lit), Sectors(lit)
    is_bias = np.array([one.name == "bias_rad" for one in best.model.errors.listed], dtype=bool)
    bias_rad = float((shares(best.copies_log_weight) @ best.values[:, is_bias]).sum())
    return Fix(
        position_enu_m=camera_at(middle, terrain), covariance_m2=covariance, radius95_m=radius95, radius999_m=radius999,
        modes=modes, ambiguous=ambiguous, search=explored.search,
        dropped_probability=dropped if dropped < 1.0 else None,
        horizon_error_rad=bias_rad, clock=_clock(whole), blocked=blocked if blocked else None,
        integrity=integrity, unstated=_unstated_facts(whole),
        exact_map_radius999_m=_radius_by_exact_map(whole), raised_rad=best.model.rise_rad(parameters),
        compared_at_m=parameters[:2], shown=_shown_errors(best),
        lit=lit_up if lit_up else None,
        support=_support(best, explored),
    )  # fmt: skip


def _own_main(whole: WeightedHypotheses) -> Array:
    """Whether points of the best hypothesis (n,) are in the main mode, with most of their copies; all if none is."""
    best = whole.best
    copies = whole.main[: len(best.copies_log_weight)].reshape(-1, best.copies)  # the best one's points are the first
    own = copies.mean(axis=1) > 0.5
    return np.asarray(own if own.any() else np.ones(len(own), dtype=bool))


def _useless_text(whole: WeightedHypotheses) -> str:
    """Text of the refusal of a posterior that leaves most of the search area open."""
    clock = whole.best.model.errors.clock
    if clock is not None and clock.sigma_s > 60.0:
        from startrack.localization.clock import duration

        return (
            f"a clock that is right to {duration(clock.sigma_s)} leaves most of the search area open: "
            "find the time more exactly (--time-sigma states its error)"
        )
    return "the rays leave most of the search area open: is the skyline in the picture?"


def _share_beyond_circle(whole: WeightedHypotheses, middle: Array) -> float:
    """Part of the core's probability beyond the main mode's own 99.9 % circle."""
    core = whole.share[whole.is_core].sum()
    _, radius = whole.radii(whole.positions_m[whole.main], whole.share[whole.main], middle)
    away = np.linalg.norm(whole.positions_m - middle, axis=1) > radius
    return float(whole.share[whole.is_core & away & (whole.label > 0)].sum() / core)


def _list_modes(whole: WeightedHypotheses) -> tuple[Mode, ...]:
    """Modes of the posterior, the heaviest first."""
    core = whole.share[whole.is_core].sum()
    modes = []
    for i in range(int(whole.label.max()) + 1):
        own = whole.is_core & (whole.label == i)
        mean, _ = moments(whole.positions_m[own], whole.share[own])
        radius95, radius999 = whole.radii(whole.positions_m[own], whole.share[own], mean)
        modes.append(
            Mode(
                east_m=float(mean[0]), north_m=float(mean[1]), weight=min(float(whole.share[own].sum() / core), 1.0),
                radius95_m=radius95, radius999_m=radius999,
            )
        )  # fmt: skip
    return tuple(sorted(modes, key=lambda mode: -mode.weight))


def _clock(whole: WeightedHypotheses) -> ClockError | None:
    """Error of the clock by the points of the core; None where the rows have no clock."""
    stated = whole.best.model.seen.rows.clock
    if stated is None:
        return None
    if whole.best.model.errors.clock is None:
        return ClockError(stated.offset_s, stated.sigma_s)
    core = [one for one in whole.hypotheses if one.gross == whole.best.gross]
    later = np.concatenate([one.model.errors.offset_s + one.values[:, -1] for one in core])
    share = shares(np.concatenate([one.copies_log_weight for one in core]))
    mean = float(share @ later)
    return ClockError(mean, float(np.sqrt(share @ np.square(later - mean))))


def _unstated_facts(whole: WeightedHypotheses) -> tuple[UnstatedFact, ...]:
    """The facts that no file states, the one that widens the 99.9 % circle most first."""
    found = []
    for fact in whole.best.model.errors.unstated_facts:
        parts = [
            (_positions_without_fact(one, fact), one.copies_log_weight) for one in whole.hypotheses if one.gross != fact
        ]
        if not parts:
            continue
        positions, logs = (np.concatenate(part) for part in zip(*parts, strict=True))
        share = shares(logs)
        found.append(UnstatedFact(fact, whole.radii(positions, share, share @ positions)[1]))
    return tuple(sorted(found, key=lambda one: one.radius999_m_if_exact))


def _positions_without_fact(one: Hypothesis, fact: str) -> Array:
    """Positions (n, 2) of a hypothesis's points with the errors of a fact taken out, by linear regression.

    Waves, which the points do not hold, widen them as in the linear model.
    """
    if one.model.errors.are_waves(fact):
        return _positions_without_waves(one)
    own = one.model.errors.is_of_fact(fact)
    _, covariance = moments(np.hstack([one.unturned_m, one.values[:, own]]), shares(one.copies_log_weight))
    drift = np.linalg.pinv(covariance[2:, 2:], hermitian=True) @ covariance[2:, :2]
    values = one.values.copy()
    values[:, own] = 0.0
    return one.model.errors.true_positions(one.unturned_m - one.values[:, own] @ drift, values)


def _radius_by_exact_map(whole: WeightedHypotheses) -> float | None:
    """Radius [m] of the 99.9 % circle if the map had no waves, by the heaviest hypothesis; None where it has none."""
    best = whole.best
    if not best.model.errors.waves:
        return None
    positions, share = _positions_without_waves(best), shares(best.copies_log_weight)
    return whole.radii(positions, share, share @ positions)[1]


def _positions_without_waves(one: Hypothesis) -> Array:
    """Positions (n, 2) of a hypothesis's points about their mean, narrower as in the linear model without waves."""
    exact = replace(one.model, errors=replace(one.model.errors, waves=()))
    wide, narrow = (np.linalg.cholesky(model.solve_linear().covariance[:2, :2]) for model in (one.model, exact))
    mean = shares(one.copies_log_weight) @ one.positions_m
    return np.asarray(mean + (one.positions_m - mean) @ np.linalg.solve(wide.T, narrow.T))


def _shown_errors(best: Hypothesis) -> tuple[ShownError, ...]:
    """The errors that nobody states and that the image shows to be larger than their default."""
    errors = best.model.errors
    mean, covariance = moments(best.values - errors.stated_values, shares(best.copies_log_weight))
    sigma = np.sqrt(np.diag(covariance))
    return tuple(
        ShownError(one.name, one.fact, float(mean[k]), float(sigma[k]))
        for k, one in enumerate(errors.listed)
        if not one.is_stated and abs(mean[k]) - SHOWN_SIGMAS * sigma[k] > one.sigma
    )


def _support(best: Hypothesis, explored: Explored) -> Explored:
    """The SUPPORT points (n, 2) [m, enu] of most weight of the best hypothesis, where a later search begins.

    `explored` is left by the search of this one.
    """
    order = np.argsort(-best.sampled.log_weight)[:SUPPORT]
    points, log = best.sampled.points[order, :2], best.sampled.log_weight[order]
    spread = np.sqrt(max(float(np.linalg.eigvalsh(moments(points, relative_weights(log))[1])[1]), 1e-6))
    return explored._replace(centres_m=points, half_m=0.5 * spread, log_weight=log)
