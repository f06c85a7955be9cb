"""The ground for a page: the horizon seen from a place, and the map that a place is drawn on."""

from __future__ import annotations

from typing import Any

import numpy as np

from startrack.output.html.picture import data_uri
from startrack.output.picture.relief import edge_of, ground_cells, light_on
from startrack.terrain import Terrain, load_terrain
from startrack.types import BadInput

RELIEF_CELLS = 420
MARGIN = 1.03  # beyond the map, for its edge
BRIGHTEST = 215.0


class Grounds:
    """Terrains by the names that results give them, each loaded once; None where its file is not here."""

    def __init__(self) -> None:
        self._known: dict[str, Terrain | None] = {}

    def terrain(self, name: str) -> Terrain | None:
        """The terrain of a name or path."""
        if name not in self._known:
            try:
                self._known[name] = load_terrain(name)
            except BadInput:  # a page must not need more than the results: it says what it leaves out
                self._known[name] = None
        return self._known[name]


def horizon_deg(terrain: Terrain, east_m: float, north_m: float, count: int) -> list[float] | None:
    """Elevation of the horizon [deg] at `count` azimuths, evenly from 0 to 360 degrees, both ends included.

    None from where it is not known: a place off the map.
    """
    azimuths_rad = np.linspace(0.0, 2 * np.pi, count)
    horizon_rad = terrain.horizon_rad(np.broadcast_to([east_m, north_m], (count, 2)), azimuths_rad)
    if not np.isfinite(horizon_rad).all():
        return None
    return [round(value, 3) for value in np.degrees(horizon_rad).tolist()]


def ground_map(terrain: Terrain) -> dict[str, Any]:
    """`search_m`, the radius of the search area; of a cylinder `rim_m`, else `relief` with its `half_m`."""
    shape: dict[str, Any] = {"search_m": terrain.search_radius_m, "site": terrain.site.body}
    if terrain.rim_radius_m is not None:
        return {**shape, "rim_m": terrain.rim_radius_m}
    half_m = MARGIN * terrain.reach_m
    return {**shape, "half_m": half_m, "relief": _relief(terrain, half_m)}


def _relief(terrain: Terrain, half_m: float) -> str:
    """The ground's shape, lit from the north-west as maps are; see-through where a camera cannot stand."""
    halves_m, shape = (half_m, half_m), (RELIEF_CELLS, RELIEF_CELLS)
    ground_m, known = ground_cells(terrain, halves_m, shape)
    grey = np.rint(BRIGHTEST * light_on(ground_m, known, halves_m)).astype(np.uint8)
    cover = np.rint(255 * edge_of(known, shape)).astype(np.uint8)
    return data_uri(np.stack([grey, grey, grey, cover], axis=-1))
