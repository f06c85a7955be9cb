"""`startrack render --every`: series at rest and drives, their files, and refusals. A small camera keeps it quick."""

import json

import numpy as np
import pytest
from test_cli_render import CAMERA, digests, render

from startrack.applications.tracking import read_odometry
from startrack.camera import load_camera
from startrack.core.errors import BadInput
from startrack.exposure import read_exposure
from startrack.frames import R_from_quat_xyzw

PATH = "east_m,north_m\n1000,-2000\n1050,-2000\n1050,-1950\n"
DRIVE = ["--path", "path.csv", "--speed", "0.05", "--every", "500", "--hot-pixels", "0"]


@pytest.fixture
def folder(tmp_path, monkeypatch):
    (tmp_path / "small.toml").write_text(CAMERA)
    (tmp_path / "path.csv").write_text(PATH)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def truths(out):
    return [json.loads(path.read_text()) for path in sorted(out.glob("*.truth.json"))]


def test_a_drive_has_frames_truth_and_odometry_that_agree(folder):
    render(*DRIVE, "-D", "out", "--clock-offset", "90", "--time-sigma", "60")
    images = sorted((folder / "out").glob("*.png"))
    assert len(images) == 5
    exposures = [read_exposure(path) for path in images]
    stated_s = np.array([exposure.time_utc.timestamp() for exposure in exposures])
    np.testing.assert_allclose(np.diff(stated_s), 500, atol=1e-6)

    true, odometry = (read_odometry(f"out/{name}.tum") for name in ("truth", "odometry"))
    for trajectory in (true, odometry):  # one clock for images and odometry, also a wrong one
        np.testing.assert_array_equal(trajectory.time_s, stated_s)
    east_north = [[1000, -2000], [1025, -2000], [1050, -2000], [1050, -1975], [1050, -1950]]
    np.testing.assert_allclose(true.position_m[:, :2], east_north)
    camera = load_camera("small.toml")
    for fact, position_m, quat in zip(truths(folder / "out"), true.position_m, true.quat_xyzw, strict=True):
        np.testing.assert_allclose(fact["position_enu_m"], position_m)
        R_body_enu = camera.R_body_cam @ np.array(fact["R_cam_enu"])
        np.testing.assert_allclose(R_from_quat_xyzw(quat).T, R_body_enu, atol=1e-8)
    assert [round(fact["heading_deg"]) % 360 for fact in truths(folder / "out")] == [90, 90, 0, 0, 0]

    increments = odometry.increments_body_m(stated_s)
    error_m = increments - true.increments_body_m(stated_s)
    assert 0 < np.linalg.norm(error_m, axis=1).max() < 4 * np.sqrt(2) * np.hypot(0.02 * 25, 0.05)
    assert np.linalg.norm(odometry.position_m[0]) == 0
    np.testing.assert_allclose(increments[:, 0], 25, atol=3)  # nose forward


@pytest.mark.slow
def test_the_errors_of_the_odometry_are_those_of_the_flags_and_the_seed(folder):
    for out, flags in {
        "exact": ["--odometry-sigma", "0", "--odometry-floor", "0"],
        "a": [], "b": [], "other": ["--seed", "1"], "short": ["-n", "2"],
    }.items():  # fmt: skip
        render(*DRIVE, "-D", out, *flags)
    assert digests(folder / "a") == digests(folder / "b")
    exact, true = read_odometry("exact/odometry.tum"), read_odometry("exact/truth.tum")
    np.testing.assert_allclose(exact.increments_body_m(exact.time_s), true.increments_body_m(true.time_s), atol=1e-6)
    assert (folder / "exact/truth.tum").read_bytes() == (folder / "a/truth.tum").read_bytes()
    assert (folder / "other/odometry.tum").read_bytes() != (folder / "a/odometry.tum").read_bytes()
    assert "(0.02 length)^2 + (0.05 m)^2" in (folder / "a/odometry.tum").read_text()
    short, whole = digests(folder / "short"), digests(folder / "a")
    assert len(short) == 2 * 4 + 2
    assert {name for name in short if short[name] != whole[name]} == {"truth.tum", "odometry.tum"}
    np.testing.assert_array_equal(
        read_odometry("short/odometry.tum").position_m, read_odometry("a/odometry.tum").position_m[:2]
    )


def test_a_series_at_rest_has_one_pose_and_no_odometry(folder):
    render("--every", "50400", "-n", "3", "--time", "2030-01-01T00:00:00Z", "-D", "rest")
    facts = truths(folder / "rest")
    assert [fact["time_utc"][:16] for fact in facts] == ["2030-01-01T00:00", "2030-01-01T14:00", "2030-01-02T04:00"]
    assert len({(*fact["position_enu_m"], fact["heading_deg"], fact["pitch_deg"]) for fact in facts}) == 1
    assert len({tuple(fact["quat_xyzw_cam_icrs"]) for fact in facts}) == 3  # the sky turns
    true = read_odometry("rest/truth.tum")
    np.testing.assert_allclose(true.increments_body_m(true.time_s), 0, atol=1e-12)
    assert not (folder / "rest/odometry.tum").exists()


def test_the_first_exposure_at_rest_is_that_of_a_series_without_steps_of_time(folder):
    render("--every", "3600", "-D", "rest")
    render("-D", "plain")
    assert digests(folder / "plain").items() <= digests(folder / "rest").items()


@pytest.mark.parametrize(
    ("path", "flags", "reason", "cause"),
    [
        (PATH + "9000,9000\n", [], "bad_odometry", "1 of 4 waypoints are outside the search area"),
        ("east_m,north_m\n1,2\n", [], "bad_odometry", "path.csv: 1 waypoint"),
        (PATH, ["--every", "5000"], "bad_odometry", "the path of 100 m takes 2000 s .* gives 1"),
        (PATH, ["--path", "none.csv"], "bad_odometry", "none.csv: cannot be read .no such file"),
    ],
)
def test_a_path_that_cannot_be_used_is_refused_before_anything_is_written(folder, path, flags, reason, cause):
    (folder / "path.csv").write_text(path)
    with pytest.raises(BadInput, match=cause) as refusal:
        render(*DRIVE, *flags, "-D", "out")
    assert refusal.value.reason == reason
    assert not (folder / "out").exists()


def test_an_existing_trajectory_is_kept(folder):
    (folder / "out").mkdir()
    (folder / "out/odometry.tum").write_text("mine")
    with pytest.raises(BadInput, match=r"odometry\.tum: exists"):
        render(*DRIVE, "-D", "out")
    assert [path.name for path in (folder / "out").iterdir()] == ["odometry.tum"]


@pytest.mark.parametrize(
    "flags",
    [
        ["--path", "path.csv", "--every", "10"],
        ["--path", "path.csv", "--speed", "1"],
        ["--speed", "1"],
        ["--every", "10", "--odometry-floor", "1"],
        ["--every", "0"],
        ["--every", "10", "-o", "x.png"],
        [*DRIVE, "--speed", "0"],
        [*DRIVE, "--speed", "-1"],
        [*DRIVE, "--odometry-sigma", "-1"],
        [*DRIVE, "--heading", "10"],
        [*DRIVE, "--east", "10"],
        [*DRIVE, "-n", "6"],
    ],
)
def test_flags_that_do_not_go_together_exit_with_2(folder, flags):
    with pytest.raises(SystemExit) as leaving:
        render(*flags)
    assert leaving.value.code == 2
    assert sorted(path.name for path in folder.iterdir()) == ["path.csv", "small.toml"]
