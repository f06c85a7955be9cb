"""`startrack report`: results as one page that any browser opens; `demo` makes a picture and opens its page."""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Sequence
from pathlib import Path

from startrack.applications.batch import JOB, result_stems, tabled_results, text_of_name
from startrack.core import REPORTED_IMAGES
from startrack.core.errors import BadInput, one_line
from startrack.core.files import check_output, existing_folder, printable
from startrack.core.stored import read_json_object
from startrack.output import Found, result_at, results_under, write_page

PAGE = "report.html"  # of a folder; of one result NAME.report.html
NAMED_FILES = 3
POSITION_M = (-6900.0, 4700.0)  # of the demo: near the wall of the thesis's crater, where the position is known best


def run(args: argparse.Namespace) -> int:
    """Write the page; 0."""
    path = write_page_of(args.out, truth=args.truth, images=args.images, output=args.output)
    if not args.quiet:
        print(f"page in {printable(path)}")
    return 0


def write_page_of(
    out: str, *, truth: str | None = None, images: int = REPORTED_IMAGES, output: str | None = None
) -> Path:
    """Write the page of a folder of results or of one NAME.fix.json; its path. Raises BadInput, BadOutput."""
    if output is not None:
        check_output(output, overwrite=True)
    if Path(out).is_file():
        one = result_at(out)
        path = Path(output) if output else one.companion(f".{PAGE}")
        write_page(path, [one], real=_true_positions([one], truth), images=images, single=True)
        return path
    found, unread = results_under(out)
    for line in unread:
        print(f"startrack: left out {one_line(line)}", file=sys.stderr)
    found = _select_tabled(out, found)
    path = Path(output) if output else Path(out) / PAGE
    write_page(path, found, unread=unread, real=_true_positions(found, truth), images=images)
    return path


def _select_tabled(out: str, found: list[Found]) -> list[Found]:
    """The results without results of a batch that its tables lack; a line on stderr names these."""
    known = tabled_results(Path(out))
    if known is None:
        return found
    paths = {one.stem: text_of_name(one.path.relative_to(out).as_posix()) for one in found if JOB in one.record}
    left = {stem for stem, path in paths.items() if path not in known}
    if left:
        some = ", ".join(sorted(map(text_of_name, left))[:NAMED_FILES]) + (", ..." if len(left) > NAMED_FILES else "")
        print(
            f"startrack: left out {len(left)} results that {printable(out)}'s tables do not have ({some}): their "
            "images are no longer in the batch's folder, or startrack batch is to be run again",
            file=sys.stderr,
        )
    return [one for one in found if one.stem not in left]


def write_page_of_images(out: str, images: Sequence[str]) -> Path | None:
    """Write the page beside new results: NAME.report.html of one image, OUT/report.html of several; its path.

    An image that could not be read has no result to show; None where no image has one.
    """
    results = [path for stem in result_stems(images) if (path := Path(out) / f"{stem}.fix.json").is_file()]
    if not results:
        return None
    return write_page_of(str(results[0]) if len(images) == 1 else out)


def _true_positions(found: Sequence[Found], folder: str | None) -> dict[str, tuple[float, float]]:
    """True (east, north) [m] by the results' stems, of NAME.truth.json at the path of the image or of its result."""
    if folder is None:
        return {}
    root, positions_m = existing_folder(folder, "truth"), {}
    for one in found:
        image = Path(one.record["image"])
        names = dict.fromkeys((str(one.record["image"]).removesuffix(image.suffix), one.stem, Path(one.stem).name))
        path = next((file for name in names if (file := root / f"{name}.truth.json").is_file()), None)
        if path is None:
            continue
        try:
            east, north = (float(value) for value in (read_json_object(path) or {})["position_enu_m"][:2])
        except (ValueError, KeyError, TypeError, OverflowError) as cause:
            raise BadInput("bad_image", f"{path}: holds no position_enu_m ({type(cause).__name__})") from cause
        if not (math.isfinite(east) and math.isfinite(north)):
            raise BadInput("bad_image", f"{path}: position_enu_m is not finite")
        positions_m[one.stem] = east, north
    return positions_m


def run_demo(args: argparse.Namespace) -> int:
    """Render, locate, report; the exit code of `locate`."""
    from startrack.cli.main import main

    image, east_north = Path(args.dir) / "demo.png", [f"{metres:g}" for metres in POSITION_M]
    pose = ["--seed", str(args.seed), "--east", east_north[0], "--north", east_north[1]]
    made = main(["render", *pose, "-o", str(image), "-O", "-q"])
    if made:
        return made
    code = main(["locate", str(image), "-D", args.dir, "-O", *(["-q"] if args.quiet else [])])
    page = write_page_of(str(image.with_suffix(".fix.json")), truth=args.dir)
    if not args.quiet:
        print(f"the camera stood at E {east_north[0]} m, N {east_north[1]} m; page {printable(page)}")
    if not args.no_open:
        import webbrowser

        webbrowser.open(page.resolve().as_uri())
    return code
