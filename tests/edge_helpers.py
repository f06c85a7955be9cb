"""Small random maps whose ends and voids are near the search area, and images of the ground that they may misstate."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from hazard_helpers import catalog_to, small_camera

from startrack.chain import StarRays
from startrack.core.types import Array, BadInput
from startrack.frames import Site
from startrack.rendering import Scene, Series
from startrack.simulation import simulate_rays
from startrack.terrain import STEREOGRAPHIC, HeightMap, Projection, Raster

FOOT_M = np.float32(0.3048)
RIGHT = "right", "void", "crop"  # changes that leave a map right, where it is known
WRONG = {
    "rows": lambda h: h[::-1], "columns": lambda h: h[:, ::-1], "turned": lambda h: h.T, "feet": lambda h: h * FOOT_M,
    "metres": lambda h: h / FOOT_M, "kilometres": lambda h: h / 1000, "moved": lambda h: np.roll(h, (3, -2), (0, 1)),
}  # fmt: skip
CHANGES = (*RIGHT, *WRONG)
V_MAG = 6.5  # of the faintest stars


class Ground(NamedTuple):
    """Heights (n, n) [m] of posts at `line_m` (n,) east and, the first row to the north, north of the origin."""

    heights_m: Array
    line_m: Array
    radius_m: float  # of the search area

    @property
    def post_m(self) -> float:
        return float(self.line_m[1] - self.line_m[0])

    @property
    def away_m(self) -> Array:
        """(n, n) distance of the posts from the origin."""
        return np.hypot(*np.meshgrid(self.line_m, self.line_m))


def draw_ground(rng: np.random.Generator, posts: int = 40) -> Ground:
    """Rough or flat ground, a crater, a mountain or a slope; the search area may end near the last posts."""
    post_m = float(np.exp(rng.uniform(np.log(10.0), np.log(150.0))))
    line_m = (np.arange(posts) - 0.5 * posts + rng.uniform(-0.4, 0.4)) * post_m
    east, north = np.meshgrid(line_m, -line_m)
    away, half_m = np.hypot(east, north), 0.5 * posts * post_m
    wave = np.hypot(*np.meshgrid(np.fft.fftfreq(posts), np.fft.fftfreq(posts)))
    wave[0, 0] = np.inf
    rough = np.fft.ifft2(np.fft.fft2(rng.normal(size=wave.shape)) * wave**-1.5).real
    heights = rough * rng.choice([0.02, 0.2, 0.6]) * post_m / rough.std()
    kind, size_m = rng.integers(5), half_m * rng.uniform(0.3, 1.1)
    if kind in (0, 1):
        inner, outer = (away / size_m) ** 4, np.exp(-np.maximum(away / size_m - 1.0, 0.0) * rng.uniform(0.5, 5.0))
        heights += size_m * rng.uniform(0.03, 0.4) * np.minimum(inner, outer)
    elif kind == 2:
        heights += half_m * rng.uniform(0.05, 0.5) * np.exp(-((away / size_m) ** 2))
    elif kind == 3:
        heights += rng.uniform(-0.4, 0.4) * east + rng.uniform(-0.4, 0.4) * north
    known_m = min(-line_m[0], line_m[-1])
    return Ground(heights.astype(np.float32), line_m, float(max(known_m * rng.uniform(0.2, 0.97), 2.5 * post_m)))


def with_voids(ground: Ground, rng: np.random.Generator) -> Array:
    """The heights with disks, a half-plane or single posts off the search area unknown: NaN."""
    heights = ground.heights_m.copy()
    east, north = np.meshgrid(ground.line_m, -ground.line_m)
    off = ground.away_m > ground.radius_m + 3.0 * ground.post_m
    turn, middle = rng.uniform(0.0, 2 * np.pi), rng.choice(ground.line_m, 2)
    unknown = np.hypot(east - middle[0], north - middle[1]) < rng.uniform(2.0, 8.0) * ground.post_m
    unknown |= np.cos(turn) * east + np.sin(turn) * north > rng.uniform(ground.radius_m, 1.2 * ground.line_m[-1])
    heights[off & (unknown | (rng.random(heights.shape) < 0.02))] = np.nan
    return heights


def raster_of(heights_m: Array, ground: Ground, site: Site) -> Raster:
    """A map of these heights at the posts of a `ground`."""
    return Raster(
        heights_m=np.ascontiguousarray(heights_m), source="edges",
        projection=Projection(kind=STEREOGRAPHIC, latitude_rad=site.latitude_rad, longitude_rad=site.longitude_rad),
        x0_m=float(ground.line_m[0]), y0_m=-float(ground.line_m[0]), dx_m=ground.post_m, dy_m=-ground.post_m,
    )  # fmt: skip


def map_of(ground: Ground, change: str, truth: HeightMap, rng: np.random.Generator) -> HeightMap:
    """The map of a `ground` with a `change`; that of the right ones states how high ground off it is.

    Raises BadInput where it does not cover the search area.
    """
    heights = WRONG[change](ground.heights_m) if change in WRONG else ground.heights_m
    raster = raster_of(with_voids(ground, rng) if change == "void" else heights, ground, truth.site)
    if change == "crop":
        kept_m = ground.radius_m + 2.0 * ground.post_m
        kept = [np.flatnonzero(np.abs(ground.line_m) < kept_m * rng.uniform(1.0, 1.5)) for _ in range(2)]
        raster = raster.crop(*(slice(int(one[0]), int(one[-1]) + 1) for one in kept))
    highest_m = float(ground.heights_m.max()) if change in RIGHT else -np.inf
    return replace(truth, name="map", maps=(raster,), highest_beyond_m=highest_m)


def draw_scene(seed: int) -> tuple[Ground, HeightMap, Scene, np.random.Generator]:
    """A ground, its map with errors, an image on it, and the generator for what follows."""
    rng = np.random.default_rng([seed, 12])
    ground, site = draw_ground(rng), Site("moon", float(rng.uniform(-1.55, 1.55)), float(rng.uniform(-3.1, 3.1)))
    truth = HeightMap(
        name="truth", site=site, maps=(raster_of(ground.heights_m, ground, site),), search_radius_m=ground.radius_m,
        height_sigma_m=float(rng.choice([0.0, 0.2, 1.0, 0.05 * ground.post_m])), stretch_sigma_1=None,
        vertical_sigma_rad=None, camera_height_sigma_m=0.02,
    )  # fmt: skip
    away_m, turn = 0.97 * ground.radius_m * np.sqrt(rng.random()), rng.uniform(0.0, 2 * np.pi)
    series = Series(
        camera=small_camera(), terrain=truth, catalog=catalog_to(V_MAG), seed=seed, faint_v_mag=V_MAG,
        east_m=float(away_m * np.sin(turn)), north_m=float(away_m * np.cos(turn)), pitch_rad=0.05, roll_rad=-0.03,
    )  # fmt: skip
    return ground, truth, series.scene(0)[0], rng


def draw_rays(seed: int, change: str) -> tuple[StarRays, Scene] | None:
    """The stars of a random image as seen on its ground, for a map with a `change`; None where the map is refused."""
    ground, truth, scene, rng = draw_scene(seed)
    try:
        terrain = map_of(ground, change, truth, rng)
    except BadInput:
        return None
    return simulate_rays(scene, catalog_to(V_MAG), terrain, rng=np.random.default_rng(seed)), scene
