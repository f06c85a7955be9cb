"""Facts that no file states: frames that contradict the others in a shared error, and gross errors of a track."""

from __future__ import annotations

from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
import pytest

import startrack
from startrack.applications.tracking import ObservedFrame, TrackErrors, estimate_track
from startrack.applications.tracking.track_errors import DEPTH
from startrack.camera import load_camera, save_camera
from startrack.cli.main import main
from startrack.estimation.observations import FrameEstimate
from startrack.terrain import load_terrain

START = datetime(2030, 6, 1, tzinfo=UTC)
SIGMA_1 = 0.0005  # of the depth by one frame


@pytest.fixture(scope="module")
def silent():
    return replace(load_terrain("shackleton-thesis"), depth_sigma_m=None)


def frame_of(number: int, depth_1: float, errors: TrackErrors) -> ObservedFrame:
    """A frame whose depth is known to SIGMA_1."""
    prior_1 = float(errors.sigma[errors.names.index(DEPTH)])
    share = 1.0 - (SIGMA_1 / prior_1) ** 2
    covariance = np.diag([1.0, 1.0, (SIGMA_1 / prior_1) ** 2])
    mean = np.array([0.0, 0.0, share * depth_1 / prior_1])
    estimate = FrameEstimate(
        mean, covariance, np.diag([1.0, 1.0, share]), share * covariance, np.zeros(0, dtype=np.int64), np.zeros((3, 0))
    )
    return ObservedFrame(f"frame-{number}", START + timedelta(hours=number), None, (estimate,), None)


def left_out(depths_1, terrain) -> list[int]:
    errors = TrackErrors.of(terrain, None).with_gross(["depth_sigma_m"])
    frames = [frame_of(k, depth, errors) for k, depth in enumerate(depths_1)]
    track = estimate_track(frames, terrain, errors)
    assert {one.reason for one in track.frames} <= {"", "inconsistent_evidence"}
    return [k for k, one in enumerate(track.frames) if one.status == "left_out"]


def test_frames_of_another_depth_are_left_out(silent):
    noise = SIGMA_1 * np.random.default_rng(1).normal(size=8)
    assert left_out(0.004 + noise, silent) == []
    other = 0.004 + noise
    other[[2, 5]] = -0.004
    assert left_out(other, silent) == [2, 5]
    with pytest.raises(startrack.BadInput, match="neither is clearly right") as refusal:
        left_out([0.004, -0.004], silent)
    assert refusal.value.reason == "inconsistent_evidence"


def test_the_library_refuses_what_the_command_refuses(tmp_path):
    from startrack.exposure import read_exposure

    camera = load_camera("fisheye-2048")
    small = replace(camera, name="small", size_px=(1024, 1024), focal_px=(326.0, 326.0), centre_px=(511.5, 511.5))
    save_camera(small, tmp_path / "small.toml")
    (tmp_path / "path.csv").write_text("east_m,north_m\n-4000,3000\n-3950,3000\n")
    code = main([
        "render", "--path", str(tmp_path / "path.csv"), "--speed", "0.05", "--every", "1000", "-n", "2", "--seed", "1",
        "-q", "-c", str(tmp_path / "small.toml"), "-D", str(tmp_path / "frames"),
    ])  # fmt: skip
    assert code == 0
    text = (Path(startrack.__file__).parents[1] / "terrain" / "shackleton-thesis.toml").read_text()
    (tmp_path / "wrong.toml").write_text(text.replace("depth_m = 2000.0", "depth_m = 2010.0"))
    images = sorted((tmp_path / "frames").glob("*.png"))
    dark = [
        replace(one, pixels_adu=np.full_like(one.pixels_adu, 100.0))
        for one in (read_exposure(image) for image in images[:2])
    ]
    with pytest.raises(startrack.BadInput, match="takes an image once"):
        startrack.track([dark[0], dark[0]])
    with pytest.raises(startrack.BadInput, match="of the camera"):
        startrack.track([dark[0], replace(dark[1], camera="fisheye-2048")])
    with pytest.raises(startrack.BadInput, match="on the terrain"):
        startrack.track([dark[0], replace(dark[1], terrain=str(tmp_path / "wrong.toml"))])
    with pytest.raises(startrack.BadInput) as refusal:
        startrack.track(dark)
    assert refusal.value.reason == "no_stars"
    with pytest.raises(startrack.BadInput, match="no image"):
        startrack.track([])
