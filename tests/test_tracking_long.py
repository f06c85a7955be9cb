"""Long drives: what many frames have followed is settled, and neither answers nor time and memory change."""

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
import pytest
from synthetic_track import CRATER
from tracking_helpers import SHARED, attitudes, observed, odometry_of, shifted, simulate_drive

from startrack.applications.tracking import ObservedFrame, Odometry, TrackSession, estimate_track
from startrack.applications.tracking import session as session_module
from startrack.applications.tracking.explanations import BEGINS, CONTINUES, MOST_WAITING, explain
from startrack.applications.tracking.explanations import WINDOW as SETTLED_AFTER
from startrack.applications.tracking.odometry import Moves, odometry_moves
from startrack.applications.tracking.positions import OnlineTrack, filter_positions
from startrack.core.errors import BadInput
from startrack.core.types import Array
from startrack.estimation.observations import USUAL_ODOMETRY, FrameEstimate

FRAMES, WINDOW = 44, 9
LEG = slice(14, 27)  # moves that slip alike, more of them than the window has


def set_window(monkeypatch: pytest.MonkeyPatch, frames: int) -> None:
    """In a live track frames are settled that so many have followed."""
    monkeypatch.setattr(session_module, "WINDOW", frames)


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
    set_window(monkeypatch, WINDOW)
    position, radius, status = newest_positions(frames, odometry)
    assert status == whole[2]
    assert [k for k, one in enumerate(status) if one != "used"] == [6, 33]
    known = np.isfinite(whole[1])
    away = np.linalg.norm(position[known] - whole[0][known], axis=1)
    assert away.max() < 0.3 * whole[1][known].min()
    np.testing.assert_allclose(radius[known], whole[1][known], rtol=0.2)
    assert (np.linalg.norm(position[known, :2] - truth[known], axis=1) < 1.5 * radius[known]).all()


def part_of(moves: Moves, first: int, frames: int) -> Moves:
    """The moves between so many frames from number `first` on."""
    turn, which = np.concatenate([moves.turn[:1], moves.turn[first + 1 :][:frames]]), slice(first, first + frames - 1)
    return replace(
        moves, turn=turn, delta_m=moves.delta_m[which], sigma_m=moves.sigma_m[which], freedom_m=moves.freedom_m[which]
    )  # fmt: skip


def followed(
    modes: Sequence[Sequence[FrameEstimate]], moves: Sequence[Moves], window: int = WINDOW
) -> Iterator[OnlineTrack]:
    """The live track after each frame."""
    online = OnlineTrack(1, window)
    for k, of in enumerate(modes):
        first = online.first
        online.add(of, [part_of(one, first, k + 1 - first) for one in moves], first)
        yield online


def test_a_whole_track_settles_nothing():
    drive = simulate_drive(np.random.default_rng(25), SETTLED_AFTER + 3)
    modes, moves = [(one,) for one in drive.estimates], [Moves.of(drive.steps)]
    (*_, live) = followed(modes, moves, SETTLED_AFTER)
    assert live.compared.settled == 3
    assert filter_positions(modes, moves, 1).compared.settled == explain(modes, moves).settled == 0


@pytest.mark.parametrize("window", [1, 2, WINDOW])
def test_what_is_settled_is_the_past_of_every_explanation_and_of_the_filter(window):
    """A leg of which begin and end are disputed: without posts the filter is at the position that it follows."""
    for seed in range(6):
        drive = simulate_drive(np.random.default_rng([31, seed]), 24)
        move_m = drive.steps.move_m.copy()
        move_m[6:16, 0] *= 1.12
        moves = [Moves.of(replace(drive.steps, move_m=move_m))]
        for online in followed([(one.without_posts,) for one in drive.estimates], moves, window):
            best, *others = online.compared.ranked()
            np.testing.assert_allclose(online.filter.position_m, best.position_m, atol=1e-3)
            for one in (best, *best.variants, *others):
                assert (one.kind[:-1][one.kind[1:] == CONTINUES] >= BEGINS).all()


def test_what_a_live_track_keeps_does_not_grow():
    drive = simulate_drive(np.random.default_rng(22), 5 * WINDOW)
    sizes, first = [], 0
    for k, online in enumerate(followed([(one,) for one in drive.estimates], [Moves.of(drive.steps)])):
        explained = online.compared
        sizes.append((len(online._modes), len(explained._frames), explained._branches.history.shape[1], k - first))
        first = online.first
    assert np.max(sizes[WINDOW:], axis=0).tolist() == [WINDOW, WINDOW, WINDOW, WINDOW + 1]
    assert np.linalg.norm(online.position[0] - drive.position_m[-1]) < 4.0 * np.sqrt(np.trace(online.position[1]))


def with_groups(*lengths: int, together: bool = True) -> tuple[list[ObservedFrame], Odometry, Array]:
    """A drive whose frames are, in turn, of it and 1,000 m off; frames of one kind agree with the odometry."""
    count = sum(lengths)
    rng = np.random.default_rng(23)
    drive, R = simulate_drive(rng, count), attitudes(rng, count)
    estimates, is_off = list(drive.estimates), np.repeat(np.arange(len(lengths)) % 2 == 1, lengths)
    for k in np.flatnonzero(is_off):
        estimates[k] = shifted(estimates[k], np.array([1000.0, 300.0 + (0.0 if together else 40.0 * k)]))
    return observed(estimates, R), odometry_of(drive.position_m, R), drive.position_m


@pytest.mark.parametrize("lengths", [(3 * WINDOW, WINDOW + 6), (2 * WINDOW, WINDOW + 3, 2 * WINDOW)])
def test_images_from_elsewhere_do_not_take_over_what_is_settled(monkeypatch, lengths):
    frames, odometry, truth = with_groups(*lengths)
    whole = newest_positions(frames, odometry)
    set_window(monkeypatch, WINDOW)
    position, radius, status = newest_positions(frames, odometry)
    assert status == whole[2]
    known = np.isfinite(radius)
    assert (np.linalg.norm(position[known, :2] - truth[known], axis=1) < 1.5 * radius[known]).all()


@pytest.mark.parametrize(("first", "second", "is_known"), [(27, 27, False), (18, 23, True)])
def test_images_that_contradict_what_is_settled_are_a_track_of_their_own(first, second, is_known):
    """As many images as before them, of which neither group is clearly right, and more; never both at once."""
    frames, odometry, truth = with_groups(first, second)
    modes, moves = [one.modes for one in frames], odometry_moves(frames, odometry, USUAL_ODOMETRY)
    for whole, live in zip(followed(modes, moves, len(modes)), followed(modes, moves), strict=True):
        used = [k + live._first for k in np.flatnonzero(live._best.mode >= 0).tolist()]
        assert max(used) < first or min(used) >= first
        assert (live.is_vouched, live.mode) == (whole.is_vouched, whole.mode)
        np.testing.assert_allclose(live.position[0], whole.position[0], atol=0.5)
        sigma_m = [np.sqrt(np.trace(one.position[1])) for one in (live, whole)]
        assert sigma_m[0] == pytest.approx(sigma_m[1], rel=0.2)
    assert live.compared.settled > WINDOW and live.is_vouched == is_known
    if is_known:
        off = live.position[0] - truth[-1] - [1000.0, 300.0]
        assert off @ np.linalg.solve(live.position[1], off) < 9.0


def test_a_pair_of_images_from_elsewhere_that_agree_is_settled():
    frames, odometry, truth = with_groups(WINDOW, 2, 3 * WINDOW)
    (*_, live) = followed([one.modes for one in frames], odometry_moves(frames, odometry, USUAL_ODOMETRY))
    assert live.compared.settled == len(frames) - WINDOW <= live.first + 1
    off = live.position[0] - truth[-1]
    assert live.is_vouched and off @ np.linalg.solve(live.position[1], off) < 9.0


def test_two_groups_of_which_neither_is_clearly_right_are_not_settled(monkeypatch):
    frames, odometry, truth = with_groups(*[1] * (4 * WINDOW))
    set_window(monkeypatch, WINDOW)
    position, radius, _ = newest_positions(frames, odometry)
    known = np.isfinite(radius)
    off = np.linalg.norm(position[known, :2] - truth[known], axis=1)
    assert (off < 1.5 * radius[known]).all()
    with pytest.raises(BadInput, match="contradict each other"):
        estimate_track(frames, CRATER, SHARED, odometry=odometry)


def test_a_gap_longer_than_the_window_is_bridged(monkeypatch):
    """Refused images without an attitude: the last one before them turns the move of each."""
    frames, odometry, _ = with_groups(3 * WINDOW)
    gap = range(WINDOW, 2 * WINDOW + 4)
    frames = [replace(one, modes=(), R_body_enu=None) if k in gap else one for k, one in enumerate(frames)]
    whole = newest_positions(frames, odometry)
    set_window(monkeypatch, WINDOW // 2)
    position, radius, status = newest_positions(frames, odometry)
    assert np.isfinite(radius[WINDOW // 2 :]).all() and status == whole[2]
    np.testing.assert_allclose(position, whole[0], atol=0.5)
    np.testing.assert_allclose(radius, whole[1], rtol=0.1)


def test_odometry_of_which_two_scales_are_likely_keeps_its_errors(monkeypatch):
    """7 % too long: moves by the usual errors and by larger ones explain it as well, and change places."""
    set_window(monkeypatch, WINDOW)
    nees = []
    for seed in range(6):
        rng = np.random.default_rng([24, seed])
        drive, R = simulate_drive(rng, 40), attitudes(rng, 40)
        odometry = odometry_of(1.068 * (drive.position_m - drive.position_m[0]), R)
        session = TrackSession(frames=observed(drive.estimates, R), terrain=CRATER, shared=SHARED)
        for k, one in enumerate(session.newest(odometry, has_ended=True)):
            off = one.filtered.position_enu_m[0, :2] - drive.position_m[k]
            if k > 25 and np.isfinite(off).all():
                nees.append(off @ np.linalg.solve(one.filtered.covariance_m2[0], off))
    assert np.mean(nees) < 2.8


def test_a_long_run_of_refused_frames_does_not_grow():
    """As by day: frames before it are settled although no other one with a position has come."""
    drive = simulate_drive(np.random.default_rng(24), 20 * WINDOW)
    modes = [(one,) if k < WINDOW else () for k, one in enumerate(drive.estimates)]
    *_, last = followed(modes, [Moves.of(drive.steps)])
    assert len(last.compared._frames) == MOST_WAITING * WINDOW
