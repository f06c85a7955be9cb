"""The compiled look-up of stars and triangles, and rotations, against other programs and brute force."""

from __future__ import annotations

import tracemalloc

import numpy as np
import pytest
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation
from test_identification import sky

from startrack.frames import wahba
from startrack.identification.index import CatalogPatterns
from startrack.identification.star_grid import StarGrid, rotation_between, settle_rotation


@pytest.mark.parametrize("count", [1, 1000, 20_000])
@pytest.mark.parametrize("chord", [0.003, 0.3])
def test_neighbours_are_those_of_a_tree(count: int, chord: float) -> None:
    stars = sky().rays_icrs[:count]
    rays = np.concatenate([Rotation.random(60, random_state=1).as_matrix()[:, 0], stars[:40], np.eye(3), -np.eye(3)])
    found = StarGrid(stars).neighbours(rays, chord)
    tree = cKDTree(stars)
    assert (np.diff(found.ray) >= 0).all()
    for i, expected in enumerate(tree.query_ball_point(rays, chord)):
        assert sorted(found.star[found.ray == i].tolist()) == sorted(expected)
    np.testing.assert_allclose(found.chord, np.linalg.norm(rays[found.ray] - stars[found.star], axis=1), atol=1e-12)
    assert len(StarGrid(stars).neighbours(rays[:0], chord).ray) == 0


@pytest.mark.parametrize("narrow", [1.0, 0.05, 0.01])
def test_a_rotation_is_that_of_the_singular_values(narrow: float) -> None:
    rng = np.random.default_rng(2)
    for seed in range(20):
        R = Rotation.random(random_state=seed).as_matrix()
        icrs = np.array([0.0, 0.0, 1.0]) + narrow * rng.normal(size=(int(rng.integers(3, 40)), 3))
        icrs /= np.linalg.norm(icrs, axis=1)[:, None]
        cam = icrs @ R.T + rng.normal(0, 1e-4 * narrow, icrs.shape)
        weight = rng.uniform(0.1, 10.0, len(cam))
        found = rotation_between(cam, icrs, weight)
        np.testing.assert_allclose(found, wahba(cam, icrs, weight), atol=1e-9)


def test_settling_leaves_wrong_pairs_out_and_takes_right_ones_in() -> None:
    rng = np.random.default_rng(3)
    R = Rotation.random(random_state=4).as_matrix()
    icrs = Rotation.random(80, random_state=5).as_matrix()[:, 0]
    cam = icrs @ R.T + rng.normal(0, 1e-4, icrs.shape)
    cam[:20] = cam[20:40] + 0.002 * rng.normal(size=(20, 3))  # wrong
    right = np.arange(80) >= 20
    found, hit = settle_rotation(cam, icrs, np.arange(80) > 60, 1e-3**2)
    np.testing.assert_array_equal(hit, right)
    np.testing.assert_allclose(found, wahba(cam[right], icrs[right]), atol=1e-12)


@pytest.mark.parametrize("field_sr", [2 * np.pi, 0.03])
def test_triangles_are_those_of_a_tree(field_sr: float) -> None:
    index = CatalogPatterns(sky(), field_sr).bright_index
    rng = np.random.default_rng(6)
    tolerance = 2e-3 * index.longest_chord
    some = index.sides[rng.integers(len(index.sides), size=200)] + rng.uniform(-1, 1, (200, 3)) * tolerance
    row, triangle = index.candidates(some, tolerance, 2)
    distance, nearest = cKDTree(index.sides).query(some, 2, p=np.inf, distance_upper_bound=tolerance)
    expected = {(i, int(one)) for i in range(200) for one, d in zip(nearest[i], distance[i], strict=True) if d < np.inf}
    assert set(zip(row.tolist(), triangle.tolist(), strict=True)) == expected
    off = np.abs(some[row] - index.sides[triangle]).max(axis=1) / some[row, 0]
    assert (np.diff(off) >= 0).all()


def test_a_lookup_within_a_large_tolerance_takes_bounded_memory() -> None:
    """A camera file of another lens makes tolerances so large that each triangle agrees with thousands of others."""
    index = CatalogPatterns(sky(), 0.2).deep_index
    row = np.random.default_rng(8).choice(len(index.sides), 20_000, replace=False)
    wanted = index.sides[row] * (1.0 + 1e-9)
    tracemalloc.start()
    try:
        left, right = index.candidates(wanted, 0.1 * index.longest_chord, 1)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert peak < 200e6
    exact = left[right == row[left]]
    assert len(exact) > 0.999 * len(row)
