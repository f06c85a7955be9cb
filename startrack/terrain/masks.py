"""Azimuths that give no evidence, as text: glare of a lit rim, and unmapped ground that may hide stars."""

from __future__ import annotations

import numpy as np

from startrack.core.types import Array, Bools

GLARE, OFF_MAP = "glare of a lit rim", "ground off the map"
Sectors = tuple[tuple[float, float], ...]  # azimuth ranges [rad], each from the first eastward to the second


def in_sectors(azimuths_rad: Array, sectors_rad: Sectors) -> Bools:
    """Whether the azimuths (...) are in one of the sectors."""
    azimuths = np.asarray(azimuths_rad)
    inside = np.zeros(azimuths.shape, dtype=bool)
    for start, end in sectors_rad:
        inside |= (azimuths - start) % (2 * np.pi) <= (end - start) % (2 * np.pi)
    return inside


def describe_masks(glare_rad: Sectors, unknown_rad: Array) -> list[str]:
    """One line per masked range of azimuths.

    `unknown_rad` (n,) of n equal sectors from north eastward is the elevation below which unmapped ground may stand,
    or -pi/2.
    """
    lines = [
        f"azimuths {_range_text(start, end)}: no evidence is taken there, {GLARE} (glare_deg)"
        for start, end in glare_rad
    ]
    step = 2 * np.pi / len(unknown_rad)
    for first, last in _circular_runs(unknown_rad > -np.pi / 2):
        highest = np.degrees(np.take(unknown_rad, range(first, last), mode="wrap").max())
        lines.append(
            f"azimuths {_range_text(first * step, last * step)}: the maps end, and {OFF_MAP} could stand up to "
            f"{highest:.1f} degrees high; no evidence is taken below that"
        )
    return lines


def _circular_runs(flags: Bools) -> list[tuple[int, int]]:
    """First index, and last plus one, of each run of True around the circle; indices may exceed the length."""
    n = len(flags)
    if flags.all():
        return [(0, n)]
    offset = int(np.argmin(flags))  # of an element that is False
    steps = np.diff(np.concatenate([[0], np.roll(flags, -offset).astype(np.int8), [0]]))
    first, last = (np.flatnonzero(steps == sign) + offset for sign in (1, -1))
    return [(int(a) % n, int(a) % n + int(b - a)) for a, b in zip(first, last, strict=True)]


def _range_text(start_rad: float, end_rad: float) -> str:
    if end_rad - start_rad >= 2 * np.pi - 1e-9:
        return "0 to 360 degrees"
    return f"{np.degrees(start_rad) % 360:.0f} to {np.degrees(end_rad) % 360:.0f} degrees"
