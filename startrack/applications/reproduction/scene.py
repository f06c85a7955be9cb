"""One place in the thesis's crater or on a map, and what can be measured there: stars, skylines, random errors."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np

from startrack.applications.reproduction.published.skylines import MapGrid, dark_skyline, lit_skyline, traced_grid
from startrack.applications.reproduction.published.stein_medioni import (
    ROUGH_HEADING_RAD,
    PolygonTable,
    polygon_table,
)
from startrack.applications.reproduction.simulator import PERFECT, Sky, Stream, crater, draw_positions, visible_stars
from startrack.core.types import Array, Bools, Evidence, MeasuredSkyline
from startrack.localization import ExactPosterior
from startrack.terrain import Cylinder, Terrain, load_terrain

THESIS_GROUND = ""  # the thesis's crater


@dataclass(frozen=True, eq=False)
class Scene:
    """One place on a ground with all that can be measured there, each drawn when it is first used."""

    seed: int
    sky_number: int
    number: int  # of the place
    ground: str = THESIS_GROUND  # or the name of a terrain

    @cached_property
    def terrain(self) -> Terrain:
        return terrain_of(self.ground)

    @cached_property
    def crater(self) -> Cylinder:
        """The thesis's crater, for methods that know no other ground."""
        return crater()

    @cached_property
    def sky(self) -> Sky:
        return Sky.draw(self.seed, self.sky_number)

    @cached_property
    def truth_m(self) -> Array:
        """The place (2,) [m]."""
        return draw_positions(self.seed, self.sky_number, self.number, self.number + 1)[0]

    @cached_property
    def points_m(self) -> Array:
        """The stars (n, 2) [m] on the plane of the rim of the thesis's crater."""
        return self.sky.project_to_rim_plane(self.crater)

    @cached_property
    def seen(self) -> Bools:
        """The stars (n,) in sight."""
        if self.ground == THESIS_GROUND:
            return visible_stars(self.points_m, self.truth_m, self.crater.radius_m)
        horizon = self.terrain.horizon_rad(np.tile(self.truth_m, (len(self.sky), 1)), self.sky.azimuth_rad)
        return np.asarray(self.sky.elevation_rad > horizon)

    @cached_property
    def evidence(self) -> Evidence:
        return PERFECT.evidence(self.sky, self.seen)

    @cached_property
    def grid(self) -> MapGrid:
        return traced_grid(self.terrain)

    @cached_property
    def table(self) -> PolygonTable:
        return polygon_table(self.grid)

    @cached_property
    def fix_m(self) -> Array:
        """Position (2,) [m] by startrack. Raises NotLocated."""
        return ExactPosterior()(self.evidence, self.terrain).position_enu_m[:2]

    @cached_property
    def lit(self) -> MeasuredSkyline:
        return lit_skyline(self.truth_m, self.terrain, rng=self.draws(Stream.LIT))

    @cached_property
    def rough(self) -> MeasuredSkyline:
        """The skyline in sunlight with a rough heading."""
        draws = self.draws(Stream.HEADING)
        return lit_skyline(self.truth_m, self.terrain, ROUGH_HEADING_RAD * draws.standard_normal(), rng=draws)

    @cached_property
    def dark(self) -> MeasuredSkyline:
        """Raises NotLocated where startrack has no position: then it measures no skyline either."""
        return dark_skyline(self.evidence, self.fix_m, self.terrain)

    def draws(self, stream: Stream) -> np.random.Generator:
        """Random numbers of a `stream` for this place."""
        return np.random.default_rng([self.seed, stream, self.sky_number, self.number])


@lru_cache(maxsize=2)
def terrain_of(ground: str) -> Terrain:
    """The terrain of a `ground`, loaded once a process: what is computed on it is kept with it."""
    return crater() if ground == THESIS_GROUND else load_terrain(ground)
