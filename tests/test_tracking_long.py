"""Long drives: what many frames have followed is settled, and neither answers nor time and memory change."""

from dataclasses import replace

import numpy as np
import pytest
from synthetic_track import CRATER
from tracking_helpers import SHARED, attitudes, observed, odometry_of, shifted, simulate_drive

from startrack.applications.tracking import ObservedFrame, Odometry, TrackSession, estimate_track
from startrack.applications.tracking import explanations as explanations_module
from startrack.applications.tracking import filtered_positions as filter_module
from startrack.applications.tracking.filtered_positions import OnlineTrack
from startrack.applications.tracking.moves import Moves
from startrack.core.types import Array

FRAMES, WINDOW = 44, 9
LEG = slice(14, 27)  # moves that slip alike, more of them than the window has


def set_window(monkeypatch: pytest.MonkeyPatch, frames: int) -> None:
    """Explanations may differ about so many frames."""
    for module in (explanations_module, filter_module):
        monkeypatch.setattr(module, "WINDOW", frames)


def mixed_drive() -> tuple[list[ObservedFrame], Odometry, Array]:
    """A drive with a leg that slipped, an image from elsewhere, an ambiguous and a refused one; the true positions."""
    rng = np.random.default_rng(21)
    drive, R = simulate_drive(rng, FRAMES), attitudes(rng, FRAMES)
    moves = np.diff(drive.position_m, axis=0)
    moves[LEG] *= 1.25
    measured = np.concatenate([drive.position_m[:1], drive.position_m[0] + np.cumsum(moves, axis=0)])
    frames = observed(drive.estimates, R)
    frames[6] = replace(frames[6], modes=(shifted(drive.estimates[6], np.array([400.0, 300.0])),))
    frames[33] = replace(frames[33], modes=())
    other = shifted(drive.estimates[38], np.array([0.0, 250.0]))
    frames[38] = replace(frames[38], modes=(replace(other, weight=0.6), replace(drive.estimates[38], weight=0.4)))
    return frames, odometry_of(measured, R), drive.position_m


def newest_positions(frames: list[ObservedFrame], odometry: Odometry) -> tuple[Array, Array, list[str]]:
    """Positions (n, 3), 99.9 % radii (n,) and states of the frames as `track --follow` gives them one by one."""
    session = TrackSession(frames=frames, terrain=CRATER, shared=SHARED)
    tracks = list(session.newest(odometry, has_ended=True))
    position = np.array([one.filtered.position_enu_m[0] for one in tracks])
    radius = np.array([one.filtered.radius999_m[0] for one in tracks])
    return position, radius, [one.frames[0].status for one in tracks]


def test_a_window_shorter_than_a_slipped_leg_changes_no_answer(monkeypatch):
    frames, odometry, truth = mixed_drive()
    whole = newest_positions(frames, odometry)
    smoothed = estimate_track(frames, CRATER, SHARED, odometry=odometry)
    set_window(monkeypatch, WINDOW)
    position, radius, status = newest_positions(frames, odometry)
    assert status == whole[2]
    assert [k for k, one in enumerate(status) if one != "used"] == [6, 33]
    known = np.isfinite(whole[1])
    away = np.linalg.norm(position[known] - whole[0][known], axis=1)
    assert away.max() < 0.3 * whole[1][known].min()
    np.testing.assert_allclose(radius[known], whole[1][known], rtol=0.2)
    assert (np.linalg.norm(position[known, :2] - truth[known], axis=1) < 1.5 * radius[known]).all()
    short = estimate_track(frames, CRATER, SHARED, odometry=odometry)
    away = np.linalg.norm(short.smoothed.position_enu_m - smoothed.smoothed.position_enu_m, axis=1)
    assert (away < 0.3 * smoothed.smoothed.radius999_m).all()  # which move of the leg was its last is settled early
    assert [(leg.first, leg.last) for leg in short.legs] == [(leg.first, leg.last) for leg in smoothed.legs]


def test_what_a_track_keeps_does_not_grow(monkeypatch):
    set_window(monkeypatch, WINDOW)
    drive = simulate_drive(np.random.default_rng(22), 5 * WINDOW)
    moves, online, sizes = Moves.of(drive.steps), OnlineTrack(1), []
    for k, estimate in enumerate(drive.estimates):
        first = online.first
        assert k - first <= 2 * WINDOW
        online.add([estimate], [moves.part(first, k + 1 - first)], first)
        explained = online._explanations
        sizes.append((len(online._modes), len(explained._frames), explained._branches.history.shape[1]))
    assert np.max(sizes[2 * WINDOW :], axis=0).tolist() == [2 * WINDOW - 1, WINDOW, WINDOW]
    assert np.linalg.norm(online.position_m - drive.position_m[-1]) < 4.0 * np.sqrt(np.trace(online.covariance_m2))
