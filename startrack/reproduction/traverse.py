"""A traverse through the middle of the crater: where the set of visible stars changes. Kua 2008, section 3.2.2."""

from __future__ import annotations

import numpy as np

from startrack.reproduction.simulator import Sky
from startrack.terrain import Cylinder
from startrack.types import Array

STEP_M = 5.0


def changes_m(sky: Sky, cylinder: Cylinder) -> Array:
    """Sorted distances from the centre [m], west to east, at which a star appears or disappears.

    Star i is visible inside the circle of radius R about -point_i, so the changes are where the line north = 0 crosses
    these circles: exact, where the thesis compares views at steps along the line.
    """
    east, north = sky.on_rim_plane(cylinder).T
    met = np.abs(north) < cylinder.radius_m
    half_chord = np.sqrt(np.square(cylinder.radius_m) - np.square(north[met]))
    crossings = np.concatenate([-east[met] - half_chord, -east[met] + half_chord])
    return np.sort(crossings[np.abs(crossings) < cylinder.radius_m])


def gaps_m(changes: Array, cylinder: Cylinder) -> Array:
    """Distances (n - 1,) [m] travelled from one change to the next; the whole diameter where there are not two."""
    return np.diff(changes) if len(changes) > 1 else np.array([cylinder.diameter_m])


def mean_gap_m(changes: Array, cylinder: Cylinder) -> float:
    """Mean distance between changes: the diameter over their number (the thesis's 14.9031 m is 20 km / 1342)."""
    return cylinder.diameter_m / max(len(changes), 1)


def stepped_m(changes: Array, cylinder: Cylinder, step_m: float = STEP_M) -> Array:
    """Ends (n,) [m] of those steps along the traverse within which the view changes: all that a stepping rover notices.

    Several changes within one step count as one. Source: Kua 2008, figures 3.7-3.9, whose step is not given: 5 m is
    what its figures at magnitude 6 are multiples of (215 m), and what gives its mean (20 km / 1342).
    """
    steps = np.unique(np.floor((changes + cylinder.radius_m) / step_m))
    return (steps + 1) * step_m - cylinder.radius_m
