"""Where a terrain cannot say whether its horizon hides a star, and why: told with the results."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from startrack.terrain.protocol import Terrain
from startrack.types import Array, Bools

GLARE, OFF_MAP = "glare of a lit rim", "ground off the map"


def why_silent(terrain: Terrain, azimuths_rad: Array, elevations_rad: Array) -> NDArray[np.str_]:
    """Why the terrain says nothing of rays (n,); empty where it does."""
    silent = ~np.asarray(terrain.is_informative(azimuths_rad, elevations_rad))
    cause = np.where(silent, OFF_MAP, "")
    return np.where(silent & _in_glare(terrain, np.asarray(azimuths_rad)), GLARE, cause)


def silent_sectors(terrain: Terrain) -> list[str]:
    """One line per azimuth range of which the terrain cannot speak, for people."""
    lines = [
        f"azimuths {_span(start, end)}: no evidence is taken there, {GLARE} (glare_deg)"
        for start, end in getattr(terrain, "glare_rad", ())
    ]
    unknown = getattr(terrain, "unknown_rad", None)
    if unknown is None or not np.any(unknown > -np.pi / 2):
        return lines
    step = 2 * np.pi / len(unknown)
    for first, last in _runs(unknown > -np.pi / 2):
        highest = np.degrees(np.take(unknown, range(first, last), mode="wrap").max())
        lines.append(
            f"azimuths {_span(first * step, last * step)}: the maps end, and {OFF_MAP} could stand up to "
            f"{highest:.1f} degrees high; no evidence is taken below that"
        )
    return lines


def _in_glare(terrain: Terrain, azimuths_rad: Array) -> Bools:
    lit = np.zeros(azimuths_rad.shape, dtype=bool)
    for start, end in getattr(terrain, "glare_rad", ()):
        lit |= (azimuths_rad - start) % (2 * np.pi) <= (end - start) % (2 * np.pi)
    return lit


def _runs(which: Bools) -> list[tuple[int, int]]:
    """First, and one past the last, of each run around the circle; a run over its end goes on past the length."""
    n = len(which)
    if which.all():
        return [(0, n)]
    turned = np.roll(which, -int(np.argmin(which)))  # begins with one that is not meant
    steps = np.diff(np.concatenate([[0], turned.astype(np.int8), [0]]))
    first, last = (np.flatnonzero(steps == sign) + int(np.argmin(which)) for sign in (1, -1))
    return [(int(a) % n, int(a) % n + int(b - a)) for a, b in zip(first, last, strict=True)]


def _span(start_rad: float, end_rad: float) -> str:
    if end_rad - start_rad >= 2 * np.pi - 1e-9:
        return "0 to 360 degrees"
    return f"{np.degrees(start_rad) % 360:.0f} to {np.degrees(end_rad) % 360:.0f} degrees"
