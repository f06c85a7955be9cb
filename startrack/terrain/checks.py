"""Checks of a user's terrain: its members, and the values that its methods return."""

from __future__ import annotations

from typing import Any

import numpy as np

from startrack.core.types import Array, BadInput
from startrack.terrain.protocol import Terrain

BOUNDS_ROUNDING_RAD = 1e-9  # by which a least horizon may exceed the greatest


def require_terrain(given: Any) -> Terrain:
    """`given`, if it is a terrain: of a class derived from Terrain, or with every member of one.

    The one check of the members of a user's object; `require_bounds` and `require_horizons` check the values. All other
    code relies on the protocol. Raises BadInput (bad_terrain) that names the required methods which are missing.
    """
    members = [name for name in dir(Terrain) if not name.startswith("_")]
    if isinstance(given, Terrain) or all(hasattr(given, name) for name in members):
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


def require_bounds(terrain: Terrain, low_rad: Array, high_rad: Array) -> None:
    """Raise BadInput (bad_terrain) unless what `horizon_bounds_rad` of a `terrain` gave are bounds.

    `low_rad` and `high_rad` (...): the least and greatest horizons. The search asks for those of the whole search area
    first, so that an error in a user's terrain is named before it misleads the search.
    """
    wrong = ~(low_rad <= high_rad + BOUNDS_ROUNDING_RAD)
    if not wrong.any():
        return
    nan = np.isnan(low_rad) | np.isnan(high_rad)
    fault = "NaN" if nan.any() else "least horizons above the greatest"
    count = np.count_nonzero(nan if nan.any() else wrong)
    raise BadInput(
        "bad_terrain",
        f"{_described(terrain)}: horizon_bounds_rad gives {fault} for {count} of {wrong.size} sectors of boxes",
    )


def require_horizons(terrain: Terrain, points_m: Array, horizon_rad: Array) -> None:
    """Raise BadInput (bad_terrain) unless a `terrain` gave finite horizons wherever a camera can stand.

    `points_m` (..., 2) are the positions, `horizon_rad` (...) what `horizon_rad` gave there.
    """
    if np.isfinite(horizon_rad).all():
        return
    wrong = ~np.isfinite(horizon_rad) & np.asarray(terrain.allowed(points_m))
    if wrong.any():
        raise BadInput(
            "bad_terrain",
            f"{_described(terrain)}: horizon_rad gives NaN or infinity for {np.count_nonzero(wrong)} of {wrong.size} "
            "rays from ground on which a camera can stand",
        )


def _described(terrain: Terrain) -> str:
    return f"terrain {terrain.name!r} ({type(terrain).__name__})"
