"""Horizons of height maps: beside Embree on the same surface, and beside plain marches in small steps.

    python benchmarks/horizons.py [--places 5]

Random positions in the inner two thirds of the search area (floor and wall), 720 azimuths each, on one core. The
surface: bilinear between posts in the map's own projection. Embree gets triangles of 48 m (Kepler 24 m; 7 m
within 900 m) and finds the horizon by bisection in elevation; the time for building its scene is not included.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np
from _embree import EmbreeHorizons
from _results import table, write_section

from startrack.terrain import HeightMap, load_terrain
from startrack.terrain.ground import ground_up_m

CROPS_M = {"shackleton": 16_000.0, "haworth": 22_000.0, "kepler": 17_000.0}
AZIMUTHS_RAD = np.radians(np.arange(0.25, 360, 0.5))
NUMPY_EVERY = 20


def main() -> None:
    """Run, print and write the section."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--places", type=int, default=5)
    parser.add_argument("--seed", type=int, default=1)
    args = parser.parse_args()
    lines = []
    for name, half_m in CROPS_M.items():
        terrain = crop_terrain(name, half_m)
        rng = np.random.default_rng(args.seed)
        azimuth, distance = rng.uniform(0, 2 * np.pi, args.places), 0.67 * np.sqrt(rng.random(args.places))
        positions = terrain.search_radius_m * distance[:, None] * np.column_stack([np.sin(azimuth), np.cos(azimuth)])
        lines += compare_methods(name, terrain, positions)
        print("\n".join(" ".join(line) for line in lines[-4:]), flush=True)
    body = table(
        ["map", "method", "horizons", "RMS from Embree, degrees", "mean", "largest", "CPU microseconds a horizon"],
        lines,
    )
    write_section("Horizons", f"python benchmarks/horizons.py --places {args.places}", ("numpy", "embreex"), body)


def crop_terrain(name: str, half_m: float) -> HeightMap:
    """The terrain with a crop of its finest map alone."""
    whole = load_terrain(name)
    assert isinstance(whole, HeightMap)
    crop = whole.maps[0].crop_around(whole.site.latitude_rad, whole.site.longitude_rad, half_m)
    return replace(whole, maps=(crop,))


def compare_methods(name: str, terrain: HeightMap, positions: np.ndarray) -> list[list[str]]:
    """One row per method."""
    step_m = terrain.maps[0].post_m / 8
    methods: dict[str, tuple[Callable[[np.ndarray, np.ndarray], np.ndarray], int]] = {
        "startrack": (lambda p, a: terrain.horizon_rad(p[None], a), 1),
        f"march in steps of {step_m:.0f} m, compiled": (lambda p, a: march_compiled(terrain, p, a, step_m), 1),
        f"march in steps of {step_m:.0f} m, numpy": (lambda p, a: march_numpy(terrain, p, a, step_m), NUMPY_EVERY),
    }
    truth, spent, inside = [], 0.0, []
    for position in positions:
        embree = EmbreeHorizons(terrain, position)
        start = time.process_time()
        truth.append(embree.horizon_rad(AZIMUTHS_RAD))
        spent += time.process_time() - start
        _, distance, edge = terrain.horizons(position[None], AZIMUTHS_RAD)
        inside.append(distance < edge - 2 * terrain.maps[0].post_m)  # without the last cell of the crop
    count = len(positions) * len(AZIMUTHS_RAD)
    rows = [[name, "Embree", str(count), "-", "-", "-", f"{1e6 * spent / count:.0f}"]]
    for method, (function, every) in methods.items():
        function(positions[0], AZIMUTHS_RAD[:2])
        start = time.process_time()
        found = [function(position, AZIMUTHS_RAD[::every]) for position in positions]
        spent = time.process_time() - start
        off = np.degrees(
            np.concatenate([(f - t[::every])[i[::every]] for f, t, i in zip(found, truth, inside, strict=True)])
        )
        errors = [f"{np.sqrt(np.mean(off**2)):.5f}", f"{off.mean():.5f}", f"{np.abs(off).max():.5f}"]
        rows.append([name, method, str(len(off)), *errors, f"{1e6 * spent * every / count:.0f}"])
    return rows


def march_compiled(terrain: HeightMap, position: np.ndarray, azimuths: np.ndarray, step_m: float) -> np.ndarray:
    """Small steps; the surface is startrack's own."""
    s = np.arange(step_m, CROPS_M[terrain.name], step_m)
    up = terrain.ground_m(position) + terrain.camera_height_m
    found = np.empty(len(azimuths))
    for k, azimuth in enumerate(azimuths):
        z = terrain.ground_m(position + s[:, None] * np.array([np.sin(azimuth), np.cos(azimuth)]))
        found[k] = np.arctan(np.max((z - up) / s))
    return found


def march_numpy(terrain: HeightMap, position: np.ndarray, azimuths: np.ndarray, step_m: float) -> np.ndarray:
    """Small steps, a ray at a time, with numpy alone."""
    s, maps = np.arange(step_m, CROPS_M[terrain.name], step_m), list(terrain.maps)
    up = ground_up_m(terrain.site, maps, position) + terrain.camera_height_m
    found = np.empty(len(azimuths))
    for k, azimuth in enumerate(azimuths):
        z = ground_up_m(terrain.site, maps, position + s[:, None] * np.array([np.sin(azimuth), np.cos(azimuth)]))
        found[k] = np.arctan(np.nanmax((z - up) / s))
    return found


if __name__ == "__main__":
    main()
