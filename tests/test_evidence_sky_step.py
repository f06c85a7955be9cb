"""The step of the sky brightness at the skyline: measured, subtracted, and not changed where it is not known."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from startrack.camera import Camera, Pinhole, load_camera
from startrack.core.smooth_image import SmoothImage
from startrack.core.types import Detections
from startrack.evidence import height_above_px, measure_sky_step, reliable_azimuths, subtract_sky_step
from startrack.frames import azel_from_rays
from startrack.terrain import load_terrain

CAMERA, CRATER = load_camera("fisheye-2048"), load_terrain("shackleton-thesis")
PLACE = np.array([3000.0, 2000.0])
STEP_E, NOISE_E = 90.0, 10.0
R_CAM_ENU = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]]) * np.array([[1.0], [1.0], [-1.0]])


def horizon_at(place):
    return partial(CRATER.horizon_rad, np.asarray(place)[None, :])


def subtract_step(image, found, horizon):
    found = replace(found, image_e=image)
    step = measure_sky_step(found, CAMERA, R_CAM_ENU, horizon)
    assert step is not None and step.exceeds_noise
    assert step.light_e == pytest.approx(STEP_E, abs=max(4 * step.sigma_e, 0.01 * STEP_E))
    assert 0.05 < step.sigma_e < 0.5
    return subtract_sky_step(found, CAMERA, R_CAM_ENU, horizon)


@pytest.fixture(scope="module")
def frame():
    """A sky of 90 electrons above the wall, blurred by the PSF, as a flat background model sees it."""
    rows, columns = np.mgrid[0:2048, 0:2048]
    xy = np.stack([columns.ravel(), rows.ravel()], axis=1).astype(float)
    azimuth, elevation = azel_from_rays(CAMERA.unproject(xy) @ R_CAM_ENU)
    above = height_above_px(azimuth, elevation, CAMERA, R_CAM_ENU, horizon_at(PLACE))
    above = above.reshape(2048, 2048)
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
    better = subtract_step(image, found, horizon_at(PLACE))
    inner = np.abs(above) < 8
    assert np.sqrt(np.mean((found.background_e - light)[inner] ** 2)) > 30
    assert np.sqrt(np.mean((better.background_e - light)[inner] ** 2)) < 3
    assert np.median(better.noise_e[inner & (above > 1)]) == pytest.approx(15, rel=0.05)
    assert np.median(better.noise_e[inner & (above < -1)]) == pytest.approx(10, rel=0.05)
    assert np.array_equal(better.background_e[np.abs(above) > 13], found.background_e[np.abs(above) > 13])


def test_a_skyline_a_little_off_gives_the_same_background(frame):
    """An error of the fix shifts the profile's origin, not the subtracted step."""
    image, found, above, light = frame
    aside = horizon_at(PLACE + np.array([12.0, -8.0]))
    better = subtract_step(image, found, aside)
    assert np.sqrt(np.mean((better.background_e - light)[np.abs(above) < 6] ** 2)) < 4


def test_distances_from_the_skyline_are_pixels_in_every_lens():
    """A pinhole's pixels are four times finer at 60 degrees off the axis than on it."""
    pinhole = Camera(
        name="pinhole", size_px=(4000, 4000), focal_px=(1000.0, 1000.0), centre_px=(1999.5, 1999.5),
        max_angle_rad=np.radians(62.0), calibrated_angle_rad=np.radians(62.0), lens=Pinhole(),
    )  # fmt: skip
    for skyline_rad in np.radians([30.0, 85.0]):
        horizon = partial(np.full_like, fill_value=skyline_rad)
        px_rad = np.sin(skyline_rad) ** 2 / 1000.0
        elevation = skyline_rad + np.array([11.0, 13.0]) * px_rad
        assert (height_above_px(np.zeros(2), elevation, pinhole, R_CAM_ENU, horizon) < 12.0).tolist() == [True, False]


def test_right_below_a_wall_the_skyline_is_not_known():
    azimuth = np.linspace(0, 2 * np.pi, 360, endpoint=False)
    middle = horizon_at([0.0, 0.0])
    assert reliable_azimuths(middle, [horizon_at([4.0, 0.0]), horizon_at([0.0, 4.0])], CAMERA, R_CAM_ENU)(azimuth).all()
    wall = horizon_at([9850.0, 0.0])
    known = reliable_azimuths(wall, [horizon_at([9852.0, 0.0]), horizon_at([9850.0, 2.0])], CAMERA, R_CAM_ENU)(azimuth)
    assert known[250:290].all()  # the far rim
    along_the_wall = np.r_[0:5, 355:360, 175:185]  # north and south: the skyline changes fastest there
    assert not known[along_the_wall].any()


def test_near_means_pixels():
    azimuth = np.zeros(3)
    height = CRATER.horizon_rad(PLACE[None], np.zeros(1))[0] + np.array([-20, 0, 20]) / 652.0
    above_px = height_above_px(azimuth, height, CAMERA, R_CAM_ENU, horizon_at(PLACE))
    assert (np.abs(above_px) < 12.0).tolist() == [False, True, False]
