"""Checks of a user's object that is given as a terrain, and of the values that it gives."""

from __future__ import annotations

from typing import Any

import numpy as np

from startrack.core.types import Array, BadInput, Bools
from startrack.frames import Site
from startrack.terrain.protocol import Terrain

BOUNDS_ROUNDING_RAD = 1e-9  # by which a least horizon may exceed the greatest


def require_terrain(given: Any) -> Terrain:
    """`given`, if it is a terrain: of a class derived from Terrain, or with every member of one.

    The one check of the members of a user's object; `require_bounds` and `require_horizons` check the values. All other
    code relies on the protocol. Raises BadInput (bad_terrain) that names the required methods which are missing.
    """
    members = [name for name in dir(Terrain) if not name.startswith("_")]
    if all(hasattr(type(given), name) or hasattr(given, name) for name in members):
        return given  # type: ignore[no-any-return]
    if isinstance(given, str):
        raise BadInput("bad_terrain", f"{given!r} is a text, no terrain: give startrack.load_terrain({given!r})")
    missing = [name for name in sorted(Terrain.__abstractmethods__) if not hasattr(given, name)]
    lacks = f" (it has no {', '.join(missing)})" if missing else ""
    raise BadInput(
        "bad_terrain",
        f"{type(given).__name__} is no terrain{lacks}: give a file, a name, or an object of a class derived from "
        "startrack.Terrain",
    )


def require_site(terrain: Terrain) -> Site:
    """The site of a `terrain`. Raises BadInput (bad_terrain) where it has none."""
    if terrain.site is None:
        raise BadInput("bad_terrain", f"terrain {terrain.name} has no site: its sky is not known")
    return terrain.site


def require_place(terrain: Terrain, east_m: float, north_m: float) -> None:
    """Raise BadInput (bad_terrain), with the range allowed, where no camera can stand on a `terrain`.

    The place is `east_m` and `north_m` of the origin [m].
    """
    if terrain.allowed(np.array([[east_m, north_m]]))[0]:
        return
    away_m, radius_m = float(np.hypot(east_m, north_m)), min(terrain.search_radius_m, terrain.reach_m)
    place = f"E {east_m:g} m, N {north_m:g} m"
    if away_m > radius_m:
        raise BadInput(
            "bad_terrain",
            f"{place} is {away_m:.0f} m from the origin of {terrain.name}: give a place within its search area, "
            f"{radius_m:g} m about the origin",
        )
    raise BadInput(
        "bad_terrain", f"{terrain.name}: no camera can stand at {place} (a steep slope, or the wall): give another"
    )


def require_bounds(terrain: Terrain, low_rad: Array, high_rad: Array) -> None:
    """Raise BadInput (bad_terrain) unless what `horizon_bounds_rad` of a `terrain` gave are bounds.

    `low_rad` and `high_rad` (...): the least and greatest horizons. The search asks for those of the whole search area
    first, so that an error in a user's terrain is named before it misleads the search.
    """
    wrong, fault = ~(low_rad <= high_rad + BOUNDS_ROUNDING_RAD), "least horizons above the greatest"
    if not wrong.any():
        return
    nan = np.isnan(low_rad) | np.isnan(high_rad)
    if nan.any():
        wrong, fault = nan, "NaN"
    _refuse(terrain, "horizon_bounds_rad", fault, wrong, "sectors of boxes")


def require_horizons(terrain: Terrain, points_m: Array, horizon_rad: Array) -> None:
    """Raise BadInput (bad_terrain) unless a `terrain` gave finite horizons wherever a camera can stand.

    `points_m` (..., 2) are the positions, `horizon_rad` (...) what `horizon_rad` gave there.
    """
    if not np.isfinite(horizon_rad).all():
        wrong = ~np.isfinite(horizon_rad) & np.asarray(terrain.allowed(points_m))
        _refuse(terrain, "horizon_rad", "NaN or infinity", wrong, "rays from ground on which a camera can stand")


def _refuse(terrain: Terrain, method: str, fault: str, wrong: Bools, what: str) -> None:
    """Raise BadInput (bad_terrain) if any value of a method is wrong."""
    if wrong.any():
        raise BadInput(
            "bad_terrain",
            f"terrain {terrain.name!r} ({type(terrain).__name__}): {method} gives {fault} for "
            f"{np.count_nonzero(wrong)} of {wrong.size} {what}",
        )
