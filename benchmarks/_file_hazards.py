"""Hazards of the files: a camera, a terrain or a time that is not the true one, without an error that admits it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from _sky_view import Hazard, Rng

from startrack.camera import Camera
from startrack.rendering import Scene
from startrack.terrain import Cylinder, Terrain

MINUTE_S, HOUR_S = 60.0, 3600.0


def wrong_focal(low: float, high: float, *, axes: int = 1) -> Callable[[Camera, Scene, Rng], Camera]:
    """Focal lengths wrong by a part between two: both, or the second against the first (`axes` 2)."""

    def state(camera: Camera, scene: Scene, rng: Rng) -> Camera:
        fx, fy = camera.focal_px
        factor = factor_between(low, high, rng)
        return replace(camera, focal_px=(fx * (factor if axes == 1 else 1.0), fy * factor))

    return state


def wrong_centre(low_px: float, high_px: float) -> Callable[[Camera, Scene, Rng], Camera]:
    """A principal point off by a distance between two."""

    def state(camera: Camera, scene: Scene, rng: Rng) -> Camera:
        way = rng.uniform(low_px, high_px) * np.exp(1j * rng.uniform(0, 2 * np.pi))
        return replace(camera, centre_px=(camera.centre_px[0] + way.real, camera.centre_px[1] + way.imag))

    return state


def wrong_crater(low: float, high: float, *, of: str) -> Callable[[Terrain, Rng], Terrain]:
    """A crater whose `of` (depth_m or diameter_m) is wrong by a part between two."""

    def state(terrain: Terrain, rng: Rng) -> Terrain:
        assert isinstance(terrain, Cylinder)
        return replace(terrain, **{of: getattr(terrain, of) * factor_between(low, high, rng)})

    return state


def other_crater(terrain: Terrain, rng: Rng) -> Terrain:
    """A crater of another depth and diameter."""
    assert isinstance(terrain, Cylinder)
    return replace(terrain, depth_m=terrain.depth_m * rng.uniform(0.5, 0.8), diameter_m=0.8 * terrain.diameter_m)


def wrong_clock(offset_s: float) -> Callable[[Rng], float]:
    """A clock that is fast or slow by that much."""
    return lambda rng: float(offset_s * rng.choice([-1.0, 1.0]))


def factor_between(low: float, high: float, rng: Rng) -> float:
    """A factor wrong by a part between two, either way."""
    return float(1.0 + rng.uniform(low, high) * rng.choice([-1.0, 1.0]))


H = Hazard
CAMERA_HAZARDS = {
    "focal length 0.05 to 0.2 % wrong": H(stated=wrong_focal(0.0005, 0.002)),
    "focal length 0.3 to 0.5 % wrong": H(stated=wrong_focal(0.003, 0.005)),
    "lens 1 to 5 % wrong": H(stated=wrong_focal(0.01, 0.05)),
    "focal lengths of the axes 0.1 to 2 % apart": H(stated=wrong_focal(0.001, 0.02, axes=2)),
    "principal point 0.5 to 2 px off": H(stated=wrong_centre(0.5, 2)),
    "principal point 4 to 60 px off": H(stated=wrong_centre(4, 60)),
}
TERRAIN_HAZARDS = {
    "depth 0.1 to 0.5 % wrong": H(terrain=wrong_crater(0.001, 0.005, of="depth_m")),
    "depth 1 to 5 % wrong": H(terrain=wrong_crater(0.01, 0.05, of="depth_m")),
    "diameter 1 to 5 % wrong": H(terrain=wrong_crater(0.01, 0.05, of="diameter_m")),
    "another crater": H(terrain=other_crater),
}
CLOCK_HAZARDS = {
    "clock off by 10 minutes": H(clock_s=wrong_clock(10 * MINUTE_S)),
    "clock off by 1 hour": H(clock_s=wrong_clock(HOUR_S)),
    "clock off by 6 hours": H(clock_s=wrong_clock(6 * HOUR_S)),
    "clock off by 24 hours": H(clock_s=wrong_clock(24 * HOUR_S)),
}
