"""The linear estimator of a track: against least squares with every unknown written out, and against the truth."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from tracking_helpers import STEP_SIGMA_M, Drive, mean_nees, shifted, simulate_drive, with_slips

from startrack.applications.tracking.explanations import explain
from startrack.applications.tracking.odometry import Moves
from startrack.applications.tracking.positions import OnlineTrack, RobustTrack, conclude, filter_positions
from startrack.estimation import trajectory
from startrack.estimation.observations import FrameEstimate, Steps
from startrack.estimation.trajectory import TrackFilter, smooth


def with_shared_moves(drive: Drive) -> Drive:
    """The drive with errors of scale and heading that all its moves share."""
    move_m = drive.steps.move_m
    return replace(drive, steps=replace(drive.steps, by_shared_m=0.05 * np.stack([move_m, move_m[:, ::-1]], axis=-1)))


def explained(modes: Sequence[Sequence[FrameEstimate]], steps: Steps) -> RobustTrack:
    """The track by its likeliest explanation."""
    return conclude(modes, explain(modes, [Moves.of(steps)]))


def least_squares(drive: Drive, frames: int) -> tuple[np.ndarray, np.ndarray]:
    """Positions, shared errors, heights, and errors of moves and of legs, as unknowns of one linear problem.

    Also their covariance.
    """
    k, posts, steps = len(drive.shared), len(drive.height_error_m), drive.steps
    leg = np.cumsum(steps.begins)
    legs = [steps.by_leg_m * (leg == number)[:, None, None] for number in range(1, steps.begins.sum() + 1)]
    by_moves = [steps.by_shared_m, *legs]
    by_move = np.concatenate(by_moves, axis=-1)
    moves = by_move.shape[-1]
    size = 2 * frames + k + posts + moves
    rows, values = [], []

    def add(design: np.ndarray, value: np.ndarray, covariance: np.ndarray) -> None:
        unit = np.linalg.inv(np.linalg.cholesky(covariance))
        rows.append(unit @ design)
        values.append(unit @ value)

    for i, e in enumerate(drive.estimates[:frames]):
        design = np.zeros((2 + k, size))
        design[:, 2 * i : 2 * i + 2] = e.response[:, :2]
        design[:, 2 * frames : 2 * frames + k] = e.response[:, 2:]
        design[:, 2 * frames + k + e.post] = e.by_post
        add(design, e.mean, e.noise)
    for i in range(frames - 1):
        design = np.zeros((2, size))
        design[:, 2 * i : 2 * i + 2], design[:, 2 * i + 2 : 2 * i + 4] = -np.eye(2), np.eye(2)
        if moves:
            design[:, -moves:] = -by_move[i]
        add(design, drive.steps.move_m[i], STEP_SIGMA_M**2 * np.eye(2))
    priors = np.ones(k + posts + moves)
    add(np.eye(size)[2 * frames :], np.zeros(len(priors)), np.eye(len(priors)))
    A, b = np.vstack(rows), np.concatenate(values)
    solution = np.linalg.lstsq(A, b, rcond=None)[0]
    return solution, np.linalg.inv(A.T @ A)


@pytest.mark.parametrize(("shared_count", "by_moves"), [(0, False), (1, False), (2, True), (0, True)])
def test_the_smoother_is_least_squares_with_all_unknowns(shared_count, by_moves):
    drive = simulate_drive(np.random.default_rng(1), 7, shared_count)
    drive = with_shared_moves(drive) if by_moves else drive
    found = smooth(drive.estimates, drive.steps)
    solution, covariance = least_squares(drive, 7)
    np.testing.assert_allclose(found.position_m.ravel(), solution[:14], atol=1e-6)
    np.testing.assert_allclose(found.shared, solution[14 : 14 + shared_count], atol=1e-7)
    shared = slice(14, 14 + shared_count)
    np.testing.assert_allclose(found.shared_covariance, covariance[shared, shared], atol=1e-6)
    for i in range(7):
        part = slice(2 * i, 2 * i + 2)
        np.testing.assert_allclose(found.covariance_m2[i], covariance[part, part], atol=1e-6)


@pytest.mark.parametrize("by_moves", [False, True])
@pytest.mark.parametrize("leg", [[0] * 8, [0, 1, 1, 1, 0, 3, 4, 4]])
def test_the_filter_is_least_squares_with_the_frames_so_far(by_moves, leg):
    drive = simulate_drive(np.random.default_rng(2), 9)
    drive = with_shared_moves(drive) if by_moves else drive
    number = np.array(leg)
    by_leg_m = 0.2 * np.stack([drive.steps.move_m, drive.steps.move_m[:, ::-1]], axis=-1) * (number > 0)[:, None, None]
    begins = (number > 0) & (np.diff(number, prepend=0) != 0)
    drive = replace(drive, steps=replace(drive.steps, begins=begins, by_leg_m=by_leg_m)) if by_moves else drive
    state = TrackFilter.start(1, drive.steps.by_shared_m.shape[-1], drive.steps.by_leg_m.shape[-1])
    for k, estimate in enumerate(drive.estimates):
        if k:
            state.predict(drive.steps, k - 1)
        state.update(estimate)
        solution, covariance = least_squares(drive, k + 1)
        last = slice(2 * k, 2 * k + 2)
        np.testing.assert_allclose(state.position_m, solution[last], atol=1e-4)
        np.testing.assert_allclose(state.covariance_m2, covariance[last, last], atol=1e-4)
    found = smooth(drive.estimates, drive.steps)
    np.testing.assert_allclose(found.position_m.ravel(), solution[:18], atol=1e-4)
    every = [covariance[2 * k : 2 * k + 2, 2 * k : 2 * k + 2] for k in range(9)]
    np.testing.assert_allclose(found.covariance_m2, every, atol=1e-4)


def test_positions_of_long_ago_change_no_more(monkeypatch):
    """Those of the last frames do as before, and the others are as they were known when so many frames had followed."""
    drive = simulate_drive(np.random.default_rng(13), 30)
    whole = smooth(drive.estimates, drive.steps)
    first = smooth(drive.estimates[:13], Steps(drive.steps.move_m[:12], drive.steps.sigma_m[:12]))
    monkeypatch.setattr(trajectory, "MOST_FOLLOWING", 12)
    found = smooth(drive.estimates, drive.steps)
    np.testing.assert_allclose(found.position_m[-13:], whole.position_m[-13:], atol=1e-9)
    np.testing.assert_allclose(found.covariance_m2[-13:], whole.covariance_m2[-13:], atol=1e-9)
    np.testing.assert_allclose(found.position_m[0], first.position_m[0], atol=1e-9)
    off = np.linalg.norm(found.position_m - whole.position_m, axis=1)
    assert off.max() < 0.25 * np.sqrt(np.trace(whole.covariance_m2, axis1=1, axis2=2)).min()


def test_the_filter_forgets_posts_without_a_jump(monkeypatch):
    drive = simulate_drive(np.random.default_rng(12), 30)

    def states():
        state = TrackFilter.start(1)
        for k, estimate in enumerate(drive.estimates):
            if k:
                state.predict(drive.steps, k - 1)
            state.update(estimate)
            yield state.mean.shape[1], state.position_m, state.covariance_m2

    whole = list(states())
    monkeypatch.setattr(trajectory, "MOST_POSTS", 16)  # 12 are kept: a frame depends on 8, of which the next has 6
    for (size, position_m, covariance_m2), (_, expected_m, expected_m2) in zip(states(), whole, strict=True):
        assert size <= 3 + 24
        np.testing.assert_allclose(position_m, expected_m, atol=1e-4)
        np.testing.assert_allclose(covariance_m2, expected_m2, atol=1e-4)


@pytest.mark.slow
def test_positions_have_their_stated_errors_and_the_plain_sum_has_not():
    errors, covariances, plain_errors, plain_covariances = [], [], [], []
    for seed in range(60):
        drive = simulate_drive(np.random.default_rng([4, seed]), 12)
        found = smooth(drive.estimates, drive.steps)
        alone = [replace(e, noise=e.covariance, post=e.post[:0], by_post=e.by_post[:, :0]) for e in drive.estimates]
        plain = smooth(alone, drive.steps)
        errors.append(found.position_m - drive.position_m)
        covariances.append(found.covariance_m2)
        plain_errors.append(plain.position_m - drive.position_m)
        plain_covariances.append(plain.covariance_m2)
    assert 1.6 < mean_nees(np.concatenate(errors), np.concatenate(covariances)) < 2.4
    assert mean_nees(np.concatenate(plain_errors), np.concatenate(plain_covariances)) > 2.6
    assert np.square(errors).mean() < np.square(plain_errors).mean()


def test_slipped_moves_are_found_and_cost_no_more_than_their_loss():
    """Single ones; of moves next to each other that slip alike, those between may be of the same leg."""
    found, lost, known = 0, [], []
    for seed in range(10):
        drive = simulate_drive(np.random.default_rng([5, seed]), 30)
        which = np.array([2, 12, 22]) + np.random.default_rng([6, seed]).integers(0, 5, 3)
        modes = [(e,) for e in drive.estimates]
        slipped = explained(modes, with_slips(drive.steps, which, 20.0))
        found += int((slipped.best.leg > 0)[which].sum())
        assert (slipped.best.leg > 0).sum() <= 4
        assert not explained(modes, drive.steps).best.leg.any()
        without = np.where(np.isin(np.arange(29), which), np.inf, drive.steps.sigma_m)
        unslipped = smooth(
            drive.estimates, replace(drive.steps, sigma_m=without)
        )  # fmt: skip
        lost.append(np.linalg.norm(slipped.smoothed.position_m - drive.position_m, axis=1).mean())
        known.append(np.linalg.norm(unslipped.position_m - drive.position_m, axis=1).mean())
    assert found >= 29
    assert np.mean(lost) < 1.05 * np.mean(known)


def test_a_frame_that_contradicts_is_left_out_by_both_estimates():
    drive = simulate_drive(np.random.default_rng(7), 20)
    estimates = list(drive.estimates)
    estimates[8] = shifted(estimates[8], np.array([120.0, -90.0]))
    modes = [(e,) for e in estimates]
    found = explained(modes, drive.steps)
    assert found.mode.tolist() == [0] * 8 + [-1] + [0] * 11
    assert not found.best.leg.any()
    online = filter_positions(modes, [Moves.of(drive.steps)], 1).position_m
    assert np.linalg.norm(online - drive.position_m, axis=1).max() < 15.0


def test_a_wrong_first_frame_does_not_hold_the_filter():
    drive = simulate_drive(np.random.default_rng(8), 12)
    modes = [(e,) for e in drive.estimates]
    modes[0] = (shifted(drive.estimates[0], np.array([300.0, 400.0])),)
    online = filter_positions(modes, [Moves.of(drive.steps)], 1).position_m
    assert np.linalg.norm(online[4:] - drive.position_m[4:], axis=1).max() < 15.0
    assert explained(modes, drive.steps).mode[0] == -1


def test_three_refused_frames_are_bridged_with_growing_errors():
    drive = simulate_drive(np.random.default_rng(9), 12)
    modes = [() if k in (5, 6, 7) else (e,) for k, e in enumerate(drive.estimates)]
    found = explained(modes, drive.steps)
    assert found.mode.tolist() == [-1 if k in (5, 6, 7) else 0 for k in range(12)]
    online = OnlineTrack(1)
    traces = []
    for of in modes:
        online.add(of, [Moves.of(drive.steps)])
        traces.append(np.trace(online.filter.covariance_m2))
    assert traces[4] < traces[5] < traces[6] < traces[7] > traces[8]
    smoothed = np.trace(found.smoothed.covariance_m2, axis1=1, axis2=2)
    assert smoothed[6] > max(smoothed[4], smoothed[8])
    error = found.smoothed.position_m - drive.position_m
    assert 0.2 < mean_nees(error, found.smoothed.covariance_m2) < 6.0


def test_the_sequence_chooses_the_mode_of_an_ambiguous_frame():
    drive = simulate_drive(np.random.default_rng(10), 10)
    modes = [(e,) for e in drive.estimates]
    wrong, right = shifted(drive.estimates[4], np.array([200.0, 0.0])), drive.estimates[4]
    modes[4] = (replace(wrong, weight=0.7), replace(right, weight=0.3))
    modes[6] = (replace(shifted(wrong, np.array([0.0, 500.0])), weight=0.6), replace(wrong, weight=0.4))  # neither
    found = explained(modes, drive.steps)
    assert found.mode[4] == 1
    assert found.mode[6] == -1


def test_without_odometry_only_the_shared_errors_connect_the_frames():
    drive = simulate_drive(np.random.default_rng(11), 8)
    alone = smooth([drive.estimates[3]], Steps.unknown(1))
    modes = [(e,) for e in drive.estimates]
    found = explained(modes, Steps.unknown(8))
    assert found.mode.tolist() == [0] * 8
    assert not found.best.leg.any()
    assert np.trace(found.smoothed.covariance_m2[3]) < np.trace(alone.covariance_m2[0])
    assert found.smoothed.shared_covariance[0, 0] < alone.shared_covariance[0, 0]
    assert np.linalg.norm(found.smoothed.position_m - drive.position_m, axis=1).max() < 25.0


def test_a_track_needs_one_frame_with_a_position():
    with pytest.raises(ValueError, match="no frame has a single position"):
        explained([(), ()], Steps.unknown(2))
