"""Zero point, vignetting, gain, noise, PSF, hot pixels: from rendered frames whose sensor is known."""

from __future__ import annotations

import re
from dataclasses import replace
from datetime import UTC, datetime, timedelta

import numpy as np
import pytest

from startrack.applications.calibration import KnownSensor, calibrate
from startrack.applications.calibration.sensor import fit_photon_transfer, measure_photometry
from startrack.applications.calibration.throughput import StarFluxes, fit_throughput
from startrack.camera import Camera, KannalaBrandt, Sensor, cap_grid, difference_px
from startrack.catalog import load_catalog
from startrack.core.types import Exposure
from startrack.frames import airmass
from startrack.rendering import Series, render
from startrack.terrain import load_terrain

SENSOR = Sensor(
    zero_point_e_per_s=9000.0, gain_e_per_adu=0.5, bias_adu=200.0, read_noise_e=6.0, dark_e_per_s=0.1,
    psf_sigma_px=1.1, vignetting=(-0.15, -0.02),
)  # fmt: skip
CAMERA = Camera(
    name="truth", size_px=(600, 600), focal_px=(179.0, 179.0), centre_px=(302.2, 297.9), max_angle_rad=np.radians(91),
    calibrated_angle_rad=np.radians(90), lens=KannalaBrandt((-1 / 24, 1 / 1920)), sensor=SENSOR,
)  # fmt: skip
EXPOSURE_S = 10.0


@pytest.fixture(scope="module")
def frames():
    """Two frames of one sky and one 30 hours later, on open ground, and the hot pixels with their charge [e]."""
    start = datetime(2030, 6, 1, tzinfo=UTC)
    exposures = []
    for number, later in enumerate((timedelta(0), timedelta(0), timedelta(hours=30))):
        series = Series(
            camera=CAMERA, terrain=load_terrain("shackleton-thesis"), catalog=load_catalog().brighter_than(7.5), seed=4,
            exposure_s=EXPOSURE_S, time_utc=start + later, east_m=0.0, north_m=0.0, heading_rad=0.3, pitch_rad=0.2,
            roll_rad=0.0, sky_v_mag_arcsec2=20.0, sky_gradient=0.8, hot_pixels=60, faint_v_mag=None,
        )  # fmt: skip
        scene, rng = series.scene(number, f"frame{number}")
        exposures.append(render(replace(scene, terrain=None), rng=rng)[0])
    hot = scene.hot_pixels
    return exposures, dict(zip(map(tuple, hot.xy_px.tolist()), hot.dark_e_per_s * EXPOSURE_S, strict=True))


@pytest.fixture(scope="module")
def calibration(frames):
    rough = replace(CAMERA, focal_px=(184.0, 184.0), centre_px=(299.5, 299.5), lens=KannalaBrandt(), sensor=None)
    return calibrate(frames[0], load_catalog().brighter_than(8.0), camera=rough)


@pytest.mark.slow
def test_the_lens_is_the_true_one(calibration):
    assert calibration.accepted, calibration.failed_checks
    moved = difference_px(CAMERA, calibration.camera, cap_grid(calibration.camera.calibrated_angle_rad))
    assert np.sqrt(np.mean(np.sum(moved**2, axis=1))) < 0.03


def test_the_sensor_is_the_true_one(calibration):
    sensor = calibration.camera.sensor
    assert sensor.gain_e_per_adu == pytest.approx(0.5, rel=0.02)
    assert sensor.zero_point_e_per_s == pytest.approx(9000, rel=0.04)
    assert sensor.bias_adu == pytest.approx(202, abs=1)  # dark current of 10 s is in it
    assert sensor.read_noise_e == pytest.approx(6.0, rel=0.15)
    assert sensor.psf_sigma_px == pytest.approx(1.1, rel=0.03)
    angle = np.radians([30, 60, 85])
    np.testing.assert_allclose(sensor.throughput(angle), SENSOR.throughput(angle), atol=0.03)
    assert calibration.photometry.properties.psf_by_ring_px == pytest.approx([1.1] * 4, rel=0.06)


def test_hot_pixels_are_listed(frames, calibration):
    listed = {(int(x), int(y)) for x, y in calibration.photometry.properties.hot_px}
    bright = {px for px, light_e in frames[1].items() if light_e > 400}  # 12 times the noise of the brightest sky
    assert len(bright) >= 20
    assert len(listed & bright) >= 0.9 * len(bright)
    assert len(listed - set(frames[1])) <= 3


def test_given_values_replace_measured_ones(calibration):
    given = measure_photometry(
        calibration.joint, KnownSensor(gain_e_per_adu=0.7, read_noise_e=9.0, bias_adu=190.0)
    ).sensor
    assert (given.gain_e_per_adu, given.read_noise_e, given.bias_adu) == (0.7, 9.0, 190.0)


def test_without_exposure_times_no_zero_point_is_invented(calibration):
    blind = tuple(replace(f, exposure=replace(f.exposure, exposure_s=None)) for f in calibration.joint.frames)
    missing = measure_photometry(replace(calibration.joint, frames=blind), KnownSensor())
    assert missing.throughput is None
    assert missing.sensor is None
    assert any(re.match("zero point: not measured", note) for note in missing.notes)


def test_photon_transfer_on_flat_fields():
    rng = np.random.default_rng(0)
    light_e = np.linspace(50, 4000, 512)[None, :] * np.ones((512, 1))

    def exposure():
        return Exposure(
            pixels_adu=(rng.poisson(light_e) + rng.normal(0, 8, light_e.shape)).astype(np.float32) / 1.7 + 300
        )

    transfer = fit_photon_transfer([(exposure(), exposure())])
    assert transfer.gain_e_per_adu == pytest.approx(1.7, rel=0.01)
    assert transfer.gain_sigma < 0.03
    assert transfer.read_noise_e(300.0) == pytest.approx(8.0, rel=0.25)
    assert fit_photon_transfer([]) is None
    dark = Exposure(pixels_adu=rng.normal(300, 5, (512, 512)).astype(np.float32))
    assert fit_photon_transfer([(dark, dark)]) is None  # no range of levels


def star_fluxes(
    images: int = 3, stars: int = 200, extinction: float = 0.25, edge: float = 0.7, offset_mag: float = 0.0,
    varied: bool = True, seed: int = 0,
) -> StarFluxes:  # fmt: skip
    """Fluxes through a lens darker at its edge, and air; without `varied` airmass is a function of the angle."""
    rng = np.random.default_rng(seed)
    n = images * stars
    angle, b_v = np.radians(80) * np.sqrt(rng.random(n)), rng.normal(0.6, 0.4, n)
    zenith = np.clip(angle + (rng.normal(0, 0.5, n) if varied else 0.0), 0, np.radians(78))
    air = airmass(np.pi / 2 - zenith)
    u = np.square(angle / np.radians(80))
    image = np.repeat(np.arange(images), stars)
    gain = 10.0 + 2.5 * np.log10(1 - (1 - edge) * u) - extinction * air + rng.normal(0, 0.08, n)
    return StarFluxes(
        gain_mag=gain + offset_mag * (image == 1), sigma_mag=np.full(n, 0.08), angle_rad=angle, b_v=b_v, airmass=air,
        image=image,
    )  # fmt: skip


def test_throughput_and_extinction_are_recovered_where_distinguishable():
    throughput, warnings = fit_throughput(star_fluxes(), np.radians(80))
    assert throughput.extinction_mag == pytest.approx(0.25, abs=0.04)
    assert 2.5 * np.log10(throughput.zero_point_adu_per_s) == pytest.approx(10.0, abs=0.06)
    v1, v2 = throughput.vignetting
    assert 1 + v1 * np.radians(80) ** 2 + v2 * np.radians(80) ** 4 == pytest.approx(0.7, abs=0.05)
    assert warnings == []


@pytest.mark.parametrize("seed", range(5))
def test_a_zenith_camera_gets_no_impossible_extinction_or_vignetting(seed):
    throughput, warnings = fit_throughput(
        star_fluxes(extinction=-0.3, edge=1.0, varied=False, seed=seed), np.radians(80)
    )
    if throughput is not None:
        assert throughput.extinction_mag is None or throughput.extinction_mag >= 0
        v1, v2 = throughput.vignetting
        a2 = np.square(np.linspace(0, np.radians(80), 50))
        assert np.all((1 + a2 * (v1 + a2 * v2) > 0.03) & (1 + a2 * (v1 + a2 * v2) < 1.15))
    assert warnings


def test_a_lens_brighter_at_its_edge_is_rejected():
    throughput, warnings = fit_throughput(star_fluxes(extinction=0.0, edge=2.5), np.radians(80))
    assert throughput is None
    assert any("vignetting is not physical" in warning for warning in warnings)


def test_images_of_different_transparency_give_no_throughput():
    throughput, warnings = fit_throughput(star_fluxes(offset_mag=-0.8), np.radians(80))
    assert throughput is None
    assert any("zero points of the images differ" in warning for warning in warnings)
