"""The sampled posterior of position, shared errors and obstacles: against sums and products written out."""

from __future__ import annotations

from dataclasses import replace
from datetime import UTC, datetime
from typing import Any

import numpy as np
import pytest
from localization_helpers import integral_to, log_at, slow_chain, slow_chain_scores
from scipy.special import ndtr
from test_localization_shape import evidence_at

from startrack.core.types import MIDDLES_RAD, SECTORS, Array, Clock, Evidence, sector_of
from startrack.frames import Site, sky_rotvec_rad
from startrack.localization import ExactPosterior, importance_sampling
from startrack.localization.clock import turn_evidence
from startrack.localization.importance_sampling import moments
from startrack.localization.joint_posterior import sample_posterior
from startrack.localization.likelihood.neighbourhood import Neighbourhood
from startrack.localization.likelihood.obstacle_chain import (
    LEVELS_RAD,
    NODES,
    RISEN,
    STATES,
    WRONG_SECTOR,
    emissions,
    prepare_levels,
    state_probabilities,
    transitions,
)
from startrack.localization.likelihood.shared_errors import SharedErrors
from startrack.localization.likelihood.skyline_model import SkylineModel
from startrack.localization.likelihood.skyline_profiles import HIGH_RAD, LOW_RAD, ROW_NATS, profiles_of
from startrack.localization.likelihood.smooth_skyline import free_log_likelihood
from startrack.terrain import Cylinder, Terrain, load_terrain

CRATER = load_terrain("shackleton-thesis")
assert isinstance(CRATER, Cylinder)
PLACE = np.array([3000.0, -2000.0])
HEIGHTS_RAD = np.radians([-9.0, -1.3, -0.2, -0.03, 0.0, 0.05, 0.4, 2.2, 11.0])


def behind(rows: Evidence, place_m: Array, from_deg: float, width_deg: float, height_deg: float) -> Evidence:
    """The rows with those dark that something on no map hides."""
    above = rows.elevation_rad - CRATER.horizon_rad(place_m[None], rows.azimuth_rad)
    inside = (np.degrees(rows.azimuth_rad) - from_deg) % 360 < width_deg
    hidden = inside & (above > 0) & (above < np.radians(height_deg))
    return replace(rows, llr=np.where(hidden, -np.abs(rows.llr), rows.llr))


def above_notch(rows: Evidence, place_m: Array, from_deg: float, width_deg: float, deep_deg: float) -> Evidence:
    """The rows with those seen that stand in a gap that the map has filled."""
    above = rows.elevation_rad - CRATER.horizon_rad(place_m[None], rows.azimuth_rad)
    inside = (np.degrees(rows.azimuth_rad) - from_deg) % 360 < width_deg
    seen = inside & (above < 0) & (above > -np.radians(deep_deg))
    return replace(rows, llr=np.where(seen, np.abs(rows.llr), rows.llr))


def model_of(rows: Evidence, reference_m: Array = PLACE, half_m: float = 120.0, terrain: Terrain = CRATER) -> Any:
    return SkylineModel.of(terrain, rows, reference_m, half_m, SharedErrors.of(terrain, rows.clock))


@pytest.fixture(scope="module")
def obstructed() -> SkylineModel:
    """Stars of which a box of 40 degrees hides some."""
    return model_of(behind(evidence_at((3000.0, -2000.0), 1), PLACE, 70.0, 40.0, 3.0))


def test_transitions_are_probabilities() -> None:
    T = transitions()
    assert T.min() >= 0.0
    assert np.linalg.matrix_power(T, 2).min() > 0.0  # between an obstacle and a notch the map's skyline shows
    assert T.sum(axis=1) == pytest.approx(np.ones(STATES), abs=1e-12)


def test_the_chain_is_the_trace_of_its_matrix_product(obstructed: SkylineModel) -> None:
    rng = np.random.default_rng(2)
    smooth = np.cos(np.outer(rng.uniform(1, 4, 30), MIDDLES_RAD) + rng.uniform(0, 6, (30, 1)))
    shifts = np.radians(0.06) * rng.normal(size=(30, 1)) * smooth
    by_matrices = slow_chain(np.array([obstructed.seen.emissions(shift) for shift in shifts]))
    assert np.ptp(by_matrices) > 20.0
    likely = by_matrices > by_matrices.max() - 6.0  # of others the sector of the cut may be in a notch
    assert obstructed.log_likelihood_of(shifts)[likely] == pytest.approx(by_matrices[likely], abs=0.05)


def test_states_have_the_probabilities_of_all_paths(obstructed: SkylineModel) -> None:
    e, T = obstructed.seen.emissions(np.zeros(SECTORS)), transitions()
    found = state_probabilities(e)
    assert found.sum(axis=1) == pytest.approx(np.ones(SECTORS))
    for sector in (0, 46, 60, 75, 180):
        product = np.eye(STATES)
        for step in range(1, SECTORS + 1):
            product = product @ T * e[(sector + step) % SECTORS]
            product /= product.max()
        assert found[sector] == pytest.approx(np.diag(product) / np.trace(product), abs=1e-4)


@pytest.mark.parametrize("width_deg", [5.0, 20.0, 40.0, 80.0])
def test_an_obstacle_is_found_where_it_stands(width_deg: float) -> None:
    for seed in range(4):
        first = 90.0 * seed + 7.0
        model = model_of(behind(evidence_at((3000.0, -2000.0), seed), PLACE, first, width_deg, 3.0))
        risen = 1.0 - model.states(PLACE)[:, 0] > 0.5
        true = (np.degrees(MIDDLES_RAD) - first) % 360 < width_deg
        assert np.count_nonzero(risen != true) <= 4


@pytest.mark.parametrize(("width_deg", "deep_deg"), [(20.0, 1.0), (40.0, 4.0), (80.0, 3.0)])
def test_a_notch_is_found_where_the_map_has_filled_it(width_deg: float, deep_deg: float) -> None:
    wrong = 0
    for seed in range(4):
        first = 90.0 * seed + 7.0
        model = model_of(above_notch(evidence_at((3000.0, -2000.0), seed), PLACE, first, width_deg, deep_deg))
        sunk = model.states(PLACE)[:, RISEN + 1 :].sum(axis=1) > 0.5
        wrong += np.count_nonzero(sunk != ((np.degrees(MIDDLES_RAD) - first) % 360 < width_deg))
    assert wrong <= 24  # sectors of four frames: where a notch ends few stars show it


def direct_log(rows: Evidence, above_rad: Array, sector: int, heights_rad: Array) -> Array:
    """F at heights (n,): the sums of the rows' contributions, row by row."""
    own = np.flatnonzero((sector_of(rows.azimuth_rad) == sector) & (above_rad > LOW_RAD) & (above_rad < HIGH_RAD))
    llr, c, sigma = rows.llr[own], rows.extended_nats[own], rows.edge_sigma_rad[own]
    margin = above_rad[own] - heights_rad[:, None]
    visible = np.where(c > 0, ndtr(margin / np.where(sigma > 0, sigma, 1.0)), margin > 0)
    value = np.where(
        c > 0, llr * visible + c * visible * (1 - visible) / 2, np.clip(llr, -ROW_NATS, ROW_NATS) * visible
    )
    return np.asarray(value.sum(axis=1))


def rows_of_both(rng: np.random.Generator) -> tuple[Evidence, Array]:
    """Stars, and cells of the sky's light about the skyline, with their heights above it."""
    n, cells = 3000, np.linspace(-0.01, 0.01, 61)
    above = np.concatenate([rng.uniform(-0.25, 0.4, n), np.tile(cells, SECTORS)])
    azimuth = np.concatenate([rng.uniform(0, 2 * np.pi, n), np.repeat(MIDDLES_RAD, len(cells))])
    snr, nats = rng.uniform(1, 8, n), 8.0
    light = snr * (above[:n] > 0) + rng.normal(size=n)
    seen = ndtr(above[n:] / 1.6e-3) + rng.normal(size=SECTORS * len(cells)) / np.sqrt(nats)
    rows = Evidence(
        azimuth_rad=azimuth, elevation_rad=0.2 + above,
        llr=np.concatenate([snr * light - snr**2 / 2, nats * (seen - 0.5)]),
        extended_nats=np.repeat([0.0, nats], [n, len(seen)]), edge_sigma_rad=np.repeat([0.0, 1.6e-3], [n, len(seen)]),
    )  # fmt: skip
    return rows, above


@pytest.mark.parametrize("light", ["stars", "both"])
def test_profiles_are_the_sums_of_their_rows(light: str) -> None:
    rows, above = rows_of_both(np.random.default_rng(3))
    if light == "stars":
        rows, above = rows.take(np.arange(3000)), above[:3000]
    found = profiles_of(rows, above, np.zeros(SECTORS))
    for sector in range(0, SECTORS, 48):
        at = np.array([log_at(found, sector, height) for height in HEIGHTS_RAD])
        plain = direct_log(rows, above, sector, HEIGHTS_RAD)
        near = plain > plain.max() - 20.0
        assert (at + found.free[sector])[near] == pytest.approx(plain[near], abs=0.03)
        edge = np.linspace(LOW_RAD, HIGH_RAD, 120_001)
        middle = 0.5 * (edge[1:] + edge[:-1])
        likelihood = np.exp(direct_log(rows, above, sector, middle))
        assert found.free[sector] == pytest.approx(np.log(likelihood.mean()), abs=0.03)
        running = np.cumsum(likelihood / likelihood.mean()) * (edge[1] - edge[0])
        for height in HEIGHTS_RAD:
            expected = np.interp(height, edge[1:], running)
            assert integral_to(found, sector, height) == pytest.approx(expected, rel=0.02, abs=0.005 * running[-1])


@pytest.mark.parametrize("sigma_deg", [0.01, 0.1])
def test_profiles_are_averaged_over_an_error_of_the_map(sigma_deg: float) -> None:
    rows, above = rows_of_both(np.random.default_rng(4))
    sigma = np.radians(sigma_deg)
    found = profiles_of(rows, above, np.full(SECTORS, sigma))
    z = np.linspace(-3.5, 3.5, 1401)
    weight = np.exp(-0.5 * z**2)
    weight /= weight.sum()
    heights = np.radians([-0.3, -0.1, -0.04, 0.0, 0.04, 0.1, 0.3])
    for sector in range(0, SECTORS, 48):
        plain = np.array([
            np.log(np.exp(direct_log(rows, above, sector, height + sigma * z)) @ weight) for height in heights
        ])  # fmt: skip
        at = np.array([log_at(found, sector, height) for height in heights]) + found.free[sector]
        near = plain > plain.max() - 8.0
        assert at[near] == pytest.approx(plain[near], abs=0.25)


def test_profiles_of_crests_that_may_stand_anywhere_are_level() -> None:
    """Of a crest 20 m away whose height is known to 10 m, as of one that is known to nothing."""
    rows, above = rows_of_both(np.random.default_rng(4))
    for sigma_deg in (60.0, 200.0):
        found = profiles_of(rows, above, np.full(SECTORS, np.radians(sigma_deg)))
        level = [[log_at(found, sector, height) for height in HEIGHTS_RAD] for sector in range(SECTORS)]
        assert np.ptp(level, axis=1).max() < 0.5


@pytest.mark.parametrize("map_deg", [0.0, 0.05])
def test_the_edges_of_stars_do_not_blur_the_light_beside_them(map_deg: float) -> None:
    both, above = rows_of_both(np.random.default_rng(4))
    is_star, edge, map_rad = both.extended_nats == 0.0, np.radians(0.03), np.radians(map_deg)
    rows = replace(both, edge_sigma_rad=np.where(is_star, edge, both.edge_sigma_rad))
    found = profiles_of(rows, above, np.full(SECTORS, map_rad))
    z = np.linspace(-3.5, 3.5, 281)
    weight = np.exp(-0.5 * z**2) / np.exp(-0.5 * z**2).sum()
    for sector in range(0, SECTORS, 48):
        for height in np.radians([-0.1, -0.04, 0.0, 0.04, 0.1]):
            heights = height + map_rad * z
            stars = direct_log(both.take(is_star), above[is_star], sector, np.add.outer(heights, edge * z).ravel())
            light = direct_log(both.take(~is_star), above[~is_star], sector, heights)
            plain = np.log((np.exp(stars.reshape(len(z), -1)) @ weight * np.exp(light)) @ weight)
            assert log_at(found, sector, height) + found.free[sector] == pytest.approx(plain, abs=0.25)


def test_profiles_end_with_the_window_where_the_error_of_the_map_is_wider() -> None:
    rows, above = rows_of_both(np.random.default_rng(4))
    found = profiles_of(rows, above, np.radians(np.linspace(0.0, 90.0, SECTORS)))
    for sector in range(SECTORS):
        cells = slice(found.first[sector], found.first[sector + 1])
        assert found.x[cells][[0, -1]] == pytest.approx([LOW_RAD, HIGH_RAD])
        assert (np.diff(found.x[cells]) >= 0).all()
        assert (np.diff(found.integral[cells]) >= 0).all()
        assert found.integral[cells][-1] == pytest.approx(HIGH_RAD - LOW_RAD)


def test_stars_are_compared_with_the_skyline_at_their_own_azimuths(obstructed: SkylineModel) -> None:
    """The likelihood about a reference is that of horizons computed for each star and position."""
    rng = np.random.default_rng(5)
    points = PLACE + 12.0 * rng.normal(size=(150, 2))
    slow = slow_chain_scores(points, obstructed.seen.rows, CRATER, PLACE)
    off = (obstructed.log_likelihood(points) + obstructed.seen.log_offset) - slow
    weight = np.exp(slow - slow.max()) / np.exp(slow - slow.max()).sum()
    off -= weight @ off
    assert np.sqrt(weight @ np.square(off)) < 0.4
    assert np.ptp(slow) > 15.0


def test_references_are_comparable() -> None:
    """The same posterior from windows about two places 150 m apart."""
    rows = evidence_at((3000.0, -2000.0), 2)
    points = PLACE + 15.0 * np.random.default_rng(6).normal(size=(200, 2))
    one, other = (model_of(rows, PLACE + np.array([x, 0.3 * x]), 260.0) for x in (-75.0, 75.0))
    logs = [model.log_likelihood(points) + model.seen.log_offset for model in (one, other)]
    likely = logs[0] > logs[0].max() - 6.0
    assert np.mean(logs[0][likely] - logs[1][likely]) == pytest.approx(0.0, abs=0.15)
    means = [np.exp(log - log.max()) @ points / np.exp(log - log.max()).sum() for log in logs]
    assert np.linalg.norm(means[0] - means[1]) < 0.6


@pytest.mark.parametrize("seed", range(3))
def test_evidence_and_moments_are_those_of_a_grid(seed: int) -> None:
    rows = evidence_at((3000.0, -2000.0), seed)
    found = sample_posterior(rows, ExactPosterior().explore(rows, CRATER), CRATER)[0]
    share = np.exp(found.copies_log_weight - found.copies_log_weight.max())
    centre, spread = moments(found.positions_m, share)
    line, root = np.linspace(-6, 6, 161), np.linalg.cholesky(spread)
    step = line[1] - line[0]
    points = centre + np.stack(np.meshgrid(line, line), axis=-1).reshape(-1, 2) @ root.T
    log = found.model.log_likelihood(points) + found.model.seen.log_offset - np.log(np.pi * CRATER.reach_m**2)
    weight = np.exp(log - log.max())
    evidence = log.max() + np.log(weight.sum() * step**2 * np.prod(np.diag(root)))
    assert found.log_evidence == pytest.approx(evidence, abs=0.1)
    inside = np.abs(np.linalg.solve(root, (found.positions_m - centre).T)).max(axis=0) < 6.0
    mean, covariance = moments(found.positions_m[inside], share[inside])
    expected, expected_covariance = moments(points, weight)
    size = np.sqrt(np.trace(expected_covariance))
    assert np.linalg.norm(expected - mean) < 0.12 * size
    assert covariance == pytest.approx(expected_covariance, abs=0.25 * size**2)


@pytest.mark.slow
def test_circles_vary_little_with_the_points_that_are_drawn(monkeypatch: pytest.MonkeyPatch) -> None:
    """The Monte Carlo error of the 99.9 % radius is at most 5 %, in the mean of six skies with ten draws each."""
    sequence, errors = importance_sampling.normal_sequence, []
    for seed in range(6):
        rows, radii = evidence_at(((2000.0, -1000.0), (-6500.0, 1000.0))[seed % 2], 20 + seed), []
        for draw in range(10):
            first = 7919 * draw
            with monkeypatch.context() as patch:
                patch.setattr(importance_sampling, "normal_sequence", lambda d, n, m, k=first: sequence(d, n + k, m))
                radii.append(ExactPosterior()(rows, CRATER).radius999_m)
        errors.append(np.std(radii) / np.mean(radii))
    assert np.sqrt(np.mean(np.square(errors))) < 0.05, np.round(errors, 3)


SITE = Site("moon", np.radians(-89.66), np.radians(129.78))
TIME = datetime(2030, 6, 3, 4, 5, 6, tzinfo=UTC)


@pytest.mark.slow
@pytest.mark.usefixtures("own_cache")
@pytest.mark.parametrize("name", ["shackleton-thesis", "shackleton"])
def test_slopes_of_the_clock_are_those_of_turned_rows(name: str) -> None:
    """A row of each sector at the skyline, turned by ten minutes."""
    terrain, later_s = replace(load_terrain(name), search_radius_m=300.0), 600.0
    clock = Clock(turn_rad_s=sky_rotvec_rad(SITE, TIME, 600.0) / 600.0, sigma_s=1000.0)
    place = np.array([50.0, -90.0])
    horizon = np.asarray(terrain.horizon_rad(place[None], MIDDLES_RAD)).ravel()
    rows = Evidence(azimuth_rad=MIDDLES_RAD, elevation_rad=horizon, llr=np.ones(SECTORS), clock=clock)
    errors = SharedErrors.of(terrain, clock)
    slope = Neighbourhood(terrain, place, 0.0).error_slopes_rad(errors)[-1]
    values = np.zeros((1, len(errors)))
    values[0, -1] = later_s
    turned, at = turn_evidence(rows, later_s, None), errors.true_positions(place[None], values)
    higher = np.asarray(terrain.horizon_rad(at, turned.azimuth_rad)).ravel() - turned.elevation_rad
    if terrain.axisymmetric:
        assert higher == pytest.approx(later_s * slope, abs=2e-5 * later_s * np.linalg.norm(clock.turn_rad_s))
    else:  # crests are narrower than the step: the slope is that of the skyline at large
        assert np.corrcoef(higher, later_s * slope)[0, 1] > 0.9
        assert np.std(higher - later_s * slope) < 0.5 * np.std(higher)


def test_a_free_skyline_is_preferred_to_a_wrong_crater_only() -> None:
    gains: dict[str, list[float]] = {"true": [], "obstacle": [], "wrong": []}
    for seed in range(12):
        rows = evidence_at((3000.0, -2000.0), 40 + seed)
        hidden, wrong = behind(rows, PLACE, 30.0 * seed, 40.0, 3.0), replace(CRATER, depth_m=1.06 * CRATER.depth_m)
        for kind, seen, terrain in (("true", rows, CRATER), ("obstacle", hidden, CRATER), ("wrong", rows, wrong)):
            model = model_of(seen, terrain=terrain)
            line = np.linspace(-400, 400, 41) if kind == "wrong" else np.linspace(-60, 60, 25)
            points = PLACE + np.stack(np.meshgrid(line, line), axis=-1).reshape(-1, 2)
            best = points[np.argmax(model.log_likelihood(points))]
            shift = model.shifts(best[None])
            gains[kind].append(free_log_likelihood(model.seen, shift[0]) - model.log_likelihood_of(shift)[0])
    assert max(gains["true"]) < np.log(0.1)
    assert np.mean(np.array(gains["obstacle"]) < np.log(0.1)) > 0.8
    assert min(gains["wrong"]) > np.log(0.1)


def test_levels_and_the_wrong_sector_leave_no_sector_without_likelihood(obstructed: SkylineModel) -> None:
    """However wrong a sector is, it costs no more than the logarithm of the wrong sector's probability."""
    far = obstructed.seen.emissions(np.full(SECTORS, np.radians(-5.0)))
    assert far.min() >= WRONG_SECTOR
    assert np.all(np.diff(LEVELS_RAD) > 0)


def test_prepared_levels_are_the_emissions_at_their_nodes(obstructed: SkylineModel) -> None:
    profiles, reach = obstructed.seen.profiles, np.radians(np.where(np.arange(SECTORS) % 7, 0.3, 15.0))
    table = prepare_levels(profiles, reach)
    for node, u in enumerate(np.linspace(-1.0, 1.0, NODES)):
        at_node = emissions(profiles, reach * u * abs(u), np.zeros(SECTORS))[:, 1:]
        np.testing.assert_allclose(table[:, :, node], at_node, rtol=1e-4, atol=1e-6)
