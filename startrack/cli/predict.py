"""`startrack predict`: the expected accuracy of positions over a search area, or along a path."""

from __future__ import annotations

import argparse
import json
import os
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

from startrack.cli.common import DEFAULT_LOCALIZER, DEFAULT_OUT, check_localizer, cores
from startrack.cli.drive import ODOMETRY_FLOOR_M
from startrack.cli.flag_types import amount, count, magnitude, positive_count, positive_number, seconds
from startrack.cli.preparation import compile_kernels, prepare
from startrack.cli.progress import Progress, progress
from startrack.core.compilation import is_compiled
from startrack.core.files import is_path, make_folder

if TYPE_CHECKING:
    from collections.abc import Sequence
    from contextlib import AbstractContextManager

    from startrack.applications.prediction import Conditions, OdometryErrors, Predictions, Report

STOPPED = 5
MAX_DRAWS = 1000
POINTS_OF_PATH = 25  # of the default spacing


def add_parser(subparsers: Any) -> argparse.ArgumentParser:
    """Add `predict` to the commands of the `startrack` parser."""
    parser: argparse.ArgumentParser = subparsers.add_parser(
        "predict",
        help="expected accuracy over a terrain, before a drive",
        description="Predict how well images would be located: evidence of the stars is drawn at every place and "
        "located as `locate` does. Writes predict.tif, predict.png, predict.ecsv and predict.json. Draws are kept in "
        "OUT/.predict: a stopped run is resumed.",
    )
    parser.add_argument("-t", "--terrain", required=True, metavar="FILE", help="terrain file, or a shipped name")
    parser.add_argument("-c", "--camera", required=True, metavar="FILE", help="camera file, or a shipped name")
    parser.add_argument(
        "--time", required=True, metavar="UTC", help="middle of the exposures; START/END: evenly spaced between"
    )
    parser.add_argument("--sky", type=magnitude, default=22.0, metavar="MAG", help="diffuse sky per arcsec^2 (22.0)")
    parser.add_argument("--spacing", type=positive_number, metavar="M", help="between the places (a tenth of the area)")
    parser.add_argument("--draws", type=positive_count, default=10, metavar="N", help="at each place (10)")
    parser.add_argument("--seed", type=count, default=0, metavar="N", help="same seed, same files (0)")
    parser.add_argument("--localizer", default=DEFAULT_LOCALIZER, metavar="NAME", help="as of `locate` (%(default)s)")
    _add_questions(parser.add_argument_group("other questions"))
    _add_run(parser.add_argument_group("run and output"))
    parser.set_defaults(run=run, usage_error=parser.error)
    return parser


def _add_questions(group: Any) -> None:
    exposure = group.add_mutually_exclusive_group()
    exposure.add_argument("--exposure", type=seconds, metavar="S", help="seconds; default: V 6 on the axis at 5 sigma")
    exposure.add_argument("--exposures", type=_exposures, metavar="S,S,...", help="compare; the map is of the first")
    exposure.add_argument("--depth", action="store_true", help="find the exposure that reaches --target-radius95")
    group.add_argument("--target-radius95", type=positive_number, metavar="M", help="wanted at nine of ten places")
    group.add_argument("--compare", metavar="CAMERA2", help="a second camera at the same places")
    group.add_argument("--path", metavar="WAYPOINTS", help="CSV with east_m,north_m: the places are on this path")
    group.add_argument(
        "--odometry-sigma", type=amount, metavar="F", help="with --path: odometry between the places, error of a move"
    )
    group.add_argument(
        "--odometry-floor", type=amount, metavar="M", help=f"beside that, in quadrature ({ODOMETRY_FLOOR_M})"
    )


def _add_run(group: Any) -> None:
    group.add_argument("-j", "--jobs", type=positive_count, metavar="N", help="processes (default: all cores)")
    group.add_argument("--cluster", metavar="ADDRESS", help="a Dask cluster to use instead (extra: cluster)")
    group.add_argument("-D", "--dir", metavar="OUT", default=DEFAULT_OUT, help="folder of the results (%(default)s)")
    again = group.add_mutually_exclusive_group()
    again.add_argument("--resume", action="store_true", help="keep the draws that are there (default)")
    again.add_argument("-O", "--overwrite", action="store_true", help="draw again, and replace other results")
    group.add_argument("--json", action="store_true", help="print the summary as JSON")
    group.add_argument("--no-plots", action="store_true", help="no pictures")
    group.add_argument("-v", "--verbose", action="count", default=0, help="tracebacks of internal errors")
    group.add_argument("-q", "--quiet", action="store_true", help="print errors only")


def run(args: argparse.Namespace) -> int:
    """Predict, write the files and print the summary; 0, or 5 if the run was stopped."""
    _check_flags(args)
    from startrack.applications.prediction import Predictions, Report, draw_store, write_report
    from startrack.core.runner import RunStopped

    conditions, inputs = _conditions(args), _inputs(args)
    report = Report.begin(conditions, inputs, _places(args, conditions))
    out = make_folder(args.dir)
    report.check_folder(out, overwrite=args.overwrite)
    prepare(report.terrain, args)
    if args.cluster is None and not is_compiled():
        compile_kernels(report.terrain)
    start = time.perf_counter()
    try:
        jobs, bar = args.jobs or cores(), _bar(args)
        with draw_store(out, draws=args.draws, jobs=jobs, progress=bar, cluster=args.cluster) as store:
            if args.cluster is not None:
                store.connect()
            predictions = Predictions(report.points.places, store, inputs, args.overwrite)
            report = _answer(args, report, conditions, predictions)
    except RunStopped as cause:
        print(f"startrack predict: {cause}; the same command goes on", file=sys.stderr)
        return STOPPED
    if args.odometry_sigma is not None:
        report = report.between(_odometry(args))
    files = write_report(report, out, plots=not args.no_plots)
    _print(args, report, files, time.perf_counter() - start)
    return 0


def _answer(args: argparse.Namespace, report: Report, conditions: Conditions, predictions: Predictions) -> Report:
    """The report with the predictions that the flags request."""
    depth = None
    if args.depth:
        conditions, depth = predictions.depth(conditions, args.target_radius95)
    first = predictions.cells(conditions, "predict")
    others = {other: predictions.cells(other, "compare") for other in _variants(args, conditions)}
    return report.finish(conditions, first, others, depth)


def _variants(args: argparse.Namespace, conditions: Conditions) -> Sequence[Conditions]:
    """All cameras and exposures that are compared; none without a comparison."""
    from dataclasses import replace

    if args.compare is None and args.exposures is None:
        return []
    cameras = [conditions.camera] + ([] if args.compare is None else [_reference(args.compare)])
    exposures = args.exposures or [conditions.exposure_s]
    return [replace(conditions, camera=camera, exposure_s=one) for camera in cameras for one in exposures]


def _check_flags(args: argparse.Namespace) -> None:
    """A usage error for flags that do not go together."""
    from importlib.util import find_spec

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
    if args.cluster is not None and find_spec("distributed") is None:
        args.usage_error("--cluster needs distributed: pip install '.[cluster]' in a clone of startrack")


def _odometry(args: argparse.Namespace) -> OdometryErrors:
    from startrack.applications.prediction import OdometryErrors

    floor_m = ODOMETRY_FLOOR_M if args.odometry_floor is None else args.odometry_floor
    return OdometryErrors(args.odometry_sigma, floor_m)


def _conditions(args: argparse.Namespace) -> Conditions:
    """Raises BadInput: no_time, no_calibration, bad_calibration, bad_terrain."""
    from startrack.applications.prediction import Conditions, evenly_spaced
    from startrack.frames import parse_utc

    first, slash, last = args.time.partition("/")
    start = parse_utc(first)
    return Conditions(
        camera=_reference(args.camera),
        terrain=_reference(args.terrain),
        times_utc=evenly_spaced(start, parse_utc(last) if slash else start, args.draws),
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

    cameras = [_reference(one) for one in (args.camera, args.compare) if one is not None]
    found = input_hashes(os.path.join(args.dir, "predict.json"), cameras, _reference(args.terrain))
    return tuple(sorted({(Path(path).name, sha256) for path, sha256 in found.items()}))


def _reference(reference: str) -> str:
    """The path absolute, as workers may run in other folders; a shipped name as it is."""
    return os.path.abspath(reference) if is_path(reference) else reference


def _bar(args: argparse.Namespace) -> Any:
    def shown(what: str, total: int) -> AbstractContextManager[Progress]:
        return progress(what, total, shown=not args.quiet)

    return shown


def _exposures(text: str) -> list[float]:
    """Exposure times [s] with commas between them, as an argparse type."""
    found = [seconds(word) for word in text.split(",")]
    if len(set(found)) != len(found):
        raise argparse.ArgumentTypeError(f"{text!r} names an exposure twice")
    return found


def _print(args: argparse.Namespace, report: Report, files: Sequence[Path], elapsed_s: float) -> None:
    if args.json:
        print(json.dumps(report.record))
    elif not args.quiet:
        print("\n".join(report.lines()))
        print(f"{', '.join(path.name for path in files)} in {args.dir} ({elapsed_s:.0f} s)")
