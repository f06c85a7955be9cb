"""Other times than the stated one that the rows allow on real ground, as hypotheses of the one posterior.

The normal distribution of a gross error of the clock is a sum of narrow ones, a step apart. Each is a hypothesis whose
rows are turned to its time. Only times that may hold a part of the probability are sampled: the stated one, the
likeliest by the heights that the rows show, and from these on one step after the other while they hold enough.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from startrack.core.statistics import interpolate_circle
from startrack.core.types import MIDDLES_RAD, SECTORS, Array, Clock
from startrack.frames import R_from_rotvec, turn_sky
from startrack.localization.clock import TIME_STEP_RAD, turned_model
from startrack.localization.hypothesis import (
    FEW_ROUNDS,
    GROSS_ROUNDS,
    WIDER,
    Hypothesis,
    first_plain,
    sample_hypothesis,
)
from startrack.localization.importance_sampling import FEW, Gaussian, moments
from startrack.localization.places import choose_apart
from startrack.localization.shared_errors import CLOCK_FACT, is_noticeable
from startrack.localization.skyline_model import SkylineModel
from startrack.localization.skyline_profiles import heavy_log_likelihood, solve_linear

WRONG_TIME_PROBABILITY = 0.005  # of a stated time; see docs/method.md, section 8
GROSS_REACH_SIGMAS, MOST_TIME_STEPS = 3.0, 60  # of a gross error, to the last time: 16 degrees of turn at most
FIRST_NATS, MOST_FIRST = 3.0, 2  # of times by the heights alone: worse than the best by more; begun with besides zero
LEAST_SHARE, FULL_SHARE = 5e-5, 1e-2  # of the probability: next times are sampled too; with more points


def sample_other_times(found: Sequence[Hypothesis]) -> list[Hypothesis]:
    """Hypotheses of a gross error of the clock on real ground, about the plain one of the group of the first `found`.

    A stated clock has them too, but not at a first look: the image is then measured at the stated time.
    """
    plain = first_plain(found)
    rows, clock, terrain = plain.model.seen.rows, plain.model.seen.rows.clock, plain.model.terrain
    if clock is None or terrain.axisymmetric or not is_noticeable(clock, clock.gross_sigma_s, terrain):
        return []
    is_stated = clock.gross_probability == 0.0
    if clock.sigma_s >= clock.gross_sigma_s or (is_stated and rows.is_first_look):
        return []
    log_evidence = float(np.logaddexp.reduce([one.log_evidence for one in found]))
    probability = WRONG_TIME_PROBABILITY if is_stated else clock.gross_probability
    return OtherTimes(plain, plain.model.with_gross(CLOCK_FACT), clock, probability, log_evidence).sample()


@dataclass(frozen=True, eq=False)
class OtherTimes:
    """Times that a gross error of a clock allows, about the points of a `plain` hypothesis without one."""

    plain: Hypothesis
    model: SkylineModel  # with the gross error
    clock: Clock
    probability: float  # of the gross error
    log_evidence: float  # of all hypotheses without one

    @property
    def step_s(self) -> float:
        """Step [s] between two times."""
        return float(TIME_STEP_RAD / np.linalg.norm(self.clock.turn_rad_s))

    @cached_property
    def times_s(self) -> Array:
        """Times (2 n + 1,) [s later than stated], the stated one in the middle."""
        count = min(int(np.ceil(GROSS_REACH_SIGMAS * self.clock.gross_sigma_s / self.step_s)), MOST_TIME_STEPS)
        return self.step_s * np.arange(-count, count + 1.0)

    @cached_property
    def log_part(self) -> Array:
        """Logarithms (2 n + 1,) of the parts of the gross error's distribution that the times have."""
        sigmas = self.times_s / self.clock.gross_sigma_s
        norm = float(np.log(self.step_s / self.clock.gross_sigma_s / np.sqrt(2 * np.pi)))
        return np.asarray(norm - 0.5 * np.square(sigmas), dtype=np.float64)

    def sample(self) -> list[Hypothesis]:
        """The hypotheses of the times that may hold a part of the probability."""
        found: dict[int, Hypothesis] = {}
        waiting = self._first()
        while waiting:
            at = waiting.pop(0)
            if at in found or not 0 <= at < len(self.times_s):
                continue
            found[at] = self._sample_time(at, found.get(at - 1, found.get(at + 1)))
            least = FULL_SHARE if self.model.seen.rows.is_first_look else LEAST_SHARE
            if found[at].log_evidence > self.log_evidence + np.log(least):
                waiting += [at - 1, at + 1]
        return list(found.values())

    def _first(self) -> list[int]:
        """Indices of the stated time, of the likeliest others apart, and of its neighbours where heights allow them."""
        fits = np.array([self._fit(offset_s) for offset_s in self.times_s]) + self.log_part
        likely = choose_apart(self.times_s[:, None], fits, 1.5 * self.step_s, FIRST_NATS, MOST_FIRST)
        stated = len(self.times_s) // 2
        return [stated, *likely, *(at for at in (stated - 1, stated + 1) if fits[at] > fits.max() - FIRST_NATS)]

    def _fit(self, offset_s: float) -> float:
        """Log-likelihood of the heights of the sectors, turned to a later time, where position and errors suit them."""
        model, around, seen = self.model, self.model.around, self.model.seen.moments
        R = R_from_rotvec((offset_s - model.errors.offset_s) * self.clock.turn_rad_s)
        azimuth, elevation = turn_sky(MIDDLES_RAD, around.horizon_rad + seen.mean_rad, R, model.terrain.air)
        own = ~model.errors.is_of_fact(CLOCK_FACT)
        rises = np.vstack([around.slopes, model.error_slopes_rad[own], around.expected_rise_rad])
        *design, expected = rises[:, np.floor(azimuth / (2 * np.pi) * SECTORS).astype(int) % SECTORS]
        left = elevation - interpolate_circle(around.skyline_rad, azimuth) - expected
        heights, rises = seen._replace(mean_rad=left), np.transpose(design)
        prior = np.diag(np.r_[np.full(2, model.terrain.reach_m**-2.0), model.errors.sigma()[own] ** -2.0])
        mean = np.r_[0.0, 0.0, model.errors.mean[own]]
        return heavy_log_likelihood(heights, rises @ solve_linear(heights, rises, mean, prior)[0])

    def _sample_time(self, at: int, neighbour: Hypothesis | None) -> Hypothesis:
        """The hypothesis of one time; sampling begins at the points of a `neighbour`, if there is one."""
        model, begin = self._model_at(float(self.times_s[at])), neighbour or self.plain
        linear, covariance, weight = model.solve()
        mean, spread = moments(begin.sampled.points[:, :2], begin.sampled.share)
        wide = WIDER * covariance
        wide[:2, :2] += WIDER * spread
        modes: list[Gaussian] = [(model.with_likely_errors(mean[None], weight)[0], wide)]
        if neighbour is None:
            modes.append((linear, WIDER * covariance))
        for rounds in FEW_ROUNDS, GROSS_ROUNDS:
            one = sample_hypothesis(model, None, modes, rounds=rounds, enough=FEW)
            one = one.weighed(self.log_part[at])
            if one.log_evidence < self.log_evidence + np.log(FULL_SHARE):
                break
        return one

    def _model_at(self, offset_s: float) -> SkylineModel:
        """Copy of the model with its rows turned to `offset_s`, and the prior of an error about that."""
        model = turned_model(self.model, offset_s - self.model.errors.offset_s)
        *others, clock = model.errors.listed
        about = replace(clock, mean=offset_s, gross_sigma=0.5 * self.step_s, gross_probability=self.probability)
        return replace(model, errors=replace(model.errors, listed=(*others, about)))
