"""The scene to render, and the truth about the rendered exposure."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime
from functools import cached_property

import numpy as np

from startrack.camera import Camera, Sensor
from startrack.core.types import Array, BadInput, Body, Bools, Ints, Stars, Value, array, rotation, vector
from startrack.frames import airmass, azel_from_rays
from startrack.terrain import GroundBrightness, Terrain

AZIMUTHS = 1 << 16  # of the skyline: 0.0055 degrees, a sixteenth of a pixel of the widest fisheye


@dataclass(frozen=True, kw_only=True)
class HotPixels(Value):
    """Pixels of one sensor whose dark current is far above the rest: the same ones in each of its exposures."""

    xy_px: Ints = array("n", 2, dtype=np.int64)  # column, row
    dark_e_per_s: Array = array("n")  # beyond the sensor's own


NO_HOT_PIXELS = HotPixels(xy_px=np.empty((0, 2), dtype=np.int64), dark_e_per_s=np.empty(0))


@dataclass(frozen=True, kw_only=True)
class Scene(Value):
    """Everything that determines an exposure, except the noise of photons and electronics."""

    camera: Camera  # with a sensor
    terrain: Terrain | None  # None: nothing hides the stars
    stars: Stars  # apparent, with the magnitudes that the catalogue states
    v_error_mag: Array = array("n")  # true minus stated magnitude of each star
    bodies: tuple[Body, ...] = ()
    position_enu_m: Array = vector()  # the camera's centre
    R_cam_enu: Array = rotation()
    R_enu_icrs: Array = rotation()  # at mid-exposure
    sky_rotvec_rad: Array = vector(default=0.0)  # rotation vector in enu of the stars from start to end
    exposure_s: float
    extinction_mag: float = 0.0  # by which the air dims stars and bodies, per airmass; 0: no air
    sky_v_mag_arcsec2: float | None  # diffuse light of the sky per square arcsecond; None: a black sky
    sky_gradient: float  # s: the sky is 1 + s cos(elevation) cos(azimuth - sky_gradient_azimuth_rad) of that
    sky_gradient_azimuth_rad: float
    ground_brightness: GroundBrightness
    hot_pixels: HotPixels = NO_HOT_PIXELS
    cosmic_rays: int  # tracks in this exposure
    name: str = ""
    time_utc: datetime | None = None  # mid-exposure
    camera_ref: str | None = None  # how the exposure's metadata name the camera and the terrain
    terrain_ref: str | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if len(self.v_error_mag) != len(self.stars):
            raise ValueError(f"Scene.v_error_mag: {len(self.v_error_mag)} values for {len(self.stars)} stars")
        if not (np.isfinite(self.exposure_s) and self.exposure_s > 0):
            raise ValueError(f"Scene.exposure_s must be positive, not {self.exposure_s!r}")

    @property
    def sensor(self) -> Sensor:
        """The camera's sensor. Raises BadInput bad_calibration where the camera file names none."""
        if self.camera.sensor is None:
            raise BadInput("bad_calibration", f"camera {self.camera.name} has no [sensor]: nothing to render with")
        return self.camera.sensor

    def dimmed_mag(self, v_mag: Array, rays_enu: Array) -> Array:
        """Magnitudes (n,) of sources of `v_mag` (n,) in apparent directions `rays_enu` (n, 3), below the air."""
        if self.extinction_mag == 0.0:
            return v_mag
        return np.asarray(v_mag + self.extinction_mag * airmass(azel_from_rays(rays_enu)[1]))

    @property
    def R_cam_icrs(self) -> Array:
        """Rotation (3, 3) from icrs to the camera at mid-exposure."""
        return self.R_cam_enu @ self.R_enu_icrs

    def horizon_rad(self, azimuths_rad: Array) -> Array:
        """Horizon elevation (n,) [rad] at `azimuths_rad` (n,): the same bits whether or not a table is prepared.

        Raises ValueError for a scene without terrain.
        """
        if self.terrain is None:
            raise ValueError("a scene without terrain has no horizon")
        return np.asarray(self.terrain.without_table().horizon_rad(self.position_enu_m[:2], azimuths_rad))

    @cached_property
    def skyline_rad(self) -> tuple[Array, Array]:
        """Azimuths from 0 to 2 pi, both ends included, and the horizon of the terrain there [rad]."""
        azimuths = np.linspace(0.0, 2 * np.pi, AZIMUTHS + 1)
        horizon = self.horizon_rad(azimuths[:-1])
        return azimuths, np.append(horizon, horizon[0])


@dataclass(frozen=True, kw_only=True)
class Truth(Value):
    """The truth for comparisons; no stage reads it. One row per light source inside the image circle and frame."""

    position_enu_m: Array = vector()
    R_cam_enu: Array = rotation()
    R_cam_icrs: Array = rotation()  # at mid-exposure
    sources: Stars  # stars and bodies, as the catalogue states them
    xy_px: Array = array("n", 2)  # at mid-exposure, hidden or not
    flux_e: Array = array("n")  # whole PSF, from the stated magnitude [electrons]
    hidden: Bools = array("n", dtype=np.bool_)  # the terrain hides it at mid-exposure
