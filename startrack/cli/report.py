"""`startrack report`: results as one page that any browser opens."""

from __future__ import annotations

import argparse
import json
import math
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from startrack.cli.flag_types import count
from startrack.core.errors import BadInput
from startrack.core.files import check_output, existing_folder

if TYPE_CHECKING:
    from startrack.output.html import Found

PAGE = "report.html"
OF_ONE = ".report.html"
DEFAULT_IMAGES = 30
FEW = 3


def add_parser(subparsers: Any) -> None:
    """Add `report` to the commands of the `startrack` parser."""
    parser: argparse.ArgumentParser = subparsers.add_parser(
        "report",
        help="results as one page for a browser",
        description="Write OUT/report.html: every result of the folder OUT, in one file that needs no server and no "
        "network. Of a single NAME.fix.json it writes NAME.report.html beside it.",
    )
    parser.add_argument("out", metavar="OUT", help="folder of results, or one NAME.fix.json")
    parser.add_argument("-o", "--output", metavar="FILE", help="file of the page")
    parser.add_argument(
        "--images", type=count, default=DEFAULT_IMAGES, metavar="N",
        help="number of images with picture and stars (%(default)s); the table contains all",
    )  # fmt: skip
    parser.add_argument(
        "--truth", metavar="FOLDER", help="folder with NAME.truth.json of the images, to show the errors"
    )
    parser.add_argument("-v", "--verbose", action="count", default=0, help="tracebacks of internal errors")
    parser.add_argument("-q", "--quiet", action="store_true", help="print errors only")
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Write the page; 0."""
    path = write_page_of(args.out, truth=args.truth, images=args.images, output=args.output)
    if not args.quiet:
        print(f"page in {path}")
    return 0


def write_page_of(
    out: str, *, truth: str | None = None, images: int = DEFAULT_IMAGES, output: str | None = None
) -> Path:
    """Write the page of a folder of results or of one NAME.fix.json; its path. Raises BadInput, BadOutput."""
    from startrack.output.html import result_at, results_under, write_page

    if output is not None:
        check_output(output, overwrite=True)
    if Path(out).is_file():
        one = result_at(out)
        path = Path(output) if output else one.companion(OF_ONE)
        write_page(path, [one], real=_true_positions([one], truth), images=images, single=True)
        return path
    found, unread = results_under(out)
    for line in unread:
        print(f"startrack: left out {line}", file=sys.stderr)
    found = _select_tabled(out, found)
    path = Path(output) if output else Path(out) / PAGE
    write_page(path, found, unread=unread, real=_true_positions(found, truth), images=images)
    return path


def _select_tabled(out: str, found: list[Found]) -> list[Found]:
    """The results without results of a batch that its tables lack; a line on stderr names these."""
    from startrack.applications.batch import JOB, tabled_results

    known = tabled_results(Path(out))
    if known is None:
        return found
    left = {one.stem for one in found if JOB in one.record and one.path.relative_to(out).as_posix() not in known}
    if left:
        some = ", ".join(sorted(left)[:FEW]) + (", ..." if len(left) > FEW else "")
        print(
            f"startrack: left out {len(left)} results that {out}'s tables do not have ({some}): their images are no "
            "longer in the batch's folder, or startrack batch is to be run again",
            file=sys.stderr,
        )
    return [one for one in found if one.stem not in left]


def write_page_of_images(out: str, images: Sequence[str]) -> None:
    """Write the page beside new results: NAME.report.html of one image, OUT/report.html of several.

    An image that could not be read has no result to show.
    """
    from startrack.applications.batch import result_stems

    results = [path for stem in result_stems(images) if (path := Path(out) / f"{stem}.fix.json").is_file()]
    if len(images) == 1 and results:
        write_page_of(str(results[0]))
    elif results:
        write_page_of(out)


def _true_positions(found: Sequence[Found], folder: str | None) -> dict[str, tuple[float, float]]:
    """True (east, north) [m] by the results' stems, where the folder has them."""
    if folder is None:
        return {}
    root = existing_folder(folder, "truth")
    positions = {one.stem: _true_position(root, one) for one in found}
    return {stem: position for stem, position in positions.items() if position is not None}


def _true_position(folder: Path, one: Found) -> tuple[float, float] | None:
    """(east, north) [m] from NAME.truth.json at the path of the image or of its result."""
    image = one.record["image"]
    names = dict.fromkeys((image.removesuffix(Path(image).suffix), one.stem, Path(one.stem).name))
    path = next((file for name in names if (file := folder / f"{name}.truth.json").is_file()), None)
    if path is None:
        return None
    try:
        east, north = (float(value) for value in json.loads(path.read_text(encoding="utf-8"))["position_enu_m"][:2])
    except (OSError, ValueError, KeyError, TypeError) as cause:
        raise BadInput("bad_image", f"{path}: holds no position_enu_m ({type(cause).__name__})") from cause
    if not (math.isfinite(east) and math.isfinite(north)):
        raise BadInput("bad_image", f"{path}: position_enu_m is not finite")
    return east, north
