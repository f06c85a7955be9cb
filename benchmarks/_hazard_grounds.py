"""Ground that no file describes: rims of any closed form, obstacles on no map, and maps that are wrong.

The horizons are exact and use no formula of the package for errors of a terrain's shape.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from startrack.core.types import Array
from startrack.terrain import Cylinder, ForwardingTerrain, Terrain

Curve = Callable[[Array], Array]  # of azimuths [rad]
STEPS, TURN_RAD = 40, 1e-6  # rounds of Newton's method to the wall; for the slope of its radius
NAMES = (
    "depth_1", "diameter_1", "ellipse_cos_1", "ellipse_sin_1", "rim_tilt_east_rad", "rim_tilt_north_rad",
    "bias_rad", "stretch_1", "vertical_east_rad", "vertical_north_rad",
)  # fmt: skip
WAVES = np.arange(2, 9)  # around the crater; one wave is a tilt


class Risen(ForwardingTerrain):
    """The ground with a horizon that is higher by `rise` of the azimuth."""

    def __init__(self, whole: Terrain, rise: Curve) -> None:
        super().__init__(whole)
        self.rise = rise

    def horizon_rad(self, points_m: Array, azimuths_rad: Array) -> Array:
        return np.asarray(self.whole.horizon_rad(points_m, azimuths_rad) + self.rise(azimuths_rad))


class Stretched(ForwardingTerrain):
    """The ground with the tangent of its horizon greater by `stretch_1` (relative)."""

    def __init__(self, whole: Terrain, stretch_1: float) -> None:
        super().__init__(whole)
        self.stretch_1 = stretch_1

    def horizon_rad(self, points_m: Array, azimuths_rad: Array) -> Array:
        tan = np.tan(self.whole.horizon_rad(points_m, azimuths_rad))
        return np.asarray(np.arctan((1.0 + self.stretch_1) * tan))


class SecondWall(ForwardingTerrain):
    """The ground with a second wall, as if seen from (2,) `away_m` off, over `width_rad` about `middle_rad`."""

    def __init__(self, whole: Terrain, away_m: Array, middle_rad: float, width_rad: float) -> None:
        super().__init__(whole)
        self.away_m, self.middle_rad, self.width_rad = away_m, middle_rad, width_rad

    def horizon_rad(self, points_m: Array, azimuths_rad: Array) -> Array:
        first = self.whole.horizon_rad(points_m, azimuths_rad)
        second = self.whole.horizon_rad(np.asarray(points_m) + self.away_m, azimuths_rad)
        inside = np.abs(turn(azimuths_rad, self.middle_rad)) < self.width_rad / 2
        return np.asarray(np.where(inside, np.maximum(first, second), first))


@dataclass(frozen=True)
class Rim:
    """A closed vertical wall: by the azimuth about the middle its distance, and its height above the floor [m]."""

    radius_m: Curve
    height_m: Curve


class Walled(ForwardingTerrain):
    """The floor of a crater within a `wall`."""

    def __init__(self, whole: Terrain, wall: Rim) -> None:
        super().__init__(whole)
        self.wall = wall

    def horizon_rad(self, points_m: Array, azimuths_rad: Array) -> Array:
        """By the distance to the wall along each azimuth, from Newton's method."""
        points, azimuth = np.asarray(points_m, dtype=float), np.asarray(azimuths_rad, dtype=float)
        along = points[..., 0] * np.sin(azimuth) + points[..., 1] * np.cos(azimuth)
        off2 = np.square(points).sum(axis=-1)
        distance = np.sqrt(np.maximum(np.square(along) + np.square(self.wall.radius_m(azimuth)) - off2, 1.0)) - along
        for _ in range(STEPS):
            at = points + distance[..., None] * np.stack([np.sin(azimuth), np.cos(azimuth)], axis=-1)
            away, about = np.hypot(at[..., 0], at[..., 1]), np.arctan2(at[..., 0], at[..., 1])
            radius = self.wall.radius_m(about)
            bend = (self.wall.radius_m(about + TURN_RAD) - radius) / TURN_RAD
            outward, across = np.cos(azimuth - about), np.sin(azimuth - about) / away
            step = (radius - away) / (outward - bend * across)
            distance = np.maximum(distance + step, 1e-3)
            if np.all(np.abs(step) < 1e-6):
                break
        return np.asarray(np.arctan2(self.wall.height_m(about) - self.whole.camera_height_m, distance))


def crater_with(crater: Cylinder, values: Mapping[str, float]) -> Terrain:
    """The crater with errors of its rim by their names in NAMES; others are zero."""
    known = dict.fromkeys(NAMES, 0.0) | dict(values)
    depth_m, radius_m = crater.depth_m * (1 + known["depth_1"]), crater.radius_m * (1 + known["diameter_1"])
    east, north = np.tan([known["rim_tilt_east_rad"], known["rim_tilt_north_rad"]])

    def radius(azimuth: Array) -> Array:
        cos, sin = known["ellipse_cos_1"], known["ellipse_sin_1"]
        return np.asarray(radius_m * (1 + cos * np.cos(2 * azimuth) + sin * np.sin(2 * azimuth)))

    def height(azimuth: Array) -> Array:
        return np.asarray(depth_m + radius(azimuth) * (east * np.sin(azimuth) + north * np.cos(azimuth)))

    return Walled(crater, Rim(radius, height))


def map_with(terrain: Terrain, values: Mapping[str, float]) -> Terrain:
    """A height map with errors that all azimuths share, by their names in NAMES; others are zero."""
    known = dict.fromkeys(NAMES, 0.0) | dict(values)
    east, north = known["vertical_east_rad"], known["vertical_north_rad"]

    def rise(azimuth: Array) -> Array:
        return np.asarray(known["bias_rad"] + east * np.sin(azimuth) + north * np.cos(azimuth))

    return Risen(Stretched(terrain, known["stretch_1"]), rise)


def wavy_crater(crater: Cylinder, error_m: float, rng: np.random.Generator) -> Terrain:
    """The crater with smooth random waves of its rim's height, of that RMS."""
    a, b = rng.standard_normal((2, len(WAVES)))
    size = error_m / np.sqrt(0.5 * np.sum(a**2 + b**2))

    def height(azimuth: Array) -> Array:
        phase = np.multiply.outer(azimuth, WAVES)
        return np.asarray(crater.depth_m + size * (np.cos(phase) @ a + np.sin(phase) @ b))

    return Walled(crater, Rim(lambda azimuth: np.full(np.shape(azimuth), float(crater.radius_m)), height))


def box_rise(middle_rad: float, width_rad: float, height_rad: float) -> Curve:
    """A rise of one height."""
    return lambda azimuth: np.asarray(height_rad * (np.abs(turn(azimuth, middle_rad)) < width_rad / 2))


def ridge_rise(middle_rad: float, width_rad: float, height_rad: float) -> Curve:
    """A triangular rise, highest in its middle."""

    def rise(azimuth: Array) -> Array:
        off = np.abs(turn(azimuth, middle_rad)) / (width_rad / 2)
        return np.asarray(height_rad * np.maximum(1.0 - off, 0.0))

    return rise


def turn(azimuth_rad: Array, from_rad: float) -> Array:
    """Azimuths from another one, in [-pi, pi)."""
    return np.asarray((azimuth_rad - from_rad + np.pi) % (2 * np.pi) - np.pi)
