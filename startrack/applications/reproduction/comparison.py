"""Every method that the thesis names, at the same places: `COMPARED` by name, what each is given, and their answers."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np

from startrack.applications.reproduction.published.cozman_krotkov import locate_by_posterior
from startrack.applications.reproduction.published.kua_drive import draw_drive, locate_by_drive, outermost_stars
from startrack.applications.reproduction.published.malay import draw_readings, locate_at_rest
from startrack.applications.reproduction.published.sigel_wettergreen import locate_by_inclinometer
from startrack.applications.reproduction.published.stein_medioni import locate_by_segments
from startrack.applications.reproduction.published.talluri_aggarwal import locate_by_four_bearings
from startrack.applications.reproduction.scene import THESIS_GROUND, Scene
from startrack.applications.reproduction.simulator import SHACKLETON, Stream, visible_stars
from startrack.core.chunk_store import Chunk
from startrack.core.types import Array, NotLocated
from startrack.localization import PseudoGradient, descend, hull_position


@dataclass(frozen=True)
class ComparedMethod:
    """A method, what it is given, its published figure, and its function of a scene, which may raise NotLocated."""

    name: str
    sees: str
    heading: str
    clock: str
    vertical: str
    prior: str
    published: str
    locate: Callable[[Scene], Array]  # position (2,) [m]
    needs_crater: bool = False  # the thesis's: it knows no other ground


LIT = ("lit skyline", "given", "no", "given", "the map")
DARK = ("skyline by stars", "stars", "yes", "stars", "the map")
STARS = ("stars", "stars", "yes", "stars", "the map")
TILTED = ("stars", "stars", "yes", "measured", "none")
COMPARED = {  # startrack first: the skyline by stars stands on its fix, whose time is its own
    "startrack": ComparedMethod("startrack", *STARS, "", lambda scene: scene.fix_m),
    "sigel-wettergreen": ComparedMethod(
        "Sigel and Wettergreen", *TILTED, "1.2 km",
        lambda scene: locate_by_inclinometer(scene.truth_m, SHACKLETON, rng=scene.draws(Stream.TILT))[0],
    ),
    "malay": ComparedMethod(
        "Malay et al.", *TILTED, "400 m",
        lambda scene: locate_at_rest(
            draw_readings(scene.truth_m, SHACKLETON, rng=scene.draws(Stream.REST)), SHACKLETON
        ),
    ),
    "talluri-aggarwal-lit": ComparedMethod(
        "Talluri and Aggarwal", *LIT, "26 m, with noise 55 m",
        lambda scene: locate_by_four_bearings(scene.lit, scene.terrain, scene.grid),
    ),
    "talluri-aggarwal-dark": ComparedMethod(
        "Talluri and Aggarwal", *DARK, "",
        lambda scene: locate_by_four_bearings(scene.dark, scene.terrain, scene.grid),
    ),
    "stein-medioni-lit": ComparedMethod(
        "Stein and Medioni", "lit skyline", "rough", "no", "given", "the map", "300 to 600 m",
        lambda scene: locate_by_segments(scene.rough, scene.grid, scene.table),
    ),
    "stein-medioni-dark": ComparedMethod(
        "Stein and Medioni", *DARK, "", lambda scene: locate_by_segments(scene.dark, scene.grid, scene.table, 0.0)
    ),
    "cozman-krotkov-lit": ComparedMethod(
        "Cozman and Krotkov", *LIT, "hundreds of m", lambda scene: locate_by_posterior(scene.lit, scene.grid).mean_m
    ),
    "cozman-krotkov-dark": ComparedMethod(
        "Cozman and Krotkov", *DARK, "", lambda scene: locate_by_posterior(scene.dark, scene.grid).mean_m
    ),
    "kua-drive": ComparedMethod(
        "Kua's earlier work", "stars of a drive", "stars", "yes", "stars", "diameter", "800 m",
        lambda scene: estimate_drive(scene)[0], needs_crater=True,
    ),
    "kua-hull": ComparedMethod(
        "Kua 2008, hull and circle", *STARS, "637 m",
        lambda scene: hull_position(scene.points_m[scene.seen], scene.crater.wall_m, scene.crater.radius_m),
        needs_crater=True,
    ),
    "kua-pseudo-gradient": ComparedMethod(
        "Kua 2008, pseudo-gradient", *STARS, "34.2 m", lambda scene: _descend_from_hull(scene), needs_crater=True
    ),
}  # fmt: skip


def estimate_drive(scene: Scene) -> tuple[Array, float]:
    """Position (2,) [m] at the end of a drive to the place of a `scene`, and depth of the crater [m], both by it."""
    drive = draw_drive(scene.truth_m, scene.crater.radius_m, rng=scene.draws(Stream.DRIVE))
    seen = [visible_stars(scene.points_m, stop, scene.crater.radius_m) for stop in drive.positions_m]
    vectors = [outermost_stars(scene.points_m[one], scene.crater.wall_m) for one in seen]
    positions, depth_m = locate_by_drive(vectors, drive.legs_m, scene.crater.radius_m)
    return positions[-1], depth_m


def _descend_from_hull(scene: Scene) -> Array:
    """Where the thesis's descent ends, settled or not."""
    method = PseudoGradient()
    first = hull_position(scene.points_m[scene.seen], scene.crater.wall_m, scene.crater.radius_m)
    end, _ = descend(scene.points_m, scene.seen, first, scene.crater.radius_m, method.gain, method.most_steps)
    return end


def methods_on(ground: str) -> dict[str, ComparedMethod]:
    """The methods of COMPARED that can be used on a `ground`."""
    return {name: one for name, one in COMPARED.items() if ground == THESIS_GROUND or not one.needs_crater}


def compare_places(seed: int, sky: int, start: int, stop: int, ground: str = THESIS_GROUND) -> Chunk:
    """Answers at places number `start` to `stop` - 1 of a `sky` on a `ground`, in the order of `methods_on` it.

    `truth_m` (n, 2), `position_m` (n, methods, 2), NaN where a method refuses, and `seconds` (1, methods) of processor
    time for the methods: without the skylines, which they are given, and without the grid and its polygons, which are
    made once a process.
    """
    scenes = [Scene(seed, sky, number, ground) for number in range(start, stop)]
    methods = methods_on(ground)
    positions, seconds = np.full((len(scenes), len(methods), 2), np.nan), np.zeros((1, len(methods)))
    _warm_up(ground)
    for k, scene in enumerate(scenes):
        _ = scene.table, scene.seen, scene.evidence, scene.lit, scene.rough
        for j, method in enumerate(methods.values()):
            began = time.process_time()
            positions[k, j] = _answer(method, scene)
            seconds[0, j] += time.process_time() - began
            if np.isfinite(positions[k, 0, 0]):
                _ = scene.dark
    return {"truth_m": np.stack([scene.truth_m for scene in scenes]), "position_m": positions, "seconds": seconds}


@lru_cache(maxsize=2)
def _warm_up(ground: str) -> None:
    """Compile and load what the methods need on a `ground`, once a process, before the clock starts."""
    scene = Scene(0, 0, 0, ground)
    for method in methods_on(ground).values():
        _answer(method, scene)


def _answer(method: ComparedMethod, scene: Scene) -> Array:
    """The position (2,) [m] by a `method`; NaN where it refuses."""
    try:
        return method.locate(scene)
    except NotLocated:
        return np.full(2, np.nan)


@dataclass(frozen=True, eq=False)
class ComparedErrors:
    """Errors of methods at the same places."""

    names: tuple[str, ...]  # keys of COMPARED
    truth_m: Array  # (n, 2)
    position_m: Array  # (n, methods, 2); NaN where a method refuses
    ms_per_fix: Array  # (methods,) of processor time

    def errors_m(self, name: str) -> Array:
        """Errors (m,) [m] of the method `name` where it has an answer."""
        offset = self.position_m[:, self.names.index(name)] - self.truth_m
        return np.hypot(*offset[np.isfinite(offset[:, 0])].T)

    def statistics(self, name: str) -> dict[str, Any]:
        """Mean with its standard error, median, 95 % and largest of the errors [m], and the counts of a method.

        None where nothing is known: of no answer, and the standard error of one.
        """
        errors = self.errors_m(name)
        count, known = len(errors), len(errors) > 0
        return {
            "mean_m": float(errors.mean()) if known else None,
            "mean_sigma_m": float(errors.std(ddof=1) / np.sqrt(count)) if count > 1 else None,
            "median_m": float(np.median(errors)) if known else None,
            "p95_m": float(np.quantile(errors, 0.95)) if known else None,
            "max_m": float(errors.max()) if known else None,
            "count": count,
            "refused": len(self.truth_m) - count,
        }
