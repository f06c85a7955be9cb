"""The posterior of a column: the chain beside sums over every pair of elevations, stars and steps beside formulas."""

from __future__ import annotations

import numpy as np
from scipy.stats import norm

from startrack.applications.horizon.columns import AZIMUTH_COLUMNS, GRID_STEP_RAD, column_of, elevations_rad
from startrack.applications.horizon.posterior import (
    CHANGE_WEIGHTS,
    CHANGES_RAD,
    JUMP_WEIGHT,
    KINDS,
    SWITCH_1,
    add_steps,
    combine_columns,
    limited_rows,
    pass_messages,
    skyline_prior,
    star_log_likelihood,
)
from startrack.core.types import Evidence

RATIO, WEIGHT, JUMP = np.array([0.2, 0.7, 0.95]), np.array([0.5, 0.3, 0.15]), 0.05


def test_messages_are_those_of_the_whole_transition_matrix():
    kinds, columns, n = 2, 7, 60
    rng = np.random.default_rng(4)
    likelihood = rng.uniform(0.01, 1.0, (kinds, columns, n)).astype(np.float32)
    likelihood[:, 2, 5:40] = 1e-4
    part, switch, landing = np.array([0.7, 0.3]), 0.1, rng.uniform(0.5, 1.0, n)
    landing /= landing.sum()
    apart = np.abs(np.arange(n)[:, None] - np.arange(n))
    move = sum(w * (1 - r) / (1 + r) * r**apart for r, w in zip(RATIO, WEIGHT, strict=True))
    move /= move.sum(axis=1, keepdims=True)
    change = (1.0 - switch) * np.eye(kinds) + switch * part  # from a kind (rows) to another
    jump = np.broadcast_to(np.outer(part, landing).ravel(), (kinds * n, kinds * n))
    matrix = (1.0 - JUMP) * np.kron(change, move) + JUMP * jump
    for forward in (True, False):
        order = range(columns) if forward else range(columns - 1, -1, -1)
        expected = np.empty((kinds, columns, n))
        message = np.outer(part, landing) if forward else np.ones((kinds, n))
        for c in [*order, *order]:
            expected[:, c] = message
            after = (message * likelihood[:, c]).ravel()
            message = ((after @ matrix if forward else matrix @ after) / after.sum()).reshape(kinds, n)
        found = pass_messages(likelihood, forward, RATIO, WEIGHT, JUMP, landing, part, switch)
        np.testing.assert_allclose(found, expected, rtol=1e-6)  # they are in single precision


def test_without_evidence_the_posterior_is_the_chains_own_distribution():
    """The prior of the elevation counts once: the columns after one say nothing about it."""
    change = np.exp(-GRID_STEP_RAD / CHANGES_RAD), np.array(CHANGE_WEIGHTS), JUMP_WEIGHT, skyline_prior()
    ones = np.ones((len(KINDS), AZIMUTH_COLUMNS, len(elevations_rad())), np.float32)
    ahead = pass_messages(ones, True, *change, np.array(KINDS), SWITCH_1)[:, -1].astype(float)
    np.testing.assert_allclose(ahead.sum(axis=1), KINDS, rtol=1e-5)
    expected = ahead.sum(axis=0) @ elevations_rad()
    mean, _ = combine_columns(np.zeros(ones.shape))
    np.testing.assert_allclose(np.degrees(mean), np.degrees(expected), atol=0.02)


def test_steps_add_the_logarithm_of_their_mixture():
    lowest, step, n, nothing, temper = -0.1, 0.01, 50, 0.25, 0.6
    column, place, sigma = np.array([1, 1, 3]), np.array([0.0, 0.2, 0.39]), np.array([0.005, 0.02, 0.004])  # at an end
    weight, passed = np.array([0.5, 0.3, 0.7]), np.array([-0.4, 0.2, 0.1])
    total = np.zeros((4, n), np.float32)
    add_steps(temper, lowest, step, column, place, sigma, weight, passed, nothing, np.empty(n), total)
    elevation, expected = lowest + step * np.arange(n), np.zeros((4, n))
    for c in (1, 3):
        own = column == c
        each = norm.pdf(elevation[:, None], place[own], sigma[own]) * weight[own]
        above = elevation[:, None] < place[own] - 2.0 * sigma[own]
        expected[c] = temper * (np.log(nothing + each.sum(axis=1)) + (above * passed[own]).sum(axis=1))
    np.testing.assert_allclose(total, expected, rtol=3e-7, atol=1e-7)  # in single precision


def test_stars_add_the_probability_of_each_skyline_at_their_heights():
    elevation = elevations_rad()
    azimuth, height = np.radians([10.1, 10.2, 200.0]), np.radians([3.0, 20.0, 1.0])
    llr, edge = np.array([6.0, -2.0, 5.0]), np.radians(0.05)
    rays = Evidence(azimuth_rad=azimuth, elevation_rad=height, llr=llr, edge_sigma_rad=np.full(3, edge))
    found = star_log_likelihood(rays, 0.1)
    _, limited = limited_rows(rays, 0.1)
    expected = np.zeros_like(found)
    for at, star_rad, ratio in zip(column_of(azimuth), height, limited, strict=True):
        above = norm.cdf((star_rad - elevation) / edge)
        expected[at] += np.log(above * np.exp(ratio) + 1.0 - above)
    np.testing.assert_allclose(found, expected, atol=2e-6)  # beyond 5 sigma of an edge the kernel takes it as sharp
