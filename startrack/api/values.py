"""Position, attitude and clock as values with units, that print themselves in a terminal and in a notebook."""

from __future__ import annotations

from dataclasses import dataclass
from html import escape
from typing import TYPE_CHECKING

import numpy as np

from startrack.core.statistics import error_ellipse
from startrack.output import Rows

if TYPE_CHECKING:
    from astropy.coordinates import Angle
    from astropy.units import Quantity
    from scipy.spatial.transform import Rotation


class Shown:
    """Prints itself as rows of a name and a text."""

    shown: Rows

    def __repr__(self) -> str:
        width = max(len(name) for name, _ in self.shown)
        lines = (f"  {name:<{width}}  {text}" for name, text in self.shown)
        return "\n".join([type(self).__name__, *lines])

    def _repr_html_(self) -> str:
        return html_table(type(self).__name__, self.shown)


def html_table(caption: str, rows: Rows) -> str:
    """Rows as a table for a notebook."""
    body = "".join(
        f'<tr><th style="text-align:left">{escape(name)}</th><td style="text-align:left">{escape(text)}</td></tr>'
        for name, text in rows
    )
    return f'<table><caption style="text-align:left"><b>{escape(caption)}</b></caption><tbody>{body}</tbody></table>'


@dataclass(frozen=True, eq=False, repr=False)
class Ellipse(Shown):
    """One sigma of a position; 39 % of a Gaussian lie within."""

    semi_major: Quantity  # [m]
    semi_minor: Quantity  # [m]
    azimuth: Angle  # of the major axis, from north through east, [0, 180) deg

    @property
    def shown(self) -> Rows:  # type: ignore[override]
        """The ellipse in one row."""
        lengths = f"{self.semi_major:.2f} by {self.semi_minor:.2f}"
        return [("one sigma", f"{lengths}, long axis at azimuth {self.azimuth.deg:.1f}°")]


@dataclass(frozen=True, eq=False, repr=False)
class Position(Shown):
    """Position of the camera: the posterior's mean in the terrain's frame `enu`, with its uncertainty.

    Covariance and circles of a method that states none are infinite.
    """

    east: Quantity  # [m] from the terrain's origin
    north: Quantity  # [m]
    up: Quantity  # [m]
    covariance: Quantity  # (2, 2) of (east, north) [m2]
    radius95: Quantity  # [m] of the circle about the position that holds 95 % of the posterior
    radius999: Quantity  # [m], 99.9 %
    latitude: Angle
    longitude: Angle  # east positive, (-180, 180] deg
    terrain: str
    shown: Rows  # name and text of each quantity of the table

    @property
    def sigma(self) -> Quantity:
        """Standard deviations (2,) of east and north [m]."""
        return np.sqrt(np.diagonal(self.covariance))

    @property
    def ellipse(self) -> Ellipse:
        """The covariance as an ellipse of one sigma; of an infinite one both semi-axes are infinite."""
        from astropy import units as u
        from astropy.coordinates import Angle

        covariance_m2 = self.covariance.to_value(u.m**2)
        if not np.isfinite(covariance_m2).all():
            return Ellipse(np.inf * u.m, np.inf * u.m, Angle(0.0, u.deg))
        major_m, minor_m, azimuth_rad = error_ellipse(covariance_m2)
        return Ellipse(major_m * u.m, minor_m * u.m, Angle(np.degrees(azimuth_rad), u.deg))


@dataclass(frozen=True, eq=False, repr=False)
class Orientation(Shown):
    """Attitude of the camera to the stars and, with a terrain and a time, of the rover."""

    rotation: Rotation  # from icrs to cam: rotation.apply(rays_icrs) are rays_cam
    ra: Angle  # of the camera's axis, ICRS
    dec: Angle
    roll: Angle  # position angle of the image's top, from north through east
    sigma: Quantity  # (3,) of rotations about cam x, y, z [arcsec]
    lens_error_included: bool  # whether sigma holds the lens's errors: the camera has a covariance
    shown: Rows  # name and text of each quantity of the table
    body: Rotation | None = None  # from enu to the rover's body
    heading: Angle | None = None  # azimuth of body x (forward)
    pitch: Angle | None = None  # nose up positive
    roll_body: Angle | None = None  # right side down positive


@dataclass(frozen=True, eq=False, repr=False)
class ClockOffset(Shown):
    """Error of the stated time, as the image shows it."""

    offset: Quantity  # [s] true minus stated time
    sigma: Quantity  # [s] standard deviation of the offset
    shown: Rows  # name and text of each quantity of the table
