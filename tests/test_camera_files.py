"""Camera files: what is written is read back, and every wrong key is named."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tomli_w
from schema_helpers import change_key
from scipy.spatial.transform import Rotation

from startrack.camera import Camera, KannalaBrandt, Pinhole, Sensor, camera_from_dict, load_camera, save_camera
from startrack.core.files import data_dir
from startrack.core.types import BadInput

GOOD: dict[str, Any] = {
    "format": 1,
    "name": "test",
    "model": "kannala_brandt",
    "size_px": [1000, 800],
    "focal_px": [300.0, 301.0],
    "centre_px": [499.5, 399.5],
    "k": [0.01, -0.002],
    "max_angle_deg": 92.5,
    "calibrated_angle_deg": 91.0,
    "mirrored": True,
    "mount": {"quat_xyzw_body_cam": [0.1, -0.2, 0.3, 0.9273618495495703]},
    "sensor": {
        "zero_point_e_per_s": 1e4, "gain_e_per_adu": 0.4, "bias_adu": 10.0, "read_noise_e": 3.0, "dark_e_per_s": 0.1,
        "saturation_adu": 4000, "psf_sigma_px": 0.9, "vignetting": [-0.1, 0.01],
    },
    "covariance": {"order": ["fx", "k1"], "matrix": [[0.04, -0.001], [-0.001, 0.0009]]},
}  # fmt: skip


def assert_same(a: Camera, b: Camera) -> None:
    for name in Camera.__dataclass_fields__:
        if name in ("R_body_cam", "covariance"):
            continue
        mine, other = getattr(a, name), getattr(b, name)
        assert mine == (pytest.approx(other, abs=1e-15) if name.endswith("_rad") else other), name
    assert a.R_body_cam == pytest.approx(b.R_body_cam, abs=1e-15)
    assert (a.covariance is None) == (b.covariance is None)
    assert a.covariance is None or np.array_equal(a.covariance, b.covariance)


@pytest.mark.parametrize("path", sorted(data_dir("calib").glob("*.toml")), ids=lambda p: p.stem)
def test_shipped_cameras_load_and_survive_a_round_trip(path: Path, tmp_path: Path) -> None:
    camera = load_camera(path.stem)
    assert camera.name == path.stem
    assert_same(camera, load_camera(path))
    save_camera(camera, tmp_path / "again.toml")
    assert_same(camera, load_camera(tmp_path / "again.toml"))
    assert camera.calibrated_angle_rad <= camera.max_angle_rad


def test_every_key_reaches_the_camera(tmp_path: Path) -> None:
    camera = camera_from_dict(GOOD)
    assert (camera.size_px, camera.focal_px, camera.centre_px) == ((1000, 800), (300.0, 301.0), (499.5, 399.5))
    assert camera.lens == KannalaBrandt((0.01, -0.002))
    assert np.degrees([camera.max_angle_rad, camera.calibrated_angle_rad]) == pytest.approx([92.5, 91.0])
    assert camera.mirrored is True
    assert camera.R_body_cam == pytest.approx(Rotation.from_quat(GOOD["mount"]["quat_xyzw_body_cam"]).as_matrix())
    assert camera.sensor == Sensor(
        zero_point_e_per_s=1e4, gain_e_per_adu=0.4, bias_adu=10.0, read_noise_e=3.0, dark_e_per_s=0.1,
        saturation_adu=4000.0, psf_sigma_px=0.9, vignetting=(-0.1, 0.01),
    )  # fmt: skip
    assert camera.covariance_order == ("fx", "k1")
    assert camera.covariance is not None
    assert camera.covariance.tolist() == GOOD["covariance"]["matrix"]
    save_camera(camera, tmp_path / "c.toml")
    assert_same(camera, load_camera(tmp_path / "c.toml"))
    assert set(tomllib.loads((tmp_path / "c.toml").read_text())) == set(GOOD)


def test_defaults_are_those_of_the_format() -> None:
    least = {key: GOOD[key] for key in ("size_px", "focal_px", "centre_px", "max_angle_deg")}
    camera = camera_from_dict(least)
    assert camera.lens == KannalaBrandt(())
    assert camera.mirrored is False
    assert camera.sensor is None
    assert camera.calibrated_angle_rad == camera.max_angle_rad
    # body x (forward) = -cam y, body y (left) = +cam x, body z (up) = +cam z
    assert np.eye(3) @ camera.R_body_cam.T == pytest.approx(np.array([[0, 1, 0], [-1, 0, 0], [0, 0, 1]]))
    assert camera_from_dict(least | {"model": "pinhole", "max_angle_deg": 40}).lens == Pinhole()


def test_integers_are_numbers() -> None:
    d = change_key(GOOD, "focal_px", [300, 301]) | {"max_angle_deg": 92, "centre_px": [500, 400], "k": [0, 0]}
    assert camera_from_dict(d).centre_px == (500.0, 400.0)


BAD = [
    ("format", 2), ("model", "equidistant"), ("model", 3),
    ("size_px", None), ("size_px", [1000]), ("size_px", [1000.5, 800]), ("size_px", [0, 800]), ("size_px", 1000),
    ("size_px", ["1000", "800"]), ("size_px", [True, True]),
    ("focal_px", None), ("focal_px", [300.0, -300.0]), ("focal_px", 300.0), ("focal_px", [300.0, float("nan")]),
    ("focal_px", [300.0, 300.0, 300.0]),
    ("centre_px", None), ("centre_px", [1.0]), ("centre_px", [1.0, float("inf")]), ("centre_px", "middle"),
    ("k", [0.1, "x"]), ("k", 0.1), ("k", [0.0] * 5), ("k", {"k1": 0.1}),
    ("max_angle_deg", None), ("max_angle_deg", 0), ("max_angle_deg", -5.0), ("max_angle_deg", 181.0),
    ("max_angle_deg", "92"), ("calibrated_angle_deg", "92"), ("calibrated_angle_deg", -1.0),
    ("mirrored", "yes"), ("mirrored", 1), ("mirrored", "false"),
    ("mount", 5), ("mount.quat_xyzw_body_cam", [0.0, 0.0, 0.0, 0.5]), ("mount.quat_xyzw_body_cam", [0.0, 0.0, 1.0]),
    ("mount.quat_xyzw_body_cam", "default"), ("mount.quat_xyzw_body_cam", [0.0, 0.0, 0.0, 0.0]),
    ("sensor", 5), ("sensor", []), ("sensor.zero_point_e_per_s", None), ("sensor.zero_point_e_per_s", 0.0),
    ("sensor.gain_e_per_adu", -1.0), ("sensor.gain_e_per_adu", "1"), ("sensor.psf_sigma_px", 0.0),
    ("sensor.saturation_adu", 0), ("sensor.read_noise_e", -1.0), ("sensor.dark_e_per_s", -0.1),
    ("sensor.vignetting", [0.1]), ("sensor.vignetting", 0.1), ("sensor.gian_e_per_adu", 1.0),
    ("covariance", 5), ("covariance.matrix", [[1.0]]), ("covariance.matrix", [[1.0, "x"], [0.0, 1.0]]),
    ("covariance.matrix", None), ("covariance.order", 3), ("covariance.order", ["fx"]),
    ("covariance.matrix", [[1.0, 0.0], [0.0, float("nan")]]), ("covariance.matrix", [[1.0], [0.0, 1.0]]),
    ("size_px", [2**70, 800]), ("size_px", [65_000, 65_000]), ("focal_px", [1e308, 300.0]), ("centre_px", [2**70, 0.0]),
    ("k", [1e308]), ("sensor.psf_sigma_px", 1e6), ("sensor.psf_sigma_px", 1e-300), ("sensor.zero_point_e_per_s", 1e308),
    ("sensor.saturation_adu", 10**400), ("covariance.matrix", [[1e308, 0.0], [0.0, 1.0]]),
    ("covariance.order", [1, 2]), ("covariance.order", [["fx"], ["k1"]]), ("covariance.order", ["fx", "fx"]),
    ("covariance.order", ["fx", "x1"]), ("covariance.matrix", [[1.0, 0.5], [0.0, 1.0]]),
    ("covariance.matrix", [[-1.0, 0.0], [0.0, 1.0]]), ("covariance.matrix", [[1.0, 2.0], [2.0, 1.0]]),
    ("covariance.matrix", [[1e-300, 1e12], [1e12, 1e-300]]), ("name", ""), ("name", "two\nlines"), ("name", "x" * 250),
    ("name", 7), ("focal_pix", [300.0, 300.0]), ("calibrated_angle", 90.0),
]  # fmt: skip


@pytest.mark.parametrize(("path", "value"), BAD, ids=lambda v: str(v)[:30])
def test_a_wrong_key_is_refused_and_named(path: str, value: Any, tmp_path: Path) -> None:
    file = tmp_path / "bad.toml"
    file.write_text(tomli_w.dumps(change_key(GOOD, path, value)))
    with pytest.raises(BadInput) as caught:
        load_camera(file)
    assert caught.value.reason == "bad_calibration"
    assert path.split(".")[-1] in str(caught.value)
    assert str(file) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_circle_beyond_the_turning_point_is_refused() -> None:
    with pytest.raises(BadInput, match=r"max_angle_deg.*95\.4") as caught:
        camera_from_dict(change_key(GOOD, "k", [-0.12]) | {"max_angle_deg": 96.0})
    assert caught.value.reason == "bad_calibration"
    with pytest.raises(BadInput, match="max_angle_deg"):
        camera_from_dict(change_key(GOOD, "model", "pinhole") | {"k": [], "max_angle_deg": 90.0})


def test_a_missing_file_is_no_calibration(tmp_path: Path) -> None:
    for name in (tmp_path / "none.toml", "no-such-camera", "some/where"):
        with pytest.raises(BadInput) as caught:
            load_camera(name)
        assert caught.value.reason == "no_calibration"
        assert str(name) in str(caught.value)
    with pytest.raises(BadInput, match="fisheye-2048"):  # lists the shipped ones
        load_camera("fisheye")


NOT_TOML = [
    b"size_px = [1, 2", b"\xff\xfe\x00", b"", b"a = 1\na = 2", b"name = " + 2000 * b"[" + 2000 * b"]",
    b"size_px = [" + 5000 * b"9" + b", 9]", b"#" * 2**21,
]  # fmt: skip


@pytest.mark.parametrize("text", NOT_TOML, ids=range(len(NOT_TOML)))
def test_what_is_not_toml_is_bad_calibration(text: bytes, tmp_path: Path) -> None:
    (tmp_path / "bad.toml").write_bytes(text)
    with pytest.raises(BadInput) as caught:
        load_camera(tmp_path / "bad.toml")
    assert caught.value.reason == "bad_calibration"
    assert "\n" not in str(caught.value) and len(str(caught.value)) < 400


def test_vignetting_is_the_stated_polynomial_and_never_negative() -> None:
    sensor = Sensor(zero_point_e_per_s=1.0, vignetting=(-0.3, 0.02))
    assert sensor.throughput(np.array([0.0, 1.0])) == pytest.approx([1.0, 0.72])
    assert Sensor(zero_point_e_per_s=1.0, vignetting=(-1.0, 0.0)).throughput(np.array([1.5])) == [0.0]


def test_a_lens_darker_than_any_is_refused() -> None:
    """Vignetting that a calibration with airmass in it once gave: 0.014 at 80 degrees, negative from 82.6."""
    dark = change_key(GOOD, "sensor.vignetting", [-0.70, 0.10])
    for calibrated_deg in (80.0, 91.0):
        with pytest.raises(BadInput, match=rf"sensor.vignetting.*{calibrated_deg:.1f} degrees") as caught:
            camera_from_dict(dark | {"calibrated_angle_deg": calibrated_deg})
        assert caught.value.reason == "bad_calibration"
    assert camera_from_dict(dark | {"calibrated_angle_deg": 60.0}).sensor is not None
    dip = Sensor(zero_point_e_per_s=1.0, vignetting=(-2.0, 1.0))  # 1 - 2 a^2 + a^4 is 0 at a = 1 and 1 at a = sqrt 2
    assert dip.lowest_throughput(1.4) == pytest.approx(0.0, abs=1e-12)
    assert dip.lowest_throughput(0.5) == pytest.approx(dip.throughput(np.array(0.5)))
