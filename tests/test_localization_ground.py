"""Positions on real ground: interpolated horizons, the posterior against a plain grid, wrong clocks."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from localization_helpers import WRAPPERS, best_levels, capped_llr, search_scores, slow_sums

from startrack.core.types import MIDDLES_RAD, SECTORS, Array, Clock, Evidence, NotLocated, sector_of
from startrack.localization import ExactPosterior, posterior
from startrack.localization.conclusion import conclude
from startrack.localization.likelihood.skyline_model import SkylineModel
from startrack.localization.search import BEAMS, BoxModel
from startrack.terrain import HeightMap, load_terrain
from startrack.terrain.shape import EXACT_WAVES

pytestmark = pytest.mark.usefixtures("own_cache")


@pytest.fixture(scope="module")
def shackleton() -> HeightMap:
    terrain = load_terrain("shackleton")
    assert isinstance(terrain, HeightMap)
    terrain = replace(
        terrain, search_radius_m=300.0, height_sigma_m=0.0, horizon_sigma_common_rad=0.0, waves_sigma_rad=EXACT_WAVES
    )
    terrain.prepare()
    return terrain


def simulate_rays(terrain: HeightMap, place: Array, rng: np.random.Generator, rays: int, sigma_rad: float) -> Evidence:
    """Rays of signal-to-noise ratio 1 to 4 near the skyline."""
    azimuth = rng.uniform(0, 2 * np.pi, rays)
    horizon = terrain.horizon_rad(place[None], azimuth)
    elevation = horizon + rng.uniform(-0.06, 0.06, rays)
    snr = rng.uniform(1, 4, rays)
    light = snr * (elevation + sigma_rad * rng.normal(size=rays) > horizon) + rng.normal(size=rays)
    return Evidence(
        azimuth_rad=azimuth, elevation_rad=elevation, llr=np.clip(snr * light - snr**2 / 2, -9, 9),
        edge_sigma_rad=np.full(rays, sigma_rad),
    )  # fmt: skip


def test_the_posterior_is_sampled_in_a_neighbourhood_as_small_as_it(shackleton, monkeypatch):
    """Beside crests at 200 m, horizons between nodes that are 20 m apart are wrong by a fifth of a pixel."""
    seen = []
    monkeypatch.setattr(posterior, "conclude", lambda found, *rest: seen.append(found) or conclude(found, *rest))
    rows = simulate_rays(shackleton, np.array([50.0, -90.0]), np.random.default_rng(5), 12_000, 0.0)
    fix = ExactPosterior()(rows, shackleton)
    sigma_m = np.sqrt(np.linalg.eigvalsh(fix.covariance_m2)[1])
    assert sigma_m < 1.5
    assert 8.0 * sigma_m < seen[0][0].model.around.half_m < 24.0 * sigma_m


@pytest.mark.slow
def test_between_traced_points_the_horizon_is_the_traced_one_and_bounds_hold(shackleton):
    rng = np.random.default_rng(1)
    azimuth = np.sort(rng.uniform(0, 2 * np.pi, 60))
    near = shackleton.near(np.array([40.0, -60.0]), 50.0, azimuth, 6)
    places = near.centre_m + rng.uniform(-50, 50, (40, 1, 2))
    traced = shackleton.horizon_rad(places, azimuth)
    off = np.degrees(near.horizon_rad(places, azimuth) - traced)
    assert np.abs(off).max() < 0.005
    assert np.sqrt(np.mean(off**2)) < 0.0005
    centres, which = near.centre_m + rng.uniform(-40, 40, (300, 2)), azimuth[rng.integers(0, 60, 300)]
    for half in (8.0, 2.0):
        low, high = near.horizon_bounds_rad(centres, np.array(half), which)
        inside = centres[:, None] + rng.uniform(-half, half, (300, 20, 2))
        horizon = shackleton.horizon_rad(inside, which[:, None])
        assert np.all(low[:, None] - 1e-9 <= horizon)
        assert np.all(horizon <= high[:, None] + 1e-9)
        assert np.median(high - low) < np.radians(0.03 * half)


def test_box_averages_equal_those_of_random_horizons_between_the_bounds(shackleton):
    rng = np.random.default_rng(6)
    evidence = simulate_rays(shackleton, np.array([-80.0, 30.0]), rng, 3000, 0.0)
    centres, half = np.array([[-90.0, 40.0], [150.0, -20.0]]), 40.0
    found, sector = BoxModel.of(evidence, shackleton).averages(centres, half), sector_of(evidence.azimuth_rad)
    low, high = shackleton.horizon_bounds_rad(centres[:, None], np.array(half), MIDDLES_RAD, np.pi / SECTORS)
    best, llr, draws = best_levels(evidence), capped_llr(evidence), (np.arange(4000) + 0.5) / 4000
    for box in range(2):
        below = np.zeros((len(draws), SECTORS))
        for s in range(SECTORS):
            horizon, own = low[box, s] + (high - low)[box, s] * draws, sector == s
            below[:, s] = (llr[own] * (evidence.elevation_rad[own] > horizon[:, None])).sum(axis=1) - best[s]
        mean = np.exp(below).mean(axis=0)
        (plain,) = search_scores(np.log(mean + 1e-300)[None], best)
        assert found[box] == pytest.approx(plain, abs=3.0)  # the table has steps of 0.04 degrees
    assert found[0] > found[1] + 50


def test_the_places_of_a_beam_are_near_the_top(shackleton):
    for seed in range(6):
        rng = np.random.default_rng([7, seed])
        place = rng.uniform(-200, 200, 2)
        evidence = simulate_rays(shackleton, place, rng, 1500, 0.0005)
        model = BoxModel.of(evidence, shackleton)
        best = model.fit_places(*model.last_boxes(*BEAMS[0]))[0]
        exact = SkylineModel.of(shackleton, evidence, place, 5.0, model.errors)
        assert best.log_likelihood > exact.log_likelihood(place[None])[0] + exact.seen.log_offset - 3.0
        off = best.position_m - place
        assert off @ np.linalg.solve(best.covariance_m2, off) < 14.0


def test_stars_of_another_position_or_time_are_refused(shackleton):
    rng = np.random.default_rng(8)
    evidence = simulate_rays(shackleton, np.array([50.0, -120.0]), rng, 3000, 0.0005)
    assert ExactPosterior()(evidence, shackleton).radius95_m < 50.0
    turned = replace(evidence, azimuth_rad=np.mod(evidence.azimuth_rad + np.radians(60), 2 * np.pi))
    with pytest.raises(NotLocated, match=r"unlike the map's|on no map|outside the search area"):
        ExactPosterior()(turned, shackleton)


def test_no_allowed_ground_is_given_up(shackleton):
    """Small patches of ground flat enough: large boxes must not be dropped because a few points in them are steep."""
    slopes = np.degrees(shackleton.slope_rad(np.random.default_rng(9).uniform(-200, 200, (4000, 2))))
    limited = replace(shackleton, most_slope_rad=np.radians(np.quantile(slopes, 0.02)))
    places = np.random.default_rng(10).uniform(-200, 200, (20_000, 2))
    place = places[np.asarray(limited.allowed(places))][0]
    evidence = simulate_rays(shackleton, place, np.random.default_rng(11), 1500, 0.0005)
    fix = ExactPosterior()(evidence, limited)
    assert np.linalg.norm(fix.position_enu_m[:2] - place) < max(fix.radius999_m, 1.0)
    with pytest.raises(NotLocated, match="max_slope_deg"):
        ExactPosterior()(evidence, replace(limited, most_slope_rad=0.0))


@pytest.mark.slow
@pytest.mark.parametrize("sigma_rad", [0.0, 0.001])
def test_posterior_on_ground_equals_a_plain_grid(shackleton, sigma_rad):
    rng = np.random.default_rng(3)
    place = np.array([120.0, 60.0])
    evidence = simulate_rays(shackleton, place, rng, 1500, sigma_rad)
    fix = ExactPosterior(budget_horizons=1e7)(evidence, shackleton)
    step = float(np.sqrt(np.linalg.eigvalsh(fix.covariance_m2)[0])) / 3
    reach = 4.5 * float(np.sqrt(np.linalg.eigvalsh(fix.covariance_m2)[1]))
    line = np.arange(-reach, reach, step)
    grid = fix.position_enu_m[:2] + np.stack(np.meshgrid(line, line), axis=-1).reshape(-1, 2)
    log = np.concatenate([slow_sums(some, evidence, shackleton).sum(axis=1) for some in np.array_split(grid, 8)])
    weight = np.exp(log - log.max())
    weight /= weight.sum()
    mean = weight @ grid
    spread = np.einsum("n,ni,nj->ij", weight, grid - mean, grid - mean)
    sigma = np.sqrt(np.trace(spread))
    assert np.linalg.norm(fix.position_enu_m[:2] - mean) < 0.15 * sigma  # horizons are interpolated between nodes
    assert fix.covariance_m2 == pytest.approx(spread, abs=0.12 * sigma**2)
    assert fix.search == "proven"
    assert fix.dropped_probability < 1e-3


def test_a_common_error_is_reported_and_not_taken_for_a_wrong_map(shackleton):
    rng, error = np.random.default_rng(4), np.radians(0.08)
    unsure = replace(shackleton, horizon_sigma_common_rad=np.radians(0.1))
    evidence = simulate_rays(shackleton, np.array([50.0, -90.0]), rng, 4000, 0.0)
    evidence = replace(evidence, elevation_rad=evidence.elevation_rad + error)
    fix = ExactPosterior()(evidence, unsure)
    assert fix.horizon_error_rad == pytest.approx(error, abs=np.radians(0.02))
    assert np.linalg.norm(fix.position_enu_m[:2] - [50.0, -90.0]) < fix.radius999_m


@pytest.mark.slow
@pytest.mark.parametrize("gross_probability", [0.0, 0.01])
def test_a_sky_turned_by_a_wrong_clock_is_refused_or_its_time_is_found(shackleton, gross_probability):
    """Two hours off: found where the clock is not stated, so that it may be grossly wrong, and refused where it is."""
    rng = np.random.default_rng(5)
    place = np.array([50.0, -90.0])
    evidence = simulate_rays(shackleton, place, rng, 12_000, 0.0)
    clock = Clock(
        turn_rad_s=np.array([0.0, 0.0, -np.radians(0.55) / 3600]), sigma_s=1.0, gross_probability=gross_probability,
        gross_sigma_s=3600.0,
    )  # fmt: skip
    right = ExactPosterior()(replace(evidence, clock=clock), shackleton)
    assert np.linalg.norm(right.position_enu_m[:2] - place) < right.radius999_m
    assert abs(right.clock.offset_s) < 10.0
    turned = replace(evidence, azimuth_rad=np.mod(evidence.azimuth_rad + np.radians(1.1), 2 * np.pi), clock=clock)
    if not gross_probability:
        with pytest.raises(NotLocated, match="time") as refused:
            ExactPosterior()(turned, shackleton)
        assert refused.value.reason == "inconsistent_evidence"
        return
    fix = ExactPosterior()(turned, shackleton)
    assert np.linalg.norm(fix.position_enu_m[:2] - place) < fix.radius999_m
    assert abs(fix.clock.offset_s + 7200) < 4 * fix.clock.sigma_s < 1500
    assert [one.name for one in fix.shown] == ["clock_s"]


@pytest.mark.parametrize("wrapper", WRAPPERS)
def test_a_wrapped_map_gives_the_maps_own_fix(shackleton, wrapper):
    evidence = simulate_rays(shackleton, np.array([-60.0, 110.0]), np.random.default_rng(14), 3000, 0.0005)
    own, wrapped = ExactPosterior()(evidence, shackleton), ExactPosterior()(evidence, wrapper(shackleton))
    atol = 1e-6 if wrapper is not WRAPPERS[-1] else 0.3  # which traces every horizon, and interpolates none
    np.testing.assert_allclose(wrapped.position_enu_m[:2], own.position_enu_m[:2], atol=atol)


def test_an_unfinished_proof_gives_the_posterior_near_the_best_positions(shackleton):
    evidence = simulate_rays(shackleton, np.array([-60.0, 110.0]), np.random.default_rng(15), 3000, 0.0005)
    beam = ExactPosterior(budget_horizons=1.0)(evidence, shackleton)
    proven = ExactPosterior(budget_horizons=1e9)(evidence, shackleton)
    assert (proven.search, beam.search) == ("proven", "beam")
    assert beam.dropped_probability is None
    assert proven.dropped_probability < 1e-3
    sigma = np.sqrt(np.trace(proven.covariance_m2))
    assert np.linalg.norm(beam.position_enu_m - proven.position_enu_m) < 0.2 * sigma
    np.testing.assert_allclose(beam.covariance_m2, proven.covariance_m2, atol=0.2 * sigma**2)
    away = replace(evidence, azimuth_rad=np.mod(evidence.azimuth_rad + 1.0, 2 * np.pi))
    with pytest.raises(NotLocated, match=r"unlike the map's|on no map|outside the search area"):
        ExactPosterior(budget_horizons=1.0)(away, shackleton)


def test_a_search_without_a_proof_looks_elsewhere_than_the_first_beam(shackleton, monkeypatch):
    """On rough maps a narrow beam may find a wrong place: where nothing is proven, the wider beams follow."""
    at, wrong = np.array([-60.0, 110.0]), np.array([[150.0, -90.0]])
    evidence = simulate_rays(shackleton, at, np.random.default_rng(15), 3000, 0.0005)
    last_boxes = BoxModel.last_boxes
    monkeypatch.setattr(
        BoxModel, "last_boxes", lambda self, width, traced: last_boxes(self, width, traced) if traced else (wrong, 12.0)
    )
    explored = ExactPosterior(budget_horizons=1.0).explore(evidence, shackleton)
    assert explored.search == "beam"
    assert np.linalg.norm(explored.centres_m[np.argmax(explored.log_weight)] - at) < 20.0
