"""The thesis's crater: a vertical wall of constant height around a flat circular floor, in closed form."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from startrack.core.declaration import Flag
from startrack.core.types import Array, BadInput
from startrack.kernels.library import kernel
from startrack.terrain.crater import Crater, DeformedCrater, distance_bounds, distance_to_circle, slopes_of_round_crater
from startrack.terrain.protocol import Terrain, TerrainFile
from startrack.terrain.refracted import refraction_errors, refraction_slopes_rad, with_refraction_error
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
    select_slopes,
)

MAX_SHAPE_SIGMA = 0.5  # of depth and diameter; beyond, a normal distribution holds sizes below 0
LINEAR_SHAPE_1 = 0.05  # of depth over diameter: beyond, the shape that the rows show is searched, as it is not linear
_SIZES = {"diameter_m": replace(LENGTH, required=True), "depth_m": replace(LENGTH, required=True)}
CYLINDER_KEYS = {  # of [cylinder] in a terrain file
    **_SIZES,
    "exact": Flag(description="true: a model, without errors of its shape"),
    **{fact.key: fact.limits for fact in CYLINDER_FACTS},
}
_SIGMAS = {
    **{fact.key: fact.limits for fact in (DEPTH, DIAMETER, ELLIPSE, CAMERA_ERROR)},
    "rim_tilt_sigma_rad": replace(RIM_TILT.limits, high=float(np.radians(RIM_TILT.limits.high))),
}


@dataclass(frozen=True, kw_only=True)
class Cylinder(Crater):
    """tan H = (depth - camera height) / d(p, a), d the distance from p along azimuth a to the circle of the rim.

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
        """Horizon elevation [rad]; pi/2 from inside the wall. See `Terrain`."""
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
        """Bounds of the horizon over boxes [rad], from circles grown and shrunk by the half diagonal."""
        nearest, farthest = distance_bounds(centres_m, half_m, azimuths_rad, azimuth_half_rad, *self.radii_m)
        return np.arctan2(self.wall_m, farthest), np.arctan2(self.wall_m, nearest)

    @property
    def errors(self) -> CylinderErrors:  # type: ignore[override]
        """Errors of its sizes, of the rim's shape, and of the camera's height."""
        return CylinderErrors(self)

    def with_shape(self, values: Array) -> Terrain:
        """The crater with these errors; see `Terrain`."""
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
        """See `Terrain`: of another depth."""
        if steepness_1 == self.errors.steepness_1:
            return self
        depth_m = self.camera_height_m + steepness_1 * (self.about_depth_m - self.camera_height_m)
        return replace(self, depth_m=depth_m, stated_depth_m=self.about_depth_m)

    @property
    def about_depth_m(self) -> float:
        """Depth [m] that the errors are about: that of the file."""
        return self.depth_m if self.stated_depth_m is None else self.stated_depth_m

    def facts(self) -> dict[str, Any]:
        """Diameter and depth, as JSON values."""
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
        """In closed form; zero from inside the wall."""
        shape = np.broadcast_shapes(np.shape(points_m)[:-1], np.shape(azimuths_rad))
        errors, crater = self.shape, self.crater
        slopes = slopes_of_round_crater(crater, points_m, azimuths_rad) if errors else {}
        if crater.air is not None:
            slopes |= refraction_slopes_rad(crater.air, crater.horizon_rad(points_m, azimuths_rad))
        return select_slopes(errors, slopes, shape)

    @property
    def unknown_steepness_1(self) -> float:  # type: ignore[override]
        """Of depth over diameter."""
        sigma = {one.name: one.sigma for one in self.shape}
        found = float(np.hypot(sigma.get("depth_1", 0.0), sigma.get("diameter_1", 0.0)))
        return found if found > LINEAR_SHAPE_1 and self.crater.stated_depth_m is None else 0.0

    @property
    def steepness_1(self) -> float:  # type: ignore[override]
        """That of its depth."""
        return self.crater.wall_m / (self.crater.about_depth_m - self.crater.camera_height_m)


_horizons_of_circle = kernel(
    "horizons_of_circle", "points: float64[n, 2]", "sines: float64[m]", "cosines: float64[m]", "radius: float64",
    "wall: float64", "found: out float64[n, m]",
)  # fmt: skip
