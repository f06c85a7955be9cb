"""Draws of hazards of the ground and of the clock: functions that make one of given limits."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from _hazard_class import SHAPE_SIGMA, Ground, Rng
from _hazard_grounds import Risen, SecondWall, Stretched, box_rise, crater_with, ridge_rise, wavy_crater
from _map_draws import draw_ground

from startrack.terrain import Cylinder, Terrain


def box(width_deg: float, low_deg: float = 0.3, high_deg: float = 5.0) -> Ground:
    """A box on no map, of a height between two (even in its logarithm)."""

    def ground(stated: Terrain, rng: Rng) -> Terrain:
        height = np.exp(rng.uniform(np.log(low_deg), np.log(high_deg)))
        return Risen(stated, box_rise(rng.uniform(0, 2 * np.pi), *np.radians([width_deg, height])))

    return ground


def ridge(width_deg: tuple[float, float], height_deg: tuple[float, float]) -> Ground:
    """A triangular ridge on no map."""

    def ground(stated: Terrain, rng: Rng) -> Terrain:
        size = np.radians([rng.uniform(*width_deg), rng.uniform(*height_deg)])
        return Risen(stated, ridge_rise(rng.uniform(0, 2 * np.pi), *size))

    return ground


def notch(width_deg: tuple[float, float], depth_deg: tuple[float, float]) -> Ground:
    """A gap that the map has filled: a box of a depth between two (even in its logarithm)."""

    def ground(stated: Terrain, rng: Rng) -> Terrain:
        width, depth = rng.uniform(*width_deg), np.exp(rng.uniform(*np.log(depth_deg)))
        return Risen(stated, box_rise(rng.uniform(0, 2 * np.pi), *np.radians([width, -depth])))

    return ground


def dip(width_deg: tuple[float, float], depth_deg: tuple[float, float]) -> Ground:
    """A crest that the map has too high: a triangle."""

    def ground(stated: Terrain, rng: Rng) -> Terrain:
        size = np.radians([rng.uniform(*width_deg), -rng.uniform(*depth_deg)])
        return Risen(stated, ridge_rise(rng.uniform(0, 2 * np.pi), *size))

    return ground


def second_wall(stated: Terrain, rng: Rng) -> Terrain:
    """A second wall over 100 to 200 degrees, as if seen from a place 50 to 1000 m off."""
    away = np.exp(rng.uniform(np.log(50), np.log(1000)))
    way = rng.uniform(0, 2 * np.pi)
    return SecondWall(
        stated, away * np.array([np.sin(way), np.cos(way)]), rng.uniform(0, 2 * np.pi),
        np.radians(rng.uniform(100, 200)),
    )  # fmt: skip


def shape(*names: str, low: float, high: float, signs: str = "any") -> Ground:
    """A crater whose errors of these names are between two sizes; `signs` any, same, or opposite."""

    def ground(stated: Terrain, rng: Rng) -> Terrain:
        sign = rng.choice([-1.0, 1.0], len(names))
        if signs != "any":
            sign[1:] = sign[0] if signs == "same" else -sign[0]
        size = rng.uniform(low, high, len(names)) if signs != "same" else np.full(len(names), rng.uniform(low, high))
        assert isinstance(stated, Cylinder)
        return crater_with(stated, dict(zip(names, sign * size, strict=True)))

    return ground


def turned(*names: str, size: float) -> Ground:
    """A crater whose errors of a pair of names have that size together, in any direction."""

    def ground(stated: Terrain, rng: Rng) -> Terrain:
        way = rng.uniform(0, 2 * np.pi)
        assert isinstance(stated, Cylinder)
        return crater_with(stated, dict(zip(names, size * np.array([np.sin(way), np.cos(way)]), strict=True)))

    return ground


def ellipse(size: float) -> Ground:
    """Radii longer and shorter by that part."""
    return turned("ellipse_cos_1", "ellipse_sin_1", size=size)


def tilt(size_deg: float) -> Ground:
    """A rim in a plane that is tilted."""
    return turned("rim_tilt_east_rad", "rim_tilt_north_rad", size=float(np.radians(size_deg)))


def normal_shape(stated: Terrain, rng: Rng) -> Terrain:
    """A crater whose depth and diameter have the errors that the file states."""
    assert isinstance(stated, Cylinder)
    return crater_with(stated, dict(zip(("depth_1", "diameter_1"), rng.normal(0.0, SHAPE_SIGMA, 2), strict=True)))


def waves(stated: Terrain, rng: Rng) -> Terrain:
    """Smooth waves of the rim, 25 m (RMS)."""
    assert isinstance(stated, Cylinder)
    return wavy_crater(stated, 25.0, rng)


def stretched(size: float) -> Ground:
    """A horizon too high or too low by that part."""
    return lambda stated, rng: Stretched(stated, size * rng.choice([-1.0, 1.0]))


def posts_wrong_by(sigma_m: float) -> Ground:
    """The ground of a map whose posts have other errors than it states."""
    return lambda stated, rng: draw_ground(stated, sigma_m, rng)  # type: ignore[arg-type]


def both(first: Ground, second: Ground) -> Ground:
    """Two hazards, the second one on the ground with the first."""
    return lambda stated, rng: second(first(stated, rng), rng)


def clock_of(sigma_s: float) -> Callable[[Rng], float]:
    """A clock wrong by a normal error."""
    return lambda rng: float(rng.normal(0.0, sigma_s))


def clock_off(offset_s: float) -> Callable[[Rng], float]:
    """A clock that is fast or slow by that much."""
    return lambda rng: float(offset_s * rng.choice([-1.0, 1.0]))
