"""Predicted accuracy against what `locate` states and how it errs, on images that were not used for it.

    python benchmarks/predictions.py [--places 10] [--frames 4] [--draws 10]

At each place `startrack.predict` gives the expected 95 % radius from draws without images. Then images of the place are
rendered whole, with other noise, other errors of the stars' fluxes and of the clock, other headings and hot pixels, on
ground that differs from the map by errors as its file states them (a cylinder's states none). They are located with
default settings, as `startrack locate` does. The ratio of a place is the predicted radius over the median of those that
`locate` states for its images; of a terrain, that of the geometric means over places. The coverage is the share of the
located images whose error is below the predicted radius.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from datetime import UTC, datetime, timedelta

import numpy as np
from _hazard_class import errors_as_stated
from _map_draws import draw_position
from _results import table, write_section

import startrack
from startrack.camera import load_camera
from startrack.catalog import load_catalog
from startrack.chain import Located, locate
from startrack.core.types import TIME_SIGMA_S, Array
from startrack.rendering import Series, load_sky_catalog, render
from startrack.terrain import HeightMap, load_terrain

SEED, WHEN = 4211, datetime(2031, 2, 14, tzinfo=UTC)
CAMERA, TERRAINS = "fisheye-2048", ("shackleton-thesis", "shackleton")
FLOOR_M, FLOOR_SLOPE_RAD, WALL_M = 4000.0, np.radians(15.0), 9500.0
FAINTEST_V_MAG = 10.0
ALIKE = 0.65, 1.5  # ratios of places that agree


def main() -> None:
    """Run, print and write the section."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--places", type=int, default=10, help="on each terrain")
    parser.add_argument("--frames", type=int, default=4, help="rendered at each place")
    parser.add_argument("--draws", type=int, default=10, help="of the prediction at each place")
    args = parser.parse_args()
    lines = [measure(name, args.places, args.frames, args.draws) for name in TERRAINS]
    head = ["terrain", "places", "images located", "predicted 95 % radius, m (median)",
            "stated by `locate`, m (median)", "predicted / stated", f"places within {ALIKE[0]} to {ALIKE[1]}",
            "squared error / predicted", "within the predicted radius"]  # fmt: skip
    body = table(head, lines)
    print(body)
    command = f"python benchmarks/predictions.py --places {args.places} --frames {args.frames} --draws {args.draws}"
    write_section("Predictions against images", command, ("numpy", "scipy"), body)


def measure(name: str, places: int, frames: int, draws: int) -> list[str]:
    """A line of the table."""
    positions_m = np.array([position(name, place) for place in range(places)])
    found = startrack.predict(CAMERA, name, time=WHEN, positions_m=positions_m, draws=draws, seed=SEED)
    predicted_m2 = found.cells["sigma_major_m"] ** 2 + found.cells["sigma_minor_m"] ** 2
    radius_m, ratios, images, squares = found.cells["radius95_m"], [], [], []
    for place, at in enumerate(positions_m):
        located = [radius_and_error_m(name, at, SEED + 1000 * place + k) for k in range(frames)]
        known = np.array([one for one in located if one is not None]).reshape(-1, 2)
        print(name, f"predicted {radius_m[place]:.2f} m, stated", np.round(known[:, 0], 2), "errors",
              np.round(known[:, 1], 2), flush=True)  # fmt: skip
        images += [(radius_m[place], *one) for one in known]
        if len(known):
            ratios.append(radius_m[place] / np.median(known[:, 0]))
            squares.append(np.mean(known[:, 1] ** 2) / predicted_m2[place])
    predicted, stated, error = np.array(images).T
    low, high = ALIKE
    log, alike = np.log(ratios), np.count_nonzero((np.array(ratios) > low) & (np.array(ratios) < high))
    sigma = np.exp(log.mean()) * np.std(log, ddof=1) / np.sqrt(len(log))
    square_sigma = np.std(squares, ddof=1) / np.sqrt(len(squares))
    return [name, str(places), f"{len(images)} of {places * frames}", f"{np.median(radius_m):.1f}",
            f"{np.median(stated):.1f}", f"{np.exp(log.mean()):.2f} ± {sigma:.2f}", f"{alike} of {places}",
            f"{np.mean(squares):.2f} ± {square_sigma:.2f}",
            f"{np.count_nonzero(error <= predicted)} of {len(images)}"]  # fmt: skip


def position(name: str, place: int) -> Array:
    """A place on the floor, drawn."""
    terrain, rng = load_terrain(name), np.random.default_rng([SEED, place])
    if isinstance(terrain, HeightMap):
        return draw_position(terrain, FLOOR_M, FLOOR_SLOPE_RAD, rng)
    azimuth = rng.uniform(0, 2 * np.pi)
    return np.asarray(WALL_M * np.sqrt(rng.random()) * np.array([np.sin(azimuth), np.cos(azimuth)]))


def radius_and_error_m(name: str, position_m: Array, seed: int) -> tuple[float, float] | None:
    """The stated 95 % radius and the horizontal error of a rendered image; None where it is refused or ambiguous."""
    camera, terrain, rng = load_camera(CAMERA), load_terrain(name), np.random.default_rng([SEED, seed])
    ground = errors_as_stated(terrain, rng) if isinstance(terrain, HeightMap) else terrain
    series = Series(
        camera=camera, terrain=ground, catalog=load_sky_catalog("auto").brighter_than(FAINTEST_V_MAG), seed=seed,
        time_utc=WHEN, east_m=float(position_m[0]), north_m=float(position_m[1]),
    )  # fmt: skip
    scene, noise = series.scene(0)
    exposure, truth = render(scene, rng=noise)
    stated = WHEN + timedelta(seconds=TIME_SIGMA_S * rng.standard_normal())
    exposure = replace(exposure, time_utc=stated, time_sigma_s=TIME_SIGMA_S, time_sigma_is_stated=False)
    found = locate(exposure, camera, terrain, load_catalog())
    if not isinstance(found, Located) or found.status != "ok":
        return None
    return found.fix.radius95_m, float(np.linalg.norm((found.fix.position_enu_m - truth.position_enu_m)[:2]))


if __name__ == "__main__":
    main()
