"""Drives: poses along waypoints, odometry of stated errors, and refusals."""

from itertools import pairwise

import numpy as np
import pytest
from render_helpers import CRATER, FISHEYE

from startrack.applications.tracking import Odometry
from startrack.core.errors import BadInput
from startrack.estimation.observations import OdometryErrors
from startrack.frames import R_body_enu_from_heading_pitch_roll, heading_pitch_roll_from_R_body_enu, parse_utc
from startrack.rendering import Drive, Series, draw_odometry, read_drive

EAST_THEN_NORTH = Drive(waypoints_m=[[0, 0], [100, 0], [100, 50]], speed_m_s=0.5)


def series(**changes):
    fields = {"camera": FISHEYE, "terrain": CRATER, "catalog": None, "seed": 4, "every_s": 60.0}
    return Series(**{**fields, **changes})


def test_frames_are_at_equal_steps_along_the_waypoints_with_the_nose_forward():
    drive = EAST_THEN_NORTH
    assert drive.count_frames(60.0) == 6  # 150 m at 30 m a step
    places = np.array([drive.position_m(60.0 * k) for k in range(6)])
    np.testing.assert_allclose(places, [[0, 0], [30, 0], [60, 0], [90, 0], [100, 20], [100, 50]], atol=1e-9)
    headings = np.degrees([drive.heading_rad(60.0 * k) for k in range(6)])
    np.testing.assert_allclose(headings, [90, 90, 90, 90, 0, 0])
    assert drive.heading_rad(200.0) == 0.0  # at the corner: of the line that begins there
    west = Drive(waypoints_m=[[0, 0], [-1, 0], [-2, 1], [-2, 0]], speed_m_s=1.0)
    np.testing.assert_allclose(np.degrees([west.heading_rad(t) for t in (0.5, 2.0, 3.0)]), [270, 315, 180])


def test_steps_that_rounding_could_lose_are_counted():
    drive = Drive(waypoints_m=[[0, 0], [0.3, 0]], speed_m_s=0.1)
    assert drive.count_frames(1.0) == 4  # 0.3 / 0.1 is 2.9999999999999996
    assert Drive(waypoints_m=[[0, 0], [0, 14]], speed_m_s=1.0).count_frames(5.0) == 3


def test_poses_of_a_drive_have_its_times_places_headings_and_the_ground_below():
    start = parse_utc("2030-01-01T00:00:00Z")
    poses = [series(drive=EAST_THEN_NORTH, time_utc=start, max_tilt_rad=0.05).pose(k) for k in range(6)]
    assert [(pose.time_utc - start).total_seconds() for pose in poses] == [0, 60, 120, 180, 240, 300]
    np.testing.assert_allclose([pose.position_enu_m[2] for pose in poses], 1.5)
    angles = np.array([heading_pitch_roll_from_R_body_enu(pose.R_body_enu) for pose in poses])
    np.testing.assert_allclose(angles[:, 0] % (2 * np.pi), np.radians([90, 90, 90, 90, 0, 0]), atol=1e-9)
    tilts = np.hypot(angles[:, 1], angles[:, 2])
    assert 0 < tilts.min() < tilts.max() <= 0.05
    level = series(drive=EAST_THEN_NORTH, pitch_rad=0.0, roll_rad=0.0).pose(3)
    np.testing.assert_allclose(level.R_body_enu, R_body_enu_from_heading_pitch_roll(np.pi / 2, 0, 0), atol=1e-9)


def test_at_rest_only_the_time_changes():
    rest = series()
    first, *others = [rest.pose(k) for k in range(4)]
    for k, pose in enumerate(others, start=1):
        np.testing.assert_array_equal(pose.position_enu_m, first.position_enu_m)
        np.testing.assert_array_equal(pose.R_body_enu, first.R_body_enu)
        assert (pose.time_utc - first.time_utc).total_seconds() == 60 * k
    alone = series(every_s=None)  # the first exposure is that of a series without steps of time
    np.testing.assert_array_equal(alone.pose(0).position_enu_m, first.position_enu_m)
    assert alone.pose(0).time_utc == first.time_utc
    assert np.linalg.norm(alone.pose(1).position_enu_m - first.position_enu_m) > 1


@pytest.mark.parametrize(("sigma_1", "floor_m", "step_m"), [(0.02, 0.05, 50.0), (0.0, 0.05, 10.0), (0.1, 0.0, 3.0)])
def test_increments_of_the_odometry_have_independent_errors_of_the_stated_size(sigma_1, floor_m, step_m):
    n = 3000
    rng = np.random.default_rng(8)
    heading = np.cumsum(rng.normal(0, 0.3, n))
    R_body_enu = np.array([R_body_enu_from_heading_pitch_roll(h, *rng.normal(0, 0.05, 2)) for h in heading])
    step = step_m * np.column_stack([np.sin(heading), np.cos(heading), np.zeros(n)])
    position_enu_m = np.cumsum(step, axis=0) + np.array([300.0, -4000.0, 1.5])
    position_m, R_odom_body = draw_odometry(
        position_enu_m, R_body_enu, errors=OdometryErrors(sigma_1, floor_m), rng=rng
    )
    np.testing.assert_allclose(position_m[0], 0, atol=1e-12)
    R_odom_enu = R_odom_body @ R_body_enu
    np.testing.assert_allclose(R_odom_enu, np.broadcast_to(R_odom_enu[0], R_odom_enu.shape), atol=1e-12)
    np.testing.assert_allclose(R_odom_enu[0, 2], [0, 0, 1], atol=1e-12)  # level
    assert np.linalg.norm(R_odom_enu[0] - np.eye(3)) > 0.1  # but not enu

    error_m = (np.diff(position_m, axis=0) @ R_odom_enu[0] - np.diff(position_enu_m, axis=0)) / np.hypot(
        sigma_1 * step_m, floor_m
    )
    np.testing.assert_allclose(error_m[:, 2], 0, atol=1e-6)
    covariance = np.cov(error_m[:, :2].T)
    limit = 4 * np.sqrt(2 / n)  # four sigma of a variance from n draws
    np.testing.assert_allclose(covariance, np.eye(2), atol=limit)
    assert abs(np.mean(error_m[1:, :2] * error_m[:-1, :2])) < limit
    assert np.abs(error_m[:, :2].mean(axis=0)).max() < 4 / np.sqrt(n)


def test_without_errors_the_odometry_gives_the_true_increments_in_the_body_frame():
    drive = series(drive=EAST_THEN_NORTH)
    poses = [drive.pose(k) for k in range(6)]
    position_m, R_odom_body = drive.odometry(poses, OdometryErrors(0.0, 0.0))
    from scipy.spatial.transform import Rotation

    times = np.arange(6) * 60.0
    odometry = Odometry(time_s=times, position_m=position_m, quat_xyzw=Rotation.from_matrix(R_odom_body).as_quat())
    true = [now.R_body_enu @ (then.position_enu_m - now.position_enu_m) for now, then in pairwise(poses)]
    np.testing.assert_allclose(odometry.increments_body_m(times), true, atol=1e-9)
    again, _ = drive.odometry(poses, OdometryErrors(0.02, 0.05))
    once_more, _ = drive.odometry(poses[:3], OdometryErrors(0.02, 0.05))
    np.testing.assert_array_equal(again[:3], once_more)
    assert not np.allclose(again, series(drive=EAST_THEN_NORTH, seed=5).odometry(poses, OdometryErrors(0.02, 0.05))[0])


def test_waypoints_are_read_by_the_names_of_their_columns(tmp_path):
    path = tmp_path / "path.csv"
    path.write_text("\ufeffname, north_m ,east_m\r\nstart,1,2\r\n\r\nend,3.5,-4e1\r\n", encoding="utf-8")
    drive = read_drive(path, 0.1)
    np.testing.assert_array_equal(drive.waypoints_m, [[2, 1], [-40, 3.5]])
    assert drive.speed_m_s == 0.1


@pytest.mark.parametrize(
    ("text", "cause"),
    [
        ("", "first line does not name the columns east_m and north_m"),
        ("0,0\n1,1\n", "first line does not name the columns"),
        ("east_m,north_m,east_m\n0,0,0\n", "first line does not name"),
        ("east_m,north_m\n", r"0 waypoint\(s\): a path has at least two"),
        ("east_m,north_m\n1,2\n", r"1 waypoint\(s\): a path has at least two"),
        ("east_m,north_m\n1,2\n1,2\n", "waypoints 1 and 2 are the same"),
        ("east_m,north_m\n1,2\n1\n", "line 3: finite numbers are expected"),
        ("east_m,north_m\n1,2\n1,x\n", "line 3: finite numbers"),
        ("east_m,north_m\n1,2\n1,nan\n", "line 3: finite numbers"),
        ("east_m,north_m\n1,2\n1,inf\n", "line 3: finite numbers"),
        ("east_m,north_m\n0,0\n1e308,0\n", "a waypoint is infinite, or the path is"),
    ],
)
def test_a_path_that_cannot_be_driven_is_refused(tmp_path, text, cause):
    (tmp_path / "path.csv").write_text(text)
    with pytest.raises(BadInput, match=f"path.csv: .*{cause}") as refusal:
        read_drive(tmp_path / "path.csv", 0.1)
    assert refusal.value.reason == "bad_odometry"
    assert "\n" not in str(refusal.value)


def test_a_path_outside_the_search_area_or_of_too_few_or_too_many_frames_is_refused():
    away = Drive(waypoints_m=[[0, 0], [9000, 5000]], speed_m_s=1.0)
    with pytest.raises(
        BadInput, match=r"1 of 2 waypoints are outside the search area of crater, 10000 m .* 9000 m east"
    ):
        series(drive=away)
    for every_s, cause in ((301.0, "gives 1; 2 to 1000000"), (1e-5, "gives 30000001;")):
        with pytest.raises(BadInput, match=f"the path of 150 m takes 300 s at 0.5 m/s: .* {cause}"):
            EAST_THEN_NORTH.count_frames(every_s)
    with pytest.raises(ValueError, match="speed 0 m/s is not above 0"):
        Drive(waypoints_m=[[0, 0], [1, 0]], speed_m_s=0.0)
    with pytest.raises(ValueError, match="needs every_s"):
        series(drive=EAST_THEN_NORTH, every_s=None)
    with pytest.raises(BadInput, match="beyond the calendar"):
        series(every_s=1e12).pose(1)
