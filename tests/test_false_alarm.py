"""The model of chance matches against simulation, and the matches that it counts."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial import cKDTree

from startrack.estimation.false_alarm import (
    coincidence_probability,
    density_per_px2,
    density_per_sr,
    expected_false_alarms,
    log_p_value,
    log_p_value_bound,
    log_p_value_poisson,
)
from startrack.estimation.match import match_mutual, match_nearest, select_closest


def test_binomial_and_poisson_tails_are_those_of_scipy() -> None:
    from scipy.stats import binom, poisson

    for k, n, p in ((4, 30, 0.02), (10, 100, 0.05), (40, 300, 0.1)):
        assert log_p_value(k, n, p, free=0) == pytest.approx(binom.logsf(k - 1, n, p), rel=1e-9)
        assert log_p_value(k + 3, n + 3, p) == pytest.approx(binom.logsf(k - 1, n, p), rel=1e-9)
        assert log_p_value_poisson(k, n * p) == pytest.approx(poisson.logsf(k - 1, n * p), rel=1e-9)
        assert expected_false_alarms(7, k, n + 3, p) == pytest.approx(7 * binom.sf(k - 1, n, p), rel=1e-9)
    assert log_p_value(3, 50, 0.1) == 0.0  # the pattern's own stars prove nothing
    assert log_p_value_poisson(5000, 0.5) == -690.0


def test_the_cheap_bound_is_no_smaller_than_the_tail() -> None:
    from scipy.stats import poisson

    gate = 4.0
    for hits, predicted, density in ((8, 60, 1e-3), (20, 100, 2e-3), (3, 100, 1e-2)):
        expected = predicted * density * np.pi * (gate / 2) ** 2
        bound = log_p_value_bound(np.full(hits, 0.5), gate, predicted, density)
        assert poisson.logsf(hits - 1, expected) <= bound <= 0.0


def test_densities_are_those_met_at_the_detections() -> None:
    rng = np.random.default_rng(1)
    size = (1000, 800)
    even = rng.uniform(0, 1, (2000, 2)) * size
    assert density_per_px2(even, size) == pytest.approx(2000 / 800_000, rel=0.1)
    half = even[even[:, 0] < 500]
    assert density_per_px2(half, size) == pytest.approx(2000 / 800_000, rel=0.15)
    rays = rng.normal(size=(3000, 3))
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    assert density_per_sr(rays) == pytest.approx(3000 / (4 * np.pi), rel=0.1)
    assert density_per_sr(rays[rays[:, 2] > 0.5]) == pytest.approx(3000 / (4 * np.pi), rel=0.15)
    assert coincidence_probability(0.01) == pytest.approx(0.00995, rel=1e-3)


def brute_force_nearest(xy: np.ndarray, px: np.ndarray, gate: float) -> set[tuple[int, int]]:
    distance = np.linalg.norm(xy[:, None] - px[None], axis=2)
    nearest = distance.argmin(axis=0)
    claimed: dict[int, int] = {}
    for star in np.argsort(distance.min(axis=0)):
        if distance[nearest[star], star] < gate:
            claimed.setdefault(int(nearest[star]), int(star))
    return set(claimed.items())


@pytest.mark.parametrize("gate", [5.0, 40.0])
def test_nearest_matches_are_those_of_a_brute_force_search(gate: float) -> None:
    rng = np.random.default_rng(2)
    xy, px = rng.uniform(0, 500, (60, 2)), rng.uniform(0, 500, (90, 2))
    detection, star, distance = match_nearest(cKDTree(xy), px, gate)
    assert set(zip(detection.tolist(), star.tolist(), strict=True)) == brute_force_nearest(xy, px, gate)
    assert distance == pytest.approx(np.linalg.norm(xy[detection] - px[star], axis=1))
    mutual = set(zip(*(a.tolist() for a in match_mutual(xy, px, gate)), strict=True))
    between = np.linalg.norm(xy[:, None] - px[None], axis=2)
    expected = {
        (i, j)
        for i, j in np.argwhere(between < gate).tolist()
        if between[i].argmin() == j and between[:, j].argmin() == i
    }
    assert mutual == expected
    assert mutual <= brute_force_nearest(xy, px, gate)


def test_select_closest() -> None:
    detection, distance = np.array([3, 1, 3, 1, 2]), np.array([0.5, 0.2, 0.1, 0.4, 0.9])
    assert select_closest(detection, distance).tolist() == [1, 2, 4]
    assert select_closest(np.zeros(0, dtype=np.int64), np.zeros(0)).tolist() == []
