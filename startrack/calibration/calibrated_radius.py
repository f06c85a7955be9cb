"""How far off the axis the stars know the lens."""

from __future__ import annotations

import numpy as np

from startrack.types import Array

FEWEST_BEYOND = 3
PART_BEYOND = 0.01
WIDEST_GAP_RAD = np.radians(8.0)


def reach_rad(off_axis_rad: Array) -> float:
    """The calibrated angle: at least three stars, and 1 % of them, lie there or farther off the axis.

    A gap of more than 8 degrees without any star ends it too: what lies beyond is a bridge, not a measurement.
    """
    ordered = np.sort(off_axis_rad)
    beyond = max(FEWEST_BEYOND, int(np.ceil(PART_BEYOND * len(ordered))))
    outermost = ordered[max(len(ordered) - beyond, 0)]
    middle = ordered[len(ordered) // 2]
    outer = ordered[ordered >= middle]
    gaps = np.flatnonzero(np.diff(outer) > WIDEST_GAP_RAD)
    return float(min(outermost, outer[gaps[0]]) if len(gaps) else outermost)
