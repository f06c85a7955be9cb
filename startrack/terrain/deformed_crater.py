"""A crater like the thesis's with an elliptic, tilted rim, exactly; and, to first order, what each error changes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from startrack.core.types import Array, Bools
from startrack.frames import Site
from startrack.terrain.circle import distance_bounds, distance_to_circle
from startrack.terrain.protocol import Terrain

HALVINGS = 60  # of the range of distances: to the last digit of a length


@dataclass(frozen=True, kw_only=True)
class DeformedCrater(Terrain):
    """A vertical wall about a flat floor, with the rim at the radius R (1 + c cos 2 phi + s sin 2 phi).

    phi is the azimuth of a point of the rim seen from the axis. The rim stands at depth + R (e sin phi + n cos phi)
    above the floor. Ellipse and tilt are small: the wall surrounds the axis.
    """

    name: str = "deformed crater"
    site: Site | None = None
    diameter_m: float
    depth_m: float
    camera_height_m: float = 0.0
    search_radius_m: float = np.inf
    ellipse_cos_1: float = 0.0  # c
    ellipse_sin_1: float = 0.0  # s
    rim_tilt_east_rad: float = 0.0  # e
    rim_tilt_north_rad: float = 0.0  # n
    horizon_cost = 0.2

    @property
    def radius_m(self) -> float:
        """Of the round rim, R."""
        return self.diameter_m / 2

    @property
    def rim_radius_m(self) -> float:  # type: ignore[override]
        """The round wall's, to be drawn on maps."""
        return self.radius_m

    @property
    def reach_m(self) -> float:
        """The floor, or the search area and a quarter more."""
        return float(min(self._radii_m[1], 1.25 * self.search_radius_m))

    @property
    def _radii_m(self) -> tuple[float, float]:
        """Least and greatest radius of the rim [m]."""
        ellipse = float(np.hypot(self.ellipse_cos_1, self.ellipse_sin_1))
        return self.radius_m * (1.0 - ellipse), self.radius_m * (1.0 + ellipse)

    def rim_m(self, points_m: Array) -> tuple[Array, Array]:
        """Radius and height above the floor (...), (...) [m] of the rim on the side of the points (..., 2)."""
        around = np.arctan2(points_m[..., 0], points_m[..., 1])
        radius = 1.0 + self.ellipse_cos_1 * np.cos(2 * around) + self.ellipse_sin_1 * np.sin(2 * around)
        raised = self.rim_tilt_east_rad * np.sin(around) + self.rim_tilt_north_rad * np.cos(around)
        return self.radius_m * radius, self.depth_m + self.radius_m * raised

    def horizon_rad(self, points_m: Array, azimuths_rad: Array) -> Array:
        """Horizon elevation [rad]; pi/2 from inside the wall. See `Terrain`."""
        points = np.asarray(points_m, dtype=np.float64)
        distance = self._distance_m(points, azimuths_rad)
        height = self.rim_m(_ahead(points, distance, azimuths_rad))[1]
        return np.arctan2(height - self.camera_height_m, distance)

    def _distance_m(self, points: Array, azimuths_rad: Array) -> Array:
        """Distance to the rim, halved in between the circles that lie wholly within and wholly outside of it."""
        near = distance_to_circle(points, azimuths_rad, self._radii_m[0])
        far = distance_to_circle(points, azimuths_rad, self._radii_m[1])
        for _ in range(HALVINGS if np.any(far > near) else 0):
            middle = 0.5 * (near + far)
            within = self._is_within(_ahead(points, middle, azimuths_rad))
            near, far = np.where(within, middle, near), np.where(within, far, middle)
        return np.where(self._is_within(points), 0.5 * (near + far), 0.0)

    def _is_within(self, points_m: Array) -> Bools:
        return np.asarray(np.hypot(points_m[..., 0], points_m[..., 1]) < self.rim_m(points_m)[0])

    def horizon_bounds_rad(
        self, centres_m: Array, half_m: Array, azimuths_rad: Array, azimuth_half_rad: Array | float = 0.0
    ) -> tuple[Array, Array]:
        """Bounds [rad] from the circles and the heights between which the rim lies; see `Terrain`."""
        near, far = distance_bounds(centres_m, half_m, azimuths_rad, azimuth_half_rad, *self._radii_m)
        wall = self.depth_m - self.camera_height_m
        raised = self.radius_m * float(np.hypot(self.rim_tilt_east_rad, self.rim_tilt_north_rad))
        low, high = wall - raised, wall + raised
        return np.arctan2(low, far if low > 0 else near), np.arctan2(high, near if high > 0 else far)

    def ground_m(self, points_m: Array) -> Array:
        """Zero: the floor is the plane z = 0."""
        return np.zeros(np.shape(points_m)[:-1])

    def allowed(self, points_m: Array) -> Bools:
        """Whether the points (..., 2) are on the floor and within reach."""
        points = np.asarray(points_m, dtype=np.float64)
        return self._is_within(points) & (np.hypot(points[..., 0], points[..., 1]) <= self.reach_m)

    def facts(self) -> dict[str, Any]:
        """Diameter, depth, ellipse and tilt, as JSON values."""
        names = ("diameter_m", "depth_m", "ellipse_cos_1", "ellipse_sin_1", "rim_tilt_east_rad", "rim_tilt_north_rad")
        return {"kind": "deformed crater", **{name: getattr(self, name) for name in names}}


def slopes_of_round_crater(
    points_m: Array, azimuths_rad: Array, *, radius_m: float, depth_m: float, camera_height_m: float
) -> dict[str, Array]:
    """Change (...) of the horizon [rad] by one unit of each error of a round crater, by the error's name.

    With d the distance to the rim, w its height above the camera and q its point there: tan H = w / d; where the rim
    moves outward by x, d grows by x R / (u q), u the direction (u q = R cos of the angle to the wall's normal). Zero
    from inside the wall.
    """
    points = np.asarray(points_m, dtype=np.float64)
    wall = depth_m - camera_height_m
    distance = distance_to_circle(points, azimuths_rad, radius_m)
    rim = _ahead(points, distance, azimuths_rad)
    east, north = rim[..., 0] / radius_m, rim[..., 1] / radius_m
    facing = np.maximum(east * np.sin(azimuths_rad) + north * np.cos(azimuths_rad), 1e-12)
    per_tan_m = np.where(distance > 0, 1.0 / (np.square(distance) + wall**2), 0.0)  # cos^2 H / d^2
    raised, outward = distance * per_tan_m, -wall * radius_m / facing * per_tan_m
    return {
        "depth_1": depth_m * raised,
        "diameter_1": outward,
        "ellipse_cos_1": outward * (np.square(north) - np.square(east)),
        "ellipse_sin_1": outward * 2.0 * east * north,
        "rim_tilt_east_rad": radius_m * east * raised,
        "rim_tilt_north_rad": radius_m * north * raised,
        "camera_height_m": -raised,
    }


def _ahead(points: Array, distance: Array, azimuths_rad: Array) -> Array:
    """The points (..., 2) that lie at the distances (...) along the azimuths."""
    return np.stack(
        [points[..., 0] + distance * np.sin(azimuths_rad), points[..., 1] + distance * np.cos(azimuths_rad)], axis=-1
    )
