"""Heading, pitch and roll against SciPy's rotations and against looking."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from startrack.frames.body_angles import R_body_enu_from_heading_pitch_roll as to_matrix
from startrack.frames.body_angles import heading_pitch_roll_from_R_body_enu as from_matrix

angle = st.floats(-np.pi, np.pi)


@given(heading=angle, pitch=st.floats(-1.5, 1.5), roll=st.floats(-3.1, 3.1))
def test_round_trip(heading, pitch, roll):
    h, p, r = from_matrix(to_matrix(heading, pitch, roll))
    turn = (h - heading + np.pi) % (2 * np.pi) - np.pi
    np.testing.assert_allclose([turn, p - pitch, r - roll], 0.0, atol=1e-9)
    assert 0 <= h < 2 * np.pi


def test_scipys_yaw_pitch_roll():
    # ROS (REP 103): yaw from east counter-clockwise, pitch nose DOWN positive, roll right side down positive.
    heading, pitch, roll = 0.7, 0.2, -0.4
    R_enu_body = Rotation.from_euler("ZYX", [np.pi / 2 - heading, -pitch, roll]).as_matrix()
    np.testing.assert_allclose(to_matrix(heading, pitch, roll).T, R_enu_body, atol=1e-14)


def test_signs_by_looking():
    nose, left, up = to_matrix(np.radians(90), np.radians(10), 0.0)
    np.testing.assert_allclose(nose, [np.cos(np.radians(10)), 0, np.sin(np.radians(10))], atol=1e-15)  # east, nose up
    np.testing.assert_allclose(left, [0, 1, 0], atol=1e-15)  # facing east, north is on the left
    assert up[2] > 0
    rolled_left = to_matrix(0.0, 0.0, np.radians(10))[1]
    assert rolled_left[2] == pytest.approx(np.sin(np.radians(10)))  # right side down: the left side rises


@pytest.mark.parametrize("pitch", [np.pi / 2, -np.pi / 2])
def test_nose_vertical_gives_the_same_rotation_with_roll_zero(pitch):
    R = to_matrix(0.5, pitch, 0.3)
    h, p, r = from_matrix(R)
    assert r == 0.0
    np.testing.assert_allclose(to_matrix(h, p, r), R, atol=1e-9)
