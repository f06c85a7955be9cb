"""Methods that compare skylines on a grid, against brute force; the skylines that they get."""

from dataclasses import replace

import numpy as np
import pytest

from startrack.applications.reproduction.published.cozman_krotkov import (
    TAIL_SHARE,
    bound_means,
    locate_by_posterior,
    log_likelihoods,
)
from startrack.applications.reproduction.published.skylines import (
    LIT_SIGMA_RAD,
    MAP_STEP_M,
    MapGrid,
    close_gaps,
    lit_skyline,
    traced_grid,
)
from startrack.applications.reproduction.published.talluri_aggarwal import (
    cardinal_sectors,
    locate_by_four_bearings,
    positions_with_elevations,
)
from startrack.applications.reproduction.simulator import crater, draw_positions
from startrack.core.types import MIDDLES_RAD, SECTORS, MeasuredSkyline, NotLocated

CRATER = crater()
PLACES = draw_positions(0, 0, 0, 12)


@pytest.fixture(scope="module")
def grid():
    return traced_grid(CRATER)


@pytest.fixture(scope="module")
def lit():
    return [lit_skyline(place, CRATER, rng=np.random.default_rng(k)) for k, place in enumerate(PLACES)]


def distances(answers):
    return np.hypot(*(np.array(answers) - PLACES).T)


def nothing_seen():
    unknown = np.full(SECTORS, np.nan)
    return MeasuredSkyline(
        azimuth_rad=MIDDLES_RAD, elevation_rad=unknown, sigma_rad=np.full(SECTORS, np.inf), source=np.full(SECTORS, "")
    )


def test_the_grid_has_the_skylines_of_its_positions(grid):
    assert len(grid.points_m) == pytest.approx(np.pi * (1e4 / MAP_STEP_M) ** 2, rel=0.01)
    some = np.arange(0, len(grid.points_m), 5000)
    expected = [CRATER.horizon_rad(np.tile(grid.points_m[k], (SECTORS, 1)), MIDDLES_RAD) for k in some]
    np.testing.assert_allclose(grid.horizon_rad[some], expected, rtol=1e-6)


def test_a_lit_skyline_has_one_pixel_of_noise(lit):
    errors = [one.elevation_rad - CRATER.horizon_rad(np.tile(place, (SECTORS, 1)), MIDDLES_RAD)
              for one, place in zip(lit, PLACES, strict=True)]  # fmt: skip
    assert np.std(errors) == pytest.approx(LIT_SIGMA_RAD, rel=0.05)


def test_gaps_of_a_skyline_are_closed_between_known_bearings(lit):
    some = replace(lit[0], elevation_rad=np.where(np.arange(SECTORS) % 3 == 0, lit[0].elevation_rad, np.nan))
    whole = close_gaps(some)
    np.testing.assert_array_equal(whole[::3], lit[0].elevation_rad[::3])
    assert whole[1] == pytest.approx((2 * whole[0] + whole[3]) / 3)


def test_the_four_bearings_are_the_known_ones_nearest_to_north_east_south_and_west(lit):
    assert set(cardinal_sectors(lit[0])) <= {0, 239, 59, 60, 119, 120, 179, 180}
    elevation = np.where(np.isin(np.arange(SECTORS), [50, 75, 121, 170, 230]), 0.2, np.nan)
    some = replace(lit[0], elevation_rad=elevation)
    np.testing.assert_array_equal(cardinal_sectors(some), [230, 50, 121, 170])


def test_four_bearings_keep_the_cell_of_the_position(grid, lit):
    for place, skyline in zip(PLACES, lit, strict=True):
        left = positions_with_elevations(skyline, CRATER, grid.points_m)
        own = np.argmin(np.hypot(*(grid.points_m - place).T))
        assert left[own] and left.sum() < 0.02 * len(left)


def test_four_bearings_give_the_best_of_all_positions(grid, lit):
    answers = [locate_by_four_bearings(skyline, CRATER, grid) for skyline in lit]
    for answer, skyline in zip(answers, lit, strict=True):
        squares = np.square(grid.horizon_rad - skyline.elevation_rad).mean(axis=1)
        np.testing.assert_array_equal(answer, grid.points_m[np.argmin(squares)])
    assert distances(answers).max() < 2 * MAP_STEP_M


def test_the_likelihood_of_a_skyline_is_that_of_the_formula(grid, lit):
    few = MapGrid(grid.points_m[::9000], grid.horizon_rad[::9000])
    for found, horizon in zip(log_likelihoods(lit[0], few), few.horizon_rad.astype(float), strict=True):
        z = (horizon - lit[0].elevation_rad) / LIT_SIGMA_RAD
        normal = np.exp(-0.5 * z**2) / (np.sqrt(2 * np.pi) * LIT_SIGMA_RAD)
        assert found == pytest.approx(np.sum(np.log((1 - TAIL_SHARE) * normal + TAIL_SHARE * 2 / np.pi)), rel=1e-5)


def test_a_posterior_finds_the_position_and_bounds_it(grid, lit):
    answers = [locate_by_posterior(skyline, grid) for skyline in lit]
    assert distances([answer.mean_m for answer in answers]).max() < 2 * MAP_STEP_M
    for answer in answers:
        assert (answer.low_m - 1e-6 <= answer.mean_m).all() and (answer.mean_m <= answer.high_m + 1e-6).all()


def test_no_contaminated_prior_has_a_mean_beyond_the_bounds():
    rng = np.random.default_rng(0)
    points, likelihood, share = rng.normal(size=(6, 2)), rng.random(6), 0.2
    low, high = bound_means(points, likelihood, share)
    for q in [*rng.dirichlet(np.full(6, 0.2), 2000), *np.eye(6)]:
        posterior = likelihood * ((1 - share) / 6 + share * q)
        mean = posterior @ points / posterior.sum()
        assert (low - 1e-12 <= mean).all() and (mean <= high + 1e-12).all()
    corner = likelihood[:, None] * ((1 - share) / 6 + share * np.eye(6))
    means = corner.T @ points / corner.sum(axis=0)[:, None]
    np.testing.assert_allclose([means.min(axis=0), means.max(axis=0)], [low, high])


def test_without_a_skyline_there_is_no_position(grid):
    for locate in (lambda one: locate_by_four_bearings(one, CRATER, grid), lambda one: locate_by_posterior(one, grid)):
        with pytest.raises(NotLocated, match="0 sectors"):
            locate(nothing_seen())
