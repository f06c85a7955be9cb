"""`startrack render`: synthetic exposures with the truth beside them, one by one or as a series along a path."""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Sequence
from dataclasses import replace
from datetime import timedelta
from pathlib import Path
from typing import Any

from startrack import rendering
from startrack.camera import load_camera
from startrack.cli.console import progress
from startrack.cli.images import odometry_errors
from startrack.core.files import check_output, printable, write_atomically
from startrack.core.types import TIME_SIGMA_S
from startrack.exposure import with_facts, write_exposure, write_sidecar
from startrack.frames import format_utc, heading_pitch_roll_from_R_body_enu, parse_utc, tum_line
from startrack.rendering import FAINTEST_V_MAG, Drive, Pose, Series
from startrack.terrain import load_terrain

SUFFIXES = {"png": ".png", "tiff": ".tif", "fits": ".fits"}
KNOWN_SUFFIXES = {*SUFFIXES.values(), ".tiff", ".fit", ".fts"}
ANGLES = ("heading", "pitch", "roll")
SETTINGS = (  # flags that determine the pixels, without those of the pose and of the files' names
    "max_tilt", "sky_mag", "sky_gradient", "sky_gradient_azimuth", "wall_reflectance", "faint_stars", "no_faint_stars",
    "flux_scatter", "hot_pixels", "cosmic_rays", "truth_mag",
)  # fmt: skip
TRUTH, ODOMETRY = "truth.tum", "odometry.tum"
ODOMETRY_HEAD = (
    "# time tx ty tz qx qy qz qw (Unix seconds UTC, m); frame: begins at the first pose, level, heading arbitrary\n"
    "# error of each increment on each horizontal axis: sqrt(({sigma:g} length)^2 + ({floor:g} m)^2)\n"
)
TRUTH_HEAD = "# time tx ty tz qx qy qz qw (Unix seconds UTC as stated in the images, m); body in enu, true\n"


def run(args: argparse.Namespace) -> int:
    """Render and write the images; 0. Raises BadInput for files and values that cannot be used, BadOutput for paths."""
    drive = _read_drive(args)
    along = 1 if drive is None else drive.count_frames(args.every)
    if drive is not None and args.count is not None and args.count > along:
        args.usage_error(f"--count {args.count}: the path has {along} exposures")
    images = _targets(args, args.count or along)
    series = _series(args, drive)
    written = [p for image in images for p in (image, image.with_suffix(".json"), *rendering.truth_paths(image))]
    if args.every is not None:
        written += [Path(args.dir) / name for name in ([TRUTH] if args.path is None else [TRUTH, ODOMETRY])]
    for path in written:  # all first: nothing is written half-way to an error
        check_output(path, overwrite=args.overwrite)
    poses = [series.pose(number) for number in range(len(images))] if args.every is not None else []
    with progress(f"render {len(images)} images", len(images), shown=len(images) > 2) as bar:
        for number, image in enumerate(images):
            summary = _render_one(args, series, number, image)
            if args.json or not args.quiet:
                print(json.dumps(summary) if args.json else _line(summary))
            bar.advance()
    if poses:
        _write_trajectories(args, series, poses)
    return 0


def _read_drive(args: argparse.Namespace) -> Drive | None:
    """The drive of --path; None without. A usage error for flags that do not go together; else raises BadInput."""
    if args.every is not None and args.output is not None:
        args.usage_error("--output names one image, but --every makes several: give --dir")
    if args.path is None:
        for name in _given_flags(args, "speed", "odometry_sigma", "odometry_floor"):
            args.usage_error(f"{name} needs --path")
        return None
    if args.every is None or args.speed is None:
        args.usage_error("--path needs --speed and --every")
    for name in _given_flags(args, "east", "north", "heading"):
        args.usage_error(f"{name}: positions and headings are those of --path")
    return rendering.read_drive(args.path, args.speed)


def _given_flags(args: argparse.Namespace, *names: str) -> list[str]:
    """Flags among the `names` of arguments that are not None."""
    return [f"--{name.replace('_', '-')}" for name in names if getattr(args, name) is not None]


def _targets(args: argparse.Namespace, count: int) -> list[Path]:
    """The images to write."""
    if args.output is not None and count != 1:
        args.usage_error(f"--output names one image, but --count is {count}: give --dir")
    if args.output is None:
        stem = f"{Path(args.terrain).name.removesuffix('.toml')}-{args.seed}"
        digits = max(3, len(str(count - 1)))
        return [Path(args.dir) / f"{stem}-{k:0{digits}d}{SUFFIXES[args.format]}" for k in range(count)]
    if Path(args.output).suffix.lower() not in KNOWN_SUFFIXES:
        args.usage_error(f"--output {args.output}: the suffix must be .png, .tif or .fits")
    return [Path(args.output)]


def _series(args: argparse.Namespace, drive: Drive | None) -> Series:
    catalog = rendering.load_sky_catalog(args.stars)
    faint = None if args.no_faint_stars else args.faint_stars
    return Series(
        camera=load_camera(args.camera), terrain=load_terrain(args.terrain),
        catalog=catalog.brighter_than(FAINTEST_V_MAG if faint is None else faint), seed=args.seed,
        time_utc=None if args.time is None else parse_utc(args.time), east_m=args.east, north_m=args.north,
        **{f"{name}_rad": math.radians(deg) for name in ANGLES if (deg := getattr(args, name)) is not None},
        max_tilt_rad=math.radians(args.max_tilt), exposure_s=args.exposure, sky_v_mag_arcsec2=args.sky_mag,
        sky_gradient=args.sky_gradient, sky_gradient_azimuth_rad=math.radians(args.sky_gradient_azimuth),
        wall_reflectance=args.wall_reflectance, faint_v_mag=faint, flux_scatter_mag=args.flux_scatter,
        hot_pixels=args.hot_pixels, cosmic_rays=args.cosmic_rays, every_s=args.every, drive=drive,
        camera_ref=args.camera, terrain_ref=args.terrain,
    )  # fmt: skip


def _render_one(args: argparse.Namespace, series: Series, number: int, image: Path) -> dict[str, Any]:
    """Render, write image, sidecar and truth, and return the text about it."""
    scene, rng = series.scene(number, image.stem)
    exposure, truth = rendering.render(scene, rng=rng)
    stated = None if scene.time_utc is None else scene.time_utc - timedelta(seconds=args.clock_offset)
    exposure = with_facts(exposure, time_utc=stated)
    if args.time_sigma is not None or args.clock_offset != 0.0:  # else a right clock, which is exact
        sigma_s = TIME_SIGMA_S if args.time_sigma is None else args.time_sigma
        exposure = replace(exposure, time_sigma_s=sigma_s, time_sigma_is_stated=args.time_sigma is not None)
    write_exposure(image, exposure, overwrite=args.overwrite)
    write_sidecar(image, exposure, overwrite=args.overwrite)
    brightness = series.ground_brightness
    heading, pitch, roll = heading_pitch_roll_from_R_body_enu(scene.camera.R_body_cam @ scene.R_cam_enu)
    facts = {
        "time_utc": None if scene.time_utc is None else format_utc(scene.time_utc),
        "exposure_s": scene.exposure_s,
        "east_m": float(truth.position_enu_m[0]),
        "north_m": float(truth.position_enu_m[1]),
        "heading_deg": math.degrees(heading),
        "pitch_deg": math.degrees(pitch),
        "roll_body_deg": math.degrees(roll),
        "clock_offset_s": args.clock_offset,
        "seed": args.seed,
        "number": number,
        "catalog": series.catalog.name,
        "settings": {name: getattr(args, name) for name in SETTINGS} | {"wall_reflectance": brightness.value},
    }
    pose_path, table_path = rendering.write_truth(
        image, truth, facts, to_v_mag=args.truth_mag, overwrite=args.overwrite
    )
    return {"image": str(image), "truth": str(pose_path), "table": str(table_path), **facts}


def _line(summary: dict[str, Any]) -> str:
    return (
        f"{printable(summary['image'])}  E {summary['east_m']:.1f} m  N {summary['north_m']:.1f} m  "
        f"heading {summary['heading_deg']:.1f}°  pitch {summary['pitch_deg']:.1f}°  "
        f"roll {summary['roll_body_deg']:.1f}°  {_seconds_of(summary['time_utc'])}  {summary['exposure_s']:.3g} s"
    )


def _seconds_of(time_utc: str | None) -> str:
    """A time to whole seconds."""
    return "no time" if time_utc is None else f"{time_utc[:19].replace('T', ' ')} UTC"


def _write_trajectories(args: argparse.Namespace, series: Series, poses: Sequence[Pose]) -> None:
    """Write the true `poses` of the series and, of a drive, its odometry, as TUM text with the stated times."""
    offset = timedelta(seconds=args.clock_offset)  # odometry and images have one clock
    times_s = [(pose.time_utc - offset).timestamp() for pose in poses]

    def write(name: str, head: str, position_m: Any, R_frame_body: Any) -> None:
        lines = (tum_line(*row) for row in zip(times_s, position_m, R_frame_body, strict=True))
        write_atomically(Path(args.dir) / name, (head + "".join(lines)).encode(), overwrite=args.overwrite)

    write(TRUTH, TRUTH_HEAD, [pose.position_enu_m for pose in poses], [pose.R_body_enu.T for pose in poses])
    if series.drive is not None:
        errors = odometry_errors(args)
        head = ODOMETRY_HEAD.format(sigma=errors.sigma_1, floor=errors.floor_m)
        write(ODOMETRY, head, *series.odometry(poses, errors))
