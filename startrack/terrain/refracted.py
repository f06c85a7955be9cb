"""The error of the stars' refraction as one of the skyline: stars raised are a skyline lowered."""

from __future__ import annotations

import numpy as np

from startrack.core.types import Array
from startrack.frames import AIR_KEYS, USUAL_SIGMA_1, Air
from startrack.terrain.protocol import ForwardingTerrain, Terrain
from startrack.terrain.shape import Fact, ShapeError

STAR_REFRACTION = Fact(
    key="refraction_sigma_1", errors=("refraction_1",), sigma=USUAL_SIGMA_1,
    meaning="error of the refraction of the stars, relative", limits=AIR_KEYS["refraction_sigma_1"],
)  # fmt: skip


def refraction_errors(air: Air | None) -> list[ShapeError]:
    """The error of the refraction in an `air`; none without."""
    return [] if air is None else STAR_REFRACTION.errors_of_shape(air.refraction_sigma_1)


def refraction_slopes_rad(air: Air | None, horizon_rad: Array) -> dict[str, Array]:
    """Change (...) [rad] of a skyline at the elevations `horizon_rad` (...) by one unit of each error, by its name."""
    return {} if air is None else {"refraction_1": -air.lift_rad(horizon_rad)}


def with_refraction_error(ground: Terrain, error_1: float) -> Terrain:
    """The `ground` below stars whose refraction is larger than that of its air, relatively by `error_1`."""
    return ground if error_1 == 0.0 or ground.air is None else MisrefractedGround(ground, ground.air, error_1)


class MisrefractedGround(ForwardingTerrain):
    """The terrain `whole`, without errors of its shape, in directions of stars that its `air` alone refracts."""

    near, with_shape = Terrain.near, Terrain.with_shape

    def __init__(self, whole: Terrain, air: Air, error_1: float) -> None:
        super().__init__(whole)
        self._air, self._error_1 = air, error_1

    def _lowered_rad(self, horizon_rad: Array) -> Array:
        """Elevations (...) [rad], in the order of the `horizon_rad` (...)."""
        return np.asarray(horizon_rad - self._error_1 * self._air.lift_rad(horizon_rad))

    def horizon_rad(self, points_m: Array, azimuths_rad: Array) -> Array:
        """Horizon elevation [rad]; see `Terrain`."""
        return self._lowered_rad(self.whole.horizon_rad(points_m, azimuths_rad))

    def horizon_bounds_rad(
        self, centres_m: Array, half_m: Array, azimuths_rad: Array, azimuth_half_rad: Array | float = 0.0
    ) -> tuple[Array, Array]:
        """Bounds [rad] from those of the whole; see `Terrain`."""
        low, high = self.whole.horizon_bounds_rad(centres_m, half_m, azimuths_rad, azimuth_half_rad)
        return self._lowered_rad(low), self._lowered_rad(high)

    def horizon_spread_rad(self, points_m: Array, half_m: float, azimuths_rad: Array) -> tuple[Array, Array]:
        """As of the whole, about the horizon of this ground; see `Terrain`."""
        middle, half = self.whole.horizon_spread_rad(points_m, half_m, azimuths_rad)
        return self._lowered_rad(middle), half
