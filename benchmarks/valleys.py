"""Valleys of the Earth: real ground, air, the skies that there are. Frames are rendered and located.

    python benchmarks/valleys.py [--frames 40] [--skies 10] [--rests 20] [--case NAME ...]

A run of one case has a section of its own in RESULTS.md.

The ground is that near Jacksboro, Tennessee, at 3 arcsec (SRTM), as it comes with matplotlib; places are valley floors
whose mean horizon is 9 to 26 degrees. 2048 px, a star of V 6 on the axis at 5 sigma, a sky of 21.5 mag/arcsec2, stars
refracted and dimmed by the standard atmosphere. "5 m per post": the ground differs from the map by 5 m of white noise
at each post, which the map states. "trees": they raise 20 % of the skyline and are on no map.
"bright ground": the exact map, with patches of 5 to 60 degrees, 0.3 to 3 times as bright as the sky.
"""

from __future__ import annotations

import argparse
import shlex
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from _ground_cases import draw_brightness
from _hazard_grounds import Risen
from _map_draws import draw_ground
from _results import table, write_section
from _sky_view import Hazard, Rng, View, expose, smooth_noise, turn

from startrack.applications.reproduction.scene import BELOW_RAD, DARK_RAD, draw_floor, draw_time, jacksboro
from startrack.applications.tracking import TrackErrors, observe_frame
from startrack.applications.tracking.positions import positions_at_rest
from startrack.camera import Camera, load_camera
from startrack.catalog import NIGHT_RAD, load_catalog
from startrack.chain import Located, locate
from startrack.core.runner import count_cores
from startrack.core.types import Array
from startrack.frames import azel_from_rays, rays_from_azel
from startrack.rendering import Series
from startrack.terrain import HeightMap, Terrain

POST_SIGMA_M = 5.0
SKY_MAG = 21.5
TWILIGHT_RAD = np.radians([-14.0, -11.0])  # elevations of the Sun
MOON_RAD = np.radians([15.0, 60.0])  # elevations of the Moon when it is up
REST_EVERY_S = 327.0  # twelve exposures an hour
RADIUS999_SIGMAS = 3.717  # of a circle in two dimensions
SEED = 29
HEAD = [
    "frames", "answered", "mean error, m", "median", "largest", "NEES", "beyond the 99.9 % circle", "beyond twice",
    "wanted mean",
]  # fmt: skip


def moonlight(view: View, rng: Rng) -> Array:
    """Moonlight that the air scatters: Krisciunas and Schaefer 1991, PASP 103, 1033, equations 17 and 21."""
    moon = next(one for one in view.scene.bodies if one.name == "Moon")
    rays = rays_from_azel(view.azimuth_rad, view.elevation_rad)
    away = np.degrees(np.arccos(np.clip(rays @ (view.scene.R_enu_icrs @ moon.ray_icrs), -1, 1)))
    scattered = 10**5.36 * (1.06 + np.cos(np.radians(away)) ** 2) + 10 ** (6.15 - away / 40)
    return view.with_sky(1 + 10 ** (-0.4 * (moon.v_mag + 12.73)) * 20.0 * scattered / 10**5.7)


def twilight(view: View, rng: Rng) -> Array:
    """A glow over the Sun: twice to 20 times the sky at the horizon, and half as much again all around."""
    sun = next(one for one in view.scene.bodies if one.name == "Sun")
    azimuth, _ = azel_from_rays(view.scene.R_enu_icrs @ sun.ray_icrs)
    off = turn(view.azimuth_rad, float(azimuth))
    glow = np.exp(-0.5 * (off / np.radians(60)) ** 2 - np.maximum(view.elevation_rad, 0) / np.radians(20))
    return view.with_sky(1.5 + rng.uniform(2, 20) * glow)


def city(view: View, rng: Rng) -> Array:
    """Two or three domes of light at the horizon, 2 to 10 times the sky."""
    factor = np.ones(view.azimuth_rad.shape)
    for _ in range(rng.integers(2, 4)):
        width, high = np.radians([rng.uniform(20, 50), rng.uniform(6, 15)])
        off = turn(view.azimuth_rad, rng.uniform(0, 2 * np.pi))
        factor += rng.uniform(2, 10) * np.exp(-0.5 * (off / width) ** 2 - np.maximum(view.elevation_rad, 0) / high)
    return view.with_sky(factor)


def thin_cloud(view: View, rng: Rng) -> Array:
    """Cirrus that takes up to 0.8 mag in patches of 10 to 30 degrees, and is up to half as bright again as the sky."""
    cell_px = int(view.scene.camera.focal_px[0] * np.radians(rng.uniform(10, 30)))
    patches = np.clip(0.5 + 0.5 * smooth_noise(view.azimuth_rad.shape, cell_px, rng), 0, 1)
    return view.with_sky(1 + 0.5 * patches, 10 ** (-0.4 * 0.8 * patches))


def trees(ground: Terrain, place_m: Array, rng: Rng) -> Terrain:
    """The ground with 5 to 20 m high trees on the crests of 20 % of the azimuths, seen from a place (2,)."""
    around = np.linspace(0, 2 * np.pi, 720, endpoint=False)
    _, distance, _ = ground.horizons(np.broadcast_to(place_m, (720, 2)), around)  # type: ignore[attr-defined]
    covered = np.zeros(720, dtype=bool)
    while covered.mean() < 0.2:
        start, width = rng.integers(720), rng.integers(8, 60)
        covered[(start + np.arange(width)) % 720] = True
    rise = covered * rng.uniform(5, 20, 720) / np.maximum(distance, 100.0)
    return Risen(
        ground, lambda azimuth: np.interp(azimuth % (2 * np.pi), np.append(around, 2 * np.pi), np.append(rise, rise[0]))
    )


@dataclass(frozen=True)
class Case:
    """A kind of frames: the wanted mean error [m], the map's error, trees, the sky."""

    wanted_m: float | None
    post_m: float = 0.0
    has_trees: bool = False
    is_bright: bool = False  # ground in patches that are 0.3 to 3 times as bright as the sky
    light: Callable[[View, Rng], Array] = lambda view, rng: view.light_e
    sun_rad: tuple[float, float] = (BELOW_RAD, NIGHT_RAD)
    moon_rad: tuple[float, float] = (BELOW_RAD, DARK_RAD)
    is_sky: bool = False
    exposures: int = 1  # at rest, in one posterior


CASES = {
    "exact map": Case(2.0),
    "5 m per post": Case(12.0, post_m=POST_SIGMA_M),
    "bright ground": Case(None, is_bright=True),
    "trees on 20 % of the skyline": Case(None, has_trees=True),
    "Moon up": Case(None, light=moonlight, moon_rad=tuple(MOON_RAD), is_sky=True),
    "twilight": Case(None, light=twilight, sun_rad=tuple(TWILIGHT_RAD), is_sky=True),
    "city glow": Case(None, light=city, is_sky=True),
    "thin cloud": Case(None, light=thin_cloud, is_sky=True),
    "an hour at rest": Case(0.6, exposures=12),
}


@cache
def _terrain(post_m: float) -> HeightMap:
    terrain = jacksboro(post_m)
    terrain.prepare()
    return terrain


@cache
def _camera() -> Camera:
    return load_camera("fisheye-2048")


def locate_frame(job: tuple[str, int]) -> tuple[str, float, float, float]:
    """Status, error [m], NEES, and the error over the radius of the 99.9 % circle of a frame of a case."""
    name, number = job
    case, rng = CASES[name], np.random.default_rng([SEED, number])
    stated = _terrain(case.post_m)
    assert stated.site is not None
    place_m = draw_floor(_terrain(0.0), rng=rng)
    when = draw_time(stated.site, sun_rad=case.sun_rad, moon_rad=case.moon_rad, rng=rng)
    ground: Terrain = draw_ground(_terrain(0.0), case.post_m, rng) if case.post_m else _terrain(0.0)
    ground = trees(ground, place_m, rng) if case.has_trees else ground
    series = Series(
        camera=_camera(), terrain=ground, catalog=load_catalog(), seed=int(rng.integers(1 << 30)), time_utc=when,
        east_m=float(place_m[0]), north_m=float(place_m[1]), sky_v_mag_arcsec2=SKY_MAG,
        every_s=REST_EVERY_S if case.exposures > 1 else None,
    )  # fmt: skip
    outcomes = []
    for k in range(case.exposures):
        scene, noise = series.scene(k, f"frame-{k:03d}")
        if case.is_bright:
            scene = replace(scene, ground_brightness=draw_brightness(rng))
        exposure, _, _ = expose(scene, Hazard(light=case.light), noise)
        outcomes.append(locate(exposure, _camera(), stated, load_catalog()))
    if case.exposures == 1:
        one = outcomes[0]
        if not isinstance(one, Located) or one.fix.ambiguous:
            print(f"{name} {number}: {one.reason}: {one.message}", flush=True)
            return str(one.reason), np.nan, np.nan, np.nan
        return "ok", *_score(one.fix.position_enu_m[:2] - place_m, one.fix.covariance_m2, one.fix.radius999_m)
    shared = TrackErrors.of(stated, None, True)
    observed = [observe_frame(one, shared) for one in outcomes]
    by_first = positions_at_rest(observed, stated, shared)[1]
    position, covariance = by_first.position_m, by_first.covariance_m2
    return "ok", *_score(
        position[-1] - place_m, covariance[-1], RADIUS999_SIGMAS * np.sqrt(np.linalg.eigvalsh(covariance[-1])[1])
    )


def _score(off_m: Array, covariance_m2: Array, radius_m: float) -> tuple[float, float, float]:
    error_m = float(np.hypot(*off_m))
    return error_m, float(off_m @ np.linalg.solve(covariance_m2, off_m)), error_m / float(radius_m)


def main() -> None:
    """Run, print and write the section."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, default=40)
    parser.add_argument("--skies", type=int, default=10)
    parser.add_argument("--rests", type=int, default=20)
    parser.add_argument("--case", nargs="*", default=list(CASES))
    parser.add_argument("--print-only", action="store_true")
    args = parser.parse_args()
    rows = []
    with ProcessPoolExecutor(count_cores()) as pool:
        for name in args.case:
            case = CASES[name]
            count = args.skies if case.is_sky else args.rests if case.exposures > 1 else args.frames
            found = list(pool.map(locate_frame, [(name, k) for k in range(count)]))
            errors, nees, parts = (np.array([one[k] for one in found if one[0] == "ok"]) for k in (1, 2, 3))
            rows.append([name, f"{len(errors)} of {count}", *7 * [""]])
            if len(errors):
                means = errors.mean(), np.median(errors), errors.max(), nees.mean()
                rows[-1][2:8] = [*(f"{one:.2f}" for one in means), *(str(int((parts > k).sum())) for k in (1, 2))]
            rows[-1][8] = "" if case.wanted_m is None else f"<= {case.wanted_m:g}"
            print(*rows[-1], flush=True)
            if not args.print_only:
                command = f"python benchmarks/valleys.py --frames {args.frames} --skies {args.skies}"
                command += f" --rests {args.rests} --case " + shlex.join(args.case[: len(rows)])
                section = "Valleys of the Earth" + (f": {args.case[0]}" if len(args.case) == 1 else "")
                write_section(section, command, ("numpy", "astropy", "matplotlib"), table(HEAD, rows))
    print(table(HEAD, rows))


if __name__ == "__main__":
    main()
