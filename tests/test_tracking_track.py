"""From observed frames and odometry to a track: statuses, axes, refused frames, and what it refuses."""

from __future__ import annotations

from dataclasses import replace
from datetime import UTC, datetime, timedelta

import numpy as np
import pytest
from tracking_helpers import HEIGHT_SIGMA_M, shifted, simulate_drive

from startrack.applications.tracking import ObservedFrame, Odometry, Track, TrackErrors, estimate_track
from startrack.applications.tracking.odometry import odometry_steps
from startrack.core.errors import BadInput
from startrack.estimation.observations import OdometryErrors
from startrack.frames import R_body_enu_from_heading_pitch_roll, quat_xyzw_from_R
from startrack.localization.shared_errors import SharedErrors
from startrack.terrain import HeightMap, ShapeError, load_terrain

START, EVERY_S = datetime(2030, 6, 1, tzinfo=UTC), 900.0
FRAMES = 12


@pytest.fixture(scope="module")
def ground() -> HeightMap:
    terrain = load_terrain("shackleton")
    assert isinstance(terrain, HeightMap)
    return replace(terrain, search_radius_m=3000.0, height_sigma_m=HEIGHT_SIGMA_M)


SHARED = TrackErrors(SharedErrors((ShapeError(name="bias_rad", fact="horizon_sigma_deg", sigma=1e-3),)))


def attitudes(rng) -> list[np.ndarray]:
    """From enu to the body, turning as it drives."""
    heading = np.cumsum(rng.normal(0.0, 0.2, FRAMES))
    return [R_body_enu_from_heading_pitch_roll(a, *rng.normal(0.0, 0.03, 2)) for a in heading]


def odometry_of(position_m: np.ndarray, R_body_enu: list[np.ndarray]) -> Odometry:
    """Without errors, in a frame of its own."""
    R_own_enu = R_body_enu_from_heading_pitch_roll(1.0, 0.0, 0.0)
    return Odometry(
        time_s=START.timestamp() + EVERY_S * np.arange(FRAMES),
        position_m=np.column_stack([position_m, np.zeros(FRAMES)]) @ R_own_enu.T + [5.0, -7.0, 1.0],
        quat_xyzw=np.array([quat_xyzw_from_R(R_own_enu @ R.T) for R in R_body_enu]),
    )


def observed(estimates, R_body_enu) -> list[ObservedFrame]:
    """Frames with one mode each."""
    return [
        ObservedFrame(f"frame-{k}", START + timedelta(seconds=EVERY_S * k), R, (e,), None)
        for k, (e, R) in enumerate(zip(estimates, R_body_enu, strict=True))
    ]


def refused(frame: ObservedFrame) -> ObservedFrame:
    """The frame without stars."""
    return replace(frame, modes=(), R_body_enu=None, reason="no_stars", message="no stars")


def test_moves_are_turned_by_the_stars_attitude_also_over_refused_frames():
    rng = np.random.default_rng(1)
    drive, R = simulate_drive(rng, FRAMES), attitudes(rng)
    frames = observed(drive.estimates, R)
    for k in (4, 5, 6):
        frames[k] = refused(frames[k])
    steps = odometry_steps(frames, odometry_of(drive.position_m, R), OdometryErrors(0.02, 0.05))
    moves = np.diff(drive.position_m, axis=0)
    np.testing.assert_allclose(steps.move_m, moves, atol=1e-6)
    np.testing.assert_allclose(steps.sigma_m, np.hypot(0.02 * np.linalg.norm(moves, axis=1), 0.05), rtol=1e-6)


def test_moves_before_the_first_attitude_are_not_known():
    rng = np.random.default_rng(2)
    drive, R = simulate_drive(rng, FRAMES), attitudes(rng)
    frames = observed(drive.estimates, R)
    frames[0] = refused(frames[0])
    steps = odometry_steps(frames, odometry_of(drive.position_m, R), OdometryErrors(0.02, 0.05))
    assert np.isinf(steps.sigma_m[0])
    assert np.isfinite(steps.sigma_m[1:]).all()


def test_a_track_names_what_it_used_and_bridges_the_rest(ground):
    rng = np.random.default_rng(3)
    drive, R = simulate_drive(rng, FRAMES), attitudes(rng)
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
    assert track.crests is not None
    truth = drive.height_error_m[track.crests.post]
    assert (track.crests.sigma_m < HEIGHT_SIGMA_M).all()
    assert np.mean(np.square((truth - track.crests.error_m) / track.crests.sigma_m)) == pytest.approx(1.0, abs=0.5)
    assert not track.slipped.any()
    assert track.clock is None


def test_without_odometry_a_refused_frame_has_no_position(ground):
    drive = simulate_drive(np.random.default_rng(4), FRAMES)
    frames = observed(drive.estimates, attitudes(np.random.default_rng(4)))
    frames[3] = refused(frames[3])
    track = estimate_track(frames, ground, SHARED)
    for found in (track.smoothed, track.filtered):
        known = np.isfinite(found.position_enu_m[:, 0])
        assert known.tolist() == [k != 3 for k in range(FRAMES)]
        assert np.isinf(found.covariance_m2[3]).all()


def test_frames_out_of_order_are_refused(ground):
    drive = simulate_drive(np.random.default_rng(5), FRAMES)
    frames = observed(drive.estimates, attitudes(np.random.default_rng(5)))
    with pytest.raises(BadInput, match="not in the order"):
        estimate_track(frames[::-1], ground, SHARED)
