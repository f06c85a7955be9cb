"""The overlay of VirtualSky: a camera that is VirtualSky's own lens gives back its numbers."""

from __future__ import annotations

import json
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from startrack.camera import Camera, KannalaBrandt, load_camera, virtualsky_of
from startrack.cli.main import main
from startrack.core.types import BadInput
from startrack.frames import R_enu_icrs, Site, quat_xyzw_from_R

SITE = Site("earth", np.radians(46.1), np.radians(14.5), 300.0)
TIME = datetime(2000, 1, 1, 22, 13, 5, tzinfo=UTC)  # without precession, as VirtualSky draws
DIAMETER = 1400
EQUISOLID = Camera(
    name="equisolid", size_px=(1600, 1200), focal_px=(DIAMETER / 4 / np.sin(np.pi / 4),) * 2, centre_px=(812.0, 595.0),
    max_angle_rad=np.pi / 2, calibrated_angle_rad=np.pi / 2,
    lens=KannalaBrandt((-1 / 24, 1 / 1920, -1 / 322_560, 1 / 92_897_280)),  # 2 sin(a / 2)
)  # fmt: skip


def zenith_attitude(azimuth_deg: float, tilt_deg: float = 0.0) -> np.ndarray:
    """R_cam_icrs of a camera that looks up, image top to an azimuth: right is then west of it, as the sky is seen."""
    a, t = np.radians(azimuth_deg), np.radians(tilt_deg)
    top, right = np.array([np.sin(a), np.cos(a), 0.0]), np.array([-np.cos(a), np.sin(a), 0.0])
    R_cam_enu = Rotation.from_rotvec([t, 0, 0]).as_matrix() @ np.stack([right, -top, [0.0, 0.0, 1.0]])
    return R_cam_enu @ R_enu_icrs(SITE, TIME)


@pytest.mark.parametrize("azimuth_deg", [0.0, 75.0, 200.0])
def test_its_own_lens_gives_back_the_numbers(azimuth_deg: float) -> None:
    found = virtualsky_of(EQUISOLID, zenith_attitude(azimuth_deg), TIME, SITE)
    values = json.loads(found.text)
    sky = values["VIRTUALSKY"]
    assert (values["LENS_AZIMUTH"] - azimuth_deg + 180) % 360 - 180 == pytest.approx(0.0, abs=0.05)
    assert sky["IMAGE_CIRCLE_DIAMETER"] == pytest.approx(DIAMETER, abs=1)
    assert (sky["OFFSET_X"], sky["OFFSET_Y"]) == (12, 5)
    assert abs(sky["LATITUDE_OFFSET"]) < 0.05
    assert found.largest_px < 1.5


def test_a_tilt_becomes_offsets_of_the_site() -> None:
    found = virtualsky_of(EQUISOLID, zenith_attitude(0.0, 3.0), TIME, SITE)
    assert abs(json.loads(found.text)["VIRTUALSKY"]["LATITUDE_OFFSET"]) == pytest.approx(3.0, abs=0.1)
    assert found.largest_px < 2.0


def test_another_lens_states_its_difference() -> None:
    found = virtualsky_of(load_camera("fisheye-2048"), zenith_attitude(30.0), TIME, SITE)
    assert 5.0 < found.largest_px < 60.0  # equidistant against equisolid
    assert found.rms_px < found.largest_px


def test_mirrored_and_blind_cameras_are_refused() -> None:
    with pytest.raises(BadInput, match="mirrored"):
        virtualsky_of(replace(EQUISOLID, mirrored=True), zenith_attitude(0.0), TIME, SITE)
    down = np.diag([1.0, -1.0, -1.0]) @ zenith_attitude(0.0)
    with pytest.raises(BadInput, match="no sky above the site"):
        virtualsky_of(EQUISOLID, down, TIME, SITE)


def test_on_the_command_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "a.json"
    quat = quat_xyzw_from_R(zenith_attitude(30.0)).tolist()
    file.write_text(
        json.dumps({"attitude": {"quat_xyzw_cam_icrs": quat}, "provenance": {"time_utc": TIME.isoformat()}})
    )
    words = ["calibrate", "convert", "fisheye-2048", "--to", "indi-allsky", "--site", "46.1,14.5,300"]
    assert main([*words, "--attitude", str(file), "-D", str(tmp_path)]) == 0
    assert "px from this one at most" in capsys.readouterr().out
    assert "VIRTUALSKY" in json.loads((tmp_path / "indi-allsky.json").read_text())
