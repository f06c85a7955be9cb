"""Stars (Hipparcos, Gaia's fainter ones) and their names, the Sun, planets, Moon and Earth; the sky over a site."""

from startrack.catalog.sky import (
    LOWEST_STAR_RAD,
    MOST_BELOW_PART,
    NIGHT_RAD,
    Sky,
    airmass_at,
    apparent_bodies,
    apparent_stars,
    bodies,
    bodies_from_centre,
    catalog_rays,
    daylight_warnings,
    is_below_horizon,
    sky_at,
    sun_elevation_rad,
)
from startrack.catalog.stars import (
    StarCatalog,
    has_deep_catalog,
    hipparcos_rows_in_deep,
    load_catalog,
    load_deep_catalog,
    proper_name_designations,
    star_names,
)

__all__ = [
    "LOWEST_STAR_RAD", "MOST_BELOW_PART", "NIGHT_RAD", "Sky", "StarCatalog", "airmass_at", "apparent_bodies",
    "apparent_stars", "bodies", "bodies_from_centre", "catalog_rays", "daylight_warnings", "has_deep_catalog",
    "hipparcos_rows_in_deep", "is_below_horizon", "load_catalog", "load_deep_catalog", "proper_name_designations",
    "sky_at", "star_names", "sun_elevation_rad",
]  # fmt: skip
