"""An error of the clock turns the sky about the axis of the body."""

from __future__ import annotations

from dataclasses import replace
from datetime import datetime

import numpy as np

from startrack.core.types import Clock, Evidence
from startrack.frames import R_from_rotvec, Site, sky_rotvec_rad, turn_azel
from startrack.terrain import Terrain

REACH_SIGMAS = 4.0  # of the stated error, to the last time that is tried
TURN_S = 600.0  # over which the sky's turn is taken
GROSS_PROBABILITY, GROSS_SIGMA_S = 0.01, 3600.0  # of a clock whose error nobody states
WRONG_SIGMA_S = 21_600.0  # of one whose stated error is wrong: a local time, a half of the day
NEGLIGIBLE_M = 0.05  # by which a row may move over the search area, within one sigma, without an effect on the fix


def clock_at(site: Site, time_utc: datetime, sigma_s: float, is_stated: bool = True) -> Clock:
    """The clock of directions at a `site` at the stated `time_utc` of an exposure, which is right to `sigma_s`.

    is_stated: whether somebody states `sigma_s`; where it is a default, the clock may be grossly wrong.
    """
    return Clock(
        turn_rad_s=sky_rotvec_rad(site, time_utc, TURN_S) / TURN_S, sigma_s=sigma_s,
        gross_probability=0.0 if is_stated else GROSS_PROBABILITY,
        gross_sigma_s=WRONG_SIGMA_S if is_stated else GROSS_SIGMA_S,
    )  # fmt: skip


def duration(seconds: float) -> str:
    """`seconds` in words, to two digits."""
    size = abs(seconds)
    units = (("days", 86400.0), ("hours", 3600.0), ("minutes", 60.0), ("s", 1.0))
    unit, factor = next(((unit, factor) for unit, factor in units if size >= 1.5 * factor), units[-1])
    value = size / factor
    return f"{value:.0f} {unit}" if value >= 9.5 else f"{value:.2g} {unit}"


def turn_evidence(evidence: Evidence, later_s: float) -> Evidence:
    """The rows as they stand if the true time is later by that much."""
    clock = evidence.clock
    if clock is None or later_s == 0.0:
        return evidence
    moved = replace(clock, offset_s=clock.offset_s + later_s)
    R = R_from_rotvec(later_s * clock.turn_rad_s)
    azimuth, elevation = turn_azel(evidence.azimuth_rad, evidence.elevation_rad, R)
    return replace(evidence, azimuth_rad=azimuth, elevation_rad=elevation, clock=moved)


def clock_matters(clock: Clock | None, terrain: Terrain) -> bool:
    """Whether the error of the clock moves a position on a terrain noticeably."""
    if clock is None:
        return False
    return clock.sigma_s * float(np.linalg.norm(clock.turn_rad_s)) * terrain.reach_m > NEGLIGIBLE_M
