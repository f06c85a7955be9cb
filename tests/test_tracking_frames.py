"""One frame as an observation: against the exact posterior, and its sensitivities against changed maps and rows."""

from __future__ import annotations

from dataclasses import replace
from datetime import UTC, datetime, timedelta

import numpy as np
import pytest

from startrack.applications.tracking.frame_estimate import (
    FIRST_WAVE,
    MIN_NOISE_SHARE,
    balanced_moments,
    clipped_noise,
    estimate_frame,
)
from startrack.applications.tracking.observed_frame import (
    ObservedFrame,
    decode_frame,
    encode_frame,
    observe_again,
    observe_frame,
)
from startrack.applications.tracking.positions import positions_at_rest
from startrack.applications.tracking.track_errors import BIAS, CLOCK, DEPTH, EDGE, TrackErrors
from startrack.core.types import BadInput, Clock, Evidence, ImageErrors, ShownError
from startrack.estimation.observations import Steps
from startrack.estimation.trajectory import smooth
from startrack.localization import ExactPosterior
from startrack.localization.importance_sampling import sample
from startrack.terrain import Cylinder, HeightMap, load_terrain

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


def estimate(evidence, terrain, place=PLACE_M):
    return estimate_frame(evidence, terrain, TrackErrors.of(terrain, None), place, 25.0 * np.eye(2))


def raise_post(terrain: HeightMap, post: int, by_m: float) -> HeightMap:
    """The map with one post of its finest raster higher."""
    heights = terrain.maps[0].heights_m.copy()
    heights.ravel()[post] += by_m
    return replace(terrain, maps=(replace(terrain.maps[0], heights_m=heights), *terrain.maps[1:]))


def test_the_horizon_sinks_with_the_posts_about_the_camera(ground):
    azimuth = np.radians([17.0, 140.0, 255.0])
    post, rad_per_m = ground.errors.ground_posts(PLACE_M, azimuth)
    raised_m = 20.0  # horizons are traced to some 1e-7 rad
    changed = raise_post(ground, int(post[0, 2]), raised_m).horizon_rad(PLACE_M[None], azimuth)
    np.testing.assert_allclose(
        changed - ground.horizon_rad(PLACE_M[None], azimuth), raised_m * rad_per_m[:, 2], rtol=0.05
    )


def test_posts_stand_where_the_map_has_them(ground):
    post, _ = ground.errors.ground_posts(PLACE_M, np.zeros(1))
    points = ground.errors.post_positions_m(post[0])
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
    alone = smooth([found], Steps.unknown(1))
    np.testing.assert_allclose(np.trace(alone.covariance_m2[0]), np.trace(fix.covariance_m2), rtol=0.5)
    assert found.mean[2] * ground.errors.common_sigma_rad == pytest.approx(HORIZON_ERROR_RAD, abs=np.radians(0.02))


def test_the_response_to_the_bias_is_that_to_raised_rows(ground):
    evidence = rays_at(ground, PLACE_M, np.random.default_rng(2))
    here = estimate(evidence, ground)
    raised = replace(evidence, elevation_rad=evidence.elevation_rad + 0.2 * ground.errors.common_sigma_rad)
    there = estimate(raised, ground)
    np.testing.assert_allclose(
        there.mean - here.mean, 0.2 * here.response[:, 2], atol=0.1 * np.sqrt(here.covariance[0, 0])
    )
    assert here.response[2, 2] > 0.9
    np.testing.assert_allclose(here.response[:, :2], np.eye(len(here.mean))[:, :2], atol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(1, 4))
def test_the_response_to_posts_is_that_to_a_map_with_other_heights(ground, seed):
    """The 40 posts that move the position most, a metre each, all to the same side: 8 to 15 % less than stated."""
    evidence = rays_at(ground, PLACE_M, np.random.default_rng(seed))
    here = estimate(evidence, ground)
    effect = np.where(here.post < FIRST_WAVE, np.abs(here.by_post[0]), 0.0)
    strongest = np.argsort(-effect)[:40]
    sides, changed = np.sign(here.by_post[0, strongest]), ground
    for post, side in zip(here.post[strongest].tolist(), sides.tolist(), strict=True):
        changed = raise_post(changed, post, -side)
    moved = estimate(evidence, changed).mean[:2] - here.mean[:2]
    stated = here.by_post[:2, strongest] @ sides / ground.height_sigma_m
    np.testing.assert_allclose(moved, stated, atol=0.2 * np.linalg.norm(stated))


def test_noise_is_positive_definite_and_no_less_than_its_share():
    whole = np.diag([4.0, 1.0])
    clipped = clipped_noise(np.array([[-3.0, 0.5], [0.5, 0.8]]), whole)
    shares = np.linalg.eigvalsh(np.diag([0.5, 1.0]) @ clipped @ np.diag([0.5, 1.0]))
    assert shares[0] == pytest.approx(MIN_NOISE_SHARE)
    np.testing.assert_allclose(clipped_noise(0.6 * whole, whole), 0.6 * whole)


def test_moments_of_points_are_those_of_the_density():
    covariance = np.array([[9.0, 2.0, 0.3], [2.0, 1.0, 0.1], [0.3, 0.1, 0.04]])
    known = np.linalg.inv(covariance)
    mean = np.array([4.0, -3.0, 0.5])

    def log_density(points):
        return -0.5 * np.einsum("ni,ij,nj->n", points - mean, known, points - mean)

    found = balanced_moments(sample(log_density, [(np.zeros(3), np.diag([40.0, 40.0, 1.0]))]))
    np.testing.assert_allclose(found[0], mean, atol=0.03)
    np.testing.assert_allclose(found[1], covariance, rtol=0.05, atol=0.005)


def crater(**changes) -> Cylinder:
    stated = load_terrain("shackleton-thesis")
    assert isinstance(stated, Cylinder)
    return replace(stated, **changes)


def test_shared_errors_are_those_that_the_terrain_and_the_clock_state(ground):
    stated = crater()
    assert TrackErrors.of(stated, None).names == ()
    assert DEPTH in TrackErrors.of(crater(depth_sigma_m=5.0), None).names
    clock = Clock(turn_rad_s=np.array([0.0, 1e-7, 2.6e-6]), sigma_s=600.0)
    found = TrackErrors.of(ground, clock)
    assert found.names == (*(one.name for one in ground.errors.shape if one.sigma > 0.0 and not one.wave), CLOCK)
    assert found.sigma[[found.names.index(BIAS), -1]].tolist() == [ground.errors.common_sigma_rad, 600.0]


def test_a_gross_error_widens_its_fact_alone():
    errors = TrackErrors.of(crater(depth_sigma_m=None), None)
    wide = errors.with_gross(["depth_sigma_m", "no_such_fact"])
    assert wide.gross == {"depth_sigma_m"}
    changed = np.array(wide.names)[wide.sigma != errors.sigma]
    assert changed.tolist() == [DEPTH]
    assert wide.sigma[wide.names.index(DEPTH)] == 0.01


def test_the_edge_of_the_skyline_is_shared_and_no_longer_each_images_own(ground):
    found = TrackErrors.of(ground, None, uses_sky=True)
    assert found.names[-1] == EDGE
    own = ImageErrors(np.ones((4, 2)), np.zeros(2), np.diag([0.01, 0.02]), np.ones(4))
    np.testing.assert_allclose(found.of_image(own).covariance, np.diag([0.01 - found.sigma[-1] ** 2, 0.02]))
    assert TrackErrors.of(ground, None).of_image(own) is own


def test_an_error_that_the_evidence_does_not_depend_on_stays_unknown():
    evidence, known = rays_at(crater(), PLACE_M, np.random.default_rng(7)), TrackErrors.of(crater(), None)
    shared = TrackErrors.of(crater(), None, uses_sky=True)
    with_edge, without = (estimate_frame(evidence, crater(), one, PLACE_M, 25.0 * np.eye(2)) for one in (shared, known))
    assert with_edge.mean[-1] == 0.0 and not with_edge.response[-1].any()  # of stars alone
    away = with_edge.mean[:2] - without.mean[:2]
    assert away @ np.linalg.solve(without.covariance[:2, :2], away) < 0.3
    found = smooth([with_edge, with_edge], Steps(np.zeros((1, 2)), np.ones(1)))
    assert found.shared[-1] == pytest.approx(0.0, abs=1e-9)
    assert found.shared_covariance[-1, -1] == pytest.approx(1.0)


def test_a_located_image_becomes_an_observation(located):
    found = observe_frame(located.result)
    fix = located.result.fix
    assert len(found.modes) == 1
    away = found.modes[0].mean[:2] - fix.position_enu_m[:2]
    assert away @ np.linalg.solve(fix.covariance_m2, away) < 1.0
    np.testing.assert_allclose(np.trace(found.modes[0].covariance[:2, :2]), np.trace(fix.covariance_m2), rtol=0.6)
    assert len(found.evidence) > 0
    np.testing.assert_array_equal(found.fixes[0].position_enu_m, fix.position_enu_m)
    again = decode_frame(encode_frame(found))
    np.testing.assert_array_equal(again.modes[0].mean, found.modes[0].mean)
    np.testing.assert_array_equal(again.fixes[0].covariance_m2, fix.covariance_m2)
    assert again.fixes[0].radius999_m == fix.radius999_m
    errors = TrackErrors.of(located.result.terrain, located.result.clock, located.result.sky_at_skyline is not None)
    np.testing.assert_array_equal(
        observe_again(again, errors, located.result.terrain).modes[0].mean, found.modes[0].mean
    )
    R = found.R_body_enu
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)
    heading = np.degrees(np.arctan2(*R[0, :2]))  # of the body's x axis
    assert heading == pytest.approx(located.heading_pitch_roll_deg[0], abs=0.05)


def test_a_gross_error_that_an_image_shows_must_be_shared(located):
    silent = replace(located.result.terrain, depth_sigma_m=None)
    shown = ShownError("depth_1", "depth_sigma_m", 0.01, 0.001)
    deeper = replace(located.result, terrain=silent, fix=replace(located.result.fix, shown=(shown,)))
    errors = TrackErrors.of(silent, None, uses_sky=True)
    with pytest.raises(ValueError, match="gross error of depth_sigma_m"):
        observe_frame(deeper, errors)
    found = observe_frame(deeper, errors.with_gross(["depth_sigma_m"]))
    assert found.facts == {"depth_sigma_m"}
    assert decode_frame(encode_frame(found)).shown == (shown,)


def frame_at(terrain, shared, place, rng, number):
    rows = rays_at(terrain, place, rng, rays=600)
    one = estimate_frame(rows, terrain, shared, place + rng.normal(size=2), 25.0 * np.eye(2))
    return ObservedFrame(f"{number}", TIME + timedelta(hours=number), None, (one,), rows)


@pytest.mark.slow
def test_exposures_at_rest_are_one_posterior():
    terrain, shared, nees, errors = crater(), TrackErrors.of(crater(), None), [], []
    for seed in range(6):
        rng = np.random.default_rng([6, seed])
        place = rng.uniform(-3000, 3000, 2)
        frames = [frame_at(terrain, shared, place, rng, k) for k in range(4)]
        found, by_first = positions_at_rest(frames, terrain, shared)
        position, covariance = by_first.position_m, by_first.covariance_m2
        assert found.mode.tolist() == [0, 0, 0, 0]
        pooled = ExactPosterior()(Evidence.concatenate(*(frame.evidence for frame in frames)), terrain)
        away = position[-1] - pooled.position_enu_m[:2]
        assert away @ np.linalg.solve(pooled.covariance_m2, away) < 0.5
        np.testing.assert_allclose(found.smoothed.position_m[0], position[-1])
        off = position - place
        nees.append(np.einsum("ni,nij,nj->n", off, np.linalg.inv(covariance), off))
        errors.append(np.linalg.norm(off, axis=1))
    assert np.mean(errors, axis=0)[-1] < 0.6 * np.mean(errors, axis=0)[0]
    assert 0.7 < np.mean(nees) < 4.5


@pytest.mark.slow
@pytest.mark.parametrize("apart_m", [200.0, 1000.0])
def test_a_camera_that_moved_is_not_at_rest(apart_m):
    """Nothing slips at rest: of many images that which moved is left out, and of two or four there is no majority."""
    terrain, shared, rng = crater(), TrackErrors.of(crater(), None), np.random.default_rng(12)
    here, there = np.array([1000.0, -500.0]), np.array([1000.0, -500.0 + apart_m])
    frames = [frame_at(terrain, shared, there if k == 2 else here, rng, k) for k in range(5)]
    assert positions_at_rest(frames, terrain, shared)[0].mode.tolist() == [0, 0, -1, 0, 0]
    for count in (2, 4):
        moved = [frame_at(terrain, shared, here + k * (there - here), rng, k) for k in range(count)]
        with pytest.raises(BadInput, match="agree on one position") as refusal:
            positions_at_rest(moved, terrain, shared)
        assert refusal.value.reason == "inconsistent_evidence"
