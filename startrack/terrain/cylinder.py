"""Craters with a vertical wall about a flat floor, in closed form: the thesis's round one, and a deformed one."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from startrack.core.declaration import Flag, Table
from startrack.core.types import Array, BadInput, Bools
from startrack.frames import Site
from startrack.kernels.library import kernel
from startrack.terrain.protocol import Rim, Terrain, TerrainFile, with_refraction_error
from startrack.terrain.shape import (
    AMOUNT,
    CAMERA_ERROR,
    CYLINDER_FACTS,
    DEPTH,
    DIAMETER,
    ELLIPSE,
    EXACT,
    LENGTH,
    RIM_TILT,
    GroundErrors,
    ShapeError,
    errors_by_name,
    radians,
    refraction_errors,
    refraction_slopes_rad,
    select_slopes,
)

HALVINGS = 60  # of the range of distances: to the last digit of a length
MAX_SHAPE_SIGMA = 0.5  # of depth and diameter; beyond, a normal distribution holds sizes below 0
LINEAR_SHAPE_1 = 0.05  # of depth over diameter: beyond, the shape that the rows show is searched, as it is not linear
_SIZES = {"diameter_m": replace(LENGTH, required=True), "depth_m": replace(LENGTH, required=True)}
CYLINDER_TABLE = Table(description="Axis through the origin; floor at z = 0.", keys={
    **_SIZES,
    "exact": Flag(description="true: a model, without errors of its shape"),
    **{fact.key: fact.limits for fact in CYLINDER_FACTS},
})  # fmt: skip
_SIGMAS = {
    **{fact.key: fact.limits for fact in (DEPTH, DIAMETER, ELLIPSE, CAMERA_ERROR)},
    "rim_tilt_sigma_rad": replace(RIM_TILT.limits, high=float(np.radians(RIM_TILT.limits.high))),
}


def distance_to_circle(points_m: Array, azimuths_rad: Array, radius_m: Array | float) -> Array:
    """Distance (...) from points (..., 2) along azimuths to the far side of the origin's circle; 0: none ahead."""
    points_m = np.asarray(points_m, dtype=np.float64)
    x, y = points_m[..., 0], points_m[..., 1]
    return chord(x * np.sin(azimuths_rad) + y * np.cos(azimuths_rad), np.hypot(x, y), radius_m)


def chord(along_m: Array, off_centre_m: Array, radius_m: Array | float) -> Array:
    """Distance (...) [m] to a circle ahead of a point `off_centre_m` off its middle, `along_m` of it along the ray."""
    inner = np.square(np.maximum(radius_m, 0.0)) - np.square(off_centre_m)
    root = np.sqrt(np.maximum(np.square(along_m) + inner, 0.0))
    # Outside the circle (inner < 0) the rim no longer surrounds the point: the wall is overhead, at distance 0.
    return np.where(inner > 0, np.maximum(root - along_m, 0.0), 0.0)


def distance_bounds(
    centres_m: Array, half_m: Array, azimuths_rad: Array, azimuth_half_rad: Array | float,
    least_radius_m: float, greatest_radius_m: float,
) -> tuple[Array, Array]:  # fmt: skip
    """Least and greatest distance (...) [m] to a rim between two circles, over boxes and azimuths as in `Terrain`.

    A point within r of the centre c sees the circle of radius R no nearer than c sees the one of radius R - r, and no
    farther than c sees the one of radius R + r. Over azimuths the distance grows steadily from the side that the point
    is on to the opposite one.
    """
    reach = np.sqrt(2.0) * np.asarray(half_m)
    if not np.any(azimuth_half_rad):
        nearest = distance_to_circle(centres_m, azimuths_rad, least_radius_m - reach)
        return nearest, distance_to_circle(centres_m, azimuths_rad, greatest_radius_m + reach)
    x, y, sine, cosine = centres_m[..., 0], centres_m[..., 1], np.sin(azimuths_rad), np.cos(azimuths_rad)
    along, across = x * sine + y * cosine, np.abs(x * cosine - y * sine)
    half = np.minimum(azimuth_half_rad, np.pi)
    off_centre, turn, turned = np.hypot(x, y), np.cos(half), np.sin(half)
    side = off_centre * turn
    most_along = np.where(along >= side, off_centre, along * turn + across * turned)
    least_along = np.where(along <= -side, -off_centre, along * turn - across * turned)
    nearest = chord(most_along, off_centre, least_radius_m - reach)
    return nearest, chord(least_along, off_centre, greatest_radius_m + reach)


@dataclass(frozen=True, kw_only=True)
class Crater(Terrain):
    """A flat floor, z = 0, within a vertical wall about the origin. The search area may be infinite."""

    name: str = "crater"
    site: Site | None = None
    diameter_m: float
    depth_m: float
    camera_height_m: float = Terrain.camera_height_m
    search_radius_m: float = np.inf

    @property
    def radius_m(self) -> float:
        """Radius [m] of the rim, or of the round rim that a deformed one differs from."""
        return self.diameter_m / 2

    @property
    def rim(self) -> Rim:  # type: ignore[override]
        """Rim at the top of the wall."""
        return Rim(self.radius_m, self.wall_m)

    @property
    def radii_m(self) -> tuple[float, float]:
        """Least and greatest radius of the rim [m]."""
        return self.radius_m, self.radius_m

    @property
    def reach_m(self) -> float:
        """Radius [m] about the origin in which a camera may stand: the floor's, or 1.25 of the search area's."""
        return float(min(self.radii_m[1], super().reach_m))

    @property
    def wall_m(self) -> float:
        """Height of the rim above the camera [m], that of the middle of a tilted one."""
        return self.depth_m - self.camera_height_m

    def rim_m(self, points_m: Array) -> tuple[Array | float, Array | float]:
        """Radius and height above the floor (...), (...) [m] of the rim on the side of the points (..., 2)."""
        return self.radius_m, self.depth_m

    def ground_m(self, points_m: Array) -> Array:
        """Height of the ground (...) [m]: zero, as the floor is the plane z = 0."""
        return np.zeros(np.shape(points_m)[:-1])

    def allowed(self, points_m: Array) -> Bools:
        """Whether the points (..., 2) are on the floor and within reach."""
        points = np.asarray(points_m)
        away = np.hypot(points[..., 0], points[..., 1])
        return np.asarray((away < self.rim_m(points)[0]) & (away <= self.reach_m))


@dataclass(frozen=True, kw_only=True)
class DeformedCrater(Crater):
    """A crater with the rim at the radius R (1 + c cos 2 phi + s sin 2 phi).

    phi is the azimuth of a point of the rim seen from the axis. The rim stands at depth + R (e sin phi + n cos phi)
    above the floor. Ellipse and tilt are small: the wall surrounds the axis.
    """

    name: str = "deformed crater"
    ellipse_cos_1: float = 0.0  # c
    ellipse_sin_1: float = 0.0  # s
    rim_tilt_east_rad: float = 0.0  # e
    rim_tilt_north_rad: float = 0.0  # n
    horizon_cost = 0.2

    @property
    def radii_m(self) -> tuple[float, float]:
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
        """Elevation (...) [rad] of the horizon from points at azimuths; pi/2 from inside the wall. See `Terrain`."""
        points = np.asarray(points_m, dtype=np.float64)
        distance = self._distance_m(points, azimuths_rad)
        height = self.rim_m(_points_ahead(points, distance, azimuths_rad))[1]
        return np.arctan2(height - self.camera_height_m, distance)

    def _distance_m(self, points: Array, azimuths_rad: Array) -> Array:
        """Distance (...) [m] to the rim, halved in between circles wholly within and wholly outside of it; else 0."""
        near = distance_to_circle(points, azimuths_rad, self.radii_m[0])
        far = distance_to_circle(points, azimuths_rad, self.radii_m[1])
        for _ in range(HALVINGS if np.any(far > near) else 0):
            middle = 0.5 * (near + far)
            within = self._is_within(_points_ahead(points, middle, azimuths_rad))
            near, far = np.where(within, middle, near), np.where(within, far, middle)
        return np.where(self._is_within(points), 0.5 * (near + far), 0.0)

    def _is_within(self, points_m: Array) -> Bools:
        """Whether points (..., 2) [m] lie within the rim."""
        return np.asarray(np.hypot(points_m[..., 0], points_m[..., 1]) < self.rim_m(points_m)[0])

    def horizon_bounds_rad(
        self, centres_m: Array, half_m: Array, azimuths_rad: Array, azimuth_half_rad: Array | float = 0.0
    ) -> tuple[Array, Array]:
        """Least and greatest horizon [rad] over boxes, from the circles and heights between which the rim lies."""
        near, far = distance_bounds(centres_m, half_m, azimuths_rad, azimuth_half_rad, *self.radii_m)
        raised = self.radius_m * float(np.hypot(self.rim_tilt_east_rad, self.rim_tilt_north_rad))
        low, high = self.wall_m - raised, self.wall_m + raised
        return np.arctan2(low, far if low > 0 else near), np.arctan2(high, near if high > 0 else far)

    def facts(self) -> dict[str, Any]:
        """Facts about the crater as JSON values: diameter, depth, ellipse and tilt."""
        names = ("diameter_m", "depth_m", "ellipse_cos_1", "ellipse_sin_1", "rim_tilt_east_rad", "rim_tilt_north_rad")
        return {"kind": "deformed crater", **{name: getattr(self, name) for name in names}}


def slopes_of_round_crater(crater: Crater, points_m: Array, azimuths_rad: Array) -> dict[str, Array]:
    """Change (...) of the horizon [rad] by one unit of each error of a round `crater`, by the error's name.

    Seen from the points (..., 2) [m] at the azimuths (...) [rad]. With d the distance to the rim, w its height above
    the camera and q its point there: tan H = w / d; where the rim moves outward by x, d grows by x R / (u q), u the
    direction (u q = R cos of the angle to the wall's normal). Zero from inside the wall.
    """
    points = np.asarray(points_m, dtype=np.float64)
    radius_m, wall = crater.radius_m, crater.wall_m
    distance = distance_to_circle(points, azimuths_rad, radius_m)
    rim = _points_ahead(points, distance, azimuths_rad)
    east, north = rim[..., 0] / radius_m, rim[..., 1] / radius_m
    facing = np.maximum(east * np.sin(azimuths_rad) + north * np.cos(azimuths_rad), 1e-12)
    per_tan_m = np.where(distance > 0, 1.0 / (np.square(distance) + wall**2), 0.0)  # cos^2 H / d^2
    raised, outward = distance * per_tan_m, -wall * radius_m / facing * per_tan_m
    return {
        "depth_1": crater.depth_m * raised,
        "diameter_1": outward,
        "ellipse_cos_1": outward * (np.square(north) - np.square(east)),
        "ellipse_sin_1": outward * 2.0 * east * north,
        "rim_tilt_east_rad": radius_m * east * raised,
        "rim_tilt_north_rad": radius_m * north * raised,
        "camera_height_m": -raised,
    }


def _points_ahead(points: Array, distance: Array, azimuths_rad: Array) -> Array:
    """Points (..., 2) that lie at the distances (...) from `points` along the azimuths."""
    return np.stack(
        [points[..., 0] + distance * np.sin(azimuths_rad), points[..., 1] + distance * np.cos(azimuths_rad)], axis=-1
    )


@dataclass(frozen=True, kw_only=True)
class Cylinder(Crater):
    """A round crater: tan H = (depth - camera height) / d(p, a), d the distance from p along azimuth a to the rim.

    Source: Kua 2008, section 3.1 (eq. 3.1 seen from the camera's height instead of the floor). Raises BadInput
    bad_terrain for lengths that are no numbers, not positive or above 10,000 km, for a camera that is not below the
    rim, and for a `depth_sigma_m` or `diameter_sigma_m` of half or more. `search_radius_m` may be infinite.
    """

    name: str = "cylinder"
    depth_sigma_m: float | None = EXACT  # standard deviations; None: not stated, see `terrain.shape`
    diameter_sigma_m: float | None = EXACT
    ellipse_sigma_1: float | None = EXACT  # relative to the radius, of each of two terms
    rim_tilt_sigma_rad: float | None = EXACT  # of each of two axes
    camera_height_sigma_m: float = EXACT
    stated_depth_m: float | None = None  # of the file, which the errors are about; None: `depth_m`
    file: TerrainFile = Terrain.file
    axisymmetric = True
    horizon_cost = 0.02

    def __post_init__(self) -> None:
        stated = {key: kind for key, kind in _SIGMAS.items() if getattr(self, key) is not None}
        declared = {**_SIZES, "camera_height_m": AMOUNT, **stated}
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
        for key, size in (("depth_sigma_m", self.about_depth_m), ("diameter_sigma_m", self.diameter_m)):
            if (getattr(self, key) or 0.0) >= MAX_SHAPE_SIGMA * size:
                raise BadInput("bad_terrain", f"{key} must be below {MAX_SHAPE_SIGMA * size:g} m, half of it")

    def horizon_rad(self, points_m: Array, azimuths_rad: Array) -> Array:
        """Elevation (...) [rad] of the horizon from points at azimuths; pi/2 from inside the wall. See `Terrain`."""
        points, azimuths = np.asarray(points_m, dtype=np.float64), np.asarray(azimuths_rad, dtype=np.float64)
        if points.ndim == 3 and points.shape[1] == 1 and azimuths.ndim == 1:  # each point with each azimuth
            found = np.empty((len(points), len(azimuths)))
            rays = np.ascontiguousarray(points[:, 0]), np.sin(azimuths), np.cos(azimuths)
            _horizons_of_circle(*rays, self.radius_m, self.wall_m, found)
            return found
        return np.arctan2(self.wall_m, distance_to_circle(points, azimuths, self.radius_m))

    def horizon_bounds_rad(
        self, centres_m: Array, half_m: Array, azimuths_rad: Array, azimuth_half_rad: Array | float = 0.0
    ) -> tuple[Array, Array]:
        """Least and greatest horizon [rad] over boxes, from circles grown and shrunk by the half diagonal."""
        nearest, farthest = distance_bounds(centres_m, half_m, azimuths_rad, azimuth_half_rad, *self.radii_m)
        return np.arctan2(self.wall_m, farthest), np.arctan2(self.wall_m, nearest)

    @property
    def errors(self) -> CylinderErrors:  # type: ignore[override]
        """Errors of the crater's sizes, of the rim's shape, and of the camera's height."""
        return CylinderErrors(self)

    def with_shape(self, values: Array) -> Terrain:
        """Crater with the errors `values` (n,), in the order of `errors.shape`; see `Terrain`."""
        errors = errors_by_name(self.errors.shape, values)
        refraction_1 = errors.pop("refraction_1", 0.0)
        crater = DeformedCrater(
            name=self.name, site=self.site, search_radius_m=self.search_radius_m,
            diameter_m=self.diameter_m * (1.0 + errors.pop("diameter_1", 0.0)),
            depth_m=self.depth_m * (1.0 + errors.pop("depth_1", 0.0)),
            camera_height_m=self.camera_height_m + errors.pop("camera_height_m", 0.0), **errors,
        )  # fmt: skip
        return with_refraction_error(crater, refraction_1)

    def with_steepness(self, steepness_1: float) -> Cylinder:
        """Copy of this crater, of another depth: its wall above the camera is `steepness_1` times the stated one."""
        if steepness_1 == self.errors.steepness_1:
            return self
        depth_m = self.camera_height_m + steepness_1 * (self.about_depth_m - self.camera_height_m)
        return replace(self, depth_m=depth_m, stated_depth_m=self.about_depth_m)

    @property
    def about_depth_m(self) -> float:
        """Depth [m] that the errors are about: that of the file."""
        return self.depth_m if self.stated_depth_m is None else self.stated_depth_m

    def facts(self) -> dict[str, Any]:
        """Facts about the crater as JSON values: diameter and depth."""
        return {"kind": "cylinder", "diameter_m": self.diameter_m, "depth_m": self.depth_m}


@dataclass(frozen=True)
class CylinderErrors(GroundErrors):
    """Errors of the shape of a round `crater`."""

    crater: Cylinder

    @property
    def shape(self) -> tuple[ShapeError, ...]:  # type: ignore[override]
        """Errors of depth and width (relative), ellipse, tilt of the rim, height of the camera, and refraction."""
        crater = self.crater
        depth = None if crater.depth_sigma_m is None else crater.depth_sigma_m / crater.depth_m
        diameter = None if crater.diameter_sigma_m is None else crater.diameter_sigma_m / crater.diameter_m
        deeper = crater.about_depth_m / crater.depth_m - 1.0
        return (
            *(replace(one, mean=deeper) for one in DEPTH.errors_of_shape(depth)),
            *DIAMETER.errors_of_shape(diameter), *ELLIPSE.errors_of_shape(crater.ellipse_sigma_1),
            *RIM_TILT.errors_of_shape(crater.rim_tilt_sigma_rad),
            *CAMERA_ERROR.errors_of_shape(crater.camera_height_sigma_m), *refraction_errors(crater.air),
        )  # fmt: skip

    def slopes_rad(self, points_m: Array, azimuths_rad: Array) -> Array:
        """Change (k, ...) [rad] of the horizon by one unit of each error, in closed form; zero from inside the wall."""
        shape = np.broadcast_shapes(np.shape(points_m)[:-1], np.shape(azimuths_rad))
        errors, crater = self.shape, self.crater
        slopes = slopes_of_round_crater(crater, points_m, azimuths_rad) if errors else {}
        if crater.air is not None:
            slopes |= refraction_slopes_rad(crater.air, crater.horizon_rad(points_m, azimuths_rad))
        return select_slopes(errors, slopes, shape)

    @property
    def unknown_steepness_1(self) -> float:  # type: ignore[override]
        """Relative sigma of depth over diameter, if too large for linear errors and no depth was chosen; else 0."""
        sigma = {one.name: one.sigma for one in self.shape}
        found = float(np.hypot(sigma.get("depth_1", 0.0), sigma.get("diameter_1", 0.0)))
        return found if found > LINEAR_SHAPE_1 and self.crater.stated_depth_m is None else 0.0

    @property
    def steepness_1(self) -> float:  # type: ignore[override]
        """Height of the wall above the camera, over that of the stated depth."""
        return self.crater.wall_m / (self.crater.about_depth_m - self.crater.camera_height_m)


def make_cylinder(keys: dict[str, Any], folder: Path, **shared: Any) -> Cylinder:
    """The terrain of the checked `keys` of a file with a [cylinder]; see `io.Kind`. Raises BadInput bad_terrain."""
    cylinder, rover = keys["cylinder"], keys["rover"]
    sigmas: dict[str, Any] = {fact.key: cylinder.get(fact.key) for fact in CYLINDER_FACTS}
    if cylinder.get("exact", False):
        wrong = [key for key, sigma in sigmas.items() if sigma]
        if wrong:
            raise BadInput("bad_terrain", f"cylinder.exact is true, but {wrong[0]} is not 0: leave one of them out")
        sigmas = dict.fromkeys(sigmas, 0.0)
    return Cylinder(
        **shared,
        diameter_m=cylinder["diameter_m"],
        depth_m=cylinder["depth_m"],
        search_radius_m=keys["search"].get("radius_m", cylinder["diameter_m"] / 2),
        camera_height_sigma_m=rover.get("camera_height_sigma_m", 0.0),
        rim_tilt_sigma_rad=radians(sigmas.pop("rim_tilt_sigma_deg")),
        **sigmas,
    )


_horizons_of_circle = kernel(
    "horizons_of_circle", "points: float64[n, 2]", "sines: float64[m]", "cosines: float64[m]", "radius: float64",
    "wall: float64", "found: out float64[n, m]",
)  # fmt: skip
