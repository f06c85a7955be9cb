"""The exposure with which an installation checks itself."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from startrack.camera import Camera, load_camera
from startrack.catalog import load_catalog
from startrack.render.compose import render
from startrack.render.series import Series
from startrack.terrain import Terrain
from startrack.types import Array, Exposure

FAINTEST_V_MAG = 8.5


def self_test_exposure(terrain: Terrain, *, rng: np.random.Generator) -> tuple[Exposure, Camera, Array]:
    """An exposure at a random place and time, its camera (fisheye-2048 at half size), and the true place (3,) [m]."""
    whole = load_camera("fisheye-2048")
    width, height = whole.size_px
    camera = replace(
        whole,
        name="self-test",
        size_px=(width // 2, height // 2),
        focal_px=(whole.focal_px[0] / 2, whole.focal_px[1] / 2),
        centre_px=((whole.centre_px[0] - 0.5) / 2, (whole.centre_px[1] - 0.5) / 2),
    )
    series = Series(
        camera=camera,
        terrain=terrain,
        catalog=load_catalog().brighter_than(FAINTEST_V_MAG),
        seed=int(rng.integers(2**31)),
        faint_v_mag=None,
        hot_pixels=50,
    )
    scene, own_rng = series.scene(0, camera.name)
    exposure, truth = render(scene, rng=own_rng)
    return exposure, camera, truth.position_enu_m
