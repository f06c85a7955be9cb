"""One contract for every camera; the lenses against scipy, OpenCV and astropy."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import brentq

from startrack.camera import Camera, KannalaBrandt, Pinhole, load_camera
from startrack.frames import angle_between_rad

# Coefficients of the kind that real lenses have: equisolid, stereographic and orthographic laws to ninth order, and
# one whose polynomial turns back not far beyond its image circle.
EQUISOLID_K = (-1 / 24, 1 / 1920, -1 / 322_560, 1 / 92_897_280)
STEREOGRAPHIC_K = (1 / 12, 1 / 120, 17 / 20_160, 31 / 362_880)
TURNING_K = (-0.12, 0.0)  # turns at sqrt(1 / 0.36) rad = 95.49 degrees


def camera(name: str, **changes: object) -> Camera:
    values: dict = {
        "name": name,
        "size_px": (1024, 1024),
        "focal_px": (310.0, 310.0),
        "centre_px": (511.5, 511.5),
        "max_angle_rad": float(np.radians(92.5)),
        "calibrated_angle_rad": float(np.radians(92.0)),
    }
    return Camera(**(values | changes))


CAMERAS = {
    c.name: c
    for c in (
        camera("equidistant"),
        camera("equisolid", lens=KannalaBrandt(EQUISOLID_K), max_angle_rad=float(np.radians(110.0))),
        camera("stereographic", lens=KannalaBrandt(STEREOGRAPHIC_K), focal_px=(250.0, 250.0)),
        camera("near its turning point", lens=KannalaBrandt(TURNING_K), max_angle_rad=float(np.radians(95.0))),
        camera("oblong pixels, off centre", focal_px=(300.0, 320.0), centre_px=(480.25, 530.75), size_px=(1000, 1100)),
        camera("mirrored", mirrored=True, lens=KannalaBrandt(EQUISOLID_K)),
        camera("200 degrees", focal_px=(280.0, 280.0), max_angle_rad=float(np.radians(100.0))),
        camera(
            "pinhole 20 degrees", lens=Pinhole(), focal_px=(2900.0, 2900.0), max_angle_rad=float(np.radians(15.0)),
            calibrated_angle_rad=float(np.radians(15.0)),
        ),
        camera(
            "pinhole 110 degrees, mirrored", lens=Pinhole(), focal_px=(360.0, 365.0), mirrored=True,
            max_angle_rad=float(np.radians(64.0)), calibrated_angle_rad=float(np.radians(64.0)),
        ),
    )
}  # fmt: skip
every_camera = pytest.mark.parametrize("cam", CAMERAS.values(), ids=CAMERAS)


def rays_at(angle_rad: np.ndarray, around_rad: np.ndarray) -> np.ndarray:
    """Rays (..., 3) at angles off the axis; `around_rad` increases from image right to image bottom."""
    side = np.sin(angle_rad)
    return np.stack([side * np.cos(around_rad), side * np.sin(around_rad), np.cos(angle_rad)], axis=-1)


def rays_in(cam: Camera, rng: np.random.Generator, n: int = 4000, edge: float = 1.0) -> np.ndarray:
    """Rays (n, 3) over the image circle, axis and edge included."""
    angle = np.concatenate([[0.0, 1e-12, 1e-7], rng.uniform(0, edge * cam.max_angle_rad, n - 3)])
    return rays_at(angle, rng.uniform(0, 2 * np.pi, n))


@every_camera
def test_rays_survive_the_round_trip(cam: Camera) -> None:
    rays = rays_in(cam, np.random.default_rng(1))
    px, inside = cam.project(rays)
    assert inside.sum() > 1000
    back = cam.unproject(px)
    slope = cam.lens.slope(np.arctan2(np.hypot(rays[:, 0], rays[:, 1]), rays[:, 2]))
    # A pixel coordinate of 1000 is known to 1e-13 px; where the lens law is flat that is a larger angle.
    assert np.all(angle_between_rad(back, rays) <= 1e-12 + 1e-14 / slope)
    assert np.linalg.norm(back, axis=-1) == pytest.approx(1.0, abs=1e-15)


@every_camera
def test_pixels_survive_the_round_trip(cam: Camera) -> None:
    width, height = cam.size_px
    px = np.random.default_rng(2).uniform([-0.5, -0.5], [width - 0.5, height - 0.5], (4000, 2))
    px = np.concatenate([px[cam.angle_rad(px) < cam.max_angle_rad], [cam.centre_px]])
    again, inside = cam.project(cam.unproject(px))
    assert inside.all()
    assert np.abs(again - px).max() < 1e-9


@every_camera
def test_inside_means_within_the_circle_and_the_frame(cam: Camera) -> None:
    around = np.linspace(0, 2 * np.pi, 64)
    angle = min(cam.max_angle_rad, cam.lens.max_invertible_rad)
    wide_frame = replace(cam, size_px=(20_000, 20_000), centre_px=(9999.5, 9999.5))
    assert wide_frame.project(rays_at(np.full(64, angle - 1e-9), around))[1].all()
    assert not wide_frame.project(rays_at(np.full(64, angle + 1e-9), around))[1].any()
    small_frame = replace(cam, size_px=(300, 280), centre_px=(150.0, 141.0), max_angle_rad=angle)
    edge = 0.5 - 1e-6  # the outer edge of the outer pixels
    for x, y in ((-edge, 150.0), (299 + edge, 150.0), (150.0, -edge), (150.0, 279 + edge)):
        assert small_frame.project(small_frame.unproject(np.array([x, y])))[1]
    for x, y in ((-0.501, 150.0), (299.501, 150.0), (150.0, -0.501), (150.0, 279.501)):
        assert not small_frame.project(small_frame.unproject(np.array([x, y])))[1]


@every_camera
def test_rays_behind_are_outside(cam: Camera) -> None:
    px, inside = cam.project(np.array([[0.0, 0.0, -1.0], [0.0, 1e-3, -1.0]]))
    assert not inside.any()
    assert np.isfinite(px).all()


@every_camera
def test_length_of_rays_does_not_matter(cam: Camera) -> None:
    rays = rays_in(cam, np.random.default_rng(3), 200)
    assert cam.project(7.5e3 * rays)[0] == pytest.approx(cam.project(rays)[0], abs=1e-9)


@every_camera
def test_jacobian_is_the_derivative(cam: Camera) -> None:
    from scipy.spatial.transform import Rotation

    rng = np.random.default_rng(4)
    rays = rays_in(cam, rng, 300, edge=0.999)
    jacobian = cam.jacobian_px_per_rad(rays)
    assert jacobian.shape == (300, 2, 3)
    for turn in rng.normal(0, 1e-5, (5, 3)):
        moved = cam.project(Rotation.from_rotvec(turn).apply(rays))[0]
        back = cam.project(Rotation.from_rotvec(-turn).apply(rays))[0]
        assert 0.5 * (moved - back) == pytest.approx(jacobian @ turn, abs=2e-7)  # of about 1e-2 px


@every_camera
def test_solid_angle_is_the_spherical_area_of_the_pixel(cam: Camera) -> None:
    rng = np.random.default_rng(5)
    rays = rays_in(cam, rng, 200, edge=0.9)[3:]
    centre, _ = cam.project(rays)
    half = 0.05  # of a tenth of a pixel: the lens law is straight enough across it
    corners = [cam.unproject(centre + half * np.array(c)) for c in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
    area = _triangle_sr(corners[0], corners[1], corners[2]) + _triangle_sr(corners[0], corners[2], corners[3])
    area *= 100
    angle = np.arctan2(np.hypot(rays[:, 0], rays[:, 1]), rays[:, 2])
    assert cam.pixel_solid_angle_sr(angle) == pytest.approx(area, rel=3e-4)
    assert cam.mean_scale_rad_per_px(angle) == pytest.approx(np.sqrt(area), rel=3e-4)
    on_axis = 1 / (cam.focal_px[0] * cam.focal_px[1])
    assert cam.pixel_solid_angle_sr(np.zeros(1))[0] == pytest.approx(on_axis, rel=1e-9)


def _triangle_sr(a: np.ndarray, b: np.ndarray, c: np.ndarray) -> np.ndarray:
    """Solid angle of spherical triangles (Van Oosterom & Strackee 1983)."""
    volume = np.abs(np.einsum("ni,ni->n", a, np.cross(b, c)))
    cosines = [np.einsum("ni,ni->n", u, v) for u, v in ((a, b), (b, c), (c, a))]
    return 2 * np.arctan2(volume, 1 + sum(cosines))


@every_camera
def test_mirrored_flips_x_about_the_centre(cam: Camera) -> None:
    rays = rays_in(cam, np.random.default_rng(6), 100)
    px = cam.project(rays)[0]
    flipped = replace(cam, mirrored=not cam.mirrored).project(rays)[0]
    assert flipped[:, 0] - cam.centre_px[0] == pytest.approx(cam.centre_px[0] - px[:, 0], abs=1e-9)
    assert flipped[:, 1] == pytest.approx(px[:, 1], abs=1e-9)


@every_camera
@pytest.mark.parametrize("shape", [(), (1,), (0,), (5,), (2, 3), (2, 0, 3)])
def test_batch_shapes(cam: Camera, shape: tuple[int, ...]) -> None:
    rng = np.random.default_rng(7)
    rays = rays_at(rng.uniform(0, cam.max_angle_rad, shape), rng.uniform(0, 6, shape))
    px, inside = cam.project(rays)
    assert px.shape == (*shape, 2)
    assert np.shape(inside) == shape
    assert cam.unproject(px).shape == (*shape, 3)
    assert np.shape(cam.angle_rad(px)) == shape
    assert cam.jacobian_px_per_rad(rays).shape == (*shape, 2, 3)
    each = [cam.project(r)[0] for r in rays.reshape(-1, 3)]
    assert np.array_equal(px.reshape(-1, 2), np.reshape(each, (-1, 2)))


@every_camera
def test_angle_off_the_axis_needs_no_ray(cam: Camera) -> None:
    px = np.random.default_rng(8).uniform(0, 1000, (300, 2))
    px = px[cam.angle_rad(px) < cam.max_angle_rad]
    rays = cam.unproject(px)
    assert cam.angle_rad(px) == pytest.approx(np.arctan2(np.hypot(rays[:, 0], rays[:, 1]), rays[:, 2]), abs=1e-13)


@pytest.mark.parametrize("k", [EQUISOLID_K, STEREOGRAPHIC_K, TURNING_K, (0.1,), (-0.03, 0.0)], ids=str)
def test_inversion_agrees_with_brentq(k: tuple[float, ...]) -> None:
    lens = KannalaBrandt(k)
    top = lens.max_invertible_rad
    for angle in np.linspace(1e-3, 0.9999 * top, 60):
        rho = angle * (1 + sum(c * angle ** (2 * n + 2) for n, c in enumerate(k)))
        root = brentq(lambda a, rho=rho: a * (1 + sum(c * a ** (2 * n + 2) for n, c in enumerate(k))) - rho, 0, top,
                      xtol=1e-15, rtol=1e-15)  # fmt: skip
        assert lens.angle_rad(np.array(rho)) == pytest.approx(root, abs=1e-12 + 1e-15 / lens.slope(np.array(root)))


@settings(max_examples=60, deadline=None)
@given(st.lists(st.floats(-0.2, 0.2), min_size=1, max_size=4), st.floats(0.0, 0.999))
def test_any_polynomial_is_inverted_up_to_its_turning_point(k: list[float], part: float) -> None:
    lens = KannalaBrandt(tuple(k))
    angle = np.array(part * lens.max_invertible_rad)
    assert abs(lens.angle_rad(lens.rho(angle)) - angle) <= 1e-12 + 1e-15 * 20 / lens.slope(angle)


def test_the_turning_point_is_where_the_polynomial_stops_rising() -> None:
    assert KannalaBrandt(TURNING_K).max_invertible_rad == pytest.approx(np.sqrt(1 / 0.36), abs=1e-3)
    assert KannalaBrandt().max_invertible_rad == np.pi


def test_opencv_fisheye_agrees_inside_80_degrees() -> None:
    cv2 = pytest.importorskip("cv2")
    cam = camera("kb", lens=KannalaBrandt(EQUISOLID_K), focal_px=(300.0, 320.0), centre_px=(480.25, 530.75))
    rays = rays_at(*np.random.default_rng(9).uniform([[0.0], [0.0]], [[np.radians(80)], [2 * np.pi]], (2, 500)))
    K = np.array([[300.0, 0, 480.25], [0, 320.0, 530.75], [0, 0, 1]])
    theirs, _ = cv2.fisheye.projectPoints(rays[None], np.zeros(3), np.zeros(3), K, np.array(EQUISOLID_K))
    assert cam.project(rays)[0] == pytest.approx(theirs[0], abs=1e-9)


def test_opencv_pinhole_agrees() -> None:
    cv2 = pytest.importorskip("cv2")
    cam = CAMERAS["pinhole 20 degrees"]
    rays = rays_in(cam, np.random.default_rng(10), 500)
    (fx, fy), (cx, cy) = cam.focal_px, cam.centre_px
    theirs, _ = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]), None)
    assert cam.project(rays)[0] == pytest.approx(theirs[:, 0], abs=1e-8)


def test_astropy_tangent_plane_agrees() -> None:
    from astropy.wcs import WCS

    cam = CAMERAS["pinhole 20 degrees"]
    wcs = WCS(naxis=2)
    wcs.wcs.ctype = ["RA---TAN", "DEC--TAN"]
    wcs.wcs.crval = [50.0, -70.0]
    wcs.wcs.crpix = [cam.centre_px[0] + 1, cam.centre_px[1] + 1]  # FITS counts from 1
    # Seen from inside the sphere with north up, ra grows to the left; image y grows downwards.
    wcs.wcs.cdelt = [-np.degrees(1 / cam.focal_px[0]), -np.degrees(1 / cam.focal_px[1])]
    ra, dec = np.random.default_rng(11).uniform([[35.0], [-74.0]], [[65.0], [-66.0]], (2, 400))
    a, d, a0, d0 = np.radians(ra), np.radians(dec), np.radians(50.0), np.radians(-70.0)
    west_to_right = np.array([np.sin(a0), -np.cos(a0), 0.0])
    north = np.array([-np.sin(d0) * np.cos(a0), -np.sin(d0) * np.sin(a0), np.cos(d0)])
    axis = np.array([np.cos(d0) * np.cos(a0), np.cos(d0) * np.sin(a0), np.sin(d0)])
    stars = np.stack([np.cos(d) * np.cos(a), np.cos(d) * np.sin(a), np.sin(d)], axis=-1)
    px, inside = cam.project(stars @ np.array([west_to_right, -north, axis]).T)
    assert inside.sum() > 100
    assert px[inside] == pytest.approx(wcs.all_world2pix(np.stack([ra, dec], axis=-1), 0)[inside], abs=1e-7)


def test_lens_law_in_the_words_of_the_file_format() -> None:
    # x_px = cx + fx rho cos b, y_px = cy + fy rho sin b; 60 degrees off the axis, straight to the image's lower right
    cam = camera("kb", lens=KannalaBrandt((0.05, -0.01)), focal_px=(300.0, 320.0))
    a, b = np.pi / 3, np.pi / 4
    rho = a + 0.05 * a**3 - 0.01 * a**5
    expected = [511.5 + 300 * rho * np.sqrt(0.5), 511.5 + 320 * rho * np.sqrt(0.5)]
    assert cam.project(rays_at(np.array(a), np.array(b)))[0] == pytest.approx(expected, abs=1e-9)


def test_a_zenith_camera_has_east_on_the_left() -> None:
    cam = load_camera("fisheye-2048")
    # Default mount: body forward (north here) is the image's top, body up is the boresight.
    forward, left, up = cam.R_body_cam  # the body's axes seen in cam: rows, as v_body = R_body_cam @ v_cam
    R_cam_enu = np.stack([-left, forward, up], axis=1)  # east is opposite to the body's left
    east_px, north_px, zenith_px = (cam.project(R_cam_enu @ v)[0] for v in
                                    (np.array([1.0, 0, 1]), np.array([0, 1.0, 1]), np.array([0, 0, 1.0])))  # fmt: skip
    assert zenith_px == pytest.approx(cam.centre_px)
    assert north_px[1] < zenith_px[1] - 400  # top
    assert east_px[0] < zenith_px[0] - 400  # left
