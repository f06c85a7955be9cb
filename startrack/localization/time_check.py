"""Would another time explain the stars much better? Then the clock is off by more than it states."""

from __future__ import annotations

import numpy as np

from startrack.localization.clock import REACH_SIGMAS, WrongTime
from startrack.localization.likelihood import PositionLikelihood
from startrack.localization.local_search import turn_rays
from startrack.localization.refit import STEPS_M, refitted_gain
from startrack.types import Array, Clock, ClockError

TURNS_RAD = np.radians([0.55, 1.1, -0.55, -1.1])  # an hour turns the Moon's sky by 0.55 degrees
NEARBY_M, LEEWAY_RAD = 40.0, np.radians(0.2)
GAIN_NATS = 5.0  # of 80 true frames the largest gain was 4.1; of 30 with a clock an hour off half gain more than 5
MAP_SIGMA_RAD = np.radians(0.02)  # errors of a map go together from azimuth to azimuth, and fit chance turns as well
SURE_LLR = 4.0


def check_time(likelihood: PositionLikelihood, position_m: Array, clock: Clock) -> None:
    """Raises WrongTime where a free `clock` explains the stars much better, the position free near the one given (2,).

    Not for a terrain that is the same after a turn of the sky.
    """
    later_s, gain = best_time(likelihood, position_m, clock)
    strong = np.abs(likelihood.evidence.llr) >= min(SURE_LLR, float(likelihood.strength.max()))
    azimuths = likelihood.evidence.azimuth_rad[strong]
    sigma = float(np.median(likelihood.terrain.horizon_sigma_rad(position_m[None], azimuths)))
    if gain > GAIN_NATS * (1 + sigma / MAP_SIGMA_RAD):
        raise WrongTime(ClockError(clock.offset_s + later_s, np.inf), clock.sigma_s, "the skyline among the stars")


def best_time(likelihood: PositionLikelihood, position_m: Array, clock: Clock) -> tuple[float, float]:
    """How much later [s] the time is that fits best, and how much better [nats] than the one of the rows.

    The position is free near the one given (2,). Times that the `clock` allows are not tried: the fix allows for them.
    """
    turn_rad_s = float(np.linalg.norm(clock.turn_rad_s))
    level = float(np.hypot(*clock.turn_rad_s[:2])) / turn_rad_s  # by which a turn changes elevations
    local = likelihood.near(position_m, NEARBY_M, LEEWAY_RAD + level * float(TURNS_RAD.max()))
    if not len(local.evidence):
        return 0.0, 0.0
    best_s, gain, at = 0.0, 0.0, position_m
    plain = local.with_turned_sky(np.zeros(3)).climb(position_m, *STEPS_M)[1]
    for later_s in TURNS_RAD / turn_rad_s:
        if abs(clock.offset_s + later_s) < REACH_SIGMAS * clock.sigma_s:
            continue
        position, fit = local.with_turned_sky(later_s * clock.turn_rad_s).climb(position_m, *STEPS_M)
        if fit - plain > gain:
            best_s, gain, at = float(later_s), fit - plain, position
    if gain > GAIN_NATS:
        turned = turn_rays(likelihood.evidence, best_s * clock.turn_rad_s)
        gain = min(gain, refitted_gain(likelihood, position_m, turned, at))
    return best_s, gain
