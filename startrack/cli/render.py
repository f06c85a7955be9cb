"""`startrack render`: synthetic exposures with the truth beside them."""

from __future__ import annotations

import argparse
import json
import math
from dataclasses import replace
from datetime import timedelta
from pathlib import Path
from typing import TYPE_CHECKING, Any

from startrack.cli import flags
from startrack.cli.drive import (
    DRIVE_FLAGS,
    count_images,
    read_drive_flags,
    trajectory_paths,
    write_trajectories,
)
from startrack.cli.flag_types import (
    amount,
    clock_offset_s,
    count,
    limited_count,
    magnitude,
    number,
    positive_count,
    seconds,
    time_sigma_s,
)
from startrack.cli.flags import Command, Either, flag
from startrack.cli.progress import progress
from startrack.core.files import check_output

if TYPE_CHECKING:
    from startrack.rendering import Drive, Scene, Series, Truth

SUFFIXES = {"png": ".png", "tiff": ".tif", "fits": ".fits"}
KNOWN_SUFFIXES = {".png", ".tif", ".tiff", ".fits", ".fit", ".fts"}
CATALOG_V_MAG = 10.0  # catalogue stars drawn when there are no faint ones to go with them
ANGLES = ("heading", "pitch", "roll")
SETTINGS = (  # flags that determine the pixels, without those of the pose and of the files' names
    "max_tilt", "sky_mag", "sky_gradient", "sky_gradient_azimuth", "wall_reflectance", "faint_stars", "no_faint_stars",
    "flux_scatter", "hot_pixels", "cosmic_rays", "truth_mag",
)  # fmt: skip


def run(args: argparse.Namespace) -> int:
    """Render and write the images; 0. Raises BadInput for files and values that cannot be used, BadOutput for paths."""
    from startrack.rendering import truth_paths

    drive = read_drive_flags(args)
    images = _targets(args, count_images(args, drive))
    series = _series(args, drive)
    written = (p for image in images for p in (image, image.with_suffix(".json"), *truth_paths(image)))
    for path in (*written, *trajectory_paths(args)):  # all first: nothing is written half-way to an error
        check_output(path, overwrite=args.overwrite)
    poses = [series.pose(number) for number in range(len(images))] if args.every is not None else []
    with progress("render", len(images), shown=len(images) > 2) as bar:
        for number, image in enumerate(images):
            summary = _render_one(args, series, number, image)
            if args.json or not args.quiet:
                print(json.dumps(summary) if args.json else _line(summary))
            bar.advance()
    if poses:
        write_trajectories(args, series, poses)
    return 0


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
    from startrack.camera import load_camera
    from startrack.frames import parse_utc
    from startrack.rendering import Series, load_sky_catalog
    from startrack.terrain import load_terrain

    catalog = load_sky_catalog(args.stars)
    faint = None if args.no_faint_stars else args.faint_stars
    return Series(
        camera=load_camera(args.camera), terrain=load_terrain(args.terrain),
        catalog=catalog.brighter_than(CATALOG_V_MAG if faint is None else faint), seed=args.seed,
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
    from startrack.core.types import TIME_SIGMA_S
    from startrack.exposure import with_facts, write_exposure, write_sidecar
    from startrack.rendering import render, write_truth

    scene, rng = series.scene(number, image.stem)
    exposure, truth = render(scene, rng=rng)
    stated = None if scene.time_utc is None else scene.time_utc - timedelta(seconds=args.clock_offset)
    exposure = with_facts(exposure, time_utc=stated)
    if args.time_sigma is not None or args.clock_offset != 0.0:  # else a right clock, which is exact
        sigma_s = TIME_SIGMA_S if args.time_sigma is None else args.time_sigma
        exposure = replace(exposure, time_sigma_s=sigma_s, time_sigma_is_stated=args.time_sigma is not None)
    pose = {**_pose(scene, truth), "clock_offset_s": args.clock_offset}
    write_exposure(image, exposure, overwrite=args.overwrite)
    write_sidecar(image, exposure, overwrite=args.overwrite)
    settings = {name: getattr(args, name) for name in SETTINGS}
    facts = {**pose, "seed": args.seed, "number": number, "catalog": series.catalog.name, "settings": settings}
    pose_path, table_path = write_truth(image, truth, facts, to_v_mag=args.truth_mag, overwrite=args.overwrite)
    return {"image": str(image), "truth": str(pose_path), "table": str(table_path), **facts}


def _pose(scene: Scene, truth: Truth) -> dict[str, Any]:
    from startrack.frames import format_utc, heading_pitch_roll_from_R_body_enu

    heading, pitch, roll = heading_pitch_roll_from_R_body_enu(scene.camera.R_body_cam @ scene.R_cam_enu)
    return {
        "time_utc": None if scene.time_utc is None else format_utc(scene.time_utc),
        "exposure_s": scene.exposure_s,
        "east_m": float(truth.position_enu_m[0]),
        "north_m": float(truth.position_enu_m[1]),
        "heading_deg": math.degrees(heading),
        "pitch_deg": math.degrees(pitch),
        "roll_body_deg": math.degrees(roll),
    }


def _line(summary: dict[str, Any]) -> str:
    return (
        f"{summary['image']}: east {summary['east_m']:.1f} m, north {summary['north_m']:.1f} m, "
        f"heading {summary['heading_deg']:.2f}, pitch {summary['pitch_deg']:.2f}, "
        f"roll {summary['roll_body_deg']:.2f} deg, "
        f"{summary['time_utc']}, {summary['exposure_s']:.3g} s"
    )


COMMANDS = (
    Command(
        "render", run, "make synthetic exposures and files with their truth",
        "Render the image of a camera on the crater's floor. Position, heading, tilt and time are drawn from the seed "
        "unless they are given. With --every the exposures are at equal steps of time, at rest or, with --path, on a "
        "drive with odometry. Beside NAME.png: NAME.json (time, exposure, camera, terrain), NAME.truth.json (pose, "
        "settings) and NAME.truth.ecsv (stars).",
        {
            "input": (
                flag("-c --camera FILE", "camera file, or a shipped name", default="fisheye-2048"),
                flag("-t --terrain FILE", "terrain file, or a shipped name", default="shackleton-thesis"),
                flag("--seed N", "same seed, same bytes", count, default=0),
                flag("-n --count N", "images (default 1; of a drive all along its path)", positive_count),
            ),
            "pose and time (what is not given is drawn from the seed)": (
                flag("--time UTC", "middle of the exposure; else between 2024 and 2034"),
                flag(
                    "--time-sigma SECONDS",
                    "standard deviation of the clock's error (0; with --clock-offset not stated)", time_sigma_s,
                ),
                flag(
                    "--clock-offset SECONDS",
                    "true minus stated time, for image and sidecar with the time of a wrong clock", clock_offset_s,
                    default=0.0,
                ),
                flag("--east M", "from the terrain's origin", number),
                flag("--north M", "from the terrain's origin", number),
                flag("--heading DEG", "azimuth of the rover's nose", number),
                flag("--pitch DEG", "nose up positive", number),
                flag("--roll DEG", "right side down positive", number),
                flag("--max-tilt DEG", "of random tilts", amount, default=5.0),
            ),
            "series at rest (--every alone) or along a path": DRIVE_FLAGS,
            "light and defects": (
                flag(
                    "--exposure S",
                    "seconds; default: a V 6 star on the axis reaches 5 sigma, which takes fisheye-2048 0.40 s",
                    seconds,
                ),
                flag("--sky-mag V", "diffuse sky per arcsec^2", magnitude, default=22.0),
                flag("--sky-gradient F", "its slope to the horizon", number, default=0.0),
                flag("--sky-gradient-azimuth DEG", "where it rises to", number, default=0.0),
                flag("--wall-reflectance F", "of the sky's light", amount, default=0.04),
                flag(
                    "--stars", "whose stars the sky has (auto: Gaia's where the extra `deep` is installed)",
                    choices=("auto", "hipparcos", "gaia"), default="auto",
                ),
                flag(
                    "--faint-stars V",
                    "no stars fainter than this; down to it, stars that Hipparcos lacks are drawn at random (FIELD n)",
                    magnitude, default=10.0,
                ),
                flag("--no-faint-stars", "the catalogue's stars alone"),
                flag(
                    "--flux-scatter MAG",
                    "of each star's flux, beyond the catalogue's own errors; 0 turns both off", amount, default=0.03,
                ),
                flag("--hot-pixels N", "of the sensor", limited_count, default=200),
                flag("--cosmic-rays N", "tracks per exposure", limited_count, default=5),
            ),
            "output": (
                Either((flag("-o --output FILE", "one image: .png, .tif or .fits"), flags.DIR)),
                flag("--format", "of images in the folder", choices=SUFFIXES, default="png"),
                flag("--truth-mag V", "faintest star in the table", magnitude, default=8.5),
                flags.OVERWRITE, flags.JSON, flags.NO_PLOTS,
            ),
            "more": flags.MORE,
        },
        "startrack render --seed 1",
    ),
)  # fmt: skip
