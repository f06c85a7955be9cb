"""Frames of which something is wrong that no file states: simulated rays, and small rendered images."""

from __future__ import annotations

import importlib.util
import sys
from collections.abc import Callable, Mapping
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from startrack.camera import Camera, load_camera
from startrack.catalog import StarCatalog, load_catalog
from startrack.chain import StarRays, locate_rays
from startrack.core.types import Array, Exposure, NoSolution
from startrack.rendering import Scene, Series, render
from startrack.simulation import simulate_rays
from startrack.terrain import Terrain, load_terrain

Ground = Callable[[Terrain], Terrain]


def _load(name: str) -> Any:
    """A module of the benchmarks."""
    path = Path(__file__).parent.parent / "benchmarks" / f"{name}.py"
    spec = importlib.util.spec_from_file_location(name, path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    spec.loader.exec_module(module)
    return module


grounds = _load("_hazard_grounds")


@cache
def terrain_named(name: str) -> Terrain:
    """A shipped terrain."""
    terrain = load_terrain(name)
    terrain.prepare()
    return terrain


@cache
def catalog_to(v_mag: float) -> StarCatalog:
    """The shipped catalogue down to a magnitude."""
    return load_catalog().brighter_than(v_mag)


@cache
def _scene(name: str, place: tuple[float, float], seed: int) -> Scene:
    series = Series(
        camera=load_camera("fisheye-2048"), terrain=terrain_named(name), catalog=catalog_to(8.6), seed=seed,
        faint_v_mag=8.6, east_m=place[0], north_m=place[1],
    )  # fmt: skip
    return series.scene(0)[0]


def rays_of(
    name: str, place: tuple[float, float], seed: int, ground: Ground = lambda stated: stated, offset_s: float = 0.0
) -> tuple[StarRays, Array]:
    """Rays seen from a place on a `ground` made of the named terrain, and the true position (3,).

    The time that is stated is late by `offset_s`. The noise is the same for every ground and time.
    """
    scene, stated = _scene(name, place, seed), terrain_named(name)
    assert scene.time_utc is not None
    rays = simulate_rays(
        replace(scene, terrain=ground(stated)), catalog_to(8.6), stated, rng=np.random.default_rng(seed),
        time_utc=scene.time_utc + timedelta(seconds=offset_s), time_sigma_s=1.0,
    )  # fmt: skip
    return rays, scene.position_enu_m


def error_in_circles(rays: StarRays, position_m: Array) -> float | None:
    """The error of the fix, in radii of its 99.9 % circle; None: refused or ambiguous."""
    try:
        found = locate_rays(rays)
    except NoSolution:
        return None
    if found.fix.ambiguous:
        return None
    return float(np.hypot(*(found.fix.position_enu_m - position_m)[:2]) / found.fix.radius999_m)


def box(width_deg: float, height_deg: float, middle_deg: float = 70.0) -> Ground:
    """A box on no map."""
    rise = grounds.box_rise(*np.radians([middle_deg, width_deg, height_deg]))
    return lambda stated: grounds.Risen(stated, rise)


def ridge(width_deg: float, height_deg: float, middle_deg: float = 70.0) -> Ground:
    """A triangular ridge on no map."""
    rise = grounds.ridge_rise(*np.radians([middle_deg, width_deg, height_deg]))
    return lambda stated: grounds.Risen(stated, rise)


def crater_with(values: Mapping[str, float]) -> Ground:
    """A crater with errors of its rim, by their names."""
    return lambda stated: grounds.crater_with(stated, values)


def stretched(stretch_1: float) -> Ground:
    """A horizon that is higher by that part."""
    return lambda stated: grounds.Stretched(stated, stretch_1)


def small_camera() -> Camera:
    """A fisheye of 1024 px."""
    return replace(
        load_camera("fisheye-2048"), name="fisheye-1024", size_px=(1024, 1024), focal_px=(326.0, 326.0),
        centre_px=(511.5, 511.5),
    )  # fmt: skip


@cache
def rendered(
    ground: Ground | None = None, sky_v_mag_arcsec2: float | None = 22.0, faintest_v_mag: float = 7.0
) -> Exposure:
    """An image of 1024 px of a `ground` made of the thesis's crater, 6.5 km off its middle.

    The sky has no fainter stars: a catalogue for locating it must end there too.
    """
    heading, pitch, roll = np.radians([30.0, 2.0, -3.0]).tolist()
    series = Series(
        camera=small_camera(), terrain=terrain_named("shackleton-thesis"), catalog=catalog_to(faintest_v_mag), seed=7,
        time_utc=datetime(2030, 6, 1, tzinfo=UTC), east_m=6000.0, north_m=-2500.0, heading_rad=heading,
        pitch_rad=pitch, roll_rad=roll, faint_v_mag=None, hot_pixels=20, sky_v_mag_arcsec2=sky_v_mag_arcsec2,
    )  # fmt: skip
    scene, rng = series.scene(0, "small")
    if ground is not None:
        scene = replace(scene, terrain=ground(series.terrain))
    return render(scene, rng=rng)[0]
