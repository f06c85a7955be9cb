"""Whether the light near a predicted skyline is that of the sky: each sector by itself, and the whole step."""

from __future__ import annotations

from math import sqrt
from typing import Any

import numpy as np

from startrack.core.types import Array, Bools
from startrack.evidence.sky_levels import LEVEL_SECTORS, SECTORS
from startrack.evidence.sky_light import SkyLight
from startrack.evidence.sky_step import MEDIAN_ABS_NORMAL

MIN_SECTORS = 60  # with a step; fewer determine no shift of the skyline
MIN_STEP_SIGMAS = 8.0  # of the mean step
SECTOR_STEP_SIGMAS = 3.0  # of the step of one sector
OWN_LEVEL_SIGMAS = 5.0  # of a sector's own level against its neighbours'
MISFIT_SIGMAS = 6.0  # of a sector's misfit against the others'
RAMP_PX = 4.0  # standard deviation of an edge that is no skyline: light that fades
SHARP_NATS = 10.0  # by which the sharp edge must explain the pixels better than such a ramp


def sectors_with_step(sky: SkyLight) -> Bools:
    """Sectors (SECTORS,) where the light steps from a ground to a sky that continue those beside them.

    None at all where the step as a whole is too weak, or fades instead of stepping.
    """
    levels = sky.levels
    sigma = np.hypot(*_level_sigmas(sky))
    good = levels.covered & np.isfinite(sky.shift_sigma_px) & (levels.step_e > SECTOR_STEP_SIGMAS * sigma)
    own = np.abs(levels.own_e) / (levels.own_sigma_e * sqrt(levels.correlation))
    good &= (own < OWN_LEVEL_SIGMAS).all(axis=0)
    if good.any():
        middle = np.median(sky.misfit_nats[good])
        spread = np.median(np.abs(sky.misfit_nats[good] - middle)) / MEDIAN_ABS_NORMAL
        good &= sky.misfit_nats < middle + MISFIT_SIGMAS * max(float(spread), 1.0)
    mean_step = levels.step_e[good].mean() if good.any() else 0.0
    mean_sigma = sqrt(float(np.sum(np.square(sigma[good]))) * LEVEL_SECTORS) / max(int(np.count_nonzero(good)), 1)
    enough = np.count_nonzero(good) >= MIN_SECTORS and mean_step > MIN_STEP_SIGMAS * mean_sigma
    return good if enough and _is_sharp(sky, good) else np.zeros(SECTORS, dtype=bool)


def _level_sigmas(sky: SkyLight) -> Array:
    """Standard deviations (2, SECTORS) of the smoothed levels."""
    levels = sky.levels
    averaged = 2 * sqrt(np.pi) * LEVEL_SECTORS  # sectors in one smoothed level
    return np.asarray(levels.own_sigma_e * sqrt(levels.correlation / averaged))


def _is_sharp(sky: SkyLight, sectors: Bools) -> bool:
    """Whether a step as sharp as a star explains the cells of the sectors better than a wide ramp, by far."""
    from scipy.special import ndtr

    heights = sky.height_px[sectors] - sky.shift_px[sectors, None]
    llr, extended = sky.llr[sectors], sky.extended_nats[sectors]

    def nats(edge_px: float) -> float:
        fraction: Any = ndtr(heights / edge_px)
        return float(np.sum(fraction * (llr + 0.5 * extended * (1.0 - fraction))))

    return nats(sky.edge_px) > nats(RAMP_PX) + SHARP_NATS
