"""The methods on chunks of positions, which are kept on disk, and their errors by sky.

Sky and positions depend on the seed only, not on the method or the order.
"""

from __future__ import annotations

import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from startrack.applications.chunk_store import Chunk, ChunkStore, Progress, settings_digest
from startrack.applications.reproduction import simulator
from startrack.applications.reproduction.artefact import Context
from startrack.applications.reproduction.comparison import compare_places
from startrack.applications.reproduction.scene import THESIS_GROUND
from startrack.core.types import Array, Bools, Fix, NotLocated
from startrack.localization import ExactPosterior, descend, hull_position
from startrack.terrain import Cylinder

FIX_FOLDER = ".chunks"
FIX_SOURCES = (  # their content is part of a chunk's key
    "localization/**/*.py", "terrain/cylinder.py", "applications/reproduction/simulator.py",
    "applications/reproduction/methods.py",
)  # fmt: skip
COMPARED_SOURCES = (  # of the chunks of all methods too
    "applications/reproduction/comparison.py", "applications/reproduction/scene.py",
    "applications/reproduction/published/*.py", "applications/tracking/*.py", "chain/*.py", "detection/*.py",
    "estimation/*.py", "evidence/*.py", "identification/*.py", "rendering/*.py", "simulation/*.py", "terrain/**/*.py",
)  # fmt: skip
KUA, OURS, BOUND = "kua", "ours", "bound"  # the thesis's two steps; ours; the limit for a perfect list
ALL_METHODS = "all"  # that the thesis names, with `compare_places`
FIXES_PER_CHUNK = {KUA: 1000, OURS: 100, BOUND: 200, ALL_METHODS: 5}  # a second to ten of work
ERROR_OF = {KUA: ("hull_m", "refined_m"), OURS: ("fix_m",), BOUND: ("centroid_m",)}
ANSWERED = {KUA: "settled", OURS: "located"}


@dataclass(frozen=True)
class Task:
    """Positions number start to stop - 1 of one sky, to be solved by one method."""

    method: str
    seed: int
    sky: int
    start: int
    stop: int
    magnitude: float = simulator.MAGNITUDE
    aspect_ratio: float = simulator.ASPECT_RATIO
    mistakes: simulator.Mistakes = simulator.PERFECT
    ground: str = THESIS_GROUND  # of all methods
    series_every: int = 1  # see `compare_places`

    def __len__(self) -> int:
        return self.stop - self.start

    @property
    def key(self) -> str:
        """Hash of all that decides the chunk: fields, sources and version."""
        more = COMPARED_SOURCES if self.method == ALL_METHODS else ()
        return settings_digest(FIX_SOURCES + more, asdict(self))


def tasks_of(method: str, seed: int, sky: int, count: int, **settings: Any) -> list[Task]:
    """The first `count` positions of a sky, in chunks; `settings` are the further fields of the tasks."""
    step = FIXES_PER_CHUNK[method]
    return [Task(method, seed, sky, at, min(at + step, count), **settings) for at in range(0, count, step)]


def fix_store(out: Path, *, jobs: int, progress: Progress, cluster: str | None = None) -> ChunkStore[Task]:
    """The store of chunks of fixes under the folder `out`, made in `jobs` processes or on a `cluster`.

    `progress` makes the bar that shows how many chunks are made.
    """
    return ChunkStore(
        out / FIX_FOLDER, compute_chunk, lambda task: task.key, jobs=jobs, progress=progress, cluster=cluster
    )  # fmt: skip


def compute_chunk(task: Task) -> Chunk:
    """Arrays over the positions of a `task`: `truth_m` (n, 2), the method's own, and its processor time `seconds` (1,).

    kua: `hull_m`, `refined_m` (n, 2), `settled` (n,). ours: `located` (n,), and of the located ones `fix_m` (m, 2).
    bound: `centroid_m` (n, 2). all: see `compare_places`.
    """
    if task.method == ALL_METHODS:
        return compare_places(task.seed, task.sky, task.start, task.stop, task.ground, task.series_every)
    sky, cylinder = simulator.Sky.draw(task.seed, task.sky, task.magnitude), simulator.crater(task.aspect_ratio)
    points, radius_m = sky.project_to_rim_plane(cylinder), cylinder.radius_m
    truth = simulator.draw_positions(task.seed, task.sky, task.start, task.stop)
    seen = [simulator.visible_stars(points, position, radius_m) for position in truth]
    if task.method == OURS:
        evidence = [
            task.mistakes.evidence(sky, task.mistakes.draw_list(one, task.seed, task.sky, task.start + k))
            for k, one in enumerate(seen)
        ]
        localizer = ExactPosterior()

        def fix_or_none(k: int) -> Fix | None:
            try:
                return localizer(evidence[k], cylinder)
            except NotLocated:
                return None  # `located` is False then

        fix_or_none(0)  # loads before the clock starts
    start = time.thread_time()
    if task.method == KUA:
        own = _solve_kua(points, seen, cylinder)
    elif task.method == BOUND:
        own = {"centroid_m": np.stack([simulator.cell_centroid(points, position, radius_m) for position in truth])}
    else:
        fixes = [fix_or_none(k) for k in range(len(truth))]
        found = [fix.position_enu_m[:2] for fix in fixes if fix is not None]
        own = {"located": np.array([fix is not None for fix in fixes]), "fix_m": np.array(found).reshape(-1, 2)}
    return {"truth_m": truth, **own, "seconds": np.array([time.thread_time() - start])}


def _solve_kua(points: Array, seen: list[Bools], cylinder: Cylinder) -> Chunk:
    """Estimates (n, 2) [m] by hull and by pseudo-gradient of the `seen` stars, and whether this settled (n,)."""
    hull = np.stack([hull_position(points[one], cylinder.wall_m, cylinder.radius_m) for one in seen])
    ends = [descend(points, one, first, cylinder.radius_m) for one, first in zip(seen, hull, strict=True)]
    refined, settled = zip(*ends, strict=True)
    return {"hull_m": hull, "refined_m": np.stack(refined), "settled": np.array(settled)}


@dataclass(frozen=True)
class MethodErrors:
    """Errors of one estimate."""

    positions_m: tuple[Array, ...]  # by sky: (n, 2) [m], where there is an estimate
    errors_m: tuple[Array, ...]  # by sky: (n,) [m]
    answered: tuple[Bools, ...]  # by sky: settled (kua) or located (ours), for every position
    ms_per_fix: float

    @property
    def errors(self) -> Array:
        """Errors of all skies (n,) [m]."""
        return np.concatenate(self.errors_m)

    @property
    def refused_count(self) -> int:
        """Number of positions without an estimate; for the pseudo-gradient, of those where it never settled."""
        return int(sum((~one).sum() for one in self.answered))

    @property
    def refused_fraction(self) -> float:
        return self.refused_count / max(sum(map(len, self.answered)), 1)

    @property
    def statistics(self) -> dict[str, float]:
        """Mean, standard deviation and largest of the errors [m], and their number."""
        return error_statistics(self.errors)


def error_statistics(errors_m: Array) -> dict[str, float]:
    """Mean, standard deviation and largest of errors (n,) [m], and their number."""
    mean, sd, largest = (float(one) for one in (errors_m.mean(), errors_m.std(), errors_m.max()))
    return {"mean_m": mean, "sd_m": sd, "max_m": largest, "count": len(errors_m)}


def format_errors(errors_m: Array, form: str = "{:.1f} / {:.1f} / {:.1f}") -> str:
    """Text "mean / standard deviation / largest" of errors (n,) [m], in a `form`."""
    return form.format(errors_m.mean(), errors_m.std(), errors_m.max())


def collect_errors(
    context: Context, what: str, method: str, skies: int, per_sky: int, **settings: Any
) -> list[MethodErrors]:  # fmt: skip
    """Errors of every estimate of a `method`, in the order of `ERROR_OF`, at `per_sky` positions of each of `skies`.

    `what` names them in the progress bar; `settings` are those of `tasks_of`.
    """
    by_sky = [tasks_of(method, context.seed, sky, per_sky, **settings) for sky in range(skies)]
    found = context.store.chunks(what, [task for tasks in by_sky for task in tasks])
    parts = [[next(found) for _ in tasks] for tasks in by_sky]
    chunks = [{key: np.concatenate([part[key] for part in of_sky]) for key in of_sky[0]} for of_sky in parts]
    ms_per_fix = 1e3 * sum(float(chunk["seconds"].sum()) for chunk in chunks) / (skies * per_sky)
    answered = tuple(chunk[ANSWERED[method]] for chunk in chunks) if method in ANSWERED else ()
    truth = tuple(chunk["truth_m"][chunk["located"]] if method == OURS else chunk["truth_m"] for chunk in chunks)
    return [
        MethodErrors(
            truth, tuple(np.hypot(*(chunk[key] - at).T) for chunk, at in zip(chunks, truth, strict=True)), answered,
            ms_per_fix,
        )
        for key in ERROR_OF[method]
    ]  # fmt: skip
