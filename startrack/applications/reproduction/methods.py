"""The methods on one chunk of positions. Sky and positions depend on the seed only, not on the method or the order."""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np

from startrack.applications.reproduction.bound import cell_centroid
from startrack.applications.reproduction.simulator import (
    ASPECT_RATIO,
    MAGNITUDE,
    PERFECT,
    Mistakes,
    Sky,
    crater,
    draw_positions,
    visible_stars,
)
from startrack.core.types import Array, Bools, Evidence, Fix, NotLocated
from startrack.localization import ExactPosterior
from startrack.localization.convex_hull import hull_position
from startrack.localization.pseudo_gradient import PseudoGradient, descend
from startrack.terrain import Cylinder

KUA, OURS, BOUND = "kua", "ours", "bound"  # the thesis's two steps; ours; the limit for a perfect list
FIXES_PER_CHUNK = {KUA: 1000, OURS: 100, BOUND: 200}  # about a second of work
Chunk = dict[str, np.ndarray]  # the result of one task, by name


@dataclass(frozen=True)
class Task:
    """Positions number start to stop - 1 of one sky, to be solved by one method."""

    method: str
    seed: int
    sky: int
    start: int
    stop: int
    magnitude: float = MAGNITUDE
    aspect_ratio: float = ASPECT_RATIO
    mistakes: Mistakes = PERFECT

    def __len__(self) -> int:
        return self.stop - self.start


def tasks_of(
    method: str, seed: int, sky: int, count: int, *, magnitude: float = MAGNITUDE, aspect_ratio: float = ASPECT_RATIO,
    mistakes: Mistakes = PERFECT,
) -> list[Task]:  # fmt: skip
    """The first `count` positions of a sky, in chunks."""
    step = FIXES_PER_CHUNK[method]
    starts = range(0, count, step)
    return [
        Task(method, seed, sky, start, min(start + step, count), magnitude, aspect_ratio, mistakes) for start in starts
    ]


def compute_chunk(task: Task) -> Chunk:
    """Arrays over the task's positions: `truth_m` (n, 2), the method's own, and `seconds` (1,) of processor time for
    the method.

    kua: `hull_m`, `refined_m` (n, 2), `settled` (n,). ours: `located` (n,); of the located ones `fix_m` (m, 2),
    `nees` (m,), the squared error over the stated covariance, and `ambiguous` (m,). cell: `centroid_m` (n, 2).
    """
    sky, cylinder = Sky.draw(task.seed, task.sky, task.magnitude), crater(task.aspect_ratio)
    points = sky.project_to_rim_plane(cylinder)
    truth = draw_positions(task.seed, task.sky, task.start, task.stop)
    seen = [visible_stars(points, position, cylinder.radius_m) for position in truth]
    if task.method == KUA:
        own = _solve_kua(points, seen, cylinder.wall_m, cylinder.radius_m)
    elif task.method == BOUND:
        start = time.thread_time()
        own = {"centroid_m": np.stack([cell_centroid(points, position, cylinder.radius_m) for position in truth])}
        own["seconds"] = np.array([time.thread_time() - start])
    else:
        own = _solve_ours(task, sky, seen, truth)
    return {"truth_m": truth, **own}


def _solve_kua(points: Array, seen: list[Bools], wall_m: float, radius_m: float) -> Chunk:
    method, start = PseudoGradient(), time.thread_time()
    hull = np.stack([hull_position(points[one], wall_m, radius_m) for one in seen])
    ends = [
        descend(points, one, first, radius_m, method.gain, method.most_steps)
        for one, first in zip(seen, hull, strict=True)
    ]
    return {
        "hull_m": hull,
        "refined_m": np.stack([end for end, _ in ends]),
        "settled": np.array([settled for _, settled in ends]),
        "seconds": np.array([time.thread_time() - start]),
    }


def _solve_ours(task: Task, sky: Sky, seen: list[Bools], truth: Array) -> Chunk:
    localizer = ExactPosterior()
    cylinder = crater(task.aspect_ratio)
    evidence = [
        task.mistakes.evidence(sky, task.mistakes.draw_list(one, task.seed, task.sky, task.start + k))
        for k, one in enumerate(seen)
    ]
    _fix_or_none(localizer, evidence[0], cylinder)  # compiles and loads before the clock starts
    start = time.thread_time()
    fixes = [_fix_or_none(localizer, one, cylinder) for one in evidence]
    seconds = time.thread_time() - start
    error = [
        (fix, fix.position_enu_m[:2] - position) for fix, position in zip(fixes, truth, strict=True) if fix is not None
    ]
    return {
        "located": np.array([fix is not None for fix in fixes]),
        "fix_m": np.array([fix.position_enu_m[:2] for fix, _ in error]).reshape(-1, 2),
        "nees": np.array([d @ np.linalg.solve(fix.covariance_m2, d) for fix, d in error]),
        "ambiguous": np.array([fix.ambiguous for fix, _ in error], dtype=np.bool_),
        "seconds": np.array([seconds]),
    }


def _fix_or_none(localizer: ExactPosterior, evidence: Evidence, cylinder: Cylinder) -> Fix | None:
    try:
        return localizer(evidence, cylinder)
    except NotLocated:
        return None  # `located` is False then
