"""`startrack calibrate`: a camera file from pictures of the stars, and what else is done with camera files."""

from __future__ import annotations

import argparse
import json
import math
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from startrack.cli.common import DEFAULT_OUT, exit_code_of_reason, read
from startrack.cli.flag_types import amount, field_of_view_rad, number, positive
from startrack.errors import NoSolution
from startrack.files import make_folder

if TYPE_CHECKING:
    from startrack.calibration import Calibration
    from startrack.camera import Camera
    from startrack.frames import Site
    from startrack.types import Exposure

TOOLS = ("verify", "show", "convert", "board")
FORMATS = ("ros", "kalibr", "colmap", "opencv")


def add_parser(subparsers: Any) -> None:
    """Add `calibrate` to the commands of the `startrack` parser."""
    parser: argparse.ArgumentParser = subparsers.add_parser(
        "calibrate",
        help="a camera file from pictures of the stars",
        formatter_class=argparse.RawDescriptionHelpFormatter,
        description="Fit the lens of a camera to the stars of one or more pictures of the open night sky, judge the "
        "fit, and write the camera file\nwith its covariance, a report and a JSON record. What cannot be trusted is "
        "refused, with the pictures that would help.",
        epilog="startrack calibrate IMAGE... --fov 180 -o CAMERA.toml     from nothing but a rough field of view\n"
        "startrack calibrate IMAGE... -c ROUGH.toml -o CAMERA.toml  from an approximate camera file\n"
        "startrack calibrate verify IMAGE... -c CAMERA.toml         does it still fit today's picture?\n"
        "startrack calibrate show CAMERA.toml                       what a camera file says\n"
        "startrack calibrate convert CAMERA.toml --to ros -o OUT    to ros, kalibr, colmap or opencv\n"
        "startrack calibrate convert FILE --from kalibr -o CAMERA.toml\n"
        "startrack calibrate board IMAGE... --pattern 9x6 -o CAMERA.toml   from pictures of a chessboard",
    )
    parser.add_argument("words", nargs="+", metavar="IMAGE", help="images; or verify, show, convert, board and theirs")
    parser.add_argument("-o", "--output", metavar="FILE", help="what to write (default: camera.toml in OUT)")
    parser.add_argument("-c", "--camera", metavar="FILE", help="approximate camera file, or one to verify")
    parser.add_argument("--fov", type=field_of_view_rad, metavar="DEG", help="below 100: angle across the "
                        "width; from 100 up: of the image circle")  # fmt: skip
    parser.add_argument("--time", metavar="UTC", help="middle of the exposure, ISO 8601 (one image only)")
    parser.add_argument("--exposure", type=positive, metavar="S", help="exposure time in seconds")
    parser.add_argument("--site", metavar="LAT,LON[,M]", help="where on the Earth, in degrees and metres: refraction "
                        "is taken out (--site=-30.2,...)")  # fmt: skip
    parser.add_argument("-t", "--terrain", metavar="FILE", help="terrain file whose origin is the site")
    parser.add_argument("--name", help="name of the camera (default: the file's stem)")
    sensor = parser.add_argument_group("sensor, where the pictures do not tell")
    sensor.add_argument("--gain", type=positive, metavar="E", help="electrons per ADU")
    sensor.add_argument("--read-noise", type=amount, metavar="E", help="read noise, electrons")
    sensor.add_argument("--bias", type=number, metavar="ADU", help="level without light")
    convert = parser.add_argument_group("convert")
    convert.add_argument("--to", choices=FORMATS, help="write this kind of file")
    convert.add_argument("--from", dest="source", choices=FORMATS, help="read this kind of file")
    board = parser.add_argument_group("board")
    board.add_argument("--pattern", metavar="CxR", help="inner corners of a chessboard; squares of a ChArUco board")
    board.add_argument("--charuco", metavar="DICT", help="ChArUco with this dictionary, such as DICT_5X5_100")
    board.add_argument("--marker", type=float, default=0.75, metavar="PART", help="marker's side over square's (0.75)")
    parser.add_argument("-D", "--dir", metavar="OUT", default=DEFAULT_OUT, help="folder of the results (%(default)s)")
    parser.add_argument("--json", action="store_true", help="print the JSON object")
    parser.add_argument("--no-plots", action="store_true", help="no report")
    parser.add_argument("-v", "--verbose", action="count", default=0, help="say more; tracebacks of internal errors")
    parser.add_argument("-q", "--quiet", action="store_true", help="print nothing but errors")
    parser.set_defaults(usage_error=parser.error)


def run(args: argparse.Namespace) -> int:
    """Calibrate, or do what the first word says; the exit code."""
    if args.words[0] in TOOLS:
        from startrack.cli import calibrate_tools

        tool: Callable[[argparse.Namespace, list[str]], int] = getattr(calibrate_tools, args.words[0])
        if not args.words[1:]:
            args.usage_error(f"calibrate {args.words[0]}: of which file?")
        return tool(args, args.words[1:])
    return _calibrate(args)


def _calibrate(args: argparse.Namespace) -> int:
    from startrack.calibration import Given, calibrate
    from startrack.calibration.record import refusal_dict
    from startrack.catalog import load_catalog
    from startrack.output import write_json

    if args.time is not None and len(args.words) > 1:
        args.usage_error("--time is the time of one image; give each of several its own in a sidecar NAME.json")
    out = output_path(args, "camera.toml")
    exposures = [read(path, args) for path in args.words]
    start = approximate(args, exposures)
    with progress(args, 2 * len(exposures) + 3) as tell:
        try:
            found = calibrate(
                exposures,
                load_catalog(),
                camera=start,
                fov_rad=args.fov,
                site=site_of(args, exposures),
                given=Given(gain_e_per_adu=args.gain, read_noise_e=args.read_noise, bias_adu=args.bias),
                name=args.name or out.stem,
                progress=tell,
            )
        except NoSolution as cause:
            record = refusal_dict(cause.reason, str(cause))
            write_json(out.with_suffix(".calibration.json"), record)
            return tell_outcome(args, record, f"{out.name}  refused {cause.reason}: {cause}")
    return write_calibration(args, out, found)


def write_calibration(args: argparse.Namespace, out: Path, found: Calibration) -> int:
    """Write and print a calibration; the exit code."""
    from startrack.calibration.record import calibration_dict, summary
    from startrack.calibration.report import write_report
    from startrack.camera.io import camera_text
    from startrack.files import write_atomically
    from startrack.output import write_json

    record, line = calibration_dict(found), summary(found, out.name)
    line += f"\n  {record['message']}" if record["message"] else ""
    if found.accepted:
        write_atomically(out, camera_text(found.camera).encode("utf-8"), overwrite=True)
    write_json(out.with_suffix(".calibration.json"), record)
    hot = None if found.photometry is None else found.photometry.facts.hot_px
    if hot is not None:
        lines = ["x_px,y_px", *(f"{x:.0f},{y:.0f}" for x, y in hot)]
        write_atomically(out.with_suffix(".hot-pixels.csv"), ("\n".join(lines) + "\n").encode(), overwrite=True)
    if not args.no_plots:
        write_report(out, found)
    if args.verbose and found.photometry is not None:
        line += "".join(f"\n  {note}" for note in found.photometry.notes)
    return tell_outcome(args, record, line)


def tell_outcome(args: argparse.Namespace, record: dict[str, Any], line: str) -> int:
    """Print the record or the line; the exit code of its reason."""
    if args.json:
        print(json.dumps(record), flush=True)
    elif not args.quiet or record["status"] != "ok":
        print(line, file=sys.stderr if args.quiet else sys.stdout, flush=True)
    return exit_code_of_reason(record["status"], record["reason"])


def output_path(args: argparse.Namespace, default: str) -> Path:
    """Where the result goes, its folder made. Raises BadInput where that is impossible."""
    path = Path(args.output) if args.output else Path(args.dir) / default
    make_folder(path.parent)
    return path


def approximate(args: argparse.Namespace, exposures: list[Exposure]) -> Camera | None:
    """The camera to begin with: the flag's, else (without --fov) the one that the images name."""
    from startrack.camera import load_camera

    named = args.camera or (None if args.fov else next((e.camera for e in exposures if e.camera), None))
    return load_camera(named) if named else None


def site_of(args: argparse.Namespace, exposures: list[Exposure]) -> Site | None:
    """The site of --site, else of the terrain that a flag or the images name; None where nothing names one."""
    from startrack.frames import Site
    from startrack.terrain import load_terrain

    if args.site:
        try:
            latitude, longitude, *height = (float(word) for word in args.site.split(","))
        except ValueError:
            args.usage_error(f"--site {args.site}: latitude, longitude and, if known, height: 34.74,-111.42,2361")
        return Site("earth", math.radians(latitude), math.radians(longitude), height[0] if height else 0.0)
    named = next((e.terrain for e in exposures if e.terrain), None)
    return load_terrain(named).site if named else None


@contextmanager
def progress(args: argparse.Namespace, steps: int) -> Iterator[Callable[[str], None]]:
    """A bar over the steps that says what is being done, on a terminal only."""
    if args.quiet or args.json or not sys.stderr.isatty():
        yield lambda text: None
        return
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

    columns = (BarColumn(), TextColumn("{task.completed:.0f}/{task.total:.0f}"), TimeElapsedColumn())
    with Progress(*columns, TextColumn("{task.description}"), console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task("starting", total=steps, completed=-1)
        yield lambda text: bar.update(task, advance=1, description=text)
