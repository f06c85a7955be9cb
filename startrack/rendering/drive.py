"""A rover that drives along waypoints, and the odometry that it would record."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from startrack.core import MAX_COUNT
from startrack.core.files import FilePath, printable
from startrack.core.obstacles import read_columns
from startrack.core.types import Array, BadInput, Value, array
from startrack.estimation.observations import OdometryErrors

PATH_COLUMNS = ("east_m", "north_m")
STEP_ROUNDING_1 = 1e-9  # relative, of a number of steps: a path of whole steps has a frame at its end


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
