"""Branch and bound over the searched square: positions that cannot matter are excluded."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from startrack.core.types import Array, NotLocated
from startrack.localization.explored import Explored, log_sum, split_boxes
from startrack.localization.initial_guess import CLIMB_NATS, Guess, local_posterior, refine_boxes
from startrack.localization.likelihood import PositionLikelihood

BOXES_AT_ONCE = 2000  # so that memory stays flat
LOOK_UP_COST = 0.08  # of a bound, in horizons traced
FINEST_M, FINEST_PART = 12.0, 0.01  # half side of boxes that may be the last ones: at most, and in the half square
MANY_BOXES, MOST_BOXES = 4000, 16_000  # of a level: from which on a better position is sought, and of the last one


@dataclass
class Search:
    """One run: the work done, how much probability was dropped, and the best log-likelihood known."""

    likelihood: PositionLikelihood
    guess: Guess
    prune_nats: float  # boxes that are less likely than the best by more are dropped
    budget_horizons: float
    log_dropped: float = -np.inf  # logarithm of a bound of the mass [m2]
    work: float = 0.0  # in horizons traced
    best: float = -np.inf  # log-likelihood known

    def run(self) -> Explored:
        """The boxes that may matter ("proven"); where the budget ends first, those about the best positions ("beam").

        Raises NotLocated (outside_search_area).
        """
        self.best, terrain = self.guess.best, self.likelihood.terrain
        centres, half = np.array([terrain.searched[:2]]), terrain.searched[2]
        finest_m = min(FINEST_M, FINEST_PART * half)
        while True:
            centres, upper = self._bound(centres, half)
            is_last = 4 * len(centres) > MOST_BOXES
            if 4 * len(centres) > MANY_BOXES and self._climb(centres, half):
                continue
            if half <= finest_m or is_last:
                average = self.likelihood.average.score(terrain, centres, half)
                likely = np.mean(average > average.max() - self.prune_nats)
                resolved = average.max() > self.guess.best - self.prune_nats and likely > 0.5
                if half <= finest_m or resolved:
                    return self._ranked(centres, average, half)
                if is_last:
                    return self._about_best(upper, half)
            quarters = split_boxes(centres, half, terrain)
            if not len(quarters):
                raise NotLocated(
                    "no camera can stand anywhere in the search area: is [search] max_slope_deg too small?",
                    reason="outside_search_area",
                )
            self.work += terrain.horizon_cost * LOOK_UP_COST * self.likelihood.sectors.count * len(quarters)
            if self.work > self.budget_horizons:
                self._climb(centres, half)
                return self._about_best(upper, half)
            centres, half = quarters, half / 2

    def _bound(self, centres: Array, half: float) -> tuple[Array, Array]:
        """Centres (n, 2) of the boxes that may matter, and upper bounds (n,) of their log-likelihood.

        A large box is kept at a smaller likelihood: it holds more probability.
        """
        lk, kept = self.likelihood, []
        nats = self.prune_nats + max(0.0, 2.0 * float(np.log(half / FINEST_M)))
        for start in range(0, len(centres), BOXES_AT_ONCE):
            some = centres[start : start + BOXES_AT_ONCE]
            first, last = lk.sums.open_rays(lk.terrain, some, half)
            visible, least, most = lk.sums.sums(first, last)
            sure = lk.sectors.score(visible + least)[np.asarray(lk.terrain.allowed(some))]
            self.best = max(self.best, float(sure.max(initial=-np.inf)))
            upper = lk.sectors.score(visible + most)
            keep = upper > self.best - nats
            self._drop(upper[~keep], half)
            kept.append((some[keep], upper[keep]))
        return np.concatenate([part[0] for part in kept]), np.concatenate([part[1] for part in kept])

    def _climb(self, centres: Array, half: float) -> bool:
        """Whether a better position than the best known is near the boxes (n, 2) with the best average."""
        average = self.likelihood.average.score(self.likelihood.terrain, centres, half)
        found = refine_boxes(self.likelihood, centres[np.argsort(-average, kind="stable")], half)
        is_better = found.best > self.guess.best + CLIMB_NATS
        if is_better:
            self.guess, self.best = found, max(self.best, found.best)
        return is_better

    def _drop(self, log_likelihood: Array, half: float) -> None:
        lost = log_sum(log_likelihood) + 2.0 * float(np.log(2 * half))
        self.log_dropped = float(np.logaddexp(self.log_dropped, lost))

    def _ranked(self, centres: Array, average: Array, half: float) -> Explored:
        """The boxes with their average log-likelihood (n,), and the guess with its own; unlikely boxes are dropped."""
        keep = average > average.max() - self.prune_nats
        self._drop(average[~keep], half)
        centres = np.vstack([self.guess.points_m, centres[keep]])
        log_likelihood = np.append(self.guess.log_likelihood, average[keep])
        return Explored(centres, half, log_likelihood, self.log_dropped, "proven")

    def _about_best(self, upper: Array, half: float) -> Explored:
        """The neighbourhoods of the best positions known, where boxes with bounds (n,) are left open."""
        self._drop(upper, half)
        return local_posterior(self.likelihood, self.guess, self.log_dropped)
