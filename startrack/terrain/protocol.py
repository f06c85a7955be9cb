"""What the localizer asks of any ground: how high the horizon stands, and between which bounds over a box."""

from __future__ import annotations

from typing import Protocol

from startrack.frames import Site
from startrack.types import Array, Bools


class Terrain(Protocol):
    """A ground whose horizon hides stars. Positions are those of the CAMERA, east and north in enu [m].

    All methods are elementwise over their (broadcast) arguments; the horizon is an elevation in enu [rad], and a star
    is visible where its elevation exceeds it.
    """

    @property
    def name(self) -> str: ...
    @property
    def site(self) -> Site: ...
    @property
    def camera_height_m(self) -> float:
        """Of the camera above the ground."""
        ...

    @property
    def search_radius_m(self) -> float:
        """The camera is within this horizontal distance of the origin."""
        ...

    @property
    def reach_m(self) -> float:
        """Half side of the square that is searched: the search area and a margin to notice leaving it."""
        ...

    def horizon_rad(self, points_m: Array, azimuths_rad: Array) -> Array:
        """Horizon elevation (n,) seen from the points (n, 2) at the azimuths (n,)."""
        ...

    def horizon_bounds_rad(
        self, centres_m: Array, half_m: Array, azimuths_rad: Array, azimuth_half_rad: Array | float = 0.0
    ) -> tuple[Array, Array]:
        """Bounds (n,), (n,) that hold the horizon at every allowed point of the boxes |dx|, |dy| <= half (n,).

        And at every azimuth within `azimuth_half_rad` of the given ones.
        """
        ...

    def horizon_sigma_rad(self, points_m: Array, azimuths_rad: Array) -> Array:
        """Standard deviation (n,) of the horizon from the errors of the map."""
        ...

    def most_sigma_rad(self, centres_m: Array, half_m: float, azimuths_rad: Array, azimuth_half_rad: float) -> Array:
        """The largest of these (n,) over boxes and azimuths, as in `horizon_bounds_rad`."""
        ...

    def ground_m(self, points_m: Array) -> Array:
        """Height (n,) of the ground in enu."""
        ...

    def allowed(self, points_m: Array) -> Bools:
        """Whether a camera could stand at the points (..., 2): there is known ground under open sky."""
        ...

    def tells(self, azimuths_rad: Array, elevations_rad: Array) -> Bools:
        """Whether the terrain can speak of the rays (n,), from everywhere in the search area.

        Not where ground off its maps may stand, nor in the glare of a sunlit rim: such rays give no evidence.
        """
        ...

    def near(self, centre_m: Array, half_m: float, azimuths_rad: Array, across: int = 3) -> Terrain:
        """The same ground, quick to ask about places within `half_m` of one, at the azimuths (n,).

        Itself where it is quick anyway; else `across` times `across` places may be asked beforehand.
        """
        ...

    @property
    def common_sigma_rad(self) -> float:
        """Standard deviation of an error of the horizon that all azimuths and places share; 0: none."""
        ...
