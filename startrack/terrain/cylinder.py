"""The thesis's crater: a vertical wall of constant height around a flat circular floor, in closed form."""

from __future__ import annotations

from copy import copy
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from startrack.declaration import Number
from startrack.frames import Site
from startrack.terrain.protocol import Terrain
from startrack.types import Array, BadInput, Bools

MAX_LENGTH_M = 1e7  # five times the Moon's radius
MAX_SHAPE_SIGMA = 0.2  # of depth and diameter; the posterior of the shape is expanded about the stated one
LENGTH = Number(low=0.0, high=MAX_LENGTH_M, above=True)
CAMERA_HEIGHT = Number(low=0.0, high=MAX_LENGTH_M)
_SIGMA = Number(low=0.0, high=MAX_LENGTH_M, description="if absent 0, with a warning")
CYLINDER_KEYS = {  # of [cylinder] in a terrain file, and of the class
    "diameter_m": replace(LENGTH, required=True),
    "depth_m": replace(LENGTH, required=True),
    "depth_sigma_m": _SIGMA,
    "diameter_sigma_m": _SIGMA,
}


@dataclass(frozen=True, kw_only=True)
class Cylinder(Terrain):
    """tan H = (depth - camera height) / d(p, a), d the distance from p along azimuth a to the circle of the rim.

    Source: Kua 2008, section 3.1 (eq. 3.1 seen from the camera's height instead of the floor). Raises BadInput
    bad_terrain for lengths that are no numbers, not positive or above 10,000 km, for a camera that is not below the
    rim, and for a `depth_sigma_m` or `diameter_sigma_m` of a fifth or more. `search_radius_m` may be infinite.
    """

    name: str = "cylinder"
    site: Site | None = None
    diameter_m: float
    depth_m: float
    camera_height_m: float = 0.0
    search_radius_m: float = np.inf
    depth_sigma_m: float = 0.0  # standard deviations; with either, the shape is estimated with the position
    diameter_sigma_m: float = 0.0
    unstated_errors: tuple[str, ...] = ()
    axisymmetric = True
    horizon_cost = 0.02

    def __post_init__(self) -> None:
        declared = {**CYLINDER_KEYS, "camera_height_m": CAMERA_HEIGHT}
        if self.search_radius_m != np.inf:
            declared["search_radius_m"] = LENGTH
        try:
            for key, kind in declared.items():
                object.__setattr__(self, key, kind.check(getattr(self, key), key))
        except ValueError as cause:
            raise BadInput("bad_terrain", str(cause)) from cause
        if self.camera_height_m >= self.depth_m:
            raise BadInput(
                "bad_terrain", f"camera_height_m is {self.camera_height_m:g}: the camera must be below the rim"
            )
        for key, size in (("depth_sigma_m", self.depth_m), ("diameter_sigma_m", self.diameter_m)):
            if getattr(self, key) >= MAX_SHAPE_SIGMA * size:
                raise BadInput("bad_terrain", f"{key} must be below {MAX_SHAPE_SIGMA * size:g} m, a fifth of it")

    @property
    def radius_m(self) -> float:
        return self.diameter_m / 2

    @property
    def rim_radius_m(self) -> float:  # type: ignore[override]
        """The wall's, to be drawn on maps."""
        return self.radius_m

    @property
    def reach_m(self) -> float:
        """The floor, or the search area and a quarter more."""
        return min(self.radius_m, 1.25 * self.search_radius_m)

    @property
    def wall_m(self) -> float:
        """Height of the rim above the camera [m]."""
        return self.depth_m - self.camera_height_m

    def horizon_rad(self, points_m: Array, azimuths_rad: Array) -> Array:
        """Horizon elevation [rad]; pi/2 from inside the wall. See `Terrain`."""
        return np.arctan2(self.wall_m, _distance_to_circle(points_m, azimuths_rad, self.radius_m))

    def horizon_bounds_rad(
        self, centres_m: Array, half_m: Array, azimuths_rad: Array, azimuth_half_rad: Array | float = 0.0
    ) -> tuple[Array, Array]:
        """Bounds of the horizon over boxes [rad], from circles grown and shrunk by the half diagonal.

        A point within r of the centre c sees the circle of radius R no nearer than c sees the one of radius R - r, and
        no farther than c sees the one of radius R + r. Over azimuths the distance grows steadily from the side that the
        point is on to the opposite one.
        """
        reach = np.sqrt(2.0) * np.asarray(half_m)
        if not np.any(azimuth_half_rad):
            nearest = _distance_to_circle(centres_m, azimuths_rad, self.radius_m - reach)
            farthest = _distance_to_circle(centres_m, azimuths_rad, self.radius_m + reach)
            return np.arctan2(self.wall_m, farthest), np.arctan2(self.wall_m, nearest)
        x, y = centres_m[..., 0], centres_m[..., 1]
        turn = np.abs((azimuths_rad - np.arctan2(x, y) + np.pi) % (2 * np.pi) - np.pi)
        off_centre = np.hypot(x, y)
        near_side = np.cos(np.maximum(turn - azimuth_half_rad, 0.0))
        far_side = np.cos(np.minimum(turn + azimuth_half_rad, np.pi))
        nearest = _chord(off_centre * near_side, off_centre, self.radius_m - reach)
        farthest = _chord(off_centre * far_side, off_centre, self.radius_m + reach)
        return np.arctan2(self.wall_m, farthest), np.arctan2(self.wall_m, nearest)

    def ground_m(self, points_m: Array) -> Array:
        """Zero: the floor is the plane z = 0."""
        return np.zeros(np.shape(points_m)[:-1])

    def allowed(self, points_m: Array) -> Bools:
        """Whether the points (..., 2) are on the floor and within reach."""
        away = np.hypot(points_m[..., 0], points_m[..., 1])
        return np.asarray((away < self.radius_m) & (away <= self.reach_m))

    @property
    def shape_sigma(self) -> tuple[float, float]:  # type: ignore[override]
        """Relative sigma of the steepness depth / diameter, and of the diameter."""
        larger = self.diameter_sigma_m / self.diameter_m
        return float(np.hypot(self.depth_sigma_m / self.depth_m, larger)), larger

    def reshaped(self, shape: Array) -> Cylinder:
        """The crater shape[0] steeper and shape[1] larger (relative)."""
        steeper, larger = float(shape[0]), float(shape[1])
        other = copy(self)  # `replace` would check it, and the search tries craters beyond the limits of a stated one
        object.__setattr__(other, "depth_m", self.depth_m * (1 + steeper) * (1 + larger))
        object.__setattr__(other, "diameter_m", self.diameter_m * (1 + larger))
        return other

    def facts(self) -> dict[str, Any]:
        """Diameter and depth, as JSON values."""
        return {"kind": "cylinder", "diameter_m": self.diameter_m, "depth_m": self.depth_m}

    def log_prior(self, shape: Array) -> float:
        """Normal priors of depth and diameter, independent of each other."""
        crater, z2 = self.reshaped(shape), 0.0
        if self.depth_sigma_m > 0:
            z2 += ((crater.depth_m - self.depth_m) / self.depth_sigma_m) ** 2
        if self.diameter_sigma_m > 0:
            z2 += ((crater.diameter_m - self.diameter_m) / self.diameter_sigma_m) ** 2
        return -0.5 * z2

    def visible_disks(self, azimuths_rad: Array, elevations_rad: Array) -> tuple[Array, float]:
        """A ray is visible from p exactly where |p + rho u| < R, rho = wall / tan e, u its horizontal direction.

        Rays at or below the horizontal are visible nowhere: their disks lie infinitely far away.
        """
        tan = np.tan(elevations_rad)
        rho = np.divide(self.wall_m, tan, out=np.full_like(tan, 1e12), where=tan > 0)
        u = np.stack([np.sin(azimuths_rad), np.cos(azimuths_rad)], axis=-1)
        return -np.minimum(rho, 1e12)[:, None] * u, self.radius_m


def _distance_to_circle(points_m: Array, azimuths_rad: Array, radius_m: Array | float) -> Array:
    """Distance from p along the azimuth to the far side of the origin's circle; 0 where there is none ahead."""
    points_m = np.asarray(points_m, dtype=np.float64)
    x, y = points_m[..., 0], points_m[..., 1]
    return _chord(x * np.sin(azimuths_rad) + y * np.cos(azimuths_rad), np.hypot(x, y), radius_m)


def _chord(along_m: Array, off_centre_m: Array, radius_m: Array | float) -> Array:
    """Distance to the circle ahead of a point `off_centre_m` from its middle, `along_m` of that in the direction."""
    inner = np.square(np.maximum(radius_m, 0.0)) - np.square(off_centre_m)
    root = np.sqrt(np.maximum(np.square(along_m) + inner, 0.0))
    # Outside the circle (inner < 0) the rim no longer surrounds the point: the wall is overhead, at distance 0.
    return np.where(inner > 0, np.maximum(root - along_m, 0.0), 0.0)
