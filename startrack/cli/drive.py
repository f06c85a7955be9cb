"""Flags of `startrack render` for exposures at equal steps of time: a rover at rest, or a drive with its odometry."""

from __future__ import annotations

import argparse
from datetime import timedelta
from pathlib import Path
from typing import TYPE_CHECKING, Any

from startrack.cli.flag_types import amount, positive_number, seconds
from startrack.cli.flags import flag

if TYPE_CHECKING:
    from collections.abc import Sequence

    from startrack.rendering import Drive, Pose, Series

TRUTH, ODOMETRY = "truth.tum", "odometry.tum"
ODOMETRY_HEAD = (
    "# time tx ty tz qx qy qz qw (Unix seconds UTC, m); frame: begins at the first pose, level, heading arbitrary\n"
    "# error of each increment on each horizontal axis: sqrt(({sigma:g} length)^2 + ({floor:g} m)^2)\n"
)
TRUTH_HEAD = "# time tx ty tz qx qy qz qw (Unix seconds UTC as stated in the images, m); body in enu, true\n"
DRIVE_FLAGS = (
    flag("--every SECONDS", "time between the exposures", seconds),
    flag(
        "--path WAYPOINTS",
        "CSV file of waypoints, columns east_m,north_m: the rover drives along it, its nose forward",
    ),
    flag("--speed M_PER_S", "along the path", positive_number),
    flag("--odometry-sigma F", "error of the odometry, as a part of each increment (as of `track`)", amount),
    flag("--odometry-floor M", "error of the odometry, added in quadrature to each increment (as of `track`)", amount),
)


def read_drive_flags(args: argparse.Namespace) -> Drive | None:
    """The drive of --path; None without. A usage error for flags that do not go together; else raises BadInput."""
    if args.every is not None and args.output is not None:
        args.usage_error("--output names one image, but --every makes several: give --dir")
    if args.path is None:
        lone = _given_flags(args, "speed", "odometry_sigma", "odometry_floor")
        if lone:
            args.usage_error(f"{lone[0]} needs --path")
        return None
    if args.every is None or args.speed is None:
        args.usage_error("--path needs --speed and --every")
    contrary = _given_flags(args, "east", "north", "heading")
    if contrary:
        args.usage_error(f"{contrary[0]}: positions and headings are those of --path")
    from startrack.rendering import read_drive

    return read_drive(args.path, args.speed)


def count_images(args: argparse.Namespace, drive: Drive | None) -> int:
    """Number of images: --count, or all along the path. A usage error for more than the path has."""
    if drive is None:
        return 1 if args.count is None else int(args.count)
    along = drive.count_frames(args.every)
    if args.count is not None and args.count > along:
        args.usage_error(f"--count {args.count}: the path has {along} exposures")
    return int(args.count or along)


def trajectory_paths(args: argparse.Namespace) -> list[Path]:
    """Files that `write_trajectories` writes."""
    if args.every is None:
        return []
    return [Path(args.dir) / name for name in ([TRUTH] if args.path is None else [TRUTH, ODOMETRY])]


def write_trajectories(args: argparse.Namespace, series: Series, poses: Sequence[Pose]) -> None:
    """Write the true `poses` of the series and, of a drive, its odometry, as TUM text with the stated times."""
    from startrack.applications.tracking import ODOMETRY_FLOOR_M, ODOMETRY_SIGMA
    from startrack.core.files import write_atomically
    from startrack.frames import tum_line

    def text(position_m: Any, R_frame_body: Any) -> str:
        offset = timedelta(seconds=args.clock_offset)  # odometry and images have one clock
        times_s = [(pose.time_utc - offset).timestamp() for pose in poses]
        return "".join(tum_line(*row) for row in zip(times_s, position_m, R_frame_body, strict=True))

    true = text([pose.position_enu_m for pose in poses], [pose.R_body_enu.T for pose in poses])
    write_atomically(Path(args.dir) / TRUTH, (TRUTH_HEAD + true).encode(), overwrite=args.overwrite)
    if series.drive is None:
        return
    sigma_1 = ODOMETRY_SIGMA if args.odometry_sigma is None else args.odometry_sigma
    floor_m = ODOMETRY_FLOOR_M if args.odometry_floor is None else args.odometry_floor
    measured = text(*series.odometry(poses, sigma_1=sigma_1, floor_m=floor_m))
    head = ODOMETRY_HEAD.format(sigma=sigma_1, floor=floor_m)
    write_atomically(Path(args.dir) / ODOMETRY, (head + measured).encode(), overwrite=args.overwrite)


def _given_flags(args: argparse.Namespace, *names: str) -> list[str]:
    """Flags among the `names` of arguments that are not None."""
    return [f"--{name.replace('_', '-')}" for name in names if getattr(args, name) is not None]
