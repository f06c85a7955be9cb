"""Frames of a fixed camera below a known jagged skyline, painted without the package's renderer; a small skyline."""

from __future__ import annotations

from collections.abc import Callable
from datetime import datetime
from functools import cache

import numpy as np
from star_painter import paint

from startrack.camera import Camera
from startrack.catalog import load_catalog
from startrack.core.types import Exposure, MeasuredSkyline
from startrack.frames import R_enu_icrs, Site, azel_from_rays, observer_velocity_m_s, parse_utc, rays_from_azel

LOWELL = Site("earth", np.radians(34.7443), np.radians(-111.4223), 2361.0)
Light = Callable[[np.ndarray, np.ndarray], np.ndarray]  # by azimuth [0, 360) and elevation in degrees
SITE = Site("earth", np.radians(46.0), np.radians(7.0), 1000.0)
TIME = parse_utc("2024-10-05T21:00:00Z")
CAMERA = Camera(
    name="all-sky", size_px=(900, 900), focal_px=(270.0, 270.0), centre_px=(452.0, 447.0),
    max_angle_rad=np.radians(94.0), calibrated_angle_rad=np.radians(90.0),
)  # fmt: skip
R_CAM_ENU = np.array([[-1.0, 0, 0], [0, -1.0, 0], [0, 0, 1.0]])  # looks at the zenith, image top to the north
PRESSURE_HPA = 1010.0 * np.exp(-1000.0 / 8430.0)
PSF_PX, PEDESTAL, SKY, GROUND, READ_NOISE = 0.9, 300.0, 400.0, 60.0, 8.0
ZERO_MAG, EXTINCTION_MAG = 14.5, 0.2
# Clouds before the sky: azimuths from and to, elevations of the lower and the upper edge, in degrees.
CLOUDS_DEG = ((15, 75, 4, 12), (135, 195, 4, 13), (205, 255, 4, 15), (265, 300, 4, 11), (310, 350, 4, 14))
CLOUD_PART, MOONLIT_GROUND = 0.6, 170.0  # of the sky's light that a cloud shows; the ground's light in moonlight


def bennett_rad(true_rad: np.ndarray) -> np.ndarray:
    """Apparent elevations by Bennett (1982), J. Navigation 35, 255, as in Meeus (1998), chapter 16, at 10 C."""
    lift_arcmin = np.zeros_like(true_rad)
    start_deg = np.degrees(np.maximum(true_rad, np.radians(-1.0)))
    for _ in range(12):
        h = start_deg + lift_arcmin / 60.0
        lift_arcmin = PRESSURE_HPA / 1010.0 / np.tan(np.radians(h + 7.31 / (h + 4.4)))
    return true_rad + np.radians(lift_arcmin / 60.0)


def skyline_deg(azimuth_deg: np.ndarray) -> np.ndarray:
    """Hills, a tree line of teeth, and a dome with vertical walls."""
    hills = 6.0 + 2.0 * np.sin(np.radians(3 * azimuth_deg))
    teeth = np.where((azimuth_deg > 200) & (azimuth_deg < 260), 3.0 * np.abs((azimuth_deg / 5) % 2 - 1), 0.0)
    return np.where((azimuth_deg > 100) & (azimuth_deg < 125), 20.0, hills + teeth)


def cloud_part(azimuth_deg: np.ndarray, elevation_deg: np.ndarray) -> np.ndarray:
    """Part of the sky's light that is seen in a direction, behind CLOUDS_DEG or beside them."""
    part = np.ones(azimuth_deg.shape)
    for first, last, low, high in CLOUDS_DEG:
        inside = (azimuth_deg > first) & (azimuth_deg < last) & (elevation_deg > low) & (elevation_deg < high)
        part[inside] = CLOUD_PART
    return part


@cache
def _quarters() -> list[tuple[np.ndarray, ...]]:
    """Azimuth [0, 360) and elevation in degrees of the quarters of all pixels; whether they see the sky, are lit."""
    width, height = CAMERA.size_px
    found = []
    for dx in (-0.25, 0.25):
        for dy in (-0.25, 0.25):
            x, y = np.meshgrid(np.arange(width) + dx, np.arange(height) + dy)
            px = np.stack([x, y], axis=-1)
            azimuth, elevation = azel_from_rays(CAMERA.unproject(px) @ R_CAM_ENU)
            is_sky = np.degrees(elevation) > skyline_deg(np.degrees(azimuth))
            lit = CAMERA.angle_rad(px) < CAMERA.max_angle_rad
            found.append((np.degrees(azimuth) % 360, np.degrees(elevation), is_sky, lit))
    return found


def painted_frame(
    seed: int = 1, time_utc: datetime = TIME, with_stars: bool = True, with_clouds: bool = False,
    ground: Light | None = None, sky: Light | None = None, faintest_mag: float = 7.5,
) -> Exposure:  # fmt: skip
    """An exposure: the sky with its stars, refracted and dimmed, above the skyline; without stars it is overcast.

    Where there are clouds, they hide stars and the Moon lights the ground. `ground` and `sky` are other lights.
    """
    usual = MOONLIT_GROUND if with_clouds else GROUND
    rng = np.random.default_rng(seed)
    width, height = CAMERA.size_px
    light = np.full((height, width), PEDESTAL)
    for azimuth_deg, elevation_deg, is_sky, lit in _quarters():
        place = azimuth_deg, elevation_deg
        clear = SKY if sky is None else sky(*place)
        above = clear * cloud_part(*place) if with_clouds else clear
        below = usual if ground is None else ground(*place)
        light += np.where(lit, np.where(is_sky, above, below), 0.0) / 4
    if with_stars:
        _paint_stars(light, time_utc, with_clouds, faintest_mag)
    light += rng.normal(size=light.shape) * np.sqrt(light + READ_NOISE**2)
    return Exposure(pixels_adu=light.astype(np.float32), name=f"frame-{seed}", time_utc=time_utc, exposure_s=30.0)


def _paint_stars(light: np.ndarray, time_utc: datetime, with_clouds: bool, faintest_mag: float) -> None:
    stars = load_catalog().at(time_utc, observer_velocity_m_s(SITE, time_utc))
    azimuth, elevation = azel_from_rays(stars.rays_icrs @ R_enu_icrs(SITE, time_utc).T)
    elevation = bennett_rad(elevation)
    up = (np.degrees(elevation) > skyline_deg(np.degrees(azimuth))) & (stars.v_mag < faintest_mag)
    if with_clouds:
        up &= cloud_part(np.degrees(azimuth) % 360, np.degrees(elevation)) == 1.0
    xy, inside = CAMERA.project(rays_from_azel(azimuth[up], elevation[up]) @ R_CAM_ENU.T)
    air = 1.0 / (np.sin(elevation[up]) + 0.025 * np.exp(-11 * np.sin(elevation[up])))
    flux = 10 ** (-0.4 * (stars.v_mag[up] + EXTINCTION_MAG * air - ZERO_MAG))
    paint(light, xy[inside], flux[inside], PSF_PX)


def small_skyline() -> MeasuredSkyline:
    """Rising from north to north, unknown at three azimuths."""
    elevation = np.radians(np.linspace(1.0, 10.0, 360))
    elevation[[0, 5, 6]] = np.nan
    return MeasuredSkyline(
        azimuth_rad=np.radians(np.arange(360.0)),
        elevation_rad=elevation,
        sigma_rad=np.where(np.isnan(elevation), np.inf, np.radians(0.1)),
        source=np.where(np.isnan(elevation), "", "both"),
    )
