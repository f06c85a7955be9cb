"""`startrack predict`: the expected accuracy of positions over a search area, or along a path."""

from __future__ import annotations

import argparse
import json
import os
import sys
import time
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from startrack.cli import flags
from startrack.cli.flag_types import amount, count, magnitude, positive_count, positive_number, seconds
from startrack.cli.flags import Command, Either, check_cluster, check_localizer, cores, flag
from startrack.cli.images import absolute_reference
from startrack.cli.progress import compile_kernels, prepare, progress
from startrack.core.compilation import is_compiled
from startrack.core.errors import EXIT_STOPPED
from startrack.core.files import make_folder

if TYPE_CHECKING:
    from collections.abc import Sequence

    from startrack.applications.prediction import Conditions

MAX_DRAWS = 1000
POINTS_OF_PATH = 25  # of the default spacing


def run(args: argparse.Namespace) -> int:
    """Predict, write the files and print the summary; 0, or 5 if the run was stopped."""
    _check_flags(args)
    from startrack.applications.prediction import OdometryErrors, Predictions, Report, draw_store, write_report
    from startrack.applications.tracking import ODOMETRY_FLOOR_M
    from startrack.core.runner import RunStopped

    conditions, inputs = _conditions(args), _inputs(args)
    report = Report.begin(conditions, inputs, _places(args, conditions))
    out = make_folder(args.dir)
    report.check_folder(out, overwrite=args.overwrite)
    prepare(report.terrain, args)
    if args.cluster is None and not is_compiled():
        compile_kernels(report.terrain)
    start, bar, depth = time.perf_counter(), partial(progress, shown=not args.quiet), None
    try:
        with draw_store(out, draws=args.draws, jobs=args.jobs or cores(), progress=bar, cluster=args.cluster) as store:
            if args.cluster is not None:
                store.connect()
            predictions = Predictions(report.points.places, store, inputs, args.overwrite)
            if args.depth:
                conditions, depth = predictions.depth(conditions, args.target_radius95)
            first = predictions.cells(conditions, "predict")
            others = {other: predictions.cells(other, "compare") for other in _variants(args, conditions)}
            report = report.finish(conditions, first, others, depth)
    except RunStopped as cause:
        print(f"startrack predict: {cause}; the same command goes on", file=sys.stderr)
        return EXIT_STOPPED
    if args.odometry_sigma is not None:
        floor_m = ODOMETRY_FLOOR_M if args.odometry_floor is None else args.odometry_floor
        report = report.with_odometry(OdometryErrors(args.odometry_sigma, floor_m))
    files = write_report(report, out, plots=not args.no_plots)
    if args.json:
        print(json.dumps(report.record))
    elif not args.quiet:
        print("\n".join(report.lines()))
        elapsed_s = time.perf_counter() - start
        print(f"{', '.join(path.name for path in files)} in {args.dir} ({elapsed_s:.0f} s)")
    return 0


def _variants(args: argparse.Namespace, conditions: Conditions) -> Sequence[Conditions]:
    """All cameras and exposures that are compared; none without a comparison."""
    from dataclasses import replace

    if args.compare is None and args.exposures is None:
        return []
    cameras = [conditions.camera] + ([] if args.compare is None else [absolute_reference(args.compare)])
    exposures = args.exposures or [conditions.exposure_s]
    return [replace(conditions, camera=camera, exposure_s=one) for camera in cameras for one in exposures]


def _check_flags(args: argparse.Namespace) -> None:
    """A usage error for flags that do not go together."""
    check_localizer(args)
    if args.depth != (args.target_radius95 is not None):
        args.usage_error("--depth and --target-radius95 go together")
    if args.odometry_sigma is not None and args.path is None:
        args.usage_error("--odometry-sigma needs --path")
    if args.odometry_floor is not None and args.odometry_sigma is None:
        args.usage_error("--odometry-floor needs --odometry-sigma")
    if args.odometry_sigma == 0 and args.odometry_floor == 0:
        args.usage_error("--odometry-sigma 0 --odometry-floor 0: odometry without errors is not known")
    if args.draws > MAX_DRAWS:
        args.usage_error(f"--draws {args.draws}: at most {MAX_DRAWS}")
    check_cluster(args)


def _conditions(args: argparse.Namespace) -> Conditions:
    """Raises BadInput: no_time, no_calibration, bad_calibration, bad_terrain."""
    from startrack.applications.prediction import Conditions, times_between
    from startrack.frames import parse_utc

    first, slash, last = args.time.partition("/")
    start = parse_utc(first)
    return Conditions(
        camera=absolute_reference(args.camera),
        terrain=absolute_reference(args.terrain),
        times_utc=times_between(start, parse_utc(last) if slash else start, args.draws),
        exposure_s=args.exposures[0] if args.exposures else args.exposure,
        sky_v_mag_arcsec2=args.sky,
        seed=args.seed,
        localizer=args.localizer,
    )


def _places(args: argparse.Namespace, conditions: Conditions) -> Any:
    """The cells of the area, or the points of the path."""
    from startrack.applications.prediction import area_cells, default_spacing_m, path_points
    from startrack.terrain import load_terrain

    terrain = load_terrain(conditions.terrain)
    if args.path is None:
        return area_cells(terrain, args.spacing or default_spacing_m(terrain))
    from startrack.rendering import read_drive

    drive = read_drive(args.path, 1.0)
    return path_points(drive, terrain, args.spacing or float(drive.distance_m[-1]) / POINTS_OF_PATH)


def _inputs(args: argparse.Namespace) -> tuple[tuple[str, str], ...]:
    """Name and SHA-256 of the files that the flags name, and of the maps that these name."""
    from startrack.chain import input_hashes

    cameras = [absolute_reference(one) for one in (args.camera, args.compare) if one is not None]
    found = input_hashes(os.path.join(args.dir, "predict.json"), cameras, absolute_reference(args.terrain))
    return tuple(sorted({(Path(path).name, sha256) for path, sha256 in found.items()}))


def _exposures(text: str) -> list[float]:
    """Exposure times [s] with commas between them, as an argparse type."""
    found = [seconds(word) for word in text.split(",")]
    if len(set(found)) != len(found):
        raise argparse.ArgumentTypeError(f"{text!r} names an exposure twice")
    return found


COMMANDS = (
    Command(
        "predict", run, "expected accuracy over a terrain, before a drive",
        "Predict how well images would be located: evidence of the stars is drawn at every place and located as "
        "`locate` does. Writes predict.tif, predict.png, predict.ecsv and predict.json. Draws are kept in "
        "OUT/.predict: a stopped run is resumed.",
        {
            "input": (
                flag("-t --terrain FILE", "terrain file, or a shipped name", required=True),
                flag("-c --camera FILE", "camera file, or a shipped name", required=True),
                flag("--time UTC", "middle of the exposures; START/END: evenly spaced between", required=True),
                flag("--sky MAG", "diffuse sky per arcsec^2", magnitude, default=22.0),
            ),
            "method": (
                flag("--spacing M", "between the places (a tenth of the area)", positive_number),
                flag("--draws N", "at each place", positive_count, default=10),
                flag("--seed N", "same seed, same files", count, default=0),
                flags.LOCALIZER,
            ),
            "other questions": (
                Either((
                    flag("--exposure S", "seconds; default: V 6 on the axis at 5 sigma", seconds),
                    flag("--exposures S,S,...", "compare; the map is of the first", _exposures),
                    flag("--depth", "find the exposure that reaches --target-radius95"),
                )),
                flag("--target-radius95 M", "wanted at nine of ten places", positive_number),
                flag("--compare CAMERA2", "a second camera at the same places"),
                flag("--path WAYPOINTS", "CSV with east_m,north_m: the places are on this path"),
                flag("--odometry-sigma F", "with --path: odometry between the places, error of a move", amount),
                flag("--odometry-floor M", "beside that, in quadrature (as of `track`)", amount),
            ),
            "output": (flags.DIR, flags.AGAIN, flags.JSON, flags.NO_PLOTS),
            "more": (flags.JOBS, flags.CLUSTER, *flags.MORE),
        },
        "startrack predict -t shackleton -c fisheye-2048 --time 2030-01-01T00:00:00",
    ),
)  # fmt: skip
