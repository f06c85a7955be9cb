"""Odometry: TUM text, interpolated increments in the body frame, and refusals."""

import tracemalloc
from itertools import pairwise

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from startrack.applications.tracking import Odometry, odometry, read_odometry
from startrack.core.errors import BadInput
from startrack.frames import R_from_quat_xyzw, tum_line

START_S = 1_900_000_000.0
GOOD = ["0 0 0 0 0 0 0 1", "10 1 0 0 0 0 0 1", "20 2 1 0 0 0 0 1"]


def write(path, lines):
    path.write_text("\n".join(lines) + "\n")
    return path


def random_odometry(rng, n=12):
    return Odometry(
        time_s=START_S + np.cumsum(rng.uniform(0.5, 60.0, n)),
        position_m=np.cumsum(rng.normal(0, 5, (n, 3)), axis=0),
        quat_xyzw=Rotation.random(n, random_state=rng).as_quat(),
    )


def interpolate(odometry, time_s):
    """Position and rotation at one time, by the definition of slerp: a part of the rotation vector between poses."""
    k = int(np.clip(np.searchsorted(odometry.time_s, time_s, side="right") - 1, 0, len(odometry) - 2))
    part = (time_s - odometry.time_s[k]) / (odometry.time_s[k + 1] - odometry.time_s[k])
    first, last = (Rotation.from_quat(odometry.quat_xyzw[j]) for j in (k, k + 1))
    turned = first * Rotation.from_rotvec(part * (first.inv() * last).as_rotvec())
    return odometry.position_m[k] + part * (odometry.position_m[k + 1] - odometry.position_m[k]), turned.as_matrix()


@pytest.mark.parametrize("seed", range(5))
def test_increments_are_those_of_poses_interpolated_one_by_one(seed):
    rng = np.random.default_rng(seed)
    odometry = random_odometry(rng)
    first, last = odometry.time_s[[0, -1]]
    times = np.sort(np.concatenate([[first, last], odometry.time_s[3:5], rng.uniform(first, last, 20)]))
    expected = []
    for earlier, later in pairwise(times):
        (position0, R_frame_body), (position1, _) = interpolate(odometry, earlier), interpolate(odometry, later)
        expected.append(R_frame_body.T @ (position1 - position0))
    np.testing.assert_allclose(odometry.increments_body_m(times), expected, atol=1e-8)


def test_moves_of_a_few_frames_take_the_poses_about_them_alone():
    """The cost of a frame does not grow with the drive; the poses beyond change nothing."""
    rng = np.random.default_rng(8)
    whole = random_odometry(rng, 400)
    for first, last in ((0, 3), (150, 153), (396, 399)):
        times = np.sort(np.append(rng.uniform(*whole.time_s[[first, last]], 4), whole.time_s[first + 1]))
        about = whole._poses_about(times)
        assert about.stop - about.start <= 4
        part = Odometry(
            time_s=whole.time_s[about], position_m=whole.position_m[about], quat_xyzw=whole.quat_xyzw[about]
        )
        np.testing.assert_array_equal(whole.increments_body_m(times), part.increments_body_m(times))


def test_increments_do_not_depend_on_the_frame_of_the_odometry():
    rng = np.random.default_rng(7)
    odometry = random_odometry(rng)
    frame = Rotation.random(random_state=rng)
    moved = Odometry(
        time_s=odometry.time_s,
        position_m=frame.apply(np.array(odometry.position_m)) + np.array([1e4, -2e4, 300.0]),
        quat_xyzw=(frame * Rotation.from_quat(odometry.quat_xyzw)).as_quat(),
    )
    times = np.linspace(*odometry.time_s[[0, -1]], 31)
    np.testing.assert_allclose(moved.increments_body_m(times), odometry.increments_body_m(times), atol=1e-7)


def test_a_rover_that_drives_forward_moves_along_body_x():
    """Nose to the east, then to the north: x is forward in both, and a step to the left is y."""
    east, north = [0, 0, 0, 1], [0, 0, np.sqrt(0.5), np.sqrt(0.5)]
    odometry = Odometry(
        time_s=[0.0, 10.0, 11.0, 21.0],
        position_m=[[0, 0, 0], [5, 0, 0], [5, 0, 0], [5, 3, 0]],
        quat_xyzw=[east, east, north, north],
    )
    increments_m = odometry.increments_body_m(np.array([0.0, 10.0, 11.0, 16.0, 21.0]))
    np.testing.assert_allclose(increments_m, [[5, 0, 0], [0, 0, 0], [1.5, 0, 0], [1.5, 0, 0]], atol=1e-12)
    np.testing.assert_allclose(odometry.increments_body_m(np.array([0.0, 21.0])), [[5, 3, 0]], atol=1e-12)
    assert odometry.increments_body_m(np.array([3.0])).shape == (0, 3)
    assert odometry.increments_body_m(np.array([])).shape == (0, 3)


def test_text_is_read_as_written_and_as_evo_reads_it(tmp_path):
    odometry = random_odometry(np.random.default_rng(1))
    poses = zip(odometry.time_s, odometry.position_m, odometry.quat_xyzw, strict=True)
    lines = [tum_line(t, p, R_from_quat_xyzw(q)).strip() for t, p, q in poses]
    path = write(tmp_path / "o.tum", ["# time tx ty tz qx qy qz qw", "", *lines[:3], "  # a pause", *lines[3:]])
    read = read_odometry(path)
    np.testing.assert_allclose(read.time_s, odometry.time_s, atol=1e-6)
    np.testing.assert_allclose(read.position_m, odometry.position_m, atol=1e-9)
    turn = Rotation.from_quat(read.quat_xyzw).inv() * Rotation.from_quat(odometry.quat_xyzw)
    assert turn.magnitude().max() < 1e-8
    table = np.loadtxt(path)  # as evo reads it
    np.testing.assert_array_equal(table, np.column_stack([read.time_s, read.position_m, read.quat_xyzw]))


def test_values_may_be_separated_by_tabs_and_rounded(tmp_path):
    odometry = read_odometry(write(tmp_path / "o.tum", ["0\t0 0 0 0 0 0.71 0.71", "1e1 1 0 0 0 0 .71 .71 # end"]))
    np.testing.assert_allclose(odometry.increments_body_m(np.array([0.0, 10.0])), [[0, -1, 0]], atol=1e-12)


@pytest.mark.parametrize(
    ("lines", "cause"),
    [
        ([GOOD[0], GOOD[2], GOOD[1]], "line 3: times are not in order: 10.000000 follows 20.000000"),
        ([*GOOD, "20 2.06 1 0 0 0 0 1"], "line 4: a second pose at the time 20.000000, 0.06 m away"),
        ([*GOOD, "20 2 1 0 0 0 0.02 0.9998"], "line 4: a second pose at the time 20.000000"),
        (["# head", GOOD[0], "10 nan 0 0 0 0 0 1", GOOD[2]], "line 3: a number is NaN or infinite"),
        ([GOOD[0], "10 0 0 inf 0 0 0 1"], "line 2: a number is NaN or infinite"),
        ([GOOD[0], "10 1e300 0 0 0 0 0 1"], "line 2: a coordinate is larger than 1e\\+08 m"),
        ([GOOD[0], "10 1 0 0 0 0 0 0"], "line 2: the quaternion has the length 0, not 1"),
        ([GOOD[0], "10 1 0 0 0 0 1 1"], "line 2: the quaternion has the length 1.41"),
        ([GOOD[0], "10 1 0 0 0 0 1e300 1e300"], "line 2: the quaternion has the length inf"),
        ([GOOD[0], "10 1 0 0 0 0 1"], "line 2: 7 columns, expected 8: time tx ty tz qx qy qz qw"),
        ([GOOD[0], "10,1,0,0,0,0,0,1"], "line 2: 1 columns, expected 8"),
        ([GOOD[0], "10 1 0 0 0 0 0 one"], "line 2: could not convert string to float: 'one'"),
        (["1900000000000 0 0 0 0 0 0 1", GOOD[1]], "line 1: the time 1.9e\\+12 is not in Unix seconds"),
        (["-1 0 0 0 0 0 0 1", GOOD[1]], "line 1: the time -1 is not in Unix seconds"),
        ([GOOD[0]], "1 pose\\(s\\): at least two"),
        (["# nothing"], "0 pose\\(s\\): at least two"),
        (["\0"], "it is no text"),
    ],
)
def test_a_bad_file_is_refused_in_one_line_that_names_it(tmp_path, lines, cause):
    with pytest.raises(BadInput, match=cause) as refusal:
        read_odometry(write(tmp_path / "o.tum", lines))
    message = str(refusal.value)
    assert (refusal.value.reason, refusal.value.reason.exit_code) == ("bad_odometry", 4)
    assert "o.tum: " in message
    assert "\n" not in message


def test_of_poses_at_one_time_that_agree_the_last_one_counts(tmp_path):
    """The second of three has the opposite sign of the same rotation."""
    again = ["20 2.03 1 0 0 0 0 -1", "20 2.02 1.03 0 0 0 0.005 1", "30 3 1 0 0 0 0 1"]
    read = read_odometry(write(tmp_path / "o.tum", [*GOOD, *again]))
    assert read.time_s.tolist() == [0.0, 10.0, 20.0, 30.0]
    assert read.position_m[2].tolist() == [2.02, 1.03, 0.0]
    (warning,) = read.warnings
    assert "2 second poses at one time, the first in line 4, up to 31.6 mm apart: the last one counts" in warning
    with pytest.raises(BadInput, match="line 4: a second pose"):
        read_odometry(tmp_path / "o.tum", floor_m=0.01)
    assert read_odometry(write(tmp_path / "good.tum", GOOD)).warnings == ()


def test_odometry_covers_neither_gaps_nor_what_is_beyond_its_ends():
    at_s = np.array([0.0, 1.0, 2.0, 3.0, 4.0, 50.0, 51.0, 52.0, 90.0])
    east_m = np.array([0.0, 1.0, 2.0, 3.0, 4.0, 30.0, 31.0, 32.0, 32.01])  # at rest in the second gap
    quat = np.tile([0.0, 0.0, 0.0, 1.0], (len(at_s), 1))
    found = Odometry(time_s=at_s, position_m=east_m[:, None] * [1.0, 0.0, 0.0], quat_xyzw=quat)
    asked = np.array([-0.01, -0.0005, 0.5, 4.0, 4.5, 49.0, 50.0, 51.5, 70.0, 90.0, 90.1])
    expected = [False, True, True, True, False, False, True, True, True, True, False]
    assert found.covers(asked).tolist() == expected
    assert found.covers(np.array([70.0]), still_m=0.001).tolist() == [False]


def test_reading_takes_a_few_hundred_bytes_a_pose(tmp_path, monkeypatch):
    """A day at 100 Hz has 8.6 million; lists of numbers took 620 bytes of each."""
    path, poses = tmp_path / "a.tum", 20_000
    monkeypatch.setattr(odometry, "MAX_ODOMETRY_BYTES", 2**20)  # Python reserves as many
    path.write_text("".join(f"{k} 0 0 0 0 0 0 1\n" for k in range(poses)))
    tracemalloc.start()
    try:
        assert len(read_odometry(path)) == poses
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert peak < 400 * poses, peak / poses


def test_files_that_are_no_text_are_refused(tmp_path):
    (tmp_path / "o.tum").write_bytes(b"\xff\xfe\x00")
    for path, cause in [("o.tum", "it is no text"), ("none.tum", "no such file"), (".", "without metadata.yaml")]:
        with pytest.raises(BadInput, match=cause):
            read_odometry(tmp_path / path)
    with pytest.raises(BadInput, match="has no topic /odom"):
        read_odometry(write(tmp_path / "good.tum", GOOD), topic="/odom")


@pytest.mark.parametrize(
    ("times", "cause"),
    [
        ([0.0, 25.0], "1 of 2 frames, the first at .*:25.0000.*, are outside the odometry, which covers .* to .*:20.0"),
        ([-3.0, -2.0, 5.0], "2 of 3 frames, the first at 1969-12-31T23:59:57.*, are outside"),
        ([1e18], "the frame's time 1e\\+18 s is outside"),
        ([5.0, 4.0], "not in the order of time"),
        ([5.0, np.nan], "not a list of finite numbers"),
        ([[5.0]], "not a list of finite numbers"),
    ],
)
def test_times_that_the_odometry_does_not_cover_are_refused(tmp_path, times, cause):
    odometry = read_odometry(write(tmp_path / "o.tum", GOOD))
    with pytest.raises(BadInput, match=cause) as refusal:
        odometry.increments_body_m(np.array(times))
    assert refusal.value.reason == "bad_odometry"
    assert "\n" not in str(refusal.value)


def test_times_rounded_to_a_tenth_of_a_millisecond_are_covered():
    odometry = Odometry(time_s=[0.0001, 10.0], position_m=[[0, 0, 0], [1, 0, 0]], quat_xyzw=[[0, 0, 0, 1]] * 2)
    np.testing.assert_allclose(odometry.increments_body_m(np.array([0.0, 10.0004])), [[1, 0, 0]])


@pytest.mark.parametrize(
    ("changes", "cause"),
    [
        ({"time_s": [0.0]}, "shape"),
        ({"time_s": [1.0, 1.0]}, "pose 1: a second pose"),
        ({"position_m": [[0, 0, 0], [np.nan, 0, 0]]}, "NaN"),
        ({"position_m": [[0, 0, 0], [np.inf, 0, 0]]}, "pose 1: a number is NaN or infinite"),
        ({"quat_xyzw": [[0, 0, 0, 1], [0, 0, 0, 0]]}, "pose 1: the quaternion"),
    ],
)
def test_a_value_that_is_no_odometry_raises(changes, cause):
    good = {"time_s": [0.0, 1.0], "position_m": [[0, 0, 0], [1, 0, 0]], "quat_xyzw": [[0, 0, 0, 1]] * 2}
    with pytest.raises(ValueError, match=cause):
        Odometry(**{**good, **changes})


@pytest.mark.parametrize("end", ["", "5", "5 1 2 3", "5 1 2 3\n", "5 1 2 3 0 0 0 1", "# note", "5 1 2 # 3\n"])
def test_text_that_grows_is_read_to_its_last_complete_line(tmp_path, end):
    path = tmp_path / "odometry.tum"
    path.write_text("1 0 0 0 0 0 0 1\n2 1 0 0 0 0 0 1\n" + end)
    assert read_odometry(path, growing=True).time_s.tolist() == [1.0, 2.0]


def test_text_that_grows_is_still_refused_for_a_wrong_line_within(tmp_path):
    path = tmp_path / "odometry.tum"
    path.write_text("1 0 0 0 0 0 0 1\n2 1 0 0\n3 1 0 0 0 0 0 1\n")
    with pytest.raises(BadInput, match="line 2: 4 columns"):
        read_odometry(path, growing=True)
