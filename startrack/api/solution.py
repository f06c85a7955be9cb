"""The solution of one image: what the chain returns, and the quantities of the table with astropy's types."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import UTC
from functools import cached_property
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from startrack import output
from startrack.chain import Located, Oriented, Outcome, Positioned, last_value
from startrack.core.statistics import error_ellipse

if TYPE_CHECKING:
    from astropy.coordinates import Angle, SkyCoord
    from astropy.table import QTable
    from astropy.time import Time
    from astropy.units import Quantity
    from scipy.spatial.transform import Rotation

    from startrack.core.types import Array, Fix


class Shown:
    """Base of values that print themselves as rows of a name and a text, in a notebook as a table."""

    shown: output.Rows

    def __repr__(self) -> str:
        width = max(len(name) for name, _ in self.shown)
        lines = (f"  {name:<{width}}  {text}" for name, text in self.shown)
        return "\n".join([type(self).__name__, *lines])

    def _repr_html_(self) -> str:
        return html_table(type(self).__name__, self.shown)


def html_table(caption: str, rows: output.Rows) -> str:
    """Rows as a table for a notebook."""
    body = "".join(
        f'<tr><th style="text-align:left">{escape(name)}</th><td style="text-align:left">{escape(text)}</td></tr>'
        for name, text in rows
    )
    return f'<table><caption style="text-align:left"><b>{escape(caption)}</b></caption><tbody>{body}</tbody></table>'


@dataclass(frozen=True, eq=False, repr=False)
class Section(Shown):
    """The quantities of one section of the record as attributes: their keys without the unit, which the values have.

    A quantity that is not stated is infinite; one that is not known is None.
    """

    quantities: Mapping[str, Any]
    shown: output.Rows

    def __getattr__(self, name: str) -> Any:
        try:
            return vars(self)["quantities"][name]
        except KeyError:
            raise AttributeError(f"{type(self).__name__} has no attribute {name!r}") from None

    def __dir__(self) -> list[str]:
        return [*super().__dir__(), *self.quantities]


@dataclass(frozen=True, eq=False, repr=False)
class Ellipse(Shown):
    """Ellipse of one sigma of a position; 39 % of a Gaussian lie within."""

    semi_major: Quantity  # [m]
    semi_minor: Quantity  # [m]
    azimuth: Angle  # of the major axis, from north through east, [0, 180) deg

    @property
    def shown(self) -> output.Rows:  # type: ignore[override]
        """The ellipse in one row."""
        lengths = f"{self.semi_major:.2f} by {self.semi_minor:.2f}"
        return [("one sigma", f"{lengths}, long axis at azimuth {self.azimuth.deg:.1f}°")]


class Position(Section):
    """Position of the camera, the posterior's mean in the terrain's frame `enu`: `east`, `north`, `up`, `latitude`, ...

    `covariance` (2, 2) is that of (east, north), `radius95` and `radius999` are the circles about the position: of a
    method that states none they are infinite.
    """

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


class Orientation(Section):
    """Attitude of the camera to the stars, `ra`, `dec`, `roll`, and with a terrain and a time `heading`, `pitch`, ...

    `sigma` (3,) is that of rotations about cam x, y, z; it holds the lens's errors where `lens_error_included` is true.
    """

    @property
    def rotation(self) -> Rotation:
        """Rotation from icrs to cam: rotation.apply(rays_icrs) are rays_cam."""
        from scipy.spatial.transform import Rotation

        return Rotation.from_quat(self.quat_xyzw_cam_icrs)

    @property
    def body(self) -> Rotation | None:
        """Rotation from enu to the rover's body; None without a terrain or a time."""
        from scipy.spatial.transform import Rotation

        quaternion = self.quat_xyzw_body_enu
        return None if quaternion is None else Rotation.from_quat(quaternion)


class ClockOffset(Section):
    """Error of the stated time, as the image shows it: `offset`, true minus stated time, and its `sigma`."""


OneSection = TypeVar("OneSection", bound=Section)


@dataclass(frozen=True, eq=False, repr=False)  # eq: arrays have no single answer to ==
class Solution:
    """The solution of one image. `status` is ok, ambiguous or refused; values of stages not reached are None.

    A solution equals itself only; its values are computed once, at the first use.
    """

    result: Outcome
    kind: str = "fix"  # or identification, detections: of the function that returned it

    @property
    def status(self) -> str:
        """Status: ok, ambiguous or refused."""
        return self.result.status

    @property
    def reason(self) -> str | None:
        """Code of the reason where the status is not ok, else None."""
        return self.result.reason

    @property
    def message(self) -> str:
        """Text of one line about the status; empty where it is ok."""
        return self.result.message

    def __bool__(self) -> bool:
        return self.status == "ok"

    @cached_property
    def position(self) -> Position | None:
        """East, north, up, their sigma and ellipse, latitude and longitude, with units; None unless located."""
        return self._section(Position, "position", "sky", "clock")

    @cached_property
    def attitude(self) -> Orientation | None:
        """Rotation, right ascension, declination and roll of the camera, heading and pitch of the rover."""
        return self._section(Orientation, "attitude")

    @cached_property
    def clock(self) -> ClockOffset | None:
        """Offset (true minus stated time) and its sigma, with units; None where it is not estimated."""
        is_estimated = isinstance(self.result, Located) and self.result.fix.clock is not None
        return self._section(ClockOffset, "clock") if is_estimated else None

    def _section(self, kind: type[OneSection], *sections: str) -> OneSection | None:
        """The quantities of the first of `sections` with the notebook's rows of all; None where none is determined."""
        value = last_value(self.result)
        found = output.section_values(value, sections[0])
        if not found:
            return None
        rows = output.rows("notebook", output.stage_values(value), sections)
        return kind({one.name: _with_unit(entry, one) for one, entry in found}, rows)

    @property
    def heading(self) -> Angle | None:
        """Azimuth of the rover's nose, from north through east; None without attitude, terrain or time."""
        attitude = self.attitude
        return None if attitude is None else attitude.heading

    @property
    def position_m(self) -> Array | None:
        """The camera's (east, north, up) [m] from the terrain's origin; None unless the status is ok."""
        fix = self._fix
        return None if fix is None else fix.position_enu_m

    @property
    def covariance_m2(self) -> Array | None:
        """Covariance of (east, north), (2, 2) [m2]; infinite of a method that states none."""
        fix = self._fix
        return None if fix is None else fix.covariance_m2

    @property
    def radius95_m(self) -> float | None:
        """Radius [m] of the circle that holds 95 % of the posterior; infinite of a method that states none."""
        fix = self._fix
        return None if fix is None else fix.radius95_m

    @property
    def _fix(self) -> Fix | None:
        return self.result.fix if isinstance(self.result, Positioned) and self else None

    @cached_property
    def modes(self) -> QTable | None:
        """Every position that fits: east, north, weight, radius95 and radius999; heaviest first.

        The circles hold their part of that mode alone; they are infinite where none is stated.
        """
        if not isinstance(self.result, Positioned):
            return None
        from astropy import units as u
        from astropy.table import QTable

        modes = self.result.fix.modes
        east, north = [m.east_m for m in modes] * u.m, [m.north_m for m in modes] * u.m
        circles = {"radius95": [m.radius95_m for m in modes] * u.m, "radius999": [m.radius999_m for m in modes] * u.m}
        return QTable({"east": east, "north": north, "weight": [m.weight for m in modes], **circles})

    @cached_property
    def time(self) -> Time | None:
        """Middle of the exposure, UTC."""
        if self.result.exposure.time_utc is None:
            return None
        from astropy.time import Time

        return Time(self.result.exposure.time_utc.astimezone(UTC).replace(tzinfo=None), scale="utc")

    @cached_property
    def boresight(self) -> SkyCoord | None:
        """Direction of the camera's axis, ICRS."""
        if self.attitude is None:
            return None
        from astropy.coordinates import SkyCoord

        return SkyCoord(self.attitude.ra, self.attitude.dec, frame="icrs")

    @cached_property
    def stars(self) -> QTable | None:
        """The star table: every catalogue star in view, with units."""
        value = last_value(self.result)
        if not isinstance(value, Oriented):
            return None
        from astropy.table import QTable

        return QTable.read(output.star_table_text(value, catalog=True), format="ascii.ecsv")

    @cached_property
    def skyline(self) -> QTable | None:
        """The skyline that the image shows: azimuth, elevation, sigma [deg], source, off_map; None unless located."""
        if not isinstance(self.result, Positioned) or self.result.skyline is None:
            return None
        from astropy.table import QTable

        text = output.skyline_table_text(self.result.skyline, output.off_map(self.result).likely)
        return QTable.read(text, format="ascii.ecsv")

    @property
    def warnings(self) -> list[str]:
        """Facts in the image's file that were not used, and what the terrain does not cover or its file leaves out."""
        return self.result.warnings

    def to_dict(self) -> dict[str, Any]:
        """Content of `NAME.fix.json`, or `NAME.identification.json`, or `NAME.detections.json`."""
        return output.result_dict(self.result, self.kind)

    def write(self, folder: str | os.PathLike[str], *, plots: bool = True, overwrite: bool = False) -> Path:
        """Write the files of the command (record, star table, world coordinates, picture); returns the record's path.

        Args:
            folder: place of the files; it is made where it is missing.
            plots: whether the picture is written.
            overwrite: whether the record of another image of this name may be replaced.

        Companions of an earlier result of this kind and name are removed; those of a more complete result (`locate`
        before `identify` before `detect`) stay, and this one's then have its kind in their names.

        Raises:
            BadInput: bad_image if the files cannot be written, or the record of another image exists.
        """
        path = Path(folder) / f"{self.result.exposure.name or 'image'}.{self.kind}.json"
        remedy = "write elsewhere, or with overwrite=True"
        output.prepare_folder(path, self.result.exposure.sha256, overwrite=overwrite, remedy=remedy)
        output.write_results(self.result, path, plots=plots)
        return path

    def __repr__(self) -> str:
        return output.summary_line(self.result)

    __str__ = __repr__

    def _repr_html_(self) -> str:
        tables = [part._repr_html_() for part in (self.position, self.attitude) if part is not None]
        notes = [("warning", text) for text in self.warnings]
        tables += [html_table("Warnings", notes)] if notes else []
        return f"<p>{escape(output.summary_line(self.result))}</p>" + "".join(tables)


def _with_unit(value: Any, quantity: output.Quantity) -> Any:
    """Value of a `quantity` as an Angle or Quantity of astropy; as it is where it has no unit, or is not known."""
    if value is None or quantity.astropy_unit is None:
        return value
    from astropy.coordinates import Angle
    from astropy.units import Quantity

    is_angle = quantity.astropy_unit == "deg" and isinstance(value, float)
    return (Angle if is_angle else Quantity)(value, quantity.astropy_unit)
