"""Every method that the thesis names, at the same places: `COMPARED` by name, what each is given, and their answers."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from datetime import timedelta
from functools import lru_cache
from typing import Any

import numpy as np

from startrack.applications.chunk_store import Chunk
from startrack.applications.reproduction.published.kua_drive import (
    ODOMETRY_SIGMA_1,
    STOPS,
    locate_by_drive,
    outermost_stars,
)
from startrack.applications.reproduction.published.malay import draw_readings, locate_at_rest
from startrack.applications.reproduction.published.naval import locate_by_features
from startrack.applications.reproduction.published.stein_medioni import locate_by_segments
from startrack.applications.reproduction.published.talluri_aggarwal import locate_by_four_bearings
from startrack.applications.reproduction.published.vertical import locate_by_inclinometer
from startrack.applications.reproduction.scene import THESIS_GROUND, Scene, terrain_of
from startrack.applications.reproduction.simulator import SHACKLETON, Stream, visible_stars
from startrack.applications.tracking import (
    ObservedFrame,
    Odometry,
    TrackErrors,
    estimate_frame,
    estimate_track,
    rows_near_skyline,
)
from startrack.catalog import load_catalog
from startrack.chain import Settings, locate_rays
from startrack.core.types import Array, Bools, NoSolution, NotLocated
from startrack.localization import descend
from startrack.simulation import simulate_rays
from startrack.terrain import require_site

REST_EXPOSURES = 6
REST_EVERY_S = {"moon": 12 * 3600.0, "earth": 327.0}  # three days on the Moon, half an hour on the Earth
STOP_EVERY_S = {"moon": 1800.0, "earth": 600.0}  # of a drive
LEVEL_XYZW = (0.0, 0.0, 0.0, 1.0)


def locate_by_rest(scene: Scene) -> Array:
    """Position (2,) [m] by all exposures of a camera at rest at the place of a `scene`. Raises NotLocated."""
    positions = np.tile(scene.truth_m, (REST_EXPOSURES, 1))
    frames, shared = _observe(scene, positions, np.zeros((REST_EXPOSURES - 1, 2)), REST_EVERY_S)
    return estimate_track(frames, scene.terrain, shared, at_rest=True).smoothed.position_enu_m[-1, :2]


def locate_by_stops(scene: Scene) -> Array:
    """Position (2,) [m] at the end of the drive to the place of a `scene`. Raises NotLocated."""
    frames, shared = _observe(scene, scene.drive.positions_m, scene.drive.legs_m, STOP_EVERY_S)
    odometry = Odometry(
        time_s=np.array([frame.time_utc.timestamp() for frame in frames]),
        position_m=np.pad(np.cumsum(scene.drive.legs_m, axis=0), ((1, 0), (0, 1))),
        quat_xyzw=np.tile(LEVEL_XYZW, (STOPS, 1)),
    )
    track = estimate_track(frames, scene.terrain, shared, odometry=odometry)
    return track.smoothed.position_enu_m[-1, :2]


def _observe(
    scene: Scene, positions_m: Array, moves_m: Array, every_s: dict[str, float]
) -> tuple[list[ObservedFrame], TrackErrors]:
    """Exposures at positions (n, 2), and the errors that they share; the first is searched, the others by moves."""
    terrain, catalog = scene.terrain, load_catalog()
    frames: list[ObservedFrame] = []
    start = scene.pictures.pose(0).time_utc
    moved = np.pad(np.cumsum(moves_m, axis=0), ((1, 0), (0, 0)))
    for k, (east, north) in enumerate(positions_m.tolist()):
        when = start + timedelta(seconds=k * every_s[require_site(terrain).body])
        exposed, rng = replace(scene.pictures, time_utc=when, east_m=east, north_m=north).scene(k)
        rays = simulate_rays(exposed, catalog, terrain, rng=rng)
        if not frames:
            fix, shared = locate_rays(rays).fix, TrackErrors.of(terrain, rays.clock)
            if fix.ambiguous:
                raise NotLocated("several positions fit the first exposure")
        odometry_m2 = np.square(ODOMETRY_SIGMA_1 * np.hypot(*moves_m[:k].T)).sum()
        at, covariance = fix.compared_at_m + moved[k], fix.covariance_m2 + odometry_m2 * np.eye(2)
        rows = rows_near_skyline(rays.evidence(), terrain, at)
        estimate = estimate_frame(rows, terrain, shared, at, covariance)
        frames.append(ObservedFrame(f"exposure-{k:02d}", when, np.eye(3), (estimate,), rows))
    return frames, shared


@dataclass(frozen=True)
class ComparedMethod:
    """A method, what it is given, its published figure, and its function of a scene, which may raise NoSolution."""

    name: str
    sees: str
    heading: str
    clock: str
    vertical: str
    prior: str
    published: str
    locate: Callable[[Scene], Array]  # position (2,) [m]
    needs_crater: bool = False  # the thesis's: it knows no other ground
    needs_moon: bool = False  # its error is that of a vertical on the Moon
    is_series: bool = False  # of many exposures: at a part of the places only


BOUNDED = ("bounded_lit", "bounded_dark")  # of a scene: Cozman's answers
LIT = ("lit skyline", "given", "no", "given", "the map")
DARK = ("dark skyline", "stars", "yes", "stars", "the map")
STARS = ("stars", "stars", "yes", "stars", "the map")
TILTED = ("stars", "stars", "yes", "measured", "none")
COMPARED = {
    "startrack-list": ComparedMethod("startrack, list of stars", *STARS, "", lambda scene: scene.listed_m),
    "startrack-stars": ComparedMethod(
        "startrack, picture", *STARS, "",
        lambda scene: scene.locate_picture(Settings(evidence_sources="stars")).fix.position_enu_m[:2],
    ),
    "startrack": ComparedMethod(  # the dark skyline is measured with it: its time is its own
        "startrack, picture", "stars and sky", *STARS[1:], "", lambda scene: scene.located.fix.position_enu_m[:2]
    ),
    "startrack-rest": ComparedMethod("startrack, at rest", *STARS, "", locate_by_rest, is_series=True),
    "startrack-drive": ComparedMethod("startrack, drive", *STARS, "", locate_by_stops, is_series=True),
    "sigel-wettergreen": ComparedMethod(
        "Sigel and Wettergreen", *TILTED, "1.2 km",
        lambda scene: locate_by_inclinometer(scene.truth_m, SHACKLETON, rng=scene.draws(Stream.TILT))[0],
        needs_moon=True,
    ),
    "malay": ComparedMethod(
        "Malay et al.", *TILTED, "400 m",
        lambda scene: locate_at_rest(
            draw_readings(scene.truth_m, SHACKLETON, rng=scene.draws(Stream.REST)), SHACKLETON
        ),
        needs_moon=True,
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
        "Cozman and Krotkov", *LIT, "hundreds of m", lambda scene: scene.bounded_lit.mean_m
    ),
    "cozman-krotkov-dark": ComparedMethod(
        "Cozman and Krotkov", *DARK, "", lambda scene: scene.bounded_dark.mean_m
    ),
    "naval-lit": ComparedMethod(
        "Naval et al.", "lit skyline", "no", "no", "given", "the map", "373 m",
        lambda scene: locate_by_features(scene.turned, scene.terrain, scene.features),
    ),
    "naval-dark": ComparedMethod(
        "Naval et al.", *DARK, "", lambda scene: locate_by_features(scene.dark, scene.terrain, scene.features)
    ),
    "kua-drive": ComparedMethod(
        "Kua's earlier work", "stars of a drive", "stars", "yes", "stars", "diameter", "800 m",
        lambda scene: estimate_drive(scene)[0], needs_crater=True,
    ),
    "kua-hull": ComparedMethod(
        "Kua 2008, hull and circle", *STARS, "637 m", lambda scene: scene.hull_m, needs_crater=True
    ),
    "kua-pseudo-gradient": ComparedMethod(
        "Kua 2008, pseudo-gradient", *STARS, "34.2 m",
        lambda scene: descend(scene.points_m, scene.seen, scene.hull_m, scene.crater.radius_m)[0], needs_crater=True,
    ),
}  # fmt: skip


def estimate_drive(scene: Scene) -> tuple[Array, float]:
    """Position (2,) [m] at the end of a drive to the place of a `scene`, and depth of the crater [m], both by it."""
    seen = [visible_stars(scene.points_m, stop, scene.crater.radius_m) for stop in scene.drive.positions_m]
    vectors = [outermost_stars(scene.points_m[one], scene.crater.wall_m) for one in seen]
    positions, depth_m = locate_by_drive(vectors, scene.drive.legs_m, scene.crater.radius_m)
    return positions[-1], depth_m


def methods_on(ground: str) -> dict[str, ComparedMethod]:
    """The methods of COMPARED that can be used on a `ground`."""
    site = terrain_of(ground).site
    is_crater, is_moon = ground == THESIS_GROUND, site is not None and site.body == "moon"
    return {
        name: one
        for name, one in COMPARED.items()
        if (is_crater or not one.needs_crater) and (is_moon or not one.needs_moon)
    }


def compare_places(
    seed: int, sky: int, start: int, stop: int, ground: str = THESIS_GROUND, series_every: int = 1
) -> Chunk:
    """Answers at places number `start` to `stop` - 1 of a `sky` on a `ground`, in the order of `methods_on` it.

    `truth_m` (n, 2), `position_m` (n, methods, 2), NaN where a method refuses, `is_tried` (n, methods): methods of many
    exposures are at one place in `series_every`, by the sum of the numbers of sky and place. `bounds_m` (n, 2, 2, 2):
    of Cozman's lit and dark answer the least and greatest mean. `seconds` (n, methods) of processor time for the
    methods: without the skylines, which they are given, and without the grid and its polygons, which are made once a
    process.
    """
    scenes = [Scene(seed, sky, number, ground) for number in range(start, stop)]
    methods = methods_on(ground)
    positions, seconds = np.full((len(scenes), len(methods), 2), np.nan), np.zeros((len(scenes), len(methods)))
    tried = np.array([
        [not one.is_series or (sky + number) % series_every == 0 for one in methods.values()]
        for number in range(start, stop)
    ])  # fmt: skip
    _warm_up(ground)
    for k, scene in enumerate(scenes):
        _ = scene.table, scene.features, scene.seen, scene.evidence, scene.lit, scene.rough, scene.turned, scene.picture
        for j, method in enumerate(methods.values()):
            if tried[k, j]:
                began = time.process_time()
                positions[k, j] = _or_nan(method.locate, scene)
                seconds[k, j] = time.process_time() - began
    return {
        "truth_m": np.stack([scene.truth_m for scene in scenes]), "position_m": positions, "is_tried": tried,
        "bounds_m": np.stack([[_bounds(scene, name) for name in BOUNDED] for scene in scenes]), "seconds": seconds,
    }  # fmt: skip


@lru_cache(maxsize=2)
def _warm_up(ground: str) -> None:
    """Load and prepare what the methods need on a `ground`, once a process, before the clock starts."""
    terrain_of(ground).prepare()
    scene = Scene(0, 0, 0, ground)
    for method in methods_on(ground).values():
        if not method.is_series:
            _or_nan(method.locate, scene)


def _or_nan(locate: Callable[[Scene], Array], scene: Scene) -> Array:
    """The answer of a method; NaN where it refuses."""
    try:
        return locate(scene)
    except NoSolution:
        return np.full(2, np.nan)


def _bounds(scene: Scene, name: str) -> Array:
    """Least and greatest mean (2, 2) [m] of an answer with bounds; NaN where it refuses."""
    try:
        bounded = getattr(scene, name)
    except NoSolution:
        return np.full((2, 2), np.nan)
    return np.stack([bounded.low_m, bounded.high_m])


@dataclass(frozen=True, eq=False)
class ComparedErrors:
    """Errors of methods at the same places."""

    names: tuple[str, ...]  # keys of COMPARED
    truth_m: Array  # (n, 2)
    position_m: Array  # (n, methods, 2); NaN where a method refuses
    is_tried: Bools  # (n, methods)
    bounds_m: Array  # (n, 2, 2, 2) of Cozman's lit and dark answer: least and greatest mean
    seconds: Array  # (n, methods) of processor time

    @property
    def ms_per_fix(self) -> Array:
        """Processor time (methods,) [ms] of an answer in the mean."""
        return np.asarray(1e3 * self.seconds.sum(axis=0) / np.maximum(self.is_tried.sum(axis=0), 1))

    def tried(self, name: str) -> int:
        """Number of places at which the method `name` is used."""
        return int(self.is_tried[:, self.names.index(name)].sum())

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
            "refused": self.tried(name) - count,
        }

    def bound_statistics(self, skyline: int) -> tuple[float, float] | None:
        """Mean half width [m] of Cozman's bounds on an axis, and the share of axes whose truth they contain.

        `skyline` 0: the lit one, 1: the dark one. None without an answer.
        """
        low, high = np.moveaxis(self.bounds_m[:, skyline], 1, 0)
        known = np.isfinite(low[:, 0])
        if not known.any():
            return None
        inside = (low <= self.truth_m) & (self.truth_m <= high)
        return float(0.5 * np.mean((high - low)[known])), float(np.mean(inside[known]))
