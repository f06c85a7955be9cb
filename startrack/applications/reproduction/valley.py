"""Valleys of the Earth: the map near Jacksboro, Tennessee, that comes with matplotlib; places and times there."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta
from typing import Any

import numpy as np

from startrack.catalog import NIGHT_RAD, apparent_bodies
from startrack.core.types import Array
from startrack.frames import R_enu_icrs, Site, azel_from_rays
from startrack.terrain import EarthProjection, HeightMap, Raster

VALLEY_SITE = Site("earth", float(np.radians(36.59)), float(np.radians(-84.246)), 300.0)
VALLEY_RADIUS_M, HIGHEST_BEYOND_M = 9000.0, 1300.0
FLOOR_HORIZON_DEG, STEEPEST_RAD = (9.0, 26.0), float(np.radians(15.0))  # mean horizon and slope of a valley floor
YEAR, DAYS = datetime(2026, 1, 1, tzinfo=UTC), 365
BELOW_RAD = -np.pi / 2  # the least elevation
DARK_RAD = float(np.radians(-5.0))  # elevation of the highest Moon of a dark night


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
