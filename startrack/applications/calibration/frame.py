"""One exposure of a calibration: its point sources and the apparent sky; and the removal of static sources."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from datetime import datetime
from pathlib import Path

import numpy as np

from startrack.camera import Camera
from startrack.catalog import StarCatalog
from startrack.core.types import Array, BadInput, Bools, Centroids, Exposure, Stars, take_rows
from startrack.detection import Detector
from startrack.exposure import combine_masks, with_facts
from startrack.frames import (
    R_enu_icrs,
    Site,
    azel_from_rays,
    observer_velocity_m_s,
    rays_from_azel,
    refract_rad,
)
from startrack.terrain import body_of_terrain

LOWEST_RAD = np.radians(3.0)  # on the Earth; below it refraction is not predictable
SEA_LEVEL_HPA, SCALE_HEIGHT_M = 1010.0, 8430.0  # average air
DEFAULT_SITE = Site("moon", 0.0, 0.0)  # without a site; at most 0.7 arcsec of aberration off
SAME_PX = 0.7
TURNED_PX = 4.0  # motion of the sky above which a source that keeps its pixel is not a star
NO_TIME = (
    "the mid-exposure time is not known: give --time UTC, a sidecar NAME.json with time_utc, or a header with it; "
    "nothing is guessed"
)


@dataclass(frozen=True, kw_only=True)
class Sky:
    """Catalogue stars in their apparent directions, refraction included where there is air; brightest first."""

    stars: Stars
    b_v: Array  # (n,)
    elevation_rad: Array | None  # (n,) true elevation; None where no site on the Earth is given
    R_enu_icrs: Array | None  # (3, 3) None without a site

    @property
    def includes_refraction(self) -> bool:
        """Whether refraction is in the directions."""
        return self.elevation_rad is not None


@dataclass(frozen=True, kw_only=True)
class Frame:
    """An exposure with its sources and its sky."""

    name: str
    exposure: Exposure
    time_utc: datetime
    size_px: tuple[int, int]
    sources: Centroids  # fluxes in ADU
    sky: Sky


def load_frame(
    exposure: Exposure,
    catalog: StarCatalog,
    site: Site | None,
    detector: Detector | None = None,
    camera: Camera | None = None,
) -> Frame:
    """Detect the sources outside the masks of exposure and `camera`, and compute the sky at the exposure's time.

    Raises BadInput (no_time, bad_terrain of another body, or a mask that cannot be used), TooFewStars.
    """
    require_time(exposure)
    require_body(exposure, site)
    if camera is not None:
        exposure = with_facts(exposure, mask=combine_masks(exposure.mask, camera.mask, exposure.size_px))
    return frame_of(exposure, (detector or Detector())(exposure, None), catalog, site)


def require_time(exposure: Exposure) -> datetime:
    """The middle of the exposure. Raises BadInput no_time if it is not known."""
    if exposure.time_utc is None:
        raise BadInput("no_time", f"{exposure.name}: {NO_TIME}")
    return exposure.time_utc


def require_body(exposure: Exposure, site: Site | None) -> None:
    """Raise BadInput bad_terrain where the exposure names a terrain on another body than the site."""
    if site is None or exposure.terrain is None:
        return
    body = body_of_terrain(exposure.terrain)
    if body != site.body:
        raise BadInput(
            "bad_terrain",
            f"{exposure.name} names the terrain {Path(exposure.terrain).name}, which is on the {body.title()}, but the "
            f"site is on the {site.body.title()}: correct the site, or the terrain in the image's sidecar or header",
        )


def frame_of(exposure: Exposure, found: Centroids, catalog: StarCatalog, site: Site | None) -> Frame:
    """The frame of an exposure whose point sources are `found`. Raises BadInput no_time."""
    time_utc = require_time(exposure)
    return Frame(
        name=exposure.name,
        exposure=exposure,
        time_utc=time_utc,
        size_px=exposure.size_px,
        sources=Centroids(**{f.name: getattr(found, f.name) for f in fields(Centroids)}),
        sky=sky_at(catalog, time_utc, site),
    )


def sky_at(catalog: StarCatalog, time_utc: datetime, site: Site | None, lowest_rad: float = LOWEST_RAD) -> Sky:
    """The catalogue at a time and site: with aberration; on the Earth with refraction, above `lowest_rad` of elevation.

    Without a site there is no refraction: on the Earth the fitted lens then contains it.
    """
    stars = catalog.at(time_utc, observer_velocity_m_s(site or DEFAULT_SITE, time_utc))
    if site is None:
        return Sky(stars=stars, b_v=catalog.b_v, elevation_rad=None, R_enu_icrs=None)
    R = R_enu_icrs(site, time_utc)
    if site.body != "earth":
        return Sky(stars=stars, b_v=catalog.b_v, elevation_rad=None, R_enu_icrs=R)
    azimuth, elevation = azel_from_rays(stars.rays_icrs @ R.T)
    up = elevation > lowest_rad
    shown = rays_from_azel(azimuth[up], refract_rad(elevation[up], pressure_hpa(site.height_m))) @ R
    return Sky(
        stars=replace(stars.take(up), rays_icrs=shown), b_v=catalog.b_v[up], elevation_rad=elevation[up], R_enu_icrs=R
    )


def pressure_hpa(height_m: float) -> float:
    """Average air pressure at a height above the sea."""
    return float(SEA_LEVEL_HPA * np.exp(-height_m / SCALE_HEIGHT_M))


def remove_static_sources(frames: tuple[Frame, ...], R_cam_icrs: Array) -> tuple[Frame, ...]:
    """The frames without sources that keep their pixel while the sky moves: hot pixels, dust, lamps.

    `R_cam_icrs`: attitudes (frames, 3, 3).
    """
    return tuple(
        replace(frame, sources=take_rows(frame.sources, ~_is_static(i, frames, R_cam_icrs)))
        for i, frame in enumerate(frames)
    )


def has_turned(one: Array, other: Array, size_px: tuple[int, int]) -> bool:
    """Whether the sky has clearly moved in the image between two attitudes (3, 3), except near the rotation's axis."""
    between = other @ one.T
    angle = np.arctan2(np.linalg.norm(between - between.T) / np.sqrt(8.0), (np.trace(between) - 1.0) / 2.0)
    return bool(angle * max(size_px) / 4.0 > TURNED_PX)


def _is_static(i: int, frames: tuple[Frame, ...], R_cam_icrs: Array) -> Bools:
    """Whether each source (n,) of frame `i` lies at the pixel of a source of a frame whose sky has moved."""
    from scipy.spatial import cKDTree

    xy = frames[i].sources.xy_px
    static = np.zeros(len(xy), dtype=bool)
    for j, other in enumerate(frames):
        if j != i and has_turned(R_cam_icrs[i], R_cam_icrs[j], other.size_px):
            distance, _ = cKDTree(other.sources.xy_px).query(xy, distance_upper_bound=SAME_PX)
            static |= np.isfinite(distance)
    return static
