"""The exact posterior of the position, by branch and bound over the whole search area."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from startrack.compilation import announce_compilation
from startrack.localization.branch_and_bound import Search
from startrack.localization.clock import clock_matters, duration
from startrack.localization.clock_posterior import marginalize_clock
from startrack.localization.explored import BudgetSpent, Explored, log_sum
from startrack.localization.initial_guess import climb_to_best, explains_all_sectors
from startrack.localization.likelihood import SECTOR_EPSILON, SECTOR_RAD, PositionLikelihood
from startrack.localization.local_posterior import local_posterior
from startrack.localization.nuisance import ShapeFit, find_horizon_bias, marginalize_horizon_bias, marginalize_shape
from startrack.localization.position_prior import (
    PRIOR_NATS,
    REACH_SIGMAS,
    SearchedNear,
    contradiction,
    name_prior,
    weigh_by_prior,
)
from startrack.localization.summary import smallest_axis, summarize
from startrack.prior import PositionPrior
from startrack.terrain import Terrain, require_terrain
from startrack.types import Array, Evidence, Fix, NotLocated

FINER, MOST_FINER = 1.5, 30.0  # times the boxes per sigma, from which on a prior makes the search begin again; at most
MIN_ROWS = 8
MIN_ROW_NATS = 1e-3  # |llr| below which a row is left out
CONTRADICTED_NATS = -1.7  # mean over the sectors at the best position; -0.5 is usual, and -9.2 the least possible


@dataclass(frozen=True)
class ExactPosterior:
    """log P(p | evidence) = sum over sectors of their capped sums of contributions, uniform prior on the search area.

    The area is cut into boxes; each row is visible, hidden or open over a box, which bounds the box's likelihood. Boxes
    that cannot matter are dropped (their total probability is bounded and stated), the others are quartered until they
    are small against the posterior's own spread. So all modes are found. Where the proof would trace more horizons than
    the budget allows, the posterior near the positions that explain all sectors is the answer, with `search` "beam".
    """

    sector_width_rad: float = SECTOR_RAD
    sector_epsilon: float = SECTOR_EPSILON
    prune_nats: float = 16.0  # boxes whose best position is e^-16 as likely as the best known one are dropped
    negligible_nats: float = 18.0  # and so are those that hold at most e^-18 of the probability
    finest_m: float = 0.05  # half side of the smallest boxes; a terrain may distinguish less
    boxes_per_sigma: float = 3.6  # of the posterior's smaller axis; with 1.8 hard edges moved a mean by 0.8 sigma
    most_boxes: int = 40_000
    budget_horizons: float = 250_000.0  # traced for the proof: some two seconds

    def __call__(self, evidence: Evidence, terrain: Terrain) -> Fix:
        """Posterior of the camera's position from rows of `evidence` in the enu of the `terrain`.

        Raises NotLocated: insufficient_geometry, outside_search_area, inconsistent_evidence.
        """
        terrain = require_terrain(terrain)
        announce_compilation()
        informative = (np.abs(evidence.llr) > MIN_ROW_NATS) | (evidence.extended_nats > MIN_ROW_NATS)
        informative &= terrain.is_informative(evidence.azimuth_rad, evidence.elevation_rad)
        count = int(np.count_nonzero(informative))
        if count < MIN_ROWS:
            raise NotLocated(f"only {count} rays carry information about the skyline: expose longer")
        evidence = evidence if count == len(evidence) else evidence.take(informative)
        explored = self._explore_clocked(evidence, terrain)
        log_mass = log_sum(explored.log_likelihood) + float(np.log(4 * explored.half_m**2))
        dropped = float(np.exp(min(explored.log_dropped - log_mass, 0.0)))
        try:
            fix = summarize(explored.centres_m, 2 * explored.half_m, explored.log_likelihood, dropped, terrain)
        except NotLocated as cause:
            if (
                evidence.clock is None
                or cause.reason != "insufficient_geometry"
                or not clock_matters(evidence.clock, terrain)
            ):
                raise
            raise NotLocated(
                f"a clock that is right to {duration(evidence.clock.sigma_s)} leaves most of the search area open: "
                "find the time more exactly (--time-sigma states its error)"
            ) from cause
        return replace(
            fix, horizon_error_rad=explored.horizon_bias_rad, search=explored.search, shape_1=explored.shape,
            clock=explored.clock,
        )  # fmt: skip

    def _explore_clocked(self, evidence: Evidence, terrain: Terrain) -> Explored:
        """The posterior on equal boxes, over all times, shapes and biases, and with the prior of the position.

        Raises NotLocated as `explore_shaped` does, and inconsistent_evidence where the evidence contradicts the prior.
        """
        if evidence.near is None:
            return marginalize_clock(self.explore_shaped, self.explore, evidence, terrain)
        try:
            return self._explore_near(evidence, terrain, evidence.near)
        except NotLocated as refusal:
            raise name_prior(refusal, evidence.near) from refusal

    def _explore_near(self, evidence: Evidence, terrain: Terrain, near: PositionPrior) -> Explored:
        """As `_explore_clocked`, in the neighbourhood of the prior."""
        prune, negligible = self.prune_nats + PRIOR_NATS, self.negligible_nats + PRIOR_NATS
        search = replace(self, prune_nats=prune, negligible_nats=negligible)
        found = search.explore_about(evidence, SearchedNear(terrain, near))
        lowest = CONTRADICTED_NATS * self._likelihood(evidence, terrain).sectors.occupied
        if np.max(found.log_likelihood, initial=-np.inf) < lowest:
            raise contradiction(near, f"are more than {REACH_SIGMAS:.0f} sigma from it")
        weighed = weigh_by_prior(found, near)
        narrow = smallest_axis(weighed.centres_m, 2 * found.half_m, weighed.log_likelihood)
        finer = 2 * found.half_m * self.boxes_per_sigma / max(narrow, self.finest_m)
        if finer < FINER or found.search == "beam":
            return weighed
        # Boxes that suit the evidence alone are too large beside a narrow prior.
        search = replace(search, boxes_per_sigma=min(finer, MOST_FINER) * self.boxes_per_sigma)
        terrain = SearchedNear(terrain, near, REACH_SIGMAS * near.sigma_m)
        return weigh_by_prior(marginalize_clock(search.explore_shaped, search.explore, evidence, terrain), near)

    def explore_about(self, evidence: Evidence, terrain: SearchedNear) -> Explored:
        """The posterior by `evidence` alone near the prior of a `terrain`.

        The searched disk is enlarged until the likeliest position is not at its edge: else nothing would show how far
        off the prior the evidence is. Raises NotLocated as `explore_shaped` does.
        """
        found = marginalize_clock(self.explore_shaped, self.explore, evidence, terrain)
        while terrain.is_at_edge(found):
            wider = terrain.enlarged()
            try:
                found, terrain = marginalize_clock(self.explore_shaped, self.explore, evidence, wider), wider
            except NotLocated:  # the smaller disk has an answer
                break
        return found

    def fit_shape(self, evidence: Evidence, terrain: Terrain) -> ShapeFit:
        """Shape of a `terrain` with an uncertain one, from the `evidence`, estimated together with the position."""
        return marginalize_shape(self.explore_biased, evidence, terrain)[1]

    def explore_shaped(self, evidence: Evidence, terrain: Terrain) -> Explored:
        """The posterior on equal boxes, over all shapes and horizon biases that the `terrain` allows beside `evidence`.

        Raises NotLocated as `explore_biased` does.
        """
        if any(terrain.shape_sigma):
            return marginalize_shape(self.explore_biased, evidence, terrain)[0]
        return self.explore_biased(evidence, terrain)

    def explore_biased(self, evidence: Evidence, terrain: Terrain) -> Explored:
        """The posterior on equal boxes, over all horizon biases that the `terrain` allows beside the `evidence`.

        Raises NotLocated as `explore` does, and outside_search_area.
        """
        if terrain.common_sigma_rad == 0:
            return self.explore(evidence, terrain)
        likelihood = self._likelihood(evidence, terrain)
        bias, others_m = find_horizon_bias(likelihood)
        return marginalize_horizon_bias(self.explore, evidence, terrain, bias, others_m)

    def explore(self, evidence: Evidence, terrain: Terrain, starts_m: Array | None = None) -> Explored:
        """The posterior on equal boxes from `evidence` on a `terrain`; `starts_m` (n, 2): good positions, if known.

        Raises NotLocated where the budget is spent and no position explains all sectors.
        """
        likelihood = self._likelihood(evidence, terrain)
        search = Search.begin(self, likelihood, starts_m)
        try:
            return search.run()
        except BudgetSpent as spent:
            guess = search.guess
            if not explains_all_sectors(guess.best, likelihood):
                guess = climb_to_best(likelihood, spent.centres_m, guess)
            if explains_all_sectors(guess.best, likelihood):
                return local_posterior(likelihood, guess, spent.log_open)
            best = max(search.best, guess.best) / likelihood.sectors.occupied
            limit = f"the search ended after {search.work:.0f} horizons with {spent.open_m2 / 1e6:.2f} km2 open"
            if best < CONTRADICTED_NATS:
                raise NotLocated(
                    f"no position found explains the stars (the best: {best:.1f} nats a sector; usual: 0 to -0.6); "
                    f"{limit}: wrong terrain, time or camera file?",
                    reason="inconsistent_evidence",
                ) from None
            raise NotLocated(
                f"{limit}: is the skyline in the picture, the exposure long enough, the map fine enough nearby?"
            ) from None

    def _likelihood(self, evidence: Evidence, terrain: Terrain) -> PositionLikelihood:
        return PositionLikelihood.from_evidence(evidence, terrain, self.sector_width_rad, self.sector_epsilon)
