"""Place in a crater, on a map or in a valley of the Earth, and what can be measured there: stars, skylines."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from functools import cached_property, lru_cache
from typing import Any

import numpy as np

from startrack.applications.reproduction.published.cozman_krotkov import BoundedPosition, locate_by_posterior
from startrack.applications.reproduction.published.kua_drive import Drive, draw_drive
from startrack.applications.reproduction.published.naval import MapFeatures, map_features
from startrack.applications.reproduction.published.skylines import MapGrid, lit_skyline, traced_grid
from startrack.applications.reproduction.published.stein_medioni import ROUGH_HEADING_RAD, PolygonTable, polygon_table
from startrack.applications.reproduction.simulator import PERFECT, Sky, Stream, crater, draw_positions, visible_stars
from startrack.camera import Camera, load_camera
from startrack.catalog import NIGHT_RAD, apparent_bodies, load_catalog
from startrack.chain import Located, Settings, locate
from startrack.core.types import Array, Bools, Evidence, Exposure, MeasuredSkyline, NotLocated
from startrack.frames import R_enu_icrs, Site, azel_from_rays
from startrack.localization import ExactPosterior, hull_position
from startrack.rendering import Series, render
from startrack.terrain import Cylinder, EarthProjection, HeightMap, Raster, Terrain, load_terrain, require_site

VALLEY_SITE = Site("earth", float(np.radians(36.59)), float(np.radians(-84.246)), 300.0)
VALLEY_RADIUS_M, HIGHEST_BEYOND_M = 9000.0, 1300.0
FLOOR_HORIZON_DEG, STEEPEST_RAD = (9.0, 26.0), float(np.radians(15.0))  # mean horizon and slope of a valley floor
YEAR, DAYS = datetime(2026, 1, 1, tzinfo=UTC), 365
BELOW_RAD = -np.pi / 2  # the least elevation
DARK_RAD = float(np.radians(-5.0))  # elevation of the highest Moon of a dark night
THESIS_GROUND, VALLEY_GROUND = "", "jacksboro"  # the thesis's crater; valleys of the Earth
PICTURE_CAMERA = "fisheye-2048"
PICTURE_V_MAG = 9.0  # of the faintest stars rendered: three magnitudes below those of 5 sigma, as in predictions


def jacksboro(height_sigma_m: float = 0.0) -> HeightMap:
    """The valleys at 3 arcsec (SRTM) as a terrain whose map states an error of `height_sigma_m` at each post.

    Raises ImportError where matplotlib is not installed.
    """
    from matplotlib import cbook

    data: Any = cbook.get_sample_data("jacksboro_fault_dem.npz")
    step = float(data["dx"])
    raster = Raster(
        heights_m=data["elevation"].astype(np.float32), source="jacksboro", dx_m=step, dy_m=-step,
        projection=EarthProjection(middle_x=float(data["xmin"]) + 200 * step),
        x0_m=float(data["xmin"]) + step / 2, y0_m=float(data["ymin"]) - step / 2,
    )  # fmt: skip
    return HeightMap(
        name="jacksboro", site=VALLEY_SITE, maps=(raster,), search_radius_m=VALLEY_RADIUS_M,
        height_sigma_m=height_sigma_m, highest_beyond_m=HIGHEST_BEYOND_M, terrestrial_refraction_1=0.13,
        terrestrial_refraction_sigma_1=None, horizon_sigma_common_rad=None if height_sigma_m else 0.0,
    )  # fmt: skip


def draw_floor(terrain: HeightMap, *, rng: np.random.Generator) -> Array:
    """A place (2,) [m] on a valley floor of a `terrain`, drawn by `rng`."""
    around = np.linspace(0, 2 * np.pi, 72, endpoint=False)
    while True:
        at = rng.uniform(-VALLEY_RADIUS_M, VALLEY_RADIUS_M, 2)
        if np.hypot(*at) < 0.95 * VALLEY_RADIUS_M and terrain.slope_rad(at) < STEEPEST_RAD:
            mean = np.degrees(terrain.horizon_rad(at[None], around).mean())
            if FLOOR_HORIZON_DEG[0] <= mean <= FLOOR_HORIZON_DEG[1]:
                return at


def draw_time(
    site: Site,
    *,
    sun_rad: tuple[float, float] = (BELOW_RAD, NIGHT_RAD),
    moon_rad: tuple[float, float] = (BELOW_RAD, DARK_RAD),
    rng: np.random.Generator,
) -> datetime:
    """A time with Sun and Moon at elevations in the ranges `sun_rad` and `moon_rad` [rad] at a `site`, by `rng`."""
    while True:
        when = YEAR + timedelta(days=float(rng.uniform(0, DAYS)))
        R = R_enu_icrs(site, when)
        at = {one.name: float(azel_from_rays(R @ one.ray_icrs)[1]) for one in apparent_bodies(site, when)}
        if sun_rad[0] <= at["Sun"] <= sun_rad[1] and moon_rad[0] <= at["Moon"] <= moon_rad[1]:
            return when


@dataclass(frozen=True, eq=False)
class Scene:
    """Place on a ground with all that can be measured there, each drawn when it is first used."""

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
        if self.ground == VALLEY_GROUND:
            return draw_floor(valleys(), rng=self.draws(Stream.POSITIONS))
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

    @property
    def hull_m(self) -> Array:
        """Kua's first estimate (2,) [m]; computed anew, since methods are timed. Raises NotLocated."""
        return hull_position(self.points_m[self.seen], self.crater.wall_m, self.crater.radius_m)

    @cached_property
    def evidence(self) -> Evidence:
        """Evidence of the stars in sight as a list without mistakes."""
        return PERFECT.evidence(self.sky, self.seen)

    @cached_property
    def grid(self) -> MapGrid:
        return traced_grid(self.terrain)

    @cached_property
    def table(self) -> PolygonTable:
        return polygon_table(self.grid)

    @cached_property
    def features(self) -> MapFeatures:
        return map_features(self.terrain)

    @cached_property
    def listed_m(self) -> Array:
        """Position (2,) [m] by startrack from the list of stars. Raises NotLocated."""
        return ExactPosterior()(self.evidence, self.terrain).position_enu_m[:2]

    @cached_property
    def lit(self) -> MeasuredSkyline:
        """The skyline in sunlight with the true heading."""
        return lit_skyline(self.truth_m, self.terrain, rng=self.draws(Stream.LIT))

    @cached_property
    def rough(self) -> MeasuredSkyline:
        """The skyline in sunlight with a rough heading."""
        draws = self.draws(Stream.HEADING)
        return lit_skyline(self.truth_m, self.terrain, ROUGH_HEADING_RAD * draws.standard_normal(), rng=draws)

    @cached_property
    def turned(self) -> MeasuredSkyline:
        """The skyline in sunlight with any heading."""
        draws = self.draws(Stream.ANY_HEADING)
        return lit_skyline(self.truth_m, self.terrain, draws.uniform(0.0, 2 * np.pi), rng=draws)

    @cached_property
    def dark(self) -> MeasuredSkyline:
        """The skyline that startrack measures in the picture. Raises NotLocated where it measures none."""
        if self.located.skyline is None:
            raise NotLocated("the picture shows no skyline")
        return self.located.skyline

    @cached_property
    def bounded_lit(self) -> BoundedPosition:
        """Mean position by the skyline in sunlight, with bounds. Raises NotLocated."""
        return locate_by_posterior(self.lit, self.grid)

    @cached_property
    def bounded_dark(self) -> BoundedPosition:
        """Mean position by the skyline of the picture, with bounds. Raises NotLocated."""
        return locate_by_posterior(self.dark, self.grid)

    @cached_property
    def drive(self) -> Drive:
        """A drive that ends here."""
        return draw_drive(self.truth_m, self.terrain.search_radius_m, rng=self.draws(Stream.DRIVE))

    @cached_property
    def pictures(self) -> Series:
        """Pictures from here, in a night without Moon on the Earth, at any time on the Moon."""
        draws, (east, north) = self.draws(Stream.PICTURE), self.truth_m.tolist()
        site = require_site(self.terrain)
        when = draw_time(site, rng=draws) if site.body == "earth" else None
        return Series(
            camera=picture_camera(), terrain=self.terrain, catalog=load_catalog().brighter_than(PICTURE_V_MAG),
            seed=int(draws.integers(1 << 30)), time_utc=when, east_m=east, north_m=north, faint_v_mag=PICTURE_V_MAG,
        )  # fmt: skip

    @cached_property
    def picture(self) -> Exposure:
        scene, rng = self.pictures.scene(0)
        return render(scene, rng=rng)[0]

    @cached_property
    def located(self) -> Located:
        """The picture, located by stars and the light of the sky. Raises NotLocated."""
        return self.locate_picture(Settings())

    def locate_picture(self, settings: Settings) -> Located:
        """The picture located with `settings`. Raises NotLocated where it is refused or several positions fit."""
        outcome = locate(self.picture, picture_camera(), self.terrain, load_catalog(), settings)
        if not isinstance(outcome, Located) or outcome.fix.ambiguous:
            raise NotLocated(outcome.message)
        return outcome

    def draws(self, stream: Stream) -> np.random.Generator:
        """Random numbers of a `stream` for this place."""
        return np.random.default_rng([self.seed, stream, self.sky_number, self.number])


@lru_cache(maxsize=2)
def terrain_of(ground: str) -> Terrain:
    """The terrain of a `ground`, loaded once a process: what is computed on it is kept with it."""
    if ground == VALLEY_GROUND:
        return valleys()
    return crater() if ground == THESIS_GROUND else load_terrain(ground)


valleys = lru_cache(maxsize=1)(jacksboro)


@lru_cache(maxsize=1)
def picture_camera() -> Camera:
    """The camera of all pictures."""
    return load_camera(PICTURE_CAMERA)
