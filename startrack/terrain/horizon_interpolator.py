"""The neighbourhood of a place: horizons at a few points around it, and between them by interpolation."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from startrack.types import Array, Bools, Ints

if TYPE_CHECKING:
    from startrack.terrain.height_map import HeightMap

ACROSS = 3  # points along each side, where nothing else is asked for
ROUGH = 8e-5  # of tan H: azimuths whose horizon bends by more between the points (0.004 degrees) are traced one by one
ROUGH_SIGMAS = 0.5  # or by more than that part of the map's own error


@dataclass(frozen=True, eq=False)
class Nearby:
    """The terrain about a place, quick to ask at the azimuths named; whatever else is asked is asked of `whole`.

    A crest at the distance d is seen higher as the camera's own ground falls: tan H + z / d bends much less from place
    to place than tan H, and is bilinear between traced points. Good to `rough`, checked by the points themselves.
    """

    whole: HeightMap
    centre_m: Array  # (2,)
    half_m: float
    azimuths_rad: Array  # (n,) ascending
    across: int = ACROSS

    def __getattr__(self, name: str) -> Any:
        return getattr(self.whole, name)

    @cached_property
    def step_m(self) -> float:
        return 2 * self.half_m / (self.across - 1)

    @cached_property
    def _traced(self) -> tuple[Array, Array, float]:
        """Nodes (n, across, across), one over the crests' distances (n,), and height of the ground in the middle."""
        line = np.linspace(-self.half_m, self.half_m, self.across)
        points = np.asarray(self.centre_m + np.stack(np.meshgrid(line, line, indexing="ij"), axis=-1), dtype=np.float64)
        tan, distance, _ = self.whole.horizons(points[:, :, None, :], self.azimuths_rad)
        middle = float(self.whole.ground_m(self.centre_m))
        near = 1.0 / np.maximum(np.median(distance, axis=(0, 1)), self.step_m)
        nodes = tan + (self.whole.ground_m(points) - middle)[:, :, None] * near
        return np.ascontiguousarray(np.moveaxis(nodes, -1, 0)), near, middle

    @property
    def nodes(self) -> Array:
        """(n, across, across) tan of the horizon at the points, east first, were they all as high as the middle."""
        return self._traced[0]

    @property
    def per_height(self) -> Array:
        """(n,) how much lower [1/m] tan of the horizon is seen from a metre higher."""
        return self._traced[1]

    @property
    def middle_up_m(self) -> float:
        """Height of the ground in the middle."""
        return self._traced[2]

    @cached_property
    def rough(self) -> Array:
        """(n,) how far the nodes' true values between the points may lie from the bilinear ones.

        A smooth bend errs by an eighth of the second differences, a change from one crest to another by all of one.
        """
        bends = [np.abs(np.diff(self.nodes, 2, axis=axis)).max(axis=(1, 2), initial=0.0) for axis in (1, 2)]
        return np.asarray(bends[0] + bends[1])

    @cached_property
    def _smooth(self) -> Bools:
        return np.asarray(self.rough < np.maximum(ROUGH, ROUGH_SIGMAS * self._sigma_rad))

    def column(self, azimuths_rad: Array) -> tuple[Ints, Bools]:
        """Index of each azimuth (...), and whether it is one of those named."""
        at = np.minimum(np.searchsorted(self.azimuths_rad, azimuths_rad), len(self.azimuths_rad) - 1)
        return at, np.asarray(self.azimuths_rad[at] == azimuths_rad)

    @cached_property
    def _sigma_rad(self) -> Array:
        """(n,) in the middle."""
        return np.asarray(self.whole.horizon_sigma_rad(self.centre_m, self.azimuths_rad))

    def horizon_sigma_rad(self, points_m: Array, azimuths_rad: Array) -> Array:
        """Standard deviation [rad], that in the middle for all points; see `Terrain`."""
        column, named = self.column(azimuths_rad)
        if not np.all(named):
            return self.whole.horizon_sigma_rad(points_m, azimuths_rad)
        return np.broadcast_to(
            self._sigma_rad[column], np.broadcast_shapes(np.shape(points_m)[:-1], np.shape(azimuths_rad))
        )

    def traced_part(self, points_m: Array, azimuths_rad: Array) -> float:
        """Part of the points (n, 2) and azimuths (n,) whose horizons have to be traced all the same."""
        column, named = self.column(azimuths_rad)
        inside = np.abs(points_m - self.centre_m).max(axis=-1) <= self.half_m * (1 + 1e-9)
        return 1.0 - float(np.mean(inside & named & self._smooth[column]))

    def horizon_rad(self, points_m: Array, azimuths_rad: Array) -> Array:
        """Horizon elevation [rad]; see `Terrain`."""
        points_m = np.asarray(points_m, dtype=np.float64)
        shape = np.broadcast_shapes(points_m.shape[:-1], np.shape(azimuths_rad))
        points = np.ascontiguousarray(np.broadcast_to(points_m, (*shape, 2))).reshape(-1, 2)
        azimuths = np.broadcast_to(azimuths_rad, shape).ravel()
        column, named = self.column(azimuths)
        found = np.empty(len(azimuths))
        self.whole.tracer.between(self, points, column, found)
        inside = np.abs(points - self.centre_m).max(axis=-1) <= self.half_m * (1 + 1e-9)
        other = ~(inside & named & self._smooth[column])
        if other.any():
            found[other] = self.whole.horizon_rad(points[other], azimuths[other])
        return found.reshape(shape)

    def horizon_bounds_rad(
        self, centres_m: Array, half_m: Array, azimuths_rad: Array, azimuth_half_rad: Array | float = 0.0
    ) -> tuple[Array, Array]:
        """Bounds over boxes [rad]; see `Terrain`. Interpolated for small boxes in the neighbourhood, else traced."""
        half = float(np.max(half_m))
        too_wide = half > self.step_m / 2 or 2 * half > self.whole.finest_post_m
        if np.any(azimuth_half_rad) or np.ndim(half_m) or too_wide:
            return self.whole.horizon_bounds_rad(centres_m, half_m, azimuths_rad, azimuth_half_rad)
        column, named = self.column(azimuths_rad)
        low, high = np.empty(len(column)), np.empty(len(column))
        self.whole.tracer.between_bounds(self, np.ascontiguousarray(centres_m), half, column, low, high)
        inside = np.abs(centres_m - self.centre_m).max(axis=-1) + half <= self.half_m * (1 + 1e-9)
        other = ~(inside & named & self._smooth[column])
        if other.any():
            low[other], high[other] = self.whole.horizon_bounds_rad(centres_m[other], half_m, azimuths_rad[other])
        return low, high
