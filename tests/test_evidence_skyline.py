"""The skyline in the image: pixels above it, the step of the sky brightness there, and where it is not known."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest

from startrack.camera import Camera, Pinhole, load_camera
from startrack.core.types import MIDDLES_RAD, SECTORS, Detections, SmoothImage, sector_of
from startrack.evidence import (
    Skyline,
    SkylineEstimate,
    exceeds_noise,
    measure_sky_light,
    pixels_near_skyline,
    take_out_sky_step,
)
from startrack.evidence.skyline import scale_across
from startrack.frames import azel_from_rays
from startrack.terrain import load_terrain

CAMERA, CRATER = load_camera("fisheye-2048"), load_terrain("shackleton-thesis")
PLACE = np.array([3000.0, 2000.0])
NO_STARS = SimpleNamespace(xy_px=np.empty((0, 2)), expected_e=np.empty(0))
STEP_E, NOISE_E = 90.0, 10.0
R_CAM_ENU = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]]) * np.array([[1.0], [1.0], [-1.0]])


def horizon_at(place):
    return partial(CRATER.horizon_rad, np.asarray(place)[None, :])


def take_out_step(image, found, place):
    near = SkylineEstimate(Skyline.trace(np.asarray(place), CRATER), np.zeros(SECTORS))
    band = pixels_near_skyline(replace(found, image_e=image), CAMERA, R_CAM_ENU, near)
    sky = measure_sky_light(band.without_stars(NO_STARS), near.skyline)
    step_e, sigma_e = sky.levels.mean_step_e(sky.levels.covered)
    assert sky.levels.covered.all() and exceeds_noise(sky)
    assert step_e == pytest.approx(STEP_E, abs=max(4 * sigma_e, 0.01 * STEP_E))
    assert 0.02 < sigma_e < 0.5
    return take_out_sky_step(band, sky)


@pytest.fixture(scope="module")
def frame():
    """A sky of 90 electrons above the wall, blurred by the PSF, as a flat background model sees it."""
    rows, columns = np.mgrid[0:2048, 0:2048]
    xy = np.stack([columns.ravel(), rows.ravel()], axis=1).astype(float)
    azimuth, elevation = azel_from_rays(CAMERA.unproject(xy) @ R_CAM_ENU)
    scale = scale_across(CAMERA, R_CAM_ENU, horizon_at(PLACE))(azimuth)
    above = ((elevation - horizon_at(PLACE)(azimuth)) * scale).reshape(2048, 2048)
    rng = np.random.default_rng(5)
    light = STEP_E / (1 + np.exp(np.clip(-above / 0.6, -50, 50)))
    noise = NOISE_E * np.where(above > 0, 1.5, 1.0)
    image = (light + noise * rng.standard_normal(light.shape)).astype(np.float32)
    found = Detections(
        xy_px=np.empty((0, 2)), covariance_px2=np.empty((0, 2, 2)), flux_e=np.empty(0), flux_sigma_e=np.empty(0),
        snr=np.empty(0), saturated=np.empty(0, dtype=bool), psf_sigma_px=1.0,
        image_e=image, dead=np.zeros(image.shape, bool),
        background=SmoothImage.of(np.full(image.shape, STEP_E / 2, np.float32)),
        noise=SmoothImage.of(np.full(image.shape, NOISE_E, np.float32)),
    )  # fmt: skip
    return image, found, above, light


def test_the_step_is_subtracted_and_each_side_has_its_own_noise(frame):
    image, found, above, light = frame
    better = take_out_step(image, found, PLACE)
    inner = np.abs(above) < 8
    assert np.sqrt(np.mean((found.background_e - light)[inner] ** 2)) > 30
    assert np.sqrt(np.mean((better.background_e - light)[inner] ** 2)) < 3
    assert np.median(better.noise_e[inner & (above > 1)]) == pytest.approx(15, rel=0.05)
    assert np.median(better.noise_e[inner & (above < -1)]) == pytest.approx(10, rel=0.05)
    assert np.array_equal(better.background_e[np.abs(above) > 13], found.background_e[np.abs(above) > 13])


def test_a_skyline_a_little_off_gives_the_same_background(frame):
    """The step is where the image shows it."""
    image, found, above, light = frame
    better = take_out_step(image, found, PLACE + np.array([12.0, -8.0]))
    assert np.sqrt(np.mean((better.background_e - light)[np.abs(above) < 6] ** 2)) < 4


def test_distances_from_the_skyline_are_pixels_in_every_lens():
    """A pinhole's pixels are four times finer at 60 degrees off the axis than on it."""
    pinhole = Camera(
        name="pinhole", size_px=(4000, 4000), focal_px=(1000.0, 1000.0), centre_px=(1999.5, 1999.5),
        max_angle_rad=np.radians(62.0), calibrated_angle_rad=np.radians(62.0), lens=Pinhole(),
    )  # fmt: skip
    for skyline_rad in np.radians([30.0, 85.0]):
        scale = scale_across(pinhole, R_CAM_ENU, partial(np.full_like, fill_value=skyline_rad))
        assert scale(np.linspace(0, 6, 50)) == pytest.approx(1000.0 / np.sin(skyline_rad) ** 2, rel=1e-3)


def test_right_below_a_wall_the_skyline_is_not_known():
    """A sigma of the position of four metres in the middle, and of two metres at the wall."""
    middle = SkylineEstimate.of(np.zeros(2), 16.0 * np.eye(2), CRATER, None)
    wall = SkylineEstimate.of(np.array([9850.0, 0.0]), 4.0 * np.eye(2), CRATER, None)
    px = CAMERA.focal_px[0]
    assert (middle.sigma_rad * px < 0.7).all() and middle.is_level(np.linspace(0, 2 * np.pi, 360, endpoint=False)).all()
    assert (wall.sigma_rad * px < 0.7)[167:193].all()  # the far rim
    along_the_wall = np.r_[0:3, 237:240, 117:123]  # north and south: the skyline changes fastest there
    assert not ((wall.sigma_rad * px < 0.7)[along_the_wall] & wall.is_level(MIDDLES_RAD[along_the_wall])).any()


def test_the_estimate_is_raised_by_the_errors_that_a_fix_shows():
    raised = 1e-3 * (1.0 + np.sin(MIDDLES_RAD))
    plain, higher = (SkylineEstimate.of(PLACE, np.eye(2), CRATER, by) for by in (None, raised))
    assert higher.skyline(MIDDLES_RAD) - plain.skyline(MIDDLES_RAD) == pytest.approx(raised, abs=1e-6)
    assert np.array_equal(higher.sigma_rad, plain.sigma_rad)


def test_stars_move_across_the_skyline_by_its_slope_and_their_rise():
    """A turn about the zenith moves them along a wave by its slope; one about the east, straight up in the north."""
    azimuth = np.linspace(0.0, 2 * np.pi, 7200, endpoint=False)
    waved = SkylineEstimate(Skyline(0.1 + 0.02 * np.sin(4 * azimuth)), np.zeros(SECTORS))
    about_zenith = waved.star_motion_rad(np.array([0.0, 0.0, 2e-3]))
    assert about_zenith == pytest.approx(2e-3 * 0.08 * np.abs(np.cos(4 * MIDDLES_RAD)), abs=3e-6)
    level = SkylineEstimate(Skyline(np.full(7200, 0.1)), np.zeros(SECTORS))
    about_east = level.star_motion_rad(np.array([2e-3, 0.0, 0.0]))
    assert about_east == pytest.approx(2e-3 * np.abs(np.cos(MIDDLES_RAD)), abs=2e-5)
    jumping = SkylineEstimate(Skyline(np.where(azimuth < np.pi + 0.013, 0.1, 0.3)), np.zeros(SECTORS))
    assert (jumping.star_motion_rad(np.array([0.0, 0.0, 2e-3])) < 1e-12).all()


def test_the_rows_of_moving_stars_have_the_spread_of_their_way(located):
    motion = 1e-4 * (1.0 + MIDDLES_RAD)
    rows = located.result.photometry.moving(motion).evidence()
    assert rows.edge_sigma_rad == pytest.approx(motion[sector_of(rows.azimuth_rad)] / np.sqrt(12.0))
    later = located.result.later(60.0, 1.0).photometry.moving(motion)
    assert len(later.evidence()) == len(rows)
