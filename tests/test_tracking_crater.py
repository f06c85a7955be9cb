"""A crater of which nothing is known: its steepness by one image, its depth and width by a drive."""

from __future__ import annotations

import json
from contextlib import suppress
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
import pytest

import startrack
from startrack.applications.tracking import (
    ObservedFrame,
    Odometry,
    TrackErrors,
    estimate_track,
    track_page,
    track_record,
)
from startrack.applications.tracking.frame_estimate import estimate_frame, shown_part
from startrack.applications.tracking.observed_frame import decode_frame, encode_frame
from startrack.camera import load_camera, save_camera
from startrack.cli.main import main
from startrack.core import ODOMETRY_SIGMA
from startrack.core.types import BadInput, Evidence, NotLocated
from startrack.frames import Site
from startrack.localization import ExactPosterior, SharedErrors, settle_steepness
from startrack.terrain import Cylinder, ForwardingTerrain

SITE = Site("moon", np.radians(-89.66), np.radians(129.78))
TIME = datetime(2030, 6, 1, tzinfo=UTC)
DEPTH_M, DIAMETER_M = 1000.0, 4000.0
GROUND = Cylinder(site=SITE, diameter_m=DIAMETER_M, depth_m=DEPTH_M, camera_height_m=1.5)
FRAMES, STEP_M = 12, 120.0
ODOMETRY_SIGMA_M = float(np.hypot(ODOMETRY_SIGMA * STEP_M, 0.05))


def stated(depth_1: float = 0.0, diameter_1: float = 0.0, **changes) -> Cylinder:
    """The file's crater: its depth and width are that much larger than the true ones, with sigmas of 30 and 25 %."""
    depth, diameter = DEPTH_M * (1.0 + depth_1), DIAMETER_M * (1.0 + diameter_1)
    return replace(
        GROUND, **{"depth_m": depth, "depth_sigma_m": 0.3 * depth, "diameter_m": diameter,
                   "diameter_sigma_m": 0.25 * diameter, "search_radius_m": diameter / 2, **changes}
    )  # fmt: skip


def rays_at(place_m, rng, *, ground=GROUND, about_rad=0.02, rays=500, snr=3.0) -> Evidence:
    """Rays up to `about_rad` from the skyline of a position, with the noise of photometry."""
    azimuth = rng.uniform(0.0, 2 * np.pi, rays)
    horizon = ground.horizon_rad(np.asarray(place_m)[None], azimuth)
    elevation = horizon + rng.uniform(-about_rad, about_rad, rays)
    light = snr * (elevation > horizon) + rng.normal(size=rays)
    return Evidence(azimuth_rad=azimuth, elevation_rad=elevation, llr=np.clip(snr * light - snr**2 / 2, -9.0, 9.0))


def drive(seed: int, terrain: Cylinder, frames: int = FRAMES):
    """Frames and odometry of a straight drive, and its true positions (n, 2)."""
    rng = np.random.default_rng([8, seed])
    heading = rng.uniform(0.0, 2 * np.pi)
    position = 700.0 * rng.uniform(-1, 1, 2) + STEP_M * (np.arange(frames) - frames / 2)[:, None] * [
        np.sin(heading), np.cos(heading)
    ]  # fmt: skip
    ground = terrain.with_steepness(1.02 * DEPTH_M / DIAMETER_M * terrain.diameter_m / terrain.depth_m)
    errors, scale, observed = TrackErrors.of(ground, None), terrain.diameter_m / DIAMETER_M, []
    for k, place in enumerate(position):
        rows = rays_at(place, rng)
        one = estimate_frame(rows, ground, errors, scale * (place + 3.0 * rng.normal(size=2)), 25.0 * np.eye(2))
        observed.append(ObservedFrame(f"{k}", TIME + timedelta(hours=k), np.eye(3), (one,), rows))
    too_long_1 = ODOMETRY_SIGMA * rng.normal()  # of all moves; images do not show it
    moves = (1.0 + too_long_1) * np.diff(position, axis=0) + ODOMETRY_SIGMA_M * rng.normal(size=(frames - 1, 2))
    poses = np.pad(np.vstack([np.zeros(2), np.cumsum(moves, axis=0)]), ((0, 0), (0, 1)))
    times = np.array([frame.time_utc.timestamp() for frame in observed])
    odometry = Odometry(time_s=times, position_m=poses, quat_xyzw=np.tile([0.0, 0.0, 0.0, 1.0], (frames, 1)))
    return observed, odometry, position


def track_of(seed: int, terrain: Cylinder):
    frames, odometry, position = drive(seed, terrain)
    return estimate_track(frames, terrain, TrackErrors.of(terrain, None), odometry=odometry), position


def test_a_steeper_crater_keeps_what_is_known_of_its_depth():
    known = stated(depth_1=0.2)
    steep = known.with_steepness(0.8)
    at, azimuth = np.array([[300.0, -500.0]]), np.linspace(0.0, 6.0, 7)
    np.testing.assert_allclose(np.tan(steep.horizon_rad(at, azimuth)), 0.8 * np.tan(known.horizon_rad(at, azimuth)))
    assert (
        known.errors.unknown_steepness_1 == pytest.approx(np.hypot(0.3, 0.25))
        and steep.errors.unknown_steepness_1 == 0.0
    )
    depth = next(one for one in steep.errors.shape if one.name == "depth_1")
    assert steep.depth_m * (1.0 + depth.mean) == pytest.approx(known.depth_m)
    assert steep.depth_m * depth.sigma == pytest.approx(known.depth_sigma_m)
    assert steep.with_steepness(1.0).depth_m == pytest.approx(known.depth_m)
    assert ForwardingTerrain(known).with_steepness(0.8).whole == steep
    assert GROUND.errors.unknown_steepness_1 == 0.0 and GROUND.with_steepness(1.0) is GROUND
    with pytest.raises(BadInput, match="half of it"):
        stated(depth_sigma_m=0.5 * DEPTH_M)


@pytest.mark.parametrize("sizes", [(-0.3, 0.2), (0.35, -0.25)])
def test_one_image_shows_the_steepness_and_the_position_over_the_width(sizes):
    known, place = stated(*sizes), np.array([700.0, -900.0])
    rows = rays_at(place, np.random.default_rng(3), about_rad=0.3, rays=4000)
    found = settle_steepness(rows, known)
    assert found.depth_m / found.diameter_m == pytest.approx(DEPTH_M / DIAMETER_M, rel=0.01)
    fix, exact = ExactPosterior()(rows, known), ExactPosterior()(rows, GROUND)
    scaled = fix.compared_at_m * DIAMETER_M / known.diameter_m
    assert np.linalg.norm(scaled - exact.position_enu_m[:2]) < exact.radius95_m
    off = fix.position_enu_m[:2] - place
    assert off @ np.linalg.solve(fix.covariance_m2, off) < 9.2
    assert fix.radius95_m > 0.15 * np.linalg.norm(place)  # the width is not known


def test_rays_that_fit_craters_of_several_shapes_are_refused():
    few = rays_at(np.array([700.0, -900.0]), np.random.default_rng(4), about_rad=0.5, rays=12, snr=1.0)
    with pytest.raises(NotLocated, match="more than one shape"):
        settle_steepness(few, stated())


def test_a_known_depth_with_an_unknown_width_is_heeded():
    known = stated(diameter_1=0.2, depth_sigma_m=0.0)
    rows = rays_at(np.array([700.0, -900.0]), np.random.default_rng(5), about_rad=0.3, rays=4000)
    fix = ExactPosterior()(rows, known)
    assert np.linalg.norm(fix.position_enu_m[:2] - [700.0, -900.0]) < 3.0 * fix.radius95_m < 150.0


def test_a_drive_shows_depth_and_width():
    known = stated(-0.25, 0.2)
    track, position = track_of(0, known)
    assert [frame.status for frame in track.frames] == ["used"] * FRAMES
    for size, true, before in ((track.depth, DEPTH_M, known.depth_m), (track.width, DIAMETER_M, known.diameter_m)):
        assert abs(size.size_m - true) < 3.5 * size.sigma_m
        assert 0.9 * ODOMETRY_SIGMA < size.sigma_m / true < 1.4 * ODOMETRY_SIGMA
        assert before * (1.0 + size.error_1) == pytest.approx(size.size_m)
    assert track.terrain.rim.radius_m == pytest.approx(track.width.size_m / 2)
    off = track.smoothed.position_enu_m[:, :2] - position
    assert np.linalg.norm(off, axis=1).max() < 2.0 * track.smoothed.radius95_m.max() < 120.0
    np.testing.assert_allclose(track.filtered.position_enu_m[-1], track.smoothed.position_enu_m[-1], atol=0.05)
    assert track.filtered.radius95_m[0] > 3.0 * track.smoothed.radius95_m[0]
    record = track_record(track)
    assert record["depth"]["depth_m"] == track.depth.size_m and record["width"]["sigma_m"] == track.width.sigma_m
    page = track_page(track, title="drive")
    assert f"width of the crater: {track.width.size_m:.1f}" in page


def test_a_file_may_be_surer_of_the_size_than_the_odometry():
    known = stated(0.005, -0.005, depth_sigma_m=0.01 * DEPTH_M, diameter_sigma_m=0.01 * DIAMETER_M)
    frames, odometry, _ = drive(5, known)
    too_long = replace(odometry, position_m=1.04 * odometry.position_m)
    track = estimate_track(frames, known, TrackErrors.of(known, None), odometry=too_long)
    assert not track.odometry_fault and track.width.sigma_1 < 0.01
    assert abs(track.width.size_m / DIAMETER_M - 1.0) < 0.015


@pytest.mark.parametrize("sizes", [(-0.58, -0.3), (0.8, 0.5)])
def test_sizes_far_from_those_stated_are_by_true_odometry(sizes):
    """By other explanations the odometry is wrong, and the crater as the file states."""
    track, position = track_of(6, stated(*sizes))
    assert not track.odometry_fault and abs(track.width.size_m - DIAMETER_M) < 3.5 * track.width.sigma_m
    off = track.smoothed.position_enu_m[:, :2] - position
    assert np.einsum("ni,nij,nj->n", off, np.linalg.inv(track.smoothed.covariance_m2), off).mean() < 9.2


@pytest.mark.slow
def test_depth_width_and_positions_are_as_wrong_as_stated():
    z, nees = [], []
    for seed in range(20):
        sizes = 0.2 * np.random.default_rng([9, seed]).normal(size=2)
        track, position = track_of(seed, stated(*sizes))
        z.append(
            [
                (track.depth.size_m - DEPTH_M) / track.depth.sigma_m,
                (track.width.size_m - DIAMETER_M) / track.width.sigma_m,
            ]
        )
        off = track.smoothed.position_enu_m[:, :2] - position
        nees.append(np.einsum("ni,nij,nj->n", off, np.linalg.inv(track.smoothed.covariance_m2), off).mean())
    assert (
        0.5 < np.square(z).mean() < 1.8
    )  # 20 of them, the two of a drive nearly the same: one standard deviation is 0.3
    assert 1.0 < np.mean(nees) < 3.3


@pytest.mark.slow
def test_a_drive_from_pixels_shows_depth_and_width(tmp_path, capsys):
    camera = load_camera("fisheye-2048")
    small = replace(camera, name="small", size_px=(1024, 1024), focal_px=(326.0, 326.0), centre_px=(511.5, 511.5))
    save_camera(small, tmp_path / "small.toml")
    (tmp_path / "path.csv").write_text("east_m,north_m\n-4000,1000\n-2500,2000\n")
    out, wide = tmp_path / "frames", tmp_path / "unknown.toml"
    render = [
        "--path",
        str(tmp_path / "path.csv"),
        "--speed",
        "0.05",
        "--every",
        "6000",
        "--seed",
        "5",
        "-q",
        "-D",
        str(out),
    ]
    assert main(["render", *render, "-c", str(tmp_path / "small.toml")]) == 0
    text = (Path(startrack.__file__).parents[1] / "terrain" / "shackleton-thesis.toml").read_text()
    for old, new in (("diameter_m = 20000.0", "diameter_m = 24000.0\ndiameter_sigma_m = 6000.0"),
                     ("depth_m = 2000.0", "depth_m = 1600.0\ndepth_sigma_m = 500.0"), ("exact = true", ""),
                     ("radius_m = 10000.0", "radius_m = 12000.0")):  # fmt: skip
        text = text.replace(old, new)
    wide.write_text(text)
    track = ["track", str(out), "--odometry", str(out / "odometry.tum"), "-t", str(wide), "-D", str(tmp_path / "track")]
    assert main(track) == 0
    record = json.loads((tmp_path / "track" / "track.json").read_text())
    assert record["counts"]["used"] == record["counts"]["frames"] == 7
    for size, key, true in ((record["depth"], "depth_m", 2000.0), (record["width"], "diameter_m", 20_000.0)):
        assert abs(size[key] - true) < 3.5 * size["sigma_m"] < 0.08 * true
    last = record["frames"][-1]
    true_m = json.loads(sorted(out.glob("*.truth.json"))[-1].read_text())["position_enu_m"]
    assert np.hypot(last["east_m"] - true_m[0], last["north_m"] - true_m[1]) < last["radius999_m"] < 300.0
    before = capsys.readouterr().out
    assert (
        main(["track", "--follow", str(out), "--until-idle", "0.3", "--no-plots", *track[2:-1], str(tmp_path / "live")])
        == 0
    )
    assert json.loads((tmp_path / "live" / "track.json").read_text())["depth"] == record["depth"]
    live = capsys.readouterr().out
    assert "no position" not in before + live


def test_odometry_of_the_opposite_sign_is_left_out():
    frames, odometry, _ = drive(4, stated())
    wrong = replace(odometry, position_m=-odometry.position_m)
    track = estimate_track(frames, stated(), TrackErrors.of(stated(), None), odometry=wrong)
    assert track.odometry_fault in {"the opposite sign", "the opposite order in time"}  # of a straight drive the same
    assert track.width.sigma_1 > 0.15


def test_a_camera_at_rest_knows_the_size_as_stated():
    """One position shows depth over width; errors are counted from a steepness that is 2 % off."""
    known, rng = stated(-0.3, 0.2), np.random.default_rng(11)
    ground = known.with_steepness(1.02 * DEPTH_M / DIAMETER_M * known.diameter_m / known.depth_m)
    errors, place = TrackErrors.of(ground, None), np.array([700.0, -900.0])
    frames = []
    for k in range(3):
        rows = rays_at(place, rng)
        at = known.diameter_m / DIAMETER_M * (place + 3.0 * rng.normal(size=2))
        one = estimate_frame(rows, ground, errors, at, 25.0 * np.eye(2))
        seen = ObservedFrame(f"{k}", TIME + timedelta(hours=k), np.eye(3), (one,), rows)
        frames.append(replace(seen, steepness_1=ground.errors.steepness_1))
    track = estimate_track(frames, known, TrackErrors.of(known, None), at_rest=True)
    assert track.depth.size_m / track.width.size_m == pytest.approx(DEPTH_M / DIAMETER_M, rel=0.01)
    assert abs(np.log(track.width.size_m / DIAMETER_M)) < 3.5 * track.width.sigma_m / track.width.size_m


def test_without_odometry_the_size_stays_as_stated():
    frames, _, _ = drive(1, stated(), frames=3)
    track = estimate_track(frames, stated(), TrackErrors.of(stated(), None))
    assert track.width.sigma_1 == pytest.approx(0.25 * 0.3 / np.hypot(0.3, 0.25), rel=0.05)  # with the depth over it


def test_a_frame_is_placed_in_the_crater_of_the_errors():
    terrain = stated()
    (frame, _), _, _ = drive(2, terrain, frames=2)
    errors, listed = TrackErrors.of(terrain, None), SharedErrors.of(terrain, None)
    before = np.array([700.0, -500.0, 0.4, -0.6])
    true = before + np.array([4.0, -3.0, 0.02, 0.02])
    one = replace(frame.modes[0], mean=frame.modes[0].response @ true)  # without noise
    at, to = (listed.true_positions(x[None, :2], x[None, 2:] * errors.sigma)[0] for x in (before, true))
    shared = np.log1p(errors.sigma * true[2:]) / errors.sigma  # of the logarithms
    np.testing.assert_allclose(errors.values(shared), errors.sigma * true[2:])
    assert np.linalg.norm(at - before[:2]) > 50.0
    placed = errors.place(one, at, shared - 0.02)
    np.testing.assert_allclose(placed.mean, placed.response @ np.append(to, shared), atol=0.05)
    np.testing.assert_allclose(placed.noise[2:, 2:], one.noise[2:, 2:])
    assert errors.place(replace(one, mean=one.mean)) is not one and TrackErrors.of(GROUND, None).place(one) is one


def test_what_a_posterior_does_not_show_makes_no_observation():
    rng = np.random.default_rng(9)
    half = rng.normal(size=(5, 5))
    information = half @ half.T
    information[4] = information[:, 4] = 0.0  # the evidence does not depend on the last error
    prior = np.diag([0.0, 0.0, 1.0, 1.0, 1.0])
    shown, response = shown_part(np.linalg.inv(information + prior))
    np.testing.assert_allclose(response, np.linalg.inv(information + prior) @ information, atol=1e-9)
    np.testing.assert_allclose(shown @ shown, shown, atol=1e-9)
    np.testing.assert_allclose(shown @ response, response, atol=1e-9)
    assert np.linalg.matrix_rank(shown, tol=1e-6) == 4
    information[4, 4] = -0.02  # as sampled points err
    assert np.linalg.matrix_rank(shown_part(np.linalg.inv(information + prior))[0], tol=1e-6) == 4


def test_frames_keep_the_steepness_that_they_show():
    frame = replace(drive(3, stated(), frames=2)[0][0], steepness_1=1.234)
    assert decode_frame(encode_frame(frame)).steepness_1 == 1.234


@pytest.mark.parametrize("factor", [100.0, 3.28, 0.01, 0.001])
def test_odometry_in_other_units_makes_no_other_crater(factor):
    frames, odometry, _ = drive(4, stated(), frames=5)
    wrong = replace(odometry, position_m=factor * odometry.position_m)
    track = None
    with suppress(BadInput):
        track = estimate_track(frames, stated(), TrackErrors.of(stated(), None), odometry=wrong)
    if track is not None:  # the odometry is left out
        assert track.odometry_fault
        assert track.width.sigma_1 > 0.15
