"""One frame as an observation: against the exact posterior, and its sensitivities against changed maps and rows."""

from __future__ import annotations

from dataclasses import replace
from datetime import UTC, datetime, timedelta

import numpy as np
import pytest

from startrack.localization import ExactPosterior
from startrack.terrain import Cylinder, load_terrain
from startrack.terrain.height_map import HeightMap
from startrack.tracking.at_rest import positions_at_rest
from startrack.tracking.frame_estimate import MIN_NOISE_SHARE, clipped_noise, estimate_frame, first_guess
from startrack.tracking.importance_sampling import sample_posterior
from startrack.tracking.observe import ObservedFrame, observe_frame
from startrack.tracking.shared import BIAS, CLOCK, EDGE, SHAPES, ImageErrors, SharedErrors
from startrack.tracking.smoother import Observations, Steps, smooth
from startrack.types import BadInput, Clock, Evidence

TIME = datetime(2030, 6, 1, tzinfo=UTC)
HORIZON_ERROR_RAD = np.radians(0.05)
PLACE_M = np.array([120.0, -80.0])


@pytest.fixture(scope="module", autouse=True)
def _own_cache(tmp_path_factory):
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.mktemp("cache")))
        yield


@pytest.fixture(scope="module")
def ground() -> HeightMap:
    terrain = load_terrain("shackleton")
    assert isinstance(terrain, HeightMap)
    return replace(terrain, search_radius_m=500.0)


def rays_at(terrain, place, rng, *, raised_rad=0.0, rays=1500, snr=3.0) -> Evidence:
    """Rays near the skyline of a position, with the noise of photometry."""
    azimuth = rng.uniform(0, 2 * np.pi, rays)
    horizon = terrain.horizon_rad(np.asarray(place)[None], azimuth) + raised_rad
    elevation = horizon + rng.uniform(-0.02, 0.02, rays)
    light = snr * (elevation > horizon) + rng.normal(size=rays)
    return Evidence(azimuth_rad=azimuth, elevation_rad=elevation, llr=np.clip(snr * light - snr**2 / 2, -9.0, 9.0))


def estimate(evidence, terrain, place=PLACE_M, error_rad=0.0):
    shared = SharedErrors.of(terrain, None)
    return estimate_frame(evidence, terrain, shared, *first_guess(shared, place, 25.0 * np.eye(2), error_rad))


def raise_post(terrain: HeightMap, post: int, by_m: float) -> HeightMap:
    """The map with one post of its finest raster higher."""
    heights = terrain.maps[0].heights_m.copy()
    heights.ravel()[post] += by_m
    return replace(terrain, maps=(replace(terrain.maps[0], heights_m=heights), *terrain.maps[1:]))


@pytest.mark.slow
def test_the_horizon_rises_with_the_posts_that_make_it(ground):
    azimuth = np.radians([17.0, 140.0, 255.0])
    found = ground.horizon_posts(PLACE_M, azimuth)
    np.testing.assert_allclose(found.rad_per_m.sum(axis=1), [1e-4] * 3, rtol=0.6)
    here = ground.horizon_rad(PLACE_M[None], azimuth)
    for k in range(3):
        strongest = int(np.argmax(found.rad_per_m[k]))
        changed = raise_post(ground, int(found.post[k, strongest]), 0.2).horizon_rad(PLACE_M[None], azimuth)
        assert changed[k] - here[k] == pytest.approx(0.2 * found.rad_per_m[k, strongest], rel=0.15)


def test_the_horizon_sinks_with_the_posts_about_the_camera(ground):
    azimuth = np.radians([17.0, 140.0, 255.0])
    found = ground.ground_posts(PLACE_M, azimuth)
    changed = raise_post(ground, int(found.post[0, 2]), 2.0).horizon_rad(PLACE_M[None], azimuth)
    np.testing.assert_allclose(
        changed - ground.horizon_rad(PLACE_M[None], azimuth), 2.0 * found.rad_per_m[:, 2], rtol=0.05
    )


def test_posts_stand_where_the_map_has_them(ground):
    found = ground.ground_posts(PLACE_M, np.zeros(1))
    points = ground.post_positions_m(found.post[0])
    np.testing.assert_allclose(np.sort(np.ptp(points[:, :2], axis=0)), [240, 240], rtol=0.5)
    np.testing.assert_allclose(ground.ground_m(points[:, :2]), points[:, 2], atol=0.1)
    assert np.ptp(points[:, :2] - PLACE_M, axis=0).max() < 400
    assert (np.abs(points[:, :2] - PLACE_M).max(axis=1) < 350).all()


@pytest.mark.slow
def test_the_observation_is_the_exact_posterior(ground):
    evidence = rays_at(ground, PLACE_M, np.random.default_rng(1), raised_rad=HORIZON_ERROR_RAD)
    fix = ExactPosterior()(evidence, ground)
    found = estimate(evidence, ground)
    away = found.mean[:2] - fix.position_enu_m[:2]
    assert away @ np.linalg.solve(fix.covariance_m2, away) < 0.3
    alone = smooth(Observations.of([found], ground.height_sigma_m), Steps.unknown(1))
    np.testing.assert_allclose(np.trace(alone.covariance_m2[0]), np.trace(fix.covariance_m2), rtol=0.5)
    assert found.mean[2] * ground.common_sigma_rad == pytest.approx(HORIZON_ERROR_RAD, abs=np.radians(0.02))


def test_the_response_to_the_bias_is_that_to_raised_rows(ground):
    evidence = rays_at(ground, PLACE_M, np.random.default_rng(2))
    here = estimate(evidence, ground)
    raised = replace(evidence, elevation_rad=evidence.elevation_rad + 0.2 * ground.common_sigma_rad)
    there = estimate(raised, ground)
    np.testing.assert_allclose(
        there.mean - here.mean, 0.2 * here.response[:, 2], atol=0.1 * np.sqrt(here.covariance[0, 0])
    )
    assert here.response[2, 2] > 0.9
    np.testing.assert_allclose(here.response[:, :2], np.eye(3)[:, :2], atol=1e-9)


@pytest.mark.slow
def test_the_response_to_a_post_is_that_to_a_lower_map(ground):
    evidence = rays_at(ground, PLACE_M, np.random.default_rng(3))
    here = estimate(evidence, ground)
    strongest = int(np.argmax(np.linalg.norm(here.by_post[:2], axis=0)))
    there = estimate(evidence, raise_post(ground, int(here.post[strongest]), -2.0))
    moved = there.mean[:2] - here.mean[:2]
    np.testing.assert_allclose(moved, 2.0 * here.by_post[:2, strongest], atol=0.15 * np.linalg.norm(moved) + 0.05)


def test_noise_is_positive_definite_and_no_less_than_its_share():
    whole = np.diag([4.0, 1.0])
    clipped = clipped_noise(np.array([[-3.0, 0.5], [0.5, 0.8]]), whole)
    shares = np.linalg.eigvalsh(np.diag([0.5, 1.0]) @ clipped @ np.diag([0.5, 1.0]))
    assert shares[0] == pytest.approx(MIN_NOISE_SHARE)
    np.testing.assert_allclose(clipped_noise(0.6 * whole, whole), 0.6 * whole)


def test_samples_have_the_moments_of_the_density():
    covariance = np.array([[9.0, 2.0, 0.3], [2.0, 1.0, 0.1], [0.3, 0.1, 0.04]])
    known = np.linalg.inv(covariance)
    mean = np.array([4.0, -3.0, 0.5])

    def log_density(points):
        return -0.5 * np.einsum("ni,ij,nj->n", points - mean, known, points - mean)

    found = sample_posterior(log_density, np.zeros(3), np.diag([400.0, 400.0, 1.0]))
    np.testing.assert_allclose(found.mean, mean, atol=0.1)
    np.testing.assert_allclose(found.covariance, covariance, rtol=0.15, atol=0.02)
    values = found.points @ np.array([[1.0], [2.0], [0.0]])
    np.testing.assert_allclose(found.covariance_with(values)[:, 0], covariance @ [1.0, 2.0, 0.0], rtol=0.15, atol=0.1)


def crater(**changes) -> Cylinder:
    stated = load_terrain("shackleton-thesis")
    assert isinstance(stated, Cylinder)
    return replace(stated, **changes)


def test_shared_errors_are_those_that_the_terrain_and_the_clock_state(ground):
    assert SharedErrors.of(crater(), None).names == ()
    assert SharedErrors.of(crater(depth_sigma_m=5.0, diameter_sigma_m=10.0), None).names == SHAPES
    turn = np.array([0.0, 1e-7, 2.6e-6])
    found = SharedErrors.of(ground, Clock(turn_rad_s=turn, sigma_s=600.0))
    assert found.names == (BIAS, CLOCK)
    assert found.sigma.tolist() == [ground.common_sigma_rad, 600.0]
    assert SharedErrors.of(ground, Clock(turn_rad_s=turn, sigma_s=1.0)).names == (BIAS,)


def test_the_edge_of_the_skyline_is_shared_and_no_longer_each_images_own(ground):
    found = SharedErrors.of(ground, None, uses_sky=True)
    assert found.names == (BIAS, EDGE)
    assert found.of_terrain(crater(depth_sigma_m=5.0)).names == (*SHAPES[:1], EDGE)
    own = ImageErrors(np.ones((4, 2)), np.diag([0.01, 0.02]))
    np.testing.assert_allclose(own.without_edge(found).covariance, np.diag([0.01 - found.sigma[1] ** 2, 0.02]))
    assert own.without_edge(SharedErrors.of(ground, None)) is own


def test_an_error_that_the_evidence_does_not_depend_on_stays_unknown():
    evidence, known = rays_at(crater(), PLACE_M, np.random.default_rng(7)), SharedErrors.of(crater(), None)
    shared = SharedErrors.of(crater(), None, uses_sky=True)
    with_edge, without = (
        estimate_frame(evidence, crater(), one, *first_guess(one, PLACE_M, 25.0 * np.eye(2))) for one in (shared, known)
    )
    assert with_edge.mean[2] == 0.0 and not with_edge.response[2].any()  # of stars alone
    away = with_edge.mean[:2] - without.mean[:2]
    assert away @ np.linalg.solve(without.covariance, away) < 0.05
    found = smooth(Observations.of([with_edge, with_edge], 0.0), Steps(np.zeros((1, 2)), np.ones(1)))
    assert found.shared[0] == pytest.approx(0.0, abs=1e-9)
    assert found.shared_covariance[0, 0] == pytest.approx(1.0)


def test_a_located_image_becomes_an_observation(located):
    found = observe_frame(located.result)
    fix = located.result.fix
    assert len(found.modes) == 1
    away = found.modes[0].mean[:2] - fix.position_enu_m[:2]
    assert away @ np.linalg.solve(fix.covariance_m2, away) < 1.0
    np.testing.assert_allclose(np.trace(found.modes[0].covariance[:2, :2]), np.trace(fix.covariance_m2), rtol=0.6)
    assert 0 < len(found.evidence) < len(located.result.evidence())
    R = found.R_body_enu
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)
    heading = np.degrees(np.arctan2(*R[0, :2]))  # of the body's x axis
    assert heading == pytest.approx(located.heading_pitch_roll_deg[0], abs=0.05)


def test_a_fix_of_another_depth_needs_an_error_of_the_depth(located):
    deeper = replace(located.result, steeper=0.005)
    with pytest.raises(ValueError, match="wrong depth"):
        observe_frame(deeper, SharedErrors.of(deeper.terrain, None))


def frame_at(terrain, shared, place, rng, number):
    rows = rays_at(terrain, place, rng, rays=600)
    guess = first_guess(shared, place + rng.normal(size=2), 25.0 * np.eye(2))
    one = estimate_frame(rows, terrain, shared, *guess)
    return ObservedFrame(f"{number}", TIME + timedelta(hours=number), None, (one,), rows)


def test_exposures_at_rest_are_one_posterior():
    terrain, shared, nees, errors = crater(), SharedErrors.of(crater(), None), [], []
    for seed in range(6):
        rng = np.random.default_rng([6, seed])
        place = rng.uniform(-3000, 3000, 2)
        frames = [frame_at(terrain, shared, place, rng, k) for k in range(4)]
        found = positions_at_rest(frames, terrain, shared)
        assert found.mode.tolist() == [0, 0, 0, 0]
        pooled = ExactPosterior()(Evidence.concatenate(*(frame.evidence for frame in frames)), terrain)
        away = found.position_m[-1] - pooled.position_enu_m[:2]
        assert away @ np.linalg.solve(pooled.covariance_m2, away) < 0.5
        np.testing.assert_allclose(found.smoothed.position_m[0], found.position_m[-1])
        off = found.position_m - place
        nees.append(np.einsum("ni,nij,nj->n", off, np.linalg.inv(found.covariance_m2), off))
        errors.append(np.linalg.norm(off, axis=1))
    assert np.mean(errors, axis=0)[-1] < 0.6 * np.mean(errors, axis=0)[0]
    assert 0.7 < np.mean(nees) < 4.5


@pytest.mark.parametrize("apart_m", [200.0, 1000.0])
def test_a_camera_that_moved_is_not_at_rest(apart_m):
    """Nothing slips at rest: of many images that which moved is left out, and of two or four there is no majority."""
    terrain, shared, rng = crater(), SharedErrors.of(crater(), None), np.random.default_rng(12)
    here, there = np.array([1000.0, -500.0]), np.array([1000.0, -500.0 + apart_m])
    frames = [frame_at(terrain, shared, there if k == 2 else here, rng, k) for k in range(5)]
    assert positions_at_rest(frames, terrain, shared).mode.tolist() == [0, 0, -1, 0, 0]
    for count in (2, 4):
        moved = [frame_at(terrain, shared, here + k * (there - here), rng, k) for k in range(count)]
        with pytest.raises(BadInput, match="agree on one position") as refusal:
            positions_at_rest(moved, terrain, shared)
        assert refusal.value.reason == "inconsistent_evidence"
