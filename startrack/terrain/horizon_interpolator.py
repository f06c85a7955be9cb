"""Horizons near one point: traced at a few nodes around it, and interpolated between them."""

from __future__ import annotations

from copy import copy
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from startrack.core.types import Array, Bools, Ints
from startrack.terrain.deformed_map import slopes_of_map
from startrack.terrain.horizon_kernel import interpolate, interpolate_bounds
from startrack.terrain.protocol import ForwardingTerrain
from startrack.terrain.traced_map import TracedMap, flatten_rays

DEFAULT_NODES = 3  # nodes along each side by default
MAX_BEND_TAN = 8e-5  # of tan H (0.004 degrees): azimuths whose horizon bends by more between the nodes are traced
MAX_BEND_SIGMAS = 0.5  # or by more than that part of the map's own error


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
    """The terrain near a centre, with fast horizons at the azimuths that it was made for; else as `whole`.

    A crest at the distance d is seen higher as the camera's own ground falls: tan H + z / d bends much less from point
    to point than tan H, and is bilinear between traced nodes. Its error is below `interpolation_error`, which the nodes
    themselves show. Azimuths with a larger one are traced.
    """

    whole: TracedMap
    centre_m: Array  # (2,)
    half_m: float
    azimuths_rad: Array  # (n,) ascending
    across: int = DEFAULT_NODES
    exact: bool = True  # azimuths with a large interpolation error are traced

    @cached_property
    def step_m(self) -> float:
        """Distance between neighbouring nodes [m]."""
        return 2 * self.half_m / (self.across - 1)

    @cached_property
    def nodes(self) -> Nodes:
        """The horizons traced at the nodes."""
        line = np.linspace(-self.half_m, self.half_m, self.across)
        points = np.asarray(self.centre_m + np.stack(np.meshgrid(line, line, indexing="ij"), axis=-1), dtype=np.float64)
        tan, distance, _ = self.whole.horizons(points[:, :, None, :], self.azimuths_rad)
        middle = float(self.whole.ground_m(self.centre_m))
        near = 1.0 / np.maximum(np.median(distance, axis=(0, 1)), self.step_m)
        level = tan + (self.whole.ground_m(points) - middle)[:, :, None] * near
        tan = np.ascontiguousarray(np.moveaxis(level, -1, 0))
        return Nodes(tan, near, middle, float(self.centre_m[0]), float(self.centre_m[1]), float(self.half_m))

    @cached_property
    def interpolation_error(self) -> Array:
        """(n,) largest error of the bilinear nodes between the nodes.

        A smooth bend errs by an eighth of the second differences, a change from one crest to another by all of one.
        """
        bends = [np.abs(np.diff(self.nodes.tan, 2, axis=axis)).max(axis=(1, 2), initial=0.0) for axis in (1, 2)]
        return np.asarray(bends[0] + bends[1])

    @cached_property
    def _smooth(self) -> Bools:
        return np.asarray(self.interpolation_error < np.maximum(MAX_BEND_TAN, MAX_BEND_SIGMAS * self._sigma_rad))

    def interpolated(self) -> HorizonInterpolator:
        """The same nodes, between which all azimuths are interpolated; see `Terrain`."""
        nodes, other = self.nodes, copy(self)
        other.__dict__.update(nodes=nodes, exact=False)
        return other

    def without_table(self) -> TracedMap:
        """The whole map: nothing is interpolated; see `Terrain`."""
        return self.whole.without_table()

    def column(self, azimuths_rad: Array) -> tuple[Ints, Bools]:
        """Index of each azimuth (...) in `azimuths_rad`, and whether it is there."""
        at = np.minimum(np.searchsorted(self.azimuths_rad, azimuths_rad), len(self.azimuths_rad) - 1)
        return at, np.asarray(self.azimuths_rad[at] == azimuths_rad)

    @cached_property
    def _sigma_rad(self) -> Array:
        """(n,) in the middle."""
        return np.asarray(self.whole.horizon_sigma_rad(self.centre_m, self.azimuths_rad))

    def horizon_sigma_rad(self, points_m: Array, azimuths_rad: Array) -> Array:
        """Standard deviation [rad], that in the middle for all points; see `Terrain`."""
        column, known = self.column(azimuths_rad)
        if not np.all(known):
            return self.whole.horizon_sigma_rad(points_m, azimuths_rad)
        return np.broadcast_to(
            self._sigma_rad[column], np.broadcast_shapes(np.shape(points_m)[:-1], np.shape(azimuths_rad))
        )

    def shape_slopes_rad(self, points_m: Array, azimuths_rad: Array) -> Array:
        """With the interpolated horizon, and the crests' distance in the middle; see `Terrain`."""
        column, known = self.column(azimuths_rad)
        if not np.all(known):
            return self.whole.shape_slopes_rad(points_m, azimuths_rad)
        tan = np.tan(self.horizon_rad(points_m, azimuths_rad))
        return slopes_of_map(self.whole.shape_errors, tan, self.nodes.per_height[column], azimuths_rad)

    def horizon_rad(self, points_m: Array, azimuths_rad: Array) -> Array:
        """Horizon elevation [rad]; see `Terrain`."""
        shape, points, azimuths = flatten_rays(points_m, azimuths_rad)
        column, inside = self._inside(points, azimuths, 0.0, self.exact)
        found = np.empty(len(column))
        interpolate(self.whole.ground, self.nodes, points, column, found)
        if not inside.all():
            found[~inside] = self.whole.horizon_rad(points[~inside], azimuths[~inside])
        return found.reshape(shape)

    def horizon_bounds_rad(
        self, centres_m: Array, half_m: Array, azimuths_rad: Array, azimuth_half_rad: Array | float = 0.0
    ) -> tuple[Array, Array]:
        """Bounds over boxes [rad]; see `Terrain`. Interpolated for small boxes within the nodes, else traced."""
        half = float(np.max(half_m))
        too_wide = half > self.step_m / 2 or 2 * half > self.whole.finest_post_m
        if np.any(azimuth_half_rad) or np.ndim(half_m) or too_wide:
            return self.whole.horizon_bounds_rad(centres_m, half_m, azimuths_rad, azimuth_half_rad)
        shape, centres, azimuths = flatten_rays(centres_m, azimuths_rad)
        column, inside = self._inside(centres, azimuths, half, True)
        low, high = np.empty(len(column)), np.empty(len(column))
        interpolate_bounds(self.whole.ground, self.nodes, self.interpolation_error, centres, half, column, low, high)
        if not inside.all():
            low[~inside], high[~inside] = self.whole.horizon_bounds_rad(centres[~inside], half_m, azimuths[~inside])
        return low.reshape(shape), high.reshape(shape)

    def _inside(self, points: Array, azimuths: Array, half: float, exact: bool) -> tuple[Ints, Bools]:
        """Columns (n,) of rays, and whether they are interpolated: near the centre, and `exact`ly enough if asked."""
        column, known = self.column(azimuths)
        inside = np.abs(points - self.centre_m).max(axis=-1) + half <= self.half_m * (1 + 1e-9)
        return column, np.asarray(inside & known & (self._smooth[column] if exact else True))
