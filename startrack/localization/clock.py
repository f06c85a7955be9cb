"""The clock: its error turns the sky about the axis of the body; the times that real ground and the rows allow.

The normal distribution of a gross error of the clock is a sum of narrow ones, a step apart. Each is a hypothesis whose
rows are turned to its time. Only times that may hold a part of the probability are sampled: the stated one, the
likeliest by the heights that the rows show, and from these on one step after the other while they hold enough.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from functools import cached_property
from math import hypot

import numpy as np

from startrack.core.limits import check_time
from startrack.core.statistics import interpolate_circle
from startrack.core.types import MIDDLES_RAD, SECTORS, Array, Clock, Evidence, Explored, NotLocated
from startrack.frames import Air, R_from_rotvec, Site, sky_rotvec_rad, turn_sky, ut1_sigma_s
from startrack.localization.hypothesis import (
    FEW_ROUNDS,
    GROSS_ROUNDS,
    WIDER,
    Hypothesis,
    first_plain,
    sample_hypothesis,
)
from startrack.localization.importance_sampling import FEW, Gaussian, moments
from startrack.localization.likelihood.shared_errors import CLOCK_FACT, is_noticeable
from startrack.localization.likelihood.skyline_model import SkylineModel
from startrack.localization.likelihood.skyline_profiles import heavy_log_likelihood, solve_linear
from startrack.localization.search import BEAMS, FIT_M, BoxModel, Place, boxes_about, choose_apart
from startrack.terrain import Terrain

CLOCK_REACH_SIGMAS = 4.0  # of the stated error, to the last time that is tried
TURN_S = 600.0  # over which the sky's turn is taken
GROSS_PROBABILITY, GROSS_SIGMA_S = 0.01, 3600.0  # of a clock whose error nobody states
WRONG_SIGMA_S = 21_600.0  # of one whose stated error is wrong: a local time, a half of the day
TIME_STEP_RAD = np.radians(0.26)  # of the turn between two times at which a position is searched
MOST_SCANNED = 250  # of these times: 65 degrees of turn, five days on the Moon
TRACKED_NATS = 30.0  # less than the best: a time is not looked at more closely
BOXES_APART = 4.0  # halves of boxes between the positions that neighbouring times see of one solution
TIME_ROUNDS = 6  # in which the rows are turned to the time that they show, at most
LINEAR_TURN_RAD = np.radians(0.05)  # of the sky: up to it the skyline of a map changes linearly with the time
MOST_TIMES, TIME_NATS = 3, 12.0  # that are sampled; less likely ones than the best by more are not
WRONG_TIME_PROBABILITY = 0.005  # of a stated time; see docs/method.md, section 8
GROSS_REACH_SIGMAS, MOST_TIME_STEPS = 3.0, 60  # of a gross error, to the last time: 16 degrees of turn at most
FIRST_NATS, MOST_FIRST = 3.0, 2  # of times by the heights alone: worse than the best by more; begun with besides zero
LEAST_SHARE, FULL_SHARE = 5e-5, 1e-2  # of the probability: next times are sampled too; with more points


def clock_at(site: Site, time_utc: datetime, sigma_s: float, is_stated: bool = True) -> Clock:
    """The clock of directions at a `site` at the stated `time_utc` of an exposure, which is right to `sigma_s`.

    is_stated: whether somebody states `sigma_s`; where it is a default, the clock may be grossly wrong. On the Earth
    the error of its rotation beyond the IERS table counts as one of the clock.
    """
    if site.body == "earth":
        sigma_s = hypot(sigma_s, ut1_sigma_s(time_utc))
    return Clock(
        turn_rad_s=sky_rotvec_rad(site, time_utc, TURN_S) / TURN_S, sigma_s=sigma_s,
        gross_probability=0.0 if is_stated else GROSS_PROBABILITY,
        gross_sigma_s=WRONG_SIGMA_S if is_stated else GROSS_SIGMA_S,
    )  # fmt: skip


def duration(seconds: float) -> str:
    """Text of a time of `seconds` in a fitting unit, to two digits."""
    size = abs(seconds)
    units = (("days", 86400.0), ("hours", 3600.0), ("minutes", 60.0), ("s", 1.0))
    unit, factor = next(((unit, factor) for unit, factor in units if size >= 1.5 * factor), units[-1])
    value = size / factor
    return f"{value:.0f} {unit}" if value >= 9.5 else f"{value:.2g} {unit}"


def turn_evidence(evidence: Evidence, later_s: float, air: Air | None) -> Evidence:
    """Rows of `evidence` as they stand if the true time is `later_s` later, with the refraction in the `air` there.

    Rows of the sky's light that have one azimuth keep one: they stand or fall together.
    """
    clock = evidence.clock
    if clock is None or later_s == 0.0:
        return evidence
    moved = replace(clock, offset_s=clock.offset_s + later_s)
    R = R_from_rotvec(later_s * clock.turn_rad_s)
    azimuth, elevation = turn_sky(evidence.azimuth_rad, evidence.elevation_rad, R, air)
    light = np.flatnonzero(evidence.extended_nats > 0.0)
    _, first, of = np.unique(evidence.azimuth_rad[light], return_index=True, return_inverse=True)
    azimuth[light] = azimuth[light[first]][of]
    return replace(evidence, azimuth_rad=azimuth, elevation_rad=elevation, clock=moved)


@dataclass(frozen=True)
class Scan:
    """A time [s later] and the boxes that fit best there, and how well the best one fits on average."""

    later_s: float
    fit: float
    centres_m: Array  # (n, 2), the best average first
    half_m: float

    def leads_to(self, other: Scan, step_s: float) -> bool:
        """Whether the next time, `other` of those `step_s` apart, fits better at nearly the same position."""
        is_next = 0 < abs(self.later_s - other.later_s) < 1.5 * step_s and self.fit < other.fit
        apart_m = np.abs(self.centres_m[0] - other.centres_m[0]).max() if is_next else np.inf
        return bool(apart_m <= BOXES_APART * self.half_m)


@dataclass(frozen=True)
class Track:
    """Times that the clock of rows allows on a terrain."""

    evidence: Evidence
    terrain: Terrain
    clock: Clock

    def likely_places(self) -> list[Place]:
        """The best place at each time that matters; `later_s` is that time.

        The prior of the time is in the log-likelihood: the clock is one of the errors of the model.

        Raises NotLocated (outside_search_area, insufficient_geometry).
        """
        found: list[Place] = []
        for place in self._begin_places():
            settled = self._settle_time(place, found)
            if settled is not None:
                found.append(settled)
        return found

    @property
    def limits_s(self) -> tuple[float, float]:
        """First and last time that is tried [s later]."""
        clock = self.clock
        low, high = (-clock.offset_s + side * CLOCK_REACH_SIGMAS * clock.sigma_s for side in (-1, 1))
        return max(low, -clock.reach_s), min(high, clock.reach_s)

    @property
    def step_s(self) -> float:
        """Step [s] between two times."""
        return float(TIME_STEP_RAD / np.linalg.norm(self.clock.turn_rad_s))

    def _begin_places(self) -> list[Place]:
        """The best places at likely times, the best first."""
        low, high = self.limits_s
        times = np.linspace(low, high, 2 * int(np.ceil(0.5 * (high - low) / self.step_s)) + 1)
        if len(times) > MOST_SCANNED:
            raise NotLocated(
                f"a clock that is right to {duration(self.clock.sigma_s)} leaves too many times to search on this "
                "terrain: find the time more exactly (--time-sigma states its error)"
            )
        scanned = [one for one in map(self._scan, times) if len(one.centres_m)]
        found: list[Place] = []
        for one in scanned:
            if not any(one.leads_to(other, self.step_s) for other in scanned):
                places = self._model(one.later_s).fit_places(one.centres_m, one.half_m, most=1)
                found.extend(place._replace(later_s=one.later_s) for place in places)
        if not found:
            raise NotLocated("no position in the search area is allowed", reason="outside_search_area")
        found.sort(key=lambda one: -one.log_likelihood)
        return [one for one in found if one.log_likelihood > found[0].log_likelihood - TRACKED_NATS]

    def _scan(self, later_s: float) -> Scan:
        """The best boxes at a time [s later]."""
        model = self._model(later_s)
        centres, half = model.last_boxes(*BEAMS[0])
        fit = float(model.averages(centres[:1], half)[0]) if len(centres) else -np.inf
        return Scan(later_s, fit + float(self.clock.log_prior(later_s)), centres, half)

    def _settle_time(self, begin: Place, found: list[Place]) -> Place | None:
        """Place at the time that the rows show, from that of `begin`; None where it is one of `found` or none fits."""
        (low, high), place = self.limits_s, begin
        for _ in range(TIME_ROUNDS):
            if any(abs(place.later_s - one.later_s) < 0.5 * self.step_s for one in found):
                return None
            models = self._model(place.later_s).fit_places(place.position_m[None], FIT_M, most=1)
            if not models:
                return None
            off_s = models[0].later_s
            later_s = min(max(place.later_s + off_s, low), high)
            place = models[0]._replace(later_s=later_s)
            if is_linear(self.clock, off_s):
                break
        return place

    def _model(self, later_s: float) -> BoxModel:
        """Model of boxes with the rows turned to a time `later_s` later."""
        return BoxModel.of(turn_evidence(self.evidence, later_s, self.terrain.air), self.terrain)


def is_wide(clock: Clock, terrain: Terrain) -> bool:
    """Whether the stated error of a clock turns the sky over more than a skyline's shape is linear in."""
    if terrain.axisymmetric:
        return False
    return not is_linear(clock, clock.sigma_s)


def is_linear(clock: Clock, error_s: float) -> bool:
    """Whether the skyline of real ground is linear in an error of the clock of this size."""
    return abs(error_s) * float(np.linalg.norm(clock.turn_rad_s)) <= LINEAR_TURN_RAD


def explore_times(evidence: Evidence, terrain: Terrain, clock: Clock) -> list[tuple[Evidence, Explored]]:
    """Pairs of the rows turned to a likely time that a wide clock allows, and of the boxes there.

    Raises NotLocated as `Track` does.
    """
    places = Track(evidence, terrain, clock).likely_places()
    later_s, fits = np.array([one.later_s for one in places]), np.array([one.log_likelihood for one in places])
    return [
        (turn_evidence(evidence, float(later_s[at]), terrain.air), boxes_about([places[at]], terrain))
        for at in _peaks(later_s, fits, clock)
    ]


def turned_model(model: SkylineModel, later_s: float) -> SkylineModel:
    """Copy of the `model` with its rows turned to a time `later_s` later."""
    check_time()
    return model.with_rows(turn_evidence(model.seen.rows, later_s, model.terrain.air))


def _peaks(later_s: Array, fits: Array, clock: Clock) -> list[int]:
    """Indices of the likeliest times that are apart from each other."""
    apart_s = TIME_STEP_RAD / float(np.linalg.norm(clock.turn_rad_s))
    return choose_apart(later_s[:, None], fits, apart_s, TIME_NATS, MOST_TIMES)


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
        linear, covariance, weight = model.solve_linear()
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
