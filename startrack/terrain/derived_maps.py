"""Terrains made of a height map: its ground with errors of its shape, and its horizons interpolated near one point."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from startrack.core.types import Array
from startrack.frames import R_from_rotvec
from startrack.kernels.library import kernel
from startrack.terrain.horizon_table import rows_of_rays
from startrack.terrain.map_errors import PostErrors
from startrack.terrain.protocol import ForwardingTerrain, Terrain
from startrack.terrain.shape import wave_slopes_rad
from startrack.terrain.table_cache import TABLES_IN_MEMORY
from startrack.terrain.traced_map import TracedMap

if TYPE_CHECKING:
    from startrack.terrain.height_map import HeightMap

TILT_ROUNDS = 2  # of the azimuth towards that of the turned skyline: each leaves a thousandth of the difference
SETTLED_RAD = 1e-8  # of the azimuth: a change of 2 milliarcsec needs no further round
MOST_REFRACTION_1 = 0.95  # sight lines that bend as the body does would never leave it
WIDER_RAD = 0.1  # by which azimuths are widened to find the highest skyline that a tilt may turn into a direction


class DeformedMap(ForwardingTerrain):
    """The ground of a height map with errors of its shape, given by their names.

    In this order: the camera stands higher, sight lines bend more, tan of the horizon is stretched, the horizon rises
    by the bias and by waves (by name), as crests of a wrong height do, and the skyline is turned about a horizontal
    axis. It has no further errors of its shape. Its bounds need the table of a map with the camera at the changed
    height and such lines; the horizon does without.
    """

    whole: HeightMap
    near, with_shape = Terrain.near, Terrain.with_shape

    def __init__(
        self, whole: HeightMap, *, bias_rad: float = 0.0, stretch_1: float = 0.0, vertical_east_rad: float = 0.0,
        vertical_north_rad: float = 0.0, camera_height_m: float = 0.0, terrestrial_refraction_1: float = 0.0,
        **waves_rad: float,
    ) -> None:  # fmt: skip
        super().__init__(whole)
        self._raised_m, self._refraction_1 = camera_height_m, terrestrial_refraction_1
        self._bias_rad, self._stretch_1 = bias_rad, stretch_1
        self._waves_rad = {name: value for name, value in waves_rad.items() if value}
        risen_rad = abs(bias_rad) + np.abs(list(self._waves_rad.values())).sum()
        self._most_risen_rad = float(risen_rad * whole.crest_share(np.zeros(1), np.zeros(1))[0]) if risen_rad else 0.0
        self._tilt_rad = float(np.hypot(vertical_east_rad, vertical_north_rad))
        self._R_turned_map = R_from_rotvec([vertical_north_rad, -vertical_east_rad, 0.0])

    @cached_property
    def errors(self) -> PostErrors:  # type: ignore[override]
        """Errors of the map's single posts: the only ones that are left."""
        return PostErrors(self.whole)

    @property
    def camera_height_m(self) -> float:  # type: ignore[override]
        """Height [m] of the camera above the ground, with its error."""
        return max(self.whole.camera_height_m + self._raised_m, 0.0)

    @cached_property
    def _raised(self) -> TracedMap:
        """Map with the camera at the changed height and the changed bend of sight lines; `whole` without changes."""
        if not self._raised_m and not self._refraction_1:
            return self.whole
        refraction_1 = min(self.whole.terrestrial_refraction_1 + self._refraction_1, MOST_REFRACTION_1)
        raised = replace(self.whole, camera_height_m=self.camera_height_m, terrestrial_refraction_1=refraction_1)
        same = self.whole.ground
        raised.__dict__["ground"] = replace(same, sag_per_m=refraction_1 / (2 * same.radius_m))
        raised.__dict__["_similar_table"] = TABLES_IN_MEMORY.get(self.whole.table_key)
        return raised

    def without_table(self) -> DeformedMap:
        """Copy of this ground whose raised camera's map has no table of horizons; see `Terrain`."""
        return self.changed(_raised=self._raised.without_table())

    def _level_rad(self, horizon_rad: Array) -> Array:
        """Elevations (...) [rad] with tan stretched, from those of the raised camera's horizon."""
        return np.asarray(np.arctan((1.0 + self._stretch_1) * np.tan(horizon_rad)))

    def _before_turn_rad(self, points_m: Array, azimuths_rad: Array) -> Array:
        """Elevation (...) [rad] of the horizon with all errors but the turn; see `horizon_rad`."""
        if not self._most_risen_rad:
            return self._level_rad(self._raised.horizon_rad(points_m, azimuths_rad))
        tan, distance_m, _ = self._raised.horizons(points_m, azimuths_rad)
        slopes = wave_slopes_rad(azimuths_rad) if self._waves_rad else {}
        risen_rad = self._bias_rad + sum(value * slopes[name] for name, value in self._waves_rad.items())
        return self._level_rad(np.arctan(tan)) + risen_rad * self.whole.crest_share(tan, distance_m)

    def horizon_rad(self, points_m: Array, azimuths_rad: Array) -> Array:
        """Elevation (...) [rad] of the horizon with all errors, traced; see `Terrain`."""
        found = self._before_turn_rad(points_m, azimuths_rad)
        return self._turned_rad(points_m, azimuths_rad, found) if self._tilt_rad else found

    def _turned_rad(self, points_m: Array, azimuths_rad: Array, about_rad: Array) -> Array:
        """Elevation (...) [rad] of the horizon after the turn; before it, it stands at about `about_rad` (...)."""
        azimuths, found = np.broadcast_to(azimuths_rad, about_rad.shape), about_rad
        own = np.array(azimuths)
        for _ in range(TILT_ROUNDS):
            step = (azimuths - self._turn(own, found)[0] + np.pi) % (2 * np.pi) - np.pi
            if found is not about_rad and np.abs(step).max(initial=0.0) < SETTLED_RAD:
                break
            own += step
            found = self._before_turn_rad(points_m, own)
        return self._turn(own, found)[1]

    def _turn(self, azimuths_rad: Array, elevations_rad: Array) -> tuple[Array, Array]:
        """Azimuths and elevations (...), (...) [rad] of directions of the map after the turn."""
        level = np.cos(elevations_rad)
        rays = np.stack([level * np.sin(azimuths_rad), level * np.cos(azimuths_rad), np.sin(elevations_rad)], axis=-1)
        east, north, up = np.moveaxis(rays @ self._R_turned_map.T, -1, 0)
        return np.arctan2(east, north), np.arctan2(up, np.hypot(east, north))

    def horizon_bounds_rad(
        self, centres_m: Array, half_m: Array, azimuths_rad: Array, azimuth_half_rad: Array | float = 0.0
    ) -> tuple[Array, Array]:
        """Least and greatest horizon [rad] over boxes, by the raised camera's map and the azimuths that a turn adds."""
        turn, around_rad = np.asarray(azimuth_half_rad), self._tilt_rad + self._most_risen_rad
        if self._tilt_rad:
            high = self._level_rad(
                self._raised.horizon_bounds_rad(centres_m, half_m, azimuths_rad, turn + WIDER_RAD)[1]
            )
            turn = turn + 1.01 * self._tilt_rad / np.cos(np.minimum(high + around_rad, np.pi / 2 - 1e-3))
        low, high = self._raised.horizon_bounds_rad(centres_m, half_m, azimuths_rad, turn)
        return self._level_rad(low) - around_rad, self._level_rad(high) + around_rad

    def horizon_spread_rad(self, points_m: Array, half_m: float, azimuths_rad: Array) -> tuple[Array, Array]:
        """Middle (...) [rad] of this ground's horizon over boxes, and half width of that of the map; see `Terrain`."""
        return self.horizon_rad(points_m, azimuths_rad), self.whole.horizon_spread_rad(points_m, half_m, azimuths_rad)[
            1
        ]


class Nodes(NamedTuple):
    """Horizons at n azimuths, traced at nodes."""

    tan: Array  # (n, across, across) of the horizon, east first, were the ground at all nodes as high as in the middle
    per_height: Array  # (n,) decrease of tan of the horizon per metre of the camera's height [1/m]
    middle_up_m: float  # height of the ground in the middle
    east_m: float  # of the middle
    north_m: float
    half_m: float  # from the middle to the outer nodes


@dataclass(frozen=True, eq=False)
class HorizonInterpolator(ForwardingTerrain):
    """The terrain near a centre, with fast horizons at the azimuths that it was made for; elsewhere those of `whole`.

    A crest at the distance d is seen higher as the camera's own ground falls: tan H + z / d bends much less from point
    to point than tan H, and is taken as bilinear between traced nodes.
    """

    whole: TracedMap
    centre_m: Array  # (2,)
    half_m: float
    azimuths_rad: Array  # (n,) ascending
    across: int  # nodes along each side

    @cached_property
    def nodes(self) -> Nodes:
        """Horizons traced at the nodes."""
        line = np.linspace(-self.half_m, self.half_m, self.across)
        points = np.asarray(self.centre_m + np.stack(np.meshgrid(line, line, indexing="ij"), axis=-1), dtype=np.float64)
        tan, distance, _ = self.whole.horizons(points[:, :, None, :], self.azimuths_rad)
        middle = float(self.whole.ground_m(self.centre_m))
        near = 1.0 / np.maximum(np.median(distance, axis=(0, 1)), 2 * self.half_m / (self.across - 1))
        level = tan + (self.whole.ground_m(points) - middle)[:, :, None] * near
        tan = np.ascontiguousarray(np.moveaxis(level, -1, 0))
        return Nodes(tan, near, middle, float(self.centre_m[0]), float(self.centre_m[1]), float(self.half_m))

    def without_table(self) -> TracedMap:
        """The whole map without its table, where nothing is interpolated; see `Terrain`."""
        return self.whole.without_table()

    def horizon_rad(self, points_m: Array, azimuths_rad: Array) -> Array:
        """Elevation (...) [rad] of the horizon from points at azimuths; see `Terrain`."""
        shape, points, azimuths = rows_of_rays(points_m, azimuths_rad)
        column = np.minimum(np.searchsorted(self.azimuths_rad, azimuths), len(self.azimuths_rad) - 1)
        near = np.abs(points - self.centre_m).max(axis=-1) <= self.half_m * (1 + 1e-9)
        prepared = self.azimuths_rad[column] == azimuths
        found = np.empty((len(points), azimuths.shape[1]))
        _interpolate(self.whole.ground.record, *self.nodes, points, column, found)
        if not (near.all() and prepared.all()):
            point, azimuth = np.nonzero(~(near[:, None] & prepared))
            own = np.broadcast_to(azimuths, found.shape)[point, azimuth]
            found[point, azimuth] = self.whole.horizon_rad(points[point], own)
        return found.reshape(shape)


_interpolate = kernel(
    "interpolate_horizons", "ground: ground", "nodes: float64[azimuths, across, across]",
    "per_height: float64[azimuths]", "middle: float64", "east: float64", "north: float64", "half: float64",
    "points: float64[n, 2]", "column: int64[rows, m]", "found: out float64[n, m]",
)  # fmt: skip
