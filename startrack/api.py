"""The library's front door: a picture to a solution that prints itself, with astropy's types at the edge."""

from __future__ import annotations

import os
from dataclasses import dataclass
from datetime import UTC
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any

from startrack import pipeline
from startrack.camera import Camera
from startrack.catalog import load_catalog
from startrack.given import Picture, When, angle_rad, given_camera, given_exposure, given_terrain
from startrack.report import result_dict, summary_line, verbose_text, write_json, write_results
from startrack.report.result import boresight_rad, detection_dict, identification_dict
from startrack.terrain import Terrain
from startrack.types import Array

if TYPE_CHECKING:
    from astropy.coordinates import SkyCoord
    from astropy.table import QTable
    from astropy.time import Time
    from astropy.units import Quantity


@dataclass(frozen=True, repr=False)
class Solution:
    """What became of one picture. `status` is ok, ambiguous or refused; what was not reached is None."""

    result: pipeline.Result

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

    @property
    def position_m(self) -> Array | None:
        """The camera's (east, north, up) [m] from the terrain's origin; None unless the status is ok."""
        return self.result.fix.position_enu_m if self.result.fix is not None and self else None

    @property
    def covariance_m2(self) -> Array | None:
        """Of (east, north), (2, 2) [m2]."""
        return self.result.fix.covariance_m2 if self.result.fix is not None and self else None

    @property
    def radius95_m(self) -> float | None:
        """Radius [m] of the circle about the position that holds 95 % of the posterior."""
        return self.result.fix.radius95_m if self.result.fix is not None and self else None

    @property
    def modes(self) -> QTable | None:
        """Every place that fits: east, north, weight; heaviest first."""
        if self.result.fix is None:
            return None
        from astropy import units as u
        from astropy.table import QTable

        modes = self.result.fix.modes
        east, north = [m.east_m for m in modes] * u.m, [m.north_m for m in modes] * u.m
        return QTable({"east": east, "north": north, "weight": [m.weight for m in modes]})

    @property
    def time(self) -> Time | None:
        """Middle of the exposure, UTC."""
        if self.result.exposure.time_utc is None:
            return None
        from astropy.time import Time

        return Time(self.result.exposure.time_utc.astimezone(UTC).replace(tzinfo=None), scale="utc")

    @property
    def boresight(self) -> SkyCoord | None:
        """Where the camera's axis points, ICRS."""
        if self.result.attitude is None:
            return None
        from astropy.coordinates import SkyCoord

        ra, dec, _ = boresight_rad(self.result.attitude.R_cam_icrs)
        return SkyCoord(ra, dec, unit="rad", frame="icrs")

    @property
    def stars(self) -> QTable | None:
        """The star table: every catalogue star in view, with units."""
        if self.result.stars is None or self.result.attitude is None:
            return None
        from astropy.table import QTable

        from startrack.report.star_table import star_table_text

        return QTable.read(star_table_text(self.result), format="ascii.ecsv")

    def to_dict(self) -> dict[str, Any]:
        """What `NAME.fix.json` holds (or, without a terrain, the identification; or the detections)."""
        if self.result.terrain is not None:
            return result_dict(self.result)
        return identification_dict(self.result) if self.result.stars is not None else detection_dict(self.result)

    def write(self, folder: str | os.PathLike[str], *, plots: bool = True) -> Path:
        """The files that `startrack locate` writes (the record alone without a terrain); returns the record's path."""
        name, out = self.result.exposure.name or "image", Path(folder)
        out.mkdir(parents=True, exist_ok=True)
        if self.result.terrain is None:
            kind = "identification" if self.result.stars is not None else "detections"
            write_json(out / f"{name}.{kind}.json", self.to_dict())
            return out / f"{name}.{kind}.json"
        write_results(self.result, out / f"{name}.fix.json", plots=plots)
        return out / f"{name}.fix.json"

    def __repr__(self) -> str:
        return summary_line(self.result)

    __str__ = __repr__

    def _repr_html_(self) -> str:
        text = escape(f"{summary_line(self.result)}\n{verbose_text(self.result)}")
        return f"<pre>{text}</pre>"


def locate(
    image: Picture,
    *,
    camera: str | Camera | None = None,
    terrain: str | Terrain | None = None,
    time: When = None,
    settings: pipeline.Settings | None = None,
) -> Solution:
    """Position and attitude from a picture of the stars.

    `image` is a file, an array (H, W) of raw counts, or an Exposure; `camera` and `terrain` are files, names of shipped
    ones, or the objects; `time` is the middle of the exposure: text, datetime or astropy Time (any scale). What is not
    given comes from the image's sidecar or header. Raises BadInput for a file that cannot be used; a picture that
    cannot be solved gives a Solution that says why.
    """
    exposure = given_exposure(image, time)
    known = given_camera(camera, exposure), given_terrain(terrain, exposure)
    return Solution(pipeline.locate(exposure, *known, load_catalog(), settings))


def identify(
    image: Picture, *, camera: str | Camera | None = None, time: When = None, fov: float | Quantity | None = None
) -> Solution:
    """Stars and attitude only: no terrain needed, nor a time.

    With `fov` no camera either: an angle, or a number of degrees, good to 10 %; across the image's width below 100
    degrees, else across the image circle. The lens found is then `solution.result.camera`.
    """
    exposure = given_exposure(image, time)
    if fov is not None:
        return Solution(pipeline.identify_blind(exposure, angle_rad(fov), load_catalog()))
    return Solution(pipeline.identify(exposure, given_camera(camera, exposure), load_catalog()))


def detect(image: Picture, *, camera: str | Camera | None = None) -> Solution:
    """Centroids only; with a camera their fluxes are in electrons."""
    exposure = given_exposure(image, None)
    known = camera is not None or exposure.camera is not None
    return Solution(pipeline.detect(exposure, given_camera(camera, exposure) if known else None))
