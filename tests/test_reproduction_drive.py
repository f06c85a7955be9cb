"""Depth and positions along a straight drive, by the outermost stars."""

import numpy as np
import pytest

from startrack.applications.reproduction.comparison import estimate_drive
from startrack.applications.reproduction.published.kua_drive import (
    DRIVE_M,
    ODOMETRY_SIGMA_1,
    STOPS,
    draw_drive,
    locate_by_drive,
    outermost_stars,
)
from startrack.applications.reproduction.scene import Scene
from startrack.applications.reproduction.simulator import crater, draw_positions
from startrack.core.types import MIDDLES_RAD, SECTORS, NotLocated
from startrack.localization import hull_position

CRATER = crater()


def test_a_drive_is_straight_ends_at_the_place_and_stays_inside():
    for k, place in enumerate(draw_positions(0, 0, 0, 50)):
        drive = draw_drive(place, CRATER.radius_m, rng=np.random.default_rng(k))
        np.testing.assert_array_equal(drive.positions_m[-1], place)
        assert np.hypot(*drive.positions_m.T).max() < CRATER.radius_m
        legs = np.diff(drive.positions_m, axis=0)
        np.testing.assert_allclose(legs, legs[0] * np.ones((STOPS - 1, 1)), atol=1e-6)
        assert np.hypot(*legs.sum(axis=0)) == pytest.approx(DRIVE_M)
        assert np.std(np.hypot(*drive.legs_m.T) / np.hypot(*legs.T)) < 3 * ODOMETRY_SIGMA_1


@pytest.mark.parametrize("number", range(3))
def test_exact_skylines_give_the_exact_depth_and_positions(number):
    place = draw_positions(0, 0, number, number + 1)[0]
    drive = draw_drive(place, CRATER.radius_m, rng=np.random.default_rng(0))
    ways = np.stack([np.sin(MIDDLES_RAD), np.cos(MIDDLES_RAD)], axis=-1)
    horizons = [CRATER.horizon_rad(np.tile(stop, (SECTORS, 1)), MIDDLES_RAD) for stop in drive.positions_m]
    vectors = [ways / np.tan(one)[:, None] for one in horizons]
    positions, depth = locate_by_drive(vectors, np.diff(drive.positions_m, axis=0), CRATER.radius_m)
    np.testing.assert_allclose(positions, drive.positions_m, atol=0.01)
    assert depth == pytest.approx(CRATER.depth_m, abs=0.01)


def test_the_outermost_stars_are_those_of_the_hull():
    scene = Scene(0, 0, 0)
    x, y = CRATER.wall_m * outermost_stars(scene.points_m[scene.seen], CRATER.wall_m).T
    a = np.stack([np.ones_like(x), -2 * x, -2 * y], axis=1)
    q, *_ = np.linalg.lstsq(a, CRATER.radius_m**2 - x * x - y * y, rcond=None)
    hull = hull_position(scene.points_m[scene.seen], CRATER.wall_m, CRATER.radius_m)
    np.testing.assert_allclose(-q[1:], hull, atol=1e-6)
    with pytest.raises(NotLocated, match="2 seen stars"):
        outermost_stars(scene.points_m[:2], CRATER.wall_m)


def test_outermost_stars_above_the_skyline_give_too_deep_a_crater():
    """All errors have one sign: a higher skyline is a deeper crater. The published error of the depth is 110 m."""
    scenes = [Scene(0, sky, 0) for sky in range(6)]
    found = [estimate_drive(scene) for scene in scenes]
    depths = np.array([depth for _, depth in found]) - CRATER.depth_m
    assert (depths > 0).all() and 55 < depths.mean() < 220
    errors = [np.hypot(*(position - scene.truth_m)) for (position, _), scene in zip(found, scenes, strict=True)]
    assert np.mean(errors) < 800
