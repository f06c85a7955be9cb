"""Platepars of the Raspberry Meteor Station: its formulas, written here anew, give the directions of our camera."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from startrack.camera import (
    Camera,
    Decentring,
    KannalaBrandt,
    Pinhole,
    camera_from_foreign_text,
    cap_grid,
    difference_px,
    load_camera,
    platepar_of,
    read_foreign_camera,
)
from startrack.cli.main import main
from startrack.core.types import BadInput
from startrack.frames import R_enu_icrs, Site, angle_between_rad

SITE = Site("earth", np.radians(46.1), np.radians(14.5), 300.0)
TIME = datetime(2024, 8, 12, 22, 13, 5, tzinfo=UTC)
OBLONG = Camera(
    name="oblong", size_px=(1280, 720), focal_px=(820.0, 826.0), centre_px=(650.3, 351.7), max_angle_rad=1.0,
    calibrated_angle_rad=0.8, lens=KannalaBrandt((-0.05, 0.01, 0.0, 0.0)),
)  # fmt: skip
PINHOLE = Camera(
    name="pinhole", size_px=(1280, 720), focal_px=(1500.0, 1500.0), centre_px=(639.5, 359.5), max_angle_rad=0.5,
    calibrated_angle_rad=0.45, lens=Pinhole(),
)  # fmt: skip
DECENTRED = replace(load_camera("lowell-ldt"), name="decentred", decentring=Decentring(3e-4, -4e-4))
CAMERAS = [load_camera("fisheye-2048"), load_camera("lowell-ldt"), OBLONG, PINHOLE, DECENTRED]
ARCSEC = np.pi / 648_000


def meeus_to_j2000(ray: np.ndarray, days: float) -> np.ndarray:
    """Precession from the date by Meeus's formulas for right ascension and declination, then RMS's nutation."""
    T, t = days / 36525, -days / 36525
    zeta = ((2306.2181 + 1.39656 * T) * t + 0.30188 * t**2 + 0.017998 * t**3) * ARCSEC
    z = ((2306.2181 + 1.39656 * T) * t + 1.09468 * t**2 + 0.018203 * t**3) * ARCSEC
    theta = ((2004.3109 - 0.85330 * T) * t - 0.42665 * t**2 - 0.041833 * t**3) * ARCSEC
    ra, dec = np.arctan2(ray[1], ray[0]), np.arcsin(ray[2])
    a = np.cos(dec) * np.sin(ra + zeta)
    b = np.cos(theta) * np.cos(dec) * np.cos(ra + zeta) - np.sin(theta) * np.sin(dec)
    c = np.sin(theta) * np.cos(dec) * np.cos(ra + zeta) + np.cos(theta) * np.sin(dec)
    turn = np.arctan2(a, b) + z
    x, y = np.hypot(a, b) * np.cos(turn), np.hypot(a, b) * np.sin(turn)
    node, sun, moon = np.radians([125.04452 - 1934.136261 * T, 280.4665 + 36000.7698 * T, 218.3165 + 481267.8813 * T])
    psi = -17.2 * np.sin(node) - 1.32 * np.sin(2 * sun) - 0.23 * np.sin(2 * moon) + 0.21 * np.sin(2 * node)
    eps = 9.2 * np.cos(node) + 0.57 * np.cos(2 * sun) + 0.1 * np.cos(2 * moon) - 0.09 * np.cos(2 * node)
    nutated = Rotation.from_rotvec([0, 0, psi * ARCSEC]) * Rotation.from_rotvec([-eps * ARCSEC, 0, 0])
    return nutated.apply([x, y, c])


def rms_axis_and_north(plate: dict[str, Any]) -> tuple[np.ndarray, float]:
    """J2000 axis (3,) and position angle [rad] of a platepar at its own time."""
    days, rolled = plate["JD"] - 2451545.0, 1e-3
    ra, dec, angle = np.radians([plate["RA_d"], plate["dec_d"], plate["pos_angle_ref"]])
    of_date = np.array([np.cos(ra) * np.cos(dec), np.sin(ra) * np.cos(dec), np.sin(dec)])
    axis = meeus_to_j2000(of_date, days)
    # The field turns as a short arc to the north does.
    north = np.array([-np.cos(ra) * np.sin(dec), -np.sin(ra) * np.sin(dec), np.cos(dec)])
    moved = meeus_to_j2000(np.cos(rolled) * of_date + np.sin(rolled) * north, days)
    east = np.cross([0, 0, 1], axis) / np.hypot(axis[0], axis[1])
    return axis, angle + np.arctan2(moved @ east, moved @ np.cross(axis, east))


def rms_directions(plate: dict[str, Any], px: np.ndarray) -> np.ndarray:
    """J2000 rays (n, 3) of pixels (n, 2) at the platepar's time: odd radial polynomial, equidistant, from north."""
    x0, y0, *rest = plate["x_poly_fwd"]
    aspect = 0.0 if plate["equal_aspect"] else rest.pop(0)
    half_x, half_y = plate["X_res"] / 2, plate["Y_res"] / 2
    x = px[:, 0] - half_x - x0 * half_x
    y = (1 + aspect) * (px[:, 1] - half_y - y0 * half_y)
    a1, a2 = (rest.pop(0), 2 * np.pi * rest.pop(0)) if plate["asymmetry_corr"] else (0.0, 0.0)
    r = (np.hypot(x, y) + a1 * y * np.cos(a2) - a1 * x * np.sin(a2)) / half_x
    scale = 1 + sum(k * r ** (2 * i + 2) for i, k in enumerate(rest))
    radius = np.radians(scale * np.hypot(x, y) / plate["F_scale"])
    axis, position_angle = rms_axis_and_north(plate)
    west_of_north = np.pi / 2 - position_angle + np.arctan2(y, x)
    east = np.cross([0, 0, 1], axis) / np.hypot(axis[0], axis[1])
    side = np.cos(west_of_north)[:, None] * np.cross(axis, east) - np.sin(west_of_north)[:, None] * east
    return np.cos(radius)[:, None] * axis + np.sin(radius)[:, None] * side


@pytest.mark.parametrize("camera", CAMERAS, ids=lambda c: c.name)
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_directions_of_pixels_are_those_of_the_camera(camera: Camera, seed: int) -> None:
    R = Rotation.random(random_state=seed).as_matrix()
    found = platepar_of(camera, R, TIME, SITE)
    px, inside = camera.project(cap_grid(camera.calibrated_angle_rad))
    px = px[inside]
    off_px = (
        angle_between_rad(rms_directions(json.loads(found.text), px), camera.unproject(px) @ R) * camera.focal_px[0]
    )
    assert off_px.max() < found.to_sky_px + 0.04  # RMS turns the field by precession alone, not by its nutation
    largest = 0.5 if camera.decentring else 0.1
    assert found.to_sky_px < largest
    assert found.to_image_px < largest


def test_image_of_a_direction_is_the_pixel() -> None:
    """RMS's way back: r - k1 r^3 - ... of the equidistant radius."""
    for camera in CAMERAS[:-1]:
        found = platepar_of(camera, np.eye(3), TIME, SITE)
        plate = json.loads(found.text)
        rays = cap_grid(camera.calibrated_angle_rad)
        px, inside = camera.project(rays)
        x0, y0, *rest = plate["x_poly_rev"]
        aspect = 0.0 if plate["equal_aspect"] else rest.pop(0)
        half_x, half_y = plate["X_res"] / 2, plate["Y_res"] / 2
        angle, side = np.arccos(rays[:, 2]), np.arctan2(rays[:, 1], rays[:, 0])
        r = np.degrees(angle) * plate["F_scale"] / half_x
        radius_px = half_x * (r - sum(k * r ** (2 * i + 3) for i, k in enumerate(rest)))
        x = half_x + x0 * half_x + radius_px * np.cos(side)
        y = half_y + y0 * half_y + radius_px * np.sin(side) / (1 + aspect)
        off_px = np.hypot(x - px[:, 0], y - px[:, 1])[inside]
        assert off_px.max() < found.to_image_px + 0.02


def test_pointing_above_the_horizon_is_that_of_the_site() -> None:
    R = R_enu_icrs(SITE, TIME)  # cam = enu: the axis is up, and the image's right is east
    plate = json.loads(
        platepar_of(OBLONG, Rotation.from_euler("x", -40, degrees=True).as_matrix() @ R, TIME, SITE).text
    )
    assert plate["alt_centre"] == pytest.approx(50.0, abs=1e-6)
    assert min(plate["az_centre"], abs(plate["az_centre"] - 180)) < 1e-6
    assert plate["JD"] == pytest.approx(2460535.42575231, abs=1e-7)
    assert abs(plate["rotation_from_horiz"]) % 180 == pytest.approx(180.0, abs=0.5)
    later = json.loads(platepar_of(OBLONG, R, TIME + timedelta(hours=1), SITE).text)
    assert (later["Ho"] - plate["Ho"]) % 360 == pytest.approx(15.04107, abs=1e-4)


def test_a_lens_that_no_platepar_holds_is_refused() -> None:
    bent = Camera(
        name="bent", size_px=(1600, 1200), focal_px=(480.0, 480.0), centre_px=(800.0, 600.0), max_angle_rad=1.6,
        calibrated_angle_rad=1.5, lens=KannalaBrandt((-0.014, -0.0027, 1.6e-4, -4e-4)),
        decentring=Decentring(2e-3, -6e-3),
    )  # fmt: skip
    with pytest.raises(BadInput, match=r"differs from the lens by up to \d+\.\d+ px"):
        platepar_of(bent, np.eye(3), TIME, SITE)
    with pytest.raises(BadInput, match="mirrored"):
        platepar_of(replace(OBLONG, mirrored=True), np.eye(3), TIME, SITE)


def record(folder: Path, time: str | None) -> Path:
    """A result with an attitude, as far as a platepar needs it."""
    file = folder / "night.identification.json"
    found = {"attitude": {"quat_xyzw_cam_icrs": [0.1, 0.2, 0.3, 0.9273618]}, "provenance": {"time_utc": time}}
    file.write_text(json.dumps(found))
    return file


def test_on_the_command_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["calibrate", "convert", "fisheye-2048", "--to", "platepar", "-D", str(tmp_path), "--site", "46.1,14.5,300"]
    assert main([*words, "--attitude", str(record(tmp_path, "2024-08-12T22:13:05Z"))]) == 0
    assert "largest errors of its radial7-odd up to 92.0 degrees off the axis: 0.00 px" in capsys.readouterr().out
    plate = json.loads((tmp_path / "platepar_cmn2010.cal").read_text())
    assert plate["distortion_type"] == "radial7-odd"
    assert plate["lat"] == pytest.approx(46.1)
    assert main([*words, "--attitude", str(record(tmp_path, None))]) == 4
    assert "states no time" in capsys.readouterr().err
    assert main([*words, "--attitude", str(tmp_path / "none.json")]) == 4
    capsys.readouterr()
    away = record(tmp_path, "2024-08-12T22:13:05Z")
    assert main([*words[:-2], "--site=-46.1,194.5,300", "-O", "--attitude", str(away)]) == 4
    assert "degrees below the horizon of this site" in capsys.readouterr().err
    away.write_text(json.dumps(json.loads(away.read_text()) | {"provenance": {"camera": "other.toml"}}))
    assert main([*words, "-O", "--attitude", str(away)]) == 4


@pytest.mark.parametrize(
    ("words", "cause"),
    [(["--to", "platepar"], "--attitude NAME"),
     (["--to", "platepar", "--site", "46,14"], "--attitude NAME"),
     (["--to", "platepar", "--attitude", "a.json"], "--site LAT"),
     (["--to", "ros", "--site", "46,14"], "are for --to")],
)  # fmt: skip
def test_what_is_missing_is_wrong_usage(words: list[str], cause: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        main(["calibrate", "convert", "fisheye-2048", *words])
    assert stop.value.code == 2
    assert cause in capsys.readouterr().err


PLATES = json.loads((Path(__file__).parent / "data/rms-platepar-directions.json").read_text())


@pytest.mark.parametrize("kind", PLATES["cases"])
def test_a_platepar_is_read_as_rms_reads_it(kind: str, tmp_path: Path) -> None:
    """Angles between the rays of pixels are those of the directions that RMS's own code gave (tests/data/README.md)."""
    case = PLATES["cases"][kind]
    file, px = tmp_path / "platepar_cmn2010.cal", np.array(PLATES["px"])
    file.write_text(json.dumps(case["platepar"]))
    camera = read_foreign_camera(file, None, 1.0)
    ra, dec = np.radians([case["ra_deg"], case["dec_deg"]])
    sky = np.stack([np.cos(dec) * np.cos(ra), np.cos(dec) * np.sin(ra), np.sin(dec)], axis=1)
    rays = camera.unproject(px)
    turn, _ = Rotation.align_vectors(rays, sky)  # proper: a mirrored lens would leave tens of degrees
    off_px = np.hypot(*(camera.project_unlimited(turn.apply(sky)) - px).T)
    assert off_px.max() < (0.35 if kind == "radial3-all" else 0.15)  # even powers are not smooth on the axis
    assert camera.name == "platepar_cmn2010" and camera.size_px == (1280, 720)
    assert camera.refraction == ("taken out" if case["platepar"]["refraction"] else "contained")
    assert f"RMS's {kind} to" in camera.notes[0]


@pytest.mark.parametrize("camera", CAMERAS, ids=lambda c: c.name)
def test_a_platepar_written_is_read_again(camera: Camera) -> None:
    found = platepar_of(camera, np.eye(3), TIME, SITE)
    again = camera_from_foreign_text(found.text, "platepar", "again", camera.calibrated_angle_rad)
    rays = cap_grid(camera.calibrated_angle_rad)
    rays = rays[camera.project(rays)[1]]
    assert np.hypot(*difference_px(camera, again, rays).T).max() < found.to_sky_px + 0.3
    assert again.calibrated_angle_rad == pytest.approx(min(camera.calibrated_angle_rad, again.max_angle_rad))


def test_a_lens_is_written_as_the_usual_type_where_that_holds_it() -> None:
    kinds = [platepar_of(camera, np.eye(3), TIME, SITE).kind for camera in CAMERAS]
    assert kinds == ["radial7-odd", "radial9-odd", "radial7-odd", "radial7-odd", "radial9-odd"]
    for camera, kind in zip(CAMERAS, kinds, strict=True):
        plate = json.loads(platepar_of(camera, np.eye(3), TIME, SITE).text)
        flags = 2 * plate["asymmetry_corr"] + (not plate["equal_aspect"])
        assert (plate["distortion_type"], len(plate["x_poly_fwd"])) == (kind, 2 + flags + (3 if "7" in kind else 4))


def test_platepars_of_the_first_version_are_read() -> None:
    """Without names for the direction, type and flags: the polynomial, from x_poly and y_poly."""
    plate = PLATES["cases"]["poly3+radial"]["platepar"]
    old = {key: plate[key] for key in ("X_res", "Y_res", "F_scale")}
    old |= {"x_poly": plate["x_poly_fwd"], "y_poly": plate["y_poly_fwd"]}
    one, other = (camera_from_foreign_text(json.dumps(p), "platepar", "x", 0.6) for p in (plate, old))
    assert one.focal_px == other.focal_px and one.lens == other.lens


SPOILED = [
    ({"distortion_type": "radial11-odd"}, "'radial11-odd' has no counterpart: known are poly3+radial"),
    ({"F_scale": 0}, "F_scale is 0"),
    ({"F_scale": "wide"}, "could not convert"),
    ({"x_poly_fwd": [0.0, 0.0, 0.3, 0.1, 0.5, -0.4], "asymmetry_corr": True}, "the best differs by up to"),
    ({"x_poly_fwd": [0.0, 0.0, 1e300]}, "the centre is outside the frame"),
    ({"x_poly_fwd": 3}, "x_poly_fwd must be finite numbers"),
    ({"x_poly_fwd": [0.999, 0.0, 0.1], "X_res": 2}, "too small a part"),
    ({"Y_res": None}, "float"),
]


@pytest.mark.parametrize(("change", "cause"), SPOILED, ids=range(len(SPOILED)))
def test_a_platepar_that_cannot_be_used_is_refused_by_name(change: dict[str, Any], cause: str) -> None:
    plate = PLATES["cases"]["radial9-odd"]["platepar"] | change
    with pytest.raises(BadInput, match=re.escape(cause)) as refusal:
        camera_from_foreign_text(json.dumps(plate), "platepar", "x", 0.0001 if plate["X_res"] == 2 else None)
    assert refusal.value.reason == "bad_calibration" and "RMS" in str(refusal.value)


def test_a_platepar_is_a_camera_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file, made = tmp_path / "platepar_cmn2010.cal", tmp_path / "station.toml"
    file.write_text(json.dumps(PLATES["cases"]["radial7-odd"]["platepar"] | {"station_code": "XX0001"}))
    assert main(["calibrate", "show", str(file)]) == 0
    shown = capsys.readouterr().out
    assert "XX0001: kannala_brandt, 1280 x 720" in shown and "photometry are not part of a camera file" in shown
    assert main(["calibrate", "convert", str(file), "--calibrated-angle", "38", "-o", str(made)]) == 0
    assert "up to 38.0 degrees off the axis; its pointing, time, site" in capsys.readouterr().err
    assert np.degrees(load_camera(made).calibrated_angle_rad) == pytest.approx(38.0)
    assert load_camera(made).refraction == "taken out"
