"""How a wrong map or clock shows on real ground: a stretched horizon, or a turned sky, would fit the stars better."""

from __future__ import annotations

import numpy as np

from startrack.localization.local_search import Vicinity
from startrack.localization.prefix_sums import Profile
from startrack.localization.sector_likelihood import Sectors
from startrack.terrain import Terrain
from startrack.types import Array

STRETCHES = (0.005, 0.01, 0.015, 0.025, 0.05, 0.1)  # both ways
SMALL_STRETCHES = 4  # of these: the others only where these gain
STRETCH_LEEWAY = 0.35  # d(tan H) / tan H = dH / (sin H cos H), at rims up to 20 degrees
STRETCH_NEARBY_M, TURN_NEARBY_M = 80.0, 40.0
TURNS_RAD = np.radians([0.55, 1.1, -0.55, -1.1])  # an hour turns the Moon's sky by 0.55 degrees
TURN_LEEWAY_RAD = np.radians(0.2)
FIRST_STEP_M, LAST_STEP_M = 16.0, 2.0


def stretch_of_ground(sectors: Sectors, profile: Profile, place_m: Array, terrain: Terrain) -> tuple[float, float]:
    """The stretch of the horizon that fits best near a place (2,), and how much better [nats] than none.

    tan H -> s tan H for all azimuths, the place free. Large stretches are tried only where small ones gain, and more
    of them than less.
    """
    best, gain, sizes = 1.0, 0.0, STRETCHES[:SMALL_STRETCHES]
    for leeway in (sizes[-1] * STRETCH_LEEWAY, STRETCHES[-1] * STRETCH_LEEWAY):
        about = Vicinity.of(sectors, profile, terrain, place_m, STRETCH_NEARBY_M, leeway)
        if not len(about.llr):
            break
        middle, plain = about.climbed(place_m, FIRST_STEP_M, LAST_STEP_M)
        for sign in (1, -1):
            place = middle
            for stretch in (1 + sign * size for size in sizes):
                lowered = np.arctan(np.tan(about.elevation_rad) / stretch)
                place, fit = about.climbed(place, FIRST_STEP_M, LAST_STEP_M, lowered)
                if fit - plain > gain:
                    best, gain = stretch, fit - plain
        if abs(best - 1) < sizes[-1] * (1 - 1e-9):
            break
        sizes = STRETCHES
    return best, gain


def turn_of_sky(sectors: Sectors, profile: Profile, place_m: Array, terrain: Terrain) -> tuple[float, float]:
    """The turn [rad] of the sky about the vertical that fits best, and how much better [nats] than none.

    The place is free near the one given (2,). Near a pole a wrong time looks like that.
    """
    about = Vicinity.of(sectors, profile, terrain, place_m, TURN_NEARBY_M, TURN_LEEWAY_RAD)
    if not len(about.llr):
        return 0.0, 0.0
    best, gain = 0.0, 0.0
    plain = about.turned(0.0).climbed(place_m, FIRST_STEP_M, LAST_STEP_M)[1]
    for turn in TURNS_RAD:
        fit = about.turned(turn).climbed(place_m, FIRST_STEP_M, LAST_STEP_M)[1]
        if fit - plain > gain:
            best, gain = float(turn), fit - plain
    return best, gain
