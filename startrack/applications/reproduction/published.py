"""The numbers of the thesis. Source: Kua 2008, CMU-RI-TR-08-21; sections and figures as noted."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from startrack.core.types import Array


@dataclass(frozen=True)
class Errors:
    """Position errors over many positions [m]."""

    mean_m: float
    sd_m: float
    max_m: float


TRIALS = tuple(  # table 3.1
    Errors(*row)
    for row in (
        (33.3, 29.8, 317.9), (33.7, 29.9, 327.3), (34.6, 31.7, 344.3), (33.6, 30.2, 271.2), (34.3, 30.2, 242.9),
        (34.1, 32.3, 300.7), (36.2, 32.9, 325.6), (33.9, 31.2, 300.2), (34.1, 31.2, 358.4), (34.4, 31.5, 356.6),
    )
)  # fmt: skip
OVERALL = Errors(34.2, 31.1, 358.4)  # table 3.1
HULL = Errors(637.0, 275.0, 1735.0)  # section 3.1.1
NEVER_SETTLE = 0.006  # section 3.1.2
MEAN_GAP_M, MAX_GAP_M = 14.9031, 215.0  # figure 3.7, magnitude 6
STAR_COUNT = 2142  # section 3.2.2
LUNAR_ASPECT_RATIOS = (5.0, 50.0)  # section 3.2.3


def simple_depth_km(diameter_km: Array) -> Array:
    """Depth of simple craters, below 15 km: 0.196 D^1.010 (eq. 3.11, from the Lunar Sourcebook)."""
    return 0.196 * np.power(diameter_km, 1.010)


def complex_depth_km(diameter_km: Array) -> Array:
    """Depth of complex craters, 12 to 275 km: 1.044 D^0.301 (eq. 3.12, from the Lunar Sourcebook)."""
    return 1.044 * np.power(diameter_km, 0.301)
