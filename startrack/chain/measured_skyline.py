"""A skyline that was measured elsewhere: from its file, or an array, to a position. No stars, and so no time."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from startrack.camera import Camera
from startrack.chain.inputs import angle_rad
from startrack.chain.near_attitude import REASON, read_near_attitude
from startrack.chain.pipeline import Run
from startrack.chain.stages import Inputs, Positioned, Refused
from startrack.core.errors import BadInput, NoSolution
from startrack.core.files import FilePath, printable
from startrack.core.limits import limited_time
from startrack.core.obstacles import column_names, read_columns
from startrack.core.types import MIDDLES_RAD, Array, Exposure, Fix, MeasuredSkyline, PositionPrior
from startrack.frames import R_enu_icrs, R_from_rotvec, Site, azel_from_rays, rays_from_azel
from startrack.localization import SkylinePoints, locate_points
from startrack.terrain import Terrain

HALF_TURN_RAD = np.pi + 1e-9
ANGLE_COLUMNS = ("azimuth_deg", "elevation_deg", "sigma_deg")
PIXEL_COLUMNS = ("x_px", "y_px")
PIXEL_SIGMA_PX = 1.0  # of a polyline whose file states none
LEAST_POINTS = 8
CORRELATION_RAD = np.radians(1.0)  # of the errors of heights along the azimuth, where nothing is stated


@dataclass(frozen=True)
class StatedAttitude:
    """The rotation (3, 3) of the camera from enu, by which pixels are directions."""

    R_cam_enu: Array

    @classmethod
    def of_angles(cls, azimuth_rad: float, pitch_rad: float, roll_rad: float) -> StatedAttitude:
        """Attitude with the optical axis at `azimuth_rad` from north through east and the elevation `pitch_rad`.

        With the roll about it, `roll_rad`, at 0 the image's top is up; a positive one turns the camera clockwise as
        seen from behind it, its right side down. Raises BadInput (bad_image).
        """
        if not np.isfinite([azimuth_rad, pitch_rad, roll_rad]).all() or abs(pitch_rad) >= np.pi / 2:
            raise BadInput(REASON, "the attitude is not AZ,PITCH,ROLL in degrees, with a pitch between -90 and 90")
        ahead = rays_from_azel(azimuth_rad, pitch_rad)
        right = np.array([np.cos(azimuth_rad), -np.sin(azimuth_rad), 0.0])
        return cls(R_from_rotvec([0.0, 0.0, -roll_rad]) @ np.stack([right, np.cross(ahead, right), ahead]))

    @classmethod
    def of_input(
        cls, given: FilePath | Sequence[Any] | None, site: Site | None, when: datetime | None
    ) -> StatedAttitude | None:
        """Attitude of a file, or of azimuth, pitch and roll (3,), angles or degrees; None where nothing is `given`.

        See `of_file`, for `site` and `when` too, and `of_angles`. Raises ValueError for what are no angles.
        """
        if given is None:
            return None
        if isinstance(given, str | os.PathLike):
            return cls.of_file(given, site, when)
        azimuth, pitch, roll = (angle_rad(one, "attitude") for one in given)
        return cls.of_angles(azimuth, pitch, roll)

    @classmethod
    def of_file(cls, path: FilePath, site: Site | None, when: datetime | None) -> StatedAttitude:
        """Attitude in the NAME.fix.json or NAME.identification.json at `path`, on the ground of a `site`.

        `when` is the time of a file without one. Raises BadInput: bad_image, bad_terrain, no_time.
        """
        near = read_near_attitude(path)
        if site is None:
            raise BadInput("bad_terrain", "an attitude among the stars needs a terrain with an [origin]")
        time = near.time_utc or when
        if time is None:
            raise BadInput("no_time", f"{printable(path)} has no time: give --time UTC")
        return cls(np.asarray(near.R_cam_icrs_at(None, None) @ R_enu_icrs(site, time).T))


@dataclass(frozen=True)
class SkylineErrors:
    """Stated errors of a skyline [rad]: of its attitude, and the correlation of its heights.

    Raises BadInput (bad_image) for numbers that are negative, not finite, or larger than a half turn.
    """

    heading_sigma_rad: float = 0.0
    tilt_sigma_rad: float = 0.0
    correlation_rad: float = CORRELATION_RAD

    @classmethod
    def of_inputs(cls, **stated: Any) -> SkylineErrors:
        """Errors of the `stated` heading_sigma, tilt_sigma and correlation, angles or degrees; None: not stated.

        Raises ValueError for what is no angle.
        """
        return cls(**{f"{name}_rad": angle_rad(one, name) for name, one in stated.items() if one is not None})

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not 0.0 <= value <= HALF_TURN_RAD:
                raise BadInput(REASON, f"{name} is {value:g}: give an angle from 0 to 180 degrees")


@dataclass(frozen=True, kw_only=True, eq=False)
class PlacedBySkyline(Positioned, Inputs):
    """The position by a skyline that was measured elsewhere; the exposure names it and holds no picture."""

    terrain: Terrain
    site: Site  # of the terrain
    fix: Fix
    skyline: MeasuredSkyline  # by sectors, with the attitude that suits the position
    near: PositionPrior | None = None  # of the position

    @property
    def warnings(self) -> list[str]:
        """Warnings of the exposure, what the terrain does not cover or state, and warnings of the position."""
        return [*super().warnings, *self.terrain.warnings(), *self.position_warnings]

    @property
    def evidence_source(self) -> str:
        """Source of the position: always skyline."""
        return "skyline"


def skyline_points(
    skyline: FilePath | ArrayLike,
    errors: SkylineErrors,
    camera: Camera | None = None,
    attitude: StatedAttitude | None = None,
    near: PositionPrior | None = None,
) -> SkylinePoints:
    """The points of a `skyline`: of a file, or rows (n, 3) of azimuth, elevation and sigma [deg].

    A file has the columns azimuth_deg, elevation_deg and sigma_deg (as the table that `locate` writes; rows without
    elevation are left out), or a polyline x_px, y_px and, if known, sigma_px, which needs `camera` and `attitude`.
    `errors` are those that all points share, `near` is a prior of the position. Raises BadInput: bad_image,
    no_calibration.
    """
    if not isinstance(skyline, str | os.PathLike):
        table = np.asarray(skyline, dtype=np.float64)
        if table.ndim != 2 or table.shape[1] != len(ANGLE_COLUMNS):
            raise BadInput(REASON, "skyline: rows of azimuth, elevation and sigma in degrees, (n, 3), are expected")
        return _of_angles(table, "skyline", errors, near)
    names, what = column_names(skyline, REASON), printable(skyline)
    if set(ANGLE_COLUMNS) <= set(names):
        return _of_angles(read_columns(skyline, ANGLE_COLUMNS, REASON, gaps_in=ANGLE_COLUMNS[1:]), what, errors, near)
    if not set(PIXEL_COLUMNS) <= set(names):
        raise BadInput(
            REASON, f"{what}: has neither the columns {', '.join(ANGLE_COLUMNS)} nor {', '.join(PIXEL_COLUMNS)}"
        )
    if camera is None:
        raise BadInput("no_calibration", f"{what}: a polyline in pixels needs a camera file (-c FILE)")
    if attitude is None:
        raise BadInput(REASON, f"{what}: a polyline in pixels needs an attitude (--attitude FILE|AZ,PITCH,ROLL)")
    table = read_columns(skyline, (*PIXEL_COLUMNS, *(["sigma_px"] if "sigma_px" in names else [])), REASON)
    sigma_px = table[:, 2] if table.shape[1] > 2 else np.full(len(table), PIXEL_SIGMA_PX)
    corner = np.array(camera.size_px) - 0.5
    outside = ((table[:, :2] < -0.5) | (table[:, :2] > corner)).any(axis=1)
    angle = camera.angle_rad(table[:, :2])
    if (outside | (angle > camera.calibrated_angle_rad)).any():
        x, y = table[np.argmax(outside | (angle > camera.calibrated_angle_rad)), :2]
        raise BadInput(REASON, f"{what}: ({x:g}, {y:g}) px is not in the calibrated part of the camera's picture")
    azimuth, elevation = azel_from_rays(camera.unproject(table[:, :2]) @ attitude.R_cam_enu)
    sigma = sigma_px * camera.mean_scale_rad_per_px(angle)
    return _of_angles(np.degrees(np.stack([azimuth, elevation, sigma], axis=1)), what, errors, near)


def _of_angles(table: Array, what: str, errors: SkylineErrors, near: PositionPrior | None) -> SkylinePoints:
    """The points of rows (n, 3) in degrees; `what` names them in messages."""
    known = table[~np.isnan(table[:, 1])]
    azimuth, elevation, sigma = known.T
    wrap = np.sort(np.mod(azimuth, 360.0))
    cause = ""
    if len(known) < LEAST_POINTS:
        cause = f"it has {len(known)} rows with an elevation, and {LEAST_POINTS} are needed"
    elif not np.isfinite(known).all() or (sigma <= 0.0).any():
        cause = "every row with an elevation needs a finite azimuth, and a finite sigma above 0"
    elif (np.abs(elevation) > 90.0).any() or (np.abs(azimuth) > 720.0).any():
        cause = "an elevation is beyond 90 degrees, or an azimuth beyond 720: are they in degrees?"
    elif (np.diff(wrap) == 0.0).any():
        cause = f"azimuth {wrap[np.argmax(np.diff(wrap) == 0.0)]:g} is given twice: give each azimuth one row"
    if cause:
        raise BadInput(REASON, f"{what}: {cause}")
    return SkylinePoints(
        azimuth_rad=np.mod(np.radians(azimuth), 2 * np.pi), elevation_rad=np.radians(elevation),
        sigma_rad=np.radians(sigma), near=near, **vars(errors),
    )  # fmt: skip


def skyline_exposure(skyline: FilePath | ArrayLike, time_utc: datetime | None, terrain: str | None) -> Exposure:
    """A value without a picture for the record of a `skyline`: its name and the hash of its content.

    `time_utc` and the name of the `terrain` are None where they are not known.
    """
    if isinstance(skyline, str | os.PathLike):
        path, content = os.fspath(skyline), Path(skyline).read_bytes()
    else:
        path, content = "", np.asarray(skyline, dtype=np.float64).tobytes()
    return Exposure(
        pixels_adu=np.zeros((1, 1), np.float32), name=Path(path).stem or "skyline", path=path,
        time_utc=time_utc, terrain=terrain, sha256=hashlib.sha256(content).hexdigest(),
    )  # fmt: skip


def locate_skyline(
    exposure: Exposure, points: SkylinePoints, terrain: Terrain, time_limit_s: float | None = None
) -> PlacedBySkyline | Refused:
    """The position of a camera above a `terrain`, which has a site, by the `points` of a skyline.

    `exposure` names them; `time_limit_s` is that of the processor time (None: no limit).
    """
    if terrain.site is None:
        raise BadInput("bad_terrain", f"terrain {terrain.name} has no [origin]")
    inputs = Inputs(exposure=exposure, terrain=terrain, localizer_name="posterior")
    run = Run(inputs)
    try:
        with limited_time(time_limit_s), run.stage("locate"):
            fix, seen = locate_points(points, terrain)
        shown = MeasuredSkyline(
            azimuth_rad=MIDDLES_RAD, elevation_rad=np.where(seen.used, seen.elevation_rad, np.nan),
            sigma_rad=np.sqrt(seen.points.variance_rad2), source=np.where(seen.used, "file", ""),
        )  # fmt: skip
        placed = PlacedBySkyline(
            exposure=exposure, terrain=terrain, localizer_name=inputs.localizer_name, site=terrain.site, fix=fix,
            skyline=shown, near=points.near,
        )  # fmt: skip
        return run.finish(placed)
    except (BadInput, NoSolution) as cause:
        return run.refuse(cause)
