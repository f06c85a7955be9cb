"""Does the fix explain the stars? Refuse rather than guess."""

from __future__ import annotations

import numpy as np

from startrack.evidence import StarLight
from startrack.terrain import Terrain
from startrack.types import Fix, NotLocated

SURE_LLR = 4.0
CLEAR_OF_SKYLINE_RAD = np.radians(0.5)
SECTOR_RAD = np.radians(5.0)
MOST_CONTRADICTED_SECTORS = 0.15  # a boulder of 20 degrees is 6 % of the horizon
SECTOR_CONTRADICTED = 0.2  # part of a sector's sure stars that contradict the fix
FEWEST_IN_SECTOR = 3


def check_consistency(light: StarLight, fix: Fix, terrain: Terrain) -> None:
    """Raise NotLocated (inconsistent_evidence) where too much of the horizon contradicts the fix.

    Only stars that are sure of themselves and well clear of the fix's skyline are asked, sector by sector of azimuth:
    a few contradicted sectors are an obstacle or a defect, many are a wrong map, time or identification.
    """
    sure = light.usable & (np.abs(light.llr) > SURE_LLR)
    azimuth, elevation = light.azimuth_rad[sure], light.elevation_rad[sure]
    horizon = terrain.horizon_rad(fix.position_enu_m[None, :2], azimuth)
    clear = np.abs(elevation - horizon) > CLEAR_OF_SKYLINE_RAD
    near = np.abs(elevation - horizon) < np.radians(15.0)
    wrong = (light.llr[sure] > 0) != (elevation > horizon)
    sector = (azimuth / SECTOR_RAD).astype(int)
    asked = np.bincount(sector, weights=clear & near)
    contradicted = np.bincount(sector, weights=clear & near & wrong)
    known = asked >= FEWEST_IN_SECTOR
    if not known.any():
        return
    bad = contradicted[known] > SECTOR_CONTRADICTED * asked[known]
    if bad.mean() > MOST_CONTRADICTED_SECTORS:
        raise NotLocated(
            f"{100 * bad.mean():.0f} % of the horizon contradicts the best place: wrong terrain, time or camera file?",
            reason="inconsistent_evidence",
        )
