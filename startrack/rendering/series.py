"""Scenes at given or random poses, or along a rover's drive with its odometry, in one crater under one true sky."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from enum import IntEnum
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from startrack.camera import Camera
from startrack.catalog import NIGHT_RAD, apparent_bodies, apparent_stars, sun_elevation_rad
from startrack.core import MAX_COUNT, SKY_V_MAG_ARCSEC2
from startrack.core.files import FilePath, printable
from startrack.core.obstacles import read_columns
from startrack.core.types import Array, BadInput, Stars, Value, array, rotation, vector
from startrack.estimation.observations import OdometryErrors
from startrack.frames import R_body_enu_from_heading_pitch_roll, R_enu_icrs, sky_rotvec_rad
from startrack.rendering.compose import draw_hot_pixels
from startrack.rendering.scene import Scene
from startrack.rendering.sources import draw_field_stars, draw_v_errors, exposure_for_snr
from startrack.terrain import GroundBrightness, Terrain, require_place, require_site

if TYPE_CHECKING:
    from startrack.catalog import StarCatalog

PATH_COLUMNS = ("east_m", "north_m")
STEP_ROUNDING_1 = 1e-9  # relative, of a number of steps: a path of whole steps has a frame at its end
EXPOSURE_V_MAG = 6.0  # of a star on the axis that the default exposure just shows
FAINTEST_V_MAG = 10.0  # of the stars in the sky
WALL_REFLECTANCE_1 = 0.04  # of the sky's light, by ground of which nothing is stated
RANDOM_TIMES = datetime(2024, 1, 1, tzinfo=UTC), datetime(2034, 1, 1, tzinfo=UTC)
MAX_POSITION_TRIES = 1000
# Streams of the seed. Sky and sensor are the same in every exposure of a series: errors that exposures share.
Stream = IntEnum("Stream", "SKY SENSOR EXPOSURE ODOMETRY", start=0)


@dataclass(frozen=True, kw_only=True)
class Drive(Value):
    """Straight lines between waypoints at one speed; the rover's nose points along its path.

    Raises ValueError for fewer than two waypoints, one twice in a row, numbers that are not finite, and a speed that
    is not above 0.
    """

    waypoints_m: Array = array("n", 2)  # east, north
    speed_m_s: float

    def __post_init__(self) -> None:
        super().__post_init__()
        if len(self.waypoints_m) < 2:
            raise ValueError(f"{len(self.waypoints_m)} waypoint(s): a path has at least two")
        if not np.isfinite(self.distance_m).all():
            raise ValueError("a waypoint is infinite, or the path is")
        same = np.flatnonzero(np.diff(self.distance_m) == 0)
        if len(same):
            raise ValueError(f"waypoints {same[0] + 1} and {same[0] + 2} are the same")
        if not (np.isfinite(self.speed_m_s) and self.speed_m_s > 0):
            raise ValueError(f"speed {self.speed_m_s:g} m/s is not above 0")

    @cached_property
    def distance_m(self) -> Array:
        """Distance (n,) [m] along the path from its first waypoint to each."""
        with np.errstate(over="ignore", invalid="ignore"):  # no finite distance then
            return np.append(0.0, np.cumsum(np.linalg.norm(np.diff(self.waypoints_m, axis=0), axis=1)))

    def count_frames(self, every_s: float) -> int:
        """Number of exposures from the path's start to its end, one `every_s` [s].

        Raises BadInput (bad_odometry) for fewer than two or more than a million.
        """
        duration_s = float(self.distance_m[-1]) / self.speed_m_s
        steps = int(min(duration_s / every_s * (1 + STEP_ROUNDING_1), 1e15))
        if not 1 <= steps < MAX_COUNT:
            raise BadInput(
                "bad_odometry",
                f"the path of {self.distance_m[-1]:g} m takes {duration_s:g} s at {self.speed_m_s:g} m/s: one exposure "
                f"every {every_s:g} s gives {1 + steps}; 2 to {MAX_COUNT} are possible",
            )
        return 1 + steps

    def position_m(self, time_s: float) -> Array:
        """Position (2,) [m], east and north, `time_s` after the start."""
        along_m = self.speed_m_s * time_s
        return np.array([np.interp(along_m, self.distance_m, axis) for axis in self.waypoints_m.T])

    def heading_rad(self, time_s: float) -> float:
        """Azimuth [rad] of the path `time_s` after the start; at a waypoint that of the line that begins there."""
        along_m = self.speed_m_s * time_s * (1 + STEP_ROUNDING_1)
        line = min(int(np.searchsorted(self.distance_m, along_m, side="right")), len(self.waypoints_m) - 1)
        east_m, north_m = self.waypoints_m[line] - self.waypoints_m[line - 1]
        return float(np.arctan2(east_m, north_m) % (2 * np.pi))


def read_drive(path: FilePath, speed_m_s: float) -> Drive:
    """The drive at `speed_m_s` along the waypoints in a CSV file with a header line and columns east_m and north_m.

    `path` is the file's. Raises BadInput (bad_odometry) with the file and the cause.
    """
    waypoints_m = read_columns(path, PATH_COLUMNS, "bad_odometry")
    try:
        return Drive(waypoints_m=waypoints_m, speed_m_s=speed_m_s)
    except ValueError as cause:
        raise BadInput("bad_odometry", f"{printable(path)}: {cause}") from cause


def draw_odometry(
    position_enu_m: Array, R_body_enu: Array, *, errors: OdometryErrors, rng: np.random.Generator
) -> tuple[Array, Array]:
    """Odometry of true poses: positions (n, 3) [m] and rotations R_odom_body (n, 3, 3).

    The poses are `position_enu_m` (n, 3) and `R_body_enu` (n, 3, 3); `rng` draws the `errors` of the increments.

    The frame `odom` begins at the first pose; it is level, and its heading is drawn. The error of each increment is
    independent and normal on each horizontal axis; the errors of the increments add up along the drive. Heights and
    attitudes are exact.
    """
    from startrack.frames import R_from_rotvec

    R_odom_enu = R_from_rotvec([0.0, 0.0, rng.uniform(0, 2 * np.pi)])
    increments_m = np.diff(position_enu_m, axis=0)
    increments_m[:, :2] += errors.sigma_m(increments_m)[:, None] * rng.standard_normal((len(increments_m), 2))
    position_m = np.concatenate([np.zeros((1, 3)), np.cumsum(increments_m, axis=0)])
    return position_m @ R_odom_enu.T, R_odom_enu @ np.swapaxes(R_body_enu, -1, -2)


@dataclass(frozen=True, kw_only=True)
class Pose(Value):
    """Pose of the rover in an exposure, with its time."""

    time_utc: datetime  # mid-exposure
    position_enu_m: Array = vector()  # the camera's centre, which is the body's origin
    R_body_enu: Array = rotation()


@dataclass(frozen=True, kw_only=True)
class Series:
    """Settings of a series of exposures; fields that are None are drawn from the seed for each exposure.

    With `every_s` the exposures are at equal steps of time: at rest, with the pose of the first one, or on a `drive`.
    Raises BadInput (bad_odometry) for a drive that leaves the terrain's search area.
    """

    camera: Camera
    terrain: Terrain
    catalog: StarCatalog
    seed: int
    time_utc: datetime | None = None  # mid-exposure
    east_m: float | None = None
    north_m: float | None = None
    heading_rad: float | None = None
    pitch_rad: float | None = None
    roll_rad: float | None = None
    max_tilt_rad: float = float(np.radians(5.0))  # of random tilts: uniform over the cap of this radius
    exposure_s: float | None = None  # None: a V 6 star on the axis reaches 5 sigma
    sky_v_mag_arcsec2: float | None = SKY_V_MAG_ARCSEC2
    sky_gradient: float = 0.0
    sky_gradient_azimuth_rad: float = 0.0
    wall_reflectance: float | None = None  # of the sky's light; None: as the terrain states, else WALL_REFLECTANCE_1
    faint_v_mag: float | None = FAINTEST_V_MAG  # random stars that Hipparcos lacks are added down to this; None: none
    flux_scatter_mag: float = 0.03  # beyond the catalogue's own errors; 0: neither
    hot_pixels: int = 200
    cosmic_rays: int = 5
    every_s: float | None = None  # between exposures; the rover is then at rest, or on its drive. None: times are drawn
    drive: Drive | None = None  # with `every_s`; it gives positions and headings
    camera_ref: str | None = None
    terrain_ref: str | None = None

    def __post_init__(self) -> None:
        if self.drive is not None and self.every_s is None:
            raise ValueError("Series.drive needs every_s")
        if self.every_s is not None and not self.every_s > 0:
            raise ValueError(f"Series.every_s must be positive, not {self.every_s!r}")
        if self.drive is not None:  # where all waypoints are in the search area, so are the lines between them
            away_m = np.linalg.norm(self.drive.waypoints_m, axis=1)
            outside = np.flatnonzero(away_m > self.terrain.search_radius_m)
            if len(outside):
                east_m, north_m = self.drive.waypoints_m[outside[0]]
                raise BadInput(
                    "bad_odometry",
                    f"{len(outside)} of {len(away_m)} waypoints are outside the search area of {self.terrain.name}, "
                    f"{self.terrain.search_radius_m:g} m about its origin; the first is {east_m:g} m east, "
                    f"{north_m:g} m north",
                )

    @cached_property
    def exposure_used_s(self) -> float:
        """The exposure [s], given or default. Raises BadInput bad_calibration when the camera has no sensor."""
        if self.exposure_s is not None:
            return self.exposure_s
        if self.camera.sensor is None:
            raise BadInput("bad_calibration", f"camera {self.camera.name} has no [sensor]: nothing to render with")
        return exposure_for_snr(self.camera, self.sky_v_mag_arcsec2, v_mag=EXPOSURE_V_MAG)

    @property
    def ground_brightness(self) -> GroundBrightness:
        """Light of the ground over that of the sky, given, the terrain's or default."""
        stated = None if self.wall_reflectance is None else GroundBrightness.of(self.wall_reflectance)
        return stated or self.terrain.file.ground_brightness or GroundBrightness.of(WALL_REFLECTANCE_1)

    def scene(
        self, number: int, name: str = "", sky: tuple[Stars, Array] | None = None
    ) -> tuple[Scene, np.random.Generator]:
        """The scene of exposure `number`, called `name`, and the generator to render it with.

        `sky` is what `draw_sky` gives for the time of the exposure, if it has been drawn before.

        Raises BadInput: bad_terrain when no position can be found, no_time outside the ephemeris.
        """
        pose, rng = self._pose_and_rng(number)
        time, site, exposure_s = pose.time_utc, require_site(self.terrain), self.exposure_used_s
        stars, v_error_mag = sky or self.draw_sky(time)
        sensor_rng = np.random.default_rng([self.seed, Stream.SENSOR])
        scene = Scene(
            camera=self.camera,
            terrain=self.terrain,
            stars=stars,
            v_error_mag=v_error_mag,
            bodies=apparent_bodies(site, time),
            position_enu_m=pose.position_enu_m,
            R_cam_enu=self.camera.R_body_cam.T @ pose.R_body_enu,
            R_enu_icrs=R_enu_icrs(site, time),
            sky_rotvec_rad=sky_rotvec_rad(site, time, exposure_s),
            exposure_s=exposure_s,
            extinction_mag=0.0 if site.air is None else site.air.rendered_extinction_mag,
            sky_v_mag_arcsec2=self.sky_v_mag_arcsec2,
            sky_gradient=self.sky_gradient,
            sky_gradient_azimuth_rad=self.sky_gradient_azimuth_rad,
            ground_brightness=self.ground_brightness,
            hot_pixels=draw_hot_pixels(self.camera.size_px, self.hot_pixels, rng=sensor_rng),
            cosmic_rays=self.cosmic_rays,
            name=name,
            time_utc=time,
            camera_ref=self.camera_ref,
            terrain_ref=self.terrain_ref,
        )
        return scene, rng

    def pose(self, number: int) -> Pose:
        """Time and pose of exposure `number`. Raises BadInput (bad_terrain: no camera can stand there; no_time)."""
        return self._pose_and_rng(number)[0]

    def odometry(self, poses: Sequence[Pose], errors: OdometryErrors) -> tuple[Array, Array]:
        """Odometry with `errors` of the first exposures of the series, whose true poses are `poses`.

        See `draw_odometry`.
        """
        position_enu_m = np.array([pose.position_enu_m for pose in poses])
        R_body_enu = np.array([pose.R_body_enu for pose in poses])
        rng = np.random.default_rng([self.seed, Stream.ODOMETRY])
        return draw_odometry(position_enu_m, R_body_enu, errors=errors, rng=rng)

    def _pose_and_rng(self, number: int) -> tuple[Pose, np.random.Generator]:
        """The pose of exposure `number`, and the generator in the state after the pose was drawn."""
        rng = np.random.default_rng([self.seed, Stream.EXPOSURE, number])
        time, position_m, heading, pitch, roll = self._draw_pose(rng)
        if self.every_s is not None:
            first = self._draw_pose(np.random.default_rng([self.seed, Stream.EXPOSURE, 0]))
            after_s = number * self.every_s
            try:
                time = first[0] + timedelta(seconds=after_s)
            except OverflowError as cause:
                raise BadInput("no_time", f"{after_s:g} s after {first[0]} is beyond the calendar") from cause
            if self.drive is None:  # at rest
                _, position_m, heading, pitch, roll = first
            else:
                position_m, heading = self.drive.position_m(after_s), self.drive.heading_rad(after_s)
        require_place(self.terrain, float(position_m[0]), float(position_m[1]))
        height_m = float(self.terrain.ground_m(position_m[None])[0]) + self.terrain.camera_height_m
        pose = Pose(
            time_utc=time,
            position_enu_m=np.append(position_m, height_m),
            R_body_enu=R_body_enu_from_heading_pitch_roll(heading, pitch, roll),
        )
        return pose, rng

    def _draw_pose(self, rng: np.random.Generator) -> tuple[datetime, Array, float, float, float]:
        """Time, position (2,) [m], heading, pitch and roll [rad]. All are drawn: a given one does not change others.

        On the Earth the time is one of the astronomical night.
        """
        time = _random_time(rng)
        others, site = rng.spawn(1)[0], self.terrain.site
        while self.time_utc is None and site and site.body == "earth" and sun_elevation_rad(site, time) > NIGHT_RAD:
            time = _random_time(others)
        position = _random_position(self.terrain, rng)
        heading, direction = rng.uniform(0, 2 * np.pi, 2)
        tilt = self.max_tilt_rad * np.sqrt(rng.random())
        given = (self.time_utc, self.east_m, self.north_m, self.heading_rad, self.pitch_rad, self.roll_rad)
        drawn = (time, *position, heading, tilt * np.cos(direction), tilt * np.sin(direction))
        pose: list[Any] = [by_seed if one is None else one for one, by_seed in zip(given, drawn, strict=True)]
        return pose[0], np.array(pose[1:3]), *pose[3:]

    def draw_sky(self, time: datetime) -> tuple[Stars, Array]:
        """Apparent stars, first those of the catalogue, then the random ones, and their magnitude errors (n,).

        Raises BadInput (bad_terrain) where the terrain has no site.
        """
        site = require_site(self.terrain)
        rng = np.random.default_rng([self.seed, Stream.SKY])
        stars = apparent_stars(self.catalog, time, site)
        errors = np.zeros(len(stars))
        if self.flux_scatter_mag > 0:
            errors = draw_v_errors(stars, self.flux_scatter_mag, rng=rng)
        if self.faint_v_mag is None or self.catalog.is_deep:
            return stars, errors
        field = draw_field_stars(stars, self.faint_v_mag, rng=rng)
        return Stars.concatenate(stars, field), np.concatenate([errors, np.zeros(len(field))])


def load_sky_catalog(stars: str) -> StarCatalog:
    """The catalogue of the sky's stars: "hipparcos", "gaia", or "auto" for Gaia's where they are installed.

    The evidence of long exposures expects Gaia's stars where they are installed; a sky with other faint stars would
    contradict it. Raises BadInput (bad_calibration) for "gaia" where the package is not installed.
    """
    from startrack.catalog import has_deep_catalog, load_catalog, load_deep_catalog

    return load_deep_catalog() if stars == "gaia" or (stars == "auto" and has_deep_catalog()) else load_catalog()


def _random_time(rng: np.random.Generator) -> datetime:
    first, last = RANDOM_TIMES
    return first + timedelta(microseconds=int(rng.integers((last - first) // timedelta(microseconds=1))))


def _random_position(terrain: Terrain, rng: np.random.Generator) -> Array:
    """A position (2,) [m], uniform over the part of the search area where the camera can stand."""
    for _ in range(MAX_POSITION_TRIES):
        azimuth = rng.uniform(0, 2 * np.pi)
        position = terrain.search_radius_m * np.sqrt(rng.random()) * np.array([np.sin(azimuth), np.cos(azimuth)])
        if bool(terrain.allowed(position[None])[0]):
            return position
    raise BadInput("bad_terrain", f"{terrain.name}: nowhere in its search area can the camera stand")
