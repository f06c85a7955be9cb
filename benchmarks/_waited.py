"""Waits within a process, for waits.py: the function with the name given as argument prints its cost [ms of CPU time].

Runs under the code that PYTHONPATH holds, also that of an older commit: it uses names that both have.
"""

from __future__ import annotations

import os
import statistics
import sys
import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

SAMPLE = Path(__file__).parent.parent / "sample_images/near-wall.png"
SCENES = Path(__file__).parent.parent.parent / "shared/scenes/thesis"  # where there are any
RUNS = 15
LISTS = 500


def read_to_fix() -> None:
    """A sample image from its file to the fix, no output files."""
    from startrack import locate

    print_ms(lambda: locate(SAMPLE))


def sep_winpos() -> None:
    """sep finds the stars of the same image: background, extraction, windowed centroids."""
    import cv2
    import numpy as np
    from _star_peers import sep_winpos as find

    image = cv2.imread(str(SAMPLE), cv2.IMREAD_UNCHANGED).astype(np.float32)
    print_ms(lambda: find(image, 1.0))


def detection_per_mpx() -> None:
    """The stars of a frame of 4 Mpx with 2000 stars, with a camera file; per Mpx."""
    detect_frame("startrack")


def sep_per_mpx() -> None:
    """The same by sep: background, extraction, windowed centroids."""
    detect_frame("sep_winpos")


def detect_frame(finder: str) -> None:
    """The frame's stars by a function of `_star_peers`."""
    import _star_peers
    import numpy as np
    from _star_frames import star_frame

    sigma_px = 1.2
    frame = star_frame(sigma_px, 2000, (3.0, 300.0), rng=np.random.default_rng([1, 0]))
    find = getattr(_star_peers, finder)
    print_ms(lambda: find(frame.image, sigma_px), parts=frame.image.size / 1e6)


def narrow_fields() -> None:
    """Stars and attitude of narrow fields of which the width is known to 10 %; a frame."""
    import stars_narrow

    from startrack.detection import Detector

    detector = Detector()
    solve_narrow(lambda exposure: detector(exposure, None), lambda _: stars_narrow.solve_ours)


def tetra3rs_narrow_fields() -> None:
    """The same by tetra3rs with its thorough extraction."""
    import stars_narrow

    def solver(width_deg: float) -> Callable[[Any, Any, Any], object]:
        base = stars_narrow.database([width_deg])
        return lambda found, picture, _: stars_narrow.solve_tetra3rs(found, picture, base)

    solve_narrow(stars_narrow.extract_thorough, solver)


def solve_narrow(find: Callable[[Any], object], solver: Callable[[float], Callable[[Any, Any, Any], object]]) -> None:
    """Frames of each width, found and solved by the function that `solver` gives for the width."""
    from stars_narrow import WIDTHS_DEG, synthetic_pictures

    from startrack.catalog import load_catalog

    stars = load_catalog().at(None, None)

    def solve_one(solve: Callable[[Any, Any, Any], object], picture: Any) -> object:
        return solve(find(picture.exposure), picture, stars)

    runs = []
    for width in WIDTHS_DEG:
        solve = solver(width)
        runs += [partial(solve_one, solve, p) for p in synthetic_pictures(stars, width, 3)]
    print_ms(*runs)


def live_answer() -> None:
    """From an image's file to the line of `track --follow` on one core; the median of five [s], two before them."""
    import live

    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder)
        live.render_drive(root, "shackleton-rendered", live.WARM_UP + 5)
        times_s = live.measure_times(root, root / "out")
    print(statistics.median(wall for wall, _ in times_s[live.WARM_UP :]))


def listed_stars() -> None:
    """80 stars and 20 false ones on a lens of 180 degrees; the median list."""
    from _identify_peers import startrack

    print_median_list(startrack)


def ruststartracker_listed_stars() -> None:
    """The same by ruststartracker to V 4.5 and 90 degrees, the middle of its settings."""
    from math import radians

    from _identify_peers import ruststartracker

    print_median_list(lambda camera, stars: ruststartracker(camera, stars, 4.5, radians(90)))


def print_median_list(solver: Callable[[Any, Any], Any]) -> None:
    """The median CPU time of the lists of stars_identification.py."""
    import numpy as np
    from stars_identification import cases, run, star_list

    from startrack.catalog import load_catalog

    case, stars = cases()[0], load_catalog().at(None, None)
    rngs = [np.random.default_rng([0, number]) for number in range(LISTS)]
    lists = [star_list(case.camera, stars, case.true, case.false, case.noise_px, rng=rng) for rng in rngs]
    print(statistics.median(run(solver(case.camera, stars), lists, np.inf).ms))


def next_frames() -> None:
    """Stars of rendered frames, each a minute after the one before and, where the code can, near its attitude."""
    from datetime import timedelta
    from inspect import signature

    from startrack import identify
    from startrack.catalog import apparent_stars, load_catalog
    from startrack.identification import Identifier

    identifier, has_near = Identifier(), "near_R_cam_icrs" in signature(Identifier.__call__).parameters
    runs = []
    for path in (SAMPLE, *sorted(SCENES.glob("*.png"))[:3]):
        found = identify(path).result
        when, R = found.exposure.time_utc, found.attitude_fit.attitude.R_cam_icrs
        skies = iter([apparent_stars(load_catalog(), when + timedelta(minutes=k), None) for k in range(RUNS + 1)])
        near = (R,) if has_near else ()
        runs.append(lambda f=found, skies=skies, near=near: identifier(f.detections, f.camera, next(skies), *near))
    print_ms(*runs)


def horizon_table() -> None:
    """The table of horizons of a rough map of 1500 x 1500 posts, on all cores [s]."""
    from dataclasses import replace

    from _rough_map import rough_terrain

    from startrack.terrain import load_terrain

    with tempfile.TemporaryDirectory() as folder:
        os.environ["XDG_CACHE_HOME"] = folder
        terrain = load_terrain(rough_terrain(Path(folder)))
        replace(terrain, search_radius_m=100.0).prepare()
        start = time.perf_counter()
        terrain.prepare()
    print(time.perf_counter() - start)


def own_map() -> None:
    """Image to fix on this map with the errors that it shows itself; largest and median of nine places [s]."""
    times_s = own_map_times_s()
    print(max(times_s), statistics.median(times_s))


def own_map_times_s() -> list[float]:
    """Times at five places on the floor and four on the wall, after one that loads what it needs."""
    import numpy as np
    from _rough_map import rough_terrain
    from craters import FLOOR_DEG, WALL_DEG, draw_night, draw_positions

    from startrack.camera import load_camera
    from startrack.catalog import load_catalog
    from startrack.chain import locate
    from startrack.rendering import Series, render
    from startrack.terrain import load_terrain

    rng, camera, catalog, times_s = np.random.default_rng(2024), load_camera("fisheye-2048"), load_catalog(), []
    with tempfile.TemporaryDirectory() as folder:
        os.environ["XDG_CACHE_HOME"] = folder
        terrain = load_terrain(rough_terrain(Path(folder), errors=()))
        terrain.prepare()
        positions = [*draw_positions(terrain, 5, FLOOR_DEG, rng), *draw_positions(terrain, 4, WALL_DEG, rng)]
        for number, (place, _) in enumerate(positions[:1] + positions):
            series = Series(
                camera=camera, terrain=terrain, catalog=catalog.brighter_than(10.0), seed=77,
                time_utc=draw_night(terrain.site, rng), east_m=float(place[0]), north_m=float(place[1]),
            )  # fmt: skip
            scene, noise = series.scene(number, f"frame-{number}")
            exposure, _ = render(scene, rng=noise)
            start = time.perf_counter()
            locate(exposure, camera, terrain, catalog)
            times_s.append(time.perf_counter() - start)
    return times_s[1:]


def print_ms(*runs: Callable[[], object], parts: float = 1.0) -> None:
    """The median CPU time of a part of each call, after one that loads what it needs; the mean over the calls."""
    medians = []
    for run in runs:
        run()
        costs = []
        for _ in range(RUNS):
            start = time.process_time()
            run()
            costs.append(time.process_time() - start)
        medians.append(statistics.median(costs))
    print(1e3 * statistics.mean(medians) / parts)


if __name__ == "__main__":
    globals()[sys.argv[1]]()
