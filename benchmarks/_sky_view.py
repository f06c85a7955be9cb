"""An exposure with a hazard: the renderer's light, changed by a function of what each pixel looks at."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from datetime import timedelta

import cv2
import numpy as np

from startrack.camera import Camera
from startrack.core.types import Array, Exposure
from startrack.frames import azel_from_rays
from startrack.rendering import Scene, Truth, truth_of
from startrack.rendering.compose import ADC_MAX_ADU, add_cosmic_rays, add_hot_pixels, read_out
from startrack.rendering.sky import diffuse_e
from startrack.rendering.sources import add_sources
from startrack.terrain import Terrain

HORIZON_SAMPLES = 1 << 14
Rng = np.random.Generator


@dataclass(frozen=True, eq=False)
class View:
    """Fields (H, W) over the pixels of a scene."""

    scene: Scene
    azimuth_rad: Array
    elevation_rad: Array
    above_rad: Array  # elevation above the skyline
    angle_rad: Array  # off the axis
    turn_rad: Array  # around the image's centre
    sky_e: Array  # diffuse light of the sky if nothing hid it
    part: Array  # of it that is seen: 0 on the wall, 1 above the skyline
    stars_e: Array

    @classmethod
    def of(cls, scene: Scene) -> View:
        """All fields of a `scene` with a terrain."""
        assert scene.terrain is not None
        camera = scene.camera
        px = np.stack(np.meshgrid(*(np.arange(n, dtype=float) for n in camera.size_px)), axis=-1)
        azimuth, elevation = azel_from_rays(camera.unproject(px) @ scene.R_cam_enu)
        around = np.linspace(0.0, 2 * np.pi, HORIZON_SAMPLES)
        wall = scene.ground_brightness(azimuth)
        horizon = np.interp(azimuth % (2 * np.pi), around, scene.terrain.horizon_rad(scene.position_enu_m[:2], around))
        open_sky = replace(scene, terrain=None, sky_v_mag_arcsec2=scene.sky_v_mag_arcsec2 or 22.0)
        sky, stars = diffuse_e(open_sky), np.zeros(azimuth.shape)
        add_sources(stars, scene)
        seen = np.divide(diffuse_e(scene), sky, out=np.zeros_like(sky), where=sky > 0)
        return cls(
            scene=scene, azimuth_rad=azimuth, elevation_rad=elevation, above_rad=elevation - horizon,
            angle_rad=camera.angle_rad(px), sky_e=sky, part=np.clip((seen - wall) / (1 - wall), 0, 1), stars_e=stars,
            turn_rad=np.arctan2(px[..., 1] - camera.centre_px[1], px[..., 0] - camera.centre_px[0]),
        )  # fmt: skip

    @property
    def light_e(self) -> Array:
        """All light, without a hazard."""
        return self.with_sky(1.0)

    @property
    def inside(self) -> Array:
        """1 in the image circle, 0 outside."""
        return np.asarray(self.angle_rad < self.scene.camera.max_angle_rad, dtype=float)

    def with_sky(self, factor: Array | float, stars: Array | float = 1.0) -> Array:
        """All light, that of the sky above the skyline multiplied by a `factor`, that of the stars by `stars`."""
        wall = self.scene.ground_brightness(self.azimuth_rad)
        return np.asarray(stars * self.stars_e + self.sky_e * (wall + (1 - wall) * self.part * factor))

    def distance_rad(self, angle_rad: float, turn_rad: float) -> Array:
        """From the image's point at `angle_rad` off the axis and `turn_rad` around the centre [focal lengths]."""
        rho, rho0 = self.scene.camera.lens.rho(self.angle_rad), float(self.scene.camera.lens.rho(np.array(angle_rad)))
        return np.sqrt(np.maximum(rho**2 + rho0**2 - 2 * rho * rho0 * np.cos(self.turn_rad - turn_rad), 0.0))


@dataclass(frozen=True)
class Hazard:
    """One kind of trouble: functions of what they change and of a generator; most of them change nothing."""

    light: Callable[[View, Rng], Array] = lambda view, rng: view.light_e
    scene: Callable[[Scene, Rng], Scene] = lambda scene, rng: scene
    noise_e: Callable[[tuple[int, ...], Rng], Array | float] = lambda shape, rng: 0.0
    pixels: Callable[[Array, View, Rng], Array] = lambda frame, view, rng: frame  # [ADU], of the frame as recorded
    stated: Callable[[Camera, Scene, Rng], Camera] = lambda camera, scene, rng: camera  # the camera file
    terrain: Callable[[Terrain, Rng], Terrain] = lambda terrain, rng: terrain  # the terrain file
    clock_s: Callable[[Rng], float] = lambda rng: 0.0  # stated time minus the true one


def expose(scene: Scene, hazard: Hazard, rng: Rng) -> tuple[Exposure, Truth, Camera]:
    """The exposure of a scene with a hazard, as `startrack.rendering.render` makes it; the truth; the camera file."""
    given, scene = scene.camera, hazard.scene(scene, rng)
    view = View.of(scene)
    electrons = hazard.light(view, rng)
    electrons += scene.sensor.dark_e_per_s * scene.exposure_s
    add_hot_pixels(electrons, scene.hot_pixels, scene.exposure_s)
    add_cosmic_rays(electrons, scene.cosmic_rays, rng=rng)
    sensor = scene.sensor
    pixels = read_out(electrons, sensor, rng=rng) + hazard.noise_e(electrons.shape, rng) / sensor.gain_e_per_adu
    recorded = np.rint(np.clip(pixels, 0, sensor.saturation_adu))
    changed = np.clip(np.rint(hazard.pixels(recorded, view, rng)), 0, ADC_MAX_ADU)
    exposure = Exposure(
        pixels_adu=np.ascontiguousarray(changed, dtype=np.float32), name=scene.name,
        time_utc=scene.time_utc + timedelta(seconds=hazard.clock_s(rng)), exposure_s=scene.exposure_s,
        saturation_adu=min(sensor.saturation_adu, ADC_MAX_ADU),
    )  # fmt: skip
    return exposure, truth_of(scene), hazard.stated(given, scene, rng)


def turn(azimuth_rad: Array, from_rad: float) -> Array:
    """Azimuths from another one, in [-pi, pi)."""
    return np.asarray((azimuth_rad - from_rad + np.pi) % (2 * np.pi) - np.pi)


def draw(low: float, high: float, rng: Rng) -> float:
    """A random number between two, even in its logarithm."""
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


def smooth_noise(shape: tuple[int, ...], cell_px: int, rng: Rng) -> Array:
    """Noise (H, W) of an RMS of 1, smooth over cells of that size."""
    coarse = rng.standard_normal([n // cell_px + 4 for n in shape])
    smooth = cv2.resize(coarse, shape[::-1], interpolation=cv2.INTER_CUBIC)
    return np.asarray(smooth / smooth.std())
