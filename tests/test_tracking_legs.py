"""Legs in which the odometry slips, its lag, and images that it does not cover."""

from __future__ import annotations

import importlib
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from jsonschema import Draft202012Validator
from scipy.spatial.transform import Rotation
from synthetic_track import CRATER
from test_tracking_explanations import estimate_at
from tracking_helpers import SHARED, attitudes, observed, odometry_of

from startrack.applications.tracking import TRACK, ObservedFrame, Odometry, estimate_track, track_page, track_record
from startrack.applications.tracking.observed_frame import ImageFix
from startrack.applications.tracking.odometry import odometry_moves
from startrack.applications.tracking.track import slipped_legs
from startrack.core.types import Array
from startrack.estimation.observations import USUAL_ODOMETRY
from startrack.estimation.trajectory import mixed_normal, radius_holding
from startrack.localization import camera_at

FRAMES, STEP_M, SIGMA_M, DRAWS = 10, 80.0, 5.0, 4


def drive(rng: np.random.Generator, leg: slice = slice(0), factor: float = 1.0, turned_deg: float = 0.0):
    """True positions, frames with the fix of each image, and odometry whose moves of a `leg` slip."""
    heading = rng.uniform(0.0, 2.0 * np.pi) + np.cumsum(rng.normal(0.0, 0.2, FRAMES))
    position = rng.uniform(-3000.0, 3000.0, 2) + np.cumsum(
        STEP_M * np.stack([np.sin(heading), np.cos(heading)], axis=1), axis=0
    )
    R = attitudes(rng, FRAMES)
    frames = [with_fix(one) for one in observed([estimate_at(p, 0.3, rng, SIGMA_M) for p in position], R)]
    moves = np.diff(position, axis=0) + 1.6 * rng.normal(size=(FRAMES - 1, 2))
    turn = Rotation.from_rotvec([0.0, 0.0, -np.radians(turned_deg)]).as_matrix()[:2, :2]  # to the right
    moves[leg] = factor * moves[leg] @ turn.T
    return position, frames, odometry_of(position[0] + np.cumsum(np.vstack([np.zeros(2), moves]), axis=0), R)


def with_fix(frame: ObservedFrame, sigma_m: float = SIGMA_M) -> ObservedFrame:
    """The frame with the fix of its image alone."""
    at, covariance = frame.modes[0].mean[:2], sigma_m**2 * np.eye(2)
    radius95, radius999 = (float(radius_holding(covariance[None], part)[0]) for part in (0.95, 0.999))
    return replace(
        frame, fixes=(ImageFix(np.asarray(camera_at(at, CRATER)), covariance, radius95, radius999, at, 1.0),)
    )


def in_circles(found, position_m: Array) -> Array:
    return np.linalg.norm(found.position_enu_m[:, :2] - position_m, axis=1) / found.radius999_m


@pytest.mark.parametrize(("factor", "turned_deg"), [(1.2, 0.0), (0.75, 0.0), (1.2, -12.0)])
def test_a_leg_that_slips_is_found_and_named(factor, turned_deg):
    named, worst = [], []
    for seed in range(DRAWS):
        rng = np.random.default_rng([1, seed])
        position, frames, odometry = drive(rng, slice(3, 7), factor, turned_deg)
        track = estimate_track(frames, CRATER, SHARED, odometry=odometry)
        assert not track.odometry_fault and all(frame.status == "used" for frame in track.frames)
        worst.append(in_circles(track.smoothed, position).max())
        longest = max(track.legs, key=lambda one: one.last - one.first)
        named.append([longest.first, longest.last, longest.factor_1, np.degrees(longest.heading_rad)])
        record = track_record(track)
        Draft202012Validator(TRACK).validate(record)
        assert record["counts"]["slips"] == sum(one["moves"] for one in record["legs"]) >= 3
        assert track.leg_texts[0] in track_page(track, title="drive")
    assert max(worst) < 1.2 and np.count_nonzero(np.array(worst) > 1.0) <= 1
    first, last, found, turned = np.median(named, axis=0)
    assert (first, last) == pytest.approx((3, 7), abs=0.6)
    assert found == pytest.approx(factor, abs=0.06) and turned == pytest.approx(turned_deg, abs=3.0)


def test_a_drive_without_slip_has_no_leg():
    for seed in range(DRAWS):
        position, frames, odometry = drive(np.random.default_rng([2, seed]))
        track = estimate_track(frames, CRATER, SHARED, odometry=odometry)
        assert track.legs == () and not track.slipped.any()
        assert in_circles(track.smoothed, position).max() < 1.0


@pytest.mark.slow
def test_drives_whose_images_are_located_have_no_pose_beyond_twice_its_circle(monkeypatch):
    """A few of the drives of benchmarks/slips.py, from simulated stars."""
    monkeypatch.setattr(sys, "path", [*sys.path, str(Path(__file__).parent.parent / "benchmarks")])
    slips = importlib.import_module("slips")
    beyond = []
    for number, draw in enumerate(slips.draws_of("shackleton-thesis", 4)):
        for name in ("none", "4 of 9 moves 20 % too long", "4 of 9 moves 20 % too long, 3 others turned by 3 degrees"):
            slipped = slips.with_slips(draw, slips.CLASSES[name], np.random.default_rng([1, number]))
            course = slipped.course
            track = estimate_track(slipped.frames, course.stated, course.shared, odometry=slipped.odometry)
            beyond.append(slips.score(track, slipped))
            for frame, at in zip(slipped.frames, track.smoothed.position_enu_m, strict=True):
                assert np.linalg.norm(at - frame.fixes[0].position_enu_m) <= frame.fixes[0].radius999_m + 1.0
    for kind in ("smoothed", "filtered"):
        circles = np.array([one[f"{kind} circles"] for one in beyond])
        assert circles.max() < 2.0 and np.count_nonzero(circles > 1.0) <= 1


def test_a_leg_states_the_similarity_of_its_moves():
    position = np.array([[0.0, 0.0], [10.0, 0.0], [10.0, 20.0], [0.0, 20.0]])
    right = Rotation.from_rotvec([0.0, 0.0, -0.1]).as_matrix()[:2, :2]
    move = 1.3 * np.diff(position, axis=0) @ right.T
    (leg,) = slipped_legs(np.array([0, 2, 2]), move, position)
    assert (leg.first, leg.last, leg.length_m) == (1, 3, pytest.approx(39.0))
    assert (leg.factor_1, leg.heading_rad) == (pytest.approx(1.3), pytest.approx(0.1))
    assert "1.30 times the track, 5.7 degrees to the right" in leg.text("abcd")
    (unknown,) = slipped_legs(np.array([0, 2, 2]), move, np.full((4, 2), np.nan))
    assert np.isnan(unknown.factor_1) and unknown.text("abcd") == "39.0 m of odometry slipped from b to d"


def test_a_mixture_has_the_moments_of_its_draws():
    rng = np.random.default_rng(4)
    means, share = rng.normal(0.0, 5.0, (3, 2)), np.array([0.5, 0.3, 0.2])
    covariances = np.array([np.diag(rng.uniform(1.0, 9.0, 2)) for _ in range(3)])
    counts = (400_000 * share).astype(int)
    draws = np.concatenate([rng.multivariate_normal(*of) for of in zip(means, covariances, counts, strict=True)])
    mean, covariance = mixed_normal(list(means), list(covariances), share)
    np.testing.assert_allclose(mean, draws.mean(axis=0), atol=0.05)
    np.testing.assert_allclose(covariance, np.cov(draws.T), rtol=0.02, atol=0.1)


def turning_odometry(frames: list[ObservedFrame], offset_s: float = 0.0) -> Odometry:
    """Of a body that speeds up and turns, with stamps that are `offset_s` late."""
    first = frames[0].time_utc.timestamp()
    time_s = first + np.arange(-600.0, 900.0 * FRAMES + 600.0, 30.0)
    u = (time_s - first) / 900.0
    heading = 0.05 * u**2
    return Odometry(
        time_s=time_s + offset_s,
        position_m=np.column_stack([60.0 * u + 4.0 * u**2, 20.0 * np.sin(u), np.zeros(len(u))]),
        quat_xyzw=Rotation.from_rotvec(np.column_stack([np.zeros((len(u), 2)), heading])).as_quat(),
    )


def test_a_lag_of_the_odometry_is_an_error_that_all_moves_share():
    _, frames, _ = drive(np.random.default_rng(5))
    errors = replace(USUAL_ODOMETRY, time_sigma_s=40.0)
    anchor = np.arange(1, FRAMES)
    true, late = (
        odometry_moves(frames, turning_odometry(frames, offset_s), errors)[0].steps(anchor) for offset_s in (0.0, 40.0)
    )
    by_one_sigma = true.by_shared_m[:, :, -1]
    assert np.abs(late.move_m - true.move_m).max() > 3.0
    np.testing.assert_allclose(true.move_m - late.move_m, by_one_sigma, atol=0.1)
    assert not odometry_moves(frames, turning_odometry(frames), USUAL_ODOMETRY)[0].freedom_m[..., -1].any()


def test_an_image_outside_the_odometry_is_used_by_itself():
    position, frames, odometry = drive(np.random.default_rng(6))
    inner = replace(odometry, **{name: getattr(odometry, name)[2:8] for name in ("time_s", "position_m", "quat_xyzw")})
    track = estimate_track(frames, CRATER, SHARED, odometry=inner)
    assert [frame.is_outside for frame in track.frames] == [k < 2 or k > 7 for k in range(FRAMES)]
    assert all(frame.status == "used" for frame in track.frames)
    record = track_record(track)
    assert record["counts"]["outside_odometry"] == 4 and record["frames"][0]["outside_odometry"] == 1
    radius = track.smoothed.radius95_m
    assert radius[[0, 1, 8, 9]].min() > 1.4 * radius[2:8].max()
    assert in_circles(track.smoothed, position).max() < 1.0
