"""`startrack predict` and `reproduce`: many computed fixes, kept in OUT, so that a stopped run goes on."""

from __future__ import annotations

import argparse
import json
import os
import sys
import time
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from startrack.applications import prediction, reproduction
from startrack.applications.prediction import Conditions
from startrack.applications.reproduction import ARTEFACTS, Artefact
from startrack.chain import input_hashes
from startrack.cli.console import progress
from startrack.cli.flags import check_cluster, check_extra, check_localizer
from startrack.cli.images import absolute_reference, odometry_errors, prepare
from startrack.core.errors import EXIT_STOPPED, how_to_install, one_line
from startrack.core.files import make_folder, printable
from startrack.core.runner import RunStopped, count_cores
from startrack.frames import parse_utc
from startrack.rendering import read_drive
from startrack.terrain import can_write_maps, load_terrain

MAX_DRAWS = 1000
POINTS_OF_PATH = 25  # of the default spacing


def predict(args: argparse.Namespace) -> int:
    """Predict, write the files and print the summary; 0, or 5 if the run was stopped."""
    _check_prediction(args)
    conditions = _conditions(args)
    cameras = [absolute_reference(one) for one in (args.camera, args.compare) if one is not None]
    hashes = input_hashes(os.path.join(args.dir, "predict.json"), cameras, conditions.terrain)
    inputs = tuple(sorted({(Path(path).name, sha256) for path, sha256 in hashes.items()}))  # of the files of flags
    plan = prediction.Plan.of(conditions, inputs, _places(args, conditions))
    out = make_folder(args.dir)
    plan.check_folder(out, overwrite=args.overwrite)
    if not args.quiet:
        print(f"predict: places: {len(plan.points.places)}, draws at each: {args.draws}", file=sys.stderr, flush=True)
    if args.path is None and not can_write_maps():
        print(f"predict: no predict.tif, which needs rasterio: {how_to_install('dem')}", file=sys.stderr, flush=True)
    prepare(plan.terrain, args)
    start, depth, jobs = time.perf_counter(), None, args.jobs or count_cores()
    bar = partial(progress, shown=not args.quiet, jobs=jobs)
    try:
        with prediction.draw_store(out, draws=args.draws, jobs=jobs, progress=bar, cluster=args.cluster) as store:
            predictions = prediction.Predictions(plan.points.places, store, inputs, args.overwrite)
            if args.depth:
                conditions, depth = predictions.depth(conditions, args.target_radius95)
            first = predictions.cells(conditions, "predict")
            others = {other: predictions.cells(other, "compare") for other in _variants(args, conditions, cameras)}
    except RunStopped as cause:
        print(f"startrack predict: {cause}; the same command goes on", file=sys.stderr)
        return EXIT_STOPPED
    odometry = None if args.odometry_sigma is None else odometry_errors(args)
    report = prediction.Report.of(replace(plan, conditions=conditions), first, others, depth, odometry)
    files = prediction.write_report(report, out, plots=not args.no_plots)
    if args.json:
        print(json.dumps(report.record))
    elif not args.quiet:
        print("\n".join(map(one_line, report.lines())))
        elapsed_s = time.perf_counter() - start
        print(f"{', '.join(path.name for path in files)} in {printable(args.dir)} ({elapsed_s:.0f} s)")
    return 0


def _check_prediction(args: argparse.Namespace) -> None:
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
    first, slash, last = args.time.partition("/")
    start = parse_utc(first)
    return Conditions(
        camera=absolute_reference(args.camera),
        terrain=absolute_reference(args.terrain),
        times_utc=prediction.times_between(start, parse_utc(last) if slash else start, args.draws),
        exposure_s=args.exposures[0] if args.exposures else args.exposure,
        sky_v_mag_arcsec2=args.sky,
        seed=args.seed,
        localizer=args.localizer,
    )


def _variants(args: argparse.Namespace, conditions: Conditions, cameras: list[str]) -> Sequence[Conditions]:
    """All cameras and exposures that are compared; none without a comparison."""
    if args.compare is None and args.exposures is None:
        return []
    exposures = args.exposures or [conditions.exposure_s]
    return [replace(conditions, camera=camera, exposure_s=one) for camera in cameras for one in exposures]


def _places(args: argparse.Namespace, conditions: Conditions) -> Any:
    """The cells of the area, or the points of the path."""
    terrain = load_terrain(conditions.terrain)
    if args.path is None:
        return prediction.area_cells(terrain, args.spacing or prediction.default_spacing_m(terrain))
    drive = read_drive(args.path, 1.0)
    spacing_m = args.spacing or float(drive.distance_m[-1]) / POINTS_OF_PATH
    return prediction.path_points(drive, terrain, spacing_m)


def reproduce(args: argparse.Namespace) -> int:
    """Make the named artefacts, in the order of the thesis; 0."""
    unknown, known = ", ".join(name for name in args.what if name not in (*ARTEFACTS, "all")), ", ".join(ARTEFACTS)
    if unknown:
        args.usage_error(f"{unknown}: not a table or figure of the thesis; known are {known}, all")
    if not args.no_plots:
        check_extra(args, "matplotlib", "plots", "figures need", ", or omit them with --no-plots")
    check_cluster(args)
    out, size = make_folder(args.dir), reproduction.FULL if args.full else reproduction.QUICK
    if args.ours is not None:
        size = size.limit_our_positions(args.ours)
    with reproduction.fix_store(out, jobs=args.jobs or count_cores(), progress=progress, cluster=args.cluster) as store:
        for name in (name for name in ARTEFACTS if name in args.what or "all" in args.what):
            start = time.perf_counter()
            artefact = ARTEFACTS[name](reproduction.Context(size, args.seed, store))
            files = reproduction.write_artefact(artefact, out, plots=not args.no_plots)
            _print_artefact(args, artefact, size.name, files, time.perf_counter() - start)
    return 0


def _print_artefact(args: argparse.Namespace, artefact: Artefact, size: str, files: list[Path], seconds: float) -> None:
    if args.json:
        record = {
            "format": "startrack.reproduction/1",
            "name": artefact.name,
            "title": artefact.title,
            "size": size,
            "seed": args.seed,
            **artefact.values,
            "files": [str(path) for path in files],
            "timing_ms": {**artefact.timing_ms, "all": 1e3 * seconds},
        }
        print(json.dumps(record), flush=True)
    elif not args.quiet:
        per_fix = ", ".join(f"{key} {value:.1f}" for key, value in artefact.timing_ms.items())
        print(f"{artefact.name}: {artefact.line}{f' [ms per fix: {per_fix}]' if per_fix else ''}", flush=True)
