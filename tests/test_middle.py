"""The sky at the middle of a picture, and what of a lens that was found with the stars shows."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from astropy.io import fits
from astropy.wcs import WCS
from scipy.spatial.transform import Rotation
from stage_helpers import as_stage
from star_painter import paint
from test_unknown_lens import SIZE, lens_camera, picture, sky

from startrack.api.centroids import identify_centroids
from startrack.camera import Camera, Decentring, KannalaBrandt, Pinhole
from startrack.catalog import load_catalog
from startrack.chain import Oriented, identify_blind
from startrack.core.types import Exposure, NotIdentified
from startrack.estimation.adjust import observations_of_image
from startrack.estimation.attitude import solve_attitude
from startrack.estimation.lens_correction import solve_with_misfit
from startrack.exposure import read_exposure
from startrack.identification.unknown_lens import identify_unknown_lens
from startrack.identification.verify_unknown_lens import fit_found_lens
from startrack.output import result_dict
from startrack.output.values import has_middle, sky_at_middle
from startrack.output.wcs import wcs_bytes

MIDDLE_PX = (np.array(SIZE) - 1) / 2
CENTRE_PX = (float(MIDDLE_PX[0]), float(MIDDLE_PX[1]))


def oriented(camera: Camera, xy_px: np.ndarray, rays: np.ndarray, R: np.ndarray) -> Any:
    """What `sky_at_middle` takes of a value without a time: camera and attitude of stars with errors of 0.2 px."""
    fit = solve_attitude(camera, xy_px, np.tile(0.04 * np.eye(2), (len(rays), 1, 1)), rays, R)
    return SimpleNamespace(
        camera=camera, attitude_fit=fit, attitude=fit.attitude, exposure=SimpleNamespace(time_utc=None), site=None
    )


def off_sigmas(value: Any, camera: Camera, R: np.ndarray) -> float:
    """Distance of the sky at the middle from the true one, in sigmas of one axis."""
    found, true = sky_at_middle(value), camera.unproject(MIDDLE_PX) @ R
    ra, dec = found.ra_rad, found.dec_rad
    ray = np.array([np.cos(dec) * np.cos(ra), np.cos(dec) * np.sin(ra), np.sin(dec)])
    return float(np.linalg.norm(np.cross(ray, true)) / found.sigma_rad)


def fitted(fov: float, off: np.ndarray, aspect: float, rng: np.random.Generator) -> tuple[Camera, Camera, float]:
    """A true camera of `fov` degrees, the one fitted to 90 of its stars, and how far off the middle is in sigmas."""
    true = lens_camera(Pinhole(), fov, 700, off=(float(off[0]), float(off[1])))
    true = replace(
        true, focal_px=(true.focal_px[0] * aspect, true.focal_px[0]), decentring=Decentring(*rng.normal(0, 1e-3, 2))
    )
    R = Rotation.random(random_state=rng).as_matrix()
    rays_cam = true.unproject(rng.uniform(0, 1, (90, 2)) * SIZE)
    rays, xy = rays_cam @ R, true.project_unlimited(rays_cam) + rng.normal(0, 0.2, (90, 2))
    points = observations_of_image(xy, np.tile(0.04 * np.eye(2), (90, 1, 1)), rays)
    start = replace(true, centre_px=CENTRE_PX, focal_px=(true.focal_px[1],) * 2, decentring=Decentring())
    camera, R_found = fit_found_lens(start, R, points, CENTRE_PX)
    return true, camera, off_sigmas(oriented(camera, xy, rays, R_found), true, R)


def test_the_middle_is_that_of_the_world_coordinates_by_astropy(located) -> None:
    value = as_stage(located.result, Oriented, terrain=None)
    header = fits.Header.fromstring(wcs_bytes(value).decode("ascii"))
    world = WCS(header)
    found = result_dict(value, "identification")["middle"]
    x, y = found["x_px"], found["y_px"]
    assert (x, y) == ((value.camera.size_px[0] - 1) / 2, (value.camera.size_px[1] - 1) / 2)
    here, above, right = world.pixel_to_world([x, x, x + 1], [y, y - 1, y])
    # The world coordinates take out the mean aberration of the whole frame alone.
    assert here.ra.deg == pytest.approx(found["ra_deg"], abs=0.02)
    assert here.dec.deg == pytest.approx(found["dec_deg"], abs=0.006)
    assert here.position_angle(above).deg == pytest.approx(found["rotation_deg"], abs=0.05)
    sides = here.separation(above).arcsec, here.separation(right).arcsec
    assert np.sqrt(sides[0] * sides[1]) == pytest.approx(found["scale_arcsec_per_px"], rel=1e-3)
    assert 0.0 < found["sigma_deg"] < 0.01


def test_a_middle_beyond_the_lens_is_null(located) -> None:
    value = as_stage(located.result, Oriented, terrain=None)
    camera = replace(value.camera, centre_px=(0.0, 0.0), max_angle_rad=0.2)
    away = replace(value, camera=camera)
    assert not has_middle(away)
    assert result_dict(away, "identification")["middle"] is None
    assert result_dict(away, "identification")["attitude"] is not None


def test_without_a_time_the_middle_is_a_minute_of_arc_wider(located) -> None:
    value = as_stage(located.result, Oriented, terrain=None)
    timeless = replace(value, exposure=replace(value.exposure, time_utc=None))
    sigma = [sky_at_middle(one).sigma_rad for one in (value, timeless)]
    assert np.sqrt(sigma[1] ** 2 - sigma[0] ** 2) == pytest.approx(np.radians(1 / 60), rel=0.01)


@pytest.mark.parametrize(("fov", "aspect"), [(8.0, 1.0), (11.0, 0.97), (25.0, 1.0)])
def test_the_sigmas_of_a_narrow_lens_hold(fov: float, aspect: float) -> None:
    """Middle, centre and ratio of the focal lengths, whether they show or not."""
    rng = np.random.default_rng([int(fov), 3])
    middle, centre, ratio = [], [], []
    for _ in range(40):
        true, camera, off = fitted(fov, rng.normal(0, 40, 2), aspect, rng)
        at = {name: k for k, name in enumerate(camera.covariance_order)}
        assert camera.covariance is not None
        sigma = np.sqrt(np.diag(camera.covariance))
        middle.append(off)
        centre += [(camera.centre_px[k] - true.centre_px[k]) / sigma[at[name]] for k, name in enumerate(("cx", "cy"))]
        by_focal = np.array([1.0, -1.0]) / camera.focal_px
        error = np.sqrt(by_focal @ camera.covariance[:2, :2] @ by_focal)
        ratio.append((camera.focal_px[0] / camera.focal_px[1] / aspect - 1.0) / error)
    assert 0.7 < np.sqrt(np.mean(np.square(middle)) / 2) < 1.25
    assert max(middle) < 4.0
    assert np.sqrt(np.mean(np.square(centre))) < 1.4
    assert np.abs(centre).max() < 4.0
    assert np.sqrt(np.mean(np.square(ratio))) < 1.25


def bent(size_px: float, rng: np.random.Generator) -> tuple[float, float]:
    """Distance of the middle of a bent picture in sigmas, and these sigmas over those by independent errors alone.

    A pinhole of 11 degrees displaces 130 stars by waves of half the frame and longer; its true middle is moved, too.
    """
    true, n = lens_camera(Pinhole(), 11.0, 700), 130
    waves, phase = rng.normal(0, 0.4, (40, 2)) * 2 * np.pi / SIZE, rng.uniform(0, 2 * np.pi, 40)
    by_wave = size_px * rng.normal(0, 1, (40, 2)) / np.sqrt(20)
    R = Rotation.random(random_state=rng).as_matrix()
    px = rng.uniform(0, 1, (n, 2)) * SIZE
    rays, covariance = true.unproject(px) @ R, np.tile(0.04 * np.eye(2), (n, 1, 1))
    xy = px + np.sin(px @ waves.T + phase) @ by_wave + rng.normal(0, 0.2, (n, 2))
    camera, R_found = fit_found_lens(true, R, observations_of_image(xy, covariance, rays), CENTRE_PX)
    before = oriented(camera, xy, rays, R_found)
    camera, fit = solve_with_misfit(camera, xy, covariance, rays, R_found)
    value = SimpleNamespace(
        camera=camera, attitude_fit=fit, attitude=fit.attitude, exposure=before.exposure, site=None
    )  # fmt: skip
    shift = np.sin(MIDDLE_PX @ waves.T + phase) @ by_wave
    moved = replace(true, centre_px=(true.centre_px[0] + shift[0], true.centre_px[1] + shift[1]))
    return off_sigmas(value, moved, R), sky_at_middle(value).sigma_rad / sky_at_middle(before).sigma_rad


def test_a_bent_picture_has_a_wider_sigma_and_a_straight_one_has_not() -> None:
    rng = np.random.default_rng(8)
    straight, crooked = (np.array([bent(size_px, rng) for _ in range(6)]) for size_px in (0.0, 0.3))
    assert np.all((straight[:, 1] >= 1.0) & (straight[:, 1] < 1.2))
    assert np.median(crooked[:, 1]) > 1.3
    assert np.all(crooked[:, 0] < 4.0)


@pytest.mark.slow
@pytest.mark.parametrize("size_px", [0.0, 0.1, 0.2, 0.3])
def test_the_sigma_of_the_middle_holds_what_the_lens_does_not(size_px: float) -> None:
    rng = np.random.default_rng([int(100 * size_px), 1])
    off, wider = np.array([bent(size_px, rng) for _ in range(60)]).T
    assert np.mean(off < 3.0) >= 0.95
    assert np.sqrt(np.mean(off**2) / 2) < 1.3
    if size_px == 0.0:
        assert np.median(wider) < 1.05
        assert np.quantile(wider, 0.9) < 1.2


def test_a_centre_that_does_not_show_stays_in_the_middle() -> None:
    rng = np.random.default_rng(5)
    lenses = {fov: [fitted(fov, np.array([15.0, -10.0]), 1.0, rng)[1] for _ in range(10)] for fov in (8.0, 60.0)}
    assert sum(camera.centre_px == CENTRE_PX for camera in lenses[8.0]) >= 9
    assert not any(camera.centre_px == CENTRE_PX for camera in lenses[60.0])
    for camera in lenses[8.0]:
        assert camera.covariance is not None
        assert np.sqrt(camera.covariance[2, 2]) > 15.0
        assert camera.focal_px[0] == camera.focal_px[1]


@pytest.mark.parametrize(
    ("lens", "fov", "radius_px", "limit", "aspect"),
    [(Pinhole(), 16, 700, 7.0, 0.98), (KannalaBrandt((-0.04, 0.003, 0.0, 0.0)), 180, 520, 5.0, 0.96)],
)
def test_pixels_that_are_not_square_are_found_with_the_lens(
    lens: Any, fov: float, radius_px: float, limit: float, aspect: float
) -> None:
    true = lens_camera(lens, fov, radius_px, off=(12.0, -8.0))
    true = replace(true, focal_px=(true.focal_px[0] * aspect, true.focal_px[0]), max_angle_rad=np.radians(fov))
    seen, truth, R = picture(true, seed=6, limit=limit, hidden=0.1)
    found = identify_unknown_lens(seen, SIZE, np.radians(fov), sky())
    names, camera = found.identification, found.camera
    assert np.mean(truth[names.detection] == names.star) >= 0.96
    assert np.count_nonzero(truth[names.detection] == names.star) > 0.8 * np.count_nonzero(truth >= 0)
    assert camera.focal_px[0] / camera.focal_px[1] == pytest.approx(aspect, abs=5e-4)
    stars = sky().rays_icrs[names.star]
    assert off_sigmas(oriented(camera, seen.xy_px[names.detection], stars, names.R_cam_icrs), true, R) < 3.5
    at = [camera.covariance_order.index(name) for name in ("cx", "cy")]
    assert camera.covariance is not None
    sigma_px = np.sqrt(np.diag(camera.covariance)[at])
    assert np.all(np.abs(np.array(camera.centre_px) - true.centre_px) < 3.5 * sigma_px)


@pytest.mark.slow
@pytest.mark.parametrize("aspect", [0.9, 0.95, 1.067, 45 / 64])
def test_a_narrow_picture_that_was_stretched_is_solved(aspect: float) -> None:
    true = lens_camera(Pinhole(), 14, 700)
    true = replace(true, focal_px=(true.focal_px[0], true.focal_px[0] / aspect), max_angle_rad=0.4)
    seen, truth, R = picture(true, seed=9, limit=8.5, hidden=0.0, false=0.1)
    found = identify_unknown_lens(seen, SIZE, np.radians(14), sky())
    names, camera = found.identification, found.camera
    assert np.mean(truth[names.detection] == names.star) >= 0.96
    assert camera.focal_px[0] / camera.focal_px[1] == pytest.approx(aspect, rel=1e-3)
    stars = sky().rays_icrs[names.star]
    assert off_sigmas(oriented(camera, seen.xy_px[names.detection], stars, names.R_cam_icrs), true, R) < 3.5


@pytest.mark.slow
def test_a_frame_and_its_jpeg_agree_within_their_sigmas(tmp_path) -> None:
    import cv2

    camera = lens_camera(Pinhole(), 12, 700, off=(20.0, 10.0))
    rng = np.random.default_rng(11)
    R = Rotation.random(random_state=rng).as_matrix()
    px, inside = camera.project(sky().rays_icrs @ R.T)
    inside &= sky().v_mag < 9.0
    image = np.full(SIZE[::-1], 20.0)
    paint(image, px[inside], 10 ** (-0.4 * (sky().v_mag[inside] - 13.5)), 1.0)
    counts = np.clip(np.rint(image + rng.normal(0, 2.0, image.shape)), 0, 255).astype(np.uint8)
    content = cv2.imencode(".jpg", counts, [cv2.IMWRITE_JPEG_QUALITY, 85])[1].tobytes()
    jpeg = tmp_path / "frame.jpg"
    jpeg.write_bytes(content)
    plain = Exposure(pixels_adu=counts.astype(np.float32), saturation_adu=255.0)
    found = []
    for exposure in (plain, read_exposure(jpeg)):
        value = identify_blind(exposure, np.radians(12.0), load_catalog())
        assert isinstance(value, Oriented)
        assert off_sigmas(value, camera, R) < 3.0
        found.append(value)
    axes = [value.attitude.R_cam_icrs[2] for value in found]
    sigma = np.sqrt(sum(np.trace(value.attitude.covariance_rad2[:2, :2]) / 2 for value in found))
    assert np.linalg.norm(np.cross(*axes)) < 3.0 * sigma


@pytest.mark.parametrize(("fov", "smallest"), [(12.0, 0.7), (60.0, 0.79)])
def test_a_refusal_states_the_ratios_that_were_tried(fov: float, smallest: float) -> None:
    xy_px = np.random.default_rng(1).uniform(0, 1, (40, 2)) * SIZE
    with pytest.raises(NotIdentified) as refused:
        identify_centroids(xy_px, fov_rad=np.radians(fov), size_px=SIZE)
    text = f" with square pixels and with fx / fy from {smallest:.2g} to 1.27 tried"
    assert text in str(refused.value)
