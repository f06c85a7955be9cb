"""The drawn band of pixels about the skyline against the rendered image and the truth; positions by it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from startrack.camera import load_camera
from startrack.catalog import load_catalog
from startrack.chain import Measured, Settings, locate, locate_measured
from startrack.core.types import SECTORS, NotLocated
from startrack.evidence import Skyline, SkylineEstimate, measure_sky_light, pixels_near_skyline, sectors_with_step
from startrack.rendering import Scene, Series, light_e, render
from startrack.simulation import draw_band, draw_camera, simulate_measured, simulate_stars
from startrack.terrain import load_terrain

SKY_MAG = 20.5  # 17 e a pixel: the step is half again the noise


@pytest.fixture(scope="module")
def series() -> Series:
    camera = load_camera("fisheye-2048")
    camera = replace(camera, size_px=(1024, 1024), focal_px=(326.0, 326.0), centre_px=(511.5, 511.5))
    terrain, catalog = load_terrain("shackleton-thesis"), load_catalog().brighter_than(7.5)
    return Series(
        camera=camera, terrain=terrain, catalog=catalog, seed=3, faint_v_mag=None, sky_v_mag_arcsec2=SKY_MAG,
        hot_pixels=0, cosmic_rays=0, exposure_s=0.4,
    )  # fmt: skip


def measure(series: Series, scene: Scene, rng: np.random.Generator) -> Measured:
    return simulate_measured(
        scene, series.catalog, series.terrain, series.camera, time_utc=scene.time_utc, time_sigma_s=None, rng=rng
    )


def test_the_band_has_the_light_and_the_noise_of_the_rendered_image(series: Series):
    scene, rng = series.scene(0)
    sensor = scene.sensor
    stars = simulate_stars(scene, series.catalog, None, time_utc=None, time_sigma_s=1.0, rng=rng)
    pixels_adu, band = draw_band(stars, rng=rng)
    assert 50_000 < np.count_nonzero(band) < 150_000
    assert not pixels_adu[~band].any()
    still = replace(scene, sky_rotvec_rad=np.zeros(3), bodies=())
    mean_e = light_e(still)[band] + sensor.dark_e_per_s * scene.exposure_s
    variance_e2 = mean_e + sensor.read_noise_e**2 + sensor.gain_e_per_adu**2 / 12
    z = ((pixels_adu[band] - sensor.bias_adu) * sensor.gain_e_per_adu - mean_e) / np.sqrt(variance_e2)
    assert np.mean(z) == pytest.approx(0.0, abs=5 / np.sqrt(len(z)))
    assert np.mean(np.square(z)) == pytest.approx(1.0, abs=0.03)


@pytest.mark.parametrize(("raised_px", "bias_px", "chi2"), [(0.0, 0.015, 1.01), (1.5, 0.087, 2.98)])
def test_the_skyline_of_the_band_is_measured_as_that_of_images(
    series: Series, raised_px: float, bias_px: float, chi2: float
):
    """Against the true skyline, and beside one that is too high. `bias_px` and `chi2`: of six images rendered whole."""
    off, squares, used = [], [], 0
    for number in range(8):
        scene, rng = series.scene(number)
        measured = measure(series, scene, rng)
        true = Skyline.trace(scene.position_enu_m[:2], series.terrain)
        horizon = Skyline(true.elevation_rad + raised_px / series.camera.focal_px[0])
        near = SkylineEstimate(horizon, np.zeros(SECTORS))
        band = pixels_near_skyline(measured.detections, series.camera, scene.R_cam_enu, near)
        sky = measure_sky_light(band.without_stars(measured.photometry), horizon)
        good = sectors_with_step(sky)
        error_px = (sky.shift_px + raised_px * sky.px_per_rad / series.camera.focal_px[0])[good]
        off.append(np.average(error_px, weights=1.0 / sky.variance_px2[good]))
        squares.append(np.mean(np.square(error_px / sky.shift_sigma_px[good])))
        used += np.count_nonzero(good)
    assert used > 1600  # of 1920 sectors
    assert np.mean(off) == pytest.approx(bias_px, abs=0.025)
    assert np.mean(squares) == pytest.approx(chi2, rel=0.12)


def test_the_attitude_errs_as_it_states(series: Series):
    nees = []
    for number in range(12):
        scene, rng = series.scene(number)
        attitude = measure(series, scene, rng).attitude_fit.attitude
        error = Rotation.from_matrix(scene.R_cam_icrs @ attitude.R_cam_icrs.T).as_rotvec()
        nees.append(error @ np.linalg.solve(attitude.covariance_rad2, error))
    assert 1.4 < np.mean(nees) < 5.1  # 3 is expected; its standard error is 0.7


def test_a_lens_is_drawn_from_its_stated_covariance(series: Series):
    order, covariance = ("fx", "fy", "cx", "k1"), np.diag([1.0, 4.0, 0.25, 1e-6])
    covariance[0, 1] = covariance[1, 0] = 1.5
    stated = replace(series.camera, covariance_order=order, covariance=covariance)
    rng = np.random.default_rng(5)
    drawn = [draw_camera(stated, rng=rng) for _ in range(2000)]
    values = np.array([[*one.focal_px, one.centre_px[0], one.lens.k[0]] for one in drawn])
    assert np.cov(values.T) == pytest.approx(covariance, rel=0.15, abs=0.07)
    assert draw_camera(series.camera, rng=rng) is series.camera


def test_the_corrected_lens_of_a_draw_is_the_true_one(series: Series):
    """A centre 0.6 px off where 1 px is stated: the stars show it, and the skyline is measured rightly."""
    stated = replace(series.camera, covariance_order=("cx", "cy"), covariance=np.eye(2))
    scene, rng = series.scene(1)
    true = replace(series.camera, centre_px=(512.1, 511.5))
    measured = simulate_measured(
        replace(scene, camera=true), series.catalog, series.terrain, stated, time_utc=scene.time_utc,
        time_sigma_s=None, rng=rng,
    )  # fmt: skip
    rays = np.array([[np.sin(a) * np.cos(b), np.sin(a) * np.sin(b), np.cos(a)] for a in (0.4, 1.3) for b in range(6)])
    by_truth, _ = true.project(rays)
    turned = rays @ (measured.attitude_fit.attitude.R_cam_icrs @ scene.R_cam_icrs.T).T
    found, _ = measured.camera.project(turned)
    assert np.hypot(*(found - by_truth).T).max() < 0.1


@pytest.mark.parametrize("sky_mag", [None, 26.0])
def test_without_light_of_the_sky_the_stars_count_alone(series: Series, sky_mag: float | None):
    scene, rng = series.scene(2)
    located = locate_measured(measure(series, replace(scene, sky_v_mag_arcsec2=sky_mag), rng), Settings())
    assert located.evidence_source == "stars"
    assert "no step of light" in located.sky_unused
    error_m = np.linalg.norm((located.fix.position_enu_m - scene.position_enu_m)[:2])
    assert error_m < located.fix.radius999_m


def test_without_the_skyline_in_view_there_is_no_position(series: Series):
    narrow = replace(series, camera=replace(series.camera, max_angle_rad=0.7, calibrated_angle_rad=0.69))
    scene, rng = narrow.scene(2)
    measured = measure(narrow, scene, rng)
    assert measured.detections.dead.all()
    with pytest.raises(NotLocated):
        locate_measured(measured, Settings())


@pytest.mark.slow
def test_positions_by_drawn_stars_and_sky_err_as_they_state(series: Series):
    """And are as certain as those of rendered images, of a sky so bright that stars near the skyline are measured
    again.
    """
    nees, radii = [], []
    for number in range(24):
        scene, rng = series.scene(number)
        located = locate_measured(measure(series, scene, rng), Settings())
        assert located.evidence_source == "both"
        off = (located.fix.position_enu_m - scene.position_enu_m)[:2]
        nees.append(off @ np.linalg.solve(located.fix.covariance_m2, off))
        if number < 6:
            image, _ = render(scene, rng=rng)
            image = replace(image, time_sigma_is_stated=False, time_sigma_s=1.0)
            rendered = locate(image, series.camera, series.terrain, series.catalog)
            radii.append((located.fix.radius95_m, rendered.fix.radius95_m))
    assert 1.1 < np.mean(nees) < 3.2  # 2 is expected; its standard error is 0.41
    drawn, rendered = np.log(radii).mean(axis=0)
    assert np.exp(drawn - rendered) == pytest.approx(1.0, abs=0.25)
