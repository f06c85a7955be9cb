"""The solution of one image, with astropy's types."""

from __future__ import annotations

import os
from dataclasses import dataclass, replace
from datetime import UTC
from functools import cached_property
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from startrack import output
from startrack.api.values import ClockOffset, Orientation, Position, html_table
from startrack.chain import Located, Measured, Oriented, Outcome, Positioned, last_value
from startrack.frames import heading_pitch_roll_from_R_body_enu, latlon_from_enu

if TYPE_CHECKING:
    from astropy.coordinates import Angle, SkyCoord
    from astropy.table import QTable
    from astropy.time import Time

    from startrack.core.types import Array, Fix


@dataclass(frozen=True, eq=False, repr=False)  # eq: arrays have no single answer to ==
class Solution:
    """The solution of one image. `status` is ok, ambiguous or refused; values of stages not reached are None.

    A solution equals itself only; its values are computed once, at the first use.
    """

    result: Outcome
    kind: str = "fix"  # or identification, detections: of the function that returned it

    @property
    def status(self) -> str:
        return self.result.status

    @property
    def reason(self) -> str | None:
        return self.result.reason

    @property
    def message(self) -> str:
        return self.result.message

    def __bool__(self) -> bool:
        return self.status == "ok"

    @cached_property
    def position(self) -> Position | None:
        """East, north, up, their sigma and ellipse, latitude and longitude, with units; None unless located."""
        result = self.result
        if not isinstance(result, Positioned) or result.fix.ambiguous:
            return None
        from astropy import units as u
        from astropy.coordinates import Angle

        fix = result.fix
        east, north, up = fix.position_enu_m * u.m
        latlon_rad = latlon_from_enu(result.site, *fix.position_enu_m)
        latitude, longitude = (Angle(np.degrees(angle), u.deg) for angle in latlon_rad)
        return Position(
            east, north, up, fix.covariance_m2 * u.m**2, fix.radius95_m * u.m, fix.radius999_m * u.m, latitude,
            longitude, result.terrain.name, self._shown("position", "sky", "clock"),
        )  # fmt: skip

    @cached_property
    def attitude(self) -> Orientation | None:
        """Rotation, right ascension, declination and roll of the camera, heading and pitch of the rover."""
        result = last_value(self.result)
        if not isinstance(result, Oriented):
            return None
        from astropy import units as u
        from astropy.coordinates import Angle
        from scipy.spatial.transform import Rotation

        attitude = result.attitude
        ra, dec, roll = (Angle(np.degrees(angle), u.deg) for angle in output.boresight_rad(attitude.R_cam_icrs))
        sigma = np.sqrt(np.diag(attitude.covariance_rad2)) * output.ARCSEC_PER_RAD * u.arcsec
        has_lens_error = result.camera.covariance is not None
        rotation = Rotation.from_matrix(attitude.R_cam_icrs)
        found = Orientation(rotation, ra, dec, roll, sigma, has_lens_error, self._shown("attitude"))
        if not isinstance(result, Measured):
            return found
        body = output.R_body_enu(result)
        angles_rad = heading_pitch_roll_from_R_body_enu(body)
        heading, pitch, roll_body = (Angle(np.degrees(angle), u.deg) for angle in angles_rad)
        return replace(found, body=Rotation.from_matrix(body), heading=heading, pitch=pitch, roll_body=roll_body)

    @cached_property
    def clock(self) -> ClockOffset | None:
        """Offset (true minus stated time) and its sigma, with units; None where it is not estimated."""
        if not isinstance(self.result, Located) or self.result.fix.clock is None:
            return None
        from astropy import units as u

        clock = self.result.fix.clock
        return ClockOffset(clock.offset_s * u.s, clock.sigma_s * u.s, self._shown("clock"))

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

    def _shown(self, *groups: str) -> output.Rows:
        """The rows of the notebook's table of these groups of quantities."""
        return output.rows("notebook", output.stage_values(last_value(self.result)), groups)

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
        value = last_value(self.result)
        if not isinstance(value, Oriented):
            return None
        from astropy.coordinates import SkyCoord

        ra, dec, _ = output.boresight_rad(value.attitude.R_cam_icrs)
        return SkyCoord(ra, dec, unit="rad", frame="icrs")

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

        text = output.skyline_table_text(self.result.skyline, output.off_map(self.result).whole)
        return QTable.read(text, format="ascii.ecsv")

    @property
    def warnings(self) -> list[str]:
        """Facts in the image's file that were not used, and what the terrain does not cover or its file leaves out."""
        return self.result.warnings

    def to_dict(self) -> dict[str, Any]:
        """Content of `NAME.fix.json`, or `NAME.identification.json`, or `NAME.detections.json`."""
        return output.record_of(self.result, self.kind)

    def write(self, folder: str | os.PathLike[str], *, plots: bool = True, overwrite: bool = False) -> Path:
        """Write the files of the command (record, star table, world coordinates, picture); returns the record's path.

        Args:
            folder: of the files; it is made where it is missing.
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
