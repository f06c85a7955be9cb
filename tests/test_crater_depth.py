"""A depth of a crater that its file states wrongly, as the stars alone show it: evidence is simulated, not images."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from startrack.camera import load_camera
from startrack.catalog import load_catalog
from startrack.localization import ExactPosterior
from startrack.rendering import Scene, Series
from startrack.simulation import simulate_rays
from startrack.stages import StarFix, StarRays
from startrack.star_fix import check_by_stars, fix_unblocked, locate_rays
from startrack.terrain import Cylinder, load_terrain
from startrack.types import NotLocated

FRAMES = 4


@pytest.fixture(scope="module")
def series() -> Series:
    terrain, catalog = load_terrain("shackleton-thesis"), load_catalog().brighter_than(8.0)
    return Series(camera=load_camera("fisheye-2048"), terrain=terrain, catalog=catalog, seed=515, faint_v_mag=None)


def rays_of(series: Series, steeper: float, number: int) -> tuple[Scene, StarRays]:
    """Stars above a crater steeper by a part than its file states."""
    stated = series.terrain
    assert isinstance(stated, Cylinder)
    scene, rng = series.scene(number)
    scene = replace(scene, terrain=replace(stated, depth_m=stated.depth_m * (1 + steeper)))
    return scene, simulate_rays(scene, series.catalog, stated, rng=rng)


@pytest.mark.parametrize("steeper", [-0.004, 0.004])
def test_a_wrong_depth_is_estimated_by_the_stars(series: Series, steeper: float):
    estimated = 0
    for number in range(FRAMES):
        scene, rays = rays_of(series, steeper, number)
        fixed = locate_rays(rays)
        off_m = np.hypot(*(fixed.fix.position_enu_m - scene.position_enu_m)[:2])
        assert off_m < fixed.fix.radius999_m
        if fixed.steeper:
            estimated += 1
            assert fixed.steeper == pytest.approx(steeper, abs=0.003)
            assert fixed.fix.shape_1[0] == pytest.approx(steeper, abs=0.003)
            assert fixed.terrain.shape_sigma[0] == pytest.approx(abs(fixed.steeper))
    assert estimated >= FRAMES // 2


def test_the_stated_depth_stays_where_it_is_right(series: Series):
    depths = [locate_rays(rays_of(series, 0.0, number)[1]).steeper for number in range(FRAMES)]
    assert depths.count(0.0) >= FRAMES - 1


def test_a_depth_that_is_far_off_is_refused(series: Series):
    with pytest.raises(NotLocated) as refusal:
        locate_rays(rays_of(series, 0.02, 0)[1])
    assert refusal.value.reason == "inconsistent_evidence"


def test_a_depth_taken_as_right_is_not_questioned(series: Series):
    fixed = fix_unblocked(rays_of(series, 0.001, 0)[1], StarFix, ExactPosterior())
    assert check_by_stars(fixed, depth_is_right=True) is fixed
