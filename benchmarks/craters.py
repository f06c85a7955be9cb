"""Dark craters from their shipped maps, from pixels: positions on floor and wall, no prior, by night.

    python benchmarks/craters.py [--terrain haworth de-gerlache kepler rough] [--floor 3] [--wall 2]

"rough" is a user's own map (_rough_map.py), kept in a temporary folder; it gets 5 positions on the floor and 5 on the
wall.

fisheye-2048 with its own sensor and default exposure (V 6 on the axis at 5 sigma), the sky, defects and headings as
`startrack render` has them. Floor: slopes below 15 degrees; wall: 15 to 40. Times between 2025 and 2032 with the Sun
below the horizon of a plain (half a degree above it in the polar craters, whose rims hide it). The Earth is always up
in Kepler, sometimes in the others.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np
from _results import table, write_section
from _rough_map import rough_terrain

from startrack.camera import load_camera
from startrack.catalog import bodies, load_catalog
from startrack.chain import Located, locate
from startrack.frames import R_enu_icrs, Site
from startrack.rendering import Series, render
from startrack.terrain import HeightMap, load_terrain

FLOOR_DEG, WALL_DEG = (0.0, 15.0), (15.0, 40.0)
ROUGH_POSITIONS = 5  # each on floor and wall
HIGHEST_SUN = {True: np.sin(np.radians(0.5)), False: np.sin(np.radians(-3.0))}  # in polar craters, elsewhere
POLAR_RAD = np.radians(60)


def main() -> None:
    """Run, print and write the section."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--terrain", nargs="+", default=["haworth", "de-gerlache", "kepler", "rough"])
    parser.add_argument("--floor", type=int, default=3)
    parser.add_argument("--wall", type=int, default=2)
    parser.add_argument("--seed", type=int, default=11)
    args = parser.parse_args()
    lines: list[list[str]] = []
    for name in args.terrain:
        rough = name == "rough"
        terrain = load_terrain(
            rough_terrain(Path(tempfile.gettempdir()) / "startrack-rough-map") if rough else f"{name}-rendered"
        )
        assert isinstance(terrain, HeightMap)
        terrain.prepare()
        rng = np.random.default_rng(args.seed)
        floor, wall = (ROUGH_POSITIONS, ROUGH_POSITIONS) if rough else (args.floor, args.wall)
        positions = [*draw_positions(terrain, floor, FLOOR_DEG, rng), *draw_positions(terrain, wall, WALL_DEG, rng)]
        for number, (position, slope) in enumerate(positions):
            when = draw_night(terrain.site, rng)
            lines.append([name, *measure_position(terrain, position, slope, when, number, args.seed)])
            print(" | ".join(lines[-1]), flush=True)
    head = ["crater", "place, m", "slope, degrees", "horizon, degrees", "result", "error, m", "95 % circle, m",
            "99.9 %, m", "NEES", "s, position", "CPU s, all"]  # fmt: skip
    command = f"python benchmarks/craters.py --terrain {' '.join(args.terrain)} --floor {args.floor} --wall {args.wall}"
    write_section("Dark craters", command, ("numpy", "scipy"), table(head, lines))


def draw_positions(
    terrain: HeightMap, count: int, slopes_deg: tuple[float, float], rng: np.random.Generator
) -> list[tuple[np.ndarray, float]]:
    """Positions (2,) in the search area with slopes in a range, and the slopes in degrees."""
    found: list[tuple[np.ndarray, float]] = []
    while len(found) < count:
        azimuth, distance = rng.uniform(0, 2 * np.pi), terrain.search_radius_m * np.sqrt(rng.random())
        position = distance * np.array([np.sin(azimuth), np.cos(azimuth)])
        slope = float(np.degrees(terrain.slope_rad(position)))
        if slopes_deg[0] <= slope < slopes_deg[1]:
            found.append((position, slope))
    return found


def draw_night(site: Site, rng: np.random.Generator) -> datetime:
    """A time at which the Sun is down."""
    while True:
        when = datetime(2025, 1, 1, tzinfo=UTC) + timedelta(seconds=float(rng.uniform(0, 8 * 365 * 86_400)))
        (sun,) = (body for body in bodies(site, when) if body.name == "Sun")
        if (R_enu_icrs(site, when) @ sun.ray_icrs)[2] < HIGHEST_SUN[abs(site.latitude_rad) > POLAR_RAD]:
            return when


def measure_position(
    terrain: HeightMap, position: np.ndarray, slope: float, when: datetime, number: int, seed: int
) -> list[str]:
    """Render and locate one exposure; a row of the table."""
    camera, catalog = load_camera("fisheye-2048"), load_catalog()
    series = Series(
        camera=camera, terrain=terrain, catalog=catalog.brighter_than(10.0), seed=seed, time_utc=when,
        east_m=float(position[0]), north_m=float(position[1]),
    )  # fmt: skip
    scene, rng = series.scene(number, f"frame-{number:03d}")
    exposure, _ = render(scene, rng=rng)
    start = time.process_time()
    result = locate(exposure, camera, terrain, catalog)
    spent = time.process_time() - start
    horizon = np.degrees(terrain.horizon_rad(position[None], np.radians(np.arange(360.0))))
    where = [f"E {position[0]:.0f} N {position[1]:.0f}", f"{slope:.0f}", f"{horizon.min():.1f} to {horizon.max():.1f}"]
    times = [f"{result.timing_ms.get('locate', 0.0) / 1e3:.1f}", f"{spent:.1f}"]
    if not isinstance(result, Located) or result.status != "ok":
        return [*where, result.reason or result.status, *["-"] * 4, *times]
    fix: Any = result.fix
    off = fix.position_enu_m[:2] - position
    nees = float(off @ np.linalg.solve(fix.covariance_m2, off))
    numbers = (float(np.hypot(*off)), fix.radius95_m, fix.radius999_m)
    return [*where, result.status, *[f"{value:.1f}" for value in numbers], f"{nees:.2f}", *times]


if __name__ == "__main__":
    main()
