"""Hazards at the level of evidence: simulated stars instead of pixels, located with the checks of the pipeline."""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, replace
from datetime import timedelta
from functools import lru_cache
from typing import Any

import numpy as np
from _sky_scenes import EXPOSURE_S, camera_for_share
from map_errors import draw_ground, draw_position

from startrack.catalog import load_catalog
from startrack.evidence.likelihood_ratio import visibility_llr
from startrack.frames import azel_from_rays
from startrack.rendering import Scene, Series
from startrack.simulation import simulate_rays
from startrack.stages import StarRays
from startrack.star_fix import locate_rays
from startrack.terrain import Cylinder, Terrain, load_terrain
from startrack.terrain.height_map import HeightMap
from startrack.terrain.protocol import ForwardingTerrain
from startrack.types import TIME_SIGMA_S, Array, NoSolution

SEED, SHARE, FAINTEST_V_MAG = 515, 0.07, 8.6  # stars fainter than this are no evidence in these frames
FLOOR_M, FLOOR_SLOPE_RAD = 4000.0, np.radians(15.0)  # positions on height maps
SHAPE_SIGMA = 0.002  # of the cylinder whose file states errors
TOO_FAINT_MAG = 20.0
HOUR_S = 3600.0
SLOWEST = 150  # rounds between two frames of the classes that take minutes
WITHIN, BEYOND, BLOCKED, CLOCK, UNSEEN = "within", "beyond", "blocked", "clock", "unseen"
KINDS = {
    WITHIN: "errors within what the files state", BEYOND: "errors beyond what the files state",
    BLOCKED: "part of the view blocked", CLOCK: "clock off by an hour, stated to a second",
    UNSEEN: "the size of a crater beyond what its file states, which no picture shows",
}  # fmt: skip
HEAD = [
    "errors", "class", "frames", "answered rightly", "refused", "median error, m", "beyond the 99.9 % circle",
    "beyond the protection level",
]  # fmt: skip
Rng = np.random.Generator
Rise = Callable[[Array], Array]  # of azimuths (n,), by how much the true horizon is higher [rad]


class Risen(ForwardingTerrain):
    """The ground with a horizon that is higher by a function of the azimuth, which no map has."""

    def __init__(self, whole: Terrain, rise: Rise) -> None:
        super().__init__(whole)
        self.rise = rise

    def horizon_rad(self, points_m: Array, azimuths_rad: Array) -> Array:  # type: ignore[override]
        return np.asarray(self.whole.horizon_rad(points_m, azimuths_rad) + self.rise(azimuths_rad))


@dataclass(frozen=True)
class Class:
    """One class of frames: what their files state, and how the truth differs from it."""

    kind: str  # of KINDS
    stated: Callable[[], Terrain]
    ground: Callable[[Terrain, Rng], Terrain] = lambda stated, rng: stated
    scene: Callable[[Scene, Rng], Scene] = lambda scene, rng: scene
    rays: Callable[[StarRays, Rng], StarRays] = lambda rays, rng: rays
    clock_s: Callable[[Rng], float] = lambda rng: 0.0  # by which the stated time is wrong
    time_sigma_s: float = TIME_SIGMA_S
    every: int = 1  # measured in one of so many rounds: the slow ones less often


def shipped(name: str) -> Callable[[], Terrain]:
    """A shipped terrain by its name."""
    return lambda: _load(name)


def stated_shape() -> Terrain:
    """The thesis's crater with errors of its shape in its file."""
    crater = _load("shackleton-thesis")
    assert isinstance(crater, Cylinder)
    return replace(crater, depth_sigma_m=SHAPE_SIGMA * crater.depth_m, diameter_sigma_m=SHAPE_SIGMA * crater.diameter_m)


def other_shape(depth: tuple[float, float], diameter: tuple[float, float]) -> Callable[[Terrain, Rng], Terrain]:
    """A crater whose depth and diameter differ by parts between two, either way."""

    def ground(stated: Terrain, rng: Rng) -> Terrain:
        assert isinstance(stated, Cylinder)
        parts = [1.0 + rng.uniform(*size) * rng.choice([-1.0, 1.0]) for size in (depth, diameter)]
        return replace(stated, depth_m=stated.depth_m * parts[0], diameter_m=stated.diameter_m * parts[1])

    return ground


def other_size(low: float, high: float) -> Callable[[Terrain, Rng], Terrain]:
    """A crater larger or smaller by a part between two, in the same proportions."""

    def ground(stated: Terrain, rng: Rng) -> Terrain:
        assert isinstance(stated, Cylinder)
        factor = 1.0 + rng.uniform(low, high) * rng.choice([-1.0, 1.0])
        return replace(stated, depth_m=stated.depth_m * factor, diameter_m=stated.diameter_m * factor)

    return ground


def normal_shape(stated: Terrain, rng: Rng) -> Terrain:
    """A crater whose depth and diameter have the errors that the file states."""
    assert isinstance(stated, Cylinder)
    depth, diameter = rng.normal(1.0, SHAPE_SIGMA, 2)
    return replace(stated, depth_m=stated.depth_m * depth, diameter_m=stated.diameter_m * diameter)


def stated_errors(stated: Terrain, rng: Rng) -> Terrain:
    """The ground of a map whose posts and common horizon have the errors that the file states."""
    assert isinstance(stated, HeightMap)
    bias = float(rng.normal(0.0, stated.common_sigma_rad))
    return Risen(draw_ground(stated, stated.height_sigma_m, rng), lambda azimuth: np.full(np.shape(azimuth), bias))


def posts_wrong_by(sigma_m: float) -> Callable[[Terrain, Rng], Terrain]:
    """The ground of a map whose posts have other errors than it states."""
    return lambda stated, rng: draw_ground(stated, sigma_m, rng)  # type: ignore[arg-type]


def ridge(width_deg: tuple[float, float], height_deg: tuple[float, float]) -> Callable[[Terrain, Rng], Terrain]:
    """A triangular ridge on no map."""

    def ground(stated: Terrain, rng: Rng) -> Terrain:
        width, height = np.radians([rng.uniform(*width_deg), rng.uniform(*height_deg)])
        middle = rng.uniform(0, 2 * np.pi)

        def rise(azimuth: Array) -> Array:
            return np.asarray(height * np.maximum(1.0 - np.abs(_turn(azimuth, middle)) / (width / 2), 0.0))

        return Risen(stated, rise)

    return ground


def magnitudes(scatter_mag: float, outliers: float) -> Callable[[Scene, Rng], Scene]:
    """Magnitudes wrong by a scatter, and those of a part of the stars by 0.5 to 2."""

    def change(scene: Scene, rng: Rng) -> Scene:
        n = len(scene.stars)
        error = rng.normal(0.0, scatter_mag, n) + (rng.random(n) < outliers) * rng.uniform(0.5, 2.0, n) * rng.choice(
            [-1.0, 1.0], n
        )
        return replace(scene, v_error_mag=scene.v_error_mag + error)

    return change


def missing(part: float) -> Callable[[Scene, Rng], Scene]:
    """A part of the stars is missing."""

    def change(scene: Scene, rng: Rng) -> Scene:
        gone = rng.random(len(scene.stars)) < part
        return replace(scene, v_error_mag=scene.v_error_mag + np.where(gone, TOO_FAINT_MAG, 0.0))

    return change


def false_light(part: float) -> Callable[[StarRays, Rng], StarRays]:
    """A part of the stars shows the light that is expected, hidden or not."""

    def change(rays: StarRays, rng: Rng) -> StarRays:
        light = rays.light
        shown = visibility_llr(
            light.expected_e, light.expected_e, np.maximum(light.sigma_e, 1.0), np.maximum(light.sigma_e, 1.0)
        )
        false = (rng.random(len(light.llr)) < part) & light.usable
        return replace(rays, light=replace(light, llr=np.where(false, shown, light.llr)))

    return change


def hidden_where(hides: Callable[[Array, Array, Array, Rng], Array]) -> Callable[[Scene, Rng], Scene]:
    """Stars are dark where a function of azimuths, elevations and heights above the skyline (n,) is true."""

    def change(scene: Scene, rng: Rng) -> Scene:
        azimuth, elevation = azel_from_rays(scene.stars.rays_icrs @ scene.R_enu_icrs.T)
        around = np.linspace(0.0, 2 * np.pi, 721)
        assert scene.terrain is not None
        skyline = np.asarray(scene.terrain.horizon_rad(scene.position_enu_m[None, :2], around)).ravel()
        dark = hides(azimuth, elevation, elevation - np.interp(azimuth % (2 * np.pi), around, skyline), rng)
        return replace(scene, v_error_mag=scene.v_error_mag + np.where(dark, TOO_FAINT_MAG, 0.0))

    return change


def mast(azimuth: Array, elevation: Array, above: Array, rng: Rng) -> Array:
    """A bar of 2 to 12 degrees from the ground to the zenith."""
    off, half_width = _turn(azimuth, rng.uniform(0, 2 * np.pi)), np.radians(rng.uniform(1, 6))
    return np.asarray((np.abs(np.cos(elevation) * np.sin(off)) < half_width) & (np.cos(off) > 0))


def dust(azimuth: Array, elevation: Array, above: Array, rng: Rng) -> Array:
    """Ten to forty specks of 1 to 6 degrees within 12 degrees of the skyline."""
    dark = np.zeros(len(azimuth), dtype=bool)
    for _ in range(rng.integers(10, 41)):
        middle, height, radius = rng.uniform(0, 2 * np.pi), np.radians(rng.uniform(-2, 12)), rng.uniform(0.5, 3)
        off = np.hypot(np.cos(elevation) * _turn(azimuth, middle), above - height)
        dark |= off < np.radians(radius)
    return dark


def quadrant(azimuth: Array, elevation: Array, above: Array, rng: Rng) -> Array:
    """A range of azimuths of 40 to 100 degrees."""
    return np.asarray(np.abs(_turn(azimuth, rng.uniform(0, 2 * np.pi))) < np.radians(rng.uniform(20, 50)))


def clock_of(sigma_s: float) -> Callable[[Rng], float]:
    """A clock wrong by a normal error."""
    return lambda rng: float(rng.normal(0.0, sigma_s))


def clock_off(offset_s: float) -> Callable[[Rng], float]:
    """A clock that is fast or slow by that much."""
    return lambda rng: float(offset_s * rng.choice([-1.0, 1.0]))


def measure_frame(job: tuple[str, int]) -> dict[str, Any]:
    """One frame of one class."""
    name, number = job
    one, catalog = CLASSES[name], load_catalog().brighter_than(FAINTEST_V_MAG)
    stated = one.stated()
    camera, sky = camera_for_share(SHARE)
    seed = int(np.random.SeedSequence([SEED, *name.encode()]).generate_state(1)[0])  # places and sky of its own
    east_m, north_m = (None, None)
    if isinstance(stated, HeightMap):
        east_m, north_m = draw_position(
            stated, FLOOR_M, FLOOR_SLOPE_RAD, np.random.default_rng([seed, number])
        ).tolist()
    series = Series(
        camera=camera, terrain=stated, catalog=catalog, seed=seed, exposure_s=EXPOSURE_S, sky_v_mag_arcsec2=sky,
        faint_v_mag=FAINTEST_V_MAG, east_m=east_m, north_m=north_m,
    )  # fmt: skip
    scene, rng = series.scene(number)
    scene = one.scene(replace(scene, terrain=one.ground(stated, rng)), rng)
    assert scene.time_utc is not None
    offset_s = one.clock_s(rng)
    rays = simulate_rays(
        scene, catalog, stated, time_utc=scene.time_utc + timedelta(seconds=offset_s), time_sigma_s=one.time_sigma_s,
        rng=rng,
    )  # fmt: skip
    try:
        found = locate_rays(one.rays(rays, rng))
    except NoSolution as refusal:
        return {"reason": str(refusal.reason)}
    if found.integrity is None:
        return {"reason": "ambiguous"}
    fix, error = found.fix, float(np.linalg.norm((found.fix.position_enu_m - scene.position_enu_m)[:2]))
    if error > fix.radius999_m:
        print(f"{name} {number}: {error:.1f} m, circle {fix.radius999_m:.1f} m", file=sys.stderr, flush=True)
    row = {"reason": "", "error_m": error, "circle_m": fix.radius999_m, "level_m": found.integrity.protection_level_m}
    return row | {"clock_off_s": offset_s + fix.clock.offset_s if fix.clock else offset_s}


def summary(name: str, rows: list[dict[str, Any]]) -> list[str]:
    """One line of the table."""
    located, beyond, unprotected = _answers(rows)
    reasons = Counter(row["reason"] for row in rows if row["reason"])
    refused = ", ".join(f"{reason} {count}" for reason, count in reasons.most_common())
    wrong = ", ".join(f"{row['error_m']:.0f} of {row['circle_m']:.0f} m" for row in beyond[:6])
    median = f"{np.median([row['error_m'] for row in located]):.1f}" if located else "-"
    return [
        CLASSES[name].kind, name, str(len(rows)), str(len(located) - len(beyond)),
        f"{len(rows) - len(located)}" + (f" ({refused})" if refused else ""), median,
        f"{len(beyond)}" + (f" ({wrong}{', ...' if len(beyond) > 6 else ''})" if wrong else ""), str(len(unprotected)),
    ]  # fmt: skip


def totals(rows: dict[str, list[dict[str, Any]]]) -> str:
    """The sums of each kind of class, as a text below the table."""
    lines = []
    for kind, words in KINDS.items():
        found = [row for name, some in rows.items() if CLASSES[name].kind == kind for row in some]
        located, beyond, unprotected = _answers(found)
        lines.append(
            f"- {words}: {len(found)} frames, {len(located)} answered, {len(beyond)} beyond the 99.9 % circle, "
            f"{len(unprotected)} beyond the protection level"
        )
    return "\n\n" + "\n".join(lines)


def every(name: str) -> int:
    """One in how many rounds a class is measured."""
    return CLASSES[name].every


def _answers(rows: list[dict[str, Any]]) -> tuple[list[dict[str, Any]], ...]:
    """The rows with a position, those beyond the circle, and those beyond the protection level."""
    located = [row for row in rows if not row["reason"]]
    return (
        located, [row for row in located if row["error_m"] > row["circle_m"]],
        [row for row in located if row["error_m"] > row["level_m"]],
    )  # fmt: skip


@lru_cache
def _load(name: str) -> Terrain:
    terrain = load_terrain(name)
    terrain.prepare()
    return terrain


def _turn(azimuth_rad: Array, from_rad: float) -> Array:
    return np.asarray((azimuth_rad - from_rad + np.pi) % (2 * np.pi) - np.pi)


THESIS, RENDERED = shipped("shackleton-thesis"), shipped("shackleton-rendered")
SHACKLETON, KEPLER = shipped("shackleton"), shipped("kepler")
CLASSES = {
    "thesis's crater, true": Class(WITHIN, THESIS),
    "thesis's crater, magnitudes wrong by 0.1": Class(WITHIN, THESIS, scene=magnitudes(0.1, 0.0)),
    "thesis's crater, 0.2 % of the stars missing, 0.1 % false": Class(
        WITHIN, THESIS, scene=missing(0.002), rays=false_light(0.001)
    ),
    "cylinder with depth and diameter wrong by the stated 0.2 %": Class(WITHIN, stated_shape, normal_shape, every=2),
    "clock wrong by the stated 10 minutes, thesis's crater": Class(
        WITHIN, THESIS, clock_s=clock_of(600.0), time_sigma_s=600.0, every=4
    ),
    "clock wrong by the stated hour, thesis's crater": Class(
        WITHIN, THESIS, clock_s=clock_of(HOUR_S), time_sigma_s=HOUR_S, every=4
    ),
    "clock wrong by the stated 6 hours, thesis's crater": Class(
        WITHIN, THESIS, clock_s=clock_of(6 * HOUR_S), time_sigma_s=6 * HOUR_S, every=4
    ),
    "Shackleton, map without errors": Class(WITHIN, RENDERED, every=12),
    "Shackleton, posts and horizon wrong as stated": Class(WITHIN, SHACKLETON, stated_errors, every=12),
    "Kepler, posts and horizon wrong as stated": Class(WITHIN, KEPLER, stated_errors, every=12),
    "clock wrong by the stated 10 minutes, Shackleton": Class(
        WITHIN, SHACKLETON, stated_errors, clock_s=clock_of(600.0), time_sigma_s=600.0, every=SLOWEST
    ),
    "clock wrong by the stated hour, Shackleton": Class(
        WITHIN, SHACKLETON, stated_errors, clock_s=clock_of(HOUR_S), time_sigma_s=HOUR_S, every=SLOWEST
    ),
    "clock wrong by the stated 6 hours, Shackleton": Class(
        WITHIN, SHACKLETON, stated_errors, clock_s=clock_of(6 * HOUR_S), time_sigma_s=6 * HOUR_S, every=SLOWEST
    ),
    "clock wrong by the stated 10 minutes, Kepler": Class(
        WITHIN, KEPLER, stated_errors, clock_s=clock_of(600.0), time_sigma_s=600.0, every=SLOWEST
    ),
    "clock wrong by the stated hour, Kepler": Class(
        WITHIN, KEPLER, stated_errors, clock_s=clock_of(HOUR_S), time_sigma_s=HOUR_S, every=SLOWEST
    ),
    "clock wrong by the stated 6 hours, Kepler": Class(
        WITHIN, KEPLER, stated_errors, clock_s=clock_of(6 * HOUR_S), time_sigma_s=6 * HOUR_S, every=SLOWEST
    ),
    "magnitudes of 2 % of the stars wrong by 0.5 to 2": Class(BEYOND, THESIS, scene=magnitudes(0.0, 0.02)),
    "2 % of the stars missing, 1 % false": Class(BEYOND, THESIS, scene=missing(0.02), rays=false_light(0.01)),
    "small ridge, 10 to 60 by 0.2 to 1 degrees": Class(BEYOND, THESIS, ridge((10, 60), (0.2, 1))),
    "low wide ridge, 70 to 150 by 1 to 3 degrees": Class(BEYOND, THESIS, ridge((70, 150), (1, 3))),
    "small ridge, Shackleton": Class(BEYOND, RENDERED, ridge((10, 60), (0.2, 1)), every=24),
    "depth 0.1 to 0.5 % wrong, stated exact": Class(BEYOND, THESIS, other_shape((0.001, 0.005), (0.0, 0.0))),
    "depth 1 to 5 % wrong, stated exact": Class(BEYOND, THESIS, other_shape((0.01, 0.05), (0.0, 0.0))),
    "diameter 1 to 5 % wrong, stated exact": Class(BEYOND, THESIS, other_shape((0.0, 0.0), (0.01, 0.05))),
    "depth 1 to 2 % wrong, stated 0.2 %": Class(BEYOND, stated_shape, other_shape((0.01, 0.02), (0.0, 0.0)), every=2),
    "crater 0.6 to 2 % larger or smaller in the same proportions, stated 0.2 %": Class(
        UNSEEN, stated_shape, other_size(0.006, 0.02), every=2
    ),
    "Shackleton, posts wrong by 5 m, stated 1 m": Class(BEYOND, RENDERED, posts_wrong_by(5.0), every=24),
    "mast of 2 to 12 degrees": Class(BLOCKED, THESIS, scene=hidden_where(mast)),
    "dust near the skyline": Class(BLOCKED, THESIS, scene=hidden_where(dust)),
    "40 to 100 degrees of azimuth dark": Class(BLOCKED, THESIS, scene=hidden_where(quadrant)),
    "high ridge, 30 to 90 by 5 to 20 degrees": Class(BLOCKED, THESIS, ridge((30, 90), (5, 20))),
    "40 to 100 degrees of azimuth dark, Shackleton": Class(BLOCKED, RENDERED, scene=hidden_where(quadrant), every=24),
    "clock off by an hour, stated 1 s, thesis's crater": Class(CLOCK, THESIS, clock_s=clock_off(HOUR_S), every=4),
    "clock off by an hour, stated 1 s, Shackleton": Class(
        CLOCK, SHACKLETON, stated_errors, clock_s=clock_off(HOUR_S), every=24
    ),
    "clock off by an hour, stated 1 s, Kepler": Class(
        CLOCK, KEPLER, stated_errors, clock_s=clock_off(HOUR_S), every=24
    ),
}
