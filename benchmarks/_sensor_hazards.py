"""Hazards of the ground, the lens and the sensor: ridge, bright wall, noise, dark, blur; no file states them."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from _sky_view import Rng, View, draw, smooth_noise, turn

from startrack.camera import Camera
from startrack.core.types import Array
from startrack.rendering import Scene
from startrack.terrain import Cylinder, GroundBrightness

EIGHT_BITS = {"gain_e_per_adu": 4.0, "bias_adu": 12.0, "saturation_adu": 255.0}


@dataclass(frozen=True, kw_only=True)
class Ridged(Cylinder):
    """The crater with a ridge on no map: `height_rad` above the crater's own horizon, triangular."""

    azimuth_rad: float
    width_rad: float
    height_rad: float

    def horizon_rad(self, points_m: Array, azimuths_rad: Array) -> Array:
        off = np.abs(turn(azimuths_rad, self.azimuth_rad)) / (self.width_rad / 2)
        return super().horizon_rad(points_m, azimuths_rad) + self.height_rad * np.maximum(1 - off, 0.0)


def flat_field(view: View, rng: Rng) -> Array:
    """Sensitivities that differ by 1 %, from pixel to pixel or smoothly."""
    shape = view.part.shape
    unlike = rng.standard_normal(shape) if rng.random() < 0.5 else smooth_noise(shape, int(rng.uniform(30, 250)), rng)
    return view.light_e * (1 + 0.01 * unlike)


def uneven_dark(view: View, rng: Rng) -> Array:
    """Dark current with a gradient, or the glow of an amplifier in a corner; added to the light."""
    height, width = view.part.shape
    y, x = np.mgrid[:height, :width]
    if rng.random() < 0.5:
        slope = 25 * rng.uniform(0.4, 1.2) / width
        return view.light_e + 25 + slope * (x * rng.uniform(-1, 1) + y * rng.uniform(-1, 1))
    corner = np.hypot(x - width * rng.integers(2), y - height * rng.integers(2))
    return view.light_e + draw(30, 600, rng) * np.exp(-corner / rng.uniform(150, 500))


def bright_wall(scene: Scene, rng: Rng) -> Scene:
    """A wall that reflects 20 to 60 % of the sky's light."""
    return replace(scene, ground_brightness=GroundBrightness.of(rng.uniform(0.2, 0.6)))


def low_ridge(scene: Scene, rng: Rng) -> Scene:
    """A ridge on no map, 10 to 60 degrees wide and 0.2 to 1 degree high."""
    assert isinstance(scene.terrain, Cylinder)
    width, height = np.radians([draw(10, 60, rng), draw(0.2, 1, rng)])
    ridge = {"azimuth_rad": rng.uniform(0, 2 * np.pi), "width_rad": width, "height_rad": height}
    return replace(scene, terrain=Ridged(**{**vars(scene.terrain), **ridge}))


def blurred(scene: Scene, rng: Rng) -> Scene:
    """A PSF of 1.5 to 2 px that the camera file does not state."""
    return with_sensor(scene, psf_sigma_px=rng.uniform(1.5, 2.0))


def eight_bits(scene: Scene, rng: Rng) -> Scene:
    """Pixels of 8 bits, with steps of 4 electrons."""
    return with_sensor(scene, **EIGHT_BITS)


def narrow_lens(scene: Scene, rng: Rng) -> Scene:
    """An image circle that ends near the skyline."""
    assert scene.terrain is not None
    lowest = float(np.min(scene.terrain.horizon_rad(scene.position_enu_m[:2], np.linspace(0, 2 * np.pi, 360))))
    angle = np.clip(np.pi / 2 - lowest + np.radians(rng.uniform(-6, 4)), np.radians(62), np.radians(92))
    return replace(scene, camera=replace(scene.camera, max_angle_rad=angle, calibrated_angle_rad=angle))


def state_edge(camera: Camera, scene: Scene, rng: Rng) -> Camera:
    """A camera file that states the image circle, or one 1.5 degrees wider."""
    angle = scene.camera.max_angle_rad + rng.choice([0.0, np.radians(1.5)])
    return replace(camera, max_angle_rad=angle, calibrated_angle_rad=angle)


def state_eight_bits(camera: Camera, scene: Scene, rng: Rng) -> Camera:
    """The camera file of the sensor with 8 bits."""
    return scene.camera


def correlated_noise(shape: tuple[int, ...], rng: Rng) -> Array:
    """Noise of 2 to 8 e that is as smooth as the PSF."""
    noise = cv2.GaussianBlur(rng.standard_normal(shape), (0, 0), rng.uniform(0.8, 2.0))
    return np.asarray(rng.uniform(2, 8) * noise / noise.std())


def rows_and_columns(shape: tuple[int, ...], rng: Rng) -> Array:
    """An offset of each row or column, or both, of 1 to 3 e."""
    rows, columns = [(1, 0), (0, 1), (1, 1)][rng.integers(3)]
    pattern = rows * rng.standard_normal((shape[0], 1)) + columns * rng.standard_normal((1, shape[1]))
    return np.asarray(rng.uniform(1, 3) * pattern)


def with_sensor(scene: Scene, **changes: float) -> Scene:
    """The scene with another sensor."""
    return replace(scene, camera=replace(scene.camera, sensor=replace(scene.sensor, **changes)))
