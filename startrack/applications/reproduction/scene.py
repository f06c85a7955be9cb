"""One place in the thesis's crater, and what can be measured there: stars, skylines, random errors of instruments."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

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
from startrack.terrain import Cylinder


@dataclass(frozen=True, eq=False)
class Scene:
    """One place in the thesis's crater with all that can be measured there, each drawn when it is first used."""

    seed: int
    sky_number: int
    number: int  # of the place

    @cached_property
    def terrain(self) -> Cylinder:
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
        """The stars (n, 2) [m] on the plane of the rim."""
        return self.sky.project_to_rim_plane(self.terrain)

    @cached_property
    def seen(self) -> Bools:
        """The stars (n,) in sight."""
        return visible_stars(self.points_m, self.truth_m, self.terrain.radius_m)

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
        return lit_skyline(self.truth_m, self.terrain, self.draws(Stream.LIT))

    @cached_property
    def rough(self) -> MeasuredSkyline:
        """The skyline in sunlight with a rough heading."""
        draws = self.draws(Stream.HEADING)
        return lit_skyline(self.truth_m, self.terrain, draws, ROUGH_HEADING_RAD * draws.standard_normal())

    @cached_property
    def dark(self) -> MeasuredSkyline:
        """Raises NotLocated where startrack has no position: then it measures no skyline either."""
        return dark_skyline(self.evidence, self.fix_m, self.terrain)

    def draws(self, stream: Stream) -> np.random.Generator:
        """Random numbers of a `stream` for this place."""
        return np.random.default_rng([self.seed, stream, self.sky_number, self.number])
