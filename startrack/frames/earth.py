"""The Earth's orientation: IAU 2006/2000A through ERFA, with the IERS table that comes with astropy."""

from __future__ import annotations

from datetime import datetime
from functools import cache

import numpy as np

from startrack.core.types import Array
from startrack.frames.spice import et_s
from startrack.frames.time import seconds_since_2000

EARTH_SPIN_RAD_S = 7.292115e-5  # nominal mean angular velocity, IERS Conventions (2010), table 1.2
_J2000_JD = 2_451_545.0
_J2000_MJD = 51_544.5
_DAY_S = 86_400.0


def R_itrs_icrs(time: datetime) -> Array:
    """Rotation (3, 3) from ICRS axes (GCRS) to the Earth-fixed frame ITRS at `time`.

    Within the installed IERS table (1973 to a year ahead of its release) good to a milliarcsecond or so. Outside it
    the nearest UT1 - UTC and polar motion are held: about 2 arcsec of Earth rotation one year beyond, and at most 15
    arcsec as long as leap seconds keep |UT1 - UTC| below 0.9 s. Nothing is downloaded.

    Raises:
        BadInput: "no_time" outside the years that the ephemeris covers.
        RuntimeError: the IERS table is not installed.
    """
    import erfa

    utc_s = seconds_since_2000(time)
    pole_x_rad, pole_y_rad, ut1_minus_utc_s = _earth_orientation_at(_J2000_MJD + utc_s / _DAY_S)
    # TDB serves as TT: they differ by 2 ms at most, and only precession and nutation see it.
    return erfa.c2t06a(
        _J2000_JD, et_s(time) / _DAY_S, _J2000_JD, (utc_s + ut1_minus_utc_s) / _DAY_S, pole_x_rad, pole_y_rad
    )


def _earth_orientation_at(mjd: float) -> tuple[float, float, float]:
    """Polar motion x, y [rad] and UT1 - UTC [s] at a UTC date, linear between days, held outside the table."""
    table = _earth_orientation()
    i = int(np.clip(np.searchsorted(table[:, 0], mjd, side="right") - 1, 0, len(table) - 2))
    fraction = float(np.clip((mjd - table[i, 0]) / (table[i + 1, 0] - table[i, 0]), 0.0, 1.0))
    step = table[i + 1, 1:] - table[i, 1:]
    step[2] -= round(step[2])  # a leap second is a jump at the end of the day, not a slope
    pole_x_arcsec, pole_y_arcsec, ut1_minus_utc_s = table[i, 1:] + fraction * step
    return np.radians(pole_x_arcsec / 3600), np.radians(pole_y_arcsec / 3600), float(ut1_minus_utc_s)


@cache
def _earth_orientation() -> Array:
    """Rows MJD [d], pole x, pole y [arcsec], UT1 - UTC [s], day by day, from IERS finals2000A (Bulletin A).

    Read here and not through astropy.utils.iers, which takes 0.6 s and may access the network.
    """
    try:
        from astropy_iers_data import IERS_A_FILE
    except ImportError as error:
        raise RuntimeError("the IERS table is missing: install the package astropy-iers-data") from error
    with open(IERS_A_FILE, encoding="ascii") as lines:
        # Columns as in the ReadMe.finals2000A beside it; the file's last days are still blank.
        rows = [(x[7:15], x[18:27], x[37:46], x[58:68]) for x in lines if x[58:68].strip()]
    return np.array(rows, dtype=float)
