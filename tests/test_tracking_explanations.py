"""Images from elsewhere and odometry that is wrong as a whole never carry a track with small circles."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import multivariate_normal
from synthetic_track import CRATER
from tracking_helpers import SHARED, attitudes, observed, odometry_of

from startrack.applications.tracking import ObservedFrame, Odometry, Track, estimate_track
from startrack.applications.tracking.explanations import (
    BEGINS,
    CONTINUES,
    FOREIGN_SIGMA_M,
    LEG_END_PROBABILITY,
    LEG_PROBABILITY,
    SLIP_PROBABILITY,
    SLIPS,
    STRAIGHT,
    Explanations,
)
from startrack.applications.tracking.files import tum_text
from startrack.applications.tracking.odometry import LEG_SIGMA_1, Moves
from startrack.core.errors import BadInput
from startrack.core.types import Array
from startrack.estimation.observations import FrameEstimate, OdometryErrors, Steps

FRAMES, STEP_M, SIGMA_M = 7, 80.0, 5.0
DRAWS = 12
STRAIGHT_1 = 1.0 - SLIP_PROBABILITY - LEG_PROBABILITY


def estimate_at(place: Array, bias: float, rng: np.random.Generator, sigma_m: float = SIGMA_M) -> FrameEstimate:
    """The observation of a position; the evidence knows the shared error to half of its prior."""
    covariance = np.diag([sigma_m**2, sigma_m**2, 0.2])
    response = np.diag([1.0, 1.0, 0.8])
    noise = np.diag([sigma_m**2, sigma_m**2, 0.8 * 0.2])
    mean = response @ np.append(place, bias) + rng.multivariate_normal(np.zeros(3), noise)
    return FrameEstimate(mean, covariance, response, noise, np.zeros(0, dtype=np.int64), np.zeros((3, 0)))


def drive(rng: np.random.Generator) -> tuple[Array, list[ObservedFrame], Odometry]:
    """True positions, frames and odometry of a drive in a crater."""
    heading = rng.uniform(0.0, 2.0 * np.pi) + np.cumsum(rng.normal(0.0, 0.4, FRAMES))
    moves = STEP_M * np.stack([np.sin(heading), np.cos(heading)], axis=1)
    position, bias = rng.uniform(-4000.0, 4000.0, 2) + np.cumsum(moves, axis=0), rng.normal()
    measured = position + np.cumsum(1.6 * rng.normal(size=(FRAMES, 2)), axis=0)
    R = attitudes(rng, FRAMES)
    return position, observed([estimate_at(p, bias, rng) for p in position], R), odometry_of(measured, R)


def worst_in_circles(track: Track, position_m: Array) -> float:
    """Largest error of a pose in its 99.9 % circles."""
    off = np.linalg.norm(track.smoothed.position_enu_m[:, :2] - position_m, axis=1)
    return float(np.nanmax(off / track.smoothed.radius999_m, initial=0.0))


def foreign(frames: list[ObservedFrame], which: Array, shift_m: Array, rng: np.random.Generator) -> list[ObservedFrame]:
    """Frames `which` are from elsewhere, each shifted by its row of `shift_m`, with attitudes of their own."""
    found = list(frames)
    for k, by in zip(which.tolist(), shift_m, strict=True):
        estimate = replace(frames[k].modes[0], mean=frames[k].modes[0].mean + np.append(by, 0.0))
        found[k] = replace(frames[k], modes=(estimate,), R_body_enu=attitudes(rng, 1)[0])
    return found


@pytest.mark.parametrize("count", [0, 1, 2, 3])
def test_images_from_elsewhere_are_left_out(count):
    for seed in range(DRAWS):
        rng = np.random.default_rng([1, count, seed])
        position, frames, odometry = drive(rng)
        which = np.sort(rng.choice(FRAMES, count, replace=False))
        mixed = foreign(frames, which, rng.uniform(-4000.0, 4000.0, (count, 2)), rng)
        track = estimate_track(mixed, CRATER, SHARED, odometry=odometry)
        assert [frame.status for frame in track.frames] == ["left_out" if k in which else "used" for k in range(FRAMES)]
        assert not track.odometry_fault
        assert worst_in_circles(track, position) < 2.0
        # Files of poses have the images of the track alone.
        assert len(tum_text(track, track.smoothed).splitlines()) == FRAMES - count


def test_two_groups_that_each_agree_are_named_and_refused():
    for seed in range(DRAWS):
        rng = np.random.default_rng([2, seed])
        _, frames, odometry = drive(rng)
        which, shift = np.sort(rng.choice(FRAMES, 3, replace=False)), rng.uniform(1000.0, 4000.0, 2)
        mixed = foreign(frames, which, np.tile(shift, (3, 1)), rng)
        for k in which:
            mixed[k] = replace(mixed[k], R_body_enu=frames[k].R_body_enu)
        with pytest.raises(BadInput, match="neither is clearly right") as refusal:
            estimate_track(mixed, CRATER, SHARED, odometry=odometry)
        assert refusal.value.reason == "inconsistent_evidence"
        assert ", ".join(f"frame-{k}" for k in which) in str(refusal.value)


def test_two_images_that_contradict_each_other_are_refused():
    rng = np.random.default_rng(3)
    _, frames, odometry = drive(rng)
    mixed = foreign(frames[:2], np.array([1]), np.array([[900.0, -2000.0]]), rng)
    with pytest.raises(BadInput, match=r"\(frame-[01].*\(frame-[01]"):
        estimate_track(mixed, CRATER, SHARED, odometry=odometry)


def changed(one: Odometry, position_m: Array, quat_xyzw: Array | None = None) -> Odometry:
    return replace(one, position_m=position_m, quat_xyzw=one.quat_xyzw if quat_xyzw is None else quat_xyzw)


def inverse_poses(one: Odometry) -> Odometry:
    back = Rotation.from_quat(np.array(one.quat_xyzw)).inv()
    return changed(one, -back.apply(np.array(one.position_m)), back.as_quat())


FAULTS = {
    "sign": (lambda one: changed(one, -one.position_m), "the opposite sign"),
    "order": (lambda one: changed(one, one.position_m[::-1], one.quat_xyzw[::-1]), "the opposite order in time"),
    "x and y": (lambda one: changed(one, one.position_m[:, [1, 0, 2]]), "axes in the order y x z"),
    "w first": (
        lambda one: changed(one, one.position_m, np.roll(one.quat_xyzw, 1, axis=1)), "quaternions with w first",
    ),
    "quaternions": (
        lambda one: changed(one, one.position_m, one.quat_xyzw * [-1, -1, -1, 1]),
        "quaternions of the inverse rotations",
    ),
    "inverse": (inverse_poses, "inverse poses"),
    "km": (lambda one: changed(one, 1e-3 * one.position_m), "lengths 0.001 times the true ones"),
    "feet": (lambda one: changed(one, one.position_m / 0.3048), "lengths 3.281 times the true ones"),
    "x to -y, y to -x": (
        lambda one: changed(one, -one.position_m[:, [1, 0, 2]]), "other axes, quaternions or lengths",
    ),
    "zero": (lambda one: changed(one, 0.0 * one.position_m), "an unknown fault"),
}  # fmt: skip


@pytest.mark.parametrize("name", FAULTS)
def test_odometry_that_is_wrong_as_a_whole_is_left_out_and_named(name):
    change, fault = FAULTS[name]
    named = 0
    for seed in range(DRAWS):
        position, frames, odometry = drive(np.random.default_rng([4, seed]))
        track = estimate_track(frames, CRATER, SHARED, odometry=change(odometry))
        assert worst_in_circles(track, position) < 2.0
        assert track.odometry_fault
        assert all(frame.status == "used" for frame in track.frames)
        named += track.odometry_fault == fault
    assert named > 0.8 * DRAWS


@pytest.mark.parametrize(("scale", "turn_deg"), [(1.05, 0.0), (0.9, 0.0), (1.0, 5.0), (1.2, 0.0)])
def test_moves_share_errors_of_scale_and_heading(scale, turn_deg):
    """Errors of 5 to 20 % where 2 % are stated: they are estimated, and circles hold."""
    worst, off_m = [], []
    for seed in range(DRAWS):
        position, frames, odometry = drive(np.random.default_rng([31, seed]))
        turned = Rotation.from_quat(odometry.quat_xyzw) * Rotation.from_rotvec([0.0, 0.0, np.radians(turn_deg)])
        odometry = replace(changed(odometry, scale * odometry.position_m), quat_xyzw=turned.as_quat())
        track = estimate_track(frames, CRATER, SHARED, odometry=odometry)
        assert not track.odometry_fault
        worst.append(worst_in_circles(track, position))
        off_m.append(np.linalg.norm(track.smoothed.position_enu_m[:, :2] - position, axis=1).mean())
    assert max(worst) < 1.5
    assert np.count_nonzero(np.array(worst) > 1.0) <= 1
    assert np.mean(off_m) < 0.9 * SIGMA_M  # single images: 1.25 sigma


def test_odometry_faster_than_any_rover_is_refused():
    _, frames, odometry = drive(np.random.default_rng(5))
    with pytest.raises(BadInput, match=r"faster than 10 m/s.*--max-speed") as refusal:
        estimate_track(frames, CRATER, SHARED, odometry=changed(odometry, 1e3 * odometry.position_m))
    assert refusal.value.reason == "bad_odometry"


def test_the_stated_speed_decides_what_is_impossible():
    _, frames, odometry = drive(np.random.default_rng(5))
    assert estimate_track(frames, CRATER, SHARED, odometry=odometry).frames[0].status == "used"
    slow = OdometryErrors(max_speed_m_s=0.01)
    with pytest.raises(BadInput, match=r"faster than 0\.01 m/s"):
        estimate_track(frames, CRATER, SHARED, odometry=odometry, odometry_errors=slow)


def test_the_likelihood_of_an_explanation_is_that_of_the_joint_normal():
    """Against SciPy's density of all observations at once: no slip, one of the second move, or a leg of both."""
    rng = np.random.default_rng(6)
    estimates = [estimate_at(np.array([80.0 * k, 3.0]), 0.5, rng) for k in range(3)]
    steps = Steps(np.array([[80.0, 0.0], [80.0, 0.0]]), np.array([1.6, 1.6]))
    kinds = {
        (STRAIGHT, STRAIGHT): [STRAIGHT_1, STRAIGHT_1],
        (STRAIGHT, SLIPS): [STRAIGHT_1, SLIP_PROBABILITY],
        (BEGINS, CONTINUES): [LEG_PROBABILITY, 1.0 - LEG_END_PROBABILITY],
        (BEGINS, SLIPS): [LEG_PROBABILITY, LEG_END_PROBABILITY * SLIP_PROBABILITY],
    }
    for (first, second), probabilities in kinds.items():
        # Unknowns in order: first position, two errors of moves, shared error.
        slip_m2 = 400.0 * (second == SLIPS)
        prior = np.diag([*[FOREIGN_SIGMA_M**2] * 2, *[1.6**2] * 2, *[1.6**2 + slip_m2] * 2, 1.0])
        # The error of scale moves along a leg to the east, that of heading across it.
        by_leg = (LEG_SIGMA_1 * 80.0) ** 2 * np.eye(2)
        if first == BEGINS:
            prior[2:4, 2:4] += by_leg
        if second == CONTINUES:
            prior[4:6, 4:6] += by_leg
            prior[2:4, 4:6] = prior[4:6, 2:4] = by_leg
        design = np.zeros((9, 7))
        for k in range(3):
            design[3 * k : 3 * k + 2, : 2 * (k + 1)] = np.tile(np.eye(2), k + 1)
            design[3 * k + 2, 6] = 0.8
        mean = np.concatenate([[80.0 * k, 0.0, 0.0] for k in range(3)])
        covariance = design @ prior @ design.T
        for k, one in enumerate(estimates):
            covariance[3 * k : 3 * k + 3, 3 * k : 3 * k + 3] += one.noise
        log_density = multivariate_normal(mean, covariance).logpdf(np.concatenate([one.mean for one in estimates]))
        log_density += np.log(probabilities).sum()
        found = Explanations(1)
        for one in estimates:
            found.add((one,), [Moves.of(steps)])
        branches = found._branches
        same = (branches.history[:, :, 0] == 0).all(axis=1) & (branches.history[:, 1:, 1] == (first, second)).all(
            axis=1
        )
        assert branches.log_likelihood[same] == pytest.approx(log_density, abs=1e-6)
