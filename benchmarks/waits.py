"""What a person waits for: this code, that of another commit and peers in turn, in one run; the median of each.

    python benchmarks/waits.py [--against COMMIT] [--runs N] [--only WORD ...]

One function a row. A process gets the code by PYTHONPATH; the other commit's is a git worktree. Seconds are wall time,
in brackets CPU time; milliseconds are CPU time. Ratios count, on free cores: a machine at work stretches both.
"""

from __future__ import annotations

import argparse
import atexit
import math
import os
import re
import resource
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
import tomllib
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import cache, partial
from importlib import metadata
from pathlib import Path

from _results import table, write_section

ROOT = Path(__file__).parent.parent
SAMPLE = ROOT / "sample_images/near-wall.png"
BASELINE = "374b11e"
REFUSED = 3  # the exit code
PHOTO, PHOTO_SITE = ROOT / "sample_images/lowell-2018-08-06.fits.bz2", "--site=34.7443,-111.4223,2361"
FLAT = """
format = 1
name = "flat"
body = "moon"
origin = {latitude_deg = 20.0, longitude_deg = 30.0}
cylinder = {diameter_m = 20000.0, depth_m = 20.0}
rover = {camera_height_m = 1.5}
search = {radius_m = 9000.0}
"""
WARM = set[tuple[Path, str]]()  # codes, and commands that they have run
PEERS = ("sep", "tetra3rs", "ruststartracker")
Cost = tuple[float, ...]  # one number, or wall and CPU time


@dataclass(frozen=True)
class Row:
    """A wait: `measure` takes the folder of a code and gives its cost in `unit`, NaN where that code cannot do it.

    `peer` gives the cost of another program on the same input; `runs`: how often at most.
    """

    name: str
    wanted: str
    measure: Callable[[Path], Cost]
    unit: str = "s"
    peer: Callable[[], Cost] | None = None
    runs: int = 9


def main() -> None:
    """Measure the rows; write the section of RESULTS.md."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--against", default=BASELINE, metavar="COMMIT")
    parser.add_argument("--runs", type=int, default=9)
    parser.add_argument(
        "--only", nargs="+", default=[""], metavar="WORD", help="rows with one of these words; not stored"
    )
    args = parser.parse_args()
    rows = []
    with worktree(args.against) as before:
        for row in (row for row in ROWS if any(word in row.name for word in args.only)):
            rows.append(cells(row, before, min(row.runs, args.runs)))
            print(*rows[-1], sep="  ", flush=True)
    if args.only == [""]:
        columns = ["what", args.against, "this", "this / that", "peer", "this / peer", "wanted"]
        command = f"python benchmarks/waits.py --against {args.against} --runs {args.runs}"
        write_section("Waits", command, ("numpy", *PEERS), table(columns, rows))


def cells(row: Row, before: Path, runs: int) -> list[str]:
    """The cells of a row from `runs` rounds: the code in the folder `before`, this one, the peer."""
    sides = (lambda: row.measure(before), lambda: row.measure(ROOT), row.peer or (lambda: (math.nan,)))
    rounds = [[side() for side in sides] for _ in range(runs)]
    old, new, peer = (
        tuple(statistics.median(part) for part in zip(*costs, strict=True)) for costs in zip(*rounds, strict=True)
    )
    to_old, to_peer = (shown(new[0] / other[0], ".2f") for other in (old, peer))
    before_cell, cell, peer_cell = (in_unit(cost, row.unit) for cost in (old, new, peer))
    return [row.name, before_cell, cell, to_old, peer_cell, to_peer, row.wanted]


def in_unit(cost: Cost, unit: str) -> str:
    """A cost with its unit, CPU time in brackets; "-" where there is none."""
    number, *cpu = (shown(part, {"s": ".2f", "ms": ".3g"}.get(unit, ".0f")) for part in cost)
    return "-" if number == "-" else f"{number} {unit}" + "".join(f" ({part})" for part in cpu)


def shown(number: float, digits: str) -> str:
    return "-" if math.isnan(number) else format(number, digits)


@contextmanager
def worktree(commit: str) -> Iterator[Path]:
    """A folder with the files of a commit, for the block."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "code"
        subprocess.run(["git", "-C", ROOT, "worktree", "add", "-q", "--detach", path, commit], check=True)
        try:
            yield path
        finally:
            subprocess.run(["git", "-C", ROOT, "worktree", "remove", "--force", path], check=True)


def process(code: Path, *words: str) -> Cost:
    """Wall and CPU time of `startrack` with the arguments `words`, by the code in a folder."""
    inherited = {key: value for key, value in os.environ.items() if key != "PYTHONDONTWRITEBYTECODE"}
    with tempfile.TemporaryDirectory() as folder:
        command, before = [sys.executable, "-m", "startrack", *words, "-D", folder], cpu_s()
        start = time.perf_counter()
        done = subprocess.run(command, cwd=folder, env=inherited | {"PYTHONPATH": str(code)}, check=False)
        if done.returncode not in (0, REFUSED):
            done.check_returncode()
        return time.perf_counter() - start, cpu_s() - before


def in_process(name: str, code: Path = ROOT) -> Cost:
    """The last number that the function `name` of `_waited.py` prints; NaN if it fails."""
    return (printed_numbers(name, code)[-1],)


def printed_numbers(name: str, code: Path) -> list[float]:
    """What a function of `_waited.py` prints last, in a process with the code in a folder; NaN if it fails."""
    command = [sys.executable, str(ROOT / "benchmarks/_waited.py"), name]
    variables = os.environ | {"PYTHONPATH": str(code), "OPENBLAS_NUM_THREADS": "1"}
    done = subprocess.run(command, env=variables, check=False, capture_output=True, text=True)
    return [float(word) for word in done.stdout.splitlines()[-1].split()] if done.returncode == 0 else [math.nan]


own_map = cache(partial(printed_numbers, "own_map"))  # of the folder of a code


def cpu_s() -> float:
    """User and system time [s] of the processes that have ended."""
    usage = resource.getrusage(resource.RUSAGE_CHILDREN)
    return usage.ru_utime + usage.ru_stime


@cache
def warm_up(code: Path, image: Path, *flags: str) -> None:
    """Have the code compute the tables of the terrain of an image."""
    process(code, "locate", str(image), "-q", *flags)


def located(code: Path, *flags: str, image: Callable[[], Path] = lambda: SAMPLE) -> Cost:
    """The whole command, warm."""
    warm_up(code, image(), *flags)
    return process(code, "locate", str(image()), "-q", *flags)


@cache
def height_map_frame() -> Path:
    """A frame of the floor of Shackleton, rendered once."""
    return rendered("-t", "shackleton", "--seed", "3", "--east", "1500", "--north", "-2500")[0]


@cache
def open_sky_frames() -> list[str]:
    """17 frames of the sky over flat ground, of fisheye-2048 tilted by up to 20 degrees, with the usual exposure."""
    ground = temporary_folder() / "flat.toml"
    ground.write_text(FLAT, encoding="utf-8")
    frames = rendered("-t", str(ground), "--seed", "5", "-n", "17", "--max-tilt", "20")
    return [str(frame) for frame in frames]


def rendered(*flags: str) -> list[Path]:
    """The images that `startrack render` makes, in a folder that is removed at the end."""
    folder = temporary_folder()
    command = [sys.executable, "-m", "startrack", "render", *flags, "-D", str(folder)]
    subprocess.run(command, cwd=folder, env=os.environ | {"PYTHONPATH": str(ROOT)}, check=True, capture_output=True)
    return sorted(folder.glob("*.png"))


def temporary_folder() -> Path:
    """A folder that is removed at the end."""
    folder = Path(tempfile.mkdtemp())
    atexit.register(shutil.rmtree, folder)
    return folder


def calibrated(code: Path) -> Cost:
    """`calibrate` from the field of view alone, warm."""
    return warm_process(code, "calibrate", *open_sky_frames(), "--fov", "185", "-q")


def horizon_of(code: Path) -> Cost:
    """`horizon` with a camera file, warm: the photograph of the samples, four times."""
    return warm_process(code, "horizon", *4 * [str(PHOTO)], PHOTO_SITE, "-c", "lowell-ldt", "-o", "found.csv", "-q")


def predicted(code: Path) -> Cost:
    """`predict` along a line on the floor of Shackleton, 10 places, 10 draws each, warm."""
    path = temporary_folder() / "path.csv"
    path.write_text("east_m,north_m\n-3000,-1000\n3000,2000\n", encoding="utf-8")
    flags = ("-t", "shackleton", "-c", "fisheye-2048", "--time", "2031-03-26T20:58:11Z", "--path", str(path), "-q")
    return warm_process(code, "predict", *flags, "--spacing", "746", "--no-plots")


def warm_process(code: Path, *words: str) -> Cost:
    """`process`, the second time in a run for a code."""
    if (code, words[0]) not in WARM:
        WARM.add((code, words[0]))
        process(code, *words)
    return process(code, *words)


def on_floor(code: Path, *flags: str) -> Cost:
    """The whole command without pictures for a frame of the floor of Shackleton, warm."""
    return located(code, "--no-plots", *flags, image=height_map_frame)


def core_mb(code: Path) -> Cost:
    """Files of the packages that the core requires, with theirs, as they are installed here [MB]."""
    project = tomllib.loads((code / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    found, coming = dict[str, int](), list(project["dependencies"])
    while coming:
        name = re.split(r"[^\w.-]", coming.pop())[0].lower()
        if name in found:
            continue
        found[name] = 0
        with suppress(metadata.PackageNotFoundError):  # required by other versions of Python only
            package = metadata.distribution(name)
            files = [Path(str(file.locate())) for file in package.files or []]
            found[name] = sum(file.stat().st_size for file in files if file.is_file())
            coming += [one for one in package.requires or [] if "extra ==" not in one]
    return (sum(found.values()) / 1e6,)


waited = partial(partial, in_process)  # the cost of a function of `_waited.py`
ROWS = (
    Row("`locate near-wall.png`, whole process, all files", "<= 1.5 s", located),
    Row("`locate near-wall.png --no-plots`, whole process", "<= 1.0 s", lambda code: located(code, "--no-plots")),
    Row("`locate --no-plots` on Shackleton's floor", "", on_floor, runs=5),
    Row("the same, with a clock right to an hour", "<= 3 s", lambda code: on_floor(code, "--time-sigma", "3600"),
        runs=3),
    Row("the same on Faustini's map, until refused", "<= 8 s", lambda code: on_floor(code, "-t", "faustini"), runs=3),
    Row("read to fix; sep", "<= 1 peer", waited("read_to_fix"), "ms", waited("sep_winpos"), 3),
    Row("detection per Mpx; sep", "<= 8 ms", waited("detection_per_mpx"), "ms", waited("sep_per_mpx"), 3),
    Row("narrow fields, detect and identify; tetra3rs, thorough", "<= 2 peer", waited("narrow_fields"), "ms",
        waited("tetra3rs_narrow_fields"), 3),
    Row("`calibrate`, 17 images of 4 Mpx, 2,000 stars each", "<= 15 s", calibrated, runs=3),
    Row("`horizon`, 4 photographs", "<= 8 s", horizon_of, runs=3),
    Row("`predict`, 10 places x 10 draws on Shackleton's floor", "<= 30 s", predicted, runs=1),
    Row("a table of horizons, 1500 x 1500 posts of 20 m", "<= 20 s", waited("horizon_table"), runs=1),
    Row("image to fix on a rough map, 9 places: median", "<= 1.5 s", lambda code: (own_map(code)[-1],), runs=1),
    Row("the same: the largest", "<= 4 s", lambda code: (own_map(code)[0],), runs=1),
    Row("live track on a height map, file to answer", "<= 1 s", waited("live_answer"), runs=1),
    Row("lost in space from a list; ruststartracker", "<= 1 peer", waited("listed_stars"), "ms",
        waited("ruststartracker_listed_stars"), 3),
    Row("identification of the next frame, after detection", "<= 5 ms", waited("next_frames"), "ms", runs=3),
    Row("packages of the core", "<= 760 MB", core_mb, "MB", runs=1),
)  # fmt: skip

if __name__ == "__main__":
    main()
