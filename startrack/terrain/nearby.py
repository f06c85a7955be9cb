"""The neighbourhood of a place: horizons at a few points around it, and between them by interpolation."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from startrack.types import Array

if TYPE_CHECKING:
    from startrack.terrain.dem import HeightTerrain

ACROSS = 3  # points along each side
AZIMUTHS = 3600


@dataclass(frozen=True, eq=False)
class Nearby:
    """The terrain about a place, quick to ask: all is as in `whole`, but for the horizon, linear between traced ones.

    Good to some thousandths of a degree within `half_m`; beyond it goes on as at the edge.
    """

    whole: HeightTerrain
    centre_m: Array  # (2,)
    half_m: float

    def __getattr__(self, name: str) -> Any:
        return getattr(self.whole, name)

    @cached_property
    def _table_rad(self) -> Array:
        """(ACROSS, ACROSS, AZIMUTHS + 1) horizon at the points, east first."""
        line = np.linspace(-self.half_m, self.half_m, ACROSS)
        points = self.centre_m + np.stack(np.meshgrid(line, line, indexing="ij"), axis=-1)
        azimuths = np.arange(AZIMUTHS, dtype=np.float64) * (2 * np.pi / AZIMUTHS)
        horizon = self.whole.horizon_rad(np.asarray(points[:, :, None, :], dtype=np.float64), azimuths)
        return np.concatenate([horizon, horizon[..., :1]], axis=-1)

    def horizon_rad(self, points_m: Array, azimuths_rad: Array) -> Array:
        """Horizon elevation [rad]; see `Terrain`."""
        step = 2 * self.half_m / (ACROSS - 1)
        at = (np.asarray(points_m) - self.centre_m + self.half_m) / step
        turn = np.asarray(azimuths_rad) % (2 * np.pi) * (AZIMUTHS / (2 * np.pi))
        i, j = (np.clip(np.floor(at[..., k]), 0, ACROSS - 2).astype(np.int64) for k in (0, 1))
        k = np.minimum(np.floor(turn), AZIMUTHS - 1).astype(np.int64)
        u, v, w = at[..., 0] - i, at[..., 1] - j, turn - k
        table = self._table_rad.ravel()
        first = (i * ACROSS + j) * (AZIMUTHS + 1) + k
        east, north = ACROSS * (AZIMUTHS + 1), AZIMUTHS + 1

        def between(offset: int) -> Array:
            low, high = table[first + offset], table[first + offset + 1]
            return np.asarray(low + w * (high - low))

        west = between(0) * (1 - v) + between(north) * v
        return np.asarray(west * (1 - u) + (between(east) * (1 - v) + between(east + north) * v) * u)
