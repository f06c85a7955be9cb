"""Depth, width and positions of drives in a round crater of which nothing is known: stars and odometry.

    python benchmarks/unknown_crater.py [--drives 20] [--pixels 0]

The thesis's crater, of which the terrain file states another depth and width, drawn with sigmas of 30 and 25 %. A drive
of 2 km in 40 steps of 50 m in a random direction ends within 5 km of the axis. Odometry errs by 2 % of each step, each
step by itself; in the last case all steps are 1 % too long besides, as the stated 2 % include. The evidence is
simulated, without images: stars of the catalogue, 5 sigma at V 6. With `--pixels` so many drives are rendered and
located too.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from datetime import timedelta

import numpy as np
from _drive_frames import (
    FIRST_DAY,
    FIRST_ERROR_M,
    FIRST_SIGMA_M,
    FLUX_SCATTER,
    NEAR_RAD,
    Course,
    frames_by_pixels,
    simulate_evidence,
)
from _results import table, write_section

from startrack.applications.tracking import ObservedFrame, Odometry, Track, estimate_track
from startrack.applications.tracking.frame_estimate import estimate_frame
from startrack.applications.tracking.observed_frame import observe_again
from startrack.catalog import load_catalog
from startrack.core import ODOMETRY_FLOOR_M, ODOMETRY_SIGMA
from startrack.localization import settle_steepness
from startrack.terrain import Cylinder, load_terrain

FRAMES, STEP_M, EVERY_S = 41, 50.0, 900.0
END_M = 5000.0  # of the last position from the axis, at most
DEPTH_SIGMA_1, WIDTH_SIGMA_1 = 0.3, 0.25
TOO_LONG_1 = {"independent errors of 2 %": 0.0, "all steps 1 % too long besides": 0.01}
SEARCHED_RAD = np.radians(25.0)  # from the skyline: rows of the frame that the steepness is searched by
SEED = 47


def main() -> None:
    """Run, print and write the section."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--drives", type=int, default=20)
    parser.add_argument("--pixels", type=int, default=0, help="drives from rendered frames")
    args = parser.parse_args()
    rows = []
    for source, drives in (("evidence", args.drives), ("pixels", args.pixels)):
        scores: dict[str, list[list[float]]] = {name: [] for name in TOO_LONG_1}
        for number in range(drives):
            rng = np.random.default_rng([SEED, number])
            course = draw_drive(rng)
            frames = observe(course, number, rng, by_pixels=source == "pixels")
            noise = rng.normal(size=(FRAMES - 1, 2))
            for name, too_long_1 in TOO_LONG_1.items():
                odometry = drive_odometry(course, noise, too_long_1)
                track = estimate_track(frames, course.stated, course.shared, odometry=odometry)
                scores[name].append(score(track, course))
                print(source, number, name, np.round(scores[name][-1], 2), flush=True)
        rows += [[name, source, str(drives), *summary(of)] for name, of in scores.items() if of]
    head = ["odometry", "from", "drives", "depth, m", "stated, m", "width, m", "stated, m", "last position, m", "NEES",
            "all positions, m"]  # fmt: skip
    body = table(head, rows)
    print(body)
    command = f"python benchmarks/unknown_crater.py --drives {args.drives} --pixels {args.pixels}"
    write_section("A crater of unknown depth and width", command, ("numpy", "scipy"), body)


def draw_drive(rng: np.random.Generator) -> Course:
    """A drive in the thesis's crater, with a file that states another one."""
    ground = load_terrain("shackleton-thesis")
    assert isinstance(ground, Cylinder)
    heading, end = rng.uniform(0.0, 2 * np.pi), np.full(2, np.inf)
    while np.hypot(*end) > END_M:
        end = rng.uniform(-END_M, END_M, 2)
    way = np.array([np.sin(heading), np.cos(heading)])
    position = end - STEP_M * np.arange(FRAMES - 1, -1, -1)[:, None] * way
    depth_m, diameter_m = (
        size * np.clip(1.0 + sigma * rng.normal(), 1.0 - 2 * sigma, 1.0 + 2 * sigma)
        for size, sigma in ((ground.depth_m, DEPTH_SIGMA_1), (ground.diameter_m, WIDTH_SIGMA_1))
    )
    stated = replace(
        ground, depth_m=depth_m, depth_sigma_m=DEPTH_SIGMA_1 * depth_m, diameter_m=diameter_m,
        diameter_sigma_m=WIDTH_SIGMA_1 * diameter_m, search_radius_m=diameter_m / 2,
    )  # fmt: skip
    start = FIRST_DAY + timedelta(days=float(rng.uniform(0.0, 300.0)))
    times = tuple(start + timedelta(seconds=EVERY_S * k) for k in range(FRAMES))
    return Course(ground, stated, 0.0, position, times)


def observe(course: Course, number: int, rng: np.random.Generator, *, by_pixels: bool) -> list[ObservedFrame]:
    """The frames; errors are counted from the steepness that the first one shows."""
    if by_pixels:
        found = [replace(frame, R_body_enu=np.eye(3)) for frame in frames_by_pixels(course, 0.0, number)]
        ground = course.stated.with_steepness(found[0].steepness_1)
        return [observe_again(frame, course.shared, ground) for frame in found]
    catalog, frames, terrain = load_catalog(), [], course.stated
    error_mag = rng.normal(size=len(catalog)) * np.hypot(catalog.v_sigma_mag, FLUX_SCATTER)
    assert isinstance(course.ground, Cylinder) and isinstance(course.stated, Cylinder)
    scale = course.stated.diameter_m / course.ground.diameter_m  # of positions that a search gives
    for position, when in zip(course.position_m, course.time_utc, strict=True):
        near_rad = NEAR_RAD if frames else SEARCHED_RAD
        evidence = simulate_evidence(course, position, when, error_mag, rng, near_rad)
        terrain = settle_steepness(evidence, terrain)
        at = scale * (position + FIRST_ERROR_M * rng.normal(size=2))
        estimate = estimate_frame(evidence, terrain, course.shared.on(terrain), at, FIRST_SIGMA_M**2 * np.eye(2))
        frames.append(ObservedFrame(f"frame-{len(frames):03d}", when, np.eye(3), (estimate,), evidence))
    return frames


def drive_odometry(course: Course, noise: np.ndarray, too_long_1: float) -> Odometry:
    """Level poses with the stated errors, their steps too long by a part."""
    moves = np.diff(course.position_m, axis=0)
    sigma_m = np.hypot(ODOMETRY_SIGMA * np.linalg.norm(moves, axis=1), ODOMETRY_FLOOR_M)
    moves = (1.0 + too_long_1) * moves + sigma_m[:, None] * noise
    position = np.vstack([np.zeros(2), np.cumsum(moves, axis=0)])
    return Odometry(
        time_s=np.array([when.timestamp() for when in course.time_utc]),
        position_m=np.column_stack([position, np.zeros(FRAMES)]), quat_xyzw=np.tile([0.0, 0.0, 0.0, 1.0], (FRAMES, 1)),
    )  # fmt: skip


def score(track: Track, course: Course) -> list[float]:
    """Errors of depth, width and last position, what is stated of them, and the mean error of all positions."""
    assert track.depth is not None and track.width is not None and isinstance(course.ground, Cylinder)
    off = track.smoothed.position_enu_m[:, :2] - course.position_m
    nees = off[-1] @ np.linalg.solve(track.smoothed.covariance_m2[-1], off[-1])
    return [
        track.depth.size_m - course.ground.depth_m, track.depth.sigma_m,
        track.width.size_m - course.ground.diameter_m, track.width.sigma_m,
        float(np.hypot(*off[-1])), float(nees), float(np.hypot(*off.T).mean()),
    ]  # fmt: skip


def summary(scores: list[list[float]]) -> list[str]:
    """Means of the columns, of absolute values."""
    return [f"{value:.2f}" if value < 10 else f"{value:.1f}" for value in np.abs(scores).mean(axis=0)]


if __name__ == "__main__":
    main()
