"""Cases of ground that is not its map: drawn errors, seams, turned maps, finer maps, and light below the skyline."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import numpy as np
from _hazard_grounds import Curve, Risen
from _map_draws import draw_position
from _sky_view import View, turn

from startrack.core.types import Array
from startrack.terrain import ForwardingTerrain, GroundBrightness, HeightMap, Terrain

SIGMA_RAD = np.radians(0.024)  # of the horizon of 5 m posts about that of the shipped map, less their mean
WAVES = np.arange(1, 81)  # around the compass
STATED_WAVES = 8
POST_SIGMA_M, POST_REACH_M, PLANE_WAVES = 5.4, 3000.0, 1000
SEAM_M, SEAM_OFF_M = 9000.0, (5.0, 20.0)
TURN_DEG = (0.2, 2.0)
LIT_DEG = (60.0, 120.0)
REFERENCE_PLACE_M, REFERENCE_CAMERA_M = (0.0, -303.2), 2.0
FLOOR_M, FLOOR_SLOPE_RAD = 4000.0, np.radians(15.0)
SITE01_M, SITE01_PLACES = 2000.0, 3
SITE01_KEYS = {"latitude_deg": "-89.4583", "longitude_deg": "-137.49", "radius_m": "3000.0"}  # the middle of the map
CREST_AZIMUTHS = 3600
SEEN_AZIMUTHS = 1 << 14  # of a rendered skyline: 0.022 degrees, a quarter of a pixel
Rng = np.random.Generator


class Drawn(NamedTuple):
    """The true ground of a frame, and what was drawn for it."""

    terrain: Terrain
    facts: dict[str, object]
    brightness: GroundBrightness | None = None  # None: as the terrain's


@dataclass(frozen=True)
class Case:
    """Frames of one kind; the shares of the sky take turns."""

    frames: int
    terrain: str = "shackleton"  # the map: a shipped terrain file
    shares: tuple[float, ...] = (0.07, 0.3)  # of the sky in the background
    keys: Mapping[str, str] = field(default_factory=dict)  # of the map's file, changed from those of `terrain`
    fine_map: str = ""  # the ground's map, before those of the file; its file is otherwise the same
    place: Callable[[HeightMap, int, Rng], tuple[float, float]] | None = None  # east, north [m]; None: anywhere
    ground: Callable[[Terrain, Array, Rng], Drawn] = lambda stated, place_m, rng: Drawn(stated, {})
    waves_deg: Callable[[HeightMap], Array] | None = None  # what a file with the whole truth states of the waves
    light_e: Callable[[View, Rng], tuple[Array, dict[str, object]]] | None = None  # added, and what was drawn for it
    time_sigma_s: float = 0.0
    pair: str = ""  # the case with the same places and noise; "": none


def cases_of(reference: Path | None) -> dict[str, Case]:
    """All cases by name; `reference` is a table of azimuth and elevation [degrees] of a traced horizon, or None."""
    first = {} if reference is None else {"reference": reference_case(reference)}
    smooth = {f"drawn-{width}": Case(20, place=floor, ground=drawn(width), waves_deg=stated_waves(width)) for width in
              (5, 20, 60)}  # fmt: skip
    return first | smooth | {
        "posts-3km": Case(20, place=floor, ground=posts_that_agree, waves_deg=waves_of_posts),
        "seam": Case(20, place=floor, ground=seam),
        "dark": Case(20, "shackleton-thesis"),
        "bright": Case(20, "shackleton-thesis", ground=patches, pair="dark"),
        "lit-strip": Case(20, "shackleton-thesis", (0.07,), light_e=strip),
        "lit-wall": Case(20, "shackleton-thesis", (0.07,), light_e=fading_wall),
        "turned": Case(20, place=floor, ground=turned, time_sigma_s=1.0),
        "site01": Case(4 * SITE01_PLACES, keys=SITE01_KEYS, fine_map="site01-10m.tif", place=site01_place),
    }  # fmt: skip


def floor(stated: HeightMap, number: int, rng: Rng) -> tuple[float, float]:
    """A place on the floor."""
    east_m, north_m = draw_position(stated, FLOOR_M, FLOOR_SLOPE_RAD, rng)
    return float(east_m), float(north_m)


def site01_place(stated: HeightMap, number: int, rng: Rng) -> tuple[float, float]:
    """One of three places, four frames each."""
    own = np.random.default_rng(number // 4)
    east_m, north_m = draw_position(stated, SITE01_M, FLOOR_SLOPE_RAD, own)
    return float(east_m), float(north_m)


def reference_case(path: Path) -> Case:
    """A horizon that another program traced on finer maps, at the one place where it did."""
    table = np.genfromtxt(path, delimiter=",", names=True)

    def ground(stated: Terrain, place_m: Array, rng: Rng) -> Drawn:
        def rise(azimuth: Array) -> Array:
            horizon = np.interp(np.degrees(azimuth), table["azimuth_deg"], table["elevation_deg"], period=360.0)
            return np.asarray(np.radians(horizon) - stated.without_table().horizon_rad(place_m, azimuth))

        return Drawn(Risen(stated, rise), {})

    keys = {"camera_height_m": f"{REFERENCE_CAMERA_M}"}
    return Case(24, keys=keys, place=lambda stated, number, rng: REFERENCE_PLACE_M, ground=ground)


def wave_sigmas_rad(smooth_deg: float) -> Array:
    """Sigma [rad] of the cosine and of the sine of each of WAVES: white errors under a Gaussian of that sigma.

    The errors have a mean of zero and an expected RMS of SIGMA_RAD.
    """
    power = np.exp(-np.square(WAVES * np.radians(smooth_deg)))
    return np.asarray(SIGMA_RAD * np.sqrt(power / power.sum()))


def stated_waves(smooth_deg: float) -> Callable[[HeightMap], Array]:
    """The first of these sigmas [degrees]."""
    return lambda stated: np.degrees(wave_sigmas_rad(smooth_deg)[:STATED_WAVES])


def drawn(smooth_deg: float) -> Callable[[Terrain, Array, Rng], Drawn]:
    """A map whose horizon has smooth errors."""

    def ground(stated: Terrain, place_m: Array, rng: Rng) -> Drawn:
        cos, sin = wave_sigmas_rad(smooth_deg) * rng.standard_normal((2, len(WAVES)))

        def rise(azimuth: Array) -> Array:
            phase = np.multiply.outer(azimuth, WAVES)
            return np.asarray(np.cos(phase) @ cos + np.sin(phase) @ sin)

        waves = np.degrees([cos[:STATED_WAVES], sin[:STATED_WAVES]]).tolist()
        return Drawn(Risen(stated, rise), {"cos_deg": waves[0], "sin_deg": waves[1]})

    return ground


def crests_from(stated: Terrain, place_m: Array, azimuths: int) -> tuple[Array, Array, Array]:
    """Azimuths (n,) [rad], crests (n, 2) [m] from a place, and the rise (n,) of the horizon with theirs [rad/m]."""
    assert isinstance(stated, HeightMap)
    azimuth = np.linspace(0.0, 2 * np.pi, azimuths, endpoint=False)
    tan, distance_m, _ = stated.without_table().horizons(place_m, azimuth)
    crest_m = distance_m[:, None] * np.stack([np.sin(azimuth), np.cos(azimuth)], axis=-1)
    return azimuth, crest_m, 1.0 / (1.0 + np.square(tan)) / distance_m


def curve_of(azimuth: Array, error_rad: Array) -> Curve:
    """A rise between the rows of a table."""
    return lambda at: np.interp(at, azimuth, error_rad, period=2 * np.pi)


def posts_that_agree(stated: Terrain, place_m: Array, rng: Rng) -> Drawn:
    """Errors of heights that fall off as a Gaussian of 3 km with the distance between posts."""
    azimuth, crest_m, rad_per_m = crests_from(stated, place_m, CREST_AZIMUTHS)
    wave, phase = rng.standard_normal((2, PLANE_WAVES)) / POST_REACH_M, rng.uniform(0, 2 * np.pi, PLANE_WAVES)
    height_m = POST_SIGMA_M * np.sqrt(2 / PLANE_WAVES) * np.cos(crest_m @ wave + phase).sum(axis=-1)
    return Drawn(Risen(stated, curve_of(azimuth, height_m * rad_per_m)), {})


def waves_of_posts(stated: HeightMap) -> Array:
    """The sigmas [degrees] of the waves that such errors make, seen from the origin."""
    azimuth, crest_m, rad_per_m = crests_from(stated, np.zeros(2), 720)
    apart2 = np.square(crest_m[:, None] - crest_m).sum(axis=-1) / POST_REACH_M**2
    covariance = POST_SIGMA_M**2 * np.exp(-0.5 * apart2) * np.multiply.outer(rad_per_m, rad_per_m)
    phase = np.multiply.outer(WAVES[:STATED_WAVES], azimuth)
    parts = [wave(phase) * 2 / len(azimuth) for wave in (np.cos, np.sin)]
    variance = [np.einsum("mi,ij,mj->m", part, covariance, part) for part in parts]
    return np.degrees(np.sqrt(np.mean(variance, axis=0)))


def seam(stated: Terrain, place_m: Array, rng: Rng) -> Drawn:
    """Half of the horizon from another map, that much too high or too low."""
    off_m, middle = rng.uniform(*SEAM_OFF_M) * rng.choice([-1.0, 1.0]), rng.uniform(0, 2 * np.pi)
    azimuth, crest_m, rad_per_m = crests_from(stated, place_m, CREST_AZIMUTHS)
    flat = rad_per_m * np.hypot(*crest_m.T)  # cos^2 H
    error = np.where(np.abs(turn(azimuth, middle)) < np.pi / 2, off_m * flat / SEAM_M, 0.0)
    facts: dict[str, object] = {"off_m": off_m, "middle_deg": float(np.degrees(middle))}
    return Drawn(Risen(stated, curve_of(azimuth, error)), facts)


class Seen(ForwardingTerrain):
    """The ground with the skyline of one place, traced once: rendering asks for it at each star."""

    def __init__(self, whole: Terrain, place_m: Array) -> None:
        super().__init__(whole)
        azimuth = np.linspace(0.0, 2 * np.pi, SEEN_AZIMUTHS, endpoint=False)
        self.skyline = curve_of(azimuth, whole.without_table().horizon_rad(place_m, azimuth))

    def horizon_rad(self, points_m: Array, azimuths_rad: Array) -> Array:
        return self.skyline(np.asarray(azimuths_rad))


class Turned(ForwardingTerrain):
    """The ground whose map is turned about the vertical at the camera; places are those on the map."""

    def __init__(self, whole: Terrain, by_rad: float) -> None:
        super().__init__(whole)
        self.by_rad = by_rad

    def horizon_rad(self, points_m: Array, azimuths_rad: Array) -> Array:
        return self.whole.horizon_rad(points_m, np.asarray(azimuths_rad) + self.by_rad)


def turned(stated: Terrain, place_m: Array, rng: Rng) -> Drawn:
    """A map that is turned by up to two degrees."""
    by_deg = rng.uniform(*TURN_DEG) * rng.choice([-1.0, 1.0])
    return Drawn(Turned(stated, float(np.radians(by_deg))), {"turned_deg": by_deg})


def patches(stated: Terrain, place_m: Array, rng: Rng) -> Drawn:
    """Ground in such patches."""
    brightness = draw_brightness(rng)
    return Drawn(stated, {"size_deg": float(np.degrees(brightness.size_rad))}, brightness)


def draw_brightness(rng: Rng) -> GroundBrightness:
    """Patches of 5 to 60 degrees, each 0.3 to 3 times as bright as the sky."""
    size_deg, seed = rng.uniform(5.0, 60.0), int(rng.integers(1 << 30))
    return GroundBrightness.of({"low": 0.3, "high": 3.0, "size_deg": size_deg, "seed": seed})


def below_crest(view: View, rng: Rng) -> tuple[Array, Array, dict[str, object]]:
    """Pixels (H, W) above the skyline, which azimuths are lit (H, W), and where these are."""
    height_px = view.above_rad / np.hypot(*np.gradient(view.above_rad))
    middle, width = rng.uniform(0, 2 * np.pi), np.radians(rng.uniform(*LIT_DEG))
    lit = np.asarray((np.abs(turn(view.azimuth_rad, middle)) < width / 2) & (view.inside > 0))
    return height_px, lit, {"middle_deg": float(np.degrees(middle)), "width_deg": float(np.degrees(width))}


def strip(view: View, rng: Rng) -> tuple[Array, dict[str, object]]:
    """Light [e] of a strip of 1 to 3 px below the crest, 3 to 9 e, over 60 to 120 degrees."""
    height_px, lit, facts = below_crest(view, rng)
    thick_px, light_e = rng.uniform(1.0, 3.0), rng.uniform(3.0, 9.0)
    light = np.clip(0.5 - height_px, 0, 1) * np.clip(height_px + thick_px + 0.5, 0, 1) * lit * light_e
    return light, facts | {"thick_px": thick_px, "light_e": light_e}


def fading_wall(view: View, rng: Rng) -> tuple[Array, dict[str, object]]:
    """Light [e] of a wall that shines with 1 to 9 e at the crest and fades over 2 to 10 px below it."""
    height_px, lit, facts = below_crest(view, rng)
    fade_px, light_e = rng.uniform(2.0, 10.0), rng.uniform(1.0, 9.0)
    light = np.clip(0.5 - height_px, 0, 1) * np.exp(np.minimum(height_px, 0) / fade_px) * lit * light_e
    return light, facts | {"fade_px": fade_px, "light_e": light_e}
