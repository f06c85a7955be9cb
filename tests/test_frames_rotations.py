"""Rotations against SciPy: Wahba's problem, rotation vectors; heading, pitch and roll by hand."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from startrack.frames import R_body_enu_from_heading_pitch_roll as to_matrix
from startrack.frames import R_from_rotvec, wahba
from startrack.frames import heading_pitch_roll_from_R_body_enu as from_matrix

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


def random_rays(n: int, rng: np.random.Generator) -> np.ndarray:
    rays = rng.normal(size=(n, 3))
    return rays / np.linalg.norm(rays, axis=1, keepdims=True)


@pytest.mark.parametrize("n", [2, 3, 5, 100])
def test_wahba_agrees_with_scipy(n: int) -> None:
    rng = np.random.default_rng(n)
    for _ in range(20):
        R = Rotation.random(random_state=rng).as_matrix()
        icrs, weights = random_rays(n, rng), rng.uniform(0.1, 5, n)
        cam = icrs @ R.T + rng.normal(0, 1e-3, (n, 3))
        cam /= np.linalg.norm(cam, axis=1, keepdims=True)
        theirs = Rotation.align_vectors(cam, icrs, weights)[0].as_matrix()
        assert wahba(cam, icrs, weights) == pytest.approx(theirs, abs=1e-9)


def test_wahba_in_batches_and_never_a_mirror() -> None:
    rng = np.random.default_rng(1)
    icrs, weights = np.stack([random_rays(3, rng) for _ in range(50)]), np.ones((50, 3))
    cam = icrs * [-1, 1, 1]  # a mirror image: the best proper rotation is wanted
    batch = wahba(cam, icrs, weights)
    assert np.linalg.det(batch) == pytest.approx(1.0)
    each = [wahba(c, i, w) for c, i, w in zip(cam, icrs, weights, strict=True)]
    assert batch == pytest.approx(np.array(each), abs=1e-12)
    theirs = [Rotation.align_vectors(c, i)[0].as_matrix() for c, i in zip(cam, icrs, strict=True)]
    assert batch == pytest.approx(np.array(theirs), abs=1e-6)


@pytest.mark.parametrize("vector", [(0, 0, 0), (1e-9, 0, 0), (0.3, -0.2, 0.5), (3.0, 0.5, -0.2)])
def test_rotation_vector_to_matrix(vector: tuple[float, float, float]) -> None:
    assert R_from_rotvec(np.array(vector)) == pytest.approx(Rotation.from_rotvec(vector).as_matrix(), abs=1e-15)
