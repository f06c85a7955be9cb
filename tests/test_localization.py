"""The exact posterior against brute force, and what the localizers refuse."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from localization_helpers import (
    TERRAIN,
    WRAPPERS,
    ThreeMethods,
    best_levels,
    perfect_list,
    random_position,
    search_scores,
    sky,
    slow_chain_scores,
    slow_sums,
)

from startrack.chain import Settings
from startrack.core.types import Array, Evidence, NotLocated
from startrack.localization import ExactPosterior, Hull, Localizer, PseudoGradient
from startrack.localization.search import BoxModel
from startrack.terrain import Cylinder, ForwardingTerrain


def measure_stars(rng: np.random.Generator, at_m: Array, terrain: Cylinder, n: int, sigma_rad: float = 0.0) -> Evidence:
    """Stars of SNR 1 to 4, each with a noisy flux measurement."""
    azimuth, elevation = sky(rng, n)
    snr = 1 + 3 * rng.random(n)
    edge = elevation + sigma_rad * rng.standard_normal(n)
    flux = snr * (edge > terrain.horizon_rad(at_m[None], azimuth)) + rng.standard_normal(n)
    return Evidence(
        azimuth_rad=azimuth, elevation_rad=elevation, llr=np.clip(snr * flux - snr**2 / 2, -9, 9),
        edge_sigma_rad=np.full(n, sigma_rad),
    )  # fmt: skip


def seen_at(azimuth_rad: Array, elevation_rad: Array) -> Evidence:
    """Stars that are all seen."""
    return Evidence(azimuth_rad=azimuth_rad, elevation_rad=elevation_rad, llr=np.full(len(azimuth_rad), 9.0))


@pytest.mark.parametrize("method", [PseudoGradient(), Hull()])
def test_the_thesis_methods_refuse_positions_outside_the_search_area(method: Localizer) -> None:
    east_m, north_m = np.array([14e3, 16e3, 15e3, 15e3]), np.array([0.0, 0.0, 1e3, -1e3])  # a rim of 15 km to the east
    rays = seen_at(np.arctan2(east_m, north_m), np.arctan(TERRAIN.wall_m / np.hypot(east_m, north_m)))
    for terrain in (TERRAIN, replace(TERRAIN, search_radius_m=np.inf)):
        with pytest.raises(NotLocated) as caught:
            method(rays, terrain)
        assert caught.value.reason == "outside_search_area"
    at = np.array([6000.0, -6000.0])
    narrow = replace(TERRAIN, search_radius_m=5000.0)
    with pytest.raises(NotLocated, match="outside the search area of 5000 m"):
        method(perfect_list(np.random.default_rng(2), at), narrow)


def test_positions_without_a_posterior_stand_on_the_ground() -> None:
    class Raised(ForwardingTerrain):
        def ground_m(self, points_m: Array) -> Array:
            return np.full(np.shape(points_m)[:-1], 40.0)

    evidence = perfect_list(np.random.default_rng(3), np.array([1000.0, 500.0]))
    assert Hull()(evidence, Raised(TERRAIN)).position_enu_m[2] == 40.0 + TERRAIN.camera_height_m


@pytest.mark.parametrize(
    ("azimuth_deg", "elevation_deg"),
    [([90.0, 90.0, 270.0], [40.0, 60.0, 50.0]), ([30.0] * 4, [70.0] * 4)],
    ids=["one line", "one point"],
)
@pytest.mark.parametrize("method", [PseudoGradient(), Hull()])
def test_seen_stars_on_one_line_make_no_hull(
    method: Localizer, azimuth_deg: list[float], elevation_deg: list[float]
) -> None:
    with pytest.raises(NotLocated, match="make no hull: they stand on one line"):
        method(seen_at(np.radians(azimuth_deg), np.radians(elevation_deg)), TERRAIN)


def test_a_descent_that_explains_too_few_stars_is_refused() -> None:
    """Of a list with 10 % of its stars missed no position explains the rest."""
    rng = np.random.default_rng(5)
    evidence = perfect_list(rng, np.array([3000.0, 1000.0]), 400)
    missed = replace(evidence, llr=np.where(rng.random(400) < 0.1, -12.0, evidence.llr))
    assert np.isfinite(PseudoGradient()(evidence, TERRAIN).position_enu_m).all()
    with pytest.raises(NotLocated, match=r"did not settle: its last position leaves \d+ of \d+ stars unexplained"):
        PseudoGradient()(missed, TERRAIN)
    with pytest.raises(NotLocated, match="did not settle"):
        PseudoGradient(most_steps=1, most_unexplained=0.0)(evidence, TERRAIN)
    loose = PseudoGradient(most_unexplained=0.2)(missed, TERRAIN)
    assert np.linalg.norm(loose.position_enu_m[:2] - [3000.0, 1000.0]) < 2000.0


def test_settings_take_a_localizer_or_its_name() -> None:
    assert Settings(localizer="hull").localizer == Hull()
    assert Settings().localizer == Settings(localizer="posterior").localizer == ExactPosterior()
    own = PseudoGradient(gain=0.5)
    assert Settings(localizer=own).localizer is replace(Settings(), localizer=own).localizer is own
    assert Settings(localizer=own.__call__).localizer == own.__call__  # any function


@pytest.mark.parametrize(
    ("given", "error", "message"),
    [
        ("hul", ValueError, "localizer='hul': known are posterior, pseudo-gradient, hull"),
        (ExactPosterior, TypeError, r"localizer=ExactPosterior is a class: .* ExactPosterior\(\)"),
        (None, TypeError, "localizer= is of type NoneType"),
        (5, TypeError, "localizer= is of type int"),
    ],
)
def test_settings_refuse_what_is_no_localizer(given: Any, error: type[Exception], message: str) -> None:
    with pytest.raises(error, match=message):
        Settings(localizer=given)


SMALL = replace(TERRAIN, diameter_m=400.0, depth_m=60.0, search_radius_m=200.0)


@pytest.mark.slow
@pytest.mark.parametrize("terrain", [SMALL, TERRAIN], ids=["small", "thesis"])
@pytest.mark.parametrize("seed", range(3))
def test_exact_posterior_equals_brute_force(seed: int, terrain: Cylinder) -> None:
    """Mean, covariance and circles of a grid with the chain of obstacles written out."""
    rng = np.random.default_rng(seed)
    evidence = measure_stars(rng, random_position(rng, terrain), terrain, 600 if terrain is SMALL else 3000)
    fix = ExactPosterior()(evidence, terrain)
    middle, line = fix.position_enu_m[:2], np.linspace(-6, 6, 49)
    grid = middle + np.stack(np.meshgrid(line, line), axis=-1).reshape(-1, 2) @ np.linalg.cholesky(fix.covariance_m2).T
    grid = grid[np.asarray(terrain.allowed(grid))]
    log = slow_chain_scores(grid, evidence, terrain, middle)
    weight = np.exp(log - log.max())
    weight /= weight.sum()
    mean = weight @ grid
    spread = np.einsum("n,ni,nj->ij", weight, grid - mean, grid - mean)
    sigma = np.sqrt(np.trace(spread))
    assert np.linalg.norm(middle - mean) < 0.1 * sigma
    np.testing.assert_allclose(
        fix.covariance_m2, spread, atol=0.14 * sigma**2
    )  # a sector moves as a whole in the model
    distance = np.linalg.norm(grid - middle, axis=1)
    assert weight[distance < fix.radius95_m].sum() == pytest.approx(0.95, abs=0.03)
    assert weight[distance > 1.1 * fix.radius999_m].sum() < 2e-3
    assert fix.dropped_probability < 5e-3


@pytest.mark.parametrize("sigma_rad", [0.0, 0.002])
def test_bounds_hold_at_random_positions_of_every_box(sigma_rad: float) -> None:
    rng = np.random.default_rng(8)
    evidence = measure_stars(rng, random_position(rng), TERRAIN, 400, sigma_rad)
    centres, model = np.array([[1000.0, 2000.0], [-7000.0, 3000.0], [6500.0, -6500.0]]), BoxModel.of(evidence, TERRAIN)
    for half in (300.0, 20.0):
        for centre, most in zip(centres, model.bounds(centres, half), strict=True):
            inside = centre + half * (2 * rng.random((60, 2)) - 1)
            inside = inside[TERRAIN.allowed(inside)]
            score = search_scores(slow_sums(inside, evidence, TERRAIN) - best_levels(evidence), best_levels(evidence))
            assert np.all(score <= most + 1e-4)
            assert most < -5.0  # it excludes something


@pytest.mark.parametrize("sigma_rad", [0.0, 0.002])
@pytest.mark.parametrize("wrapper", WRAPPERS)
def test_a_wrapped_terrain_gives_the_terrains_own_fix(wrapper: type, sigma_rad: float) -> None:
    rng = np.random.default_rng(9)
    at = random_position(rng)
    evidence = measure_stars(rng, at, TERRAIN, 3000, sigma_rad)
    own, wrapped = ExactPosterior()(evidence, TERRAIN), ExactPosterior()(evidence, wrapper(TERRAIN))
    size = np.sqrt(np.trace(own.covariance_m2))
    part = 0.1 if wrapper is ThreeMethods else 1e-6  # which is searched by other boxes: sampled by other points
    np.testing.assert_allclose(wrapped.position_enu_m, own.position_enu_m, atol=part * size)
    np.testing.assert_allclose(wrapped.covariance_m2, own.covariance_m2, atol=1.5 * part * size**2)
    assert wrapped.radius95_m == pytest.approx(own.radius95_m, rel=part)


def test_positions_beside_the_wall_and_deep_evidence_are_located() -> None:
    """Within 50 m of the wall, and with 60,000 strong rows, as exposures to V 8 give."""
    for seed, n in ((1, 4000), (2, 4000), (3, 60_000)):
        rng = np.random.default_rng(seed)
        turn = 2 * np.pi * rng.random()
        at = (TERRAIN.radius_m - 50 * rng.random()) * np.array([np.sin(turn), np.cos(turn)])
        fix = ExactPosterior()(measure_stars(rng, at, TERRAIN, n), TERRAIN)
        assert np.linalg.norm(fix.position_enu_m[:2] - at) < fix.radius999_m
        assert fix.search == "proven"


@pytest.mark.slow
def test_errors_are_as_large_as_stated() -> None:
    """80 noisy skies: mean NEES 2, and the 95 % circle holds 95 %. Bounds are 3.5 sigma of the count."""
    nees, within = [], []
    for seed in range(80):
        rng = np.random.default_rng(1000 + seed)
        at = random_position(rng)
        fix = ExactPosterior()(measure_stars(rng, at, TERRAIN, 3000), TERRAIN)
        d = fix.position_enu_m[:2] - at
        nees.append(d @ np.linalg.solve(fix.covariance_m2, d))
        within.append(np.linalg.norm(d) < fix.radius95_m)
    assert 1.2 < np.mean(nees) < 2.8
    assert 0.865 < np.mean(within) <= 1.0


class TwoCraters(ThreeMethods):
    """Two equal craters, 1.2 km apart: every position has a twin with the same horizon."""

    def __init__(self) -> None:
        super().__init__(SMALL)
        self.search_radius_m = 900.0

    @property
    def reach_m(self) -> float:
        return 900.0

    def folded(self, points_m: Array) -> Array:
        """Positions from the middle of the crater that they are in."""
        return np.stack([points_m[..., 0] - np.copysign(600.0, points_m[..., 0]), points_m[..., 1]], axis=-1)

    def allowed(self, points_m: Array) -> Array:
        return self.whole.allowed(self.folded(points_m))

    def horizon_rad(self, points_m: Array, azimuths_rad: Array) -> Array:
        return self.whole.horizon_rad(self.folded(points_m), azimuths_rad)

    def horizon_bounds_rad(
        self, centres_m: Array, half_m: Array, azimuths_rad: Array, azimuth_half_rad: Array | float = 0.0
    ) -> tuple[Array, Array]:
        low, high = self.whole.horizon_bounds_rad(self.folded(centres_m), half_m, azimuths_rad, azimuth_half_rad)
        both = np.abs(centres_m[..., 0]) < half_m
        return np.where(both, 0.0, low), np.where(both, np.pi / 2, high)


def test_two_positions_that_fit_are_both_modes() -> None:
    at, terrain = np.array([40.0, -90.0]), TwoCraters()
    fix = ExactPosterior()(measure_stars(np.random.default_rng(3), at, SMALL, 1500), terrain)
    assert fix.ambiguous
    first, second = fix.modes[:2]
    assert first.weight == pytest.approx(0.5, abs=0.1)
    assert first.east_m == pytest.approx(second.east_m + np.copysign(1200.0, first.east_m), abs=1.0)
    for mode in (first, second):
        away = np.array([mode.east_m, mode.north_m]) - [np.copysign(600.0, mode.east_m), 0.0] - at
        assert np.linalg.norm(away) < mode.radius999_m < 30.0


def test_stars_in_two_directions_alone_are_no_position() -> None:
    """Two obstacles explain them anywhere."""
    rng = np.random.default_rng(3)
    n, at = 1500, np.array([2000.0, 6000.0])
    azimuth = np.where(rng.random(n) < 0.5, np.pi / 2, 3 * np.pi / 2)
    elevation, snr = np.radians(60) * rng.random(n), 1 + 3 * rng.random(n)
    flux = snr * (elevation > TERRAIN.horizon_rad(at[None], azimuth)) + rng.standard_normal(n)
    evidence = Evidence(azimuth_rad=azimuth, elevation_rad=elevation, llr=np.clip(snr * flux - snr**2 / 2, -9, 9))
    with pytest.raises(NotLocated) as refusal:
        ExactPosterior()(evidence, TERRAIN)
    assert refusal.value.reason == "insufficient_geometry"


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


def test_pixels_of_the_sky_and_several_exposures_are_rows_like_any_other() -> None:
    """Extended light beside stars, from two exposures in one value, locates better than the stars alone."""
    rng = np.random.default_rng(13)
    at = np.array([3000.0, -1500.0])
    stars = measure_stars(rng, at, TERRAIN, 1500)
    azimuth, sigma = 2 * np.pi * rng.random(4000), np.full(4000, 0.001)
    elevation = TERRAIN.horizon_rad(at[None], azimuth) + rng.uniform(-0.01, 0.01, 4000)
    step = 0.5  # of the sky brightness, in sigmas of a pixel
    visible = slow_visible(elevation - TERRAIN.horizon_rad(at[None], azimuth), sigma)
    light = step * visible + rng.standard_normal(4000)
    pixels = Evidence(
        azimuth_rad=azimuth, elevation_rad=elevation, llr=step * light - step**2 / 2, edge_sigma_rad=sigma,
        extended_nats=np.full(4000, step**2),
    )  # fmt: skip
    both = Evidence.concatenate(stars, pixels)
    alone, together = ExactPosterior()(stars, TERRAIN), ExactPosterior()(both, TERRAIN)
    assert np.trace(together.covariance_m2) < 0.5 * np.trace(alone.covariance_m2)
    assert np.linalg.norm(together.position_enu_m[:2] - at) < together.radius999_m


def slow_visible(margin_rad: Array, sigma_rad: Array) -> Array:
    from scipy.special import ndtr

    return np.asarray(ndtr(margin_rad / sigma_rad))


def test_a_boulder_costs_no_more_than_its_sectors() -> None:
    """Twenty degrees of azimuth wholly dark: the fix stays where it is."""
    rng = np.random.default_rng(7)
    at = np.array([-2500.0, 4000.0])
    evidence = measure_stars(rng, at, TERRAIN, 6000)
    dark = (np.degrees(evidence.azimuth_rad) < 20) & (evidence.elevation_rad < np.radians(30))
    llr = np.where(dark, -9.0, evidence.llr)
    hidden = replace(evidence, llr=llr)
    fix = ExactPosterior()(hidden, TERRAIN)
    assert np.linalg.norm(fix.position_enu_m[:2] - at) < fix.radius999_m


def whole_sky(seed: int, n: int = 1500) -> Evidence:
    """Stars with SNR 0.5 to 6 measured from a random position."""
    rng = np.random.default_rng(seed)
    azimuth, elevation = 2 * np.pi * rng.random(n), np.arcsin(2 * rng.random(n) - 1)
    at = 9000 * np.sqrt(rng.random()) * np.array([1.0, 0.0])
    snr = 0.5 + 5.5 * rng.random(n)
    flux = snr * (elevation > TERRAIN.horizon_rad(at[None], azimuth)) + rng.standard_normal(n)
    return Evidence(azimuth_rad=azimuth, elevation_rad=elevation, llr=np.clip(snr * flux - snr**2 / 2, -9, 9))


def test_rays_below_the_horizontal_say_nothing() -> None:
    evidence = whole_sky(3)
    above = evidence.elevation_rad > 0
    kept = evidence.take(above)
    method = ExactPosterior()
    with_all, without = method(evidence, TERRAIN), method(kept, TERRAIN)
    sigma = np.sqrt(np.trace(without.covariance_m2))
    assert np.linalg.norm(with_all.position_enu_m - without.position_enu_m) < 0.15 * sigma
    assert with_all.radius999_m == pytest.approx(without.radius999_m, rel=0.15)


def test_a_smaller_search_area_is_kept_to() -> None:
    evidence = whole_sky(0)
    fix = ExactPosterior()(evidence, TERRAIN)
    radius = float(np.hypot(*fix.position_enu_m[:2])) + 400.0
    near = ExactPosterior()(evidence, replace(TERRAIN, search_radius_m=radius))
    # Other boxes, the same posterior.
    sigma = np.sqrt(np.trace(fix.covariance_m2))
    np.testing.assert_allclose(near.position_enu_m, fix.position_enu_m, atol=0.1 * sigma)


def test_sharp_posteriors_are_resolved_without_a_proof() -> None:
    """20,000 rows with hard edges: a few decimetres to metres wide, mean NEES 2 (8 positions: s.d. 0.7)."""
    nees = []
    for seed in range(8):
        rng = np.random.default_rng(seed)
        at = random_position(rng)
        evidence = measure_stars(rng, at, TERRAIN, 20_000)
        fix = ExactPosterior(budget_horizons=50.0)(evidence, ThreeMethods(TERRAIN))
        d = fix.position_enu_m[:2] - at
        assert fix.search == "beam"
        assert np.linalg.norm(d) < fix.radius999_m
        nees.append(d @ np.linalg.solve(fix.covariance_m2, d))
    assert np.mean(nees) < 4.0


def test_azimuths_may_be_negative_and_numbers_must_be_finite() -> None:
    rng = np.random.default_rng(16)
    evidence = measure_stars(rng, random_position(rng), TERRAIN, 2000)
    turned = replace(evidence, azimuth_rad=evidence.azimuth_rad - 2 * np.pi)
    own, other = ExactPosterior()(evidence, TERRAIN), ExactPosterior()(turned, TERRAIN)
    np.testing.assert_allclose(other.position_enu_m, own.position_enu_m, atol=1e-6)
    with pytest.raises(ValueError, match="infinite"):
        replace(evidence, llr=np.full(2000, np.inf))
