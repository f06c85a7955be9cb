"""A class of hazards at the level of evidence, and the terrains that its files state."""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path

import numpy as np
from _hazard_grounds import NAMES, crater_with, map_with
from _map_draws import draw_ground

from startrack.chain import StarRays
from startrack.core.types import Array
from startrack.frames import R_enu_icrs, Site
from startrack.rendering import Scene
from startrack.terrain import STEREOGRAPHIC, Cylinder, HeightMap, Projection, Raster, Terrain, load_terrain

WITHIN, GROSS, VISIBLE, UNSEEN = "within", "gross", "visible", "unseen"
KINDS = {
    WITHIN: "errors within what is stated, or the default where nothing is",
    GROSS: "one gross error where the file is silent",
    VISIBLE: "denied by a file or far beyond the default, but visible",
    UNSEEN: "denied by a file or far beyond the default, and visible in no picture",
}
STATED_CLOCK_S = 1.0
SHAPE_SIGMA = 0.002  # of the crater whose file states errors
SITE = Site("moon", np.radians(-89.66), np.radians(129.78))
CREST_POSTS, CREST_POST_M, CREST_RADIUS_M, CREST_SIGMA_M = 400, 4.6, 300.0, 0.3
CREST_HEIGHT_M, CREST_SLOPE = 45.0, 0.15  # of the rim; of its roughness from post to post
SILENT = f"""format = 1
name = "silent"
body = "moon"
[origin]
latitude_deg = {np.degrees(SITE.latitude_rad)}
longitude_deg = {np.degrees(SITE.longitude_rad)}
[cylinder]
diameter_m = 20000.0
depth_m = 2000.0
[rover]
camera_height_m = 1.5
[search]
radius_m = 10000.0
"""
Rng = np.random.Generator
Ground = Callable[[Terrain, Rng], Terrain]


@dataclass(frozen=True)
class Default:
    """A fact about which a file is silent: the errors that it would state."""

    names: tuple[str, ...]  # in NAMES
    sigma: float
    gross_sigma: float


DEFAULTS = {  # as the design proposes; where the terrain states its own, those count
    "depth": Default(("depth_1",), 1e-3, 1e-2),
    "width": Default(("diameter_1",), 1e-3, 1e-2),
    "ellipse": Default(("ellipse_cos_1", "ellipse_sin_1"), 5e-4, 5e-3),
    "rim tilt": Default(
        ("rim_tilt_east_rad", "rim_tilt_north_rad"), float(np.radians(0.002)), float(np.radians(0.1))
    ),
}  # fmt: skip


@dataclass(frozen=True)
class Class:
    """One class of frames: what their files state, and how the truth differs from it."""

    kind: str  # of KINDS
    stated: Callable[[], Terrain]
    ground: Ground = lambda stated, rng: stated
    scene: Callable[[Scene, Rng], Scene] = lambda scene, rng: scene
    rays: Callable[[StarRays, Rng], StarRays] = lambda rays, rng: rays
    clock_s: Callable[[Rng], float] = lambda rng: 0.0  # by which the stated time is wrong
    time_sigma_s: float | None = STATED_CLOCK_S  # None: nothing is stated
    away_m: tuple[float, float] | None = None  # of the places from the middle
    every: int = 1  # one frame where other classes have so many: the slow ones


def shipped(name: str) -> Callable[[], Terrain]:
    """A shipped terrain by its name."""
    return lambda: _load(name)


def stated_shape() -> Terrain:
    """The thesis's crater with errors of its depth and width in its file."""
    crater = _load("shackleton-thesis")
    assert isinstance(crater, Cylinder)
    return replace(crater, depth_sigma_m=SHAPE_SIGMA * crater.depth_m, diameter_sigma_m=SHAPE_SIGMA * crater.diameter_m)


@lru_cache
def silent_crater() -> Terrain:
    """The same crater by a file that states no errors."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "silent.toml"
        path.write_text(SILENT, encoding="utf-8")
        return load_terrain(str(path))


@lru_cache
def near_crest() -> Terrain:
    """A map with fine posts about a small crater, whose rim is the horizon."""
    half = (CREST_POSTS - 1) / 2 * CREST_POST_M
    line = np.linspace(-half, half, CREST_POSTS)
    away = np.hypot(line[:, None], line)
    rim = CREST_HEIGHT_M * np.exp(-np.square((away - CREST_RADIUS_M) / (0.2 * CREST_RADIUS_M)))
    rough = np.random.default_rng(46).normal(size=away.shape)
    for axis in (0, 1):  # smooth over some ten posts
        rough = np.apply_along_axis(np.convolve, axis, rough, np.hanning(13), mode="same")
    rough *= CREST_SLOPE * CREST_POST_M / np.sqrt(np.mean(np.square(np.diff(rough, axis=0))))
    projection = Projection(
        kind=STEREOGRAPHIC, latitude_rad=SITE.latitude_rad, longitude_rad=SITE.longitude_rad
    )  # fmt: skip
    raster = Raster(
        heights_m=(rim + rough).astype(np.float32), projection=projection, x0_m=-half, y0_m=half, dx_m=CREST_POST_M,
        dy_m=-CREST_POST_M, source="crest",
    )  # fmt: skip
    terrain = HeightMap(
        name="near crest", site=SITE, maps=(raster,), search_radius_m=CREST_RADIUS_M, height_sigma_m=CREST_SIGMA_M,
        horizon_sigma_common_rad=float(np.radians(0.02)),
    )  # fmt: skip
    terrain.prepare()
    return terrain


def defaults_drawn(gross: str = "") -> Ground:
    """A crater with errors as they count where its file is silent; of the fact `gross` with its gross sigma instead."""

    def ground(stated: Terrain, rng: Rng) -> Terrain:
        drawn = dict(zip(NAMES, rng.standard_normal(len(NAMES)), strict=True))
        sigmas = _sigmas(stated)
        values = {
            name: drawn[name] * sigmas[name][one == gross] for one, fact in DEFAULTS.items() for name in fact.names
        }
        assert isinstance(stated, Cylinder)
        return crater_with(stated, values)

    return ground


def _sigmas(stated: Terrain) -> dict[str, tuple[float, float]]:
    """Default and gross sigma of each error by its name: those of the terrain where it has them."""
    found = {name: (fact.sigma, fact.gross_sigma) for fact in DEFAULTS.values() for name in fact.names}
    for error in stated.errors.shape:
        if error.name in found:
            found[error.name] = (error.sigma, error.gross_sigma or error.sigma)
    return found


def errors_as_stated(stated: Terrain, rng: Rng) -> Terrain:
    """The ground of a map whose posts and common horizon have the errors that the file states."""
    assert isinstance(stated, HeightMap)
    bias = float(rng.normal(0.0, stated.errors.common_sigma_rad))
    return map_with(draw_ground(stated, stated.height_sigma_m, rng), {"bias_rad": bias})


def origin_off(latitude_deg: float) -> Callable[[Scene, Rng], Scene]:
    """The true origin is that much farther north than the file's, so that the vertical is another one."""

    def change(scene: Scene, rng: Rng) -> Scene:
        assert scene.terrain is not None and scene.terrain.site is not None and scene.time_utc is not None
        site = scene.terrain.site
        true = replace(site, latitude_rad=site.latitude_rad + np.radians(latitude_deg))
        return replace(scene, R_enu_icrs=R_enu_icrs(true, scene.time_utc))

    return change


def draw_place(stated: Terrain, away_m: tuple[float, float], rng: Rng) -> Array:
    """A position (2,) [m] in a ring about the middle, where a camera can stand."""
    while True:
        azimuth, square = rng.uniform(0, 2 * np.pi), rng.uniform(away_m[0] ** 2, away_m[1] ** 2)
        place = np.sqrt(square) * np.array([np.sin(azimuth), np.cos(azimuth)])
        if bool(stated.allowed(place[None])[0]):
            return np.asarray(place)


@lru_cache
def _load(name: str) -> Terrain:
    terrain = load_terrain(name)
    terrain.prepare()
    return terrain
