"""The times that a wide clock allows on real ground, and the best position at each."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from startrack.core.types import Array, Clock, Evidence, NotLocated
from startrack.localization.clock import REACH_SIGMAS, duration, turn_evidence
from startrack.localization.horizon_bias import LinearSolution, at_likeliest_bias
from startrack.localization.initial_guess import BEAMS, Guess, beam_search
from startrack.localization.likelihood import PositionLikelihood
from startrack.terrain import Terrain

STEP_RAD = np.radians(0.26)  # of the turn between two times at which a position is searched
MOST_SCANNED = 250  # of these times: 65 degrees of turn, five days on the Moon
TRACKED_NATS = 30.0  # less than the best: a time is not looked at more closely
ROUNDS = 3  # in which the rows are turned to the time that they show


@dataclass(frozen=True)
class Track:
    """Times that the clock of rows allows on a terrain."""

    evidence: Evidence
    terrain: Terrain
    clock: Clock

    def likely_way(self) -> tuple[Array, Array, Array]:
        """Times (n,) that matter [s later], the logarithms of their shares (n,), and the best positions (n, 2).

        Raises NotLocated (outside_search_area, insufficient_geometry).
        """
        found: list[tuple[float, float, Array]] = []
        for later_s, position_m in self._seeds():
            if all(abs(later_s - other_s) > 0.5 * self.step_s for other_s, _, _ in found):
                found.append(self._settled(later_s, position_m))
        later, share, position = zip(*found, strict=True)
        return np.array(later), np.array(share), np.array(position)

    @property
    def limits_s(self) -> tuple[float, float]:
        """First and last time that is tried [s later]."""
        clock = self.clock
        low, high = (-clock.offset_s + side * REACH_SIGMAS * clock.sigma_s for side in (-1, 1))
        return max(low, -clock.reach_s), min(high, clock.reach_s)

    @property
    def step_s(self) -> float:
        """Between two times."""
        return float(STEP_RAD / np.linalg.norm(self.clock.turn_rad_s))

    def _seeds(self) -> list[tuple[float, Array]]:
        """Likely times [s later], the best first, each with a position (2,)."""
        low, high = self.limits_s
        times = np.linspace(low, high, 2 * int(np.ceil(0.5 * (high - low) / self.step_s)) + 1)
        if len(times) > MOST_SCANNED:
            raise NotLocated(
                f"a clock that is right to {duration(self.clock.sigma_s)} leaves too many times to search on this "
                "terrain: find the time more exactly (--time-sigma states its error)"
            )
        found = []
        for later_s in times:
            likelihood = self._likelihood(later_s)
            guess = beam_search(likelihood, BEAMS[0])
            if len(guess.points_m):
                found.append((guess.best + self._log_offset(later_s, likelihood), later_s, guess.points_m[0]))
        if not found:
            raise NotLocated("no position in the search area is allowed", reason="outside_search_area")
        found.sort(key=lambda one: -one[0])
        return [(later_s, position) for fit, later_s, position in found if fit > found[0][0] - TRACKED_NATS]

    def _settled(self, later_s: float, position_m: Array) -> tuple[float, float, Array]:
        """The time that the rows show about a time [s later], the logarithm of its share, and the best position."""
        low, high = self.limits_s
        for _ in range(ROUNDS):
            solution = LinearSolution.near(turn_evidence(self.evidence, later_s), self.terrain, position_m)
            later_s = min(max(later_s + solution.later_s, low), high)
            position_m = solution.position_m
        likelihood = self._likelihood(later_s)
        points = position_m[None]
        _, guess = at_likeliest_bias(likelihood, Guess(points, likelihood.exact_scores(points)))
        return later_s, guess.best + self._log_offset(later_s, likelihood), guess.points_m[0]

    def _log_offset(self, later_s: float, likelihood: PositionLikelihood) -> float:
        """The prior, and what makes likelihoods at different times comparable: their sectors hold different rows."""
        return float(self.clock.log_prior(later_s)) + float(likelihood.sectors.ceiling.sum())

    def _likelihood(self, later_s: float) -> PositionLikelihood:
        return PositionLikelihood.from_evidence(turn_evidence(self.evidence, later_s), self.terrain)
