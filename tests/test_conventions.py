"""CONVENTIONS.md, row by row: tested on computed values where possible, else on the source."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import startrack
from startrack import frames
from startrack.camera import Camera
from startrack.catalog import bodies, sky
from startrack.core import types
from startrack.frames import Site, parse_utc

ROOT = Path(startrack.__file__).parent
PAGE = ROOT.parent / "CONVENTIONS.md"
TIME = parse_utc("2026-03-01T12:00:00")
SHACKLETON = Site("moon", np.radians(-89.66), np.radians(129.78))
GREENWICH = Site("earth", np.radians(51.4779), 0.0, 46.0)

# A camera that looks at the zenith, image top to the north: rows are cam x, y, z in enu.
R_CAM_ENU_NORTH_UP = np.array([[-1.0, 0, 0], [0, -1.0, 0], [0, 0, 1.0]])
ZENITH_CAMERA = Camera(
    name="zenith", size_px=(201, 101), focal_px=(40.0, 40.0), centre_px=(100.0, 50.0), max_angle_rad=2.9,
    calibrated_angle_rad=2.9,
)  # fmt: skip


# --- on the values --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("site", [SHACKLETON, GREENWICH])
def test_frames_are_right_handed(site: Site) -> None:
    for R in (frames.R_enu_fixed(site), frames.R_enu_icrs(site, TIME)):
        east, north, up = R
        np.testing.assert_allclose(np.cross(east, north), up, atol=1e-14)
    vertical = frames.position_fixed_m(site) @ frames.R_enu_fixed(site).T
    assert vertical[2] > 0.99999 * np.linalg.norm(vertical)


def test_rotation_labels_cancel() -> None:
    R_enu_icrs = frames.R_enu_icrs(SHACKLETON, TIME)
    R_cam_enu = Rotation.from_euler("xyz", [3, -2, 40], degrees=True).as_matrix() @ R_CAM_ENU_NORTH_UP
    R_cam_icrs = R_cam_enu @ R_enu_icrs
    ray_icrs = np.array([0.6, 0.0, -0.8])
    np.testing.assert_allclose(R_cam_icrs @ ray_icrs, R_cam_enu @ (R_enu_icrs @ ray_icrs), atol=1e-15)


def test_rotations_act_on_vectors_not_on_axes() -> None:
    """The Earth's pole is due north at an elevation equal to the latitude, and the Sun due south at noon."""
    R_enu_icrs = frames.R_enu_icrs(GREENWICH, TIME)
    azimuth, elevation = frames.azel_from_rays(R_enu_icrs @ [0.0, 0.0, 1.0])
    # Precession has moved the pole by 0.15 degrees since 2000.
    assert np.degrees(elevation) == pytest.approx(51.48, abs=0.2)
    assert abs(np.degrees((azimuth + np.pi) % (2 * np.pi) - np.pi)) < 0.3
    sun = bodies(GREENWICH, TIME)[0]
    azimuth, elevation = frames.azel_from_rays(R_enu_icrs @ sun.ray_icrs)
    assert np.degrees(azimuth) == pytest.approx(180, abs=6)  # the equation of time is 12 minutes
    assert np.degrees(elevation) == pytest.approx(90 - 51.48 - 7.5, abs=0.5)


def test_azimuth_is_from_north_through_east() -> None:
    np.testing.assert_allclose(frames.rays_from_azel(0.0, 0.0), [0, 1, 0], atol=1e-15)
    np.testing.assert_allclose(frames.rays_from_azel(np.pi / 2, 0.0), [1, 0, 0], atol=1e-15)
    np.testing.assert_allclose(frames.rays_from_azel(1.0, np.pi / 2), [0, 0, 1], atol=1e-15)


def test_small_angles_survive() -> None:
    a, b = np.array([1.0, 0, 0]), np.array([1.0, 1e-10, 0])
    assert frames.angle_between_rad(a, b) == pytest.approx(1e-10, rel=1e-6)
    assert np.arccos(a @ b / np.linalg.norm(b)) != pytest.approx(1e-10, rel=1e-6)


def test_longitude_is_east_positive() -> None:
    for body in ("moon", "earth"):
        _, longitude = frames.latlon_from_enu(Site(body, 0.2, 3.1), 1000.0, 0.0, 0.0)
        assert 3.1 < longitude < 3.102
        _, longitude = frames.latlon_from_enu(Site(body, 0.2, 3.5), 0.0, 0.0, 0.0)
        assert longitude == pytest.approx(3.5 - 2 * np.pi)


def test_text_without_suffix_is_utc() -> None:
    assert parse_utc("2026-03-01T12:00:00") == datetime(2026, 3, 1, 12, tzinfo=UTC)


def test_default_mount_of_a_zenith_camera() -> None:
    """Image top is forward, image right is body left, the boresight is body up."""
    np.testing.assert_array_equal(ZENITH_CAMERA.R_body_cam @ [0, -1, 0], [1, 0, 0])
    np.testing.assert_array_equal(ZENITH_CAMERA.R_body_cam @ [1, 0, 0], [0, 1, 0])
    np.testing.assert_array_equal(ZENITH_CAMERA.R_body_cam @ [0, 0, 1], [0, 0, 1])


def test_pixel_origin_is_the_centre_of_the_first_pixel() -> None:
    inside = ZENITH_CAMERA.project(ZENITH_CAMERA.unproject(np.array([[-0.49, -0.49], [200.49, 100.49]])))[1]
    outside = ZENITH_CAMERA.project(ZENITH_CAMERA.unproject(np.array([[-0.51, 0.0], [0.0, 100.51]])))[1]
    assert inside.all()
    assert not outside.any()
    axis_px, _ = ZENITH_CAMERA.project(np.array([0.0, 0.0, 1.0]))
    np.testing.assert_array_equal(axis_px, ZENITH_CAMERA.centre_px)


def test_rays_past_ninety_degrees_are_legal() -> None:
    rays_cam = frames.rays_from_azel(np.radians([80.0, 100, 260, 280]), np.radians([-10.0, -30, -20, 0]))
    px, inside = ZENITH_CAMERA.project(rays_cam)
    assert inside.all()
    assert frames.angle_between_rad(ZENITH_CAMERA.unproject(px), rays_cam).max() < 1e-9
    off_axis_rad = np.linalg.norm(px - ZENITH_CAMERA.centre_px, axis=-1) / 40.0
    np.testing.assert_allclose(off_axis_rad, np.radians([100, 120, 110, 90]), atol=1e-12)


def test_looking_up_east_is_on_the_left() -> None:
    assert np.linalg.det(R_CAM_ENU_NORTH_UP) == pytest.approx(1)
    azimuths = np.radians([0.0, 90.0, 180.0, 270.0])
    rays_cam = frames.rays_from_azel(azimuths, np.radians(60)) @ R_CAM_ENU_NORTH_UP.T
    north, east, south, west = ZENITH_CAMERA.project(rays_cam)[0] - ZENITH_CAMERA.centre_px
    assert north[1] < -20 < 20 < south[1]  # y runs downwards
    assert east[0] < -20 < 20 < west[0]


def test_quaternions_are_xyzw() -> None:
    quarter_turn = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])  # x to y
    np.testing.assert_allclose(frames.quat_xyzw_from_R(quarter_turn), [0, 0, np.sqrt(0.5), np.sqrt(0.5)])
    np.testing.assert_allclose(frames.R_from_quat_xyzw([0, 0, np.sqrt(0.5), np.sqrt(0.5)]), quarter_turn, atol=1e-15)


def test_arrays_are_float64_and_pixels_float32() -> None:
    exposure = types.Exposure(pixels_adu=np.zeros((3, 4), dtype=np.uint16))
    assert exposure.pixels_adu.dtype == np.float32
    assert exposure.size_px == (4, 3)
    body = types.Body(name="x", ray_icrs=np.array([0, 0, 1], dtype=np.float32), v_mag=0.0)
    assert body.ray_icrs.dtype == np.float64
    assert frames.rays_from_azel(np.zeros((2, 5), dtype=np.float32), 0.0).shape == (2, 5, 3)


def test_constants_are_the_published_ones() -> None:
    import erfa

    assert frames.SPEED_OF_LIGHT_M_S == erfa.CMPS
    assert sky.ASTRONOMICAL_UNIT_M == erfa.DAU
    assert frames.MOON_RADIUS_M == 1_737_400  # IAU 2015, and the label of every LOLA map
    equatorial_m, flattening = erfa.eform(erfa.WGS84)
    pole = frames.position_fixed_m(Site("earth", np.pi / 2, 0.0))
    assert pole[2] == pytest.approx(equatorial_m * (1 - flattening), abs=1e-6)


# --- on the source --------------------------------------------------------------------------------------------------


def nodes() -> Iterator[tuple[str, ast.AST]]:
    """Every syntax node of the library with "file:line"."""
    for path in sorted(ROOT.rglob("*.py")):
        name = path.relative_to(ROOT.parent).as_posix()
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            yield f"{name}:{getattr(node, 'lineno', 0)}", node


def arguments(function: ast.FunctionDef) -> list[ast.arg]:
    a = function.args
    return [*a.posonlyargs, *a.args, *a.kwonlyargs]


def test_public_names_keep_to_radians() -> None:
    wrong = []
    for where, node in nodes():
        if isinstance(node, ast.arg) and node.arg in ("theta", "phi"):
            wrong.append(f"{where} {node.arg}")
        if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store) and node.id in ("theta", "phi"):
            wrong.append(f"{where} {node.id}")
        if where.startswith("startrack/cli/"):
            continue
        if isinstance(node, ast.FunctionDef) and not node.name.startswith("_"):
            wrong += [f"{where} {node.name}({a.arg})" for a in arguments(node) if a.arg.endswith("_deg")]
        if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
            fields = [f.target.id for f in node.body if isinstance(f, ast.AnnAssign) and isinstance(f.target, ast.Name)]
            wrong += [f"{where} {node.name}.{name}" for name in fields if name.endswith("_deg")]
    assert not wrong


def test_no_arccos_of_a_dot_product() -> None:
    products = {"dot", "vdot", "inner", "sum", "einsum", "matmul", "vecdot"}

    def is_product(node: ast.AST) -> bool:
        if isinstance(node, ast.BinOp) and isinstance(node.op, ast.MatMult):
            return True
        return isinstance(node, ast.Call) and getattr(node.func, "attr", getattr(node.func, "id", "")) in products

    wrong = [
        where
        for where, node in nodes()
        if isinstance(node, ast.Call)
        and getattr(node.func, "attr", getattr(node.func, "id", "")) in ("arccos", "acos")
        and any(is_product(inner) for argument in node.args for inner in ast.walk(argument))
    ]
    assert not wrong


def test_randomness_is_explicit() -> None:
    wrong = []
    for where, node in nodes():
        if isinstance(node, ast.FunctionDef):
            positional = [a.arg for a in [*node.args.posonlyargs, *node.args.args] if not node.name.startswith("_")]
            defaults = dict(zip([a.arg for a in node.args.kwonlyargs], node.args.kw_defaults, strict=True))
            if "rng" in positional or defaults.get("rng") is not None:
                wrong.append(f"{where} {node.name}: rng is keyword-only, without default")
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute):
            call = ast.unparse(node.func)
            if call.endswith("random.default_rng"):
                if not node.args or all(isinstance(a, ast.Constant) for a in node.args):
                    wrong.append(f"{where} {call}: its seed is the caller's to give")
            elif re.match(r"(np|numpy)\.random\.(?!Generator|SeedSequence|PCG64|Philox)", call):
                wrong.append(f"{where} {call}: hidden global state")
    assert not wrong


UNITS = re.compile(r"_(1|m|s|rad|px|adu|e|mag|m2|px2|rad2|m_s|e_per_s|e_per_adu|e_per_px)$")
# Pure numbers, and names with a frame instead of a unit.
UNITLESS = re.compile(r"^(R_\w+_\w+|rays?_(icrs|enu|cam|body)|\w*(snr|llr|nats|weight|probability|mass))$")


def test_values_name_their_units_and_frames() -> None:
    wrong = []
    for name, value in vars(types).items():
        if not isinstance(value, type) or not issubclass(value, types.Value):
            continue
        for field, kind in getattr(value, "__annotations__", {}).items():
            measured = re.search(r"\b(float|Array|float32)\b", str(kind)) is not None
            if measured and not (UNITS.search(field) or UNITLESS.match(field)):
                wrong.append(f"{name}.{field}")
            if "position" in field and not re.fullmatch(r"position_(enu|mcmf)_m", field):
                wrong.append(f"{name}.{field}: points are position_<frame>_m")
    assert not wrong


def test_the_page_names_tests_that_exist() -> None:
    _title, _rule, *rows = [line for line in PAGE.read_text(encoding="utf-8").splitlines() if line.startswith("|")]
    assert len(rows) == 18
    here: dict[str, Any] = globals()
    for row in rows:
        tests = re.findall(r"`((?:tests/)?test_\w+(?:\.py)?)`", row.rsplit("|", 2)[1])
        assert tests, row
        for test in tests:
            if test.startswith("tests/"):
                assert (ROOT.parent / test).is_file(), test
            else:
                assert callable(here.get(test)), test
