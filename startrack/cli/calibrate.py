"""`startrack calibrate`: a camera file from star exposures; `calibrate board` from pictures of a board."""

from __future__ import annotations

import argparse
import json
import math
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from startrack.cli.calibration_files import check_camera_output, write_camera, write_record
from startrack.cli.common import DEFAULT_OUT, add_pixel_flags, print_advice, read
from startrack.cli.flag_types import amount, field_of_view_rad, number, positive_number, seconds
from startrack.cli.progress import progress
from startrack.core.compilation import announce_compilation
from startrack.core.errors import NoSolution, exit_code_of

if TYPE_CHECKING:
    from startrack.applications.calibration import Calibration, KnownSensor
    from startrack.camera import Camera
    from startrack.core.declaration import Key
    from startrack.core.types import Exposure, Mask
    from startrack.frames import Site


def add_parser(subparsers: Any) -> None:
    """Add `calibrate` and its actions to the commands of the `startrack` parser."""
    from startrack.cli import calibrate_board, camera_files

    parser: argparse.ArgumentParser = subparsers.add_parser(
        "calibrate",
        help="a camera file from star exposures",
        formatter_class=argparse.RawDescriptionHelpFormatter,
        description="Fit the lens of a camera to the stars of one or more exposures of the open night sky, check the "
        "fit, and write the camera file\nwith its covariance, a report and a JSON record. A fit that fails a check is "
        "refused, with the exposures that would help.",
        epilog="startrack calibrate IMAGE... --fov 180 -o CAMERA.toml      from a rough field of view alone\n"
        "startrack calibrate IMAGE... -c ROUGH.toml -o CAMERA.toml  from an approximate camera file\n\n"
        "actions with flags and --help of their own:\n"
        "startrack calibrate verify IMAGE... -c CAMERA.toml         does the camera file still fit?\n"
        "startrack calibrate show CAMERA.toml                       the content of a camera file\n"
        "startrack calibrate convert CAMERA.toml --to ros -o OUT    to ros, kalibr, colmap or opencv\n"
        "startrack calibrate convert FILE --from kalibr -o CAMERA.toml\n"
        "startrack calibrate board IMAGE... --pattern 9x6 -o CAMERA.toml   from pictures of a chessboard",
    )
    parser.add_argument("images", nargs="+", metavar="IMAGE", help="PNG, TIFF, FITS, JPEG or camera raw")
    parser.add_argument("-c", "--camera", metavar="FILE", help="approximate camera file")
    parser.add_argument("--fov", type=field_of_view_rad, metavar="DEG", help="below 100: angle across the "
                        "width; from 100 up: of the image circle")  # fmt: skip
    add_site_flags(parser)
    sensor = parser.add_argument_group("sensor, if the exposures do not show it")
    sensor.add_argument("--gain", type=positive_number, metavar="E", help="electrons per ADU")
    sensor.add_argument("--read-noise", type=amount, metavar="E", help="read noise, electrons")
    sensor.add_argument("--bias", type=number, metavar="ADU", help="level without light")
    add_camera_output_flags(parser)
    parser.set_defaults(run=run, usage_error=parser.error)
    camera_files.add_parsers(subparsers)
    calibrate_board.add_parser(subparsers)


def add_site_flags(parser: argparse.ArgumentParser) -> None:
    """Flags for the time, the duration and the site of exposures of the sky."""
    parser.add_argument("--time", metavar="UTC", help="middle of the exposure, ISO 8601 (one image only)")
    parser.add_argument("--exposure", type=seconds, metavar="S", help="exposure time in seconds")
    add_pixel_flags(parser)
    parser.add_argument("--site", metavar="LAT,LON[,M]", help="site on the Earth, in degrees and metres, to correct "
                        "for refraction (--site=-30.2,...)")  # fmt: skip
    parser.add_argument("-t", "--terrain", metavar="FILE", help="terrain file whose origin is the site")


def add_camera_output_flags(parser: argparse.ArgumentParser) -> None:
    """Flags of the commands that make a camera file."""
    parser.add_argument("-o", "--output", metavar="FILE", help="the camera file (default: camera.toml in OUT)")
    parser.add_argument("--name", help="name of the camera (default: the file's stem)")
    parser.add_argument("-D", "--dir", metavar="OUT", default=DEFAULT_OUT, help="folder of the results (%(default)s)")
    add_overwrite_flag(parser)
    parser.add_argument("--no-plots", action="store_true", help="no report")
    add_print_flags(parser)


def add_overwrite_flag(parser: argparse.ArgumentParser) -> None:
    """The flag for replacing files."""
    parser.add_argument("-O", "--overwrite", action="store_true", help="replace files")


def add_print_flags(parser: argparse.ArgumentParser) -> None:
    """Flags for what is printed."""
    parser.add_argument("--json", action="store_true", help="print the JSON object")
    parser.add_argument("-v", "--verbose", action="count", default=0, help="more output; tracebacks of internal errors")
    parser.add_argument("-q", "--quiet", action="store_true", help="print errors only")


def run(args: argparse.Namespace) -> int:
    """Calibrate; the exit code."""
    from startrack.applications.calibration import calibrate
    from startrack.applications.calibration.record import refusal_dict
    from startrack.catalog import load_catalog

    if args.time is not None and len(args.images) > 1:
        args.usage_error("--time is the time of one image; give each of several its own in a sidecar NAME.json")
    check_name(args)
    known_sensor = _known_sensor(args)
    flag_site(args)  # wrong usage is reported before the images are read
    out = check_camera_output(args)
    exposures = [read(path, args) for path in args.images]
    announce_compilation()
    start = approximate_camera(args, exposures)
    with show_steps(args, 2 * len(exposures) + 3) as show_step:
        try:
            found = calibrate(
                exposures,
                load_catalog(),
                camera=start,
                fov_rad=args.fov,
                site=site_of(args, exposures),
                known_sensor=known_sensor,
                name=args.name or out.stem,
                progress=show_step,
            )
        except NoSolution as cause:
            record = refusal_dict(cause.reason, str(cause))
            write_record(out, record)
            return print_outcome(args, record, f"{out.name}  refused {cause.reason}: {cause}")
    return _write_calibration(args, out, found, [one.mask for one in exposures])


def check_name(args: argparse.Namespace) -> None:
    """A usage error for a name, of --name or of the file, that a camera file cannot hold."""
    from startrack.camera import camera_keys

    for flag, name in (("--name", args.name), ("the stem of --output", args.output and Path(args.output).stem)):
        if name is not None:
            checked_flag(args, camera_keys().keys["name"], name, flag)


def _known_sensor(args: argparse.Namespace) -> KnownSensor:
    """The sensor's properties given by flags, within the limits of camera files; else a usage error."""
    from startrack.applications.calibration import KnownSensor
    from startrack.camera import SENSOR

    flags = {"gain_e_per_adu": "--gain", "read_noise_e": "--read-noise", "bias_adu": "--bias"}
    given = (args.gain, args.read_noise, args.bias)
    known = {
        key: checked_flag(args, SENSOR.keys[key], value, flag)
        for (key, flag), value in zip(flags.items(), given, strict=True)
        if value is not None
    }
    return KnownSensor(**known)


def checked_flag(args: argparse.Namespace, key: Key, value: Any, flag: str) -> Any:
    """The value of a `flag` as the `key` of a file would have it; else a usage error."""
    try:
        return key.check(value, flag)
    except ValueError as cause:
        args.usage_error(str(cause))


def _write_calibration(args: argparse.Namespace, out: Path, found: Calibration, masks: list[str | Mask | None]) -> int:
    """Write and print a calibration of images with `masks`; the exit code."""
    from startrack.applications.calibration.record import calibration_dict, summary
    from startrack.applications.calibration.report import write_report

    record, line = calibration_dict(found), summary(found, out.name)
    line += f"\n  {record['message']}" if record["message"] else ""
    if found.accepted:
        about_mask = write_camera(out, found, [found.camera.mask, *masks])
        line += f"\n  {about_mask}" if about_mask else ""
    write_record(out, record)
    about_picture = "" if args.no_plots else write_report(out, found)
    if not args.quiet:
        if about_picture:
            print(about_picture, file=sys.stderr, flush=True)
        for one in found.refused:
            print(f"{one.name}: left out, {one.reason}: {one.message}", file=sys.stderr, flush=True)
    if args.verbose:
        line += "".join(f"\n  {note}" for note in found.photometry.notes)
    return print_outcome(args, record, line)


def print_outcome(args: argparse.Namespace, record: dict[str, Any], line: str) -> int:
    """Print the record or the line; the exit code of its reason."""
    if args.json:
        print(json.dumps(record), flush=True)
    elif not args.quiet or record["status"] != "ok":
        print(line, file=sys.stderr if args.quiet else sys.stdout, flush=True)
    if not args.json:
        print_advice(record["reason"], record["message"], args)
    return exit_code_of(record["reason"])


def approximate_camera(args: argparse.Namespace, exposures: list[Exposure]) -> Camera | None:
    """The initial camera: the flag's, else (without --fov) the one that the images name."""
    from startrack.camera import load_camera

    named = args.camera or (None if args.fov else next((e.camera for e in exposures if e.camera), None))
    return load_camera(named) if named else None


def flag_site(args: argparse.Namespace) -> Site | None:
    """The site of --site; None without it. A usage error for a place that is not on the Earth."""
    from startrack.frames import Site
    from startrack.terrain import TERRAIN_KEYS as KEYS

    if not args.site:
        return None
    try:
        words = [float(word) for word in args.site.split(",")]
        names = ("latitude_deg", "longitude_deg", "height_m")[: max(len(words), 2)]
        keys = dict(zip(names, words, strict=True))
    except ValueError:
        args.usage_error(f"--site {args.site}: latitude, longitude and, if known, height: 34.74,-111.42,2361")
    site = checked_flag(args, KEYS.keys["origin"], keys, "--site")
    return Site("earth", math.radians(site["latitude_deg"]), math.radians(site["longitude_deg"]), site["height_m"])


def site_of(args: argparse.Namespace, exposures: list[Exposure]) -> Site | None:
    """The site of --site, else of the terrain that a flag or the images name; None if there is none."""
    from startrack.terrain import load_terrain

    given = flag_site(args)
    named = next((e.terrain for e in exposures if e.terrain), None)
    return given if given is not None or named is None else load_terrain(named).site


@contextmanager
def show_steps(args: argparse.Namespace, steps: int) -> Iterator[Callable[[str], None]]:
    """A bar over the steps; the function to call with the name of each."""
    with progress("calibrate", steps, shown=not (args.quiet or args.json)) as bar:
        yield lambda text: bar.advance(text=text)
