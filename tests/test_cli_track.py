"""`startrack track`: a drive of small rendered images, at once, live and killed, at rest; files, schema, refusals."""

import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest
from astropy.table import Table
from drive_helpers import render_small_drive
from earth_helpers import jacksboro
from jsonschema import Draft202012Validator

import startrack
from startrack.applications.tracking import TRACK, read_odometry
from startrack.applications.tracking.observed_frame import decode_frame, encode_frame
from startrack.cli.main import main
from startrack.estimation.trajectory import radius_holding
from startrack.frames import R_from_quat_xyzw
from startrack.localization import posterior
from startrack.terrain import write_map

FRAMES = 5
KILLS, KILL_AFTER_S, KILL_SEED = 3, (1.5, 6.0), 8
FILES = ("track.tum", "track.filtered.tum", "track.ecsv", "track.geojson", "track.json")


def run(*arguments):
    """Exit code of the command."""
    return main(["track", *map(str, arguments)])


@pytest.fixture(scope="module")
def drive(tmp_path_factory):
    """A folder with images 25 m apart, their odometry, and the truth."""
    folder = tmp_path_factory.mktemp("drive")
    render_small_drive(folder, "-6900,4700\n-6850,4700\n-6850,4750")
    return folder


@pytest.fixture(scope="module")
def tracked(drive):
    """The folder of the drive's track."""
    assert (
        run(drive / "frames", "--odometry", drive / "frames" / "odometry.tum", "-D", drive / "out", "--report", "-q")
        == 0
    )
    return drive / "out"


def truth_m(drive):
    return read_odometry(drive / "frames" / "truth.tum").position_m


def test_the_track_holds_the_truth_and_is_better_than_single_images(drive, tracked):
    record = json.loads((tracked / "track.json").read_text())
    Draft202012Validator(TRACK).validate(record)
    none = dict.fromkeys(("left_out", "refused", "slips", "legs", "outside_odometry"), 0)
    assert record["counts"] == {"frames": FRAMES, "used": FRAMES, **none} and record["legs"] == []
    for prefix in ("", "filtered_"):
        found = np.array([[one[f"{prefix}east_m"], one[f"{prefix}north_m"]] for one in record["frames"]])
        error = found - truth_m(drive)[:, :2]
        covariance = [
            [[one[f"{prefix}covariance_{text}_m2"] for text in row] for row in (("ee", "en"), ("en", "nn"))]
            for one in record["frames"]
        ]
        nees = np.einsum("ni,nij,nj->n", error, np.linalg.inv(covariance), error)
        assert nees.max() < 16.0
    radius = np.array([[one["radius95_m"], one["filtered_radius95_m"]] for one in record["frames"]])
    assert (radius[:-1, 0] < radius[:-1, 1]).all()  # later images help
    assert radius[-1, 0] == pytest.approx(radius[-1, 1], rel=0.02)
    assert radius[-1, 1] < 0.8 * radius[0, 1]


def test_a_track_of_one_image_states_what_locate_states(drive, tmp_path):
    image = min((drive / "frames").glob("*.png"))
    alone = startrack.locate(image).result
    for flags in ([], ["--at-rest"]):
        assert run(image, "-D", tmp_path / "out", "-q", *flags) == 0
        found = json.loads((tmp_path / "out" / "track.json").read_text())["frames"][0]
        for prefix in ("", "filtered_"):
            position = [found[f"{prefix}{axis}_m"] for axis in ("east", "north", "up")]
            np.testing.assert_allclose(position, alone.fix.position_enu_m, rtol=0, atol=1e-9)
            covariance = [found[f"{prefix}covariance_{text}_m2"] for text in ("ee", "en", "en", "nn")]
            np.testing.assert_allclose(covariance, alone.fix.covariance_m2.ravel(), rtol=0, atol=1e-9)
            circles = [found[f"{prefix}radius95_m"], found[f"{prefix}radius999_m"]]
            np.testing.assert_allclose(circles, [alone.fix.radius95_m, alone.fix.radius999_m], rtol=0, atol=1e-9)
        R_body_enu = alone.camera.R_body_cam @ alone.R_cam_enu
        quat = [found[f"q{axis}_body_enu"] for axis in "xyzw"]
        np.testing.assert_allclose(R_from_quat_xyzw(quat), R_body_enu, rtol=0, atol=1e-9)


def test_a_search_that_proved_nothing_is_stated(drive, tracked, tmp_path, capsys, monkeypatch):
    assert {one["search"] for one in json.loads((tracked / "track.json").read_text())["frames"]} == {"proven"}
    search = posterior.search_boxes
    monkeypatch.setattr(posterior, "search_boxes", lambda rows, terrain, nats, budget: search(rows, terrain, nats, 0.0))
    for _ in ("located", "kept"):
        assert run(min((drive / "frames").glob("*.png")), "-D", tmp_path / "out", "--no-plots") == 0
        line, _ = capsys.readouterr().out.splitlines()
        assert re.search(r"used  E .* \(95 %\)  search: beam$", line)
        record = json.loads((tmp_path / "out" / "track.json").read_text())
        Draft202012Validator(TRACK).validate(record)
        assert [one["search"] for one in record["frames"]] == ["beam"]
        assert Table.read(tmp_path / "out" / "track.ecsv")["search"].tolist() == ["beam"]


def test_tum_text_is_that_of_the_poses(drive, tracked):
    true = read_odometry(drive / "frames" / "truth.tum")
    for name in ("track.tum", "track.filtered.tum"):
        found = read_odometry(tracked / name)
        np.testing.assert_allclose(found.time_s, true.time_s, atol=1e-6)
        assert np.abs(found.position_m - true.position_m).max() < 10.0
        for a, b in zip(found.quat_xyzw, true.quat_xyzw, strict=True):
            assert np.abs(R_from_quat_xyzw(a) - R_from_quat_xyzw(b)).max() < 1e-3


def test_tables_are_read_by_astropy_and_the_map_has_every_frame(tracked):
    record = json.loads((tracked / "track.json").read_text())
    table = Table.read(tracked / "track.ecsv")
    assert table["east_m"].unit == "m"
    np.testing.assert_allclose(table["east_m"], [one["east_m"] for one in record["frames"]], atol=1e-4)
    features = json.loads((tracked / "track.geojson").read_text())["features"]
    assert [one["geometry"]["type"] for one in features] == ["LineString", *["Point"] * FRAMES]
    assert features[0]["geometry"]["coordinates"][0] == features[1]["geometry"]["coordinates"]


@pytest.mark.slow
def test_images_followed_and_killed_give_the_same_files(drive, tracked, tmp_path):
    live, out = drive / "live", tmp_path / "out"  # beside the camera file that the images name
    live.mkdir()
    command = [
        sys.executable, "-m", "startrack", "track", "--follow", str(live), "-D", str(out), "--until-idle", "3",
        "--odometry", str(drive / "frames" / "odometry.tum"), "--no-plots",
    ]  # fmt: skip
    images, rng = sorted((drive / "frames").glob("*.png")), np.random.default_rng(KILL_SEED)
    for part in np.array_split(np.arange(FRAMES), KILLS):
        killed = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        for k in part:
            shutil.copy(images[k].with_suffix(".json"), live)
            shutil.copy(images[k], live)
        time.sleep(rng.uniform(*KILL_AFTER_S))
        os.kill(killed.pid, signal.SIGKILL)
        killed.wait()
    second = subprocess.run(command, capture_output=True, text=True, check=True)
    assert sum("used" in line for line in second.stdout.splitlines()[:-1]) == FRAMES
    for name in FILES:
        assert (out / name).read_bytes() == (tracked / name).read_bytes(), name


@pytest.mark.slow
def test_at_rest_the_images_share_one_position(drive, tmp_path):
    code = main([
        "render", "--every", "40000", "-n", "3", "--seed", "5", "-q", "-c", str(drive / "small.toml"), "-D",
        str(tmp_path / "rest"),
    ])  # fmt: skip
    assert code == 0
    assert run(tmp_path / "rest", "--at-rest", "-D", tmp_path / "out", "-q") == 0
    frames = json.loads((tmp_path / "out" / "track.json").read_text())["frames"]
    assert len({(one["east_m"], one["north_m"]) for one in frames}) == 1
    true = read_odometry(tmp_path / "rest" / "truth.tum").position_m[0]
    assert np.hypot(frames[0]["east_m"] - true[0], frames[0]["north_m"] - true[1]) < 2 * frames[0]["radius95_m"]
    assert frames[-1]["filtered_radius95_m"] < frames[0]["filtered_radius95_m"]


@pytest.mark.slow
def test_refused_images_are_bridged_by_the_odometry(drive, tmp_path):
    from startrack.exposure import read_exposure

    frames = tmp_path / "frames"
    shutil.copytree(drive / "frames", frames)
    shutil.copy(drive / "small.toml", tmp_path)
    dark = sorted(frames.glob("*.png"))[2]
    import cv2

    cv2.imwrite(str(dark), np.full(read_exposure(dark).pixels_adu.shape, 100, np.uint16))
    assert run(frames, "--odometry", frames / "odometry.tum", "-D", tmp_path / "out", "-q") == 3
    record = json.loads((tmp_path / "out" / "track.json").read_text())
    assert [one["status"] for one in record["frames"]] == ["used", "used", "refused", "used", "used"]
    bridged = record["frames"][2]
    assert bridged["reason"] == "no_stars"
    miss = np.hypot(bridged["east_m"] - truth_m(drive)[2, 0], bridged["north_m"] - truth_m(drive)[2, 1])
    assert miss < 2 * bridged["radius95_m"]
    assert bridged["filtered_radius95_m"] > record["frames"][1]["filtered_radius95_m"]


@pytest.mark.slow
def test_the_library_gives_the_track_of_the_command(drive, tracked):
    images = sorted((drive / "frames").glob("*.png"))
    track = startrack.track(images, odometry=str(drive / "frames" / "odometry.tum"))
    record = json.loads((tracked / "track.json").read_text())
    expected = [[one["east_m"], one["north_m"], one["up_m"]] for one in record["frames"]]
    np.testing.assert_array_equal(track.smoothed.position_enu_m, expected)


@pytest.mark.parametrize(
    ("arguments", "code", "message"),
    [
        (["--at-rest", "--odometry", "x.tum"], 2, "give one of them"),
        (["--time", "2030-01-01T00:00:00"], 2, "have their times in sidecars"),
        (["--odometry", "none.tum"], 4, "none.tum"),
        (["-t", "shackleton-none"], 4, "bad_terrain"),
        (["--until-idle", "3"], 2, "is for --follow"),
        (["--max-speed", "0"], 2, "is not above 0"),
    ],
)
def test_wrong_use_is_refused_in_a_line(drive, tmp_path, capsys, arguments, code, message):
    try:
        found = run(drive / "frames", "-D", tmp_path / "out", *arguments)
    except SystemExit as cause:
        found = cause.code
    text = capsys.readouterr().err
    assert found == code, text
    assert message in text
    assert "Traceback" not in text


def test_wrong_odometry_is_left_out_or_refused(drive, tracked, tmp_path, capsys):
    lines = [line for line in (drive / "frames" / "odometry.tum").read_text().splitlines() if line[0] != "#"]
    poses = np.array([line.split() for line in lines], dtype=float)
    poses[:, 1:3] *= -1.0
    reversed_signs, out = tmp_path / "odometry.tum", tmp_path / "out"
    np.savetxt(reversed_signs, poses, fmt="%.9f")
    shutil.copytree(tracked, out)
    assert run(drive / "frames", "--odometry", reversed_signs, "-D", out, "-q") == 3
    assert "the odometry has the opposite sign" in capsys.readouterr().err
    record = json.loads((out / "track.json").read_text())
    Draft202012Validator(TRACK).validate(record)
    assert record["odometry"]["fault"] == "the opposite sign"
    for one, true in zip(record["frames"], truth_m(drive), strict=True):
        assert np.hypot(one["east_m"] - true[0], one["north_m"] - true[1]) < 2.0 * one["radius999_m"]
    assert run(drive / "frames", "--odometry", reversed_signs, "--max-speed", "0.04", "-D", out, "-q") == 4
    err = capsys.readouterr().err
    assert "faster than 0.04 m/s" in err and f"the files {out}/track.* are of an earlier run" in err


def test_an_image_outside_the_odometry_is_used_by_itself_and_named(drive, tracked, tmp_path, capsys):
    images, out = tmp_path / "frames", tmp_path / "out"
    shutil.copytree(drive / "frames", images)
    shutil.copytree(tracked, out)
    shutil.copy(drive / "small.toml", tmp_path)
    poses = (images / "odometry.tum").read_text().splitlines(keepends=True)
    (images / "odometry.tum").write_text("".join(poses[:-1]))  # ends before the last image
    (images / "unread.png").write_bytes(b"no image")
    flags = ("-D", out, "--odometry-time-sigma", "5", "--no-plots")
    assert run(images, "--odometry", images / "odometry.tum", *flags) == 4
    text, err = capsys.readouterr()
    last = max(path.stem for path in images.glob("*.png") if path.stem != "unread")
    assert re.search(rf"^{last}\S*  used  E .* outside the odometry$", text, re.MULTILINE)
    assert "unread.png  refused  " in err and "earlier run" not in err
    closing = f"{FRAMES + 1} images: {FRAMES} used, 0 left out, 1 refused (1 could not be read); 1 outside the odometry"
    assert text.splitlines()[-1].startswith(f"{closing}; files in ")
    record = json.loads((out / "track.json").read_text())
    Draft202012Validator(TRACK).validate(record)
    assert record["counts"]["frames"] == record["counts"]["used"] == FRAMES
    assert record["odometry"]["time_sigma_s"] == 5.0
    live = ("--follow", images, "--until-idle", "0.5", "--odometry", images / "odometry.tum")
    assert run(*live, *flags) == 4
    shown = capsys.readouterr().out
    assert "outside the odometry" in shown and closing in shown


def test_a_height_map_in_the_folder_is_left_out(tmp_path, capsys):
    write_map(tmp_path / "valley.tif", jacksboro())
    assert run(tmp_path, "-D", tmp_path / "out") == 4
    shown = capsys.readouterr().err
    assert "valley.tif: left out, a height map (GeoTIFF)\n" in shown and "no images in this folder" in shown


def test_a_folder_without_images_is_refused(tmp_path, capsys):
    (tmp_path / "empty").mkdir()
    assert run(tmp_path / "empty", "-D", tmp_path / "out") == 4
    assert "no images in this folder" in capsys.readouterr().err


def test_a_stored_frame_is_the_frame(drive, tracked):
    for file in (tracked / ".frames").glob("*.npz"):
        frame = decode_frame(file.read_bytes())
        again = decode_frame(encode_frame(frame))
        assert (frame.name, frame.time_utc, frame.search) == (again.name, again.time_utc, again.search)
        np.testing.assert_array_equal(frame.modes[0].mean, again.modes[0].mean)
        np.testing.assert_array_equal(frame.evidence.llr, again.evidence.llr)
        assert frame.time_utc.tzinfo is not None and frame.time_utc > datetime(2020, 1, 1, tzinfo=UTC)
    with pytest.raises((ValueError, KeyError)):
        decode_frame(Path(__file__).read_bytes())


def test_a_circle_holds_its_part_of_a_gaussian():
    rng = np.random.default_rng(4)
    covariance = np.array([np.eye(2), [[9.0, 2.0], [2.0, 1.0]], [[1e4, 0.0], [0.0, 1e-4]]])
    radius = radius_holding(covariance, 0.95)
    assert radius[0] == pytest.approx(np.sqrt(-2 * np.log(0.05)))
    for one, r in zip(covariance, radius, strict=True):
        draws = rng.multivariate_normal(np.zeros(2), one, 200_000)
        assert np.mean(np.hypot(*draws.T) < r) == pytest.approx(0.95, abs=0.002)
    assert radius[2] == pytest.approx(100 * 1.95996, rel=1e-3)
    assert radius_holding(np.full((1, 2, 2), np.inf), 0.95)[0] == np.inf


def dark(image, out):
    """Write a dark frame of the size of an `image` to `out`, with its sidecar."""
    import cv2

    cv2.imwrite(str(out), np.full(cv2.imread(str(image), -1).shape[:2], 100, np.uint16))
    shutil.copy(image.with_suffix(".json"), out.with_suffix(".json"))


def test_a_track_without_a_position_names_why(drive, tmp_path, capsys):
    (tmp_path / "frames").mkdir()
    shutil.copy(drive / "small.toml", tmp_path)
    image = min((drive / "frames").glob("*.png"))
    dark(image, tmp_path / "frames" / image.name)
    assert run(tmp_path / "frames", "-D", tmp_path / "out") == 3
    assert "no_stars" in capsys.readouterr().err
    assert not (tmp_path / "out" / "track.json").exists()
    assert run("--follow", tmp_path / "frames", "-D", tmp_path / "live", "--until-idle", "1") == 3
    assert "  refused  no_stars: " in capsys.readouterr().out


def test_an_image_counts_once(drive, tmp_path, capsys):
    image = min((drive / "frames").glob("*.png"))
    assert run(image, image, "-D", tmp_path / "out") == 4
    assert "a track takes an image once" in capsys.readouterr().err
    assert json.loads((tmp_path / "out" / "track.json").read_text())["counts"]["frames"] == 1


@pytest.mark.slow
def test_images_of_another_camera_are_refused(drive, tmp_path, capsys):
    frames = tmp_path / "frames"
    shutil.copytree(drive / "frames", frames)
    shutil.copy(drive / "small.toml", tmp_path / "small.toml")
    shutil.copy(drive / "small.toml", tmp_path / "other.toml")
    sidecar = max(path for path in frames.glob("*.json") if ".truth" not in path.name)
    sidecar.write_text(json.dumps({**json.loads(sidecar.read_text()), "camera": "../other.toml"}))
    assert run(frames, "-D", tmp_path / "out", "-q") == 4
    assert "bad_calibration" in capsys.readouterr().err
    assert json.loads((tmp_path / "out" / "track.json").read_text())["counts"]["frames"] == FRAMES - 1


@pytest.mark.slow
def test_followed_images_wait_for_their_odometry(drive, tmp_path):
    live, growing = tmp_path / "live", tmp_path / "odometry.tum"
    live.mkdir()
    shutil.copy(drive / "small.toml", tmp_path)
    images = sorted((drive / "frames").glob("*.png"))[:3]
    lines = (drive / "frames" / "odometry.tum").read_text().splitlines(keepends=True)
    poses = [line for line in lines if not line.startswith("#")]
    growing.write_text("".join(poses[:2]))
    for image in images:
        shutil.copy(image.with_suffix(".json"), live)
        shutil.copy(image, live)
    command = [
        sys.executable, "-m", "startrack", "track", "--follow", str(live), "-D", str(tmp_path / "out"), "--until-idle",
        "60", "--odometry", str(growing), "--no-plots",
    ]  # fmt: skip
    running = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    try:
        assert [running.stdout.readline().split("  ")[1] for _ in range(2)] == ["used", "used"]
        growing.write_text("".join(poses[:3])[:-30])  # a line that is being written
        time.sleep(0.3)
        growing.write_text("".join(poses[:3]))
        assert running.stdout.readline().startswith(images[2].stem)
        running.terminate()
        rest, _ = running.communicate(timeout=60)
    finally:
        running.kill()
    assert running.returncode == 0
    assert "3 used" in rest


@pytest.mark.slow
def test_followed_odometry_that_ends_within_a_line_waits(drive, tracked, tmp_path):
    lines = (drive / "frames" / "odometry.tum").read_text().splitlines(keepends=True)
    for torn in (lines[-1][:-1], lines[-1][:-3], "1900000000 1.0 2.0", "1900000000 1.0 2.0\n", "190"):
        odometry = tmp_path / "odometry.tum"
        odometry.write_text("".join(lines[:-1]) + torn)
        shutil.copytree(tracked, tmp_path / "out")
        arguments = ("--odometry", odometry, "--no-plots", "--until-idle", "0.5", "-q")
        assert run("--follow", drive / "frames", "-D", tmp_path / "out", *arguments) == 0
        counts = json.loads((tmp_path / "out" / "track.json").read_text())["counts"]
        whole = torn.startswith(lines[-1][:-3])  # a last digit that is missing does not show
        assert (counts["used"], counts["outside_odometry"]) == (FRAMES, 0 if whole else 1), torn
        shutil.rmtree(tmp_path / "out")


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_following_that_is_stopped_before_any_image_has_the_code_of_a_stop(tmp_path, capsys, monkeypatch, number):
    from startrack.applications import tracking

    def stopped(*arguments, **more):
        os.kill(os.getpid(), number)
        yield None

    monkeypatch.setattr(tracking, "follow_images", stopped)
    (tmp_path / "live").mkdir()
    assert run("--follow", tmp_path / "live", "-D", tmp_path / "out") == 5
    assert "before the first image" in capsys.readouterr().err
    assert not (tmp_path / "out" / "track.json").exists()
