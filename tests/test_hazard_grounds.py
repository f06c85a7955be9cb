"""The true ground of the hazards: rims of any closed form against craters that are known, and against small steps."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hazard_helpers import box, crater_with, grounds, ridge, stretched, terrain_named

from startrack.terrain import Cylinder

AZIMUTHS = np.linspace(0.0, 2 * np.pi, 90, endpoint=False)
POINTS = np.array([[0.0, 0.0], [6000.0, -2500.0], [-4000.0, 8800.0]])
ERRORS = {
    "depth_1": 0.01, "diameter_1": -0.02, "ellipse_cos_1": 0.02, "ellipse_sin_1": -0.01, "rim_tilt_east_rad": 2e-3,
    "rim_tilt_north_rad": -1e-3,
}  # fmt: skip


@pytest.fixture(scope="module")
def crater() -> Cylinder:
    found = terrain_named("shackleton-thesis")
    assert isinstance(found, Cylinder)
    return found


@pytest.mark.parametrize(("depth_1", "diameter_1"), [(0.0, 0.0), (0.02, 0.0), (0.0, -0.01), (-0.03, 0.04)])
def test_depth_and_width_are_those_of_a_cylinder(crater: Cylinder, depth_1: float, diameter_1: float) -> None:
    other = replace(
        crater, depth_m=crater.depth_m * (1 + depth_1), diameter_m=crater.diameter_m * (1 + diameter_1)
    )  # fmt: skip
    found = crater_with({"depth_1": depth_1, "diameter_1": diameter_1})(crater).horizon_rad(POINTS[:, None], AZIMUTHS)
    np.testing.assert_allclose(found, other.horizon_rad(POINTS[:, None], AZIMUTHS), atol=1e-10)


def test_a_rim_of_any_form_is_met_where_small_steps_meet_it(crater: Cylinder) -> None:
    ground = crater_with(ERRORS)(crater)
    found = ground.horizon_rad(POINTS[:, None], AZIMUTHS)
    assert found.shape == (len(POINTS), len(AZIMUTHS))
    steps = np.arange(1.0, 25_000.0, 1.0)
    for point, horizons in zip(POINTS, found, strict=True):
        for azimuth, horizon in list(zip(AZIMUTHS, horizons, strict=True))[::7]:
            x, y = point[0] + steps * np.sin(azimuth), point[1] + steps * np.cos(azimuth)
            about = np.arctan2(x, y)
            first = np.flatnonzero(np.hypot(x, y) >= ground.wall.radius_m(about))[0]
            expected = np.arctan2(ground.wall.height_m(about[first]) - crater.camera_height_m, steps[first])
            assert horizon == pytest.approx(expected, rel=2e-3)
            assert horizon >= expected - 1e-9  # the step is beyond the wall


def test_a_tilted_rim_stands_in_a_plane(crater: Cylinder) -> None:
    ground = crater_with({"rim_tilt_east_rad": 1e-3})(crater)
    east, west = ground.horizon_rad(POINTS[0], np.radians([90.0, 270.0]))
    flat = crater.horizon_rad(POINTS[0], np.zeros(1))[0]
    assert np.tan(east) - np.tan(flat) == pytest.approx(1e-3, rel=1e-3)
    assert np.tan(west) - np.tan(flat) == pytest.approx(-1e-3, rel=1e-3)


def test_obstacles_stand_where_they_are_said_to(crater: Cylinder) -> None:
    azimuth = np.radians([70.0, 60.0, 55.0, 45.0, 200.0])
    flat = crater.horizon_rad(POINTS[1], azimuth)
    for make, rise_deg in ((box, [3, 3, 3, 0, 0]), (ridge, [3, 1.5, 0.75, 0, 0])):
        found = make(40, 3)(crater).horizon_rad(POINTS[1], azimuth)
        np.testing.assert_allclose(np.degrees(found - flat), rise_deg, atol=1e-9)
    np.testing.assert_allclose(np.tan(stretched(0.01)(crater).horizon_rad(POINTS[1], azimuth)), 1.01 * np.tan(flat))


def test_a_second_wall_never_lowers_the_horizon(crater: Cylinder) -> None:
    wall = grounds.SecondWall(crater, np.array([400.0, 300.0]), np.radians(90.0), np.radians(150.0))
    flat = crater.horizon_rad(POINTS[1], AZIMUTHS)
    risen = wall.horizon_rad(POINTS[1], AZIMUTHS) - flat
    assert (risen >= 0).all() and risen.max() > np.radians(0.3)
    outside = np.abs(grounds.turn(AZIMUTHS, np.radians(90.0))) > np.radians(75.5)
    assert (risen[outside] == 0).all()
