"""From weighted points to a position: probabilities of the circles, and modes."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from startrack.core.types import NotLocated
from startrack.localization.conclusion import WeightedHypotheses, label_modes, require_inside
from startrack.terrain import Cylinder, load_terrain

TERRAIN = load_terrain("shackleton-thesis")
assert isinstance(TERRAIN, Cylinder)
WIDTH_M = 2.0


def blob(middle: tuple[float, float], sigma_m: tuple[float, float], part: float) -> tuple[np.ndarray, np.ndarray]:
    """Boxes (n, 2) of a Gaussian of the given weight, and the log of their weights."""
    half = [np.arange(-5 * s, 5 * s + WIDTH_M, WIDTH_M) for s in sigma_m]
    x, y = np.meshgrid(*half)
    offset = np.stack([x.ravel(), y.ravel()], axis=1)
    log = -0.5 * np.sum((offset / sigma_m) ** 2, axis=1)
    return offset + np.array(middle), log - np.log(np.exp(log).sum()) + np.log(part)


def summary_of(*blobs: tuple[np.ndarray, np.ndarray]) -> tuple[WeightedHypotheses, np.ndarray, tuple[float, float]]:
    """All points of a posterior, its main position (2,) and the radii of its circles."""
    points, log = (np.concatenate(part) for part in zip(*blobs, strict=True))
    whole = posterior_of(points, log)
    middle = np.average(points[whole.main], axis=0, weights=whole.share[whole.main])
    return whole, middle, whole.radii(points, whole.share, middle)


def posterior_of(points: np.ndarray, log: np.ndarray) -> WeightedHypotheses:
    one = SimpleNamespace(positions_m=points, copies_log_weight=log, gross="")
    return WeightedHypotheses([one], TERRAIN)  # type: ignore[list-item]


def test_one_gaussian() -> None:
    whole, middle, radii = summary_of(blob((3000.0, -1000.0), (20.0, 6.0), 1.0))
    assert middle == pytest.approx([3000.0, -1000.0], abs=0.5)
    drawn = np.hypot(*(np.random.default_rng(1).normal(size=(200_000, 2)) * [20.0, 6.0]).T)
    assert radii == pytest.approx(np.percentile(drawn, [95, 99.9]), abs=2 * WIDTH_M)
    assert whole.main.all()


def test_a_weak_second_mode_does_not_shift_the_position() -> None:
    whole, middle, (radius95, radius999) = summary_of(
        blob((3000.0, 2000.0), (6.0, 6.0), 0.995), blob((-5000.0, -3000.0), (6.0, 6.0), 0.005)
    )
    assert middle == pytest.approx([3000.0, 2000.0], abs=0.5)  # the mean of both is 47 m away
    assert radius95 < 20.0
    assert radius999 > 9000.0  # but it is there
    assert whole.share[whole.label == 1].sum() == pytest.approx(0.005, rel=0.01)


def test_modes_are_labelled_by_their_weight() -> None:
    sigmas = ([6.0, 6.0], [8.0, 4.0], [5.0, 5.0])
    whole, _, _ = summary_of(
        blob((3000.0, 2000.0), (6.0, 6.0), 0.6), blob((3000.0, -2000.0), (8.0, 4.0), 0.37),
        blob((-100.0, 0.0), (5.0, 5.0), 0.03),
    )  # fmt: skip
    rng = np.random.default_rng(2)
    for number, (weight, sigma_m) in enumerate(zip((0.6, 0.37, 0.03), sigmas, strict=True)):
        own = whole.label == number
        assert whole.share[own].sum() == pytest.approx(weight, abs=1e-3)
        points, share = whole.positions_m[own], whole.share[own]
        drawn = np.hypot(*(rng.normal(size=(200_000, 2)) * sigma_m).T)  # the circles of a mode hold its own part
        found = whole.radii(points, share, np.average(points, axis=0, weights=share))
        assert found == pytest.approx(np.percentile(drawn, [95, 99.9]), abs=WIDTH_M)


@pytest.mark.parametrize("sigma_m", [(300.0, 3.0), (20.0, 20.0), (5.0, 90.0)])
def test_scattered_points_of_one_distribution_are_one_mode(sigma_m: tuple[float, float]) -> None:
    for seed in range(5):
        rng = np.random.default_rng(seed)
        points = rng.normal(size=(1200, 2)) * 1.3 * np.array(sigma_m)
        log = -0.5 * np.square(points / sigma_m).sum(axis=1) * (1 - 1 / 1.69)
        weight = np.exp(log)
        label = label_modes(points, weight / weight.sum())
        assert weight[label == 0].sum() / weight.sum() > 0.99


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(30, 400), st.floats(0.1, 2.0))
def test_circles_contain_their_probability(seed: int, n: int, spread: float) -> None:
    """Any weights on any points: the circles hold 95 and 99.9 %, to the weight of a point, and no smaller ones do."""
    rng = np.random.default_rng(seed)
    points, log = 20.0 * rng.normal(size=(n, 2)), spread * rng.normal(size=n)
    whole = posterior_of(points, log)
    middle = whole.share @ points
    away, most = np.linalg.norm(points - middle, axis=1), whole.share.max()
    for radius, mass in zip(whole.radii(points, whole.share, middle), (0.95, 0.999), strict=True):
        assert whole.share[away <= radius].sum() >= mass - most - 1e-9
        assert whole.share[away < radius - 1e-9].sum() < mass + 1e-9


def test_most_of_the_posterior_outside_the_search_area_is_refused() -> None:
    points, log = blob((3200.0, 0.0), (20.0, 20.0), 1.0)
    small = replace(TERRAIN, search_radius_m=3000.0)
    with pytest.raises(NotLocated, match="3000 m") as caught:
        require_inside(points, np.exp(log), small)
    assert caught.value.reason == "outside_search_area"
    points, log = blob((2990.0, 0.0), (20.0, 20.0), 1.0)
    inside = require_inside(points, np.exp(log), small)
    assert np.exp(log)[inside].sum() == pytest.approx(0.69, abs=0.05)
