"""A second drive with the heights of crests that a first drive estimated: how much they help it.

    python benchmarks/crests.py [--draws 12]

Two drives of the same length on real Shackleton, ten days apart, on ground that differs from the map by 5 m at each
post and 0.08 degrees all around, as its file states. The evidence is simulated, as in drives.py. The second drive
follows the first path at a distance to its side. It is estimated alone, and together with the first drive: then all
that the first drive shows of the posts is used, with its whole covariance, which no file of crests can exceed. "With
the horizon": the common error alone is taken from the first drive, not the posts. Each cell has the mean error, the
standard deviation that is stated (both in m, the latter on each axis), and the NEES.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from datetime import timedelta

import numpy as np
from _drive_frames import Course, draw_course, frames_by_evidence
from _map_draws import draw_ground
from _results import table, write_section
from drives import POST_SIGMA_M, RADIUS_M, RAISED_SIGMA_RAD, SLOPE_RAD, mean_error_and_nees

from startrack.core.types import Array
from startrack.estimation.observations import USUAL_ODOMETRY, Observations, Steps
from startrack.estimation.trajectory import smooth
from startrack.terrain import HeightMap, load_terrain

FRAMES, SPACING_M, EVERY_S = 14, 50.0, 900.0
LATER = timedelta(days=10)
SIDES_M = (0.0, 100.0)  # of the second path beside the first
OTHER_POSTS = 10**9  # added to numbers of posts: no other frame has these
SEED = 53


def main() -> None:
    """Run, print and write the section."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--draws", type=int, default=12)
    args = parser.parse_args()
    lines = []
    for side_m in SIDES_M:
        rows = np.array([score_draw(side_m, np.random.default_rng([SEED, k])) for k in range(args.draws)])
        lines.append([f"{side_m:.0f} m", *(" / ".join(f"{x:.2f}" for x in one) for one in rows.mean(axis=0))])
        print(lines[-1], flush=True)
    head = ["beside the first", "alone", "with the horizon", "with all posts"]
    body = table(head, lines)
    print(body)
    command = f"python benchmarks/crests.py --draws {args.draws}"
    write_section("A second drive with the crests of the first", command, ("numpy", "scipy", "numba"), body)


def score_draw(side_m: float, rng: np.random.Generator) -> list[list[float]]:
    """Scores of the second drive: alone, with the horizon's error, with all posts of the first."""
    shipped = load_terrain("shackleton")
    assert isinstance(shipped, HeightMap)
    shipped.prepare()
    first = draw_course(
        draw_ground(shipped, POST_SIGMA_M, rng), shipped, float(RAISED_SIGMA_RAD * rng.normal()), frames=FRAMES,
        spacing_m=SPACING_M, every_s=EVERY_S, radius_m=RADIUS_M, slope_rad=SLOPE_RAD, rng=rng,
    )  # fmt: skip
    second = beside(first, side_m)
    estimates = [[frame.modes[0] for frame in frames_by_evidence(course, rng)] for course in (first, second)]
    moves = [measured_moves(course.position_m, rng) for course in (first, second)]
    alone = smooth(Observations.of(estimates[1]), moves[1])
    scores = [score(alone.position_m, alone.covariance_m2, second.position_m)]
    apart = [replace(one, post=one.post + OTHER_POSTS) for one in estimates[1]]
    for later in (apart, estimates[1]):
        both = smooth(Observations.of(estimates[0] + later), joined(moves))
        scores.append(score(both.position_m[FRAMES:], both.covariance_m2[FRAMES:], second.position_m))
    return scores


def score(found_m: Array, covariance_m2: Array, position_m: Array) -> list[float]:
    """Mean error [m], stated standard deviation [m] and NEES of positions (n, 2) with covariances (n, 2, 2)."""
    error_m, nees = mean_error_and_nees(found_m, covariance_m2, position_m)
    return [error_m, float(np.sqrt(np.trace(covariance_m2, axis1=1, axis2=2) / 2).mean()), nees]


def beside(course: Course, side_m: float) -> Course:
    """The same drive later, to the left of the path."""
    along = course.position_m[1] - course.position_m[0]
    left = np.array([-along[1], along[0]]) / np.hypot(*along)
    times = tuple(when + LATER for when in course.time_utc)
    return replace(course, position_m=course.position_m + side_m * left, time_utc=times)


def measured_moves(position_m: Array, rng: np.random.Generator) -> Steps:
    """Moves with the errors that they state."""
    moves = np.diff(position_m, axis=0)
    sigma = USUAL_ODOMETRY.sigma_m(moves)
    return Steps(moves + sigma[:, None] * rng.normal(size=moves.shape), sigma)


def joined(moves: list[Steps]) -> Steps:
    """The moves of both drives; that between them is not known."""
    first, second = moves
    return Steps(
        np.concatenate([first.move_m, np.zeros((1, 2)), second.move_m]),
        np.concatenate([first.sigma_m, [np.inf], second.sigma_m]),
    )


if __name__ == "__main__":
    main()
