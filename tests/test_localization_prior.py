"""A prior of the position: the posterior is the product, the search stays near it, a wrong one is refused."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from localization_helpers import ThreeMethods, slow_chain_scores
from test_localization import SMALL, TwoCraters, measure_stars

from startrack.chain import Settings
from startrack.core.types import Array, Evidence, Fix, NotLocated, PositionPrior
from startrack.localization import ExactPosterior
from startrack.terrain import Cylinder, Terrain, load_terrain

CRATER = load_terrain("shackleton-thesis")
assert isinstance(CRATER, Cylinder)
AT_M = np.array([-3000.0, 2000.0])


def evidence(near: PositionPrior | None = None, *, soft: bool = False, count: int = 700, seed: int = 1) -> Evidence:
    """Stars near the skyline of AT_M, seen or hidden; soft edges make the posterior nearly normal."""
    rng = np.random.default_rng(seed)
    azimuth, edge = 2 * np.pi * rng.random(count), np.radians(0.2) if soft else 0.0
    above = np.radians(6.0) * rng.uniform(-1, 1, count)
    elevation = CRATER.horizon_rad(AT_M[None], azimuth) + above
    llr = np.where(above + edge * rng.standard_normal(count) > 0, 5.0, -5.0)
    return Evidence(azimuth_rad=azimuth, elevation_rad=elevation, llr=llr, edge_sigma_rad=edge, near=near)


def product(fix: Fix, near: PositionPrior) -> tuple[Array, Array]:
    """Mean and covariance of the product of two normal distributions."""
    weight, by_prior = np.linalg.inv(fix.covariance_m2), np.eye(2) / near.sigma_m**2
    covariance = np.linalg.inv(weight + by_prior)
    return covariance @ (weight @ fix.position_enu_m[:2] + by_prior @ near.mean_m), covariance


@pytest.mark.slow
@pytest.mark.parametrize("sigmas", [20.0, 1.0, 0.1])
def test_the_posterior_is_the_product_with_the_prior(sigmas: float) -> None:
    alone = ExactPosterior()(evidence(soft=True), CRATER)
    sigma_m = sigmas * float(np.sqrt(np.linalg.eigvalsh(alone.covariance_m2)[0]))
    near = PositionPrior(alone.position_enu_m[0] + 1.1 * sigma_m, alone.position_enu_m[1] - 0.7 * sigma_m, sigma_m)
    fix = ExactPosterior()(evidence(near, soft=True), CRATER)
    mean, covariance = product(alone, near)
    scale = np.sqrt(np.diag(covariance))
    np.testing.assert_allclose(fix.position_enu_m[:2] / scale, mean / scale, atol=0.15)
    np.testing.assert_allclose(
        fix.covariance_m2 / np.outer(scale, scale), covariance / np.outer(scale, scale), atol=0.12
    )
    assert not fix.ambiguous


@pytest.mark.slow
@pytest.mark.parametrize("terrain", [CRATER, ThreeMethods(CRATER)], ids=["disks", "bounds"])
def test_the_prior_weighs_hard_edges_too(terrain: Terrain) -> None:
    """Against a grid weighed by hand."""
    near = PositionPrior(AT_M[0] + 5.0, AT_M[1] - 3.0, 8.0)
    line = np.linspace(-30.0, 30.0, 61)
    grid = AT_M + np.stack(np.meshgrid(line, line), axis=-1).reshape(-1, 2)
    off = grid - near.mean_m
    log = slow_chain_scores(grid, evidence(), CRATER, AT_M) - np.sum(off**2, axis=1) / (2 * 8.0**2)
    weight = np.exp(log - log.max())
    mean = np.average(grid, axis=0, weights=weight)
    spread = np.cov(grid.T, aweights=weight, ddof=0)
    fix = ExactPosterior()(evidence(near), terrain)
    sigma = np.sqrt(np.diag(spread))
    np.testing.assert_allclose(fix.position_enu_m[:2] / sigma, mean / sigma, atol=0.1)
    np.testing.assert_allclose(fix.covariance_m2 / np.outer(sigma, sigma), spread / np.outer(sigma, sigma), atol=0.1)


@pytest.mark.slow
def test_an_ambiguous_position_becomes_single() -> None:
    """Of two equal craters the prior chooses one."""
    at, terrain = np.array([40.0, -90.0]), TwoCraters()
    rows = measure_stars(np.random.default_rng(3), at, SMALL, 1500)
    assert ExactPosterior()(rows, terrain).ambiguous
    one = ExactPosterior()(replace(rows, near=PositionPrior(500.0, -20.0, 80.0)), terrain)
    assert not one.ambiguous
    assert len(one.modes) == 1
    assert np.linalg.norm(one.position_enu_m[:2] - at - [600.0, 0.0]) < one.radius999_m


@pytest.mark.slow
@pytest.mark.parametrize("off_m", [[150.0, 0.0], [0.0, -300.0], [4000.0, -3000.0]], ids=str)
@pytest.mark.parametrize("sigma_m", [4.0, 10.0])
def test_a_wrong_prior_is_refused(off_m: list[float], sigma_m: float) -> None:
    near = PositionPrior(*(AT_M + off_m), sigma_m)
    with pytest.raises(NotLocated, match=f"--near {near}") as refusal:
        ExactPosterior()(evidence(near), CRATER)
    assert refusal.value.reason == "inconsistent_evidence"


def test_a_prior_outside_the_search_area_is_named() -> None:
    near = PositionPrior(90_000.0, 0.0, 50.0)
    with pytest.raises(
        NotLocated, match=r"--near 90000,0,50 is 90000 m from the origin .* radius .* 10000 m"
    ) as refusal:
        ExactPosterior()(evidence(near), CRATER)
    assert refusal.value.reason == "outside_search_area"


def test_only_the_posterior_takes_a_prior() -> None:
    near = PositionPrior(0.0, 0.0, 10.0)
    assert Settings(near=near).near == near
    with pytest.raises(ValueError, match="only the localizer posterior"):
        Settings(localizer="hull", near=near)
    for numbers in ((0.0, 0.0, 0.0), (np.nan, 0.0, 1.0), (0.0, 0.0, -1.0)):
        with pytest.raises(ValueError, match="above 0"):
            PositionPrior(*numbers)
