"""What a terrain answers: how high the horizon stands, and between which bounds over a box of positions."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from startrack.frames import Site
from startrack.types import Array, Bools

Progress = Callable[[int, int], None]  # parts done, of how many


class Terrain(ABC):
    """Ground whose horizon hides stars. Positions are those of the CAMERA, east and north in enu [m].

    A terrain of one's own is a subclass with three methods: `horizon_rad`, `horizon_bounds_rad` and `ground_m`. All
    other members have defaults, which describe exact ground that is known everywhere. Methods are elementwise over
    their broadcast arguments. The horizon is an elevation in enu [rad]; a star is visible where its elevation exceeds
    it.
    """

    name: str = "terrain"
    site: Site | None = None  # where enu stands; needed to locate images, not to localize rays
    camera_height_m: float = 0.0  # of the camera above the ground
    search_radius_m: float = 10_000.0  # the camera is within this horizontal distance of the origin
    common_sigma_rad: float = 0.0  # standard deviation of an error of the horizon that all azimuths and positions share
    hard_edges: bool = True  # whether the horizon is exact: `horizon_sigma_rad` is zero everywhere
    finest_m: float = 0.05  # half side of the smallest box of positions that the ground distinguishes
    axisymmetric: bool = False  # whether a turn of the sky about the vertical only turns the position
    shape_sigma: tuple[float, float] = (0.0, 0.0)  # relative, of steepness and of size: see `reshaped`

    @property
    def reach_m(self) -> float:
        """Half side of the square that is searched: the search area and a margin to notice leaving it [m]."""
        return 1.25 * self.search_radius_m

    @abstractmethod
    def horizon_rad(self, points_m: Array, azimuths_rad: Array) -> Array:
        """Horizon elevation (...) [rad] seen from the points (..., 2) [m] at the azimuths (...) [rad]."""

    @abstractmethod
    def horizon_bounds_rad(
        self, centres_m: Array, half_m: Array, azimuths_rad: Array, azimuth_half_rad: Array | float = 0.0
    ) -> tuple[Array, Array]:
        """Least and greatest horizon (...), (...) [rad] over the boxes |dx|, |dy| <= half (...) [m].

        They hold for every allowed point of the box and for every azimuth within `azimuth_half_rad` of the given one.
        """

    @abstractmethod
    def ground_m(self, points_m: Array) -> Array:
        """Height (...) of the ground in enu [m] at the points (..., 2)."""

    def horizon_sigma_rad(self, points_m: Array, azimuths_rad: Array) -> Array:
        """Standard deviation (...) of the horizon [rad] from the errors of the map; independent between azimuths."""
        return np.zeros(np.broadcast_shapes(np.shape(points_m)[:-1], np.shape(azimuths_rad)))

    def max_horizon_sigma_rad(
        self, centres_m: Array, half_m: float, azimuths_rad: Array, azimuth_half_rad: float
    ) -> Array:
        """The largest `horizon_sigma_rad` (...) over boxes and azimuths, as in `horizon_bounds_rad`."""
        return np.zeros(np.broadcast_shapes(np.shape(centres_m)[:-1], np.shape(azimuths_rad)))

    def allowed(self, points_m: Array) -> Bools:
        """Whether a camera could stand at the points (..., 2): known ground under open sky."""
        return np.asarray(np.hypot(points_m[..., 0], points_m[..., 1]) <= self.reach_m)

    def is_informative(self, azimuths_rad: Array, elevations_rad: Array) -> Bools:
        """Whether the terrain decides if the rays (...) are visible, from everywhere in the search area."""
        return np.ones(np.broadcast_shapes(np.shape(azimuths_rad), np.shape(elevations_rad)), dtype=bool)

    def mask_reason(self, azimuths_rad: Array, elevations_rad: Array) -> NDArray[np.str_]:
        """Why rays (n,) are not informative; empty where they are."""
        return np.where(self.is_informative(azimuths_rad, elevations_rad), "", "ground off the map")

    def masked_sectors(self) -> list[str]:
        """One line of text per range of azimuths that is not informative."""
        return []

    def near(self, centre_m: Array, half_m: float, azimuths_rad: Array, across: int = 3) -> Terrain:
        """The same ground, prepared for positions within `half_m` of a centre (2,), at the azimuths (n,).

        The terrain itself where horizons cost little; else horizons at `across` x `across` points may be worked out.
        """
        return self

    def reshaped(self, shape: Array) -> Terrain:
        """The terrain shape[0] steeper and shape[1] larger (relative); only where `shape_sigma` is not zero."""
        return self

    def closed_form(self) -> Any:
        """Compiled bounds in closed form for the branch and bound, or None: `horizon_bounds_rad` is called instead."""
        return None

    @property
    def is_prepared(self) -> bool:
        """Whether `prepare` has nothing left to do."""
        return True

    def prepare(self, progress: Progress | None = None) -> None:  # noqa: B027 - the default has nothing to do
        """Work out, once, what the first call of `horizon_bounds_rad` needs."""
