"""Scenes for the benchmark of the sky's light: shares of the background, errors of the map and of the lens."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from functools import lru_cache

import numpy as np

from startrack.camera import Camera
from startrack.core.types import Array, Bools
from startrack.terrain import Cylinder, HeightMap, load_terrain
from terrain import BIAS_RAD, SLOPE_ERROR_RAD, SLOPE_RAD, replace_settings

RIM_ANGLE_RAD = np.radians(80.0)  # off the axis; here the lens has the stated error
RIM_WAVES = np.arange(1, 9)  # around the crater
LENS_WAVES = np.array([2, 3, 4])  # around the image; one wave is a shift of the centre, which the attitude absorbs
SEED = 88
MAP_RADIUS_M = 4000.0
MAP_RAISED_RAD = {1.0: 0.0, 5.0: BIAS_RAD}  # true horizon above that of a map with such errors [m] of its posts
MAP_COMMON_RAD = {1.0: np.radians(0.1), 5.0: BIAS_RAD}  # stated by the file of such a map

Wave = Callable[[Array], Array]  # of angles


@dataclass(frozen=True, kw_only=True)
class UnevenCrater(Cylinder):
    """The crater with a wall that is higher by `rise_m` of the azimuth about the middle."""

    rise_m: Wave

    def horizon_rad(self, points_m: Array, azimuths_rad: Array) -> Array:
        distance = self.wall_m / np.tan(super().horizon_rad(points_m, azimuths_rad))
        east = np.asarray(points_m)[..., 0] + distance * np.sin(azimuths_rad)
        north = np.asarray(points_m)[..., 1] + distance * np.cos(azimuths_rad)
        return np.asarray(np.arctan2(self.wall_m + self.rise_m(np.arctan2(east, north)), distance))


@dataclass(frozen=True, eq=False, kw_only=True)
class RaisedMap(HeightMap):
    """A height map whose true horizon is everywhere higher by `raised_rad`."""

    raised_rad: float

    def horizon_rad(self, points_m: Array, azimuths_rad: Array) -> Array:
        return super().horizon_rad(points_m, azimuths_rad) + self.raised_rad


@dataclass(frozen=True, kw_only=True)
class BentCamera(Camera):
    """A camera whose image points are shifted by `bend`: pixels (..., 2) to shifts (..., 2) [px]."""

    bend: Callable[[Array], Array]

    def project(self, rays_cam: Array) -> tuple[Array, Bools]:
        px, inside = super().project(rays_cam)
        return px + self.bend(px), inside

    def unproject(self, px: Array) -> Array:
        return super().unproject(px - self.bend(px))


def random_wave(waves: Array, rng: np.random.Generator) -> Wave:
    """A smooth random function of an angle, of an RMS of 1: the numbers of `waves` around the circle."""
    a, b = rng.standard_normal((2, len(waves)))
    size = np.sqrt(0.5 * np.sum(a**2 + b**2))

    def wave(angle_rad: Array) -> Array:
        phase = np.multiply.outer(angle_rad, waves)
        return np.asarray((np.cos(phase) @ a + np.sin(phase) @ b) / size)

    return wave


def bend_camera(camera: Camera, error_px: float, rng: np.random.Generator) -> Camera:
    """The camera with smooth shifts along and across the radius, each of `error_px` (RMS) at the rim.

    Half of the square of those along it is the same all around, with the radius or with its third power.
    """
    rim_px = float(camera.lens.rho(np.array(RIM_ANGLE_RAD))) * camera.focal_px[0]
    sign, power = rng.choice([-1.0, 1.0]), rng.choice([1, 3])
    uneven, turned = random_wave(LENS_WAVES, rng), random_wave(LENS_WAVES, rng)

    def bend(px: Array) -> Array:
        x, y = px[..., 0] - camera.centre_px[0], px[..., 1] - camera.centre_px[1]
        r, angle = np.hypot(x, y) / rim_px, np.arctan2(y, x)
        along = error_px * (sign * r**power + r * uneven(angle)) / np.sqrt(2)
        across = error_px * r * turned(angle)
        c, s = np.cos(angle), np.sin(angle)
        return np.stack([along * c - across * s, along * s + across * c], axis=-1)

    return BentCamera(**{f.name: getattr(camera, f.name) for f in fields(camera)}, bend=bend)


def uneven_crater(crater: Cylinder, error_m: float, rng: np.random.Generator) -> Cylinder:
    """The crater with an error of the wall's height: half of the variance common to all azimuths, half smooth."""
    common, wave = rng.standard_normal(), random_wave(RIM_WAVES, rng)
    size = error_m / np.sqrt(2)
    return UnevenCrater(**vars(crater), rise_m=lambda azimuth: size * (common + wave(azimuth)))


@lru_cache
def map_of_floor() -> HeightMap:
    """The shipped Shackleton, without errors, for positions on the crater's floor."""
    shipped = load_terrain("shackleton")
    assert isinstance(shipped, HeightMap)
    return replace_settings(
        shipped, search_radius_m=MAP_RADIUS_M, most_slope_rad=SLOPE_RAD, height_sigma_m=0.0,
        horizon_sigma_common_rad=0.0,
    )  # fmt: skip


@lru_cache
def degraded_map(error_m: float) -> HeightMap:
    """The same map with such errors of its posts, which it states; see MAP_COMMON_RAD."""
    rng, true = np.random.default_rng(SEED), map_of_floor()
    maps = tuple(
        replace(m, heights_m=(m.heights_m + rng.normal(0.0, error_m, m.heights_m.shape)).astype(np.float32))
        for m in true.maps
    )
    return replace_settings(
        true, maps=maps, height_sigma_m=error_m, horizon_sigma_common_rad=MAP_COMMON_RAD[error_m],
        most_slope_rad=SLOPE_RAD + SLOPE_ERROR_RAD,
    )  # fmt: skip


def raised_map(error_m: float) -> HeightMap:
    """The true ground for the degraded map."""
    true = map_of_floor()
    return RaisedMap(**{f.name: getattr(true, f.name) for f in fields(true)}, raised_rad=MAP_RAISED_RAD[error_m])
