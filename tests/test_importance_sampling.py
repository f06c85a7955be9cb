"""Importance sampling against distributions whose integrals are known."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from startrack.core.types import Array
from startrack.localization.importance_sampling import ENOUGH, LEAST_WEIGHT, moments, sample


def gaussian(dimensions: int, seed: int) -> tuple[Array, Array, Any]:
    """Mean, covariance and the logarithm of a normal density times e^3."""
    rng = np.random.default_rng(seed)
    mix = rng.normal(size=(dimensions, dimensions)) + 1.5 * np.eye(dimensions)
    mean, covariance = rng.normal(size=dimensions), mix @ mix.T
    inverse, norm = np.linalg.inv(covariance), 0.5 * np.linalg.slogdet(2 * np.pi * covariance)[1]

    def log_density(points: Array) -> Array:
        off = points - mean
        return np.asarray(3.0 - norm - 0.5 * np.einsum("ni,ij,nj->n", off, inverse, off))

    return mean, covariance, log_density


@pytest.mark.parametrize("dimensions", [2, 9])
@pytest.mark.parametrize("seed", range(4))
def test_a_normal_distribution_has_its_integral_and_moments(dimensions: int, seed: int) -> None:
    """Also where sampling begins beside it, too wide by half or too narrow by a third."""
    mean, covariance, log_density = gaussian(dimensions, seed)
    beside = mean + np.linalg.cholesky(covariance) @ np.full(dimensions, 0.7 / np.sqrt(dimensions))
    for width in (0.67, 1.5):
        found = sample(log_density, [(beside, width**2 * covariance)])
        assert found.effective > ENOUGH
        assert found.log_evidence == pytest.approx(3.0, abs=0.12)
        middle, spread = moments(found.points, found.share)
        root = np.linalg.inv(np.linalg.cholesky(covariance))
        assert np.linalg.norm(root @ (middle - mean)) < 0.08 * np.sqrt(dimensions)
        assert root @ spread @ root.T == pytest.approx(np.eye(dimensions), abs=0.25)


@pytest.mark.parametrize("start", [0.3, 3.0])
def test_a_start_that_is_far_too_narrow_or_wide_is_adapted(start: float) -> None:
    mean, covariance, log_density = gaussian(4, 7)
    found = sample(log_density, [(mean, start**2 * covariance)])
    assert found.log_evidence == pytest.approx(3.0, abs=0.15)
    root = np.linalg.inv(np.linalg.cholesky(covariance))
    assert root @ moments(found.points, found.share)[1] @ root.T == pytest.approx(np.eye(4), abs=0.3)


def test_two_modes_keep_their_shares() -> None:
    """Three to one, and far apart."""
    places, parts = np.array([[0.0, 0.0], [60.0, -20.0]]), np.array([0.75, 0.25])

    def log_density(points: Array) -> Array:
        z2 = np.square(points[:, None] - places).sum(axis=2)
        return np.asarray(np.logaddexp.reduce(np.log(parts) - 0.5 * z2 - np.log(2 * np.pi), axis=1))

    found = sample(log_density, [(place + 0.5, 2.0 * np.eye(2)) for place in places])
    assert found.log_evidence == pytest.approx(0.0, abs=0.05)
    second = found.points[:, 0] > 30.0
    assert found.share[second].sum() == pytest.approx(0.25, abs=0.03)


def test_a_mode_without_weight_does_not_keep_points() -> None:
    mean, covariance, log_density = gaussian(2, 3)
    found = sample(log_density, [(mean, covariance), (mean + 500.0, covariance)])
    away = np.linalg.norm(found.points - mean, axis=1) > 250.0
    assert found.share[away].sum() < LEAST_WEIGHT
    assert found.log_evidence == pytest.approx(3.0, abs=0.1)


def test_a_density_with_a_hard_edge_is_sampled() -> None:
    """Half of a normal distribution: its mean stands at sqrt(2 / pi) sigma."""

    def log_density(points: Array) -> Array:
        value = -0.5 * np.square(points).sum(axis=1) - np.log(2 * np.pi)
        return np.where(points[:, 0] > 0.0, value, -np.inf)

    found = sample(log_density, [(np.zeros(2), np.eye(2))])
    assert found.log_evidence == pytest.approx(np.log(0.5), abs=0.06)
    assert moments(found.points, found.share)[0] == pytest.approx([np.sqrt(2 / np.pi), 0.0], abs=0.06)


def test_a_density_that_few_points_meet_ends() -> None:
    """A strip of a hundredth of the first distribution, so that fewer points than are aimed at have any weight."""

    def log_density(points: Array) -> Array:
        inside = (points[:, 0] > 0.0) & (points[:, 0] < 0.02)
        return np.where(inside, -0.5 * np.square(points).sum(axis=1) - np.log(2 * np.pi), -np.inf)

    found = sample(log_density, [(np.zeros(2), np.eye(2))])
    assert found.log_evidence == pytest.approx(np.log(0.02 / np.sqrt(2 * np.pi)), abs=0.3)
