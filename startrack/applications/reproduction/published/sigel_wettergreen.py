"""Stars and an inclinometer: attitude and vertical give latitude and longitude.

Built from the description in Kua 2008, section 2.1 (its reference [7], Sigel and Wettergreen), not from the paper. The
thesis has its "theoretical worst case error of 1.2 km", which the measurement of the vertical dominates. On the Moon's
sphere that is a tilt of 142 arcseconds; here the mean length of the drawn tilts is that.
"""

from __future__ import annotations

import numpy as np

from startrack.applications.reproduction.published.vertical import (
    draw_tilt_rad,
    position_of_vertical,
    tilt_vertical,
    vertical_at,
)
from startrack.core.types import Array
from startrack.frames import Site

INCLINOMETER_ARCSEC = 142.0  # mean error of the vertical: 1.2 km on the Moon (8.42 m per arcsecond)


def locate_by_inclinometer(truth_m: Array, site: Site, *, rng: np.random.Generator) -> tuple[Array, Array]:
    """Position (2,) [m] by one reading of the vertical at `truth_m` (2,), and the tilt (2,) [rad] that is drawn.

    Attitude and clock are taken as exact: they are good to arcseconds, and the Moon turns by half of one a second.
    """
    tilt = draw_tilt_rad(INCLINOMETER_ARCSEC, rng=rng)
    return position_of_vertical(tilt_vertical(vertical_at(truth_m, site), tilt), site), tilt
