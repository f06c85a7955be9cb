"""One depth of a crater along a track: a wrong one in its file is estimated, and frames of another one are refused."""

from __future__ import annotations

import re
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
import pytest
from tracking_helpers import mean_nees

import startrack
from startrack.camera import load_camera
from startrack.cli.main import main
from startrack.terrain import load_terrain
from startrack.tracking import ObservedFrame, SharedErrors, TrackSession, read_odometry
from startrack.tracking.depth import drop_other_depths, free_depth
from startrack.tracking.frame_estimate import FrameEstimate
from startrack.tracking.frame_store import FrameStore

START = datetime(2030, 6, 1, tzinfo=UTC)
DEPTH_ERROR_1 = 0.005  # of the file: 10 m of 2 km
SIGMA_1 = 0.0005  # of the depth by one frame


@pytest.fixture(scope="module")
def shared():
    return SharedErrors.of(free_depth(load_terrain("shackleton-thesis")), None)


def frame_of(number: int, depth_1: float, shared: SharedErrors) -> ObservedFrame:
    """A frame whose depth is known to SIGMA_1."""
    prior_1 = float(shared.sigma[0])
    share = 1.0 - (SIGMA_1 / prior_1) ** 2
    covariance = np.diag([1.0, 1.0, (SIGMA_1 / prior_1) ** 2])
    mean = np.array([0.0, 0.0, share * depth_1 / prior_1])
    estimate = FrameEstimate(
        mean, covariance, np.diag([1.0, 1.0, share]), share * covariance, np.zeros(0, dtype=np.int64), np.zeros((3, 0))
    )
    return ObservedFrame(f"frame-{number}", START + timedelta(hours=number), None, (estimate,), None)


def refused(depths_1, shared):
    frames = drop_other_depths([frame_of(k, depth, shared) for k, depth in enumerate(depths_1)], shared)
    return [k for k, frame in enumerate(frames) if not frame.modes], frames


def test_frames_of_another_depth_are_refused_with_both_depths(shared):
    noise = SIGMA_1 * np.random.default_rng(1).normal(size=8)
    assert refused(0.004 + noise, shared)[0] == []
    other = 0.004 + noise
    other[[2, 5]] = -0.004
    which, frames = refused(other, shared)
    assert which == [2, 5]
    assert frames[5].reason == "inconsistent_evidence"
    assert re.search(r"-0\.40 % off .* the other frames \+0\.(39|4\d) %", frames[5].message), frames[5].message
    assert refused([0.004, -0.004], shared)[0] == [1]  # of two the later one


def test_depths_are_compared_only_where_the_depth_is_shared():
    exact = SharedErrors.of(load_terrain("shackleton-thesis"), None)
    frames = [frame_of(0, 0.1, SharedErrors(("steepness_1",), np.array([0.01]), np.zeros(3)))]
    assert drop_other_depths(frames, exact) is frames


def test_the_freed_depth_does_not_depend_on_the_image_that_showed_it():
    terrain = load_terrain("shackleton-thesis")
    assert free_depth(replace(terrain, depth_sigma_m=3.0)).shape_sigma == free_depth(terrain).shape_sigma
    with pytest.raises(TypeError, match="only a cylinder"):
        free_depth(load_terrain("shackleton"))


@pytest.fixture(scope="module")
def drive(tmp_path_factory) -> Path:
    """Images in the crater, a camera, and a terrain file whose depth is wrong."""
    from startrack.camera import save_camera

    folder, camera = tmp_path_factory.mktemp("deeper"), load_camera("fisheye-2048")
    small = replace(camera, name="small", size_px=(1024, 1024), focal_px=(326.0, 326.0), centre_px=(511.5, 511.5))
    save_camera(small, folder / "small.toml")
    (folder / "path.csv").write_text("east_m,north_m\n-4000,3000\n-3800,3000\n")
    code = main([
        "render", "--path", str(folder / "path.csv"), "--speed", "0.05", "--every", "1000", "-n", "4", "--seed", "1",
        "-q", "-c", str(folder / "small.toml"), "-D", str(folder / "frames"),
    ])  # fmt: skip
    assert code == 0
    text = (Path(startrack.__file__).parents[1] / "terrain" / "shackleton-thesis.toml").read_text()
    (folder / "wrong.toml").write_text(text.replace("depth_m = 2000.0", f"depth_m = {2000 * (1 + DEPTH_ERROR_1)}"))
    return folder


@pytest.mark.slow
def test_a_drive_in_a_crater_with_a_wrong_depth_estimates_one_depth(drive, tmp_path):
    images = sorted((drive / "frames").glob("*.png"))
    odometry = read_odometry(drive / "frames" / "odometry.tum")
    facts = {"camera": str(drive / "small.toml"), "terrain": str(drive / "wrong.toml")}
    tracks = []
    for _ in range(2):  # the second run reads the frames that the first one stored
        session = TrackSession(store=FrameStore(tmp_path), facts=facts)
        for image in images:
            session.add(image)
        tracks.append(session.estimate(odometry))
    first, again = tracks
    np.testing.assert_array_equal(first.smoothed.position_enu_m, again.smoothed.position_enu_m)
    off = first.smoothed.position_enu_m[:, :2] - read_odometry(drive / "frames" / "truth.tum").position_m[:, :2]
    assert np.linalg.norm(off, axis=1).max() < 8.0  # 30 m with the depth of the file
    assert mean_nees(off, first.smoothed.covariance_m2) < 9.0
    assert first.depth is not None
    assert first.depth.error_1 == pytest.approx(1 / (1 + DEPTH_ERROR_1) - 1, abs=0.0015)
    assert (again.depth.error_1, again.depth.sigma_1) == (first.depth.error_1, first.depth.sigma_1)
    assert all(frame.status == "used" for frame in first.frames)


def test_the_library_refuses_what_the_command_refuses(drive):
    from startrack.exposure import read_exposure

    images = sorted((drive / "frames").glob("*.png"))
    dark = [
        replace(one, pixels_adu=np.full_like(one.pixels_adu, 100.0))
        for one in (read_exposure(image) for image in images[:2])
    ]
    with pytest.raises(startrack.BadInput, match="takes an image once"):
        startrack.track([dark[0], dark[0]])
    with pytest.raises(startrack.BadInput, match="of the camera"):
        startrack.track([dark[0], replace(dark[1], camera="fisheye-2048")])
    with pytest.raises(startrack.BadInput, match="on the terrain"):
        startrack.track([dark[0], replace(dark[1], terrain=str(drive / "wrong.toml"))])
    with pytest.raises(startrack.BadInput) as refusal:
        startrack.track(dark)
    assert refusal.value.reason == "no_stars"
    with pytest.raises(startrack.BadInput, match="no image"):
        startrack.track([])
