"""Tracks of simulated drives and rests: errors and calibration of the filter, the smoother and the plain sum.

    python benchmarks/drives.py [--drives 40] [--pixels] [--case NAME ...] [--seed N] [--section NAME]

Drives on real Shackleton with odometry of 2 %, and rests. By default the evidence is simulated, without images: the
catalogue's stars near the skyline, with the noise of photometry. With `--pixels` frames of 2048 px are rendered and
located. "Filtered" is the position after ten frames of a drive, or after four exposures at rest.
The degraded map differs from the ground by 5 m of white noise per post and 0.08 degrees common to all azimuths (one
standard deviation each), drawn anew for each drive; the ground differs, and the map is the shipped one, whose file
states such errors. "Plain sum" is the same smoother with every frame's own covariance and nothing shared.
"""

from __future__ import annotations

import argparse
import shlex
import sys
import time
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
from _drive_frames import Course, draw_course, frames_by_evidence, frames_by_pixels
from _map_draws import draw_ground
from _results import table, write_section

from startrack.applications.tracking.odometry import Moves
from startrack.applications.tracking.positions import conclude, filter_positions, positions_at_rest
from startrack.core import ODOMETRY_FLOOR_M, ODOMETRY_SIGMA
from startrack.core.types import Array
from startrack.estimation.observations import FrameEstimate, Steps
from startrack.estimation.trajectory import smooth
from startrack.terrain import HeightMap, load_terrain

POST_SIGMA_M, RAISED_SIGMA_RAD = 5.0, np.radians(0.08)
RADIUS_M, SLOPE_RAD = 4000.0, np.radians(20.0)
SLIP_PART, SLIP_M = 0.1, 20.0
SETTLED_FRAMES = 10  # after which the filter is scored
SEED = 41
CRATER = "shackleton-thesis"
PACKAGES = "numpy", "scipy"


@dataclass(frozen=True)
class Case:
    """One kind of tracks."""

    frames: int
    spacing_m: float  # 0: at rest
    every_s: float
    degraded: bool = False
    share: float = 0.0  # of the sky's light in the background
    slips: bool = False
    terrain: str = "shackleton-rendered"


CASES = {
    "50 m": Case(40, 50.0, 900.0),
    "50 m, slips": Case(40, 50.0, 900.0, slips=True),
    "25 m, sky 30 %": Case(40, 25.0, 900.0, share=0.3),
    "10 m, degraded": Case(14, 10.0, 900.0, degraded=True),
    "57 m, degraded": Case(14, 57.0, 900.0, degraded=True),
    "rest": Case(12, 0.0, 12 * 3600.0),
    "rest, sky 7 %": Case(12, 0.0, 12 * 3600.0, share=0.07),
    "rest, sky 30 %": Case(12, 0.0, 12 * 3600.0, share=0.3),
    "rest, degraded": Case(12, 0.0, 12 * 3600.0, degraded=True),
    "rest, thesis crater": Case(12, 0.0, 12 * 3600.0, terrain=CRATER),
    "rest, thesis crater, sky 30 %": Case(12, 0.0, 12 * 3600.0, share=0.3, terrain=CRATER),
}


@dataclass(frozen=True, eq=False, kw_only=True)
class RaisedMap(HeightMap):
    """Ground whose horizon is everywhere higher by `raised_rad`."""

    raised_rad: float

    def horizon_rad(self, points_m: Array, azimuths_rad: Array) -> Array:
        return super().horizon_rad(points_m, azimuths_rad) + self.raised_rad


def main() -> None:
    """Run, print and write the section."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--drives", type=int, default=40, help="of each case")
    parser.add_argument("--pixels", action="store_true", help="render and locate the frames")
    parser.add_argument("--case", action="append", choices=CASES, help="these cases only")
    parser.add_argument("--seed", type=int, default=SEED)
    parser.add_argument("--section", help="of the results; without it cases of one's own choice are not stored")
    args = parser.parse_args()
    lines = []
    for name in args.case or CASES:
        case = CASES[name]
        if case.share and not args.pixels:
            continue
        rows = []
        for number in range(args.drives):
            start = time.process_time()
            rows.append(score_track(case, np.random.default_rng([args.seed, number]), args.pixels, number))
            figures = {key: round(float(value), 2) for key, value in rows[-1].items()}
            print(name, number, figures, f"{time.process_time() - start:.0f} s", flush=True)
        lines.append([name, str(len(rows)), *summary(rows)])
        print(lines[-1], flush=True)
    head = ["tracks", "number", "one frame, m", "NEES", "filtered, m", "NEES", "smoothed, m", "NEES",
            "plain sum, m", "NEES"]  # fmt: skip
    body = table(head, lines)
    print(body)
    if args.section or not args.case:
        section = args.section or f"Tracks from {'pixels' if args.pixels else 'evidence'}"
        write_section(section, shlex.join(["python", "benchmarks/drives.py", *sys.argv[1:]]), PACKAGES, body)


def score_track(case: Case, rng: np.random.Generator, pixels: bool, number: int) -> dict[str, float]:
    """Mean errors [m] and NEES of one track."""
    course = course_of(case, rng, pixels)
    frames = list(frames_by_pixels(course, case.share, number) if pixels else frames_by_evidence(course, rng))
    modes = [frame.modes for frame in frames]
    single = [of[0] if len(of) == 1 else None for of in modes]
    used = np.flatnonzero([one is not None for one in single])
    found = {"frame": _scored([single[k] for k in used], course.position_m[used])}
    steps = odometry(case, course.position_m, rng)
    plain = smooth([one and alone(one) for one in single], steps)
    found["plain"] = _score(plain.position_m, plain.covariance_m2, course.position_m)
    if case.spacing_m == 0.0:
        by_first = positions_at_rest(frames, course.stated, course.shared)[1]
        position, covariance = by_first.position_m, by_first.covariance_m2
        found["filtered"] = _score(position[3:4], covariance[3:4], course.position_m[:1])
        found["smoothed"] = _score(position[-1:], covariance[-1:], course.position_m[:1])
    else:
        late = slice(SETTLED_FRAMES, None)
        filtered = filter_positions(modes, [Moves.of(steps)], len(course.shared))
        found["filtered"] = _score(filtered.position_m[late], filtered.covariance_m2[late], course.position_m[late])
        robust = conclude(modes, filtered.compared).smoothed
        found["smoothed"] = _score(robust.position_m, robust.covariance_m2, course.position_m)
    return {f"{key} {what}": value for key, score in found.items() for what, value in score.items()}


def course_of(case: Case, rng: np.random.Generator, pixels: bool) -> Course:
    """The track's true positions, its ground and the stated map."""
    ground = stated = load_terrain(case.terrain)
    raised = 0.0
    if case.degraded:
        shipped = load_terrain("shackleton")
        assert isinstance(shipped, HeightMap)
        ground, stated, raised = draw_ground(shipped, POST_SIGMA_M, rng), shipped, RAISED_SIGMA_RAD * rng.normal()
    if pixels and raised and isinstance(ground, HeightMap):
        facts = {f.name: getattr(ground, f.name) for f in fields(ground)}
        ground, raised = RaisedMap(**facts, raised_rad=raised), 0.0
    stated.prepare()
    course = draw_course(
        ground, stated, float(raised), frames=case.frames, spacing_m=case.spacing_m, every_s=case.every_s,
        radius_m=RADIUS_M, slope_rad=SLOPE_RAD, rng=rng,
    )  # fmt: skip
    return replace(course, uses_sky=case.share > 0.0)


def odometry(case: Case, position_m: Array, rng: np.random.Generator) -> Steps:
    """Moves with the errors that they state, and slips."""
    moves = np.diff(position_m, axis=0)
    sigma = np.hypot(ODOMETRY_SIGMA * np.linalg.norm(moves, axis=1), ODOMETRY_FLOOR_M if case.spacing_m else 1e-3)
    measured = moves + sigma[:, None] * rng.normal(size=moves.shape) * (case.spacing_m > 0.0)
    if case.slips:
        which = rng.choice(len(moves), round(SLIP_PART * len(moves)), replace=False)
        angle = rng.uniform(0.0, 2 * np.pi, len(which))
        measured[which] += SLIP_M * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    return Steps(measured, sigma)


def alone(estimate: FrameEstimate) -> FrameEstimate:
    """The position by one frame, as if nothing were shared."""
    return replace(
        estimate, mean=estimate.mean[:2], covariance=estimate.covariance[:2, :2], response=np.eye(2),
        noise=estimate.covariance[:2, :2], post=estimate.post[:0], by_post=estimate.by_post[:2, :0],
    )  # fmt: skip


def _scored(estimates: list[Any], position_m: Array) -> dict[str, float]:
    return _score(
        np.array([e.mean[:2] for e in estimates]), np.array([e.covariance[:2, :2] for e in estimates]), position_m
    )


def _score(found_m: Array, covariance_m2: Array, position_m: Array) -> dict[str, float]:
    error_m, nees = mean_error_and_nees(found_m, covariance_m2, position_m)
    return {"m": error_m, "NEES": nees}


def mean_error_and_nees(found_m: Array, covariance_m2: Array, position_m: Array) -> list[float]:
    """Mean error [m] and NEES of positions (n, 2) with covariances (n, 2, 2)."""
    off = found_m - position_m
    nees = np.einsum("ni,nij,nj->n", off, np.linalg.inv(covariance_m2), off)
    return [float(np.linalg.norm(off, axis=1).mean()), float(nees.mean())]


def summary(rows: list[dict[str, float]]) -> list[str]:
    """Means of the columns."""
    return [
        f"{np.mean([row[f'{key} {what}'] for row in rows]):.2f}"
        for key in ("frame", "filtered", "smoothed", "plain") for what in ("m", "NEES")
    ]  # fmt: skip


if __name__ == "__main__":
    main()
