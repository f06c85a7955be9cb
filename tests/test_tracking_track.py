"""From observed frames and odometry to a track: statuses, axes, refused frames, and what it refuses."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from tracking_helpers import HEIGHT_SIGMA_M, SHARED, attitudes, observed, odometry_of, shifted, simulate_drive

from startrack.applications.tracking import ObservedFrame, Track, estimate_track
from startrack.applications.tracking.odometry import odometry_moves
from startrack.core.errors import BadInput
from startrack.estimation.observations import OdometryErrors, Steps
from startrack.terrain import HeightMap, load_terrain

FRAMES = 12


@pytest.fixture(scope="module")
def ground() -> HeightMap:
    terrain = load_terrain("shackleton")
    assert isinstance(terrain, HeightMap)
    return replace(terrain, search_radius_m=3000.0, height_sigma_m=HEIGHT_SIGMA_M)


def steps_of(frames, odometry) -> Steps:
    """Moves by odometry as stated, turned by the last attitude of the frames before each."""
    has = np.array([frame.R_body_enu is not None for frame in frames[:-1]])
    anchor = np.maximum.accumulate(np.where(has, np.arange(1, len(has) + 1), 0))
    return odometry_moves(frames, odometry, OdometryErrors(0.02, 0.05))[0].steps(anchor)


def refused(frame: ObservedFrame) -> ObservedFrame:
    """The frame without stars."""
    return replace(frame, modes=(), R_body_enu=None, reason="no_stars", message="no stars")


def test_moves_are_turned_by_the_stars_attitude_also_over_refused_frames():
    rng = np.random.default_rng(1)
    drive, R = simulate_drive(rng, FRAMES), attitudes(rng, FRAMES)
    frames = observed(drive.estimates, R)
    for k in (4, 5, 6):
        frames[k] = refused(frames[k])
    steps = steps_of(frames, odometry_of(drive.position_m, R))
    moves = np.diff(drive.position_m, axis=0)
    np.testing.assert_allclose(steps.move_m, moves, atol=1e-6)
    np.testing.assert_allclose(steps.sigma_m, np.hypot(0.02 * np.linalg.norm(moves, axis=1), 0.05), rtol=1e-6)


def test_moves_before_the_first_attitude_are_not_known():
    rng = np.random.default_rng(2)
    drive, R = simulate_drive(rng, FRAMES), attitudes(rng, FRAMES)
    frames = observed(drive.estimates, R)
    frames[0] = refused(frames[0])
    steps = steps_of(frames, odometry_of(drive.position_m, R))
    assert np.isinf(steps.sigma_m[0])
    assert np.isfinite(steps.sigma_m[1:]).all()


def test_a_track_names_what_it_used_and_bridges_the_rest(ground):
    rng = np.random.default_rng(3)
    drive, R = simulate_drive(rng, FRAMES), attitudes(rng, FRAMES)
    frames = observed(drive.estimates, R)
    frames[5] = refused(frames[5])
    frames[8] = replace(frames[8], modes=(shifted(drive.estimates[8], np.array([150.0, 0.0])),))
    track = estimate_track(frames, ground, SHARED, odometry=odometry_of(drive.position_m, R))
    assert isinstance(track, Track)
    assert [f.status for f in track.frames] == ["used"] * 5 + ["refused"] + ["used"] * 2 + ["left_out"] + ["used"] * 3
    assert track.frames[5].reason == "no_stars"
    assert track.frames[5].quat_xyzw_body_enu is None
    assert track.frames[8].reason == "inconsistent_evidence"
    for found in (track.smoothed, track.filtered):
        off = found.position_enu_m[:, :2] - drive.position_m
        assert np.linalg.norm(off, axis=1).max() < 15.0
        up = ground.ground_m(found.position_enu_m[:, :2]) + ground.camera_height_m
        np.testing.assert_allclose(found.position_enu_m[:, 2], up)
    np.testing.assert_allclose(track.filtered.position_enu_m[-1], track.smoothed.position_enu_m[-1], atol=0.02)
    assert track.bias_rad == pytest.approx(1e-3 * drive.shared[0], abs=4 * track.bias_sigma_rad)
    assert not track.slipped.any()
    assert track.clock is None
    start_m = track.smoothed.position_enu_m[0, :2] - drive.position_m[0]
    np.testing.assert_allclose(track.odometry_m - start_m, drive.position_m, atol=1e-6)


def test_without_odometry_a_refused_frame_has_no_position(ground):
    drive = simulate_drive(np.random.default_rng(4), FRAMES)
    frames = observed(drive.estimates, attitudes(np.random.default_rng(4), FRAMES))
    frames[3] = refused(frames[3])
    track = estimate_track(frames, ground, SHARED)
    for found in (track.smoothed, track.filtered):
        known = np.isfinite(found.position_enu_m[:, 0])
        assert known.tolist() == [k != 3 for k in range(FRAMES)]
        assert np.isinf(found.covariance_m2[3]).all()


def test_frames_out_of_order_are_refused(ground):
    drive = simulate_drive(np.random.default_rng(5), FRAMES)
    frames = observed(drive.estimates, attitudes(np.random.default_rng(5), FRAMES))
    with pytest.raises(BadInput, match="not in the order"):
        estimate_track(frames[::-1], ground, SHARED)
