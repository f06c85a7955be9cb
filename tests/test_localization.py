"""Localizers: one contract for all, and the exact posterior against brute force."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from startrack.localization import ExactPosterior, Hull, Localizer, PseudoGradient
from startrack.localization.branch_and_bound import by_sector, ray_by_ray, split
from startrack.localization.grid_search import scores
from startrack.localization.prefix_sums import Profile
from startrack.localization.sector_likelihood import Sectors, contribution
from startrack.terrain import Cylinder, load_terrain
from startrack.types import Array, Evidence, NotLocated

TERRAIN = load_terrain("shackleton-thesis")
assert isinstance(TERRAIN, Cylinder)
THESIS_STARS = 2142  # Kua 2008, eq. 3.8 at magnitude 6


def sky(rng: np.random.Generator, n: int) -> tuple[Array, Array]:
    return 2 * np.pi * rng.random(n), np.arcsin(rng.random(n))


def place(rng: np.random.Generator, terrain: Cylinder = TERRAIN) -> Array:
    r, b = 0.98 * terrain.radius_m * np.sqrt(rng.random()), 2 * np.pi * rng.random()
    return r * np.array([np.sin(b), np.cos(b)])


def perfect_list(rng: np.random.Generator, at_m: Array, n: int = THESIS_STARS) -> Evidence:
    azimuth, elevation = sky(rng, n)
    seen = elevation > TERRAIN.horizon_rad(at_m[None], azimuth)
    return Evidence(
        azimuth_rad=azimuth, elevation_rad=elevation, llr=np.where(seen, 12.0, -12.0), edge_sigma_rad=np.zeros(n)
    )


def measured(rng: np.random.Generator, at_m: Array, terrain: Cylinder, n: int, sigma_rad: float = 0.0) -> Evidence:
    """Stars of SNR 1 to 4, each with a noisy light measurement."""
    azimuth, elevation = sky(rng, n)
    snr = 1 + 3 * rng.random(n)
    edge = elevation + sigma_rad * rng.standard_normal(n)
    flux = snr * (edge > terrain.horizon_rad(at_m[None], azimuth)) + rng.standard_normal(n)
    return Evidence(
        azimuth_rad=azimuth, elevation_rad=elevation, llr=np.clip(snr * flux - snr**2 / 2, -9, 9),
        edge_sigma_rad=np.full(n, sigma_rad),
    )  # fmt: skip


@pytest.mark.parametrize(
    ("method", "mean_m", "most_m"),
    [(ExactPosterior(compiled=True), 28.0, 200.0), (PseudoGradient(), 50.0, 400.0), (Hull(), 800.0, 2500.0)],
    ids=["exact", "pseudo-gradient", "hull"],
)
def test_contract_of_every_localizer(method: Localizer, mean_m: float, most_m: float) -> None:
    """On the thesis's perfect lists each method reaches its known error, and says what a fix must say."""
    errors = []
    for seed in range(40):
        rng = np.random.default_rng(seed)
        at = place(rng)
        fix = method(perfect_list(rng, at), TERRAIN)
        errors.append(np.linalg.norm(fix.position_enu_m[:2] - at))
        assert fix.position_enu_m[2] == TERRAIN.camera_height_m
        assert np.linalg.eigvalsh(fix.covariance_m2).min() > 0
        assert 0 < fix.radius95_m < fix.radius999_m
        assert sum(mode.weight for mode in fix.modes) == pytest.approx(1.0)
        assert not fix.ambiguous
    assert np.mean(errors) < mean_m
    assert np.max(errors) < most_m


@pytest.mark.parametrize("method", [ExactPosterior(), PseudoGradient(), Hull()])
def test_nothing_to_see_is_refused_by_every_localizer(method: Localizer) -> None:
    none = np.zeros(0)
    with pytest.raises(NotLocated):
        method(Evidence(azimuth_rad=none, elevation_rad=none, llr=none, edge_sigma_rad=none), TERRAIN)


SMALL = replace(TERRAIN, diameter_m=400.0, depth_m=60.0, search_radius_m=200.0)


@pytest.mark.parametrize("sigma_rad", [0.0, 0.01])
@pytest.mark.parametrize("epsilon", [0.0, 1e-3])
@pytest.mark.parametrize("seed", range(2))
def test_exact_posterior_equals_brute_force(seed: int, epsilon: float, sigma_rad: float) -> None:
    """Mean, covariance and the 95 % circle of a grid of 1 m over the whole floor of a small crater."""
    rng = np.random.default_rng(seed)
    evidence = measured(rng, place(rng, SMALL), SMALL, 250, sigma_rad)
    method = ExactPosterior(sector_epsilon=epsilon, boxes_per_sigma=6.0)
    fix = method(evidence, SMALL)
    line = np.arange(-200.0, 200.0, 1.0) + 0.5
    x, y = np.meshgrid(line, line)
    grid = np.stack([x.ravel(), y.ravel()], axis=1)
    grid = grid[np.hypot(grid[:, 0], grid[:, 1]) < 200.0]
    sectors = Sectors.of(evidence, method.sector_width_rad, epsilon)
    log = np.concatenate([scores(some, evidence, sectors, SMALL) for some in np.array_split(grid, 60)])
    weight = np.exp(log - log.max())
    weight /= weight.sum()
    mean = weight @ grid
    spread = np.einsum("n,ni,nj->ij", weight, grid - mean, grid - mean)
    sigma = np.sqrt(np.trace(spread))
    assert np.linalg.norm(fix.position_enu_m[:2] - mean) < 0.05 * sigma + 0.1
    np.testing.assert_allclose(fix.covariance_m2, spread, atol=0.1 * sigma**2 + 0.2)
    distance = np.linalg.norm(grid - fix.position_enu_m[:2], axis=1)
    assert weight[distance < fix.radius95_m].sum() == pytest.approx(0.95, abs=0.03)
    assert fix.dropped_mass < 1e-3


def test_bounds_hold_at_random_places_of_every_box() -> None:
    """Both kinds of bounds, on two levels, with soft edges."""
    rng = np.random.default_rng(8)
    evidence = measured(rng, place(rng), TERRAIN, 400, 0.002)
    sectors = Sectors.of(evidence, float(np.radians(1.5)), 1e-4)
    profile = Profile.of(sectors)
    centres = np.array([[1000.0, 2000.0], [-7000.0, 3000.0], [6500.0, -6500.0]])
    coarse, first, last = by_sector(centres, 300.0, sectors, profile, TERRAIN)
    by_ray = ray_by_ray(coarse, first, last, sectors, profile, TERRAIN)
    for boxes in (coarse, by_ray, split(by_ray, sectors, profile, TERRAIN)):
        for k in range(len(boxes)):
            inside = boxes.centres_m[k] + boxes.half_m * (2 * rng.random((60, 2)) - 1)
            inside = inside[TERRAIN.allowed(inside)]
            score = scores(inside, evidence, sectors, TERRAIN)
            assert np.all(score >= boxes.lower[k] - 1e-2)
            assert np.all(score <= boxes.upper[k] + 1e-2)


def test_errors_are_as_large_as_stated() -> None:
    """150 noisy skies: mean NEES 2, and the 95 % circle holds 95 %. Bounds are 3.5 sigma of the count."""
    nees, within = [], []
    for seed in range(150):
        rng = np.random.default_rng(1000 + seed)
        at = place(rng)
        fix = ExactPosterior(compiled=True)(measured(rng, at, TERRAIN, 3000), TERRAIN)
        d = fix.position_enu_m[:2] - at
        nees.append(d @ np.linalg.solve(fix.covariance_m2, d))
        within.append(np.linalg.norm(d) < fix.radius95_m)
    assert 1.4 < np.mean(nees) < 2.6
    assert 0.89 < np.mean(within) <= 1.0


@pytest.mark.parametrize("compiled", [False, True])
def test_two_places_that_fit_are_both_named(compiled: bool) -> None:
    """Stars due east and due west only: a place and its mirror image to the south see the same horizon there."""
    rng = np.random.default_rng(3)
    n, at = 1500, np.array([2000.0, 6000.0])
    azimuth = np.where(rng.random(n) < 0.5, np.pi / 2, 3 * np.pi / 2)
    elevation, snr = np.radians(60) * rng.random(n), 1 + 3 * rng.random(n)
    flux = snr * (elevation > TERRAIN.horizon_rad(at[None], azimuth)) + rng.standard_normal(n)
    llr = np.clip(snr * flux - snr**2 / 2, -9, 9)
    evidence = Evidence(azimuth_rad=azimuth, elevation_rad=elevation, llr=llr, edge_sigma_rad=np.zeros(n))
    fix = ExactPosterior(sector_epsilon=0.0, compiled=compiled)(evidence, TERRAIN)
    assert fix.ambiguous
    first, second = fix.modes[:2]
    assert first.weight == pytest.approx(0.5, abs=0.1)
    assert first.north_m == pytest.approx(-second.north_m, abs=100.0)
    assert abs(first.north_m) == pytest.approx(6000.0, abs=300.0)
    assert first.east_m == pytest.approx(2000.0, abs=300.0)


def test_a_camera_outside_the_search_area_is_refused() -> None:
    rng = np.random.default_rng(4)
    evidence = perfect_list(rng, np.array([3300.0, 0.0]))
    with pytest.raises(NotLocated) as refusal:
        ExactPosterior()(evidence, replace(TERRAIN, search_radius_m=3000.0))
    assert refusal.value.reason == "outside_search_area"


def test_stars_high_above_the_rim_locate_nothing() -> None:
    rng = np.random.default_rng(5)
    azimuth = 2 * np.pi * rng.random(500)
    elevation = np.radians(70 + 20 * rng.random(500))
    evidence = Evidence(
        azimuth_rad=azimuth, elevation_rad=elevation, llr=np.full(500, 9.0), edge_sigma_rad=np.zeros(500)
    )
    with pytest.raises(NotLocated) as refusal:
        ExactPosterior()(evidence, TERRAIN)
    assert refusal.value.reason == "insufficient_geometry"


def test_soft_edge_is_the_mixture_of_both_cases() -> None:
    from scipy.stats import norm

    rng = np.random.default_rng(6)
    llr, elevation, horizon, sigma = 6 * rng.standard_normal(50), rng.random(50), rng.random(50), 0.3 * rng.random(50)
    visible = norm.cdf((elevation - horizon) / sigma)
    expected = np.log(visible * np.exp(llr) + 1 - visible)
    np.testing.assert_allclose(contribution(llr, elevation, horizon, sigma), expected, atol=1e-12)


def test_a_boulder_costs_no_more_than_its_sectors() -> None:
    """Twenty degrees of azimuth wholly dark: the fix stays where it is."""
    rng = np.random.default_rng(7)
    at = np.array([-2500.0, 4000.0])
    evidence = measured(rng, at, TERRAIN, 6000)
    dark = (np.degrees(evidence.azimuth_rad) < 20) & (evidence.elevation_rad < np.radians(30))
    llr = np.where(dark, -9.0, evidence.llr)
    hidden = replace(evidence, llr=llr)
    fix = ExactPosterior(compiled=True)(hidden, TERRAIN)
    assert np.linalg.norm(fix.position_enu_m[:2] - at) < fix.radius999_m
    # What the dark sectors can say against the place is bounded: 14 sectors of 1.5 degrees at ln(1e-4) each.
    sectors = Sectors.of(hidden, float(np.radians(1.5)), 1e-4)
    clear = Sectors.of(evidence, float(np.radians(1.5)), 1e-4)
    loss = scores(at[None], evidence, clear, TERRAIN)[0] - scores(at[None], hidden, sectors, TERRAIN)[0]
    assert 0 < loss < 14 * -np.log(1e-4)
