"""One exposure as a calibration needs it: its point sources, and the sky as it stood above the camera."""

from __future__ import annotations

from dataclasses import dataclass, replace
from datetime import datetime

import numpy as np

from startrack.catalog import StarCatalog
from startrack.detection import Detector
from startrack.frames import (
    R_enu_icrs,
    Site,
    azel_from_rays,
    observer_velocity_m_s,
    rays_from_azel,
    refract_rad,
)
from startrack.types import Array, BadInput, Detections, Exposure, Stars

LOWEST_RAD = np.radians(3.0)  # on the Earth: below, the air's refraction is anybody's guess
SEA_LEVEL_HPA, SCALE_HEIGHT_M = 1010.0, 8430.0  # average air
ANYWHERE = Site("moon", 0.0, 0.0)  # its velocity serves where no site is known: 0.7 arcsec of aberration at most
NO_TIME = (
    "the mid-exposure time is not known: give --time UTC, a sidecar NAME.json with time_utc, or a header with it; "
    "nothing is guessed"
)


@dataclass(frozen=True, kw_only=True)
class Sky:
    """Catalogue stars where the air, if there is any, shows them; brightest first."""

    stars: Stars
    b_v: Array  # (n,)
    elevation_rad: Array | None  # (n,) true elevation; None where no site on the Earth is given
    R_enu_icrs: Array | None  # (3, 3) None without a site

    @property
    def refracted(self) -> bool:
        """Whether refraction is in the directions."""
        return self.elevation_rad is not None


@dataclass(frozen=True, kw_only=True)
class Frame:
    """An exposure's sources and sky."""

    name: str
    exposure: Exposure
    time_utc: datetime
    size_px: tuple[int, int]
    detections: Detections  # fluxes in ADU; its pixel images are left out
    sky: Sky


def frame_of(exposure: Exposure, catalog: StarCatalog, site: Site | None, detector: Detector | None = None) -> Frame:
    """Detect, and put up the sky of the exposure's time. Raises BadInput no_time, TooFewStars."""
    if exposure.time_utc is None:
        raise BadInput("no_time", f"{exposure.name}: {NO_TIME}")
    found = (detector or Detector())(exposure, None)
    nothing = np.zeros((1, 1), dtype=np.float32)
    return Frame(
        name=exposure.name,
        exposure=exposure,
        time_utc=exposure.time_utc,
        size_px=exposure.size_px,
        detections=replace(found, background_e=nothing, noise_e=nothing),
        sky=sky_at(catalog, exposure.time_utc, site),
    )


def sky_at(catalog: StarCatalog, time_utc: datetime, site: Site | None) -> Sky:
    """The catalogue above a site: aberration always; on the Earth refraction, and no star lower than 3 degrees.

    Without a site there is no refraction: on the Earth it then ends up in the lens.
    """
    stars = catalog.at(time_utc, observer_velocity_m_s(site or ANYWHERE, time_utc))
    if site is None:
        return Sky(stars=stars, b_v=catalog.b_v, elevation_rad=None, R_enu_icrs=None)
    R = R_enu_icrs(site, time_utc)
    if site.body != "earth":
        return Sky(stars=stars, b_v=catalog.b_v, elevation_rad=None, R_enu_icrs=R)
    azimuth, elevation = azel_from_rays(stars.rays_icrs @ R.T)
    up = elevation > LOWEST_RAD
    shown = rays_from_azel(azimuth[up], refract_rad(elevation[up], pressure_hpa(site.height_m))) @ R
    return Sky(
        stars=replace(stars.take(up), rays_icrs=shown), b_v=catalog.b_v[up], elevation_rad=elevation[up], R_enu_icrs=R
    )


def pressure_hpa(height_m: float) -> float:
    """Average air pressure at a height above the sea."""
    return float(SEA_LEVEL_HPA * np.exp(-height_m / SCALE_HEIGHT_M))
