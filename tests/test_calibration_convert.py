"""Camera files of other programs: there and back, and against those programs' own formulas."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from page_helpers import ROOT
from scipy.spatial.transform import Rotation

from startrack.camera import Camera, Decentring, KannalaBrandt, Pinhole, decentring_rms_px, load_camera
from startrack.camera import camera_from_foreign_text as from_text
from startrack.camera import foreign_text as to_text
from startrack.cli.main import main
from startrack.core.types import BadInput

PROGRAMS = ("ros", "kalibr", "colmap", "opencv")
BOARD_MOUNT = Rotation.from_quat([0.1, -0.2, 0.3, 0.9]).as_matrix()
FISHEYE = Camera(
    name="fisheye", size_px=(1600, 1200), focal_px=(480.123456789, 479.87654321), centre_px=(801.25, 597.75),
    max_angle_rad=np.radians(95), calibrated_angle_rad=np.radians(90),
    lens=KannalaBrandt((-0.0141075869, -0.002760624, 1.62897e-4, -4.1316e-4)), R_body_cam=BOARD_MOUNT,
)  # fmt: skip
PINHOLE = Camera(
    name="pinhole", size_px=(1024, 768), focal_px=(5132.25, 5133.5), centre_px=(511.0, 384.25),
    max_angle_rad=0.13, calibrated_angle_rad=0.12, lens=Pinhole(),
)  # fmt: skip
BENT = Camera(
    name="bent", size_px=(1600, 1200), focal_px=(480.0, 481.0), centre_px=(801.25, 597.75), max_angle_rad=1.6,
    calibrated_angle_rad=1.5, lens=KannalaBrandt((-0.014, -0.0027, 1.6e-4, -4e-4)),
    decentring=Decentring(2e-4, -6e-4),
)  # fmt: skip


def rays(top_rad, count=400):
    rng = np.random.default_rng(0)
    z, b = rng.uniform(np.cos(top_rad), 1, count), rng.uniform(0, 2 * np.pi, count)
    return np.stack([np.sqrt(1 - z * z) * np.cos(b), np.sqrt(1 - z * z) * np.sin(b), z], axis=1)


@pytest.mark.parametrize("program", PROGRAMS)
@pytest.mark.parametrize("camera", [FISHEYE, PINHOLE], ids=lambda c: c.name)
def test_there_and_back(program, camera):
    again = from_text(to_text(camera, program), program, "again")
    seen = rays(camera.calibrated_angle_rad)
    np.testing.assert_allclose(again.project(seen)[0], camera.project(seen)[0], atol=1e-6)
    assert again.size_px == camera.size_px
    assert again.lens.model == camera.lens.model
    if program == "kalibr":
        np.testing.assert_allclose(again.R_body_cam, camera.R_body_cam, atol=1e-12)


def test_opencv_puts_the_same_rays_on_the_same_pixels():
    """cv2.fisheye for a fisheye (to 80 degrees, where it still works), cv2.projectPoints for a pinhole."""
    for camera, top in ((FISHEYE, np.radians(80)), (PINHOLE, 0.12)):
        store = cv2.FileStorage(to_text(camera, "opencv"), cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)
        K, D = store.getNode("camera_matrix").mat(), store.getNode("distortion_coefficients").mat()
        seen = rays(top)
        points, nothing = (seen / seen[:, 2:])[:, None], np.zeros((3, 1))
        project = cv2.fisheye.projectPoints if camera is FISHEYE else None
        px = (
            project(points, nothing, nothing, K, D)[0]
            if project
            else cv2.projectPoints(points, nothing, nothing, K, D)[0]
        )
        np.testing.assert_allclose(px[:, 0], camera.project(seen)[0], atol=1e-6)


def test_ros_file_read_with_its_own_formula():
    """REP 104 / camera_info "equidistant": theta_d = theta (1 + k1 theta^2 + ...), x = K [theta_d / r x', ...]."""
    d = yaml.safe_load(to_text(FISHEYE, "ros"))
    assert d["distortion_model"] == "equidistant"
    K, D = np.reshape(d["camera_matrix"]["data"], (3, 3)), d["distortion_coefficients"]["data"]
    np.testing.assert_allclose(project_by_angle(K, D, rays(1.4)), FISHEYE.project(rays(1.4))[0], atol=1e-9)
    P = np.reshape(d["projection_matrix"]["data"], (3, 4))
    np.testing.assert_array_equal(P[:, :3], K)
    assert (d["image_width"], d["image_height"]) == FISHEYE.size_px


def test_kalibr_file_read_with_its_own_formula():
    d = yaml.safe_load(to_text(FISHEYE, "kalibr"))["cam0"]
    fu, fv, pu, pv = d["intrinsics"]
    K = np.array([[fu, 0, pu], [0, fv, pv], [0, 0, 1]])
    np.testing.assert_allclose(
        project_by_angle(K, d["distortion_coeffs"], rays(1.4)), FISHEYE.project(rays(1.4))[0], atol=1e-9
    )
    assert tuple(d["resolution"]) == FISHEYE.size_px
    T_cam_body = np.array(d["T_cam_imu"])
    ray_body = np.array([0.3, -0.4, 0.5, 0.0])  # a direction takes no part in the translation
    np.testing.assert_allclose(BOARD_MOUNT @ (T_cam_body @ ray_body)[:3], ray_body[:3], atol=1e-12)


def test_colmap_counts_from_the_corner_of_the_first_pixel():
    line = to_text(FISHEYE, "colmap").splitlines()[-1].split()
    assert line[:4] == ["1", "OPENCV_FISHEYE", "1600", "1200"]
    fx, fy, cx, cy, *k = map(float, line[4:])
    K = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    np.testing.assert_allclose(project_by_angle(K, k, rays(1.4)), FISHEYE.project(rays(1.4))[0] + 0.5, atol=1e-9)


def test_colmap_thin_prism_fisheye_holds_a_decentred_lens():
    """COLMAP's ThinPrismFisheyeCameraModel::Distortion, written out."""
    line = to_text(BENT, "colmap").splitlines()[-1].split()
    assert line[1] == "THIN_PRISM_FISHEYE"
    fx, fy, cx, cy, k1, k2, p1, p2, k3, k4, sx1, sy1 = map(float, line[4:])
    seen = rays(1.4)
    r = np.hypot(seen[:, 0], seen[:, 1])
    u, v = seen[:, :2].T * np.arctan2(r, seen[:, 2]) / r
    r2 = u * u + v * v
    radial = k1 * r2 + k2 * r2**2 + k3 * r2**3 + k4 * r2**4
    du = u * radial + 2 * p1 * u * v + p2 * (r2 + 2 * u * u) + sx1 * r2
    dv = v * radial + 2 * p2 * u * v + p1 * (r2 + 2 * v * v) + sy1 * r2
    px = np.stack([fx * (u + du) + cx, fy * (v + dv) + cy], axis=1)
    np.testing.assert_allclose(px, BENT.project(seen)[0] + 0.5, atol=1e-9)
    again = from_text(to_text(BENT, "colmap"), "colmap", "again")
    np.testing.assert_allclose(again.project(seen)[0], BENT.project(seen)[0], atol=1e-9)


@pytest.mark.parametrize("program", ["ros", "kalibr", "opencv"])
def test_formats_without_decentring_lose_what_is_stated(program):
    again = from_text(to_text(BENT, program), program, "again")
    assert not again.decentring
    assert 0.05 < decentring_rms_px(BENT) < 1.0


@pytest.mark.parametrize("program", PROGRAMS)
def test_mirrored_cameras_are_refused(program):
    with pytest.raises(BadInput, match="mirrored") as refusal:
        to_text(replace(FISHEYE, mirrored=True), program)
    assert refusal.value.reason == "bad_calibration"


@pytest.mark.parametrize("program", PROGRAMS)
@pytest.mark.parametrize("spoil", ["", "nonsense", "[1, 2", "distorted"])
def test_broken_files_are_refused_by_name(program, spoil):
    text = spoil
    if spoil == "distorted":  # a pinhole with real distortion has no counterpart
        text = to_text(PINHOLE, program)
        text = (
            re.sub(r"data: \[ ?0\.0, 0\.0", "data: [ 0.1, 0.0", text, count=1) if program in ("ros", "opencv") else text
        )
        text = text.replace("distortion_coeffs: [0.0", "distortion_coeffs: [0.2").replace(" PINHOLE ", " OPENCV ")
        assert text != to_text(PINHOLE, program)
    with pytest.raises(BadInput) as refusal:
        from_text(text, program, "x")
    assert refusal.value.reason == "bad_calibration"


SPOILED = {
    "ros": [("data: [480.123456789, 0.0", "data: [480.123456789, 0.5", "skewed"), ("equidistant", "fov", "'fov'")],
    "kalibr": [("intrinsics", "numbers", "'intrinsics' is missing"), ("equidistant", "fov", "'fov'")],
    "colmap": [("1600 1200", "1600", "parameters has no counterpart"), ("1 OPENCV", "# OPENCV", "no line CAMERA_ID")],
    "opencv": [("data: [ 480.123456789, 0.0", "data: [ 480.123456789, 0.5", "skewed"), ("rows: 4", "rows: 3", "")],
}


@pytest.mark.parametrize("program", PROGRAMS)
def test_what_is_wrong_with_a_file_is_stated(program):
    for old, new, cause in SPOILED[program]:
        text = to_text(FISHEYE, program)
        assert old in text
        with pytest.raises(BadInput, match=rf"not a camera file of \w+ that can be used: .*{cause}"):
            from_text(text.replace(old, new, 1), program, "x")


def test_a_ros_name_is_quoted():
    named = replace(PINHOLE, name='left: "wide" # 2')
    assert from_text(to_text(named, "ros"), "ros", "other").name == named.name


def project_by_angle(K, k, seen):
    r = np.hypot(seen[:, 0], seen[:, 1])
    theta = np.arctan2(r, seen[:, 2])
    theta_d = theta * (1 + sum(c * theta ** (2 * n + 2) for n, c in enumerate(k)))
    h = np.column_stack([theta_d / r * seen[:, 0], theta_d / r * seen[:, 1], np.ones(len(r))])
    return (h @ K.T)[:, :2]


def test_the_flag_names_the_camera_and_its_file_stays_in_the_folder(tmp_path, capsys):
    (tmp_path / "info.yaml").write_text(to_text(PINHOLE, "ros"))
    command = ["calibrate", "convert", str(tmp_path / "info.yaml"), "--from", "ros", "-q", "-o"]
    for words, name in ((["--name", "../mine"], "../mine"), ([], "pinhole")):
        assert main([*command, str(tmp_path / "out.toml"), "-O", *words]) == 0
        assert load_camera(str(tmp_path / "out.toml")).name == name
        to_ros = ["calibrate", "convert", str(tmp_path / "out.toml"), "--to", "ros", "-O"]
        assert main([*to_ros, "-D", str(tmp_path / "d")]) == 0
        assert Path(capsys.readouterr().out.strip()).parent == tmp_path / "d"


XML = """<?xml version="1.0"?><opencv_storage><image_width>1600</image_width><image_height>1200</image_height>
<fisheye_model>1</fisheye_model><camera_matrix type_id="opencv-matrix"><rows>3</rows><cols>3</cols><dt>d</dt>
<data>480. 0. 801.25 0. 481. 597.75 0. 0. 1.</data></camera_matrix>
<distortion_coefficients type_id="opencv-matrix"><rows>4</rows><cols>1</cols><dt>d</dt>
<data>-0.01 2.5e-03 0. 0.</data></distortion_coefficients></opencv_storage>"""


def test_an_opencv_file_in_xml_is_read():
    camera = from_text(XML, "opencv", "x")
    assert (camera.size_px, camera.focal_px, camera.centre_px) == ((1600, 1200), (480.0, 481.0), (801.25, 597.75))
    assert camera.lens == KannalaBrandt((-0.01, 0.0025, 0.0, 0.0))


@pytest.mark.parametrize("form", ["YAML", "XML"])
def test_files_that_opencv_writes_are_read(form, tmp_path):
    path = str(tmp_path / f"camera.{form.lower()}")
    store = cv2.FileStorage(path, cv2.FILE_STORAGE_WRITE)
    store.write("image_width", 1600)
    store.write("image_height", 1200)
    store.write("fisheye_model", 1)
    store.write("camera_matrix", np.array([[480.123456789, 0, 801.25], [0, 479.5, 597.75], [0, 0, 1]]))
    store.write("distortion_coefficients", np.array([[-0.0141, 1e-5, 0.0, -4.1316e-4]]))
    store.release()
    camera = from_text(Path(path).read_text(), "opencv", "x")
    assert camera.focal_px == (480.123456789, 479.5)
    assert camera.lens == KannalaBrandt((-0.0141, 1e-5, 0.0, -4.1316e-4))


HUGE = [("opencv", "rows: 3", "rows: 200000000"), ("opencv", "rows: 3", 'rows: ["a", 1]'), ("ros", "480.1", "1e308"),
        ("kalibr", "480.1", "9" * 400), ("colmap", "480.1", "x" * 5000),
        ("kalibr", "T_cam_imu:\n  - [", "T_cam_imu:\n  - [.nan, "),
        ("colmap", "1600", "-1"), ("kalibr", "cam0:", "cam0: " + "[" * 2000)]  # fmt: skip


@pytest.mark.parametrize(("program", "old", "new"), HUGE, ids=range(len(HUGE)))
def test_impossible_numbers_are_refused_in_one_line(program, old, new):
    text = to_text(FISHEYE, program)
    assert old in text
    with pytest.raises(BadInput, match="that can be used") as caught:
        from_text(text.replace(old, new), program, "x")
    assert caught.value.reason == "bad_calibration"
    assert str(caught.value).isprintable() and len(str(caught.value)) < 400


@pytest.mark.parametrize("program", PROGRAMS)
def test_the_calibrated_angle_is_given_or_that_of_the_nearest_edge(program, tmp_path, capsys):
    """No other format states it: it must not become that of the image circle, where no star was measured."""
    source, made = tmp_path / "theirs.txt", tmp_path / "ours.toml"
    source.write_text(to_text(FISHEYE, program))
    words = ["calibrate", "convert", str(source), "--from", program, "-o", str(made)]
    assert main(words) == 0
    camera = load_camera(made)
    edge = np.array([801.25, -0.5])  # the frame is 1600 x 1200 and its centre at 801, 598
    assert camera.calibrated_angle_rad == pytest.approx(float(camera.angle_rad(edge)))
    assert camera.calibrated_angle_rad < 0.7 * camera.max_angle_rad
    assert "the file states none; startrack calibrate convert --calibrated-angle" in capsys.readouterr().err
    assert main([*words, "--calibrated-angle", "50", "-O"]) == 0
    assert load_camera(made).calibrated_angle_rad == pytest.approx(np.radians(50))
    assert capsys.readouterr().err == ""
    off_centre = replace(FISHEYE, centre_px=(-100.0, 600.0))
    with pytest.raises(BadInput, match="--calibrated-angle"):
        from_text(to_text(off_centre, program), program, "off")
    assert from_text(to_text(off_centre, program), program, "off", 0.5).calibrated_angle_rad == 0.5


@pytest.mark.parametrize("camera", [FISHEYE, PINHOLE], ids=lambda c: c.name)
@pytest.mark.parametrize("program", PROGRAMS)
def test_every_program_is_recognized_by_content(program, camera, tmp_path, monkeypatch, caplog):
    monkeypatch.chdir(tmp_path)
    name = f"{program}-{camera.name}.txt"
    Path(name).write_text(to_text(camera, program))
    direct = load_camera(name)
    assert f"{name}: the lens is taken as calibrated to" in caplog.text
    converted = from_text(to_text(camera, program), program, Path(name).stem)
    seen = rays(converted.calibrated_angle_rad)
    np.testing.assert_array_equal(direct.project(seen)[0], converted.project(seen)[0])
    assert direct.calibrated_angle_rad == converted.calibrated_angle_rad < camera.max_angle_rad
    assert direct.name == converted.name


def test_an_opencv_file_in_xml_is_recognized(tmp_path):
    (tmp_path / "camera.xml").write_text(XML)
    assert load_camera(tmp_path / "camera.xml").lens == KannalaBrandt((-0.01, 0.0025, 0.0, 0.0))


OTHER_FILES = [
    ("ros", "equidistant", "plumb_bob", "distortion plumb_bob with coefficients other than 0 has no counterpart"),
    ("kalibr", "camera_model: pinhole", "camera_model: omni", "camera_model 'omni' has no counterpart"),
    ("colmap", "OPENCV_FISHEYE", "OPENCV", "camera model OPENCV with 8 parameters has no counterpart"),
    ("opencv", "fisheye_model: 1", "fisheye_model: 0", "distortion pinhole with coefficients other than 0"),
    ("ros", "camera_matrix", "matrix", "not a camera file of startrack (.toml), ROS, Kalibr, COLMAP, OpenCV or RMS"),
]


@pytest.mark.parametrize(("program", "old", "new", "cause"), OTHER_FILES, ids=lambda v: str(v)[:20])
def test_a_lens_that_cannot_be_converted_exactly_is_refused(program, old, new, cause, tmp_path):
    file = tmp_path / "theirs.yaml"
    file.write_text(to_text(FISHEYE, program).replace(old, new))
    with pytest.raises(BadInput, match=re.escape(cause)) as refusal:
        load_camera(file)
    assert refusal.value.reason == "bad_calibration"
    assert str(file) in str(refusal.value)


# As `ros2 topic echo` prints it; binning of 2 of the whole sensor.
ECHO = """header:
  stamp:
    sec: 1759842258
    nanosec: 831630048
  frame_id: cam
height: 1200
width: 1920
distortion_model: equidistant
d:
- -0.012
- 0.003
- -0.0005
- 0.0001
k:
- 620.0
- 0.0
- 960.7
- 0.0
- 621.0
- 600.8
- 0.0
- 0.0
- 1.0
r: [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]
p: [620.0, 0.0, 960.7, 0.0, 0.0, 620.0, 600.8, 0.0, 0.0, 0.0, 1.0, 0.0]
binning_x: BX
binning_y: BY
roi:
  x_offset: RX
  y_offset: RY
  height: RH
  width: RW
  do_rectify: false
---
"""
WHOLE = {"BX": 0, "BY": 0, "RX": 0, "RY": 0, "RW": 0, "RH": 0}


def echo(**values):
    text = ECHO
    for key, value in (WHOLE | values).items():
        text = text.replace(f": {key}\n", f": {value}\n")
    return text


def shrunk(frame, start, size, by):
    """The part of a `frame` (H, W) of that size (W, H) at `start`, each `by` pixels of it one: their mean."""
    (x, y), (w, h), (bx, by_) = start, size, by
    part = frame[y : y + h // by_ * by_, x : x + w // bx * bx]
    return part.reshape(h // by_, by_, w // bx, bx).mean(axis=(1, 3))


@pytest.mark.parametrize(
    ("start", "size", "by"),
    [((0, 0), (1920, 1200), (2, 2)), ((300, 101), (1400, 1000), (1, 1)), ((301, 99), (1400, 1001), (3, 2))],
)
def test_binning_and_region_of_a_camera_info_are_applied(start, size, by):
    """A blob painted on the sensor has its centroid in the binned part where the camera projects its ray."""
    whole = from_text(echo(), "ros", "whole")
    window = (0, 0) if size == (1920, 1200) else size
    text = echo(BX=by[0], BY=by[1], RX=start[0], RY=start[1], RW=window[0], RH=window[1])
    camera = from_text(text, "ros", "part")
    assert camera.size_px == (size[0] // by[0], size[1] // by[1])
    assert f"pictures of {camera.size_px[0]} x {camera.size_px[1]} px" in camera.notes[0]
    px = np.array([1033.37, 512.81])
    y, x = np.indices((1200, 1920))
    part = shrunk(np.exp(-((x - px[0]) ** 2 + (y - px[1]) ** 2) / (2 * 6.0**2)), start, size, by)
    rows, columns = np.indices(part.shape)
    centroid = [(columns * part).sum() / part.sum(), (rows * part).sum() / part.sum()]
    np.testing.assert_allclose(camera.project(whole.unproject(px))[0], centroid, atol=2e-3)


def test_a_camera_info_printed_from_a_topic_is_read_as_the_file_of_it(tmp_path):
    (tmp_path / "info.yaml").write_text(echo())
    camera = load_camera(tmp_path / "info.yaml")
    assert (camera.size_px, camera.focal_px, camera.centre_px) == ((1920, 1200), (620.0, 621.0), (960.7, 600.8))
    assert camera.lens == KannalaBrandt((-0.012, 0.003, -0.0005, 0.0001))
    assert len(camera.notes) == 1  # no word on binning, region or stereo: only the calibrated angle
    again = from_text(echo() + echo().replace("sec: 1", "sec: 2"), "ros", "info")  # a second message
    assert again == replace(camera, R_body_cam=again.R_body_cam)
    ros1 = re.sub(r"^([dkrp]):", lambda m: m[0].upper(), echo(), flags=re.MULTILINE)
    assert from_text(ros1, "ros", "info").focal_px == camera.focal_px
    other = echo() + echo(BX=2, BY=2)
    with pytest.raises(
        BadInput, match=r"has several cameras: choose .* FILE#1, of 1 \(1920 x 1200\), 2 \(1920 x 1200\)"
    ):
        from_text(other, "ros", "info")
    assert from_text(other, "ros", "info", wanted="2").size_px == (960, 600)


def test_the_file_of_a_camera_info_may_have_binning_and_stereo():
    text = to_text(FISHEYE, "ros")
    assert from_text(text + "binning_x: 2\nbinning_y: 2\n", "ros", "x").size_px == (800, 600)
    stereo = text.replace("801.25, 0.0, 0.0, 479.8", "801.25, -58.0, 0.0, 479.8")
    assert stereo != text
    camera = from_text(stereo, "ros", "x")
    assert "the rectification of a stereo camera (r, p) is left out" in camera.notes[0]
    assert camera.focal_px == FISHEYE.focal_px
    with pytest.raises(BadInput, match=r"roi 1600 x 1200 at 8, 0 is not within the sensor"):
        from_text(text + "roi: {x_offset: 8, y_offset: 0, width: 1600, height: 1200}\n", "ros", "x")


def several(program):
    """A file of two cameras, the second a pinhole, and their names."""
    one, two = to_text(FISHEYE, program), to_text(PINHOLE, program)
    if program == "kalibr":
        return one + two.replace("cam0:", "cam1:"), ("cam0", "cam1"), ("1600 x 1200", "1024 x 768")
    return one + two.replace("\n1 PINHOLE", "\n7 PINHOLE"), ("1", "7"), ("1600 x 1200", "1024 x 768")


@pytest.mark.parametrize("program", ["kalibr", "colmap"])
def test_of_several_cameras_one_is_chosen_by_its_name(program, tmp_path, capsys):
    text, names, sizes = several(program)
    file = tmp_path / "rig.yaml"
    file.write_text(text)
    listed = ", ".join(f"{name} ({size})" for name, size in zip(names, sizes, strict=True))
    with pytest.raises(
        BadInput, match=re.escape(f"has several cameras: choose by the file's name, as FILE#{names[0]}")
    ):
        load_camera(file)
    for words in (["show", str(file)], ["convert", str(file), "-o", str(tmp_path / "c.toml")]):
        assert main(["calibrate", *words]) == 4
        assert listed in capsys.readouterr().err
    with pytest.raises(
        BadInput, match=re.escape(f"has no camera 'cam9': choose by the file's name, as FILE#{names[0]}")
    ):
        load_camera(f"{file}#cam9")
    for name, camera in zip(names, (FISHEYE, PINHOLE), strict=True):
        found = load_camera(f"{file}#{name}")
        assert (found.focal_px, found.name) == (camera.focal_px, f"rig-{name}")
    assert main(["calibrate", "convert", f"{file}#{names[1]}", "-o", str(tmp_path / "c.toml")]) == 0
    assert load_camera(tmp_path / "c.toml").size_px == PINHOLE.size_px
    (tmp_path / "one.yaml").write_text(to_text(FISHEYE, "opencv"))
    with pytest.raises(BadInput, match="has no name: leave #cam0 out"):
        load_camera(tmp_path / "one.yaml#cam0")


def test_equal_cameras_of_colmap_are_one():
    line = to_text(FISHEYE, "colmap")
    assert from_text(line + line.replace("\n1 ", "\n2 "), "colmap", "x").focal_px == FISHEYE.focal_px


def test_what_was_chosen_is_among_the_warnings_of_an_image(tmp_path, capsys):
    file = tmp_path / "rig.yaml"
    file.write_text(to_text(load_camera("fisheye-2048"), "ros"))
    assert (
        main(
            [
                "detect",
                str(ROOT / "sample_images/near-wall.png"),
                "-c",
                str(file),
                "--json",
                "--no-plots",
                "-D",
                str(tmp_path),
            ]
        )
        == 0
    )
    found = capsys.readouterr()
    assert "the lens is taken as calibrated to" in found.err
    assert any("the file states none" in text for text in json.loads(found.out)["warnings"])
