"""A depth of a crater that its file states wrongly or not at all: evidence by stars is simulated, not images."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from localization_helpers import locate_or_refuse

from startrack.camera import load_camera
from startrack.catalog import load_catalog
from startrack.chain import StarRays, locate_rays
from startrack.core.types import Fix, NotLocated
from startrack.rendering import Scene, Series
from startrack.simulation import simulate_rays
from startrack.terrain import Cylinder, load_terrain

FRAMES = 4


@pytest.fixture(scope="module")
def series() -> Series:
    terrain, catalog = load_terrain("shackleton-thesis"), load_catalog().brighter_than(8.0)
    return Series(camera=load_camera("fisheye-2048"), terrain=terrain, catalog=catalog, seed=515, faint_v_mag=None)


def rays_of(series: Series, steeper: float, number: int, stated: bool) -> tuple[Scene, StarRays]:
    """Stars above a crater deeper by a part than its file says, as exact where it is `stated`."""
    crater = series.terrain
    assert isinstance(crater, Cylinder)
    scene, rng = series.scene(number)
    scene = replace(scene, terrain=replace(crater, depth_m=crater.depth_m * (1 + steeper)))
    in_file = crater if stated else replace(crater, depth_sigma_m=None)
    return scene, simulate_rays(scene, series.catalog, in_file, rng=rng)


def error_m(fix: Fix, scene: Scene) -> float:
    return float(np.hypot(*(fix.position_enu_m - scene.position_enu_m)[:2]))


@pytest.mark.slow
@pytest.mark.parametrize("steeper", [-0.02, -0.004, 0.004, 0.02])
def test_a_depth_that_no_file_states_is_estimated_by_the_stars(series: Series, steeper: float):
    shown = 0
    for number in range(FRAMES):
        scene, rays = rays_of(series, steeper, number, stated=False)
        fix = locate_rays(rays).fix
        assert error_m(fix, scene) < fix.radius999_m
        assert [one.fact for one in fix.unstated] == ["depth_sigma_m"]
        for error in fix.shown:
            assert (error.name, error.fact) == ("depth_1", "depth_sigma_m")
            assert abs(error.value - steeper) < 4.5 * error.sigma < 0.01  # edges of stars: the tails are no normal ones
            shown += 1
    assert abs(steeper) < 0.01 or shown == FRAMES


def test_the_depth_of_the_file_stays_where_it_is_right(series: Series):
    for number in range(FRAMES):
        scene, rays = rays_of(series, 0.0, number, stated=False)
        fix = locate_rays(rays).fix
        assert fix.shown == ()
        assert error_m(fix, scene) < fix.radius999_m


@pytest.mark.parametrize("steeper", [-0.004, 0.004])
def test_a_depth_stated_as_exact_is_not_estimated(series: Series, steeper: float):
    """The picture contradicts it, or the error is within the circle."""
    refused = 0
    for number in range(FRAMES):
        scene, rays = rays_of(series, steeper, number, stated=True)
        fix, reason = locate_or_refuse(rays.evidence(), rays.terrain)
        if fix is None:
            assert reason == "inconsistent_evidence"
            refused += 1
            continue
        assert fix.shown == fix.unstated == ()
        assert error_m(fix, scene) < fix.radius999_m
    assert refused >= FRAMES // 2


@pytest.mark.parametrize("steeper", [-0.02, 0.02])
def test_a_stated_depth_that_is_far_off_is_refused(series: Series, steeper: float):
    for number in range(FRAMES):
        with pytest.raises(NotLocated) as refusal:
            locate_rays(rays_of(series, steeper, number, stated=True)[1])
        assert refusal.value.reason == "inconsistent_evidence"
