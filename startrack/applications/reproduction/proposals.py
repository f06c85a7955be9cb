"""Proposals that the thesis makes and does not try: a grid where the descent wanders, skyline stars, a real floor."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from startrack.applications.reproduction import simulator
from startrack.applications.reproduction.artefact import Artefact, Context, markdown_table
from startrack.applications.reproduction.methods import error_statistics
from startrack.applications.reproduction.published.skylines import crest_posts_m
from startrack.applications.reproduction.scene import Scene, terrain_of
from startrack.core.types import Array, Bools, NotLocated
from startrack.localization import ExactPosterior, PseudoGradient, descend, hull_position
from startrack.output import Column
from startrack.terrain import Terrain

WANDERING_PER_SKY = 2000  # positions, of which one in a hundred wanders; fewer in a quick run
SEARCHED_M, SEARCH_STEP_M = 100.0, 5.0  # half side of the grid about the end of a descent that wanders, and its step
OBSTACLE_WIDTH_RAD, OBSTACLE_TOP_RAD = float(np.radians(40.0)), float(np.radians(40.0))
BAND_1 = 0.2  # of the rim's radius: how far from the skyline its stars are, on the rim's plane
OPEN_SECTORS, OPEN_SHARE = 24, 0.95  # of azimuth; share of the expected high stars that an open one shows at least
FLOOR_ROUNDS = 5  # of depth by the map at the estimate, and estimate by that depth
FLOOR_RADIUS_M = 3500.0  # of Shackleton's floor
REAL_GROUND = "shackleton-rendered"


@dataclass(frozen=True)
class Row:
    """The errors of one way to locate."""

    page: int
    way: str
    places: str
    drawn_m: Array  # (n,); NaN where it refuses

    @property
    def errors_m(self) -> Array:
        """Errors (m,) [m] of the places where there is an answer."""
        return self.drawn_m[np.isfinite(self.drawn_m)]

    def cells(self) -> list[str]:
        """Texts of the row in the table."""
        errors, found = self.errors_m, error_statistics(self.errors_m)
        mean = f"{found['mean_m']:.1f} ± {errors.std(ddof=1) / np.sqrt(len(errors)):.1f}"
        refused = f"{len(self.drawn_m) - len(errors)} of {len(self.drawn_m)}"
        median, largest = f"{np.median(errors):.1f}", f"{found['max_m']:.0f}"
        return [str(self.page), self.way, self.places, mean, median, largest, refused]


def proposals(context: Context) -> Artefact:
    """Table of the errors of each proposal and of the thesis's own method, at the same places."""
    rows = [
        one for one in (*_wandering(context), *_behind_obstacle(context), *_real_floor(context)) if len(one.errors_m)
    ]
    head = ("page", "method", "places", "number", "mean (m)", "median (m)", "largest (m)")
    columns = [Column("page", [one.page for one in rows], "int64", form="%d")]
    columns += [Column(key, [getattr(one, key) for one in rows], "string") for key in ("way", "places")]
    means = [float(one.errors_m.mean()) for one in rows]
    columns += [Column("mean", means, unit="m", form="%.3f", description="mean error")]
    values: dict[str, Any] = {f"{one.way}, {one.places}": error_statistics(one.errors_m) for one in rows}
    return Artefact(
        name="proposals", title="What the thesis proposes", line=f"{len(rows)} rows",
        text=f"Position errors, with the standard error of the mean; thesis 34.2 m. Seed {context.seed}.\n\n"
        + markdown_table(head, [one.cells() for one in rows]),
        columns=tuple(columns), values={"thesis": simulator.THESIS["overall"], "reproduced": values},
    )  # fmt: skip


def _wandering(context: Context) -> Iterator[Row]:
    """Rows for page 12: a grid of points about the estimate where the descent wanders."""
    cylinder = simulator.crater()
    ends, best, settled = [], [], []
    for sky in range(context.size.skies):
        points = simulator.Sky.draw(context.seed, sky).project_to_rim_plane(cylinder)
        for truth in simulator.draw_positions(context.seed, sky, 0, min(context.size.per_sky, WANDERING_PER_SKY)):
            seen = simulator.visible_stars(points, truth, cylinder.radius_m)
            end, is_settled = _descend_from_hull(points, seen, cylinder.wall_m, cylinder.radius_m)
            found = end if is_settled else best_of_grid(points, seen, end, cylinder.radius_m)
            ends.append(np.hypot(*(end - truth)))
            best.append(np.hypot(*(found - truth)))
            settled.append(is_settled)
    wanders = ~np.array(settled)
    for way, errors in (("pseudo-gradient", np.array(ends)), ("with a grid about its end", np.array(best))):
        yield Row(12, way, "all", errors)
        yield Row(12, way, "where it wanders", errors[wanders])


def best_of_grid(points_m: Array, seen: Bools, end_m: Array, radius_m: float) -> Array:
    """The middle (2,) [m] of the points of a grid about `end_m` (2,) whose expected stars differ least from the `seen`.

    The stars are `points_m` (n, 2) on the plane of a rim of `radius_m`.
    """
    line = np.arange(-SEARCHED_M, SEARCHED_M + SEARCH_STEP_M, SEARCH_STEP_M)
    grid = end_m + np.stack(np.meshgrid(line, line), axis=-1).reshape(-1, 2)
    distance = np.hypot(*(points_m + end_m).T)
    near = np.abs(distance - radius_m) < 2 * SEARCHED_M  # the other stars are the same from all of the grid
    wrong = [np.count_nonzero(simulator.visible_stars(points_m[near], one, radius_m) != seen[near]) for one in grid]
    return np.asarray(grid[np.array(wrong) == min(wrong)].mean(axis=0))


def _descend_from_hull(points_m: Array, seen: Bools, wall_m: float, radius_m: float) -> tuple[Array, bool]:
    """End (2,) [m] of a descent that begins at the estimate by the hull, and whether it settled."""
    return descend(points_m, seen, hull_position(points_m[seen], wall_m, radius_m), radius_m)


def _behind_obstacle(context: Context) -> Iterator[Row]:
    """Rows for page 21: stars along the skyline only, where something on no map hides a part of the sky."""
    cylinder = simulator.crater()
    wall_m, radius_m = cylinder.wall_m, cylinder.radius_m
    errors: dict[str, list[float]] = {}
    for sky in range(context.size.skies):
        stars = simulator.Sky.draw(context.seed, sky)
        points = stars.project_to_rim_plane(cylinder)
        for number, truth in enumerate(simulator.draw_positions(context.seed, sky, 0, context.size.compared_per_sky)):
            rng = np.random.default_rng([context.seed, simulator.Stream.OBSTACLE, sky, number])
            middle = rng.uniform(0.0, 2 * np.pi)
            turn = np.abs((stars.azimuth_rad - middle + np.pi) % (2 * np.pi) - np.pi)
            hidden = (turn < 0.5 * OBSTACLE_WIDTH_RAD) & (stars.elevation_rad < OBSTACLE_TOP_RAD)
            seen = simulator.visible_stars(points, truth, radius_m) & ~hidden
            plain, _ = _descend_from_hull(points, seen, wall_m, radius_m)
            found = {
                "pseudo-gradient": plain,
                "by the stars along the skyline": descend_by_skyline(points, seen, plain, radius_m, skips=False),
                "by those beside the obstacle": descend_by_skyline(points, seen, plain, radius_m, skips=True),
            }
            try:
                found["startrack"] = ExactPosterior()(simulator.PERFECT.evidence(stars, seen), cylinder).position_enu_m[
                    :2
                ]
            except NotLocated:
                found["startrack"] = np.full(2, np.nan)
            for way, position in found.items():
                errors.setdefault(way, []).append(float(np.hypot(*(position - truth))))
    for way, of in errors.items():
        yield Row(21, way, "an obstacle of 40 by 40 degrees", np.array(of))


def descend_by_skyline(points_m: Array, seen: Bools, start_m: Array, radius_m: float, *, skips: bool) -> Array:
    """The end (2,) [m] of a descent from `start_m` (2,) by the stars near the skyline expected at each step.

    The stars are `points_m` (n, 2) on the plane of a rim of `radius_m`, of which the `seen` (n,) are in sight. A step
    is scaled as a band of that width needs: R / 2 w times the shift, for a width w. With `skips` azimuths are left out
    where stars higher up are missing: something hides them.
    """
    position, band_m = np.array(start_m), BAND_1 * radius_m
    sector = (np.arctan2(*points_m.T) % (2 * np.pi) * OPEN_SECTORS / (2 * np.pi)).astype(np.int64) % OPEN_SECTORS
    for _ in range(PseudoGradient().most_steps):
        inside_m = radius_m - np.hypot(*(points_m + position).T)
        near, high = np.abs(inside_m) < band_m, inside_m > band_m
        if skips:
            shown, all_high = (np.bincount(sector[one], minlength=OPEN_SECTORS) for one in (high & seen, high))
            near &= (shown >= OPEN_SHARE * all_high)[sector]
        expected, found = near & (inside_m > 0.0), near & seen
        if np.array_equal(expected, found) or not expected.any() or not found.any():
            break
        position += 2 * BAND_1 * (points_m[expected].mean(axis=0) - points_m[found].mean(axis=0))
    return position


def _real_floor(context: Context) -> Iterator[Row]:
    """Rows for page 24: the simplified crater on the map of a real floor."""
    centre, radius_m, rim_m = simplify_crater(terrain_of(REAL_GROUND))
    errors: dict[str, list[float]] = {}
    away = []
    for sky in range(context.size.skies):
        for number in range(context.size.compared_per_sky):
            scene = Scene(context.seed, sky, number, REAL_GROUND)
            away.append(np.hypot(*scene.truth_m))
            for way, is_flat in (("flat floor", True), ("floor of the map", False)):
                position = _locate_on_floor(scene, centre, radius_m, rim_m, is_flat)
                errors.setdefault(way, []).append(float(np.hypot(*(position - scene.truth_m))))
    floor = np.array(away) < FLOOR_RADIUS_M
    for way, of in errors.items():
        found = np.array(of)
        yield Row(24, f"simplified crater, {way}", "floor of Shackleton", found[floor])
        yield Row(24, f"simplified crater, {way}", "all of Shackleton", found)


def simplify_crater(terrain: Terrain) -> tuple[Array, float, float]:
    """Centre (2,), radius and height of the circle [m] through the crests of a `terrain` that its origin sees."""
    points = crest_posts_m(terrain, np.zeros(2))
    points = points[np.isfinite(points[:, 0])]
    a = np.column_stack([2 * points[:, :2], np.ones(len(points))])
    (east, north, rest), *_ = np.linalg.lstsq(a, np.square(points[:, :2]).sum(axis=1), rcond=None)
    return np.array([east, north]), float(np.sqrt(rest + east**2 + north**2)), float(points[:, 2].mean())


def _locate_on_floor(scene: Scene, centre_m: Array, radius_m: float, rim_m: float, is_flat: bool) -> Array:
    """Position (2,) [m] by hull and descent; the depth is that of the map's middle, or of the estimate."""
    sky, position = scene.sky, centre_m
    for _ in range(1 if is_flat else FLOOR_ROUNDS):
        wall = rim_m - float(scene.terrain.ground_m(position[None])[0]) - scene.terrain.camera_height_m
        if wall <= 0.0:
            return np.full(2, np.nan)
        points = wall / np.tan(sky.elevation_rad)[:, None] * simulator.directions(sky.azimuth_rad)
        found, _ = _descend_from_hull(points, scene.seen, wall, radius_m)
        position = centre_m + found
        if np.hypot(*found) >= radius_m:
            return np.full(2, np.nan)
    return position
