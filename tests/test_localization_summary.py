"""From weighted boxes to a fix: probabilities of the circles, and modes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from startrack.localization.summary import smallest_axis, summarize
from startrack.terrain import Cylinder, load_terrain
from startrack.types import Fix, NotLocated

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


def fix_of(*blobs: tuple[np.ndarray, np.ndarray]) -> Fix:
    centres, log = (np.concatenate(part) for part in zip(*blobs, strict=True))
    return summarize(centres, WIDTH_M, log, 1e-7, TERRAIN)


def test_one_gaussian() -> None:
    fix = fix_of(blob((3000.0, -1000.0), (20.0, 6.0), 1.0))
    assert fix.position_enu_m == pytest.approx([3000.0, -1000.0, TERRAIN.camera_height_m], abs=1.0)
    assert fix.covariance_m2 == pytest.approx(np.diag([400.0, 36.0]), rel=0.02, abs=0.5)
    rng = np.random.default_rng(1)
    drawn = np.hypot(*(rng.normal(size=(200_000, 2)) * [20.0, 6.0]).T)
    assert fix.radius95_m == pytest.approx(np.percentile(drawn, 95), abs=2 * WIDTH_M)
    assert fix.radius999_m == pytest.approx(np.percentile(drawn, 99.9), abs=2 * WIDTH_M)
    assert [mode.weight for mode in fix.modes] == pytest.approx([1.0])
    assert not fix.ambiguous
    assert fix.dropped_probability == 1e-7


def test_a_weak_second_mode_does_not_shift_the_position() -> None:
    fix = fix_of(blob((3000.0, 2000.0), (6.0, 6.0), 0.995), blob((-5000.0, -3000.0), (6.0, 6.0), 0.005))
    assert not fix.ambiguous  # less than 1 %
    assert fix.position_enu_m[:2] == pytest.approx([3000.0, 2000.0], abs=1.0)  # the mean of both is 47 m away
    assert np.sqrt(np.diag(fix.covariance_m2)) == pytest.approx([6.0, 6.0], rel=0.05)
    assert fix.radius95_m < 20.0
    assert fix.radius999_m > 9000.0  # but it is there
    assert [round(mode.weight, 4) for mode in fix.modes] == [0.995, 0.005]


def test_a_second_mode_of_a_few_per_cent_is_ambiguous() -> None:
    fix = fix_of(
        blob((3000.0, 2000.0), (6.0, 6.0), 0.6), blob((3000.0, -2000.0), (8.0, 4.0), 0.37),
        blob((-100.0, 0.0), (5.0, 5.0), 0.03),
    )  # fmt: skip
    assert fix.ambiguous
    assert [(round(m.east_m), round(m.north_m)) for m in fix.modes] == [(3000, 2000), (3000, -2000), (-100, 0)]
    assert [m.weight for m in fix.modes] == pytest.approx([0.6, 0.37, 0.03], abs=1e-3)
    rng = np.random.default_rng(2)
    for mode, sigma_m in zip(fix.modes, ([6.0, 6.0], [8.0, 4.0], [5.0, 5.0]), strict=True):
        drawn = np.hypot(*(rng.normal(size=(200_000, 2)) * sigma_m).T)  # the circles of a mode hold its own part
        assert mode.radius95_m == pytest.approx(np.percentile(drawn, 95), abs=WIDTH_M)
        assert mode.radius999_m == pytest.approx(np.percentile(drawn, 99.9), abs=WIDTH_M)


def test_a_long_thin_posterior_is_one_mode() -> None:
    fix = fix_of(blob((0.0, 1000.0), (300.0, 3.0), 1.0))
    assert len(fix.modes) == 1
    assert not fix.ambiguous


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(1, 400), st.floats(0.1, 6.0))
def test_circles_contain_their_probability(seed: int, n: int, spread: float) -> None:
    """Any weights on any boxes: the circles hold 95 and 99.9 %, and no much smaller ones would."""
    rng = np.random.default_rng(seed)
    cells = np.unique(rng.integers(-15, 16, (n, 2)), axis=0)
    centres, log = WIDTH_M * cells + [500.0, 0.0], spread * rng.normal(size=len(cells))
    fix = summarize(centres, WIDTH_M, log, 0.0, TERRAIN)
    weight = np.exp(log - log.max())
    weight /= weight.sum()
    distance = np.linalg.norm(centres - fix.position_enu_m[:2], axis=1)
    for radius, mass in ((fix.radius95_m, 0.95), (fix.radius999_m, 0.999)):
        assert weight[distance <= radius].sum() >= mass - 1e-9
        assert weight[distance < radius - 1.5 * WIDTH_M].sum() < mass + 1e-9
    assert fix.radius95_m <= fix.radius999_m
    assert sum(mode.weight for mode in fix.modes) == pytest.approx(1.0)
    assert np.all(np.diff([mode.weight for mode in fix.modes]) <= 1e-12)
    assert np.linalg.eigvalsh(fix.covariance_m2)[0] >= WIDTH_M**2 / 12 - 1e-9


def test_most_of_the_posterior_outside_the_search_area_is_refused() -> None:
    centres, log = blob((3200.0, 0.0), (20.0, 20.0), 1.0)
    with pytest.raises(NotLocated, match="3000 m") as caught:
        summarize(centres, WIDTH_M, log, 0.0, replace(TERRAIN, search_radius_m=3000.0))
    assert caught.value.reason == "outside_search_area"
    # Near the border only the probability inside the search area counts.
    centres, log = blob((2990.0, 0.0), (20.0, 20.0), 1.0)
    fix = summarize(centres, WIDTH_M, log, 0.0, replace(TERRAIN, search_radius_m=3000.0))
    assert fix.position_enu_m[0] < 2985.0
    assert max(mode.east_m for mode in fix.modes) < 3000.0


def test_a_posterior_as_wide_as_the_area_is_refused() -> None:
    line = np.arange(-9000.0, 9001.0, 300.0)
    x, y = np.meshgrid(line, line)
    centres = np.stack([x.ravel(), y.ravel()], axis=1)
    centres = centres[np.hypot(*centres.T) < 9900]
    with pytest.raises(NotLocated, match="open") as caught:
        summarize(centres, 300.0, np.zeros(len(centres)), 0.0, TERRAIN)
    assert caught.value.reason == "insufficient_geometry"


def test_the_smallest_axis_is_a_mode_s_own():
    places, sigmas = ((0.0, 0.0), (3000.0, 0.0), (0.0, 4000.0)), ((40.0, 9.0), (20.0, 12.0), (15.0, 30.0))
    blobs = [blob(place, sigma, part) for place, sigma, part in zip(places, sigmas, (0.5, 0.3, 0.2), strict=True)]
    centres, log = (np.concatenate(part) for part in zip(*blobs, strict=True))
    assert smallest_axis(centres, WIDTH_M, log) == pytest.approx(9.0, rel=0.05)
    one = slice(0, len(blobs[0][0]))
    assert smallest_axis(centres[one], WIDTH_M, log[one]) == pytest.approx(9.0, rel=0.05)
