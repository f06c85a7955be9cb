"""Predicted accuracy against images that were not used for it: rendered to pixels and located.

    python benchmarks/predictions.py [--places 6] [--frames 3] [--draws 10]

At each place `startrack.predict` gives the expected error from draws without pixels; then images of the same place are
rendered, with other noise, other errors of the stars' fluxes and other headings, on ground that differs from the map by
errors as its file states them (a cylinder's states none), and located on the map by their stars alone, as the
prediction is. The ratio is the squared error of the images over the predicted one: 1 where both are alike. The
coverage is the share of the located images whose error is below the predicted 95 % radius.
"""

from __future__ import annotations

import argparse
from datetime import UTC, datetime

import numpy as np
from _hazard_class import errors_as_stated
from _map_draws import draw_position
from _results import table, write_section

import startrack
from startrack.camera import load_camera
from startrack.catalog import load_catalog
from startrack.chain import Located, Settings, locate
from startrack.core.types import Array
from startrack.rendering import Series, load_sky_catalog, render
from startrack.terrain import HeightMap, load_terrain

SEED, WHEN = 4211, datetime(2031, 2, 14, tzinfo=UTC)
CAMERA, TERRAINS = "fisheye-2048", ("shackleton-thesis", "shackleton")
FLOOR_M, FLOOR_SLOPE_RAD, WALL_M = 4000.0, np.radians(15.0), 9500.0
FAINTEST_V_MAG = 10.0


def main() -> None:
    """Run, print and write the section."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--places", type=int, default=6, help="on both terrains together")
    parser.add_argument("--frames", type=int, default=3, help="rendered at each place")
    parser.add_argument("--draws", type=int, default=10, help="of the prediction at each place")
    args = parser.parse_args()
    lines = [measure(name, args.places // len(TERRAINS), args.frames, args.draws) for name in TERRAINS]
    head = ["terrain", "places", "images located", "squared error / predicted (mean over places)",
            "within the predicted 95 % radius", "predicted 95 % radius, m (median)",
            "root mean squared error, m"]  # fmt: skip
    body = table(head, lines)
    print(body)
    command = f"python benchmarks/predictions.py --places {args.places} --frames {args.frames} --draws {args.draws}"
    write_section("Predictions against images", command, ("numpy", "scipy", "numba"), body)


def measure(name: str, places: int, frames: int, draws: int) -> list[str]:
    """A line of the table."""
    positions_m = np.array([position(name, place) for place in range(places)])
    found = startrack.predict(CAMERA, name, time=WHEN, positions_m=positions_m, draws=draws, seed=SEED)
    errors_m = [
        [error_m(name, at, SEED + 1000 * place + k) for k in range(frames)] for place, at in enumerate(positions_m)
    ]
    predicted_m2 = found.cells["sigma_major_m"] ** 2 + found.cells["sigma_minor_m"] ** 2
    radius_m = found.cells["radius95_m"]
    ratios, inside, located = [], 0, 0
    for errors, square_m2, radius in zip(errors_m, predicted_m2, radius_m, strict=True):
        known = np.array([error for error in errors if error is not None])
        print(name, np.round(known, 2), f"predicted rms {square_m2**0.5:.2f} m, radius {radius:.2f} m", flush=True)
        located += len(known)
        inside += int(np.sum(known <= radius))
        if len(known):
            ratios.append(float(np.mean(known**2) / square_m2))
    sigma = np.std(ratios, ddof=1) / np.sqrt(len(ratios))
    all_m = np.array([error for errors in errors_m for error in errors if error is not None])
    return [name, str(places), f"{located} of {places * frames}", f"{np.mean(ratios):.2f} ± {sigma:.2f}",
            f"{inside} of {located}", f"{np.median(radius_m):.1f}", f"{np.sqrt(np.mean(all_m**2)):.1f}"]  # fmt: skip


def position(name: str, place: int) -> Array:
    """A place on the floor, drawn."""
    terrain, rng = load_terrain(name), np.random.default_rng([SEED, place])
    if isinstance(terrain, HeightMap):
        return draw_position(terrain, FLOOR_M, FLOOR_SLOPE_RAD, rng)
    azimuth = rng.uniform(0, 2 * np.pi)
    return np.asarray(WALL_M * np.sqrt(rng.random()) * np.array([np.sin(azimuth), np.cos(azimuth)]))


def error_m(name: str, position_m: Array, seed: int) -> float | None:
    """Horizontal error of the position from one rendered image; None where it is refused or ambiguous."""
    camera, terrain = load_camera(CAMERA), load_terrain(name)
    is_map = isinstance(terrain, HeightMap)
    ground = errors_as_stated(terrain, np.random.default_rng([SEED, seed])) if is_map else terrain
    series = Series(
        camera=camera, terrain=ground, catalog=load_sky_catalog("auto").brighter_than(FAINTEST_V_MAG), seed=seed,
        time_utc=WHEN, east_m=float(position_m[0]), north_m=float(position_m[1]),
    )  # fmt: skip
    scene, rng = series.scene(0)
    exposure, truth = render(scene, rng=rng)
    found = locate(exposure, camera, terrain, load_catalog(), Settings(evidence_sources="stars"))
    if not isinstance(found, Located) or found.status != "ok":
        return None
    return float(np.linalg.norm((found.fix.position_enu_m - truth.position_enu_m)[:2]))


if __name__ == "__main__":
    main()
