"""The part of the sky at which a camera points, where a user states it: fewer attitudes are tried there by chance."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from startrack.core.types import Array, Bools
from startrack.frames import angle_between_rad, rays_from_azel

LARGEST_RADIUS_DEG = 180.0  # the whole sky
RIGHT_ASCENSIONS_DEG = -180.0, 360.0  # of both habits


@dataclass(frozen=True)
class NearSky:
    """A cap of the sky that contains the point on the camera's optical axis; the rotation about it is free.

    `ra_rad`, `dec_rad`: its centre, ICRS. `radius_rad`: above 0, at most pi.
    """

    ra_rad: float
    dec_rad: float
    radius_rad: float

    @classmethod
    def from_degrees(cls, ra_dec_radius: ArrayLike) -> NearSky:
        """The cap of `ra_dec_radius` (3,): right ascension, declination and radius in degrees. Raises ValueError."""
        try:
            ra, dec, radius = (float(one) for one in np.asarray(ra_dec_radius, dtype=float))
        except (TypeError, ValueError) as cause:
            raise ValueError("is not RA,DEC,RADIUS in degrees, as 83.6,-5.4,10") from cause
        if not RIGHT_ASCENSIONS_DEG[0] <= ra <= RIGHT_ASCENSIONS_DEG[1]:
            raise ValueError(f"RA {ra:g} is not between {RIGHT_ASCENSIONS_DEG[0]:g} and {RIGHT_ASCENSIONS_DEG[1]:g}")
        if not abs(dec) <= 90.0:
            raise ValueError(f"DEC {dec:g} is not between -90 and 90")
        if not 0.0 < radius <= LARGEST_RADIUS_DEG:
            raise ValueError(f"RADIUS {radius:g} is not above 0 and up to {LARGEST_RADIUS_DEG:g}")
        return cls(*np.radians([ra, dec, radius]).tolist())

    @property
    def part(self) -> float:
        """Part of the whole sky: the probability that an attitude which only chance proposes points here."""
        return float(np.sin(0.5 * self.radius_rad) ** 2)

    def contains(self, R_cam_icrs: Array, margin_rad: float = 0.0) -> Bools:
        """Whether the attitudes `R_cam_icrs` (..., 3, 3), known to `margin_rad`, may point into it: (...)."""
        axis = rays_from_azel(0.5 * np.pi - self.ra_rad, self.dec_rad)  # right ascension runs from x to y
        return np.asarray(angle_between_rad(R_cam_icrs[..., 2, :], axis) <= self.radius_rad + margin_rad)

    def __str__(self) -> str:
        """Text of radius and centre [deg] for messages."""
        ra, dec, radius = np.degrees([self.ra_rad, self.dec_rad, self.radius_rad])
        return f"{radius:.4g} degrees about RA {ra:.4g}, DEC {dec:.4g}"
