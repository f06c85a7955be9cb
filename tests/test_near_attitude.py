"""A rough attitude: the names of lost in space, never a wrong answer, and the files that state one."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from test_identification import FISHEYE, NARROW, frame, make_detections, random_positions, sky

from startrack.camera import Camera
from startrack.catalog import load_catalog
from startrack.chain import NearAttitude, Settings, identify, load_camera_input, read_near_attitude
from startrack.cli.main import main
from startrack.core.types import Identification, NotIdentified
from startrack.exposure import read_exposure
from startrack.frames import R_enu_icrs, Site, angle_between_rad, parse_utc
from startrack.identification import Identifier
from startrack.identification.attitude_search import AttitudeSearch

SAMPLES = Path(__file__).parents[1] / "sample_images"
MOON = Site("moon", np.radians(-89.66), np.radians(129.78))


def turned(R: np.ndarray, off_deg: float, seed: int = 0) -> np.ndarray:
    """The attitude, wrong by an angle about a random axis."""
    axis = np.random.default_rng(seed).normal(size=3)
    return Rotation.from_rotvec(np.radians(off_deg) * axis / np.linalg.norm(axis)).as_matrix() @ R


def forbid_lost_in_space(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: Any) -> NoReturn:
        raise AssertionError("the rough attitude was not used")

    monkeypatch.setattr(AttitudeSearch, "hypotheses", fail)


def assert_same_names(found: Identification, expected: Identification) -> None:
    np.testing.assert_array_equal(found.detection, expected.detection)
    np.testing.assert_array_equal(found.star, expected.star)


OFF = [(FISHEYE, 0.0), (FISHEYE, 0.1), (FISHEYE, 1.0), (FISHEYE, 12.0), (NARROW, 0.0), (NARROW, 2.0)]


@pytest.mark.parametrize(("camera", "off_deg"), OFF)
def test_names_are_those_of_lost_in_space(camera: Camera, off_deg: float, monkeypatch: pytest.MonkeyPatch) -> None:
    frames = [frame(camera, seed, limit=5.0 if camera is FISHEYE else 9.0) for seed in range(6)]
    expected = [Identifier()(one.detections, camera, sky()) for one in frames]
    forbid_lost_in_space(monkeypatch)
    for seed, (one, lost) in enumerate(zip(frames, expected, strict=True)):
        found = Identifier()(one.detections, camera, sky(), turned(one.R_cam_icrs, off_deg, seed))
        assert_same_names(found, lost)
        assert found.false_alarm_probability < 1e-9


def test_a_wrong_attitude_is_not_believed() -> None:
    one = frame(FISHEYE, 3)
    lost = Identifier()(one.detections, FISHEYE, sky())
    for seed in range(10):
        assert_same_names(Identifier()(one.detections, FISHEYE, sky(), turned(one.R_cam_icrs, 60.0, seed)), lost)


@pytest.mark.parametrize("camera", [FISHEYE, NARROW])
def test_near_no_attitude_random_points_are_stars(camera: Camera, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(AttitudeSearch, "hypotheses", lambda *_: iter(()))
    rng = np.random.default_rng(5)
    for _ in range(100):
        n = int(rng.integers(6, 120))
        xy = random_positions(camera, n, rng)
        points = make_detections(xy, np.sort(rng.uniform(1, 6, len(xy))), 0.2)
        with pytest.raises(NotIdentified):
            Identifier()(points, camera, sky(), Rotation.random(random_state=rng).as_matrix())


def test_lights_brighter_than_the_stars_do_not_matter_at_the_attitude_itself(monkeypatch: pytest.MonkeyPatch) -> None:
    forbid_lost_in_space(monkeypatch)
    rng, one = np.random.default_rng(1), frame(FISHEYE, 4, false=0.0, brightest=60)
    lamps = random_positions(FISHEYE, 60, rng)
    v = np.concatenate([np.full(len(lamps), -3.0), sky().v_mag[one.star]])
    lists = make_detections(np.concatenate([lamps, one.detections.xy_px]), v, 0.2)
    found = Identifier()(lists, FISHEYE, sky(), turned(one.R_cam_icrs, 0.05))
    assert len(found) > 50
    np.testing.assert_array_equal(found.star, one.star[found.detection - len(lamps)])


@pytest.mark.parametrize("name", ["near-wall.png", "tilted.png", "lowell-2018-08-06.fits.bz2"])
def test_images_have_the_same_names(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    exposure, catalog = read_exposure(SAMPLES / name), load_catalog()
    camera = load_camera_input(exposure.camera)
    lost = identify(exposure, camera, catalog)
    forbid_lost_in_space(monkeypatch)
    for off_deg in (0.05, 5.0):
        near = NearAttitude.of(turned(lost.attitude.R_cam_icrs, off_deg))
        found = identify(exposure, camera, catalog, Settings(near_attitude=near))
        assert_same_names(found.identification, lost.identification)
        turn = found.attitude.R_cam_icrs @ lost.attitude.R_cam_icrs.T
        assert angle_between_rad(turn[0], [1.0, 0.0, 0.0]) < 1e-9


def test_an_attitude_turns_with_the_sky() -> None:
    then, later = parse_utc("2026-01-01T00:00:00Z"), parse_utc("2026-01-03T00:00:00Z")
    R = Rotation.random(random_state=1).as_matrix()
    near = NearAttitude.of(R, then)
    turned_R = near.R_cam_icrs_at(later, MOON)
    np.testing.assert_allclose(turned_R @ R_enu_icrs(MOON, later).T, R @ R_enu_icrs(MOON, then).T, atol=1e-12)
    for when, site in ((None, MOON), (later, None)):
        np.testing.assert_allclose(near.R_cam_icrs_at(when, site), R, atol=1e-12)


def test_a_result_is_a_rough_attitude(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    words = ["identify", str(SAMPLES / "near-wall.png"), "--no-plots", "--json", "-D"]
    assert main([*words, str(tmp_path / "first")]) == 0
    first = json.loads(capsys.readouterr().out)
    file = tmp_path / "first/near-wall.identification.json"
    assert read_near_attitude(file).quat_xyzw_cam_icrs == tuple(first["attitude"]["quat_xyzw_cam_icrs"])
    forbid_lost_in_space(monkeypatch)
    assert main([*words, str(tmp_path / "second"), "--near-attitude", str(file)]) == 0
    assert json.loads(capsys.readouterr().out)["matches"] == first["matches"]
    assert main(["track", words[1], "-D", str(tmp_path / "track"), "--near-attitude", str(file), "-q"]) == 0


@pytest.mark.parametrize(
    ("text", "cause"),
    [(None, "no such file"), ("{", "is no JSON file"), ("[1]", "holds no attitude"),
     ('{"status": "refused", "provenance": {"time_utc": null}}', "holds no attitude"),
     ('{"attitude": {"quat_xyzw_cam_icrs": [0, 0, 0, 0]}}', "holds no attitude"),
     (f'{{"attitude": {{"quat_xyzw_cam_icrs": [{10**400}, 0, 0, 0]}}}}', "holds no attitude"),
     ('{"attitude": {"quat_xyzw_cam_icrs": [0, 0, 0, 1]}, "provenance": {"time_utc": "noon"}}', "holds no attitude")],
)  # fmt: skip
@pytest.mark.parametrize("command", ["identify", "locate", "batch", "track"])
def test_a_file_without_attitude_is_bad_input(
    command: str, text: str | None, cause: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file, images = tmp_path / "near.json", SAMPLES / ("" if command == "batch" else "near-wall.png")
    if text is not None:
        file.write_text(text)
    assert main([command, str(images), "-D", str(tmp_path / "out"), "--near-attitude", str(file)]) == 4
    error = capsys.readouterr().err
    assert cause in error and "near.json" in error and "Traceback" not in error
    assert not list((tmp_path / "out").glob("*.fix.json"))


def test_without_a_camera_file_it_is_wrong_usage(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        main(["identify", str(SAMPLES / "near-wall.png"), "--fov", "180", "--near-attitude", str(tmp_path / "a.json")])
    assert stop.value.code == 2
    assert "needs a camera file" in capsys.readouterr().err
