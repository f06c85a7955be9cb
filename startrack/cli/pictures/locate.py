"""`startrack locate`, `identify` and `detect`: an image or a skyline to its position, attitude or centroids."""

from __future__ import annotations

import argparse
import importlib
import math
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from threading import Thread
from typing import Any

import numpy as np

from startrack import chain, output
from startrack.applications.batch import result_stems
from startrack.camera import Camera, load_camera
from startrack.catalog import load_catalog
from startrack.cli.console import Columns, Outcome, print_files, print_outcome, print_warnings, wait_lines, worst_code
from startrack.cli.flags import attitude, check_localizer
from startrack.cli.images import check_fov, flag_site, near_attitude_of, prepare, read, settings_of
from startrack.cli.pictures.report import write_page_of_images
from startrack.core.errors import INTERNAL_ERROR, BadInput, BadOutput
from startrack.core.files import make_folder, printable
from startrack.core.limits import limited_time, refusing_shortage
from startrack.core.types import Exposure, PositionPrior
from startrack.exposure import read_mask, split_bag_path
from startrack.frames import parse_utc
from startrack.identification import WIDE_FIELD_RAD, Identifier
from startrack.localization import DEFAULT_LOCALIZER
from startrack.terrain import load_terrain

NEEDED_LATER = ("scipy.special", "scipy.spatial", "spiceypy", "PIL.ImageDraw")  # in this order; pictures need the last
Solve = Callable[[Exposure, Camera | None], chain.Outcome]


def locate(args: argparse.Namespace) -> int:
    """Locate every image; the exit code of the worst."""
    if args.fov is not None:
        args.usage_error(
            "a position needs the lens better than --fov finds it: make a camera file with startrack calibrate "
            f"--fov {args.fov} IMAGE... -o CAMERA.toml, then startrack locate -c CAMERA.toml"
        )
    if args.skyline is not None:
        return _locate_skyline(args)
    if not args.images:
        args.usage_error("give an image, or --skyline FILE")
    check_localizer(args)
    settings = settings_of(args)
    code = _run_images(args, "fix", lambda exposure, _: chain.locate_exposure(exposure, settings), args.time_limit)
    page = write_page_of_images(args.dir, args.images) if args.report else None
    _print_folder(args, "fix", page)
    return code


def identify(args: argparse.Namespace) -> int:
    """Identify every image; the exit code of the worst."""
    check_fov(args)
    if args.fov is not None and args.near_attitude is not None:
        args.usage_error("--near-attitude needs a camera file: with --fov the lens is not known")
    settings = chain.Settings(identifier=Identifier(near_sky=args.near_sky), near_attitude=near_attitude_of(args))
    site = flag_site(args)

    def solve(exposure: Exposure, camera: Camera | None) -> chain.Outcome:
        if camera is None:
            return chain.identify_blind(exposure, args.fov, load_catalog(), settings, site)
        return chain.identify(exposure, camera, load_catalog(), settings, site)

    code = _run_images(args, "identification", solve, args.time_limit)
    _print_folder(args, "identification")
    return code


def detect(args: argparse.Namespace) -> int:
    """Detect in every image; the exit code of the worst."""
    code = _run_images(args, "detections", chain.detect)
    _print_folder(args, "detections")
    return code


def _run_images(args: argparse.Namespace, kind: str, solve: Solve, limit_s: float | None = None) -> int:
    """Solve each image, print its outcome, and return the exit code; results are NAME.`kind`.json.

    `limit_s` is that of the processor time of each image, from reading it to its solution (None: none).
    """
    if args.image_topic is not None and not any(split_bag_path(path) for path in args.images):
        args.usage_error("--image-topic is for ROS bags, and none is given")
    needed = NEEDED_LATER[:-1] if args.no_plots else NEEDED_LATER
    Thread(target=_import_beside, args=(needed,)).start()
    codes, columns = set(), Columns(Path(path).name for path in args.images)
    for path, stem in zip(args.images, result_stems(args.images), strict=True):
        name = Path(path).name
        try:
            with refusing_shortage():
                record, line = _solve_image(args, path, Path(args.dir) / f"{stem}.{kind}.json", solve, limit_s)
        except BadInput as cause:
            record = output.refused_dict(path, cause.reason, str(cause), kind)
            if isinstance(cause, BadOutput):
                record["advice"] = None  # it is about the picture, as is the reason, for lack of a better code
            line = output.refusal_line(path, cause.reason, str(cause))
        except Exception as cause:
            if args.verbose:
                raise
            message = f"internal error: {type(cause).__name__}: {cause} (-v shows the traceback)"
            record = output.refused_dict(path, INTERNAL_ERROR, message, kind)
            line = f"{printable(name)}  {message}"
        print_warnings(args, name, record.get("warnings", ()))
        aligned = columns.aligned(line) if len(args.images) > 1 and record["status"] == "ok" else line
        codes.add(print_outcome(args, record, aligned))
    return worst_code(codes)


def _print_folder(args: argparse.Namespace, kind: str, page: Path | None = None) -> None:
    """The last line: the folder of results, if it has any, and the `page`."""
    if any(Path(args.dir).glob(f"*.{kind}.json")):
        print_files(args, f"in {printable(args.dir)}", page)


def _import_beside(names: Sequence[str]) -> None:
    """Import modules in a thread; one that cannot be imported raises where it is needed."""
    with suppress(ImportError, MemoryError, OSError, RuntimeError):
        for name in names:
            importlib.import_module(name)


def _solve_image(args: argparse.Namespace, path: str, out: Path, solve: Solve, limit_s: float | None) -> Outcome:
    """Read and solve the image and write its results with the record `out`; only -O replaces those of another image."""
    start, is_located = time.perf_counter(), args.command == "locate"
    with limited_time(limit_s):
        exposure = read(path, args)
        camera, terrain = (None, chain.load_named(exposure)[1]) if is_located else (_camera_of(args, exposure), None)
        if isinstance(exposure.mask, str):
            read_mask(exposure.mask)  # as the others: an earlier result outlasts a file that cannot be read
        _claim_record(args, out, exposure.sha256)
        read_s = time.perf_counter() - start
        if terrain is not None and exposure.terrain is not None and exposure.time_utc is not None:
            prepare(terrain, args)
            print_warnings(args, terrain.name, terrain.warnings(), of_all=True)
        start = time.perf_counter()
        with wait_lines(args, f"{args.command} {printable(exposure.name)}"):
            result = chain.add_timing(solve(exposure, camera), read=1e3 * read_s)
    record = _write_files(args, result, out)
    line = output.summary_line(result, seconds=read_s + time.perf_counter() - start)
    if args.command == "identify" and camera is None and isinstance(result, chain.Oriented):
        fov = _found_fov_text(result.camera, args.fov)
        line += f"\n  {output.lens_text(result.camera)}; a camera file: startrack calibrate IMAGE "
        when = " --time UTC" if result.exposure.time_utc is None else ""
        line += f"--fov {fov} --site LAT,LON{when} -o CAMERA.toml"
    if args.verbose and args.command != "detect":
        line += "\n" + output.verbose_text(result)
        files = printable(out).removesuffix(".fix.json")
        line += f"\n  written to {files}.*" if is_located else ""
    return record, line


def _claim_record(args: argparse.Namespace, out: Path, sha256: str) -> None:
    """Make the folder of the record `out` before anything is computed; only -O replaces that of another image."""
    try:
        make_folder(out.parent)
    except BadOutput as cause:
        args.usage_error(str(cause))
    output.prepare_folder(out, sha256, overwrite=args.overwrite, remedy="choose another -D, or replace it with -O")


def _write_files(args: argparse.Namespace, result: chain.Outcome, out: Path) -> dict[str, Any]:
    """Write the record `out` of a `result` and the files beside it; the record."""
    more = {"explain": output.explain(result)} if getattr(args, "explain", False) else {}
    catalog_table = getattr(args, "catalog_table", False)
    record = output.write_results(result, out, plots=not args.no_plots, catalog_table=catalog_table, more=more)
    if args.command == "locate":
        output.write_geo(out, result, args.format)
    return record


def _camera_of(args: argparse.Namespace, exposure: Exposure) -> Camera | None:
    """The camera named by flag, sidecar or header; `identify` without --fov needs one: BadInput (no_calibration)."""
    if args.command == "identify" and args.fov is not None:
        return None
    if exposure.camera is not None:
        return load_camera(exposure.camera)
    if args.command == "detect":
        return None
    raise BadInput("no_calibration", "no camera file is known: give -c FILE, a sidecar with camera, or --fov DEG")


def _found_fov_text(camera: Camera, fov_rad: float | tuple[float, float]) -> str:
    """The field of view in degrees: the stated one, or of a range that of the `camera` found."""
    if not isinstance(fov_rad, tuple):
        return f"{math.degrees(fov_rad):.4g}"
    middle, right = camera.centre_px[1], camera.size_px[0] - 0.5
    width_rad = float(camera.angle_rad(np.array([[-0.5, middle], [right, middle]])).sum())
    found_rad = width_rad if width_rad < WIDE_FIELD_RAD else max(2 * camera.calibrated_angle_rad, WIDE_FIELD_RAD)
    return f"{math.degrees(found_rad):.4g}"


def _locate_skyline(args: argparse.Namespace) -> int:
    """Locate the camera by the skyline of --skyline; the exit code."""
    check_localizer(args)
    if args.images:
        args.usage_error("--skyline stands in place of images: give one of them")
    if args.localizer != DEFAULT_LOCALIZER:
        args.usage_error(f"--skyline: only --localizer {DEFAULT_LOCALIZER} takes a measured skyline")
    try:
        with refusing_shortage():
            record, line = _solve_skyline(args)
    except BadInput as cause:
        record = output.refused_dict(args.skyline, cause.reason, str(cause))
        line = output.refusal_line(args.skyline, cause.reason, str(cause))
    print_warnings(args, Path(args.skyline).name, record.get("warnings", ()))
    code = print_outcome(args, record, line)
    if record["status"] == "ok":
        _print_folder(args, "fix")
    return code


def _solve_skyline(args: argparse.Namespace) -> Outcome:
    start = time.perf_counter()
    if args.terrain is None:
        raise BadInput("bad_terrain", "no terrain file is known: give -t FILE")
    terrain = load_terrain(args.terrain)
    when = None if args.time is None else parse_utc(args.time)
    camera = None if args.camera is None else load_camera(args.camera)
    near = None if args.near is None else PositionPrior(*args.near)
    stated = _stated_attitude(args)
    known = chain.StatedAttitude.of_input(stated, terrain.site, when)
    points = chain.skyline_points(args.skyline, _errors_of(args, stated), camera, known, near)
    exposure = chain.skyline_exposure(args.skyline, when, args.terrain)
    out = Path(args.dir) / f"{Path(args.skyline).stem}.fix.json"
    _claim_record(args, out, exposure.sha256)
    prepare(terrain, args)
    with wait_lines(args, f"locate {printable(exposure.name)}"):
        result = chain.locate_skyline(exposure, points, terrain, args.time_limit)
    record = _write_files(args, result, out)
    line = output.summary_line(result, seconds=time.perf_counter() - start)
    return record, line + ("\n" + output.verbose_text(result) if args.verbose else "")


def _stated_attitude(args: argparse.Namespace) -> str | tuple[float, float, float] | None:
    """Azimuth, pitch and roll [deg] of --attitude, or the path of a file."""
    words = [] if args.attitude is None else args.attitude.split(",")
    try:
        return attitude(words) if len(words) == 3 else args.attitude
    except argparse.ArgumentTypeError as cause:
        args.usage_error(f"argument --attitude: {cause}")
        raise  # the line above ends the program


def _errors_of(args: argparse.Namespace, stated: str | tuple[float, ...] | None) -> chain.SkylineErrors:
    """What flags state; the errors of a `stated` attitude in degrees must be, and those of a result count as none."""
    if isinstance(stated, tuple) and None in (args.heading_sigma, args.tilt_sigma):
        args.usage_error("--attitude AZ,PITCH,ROLL needs its errors: --heading-sigma DEG and --tilt-sigma DEG")
    return chain.SkylineErrors.of_inputs(
        heading_sigma=args.heading_sigma, tilt_sigma=args.tilt_sigma, correlation=args.correlation
    )
