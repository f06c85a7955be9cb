"""Photon statistics, gain, clipping and defects, from flat frames."""

from dataclasses import replace

import numpy as np
import pytest
from render_helpers import FISHEYE, SENSOR, make_scene, stars_at_azel

from startrack.rendering import HotPixels, draw_hot_pixels, render
from startrack.rendering.compose import add_cosmic_rays, photons, read_out


@pytest.mark.parametrize("mean", [0.3, 20.0, 200.0, 5000.0])
def test_variance_of_a_flat_frame_is_mean_plus_read_noise(mean):
    adu = read_out(np.full((500, 500), mean), SENSOR, rng=np.random.default_rng(4)).astype(float)
    n = adu.size
    variance_e2 = mean + 2.5**2 + 0.5**2 / 12
    assert (adu.mean() - 100.0) * 0.5 == pytest.approx(mean, abs=5 * np.sqrt(variance_e2 / n))
    # 5 sigma of a sample variance, sqrt(2/n).
    assert adu.var() * 0.5**2 == pytest.approx(variance_e2, rel=5 * np.sqrt(2 / n))


@pytest.mark.parametrize("mean", [2.0, 63.0, 65.0])
def test_skewness_of_the_photons_is_poisson_either_side_of_the_normal_approximation(mean):
    e = photons(np.full(400_000, mean), rng=np.random.default_rng(5)).astype(float)
    assert e.mean() == pytest.approx(mean, abs=5 * np.sqrt(mean / len(e)))
    assert np.all(e == np.rint(e))
    skewness = np.mean((e - e.mean()) ** 3) / e.std() ** 3
    expected = 1 / np.sqrt(mean) if mean < 64 else 0.0
    assert skewness == pytest.approx(expected, abs=5 * np.sqrt(6 / len(e)))


def test_saturation_bits_and_bias():
    rng = np.random.default_rng(6)
    mean = np.array([[0.0, 1e5, 1e9]])
    twelve_bits = replace(SENSOR, saturation_adu=4095.0)
    np.testing.assert_array_equal(read_out(mean, twelve_bits, rng=rng)[0, 1:], 4095)
    np.testing.assert_array_equal(read_out(mean, replace(SENSOR, saturation_adu=1e7), rng=rng)[0, 1:], 65535)
    below_zero = read_out(np.zeros((50, 50)), replace(SENSOR, bias_adu=0.0), rng=rng)
    assert below_zero.min() == 0
    assert np.all(below_zero == np.rint(below_zero))


def test_a_bright_star_saturates_and_stays_flat():
    exposure, _ = render(make_scene(stars_at_azel([0.0], [60.0], [-4.0])), rng=np.random.default_rng(7))
    assert exposure.pixels_adu.max() == 65535
    assert np.count_nonzero(exposure.pixels_adu == 65535) > 4


def test_dark_current_is_everywhere_and_hot_pixels_stand_where_they_are():
    camera = replace(FISHEYE, sensor=replace(SENSOR, dark_e_per_s=30.0, read_noise_e=0.0))
    hot = HotPixels(xy_px=np.array([[7, 11]]), dark_e_per_s=np.array([50_000.0]))
    exposure, _ = render(make_scene(camera=camera, exposure_s=2.0, hot_pixels=hot), rng=np.random.default_rng(8))
    electrons = (exposure.pixels_adu - 100) * 0.5
    assert np.median(electrons[:20]) == pytest.approx(60.0, abs=1.0)  # off the image circle too
    assert electrons[11, 7] == pytest.approx(32_717, rel=1e-3)  # saturated: (65535 - 100) x 0.5
    assert np.count_nonzero(electrons > 200) == 1


def test_hot_pixels_are_different_pixels_on_the_frame_with_a_wide_spread():
    hot = draw_hot_pixels((30, 20), 500, rng=np.random.default_rng(9))
    assert len({tuple(p) for p in hot.xy_px.tolist()}) == 500
    assert hot.xy_px.max(axis=0).tolist() == [29, 19]
    assert np.percentile(hot.dark_e_per_s, 95) / np.percentile(hot.dark_e_per_s, 5) > 100


def test_a_hot_pixel_off_the_frame_is_refused():
    hot = HotPixels(xy_px=np.array([[512, 0]]), dark_e_per_s=np.array([1.0]))
    with pytest.raises(ValueError, match="off the frame"):
        render(make_scene(hot_pixels=hot), rng=np.random.default_rng(0))


def test_cosmic_rays_leave_narrow_tracks():
    image = np.zeros((400, 400))
    add_cosmic_rays(image, 40, rng=np.random.default_rng(10))
    touched = np.count_nonzero(image > 20)
    # 40 tracks of 6 px on average, each one to two pixels wide.
    assert 100 < touched < 900
    assert 40 * 50 < image.sum() < 40 * 6000


def test_same_scene_and_generator_state_give_the_same_pixels():
    scene = make_scene(stars_at_azel([0.0], [60.0], [2.0]), sky_v_mag_arcsec2=20.0, cosmic_rays=5)
    one, two, other = (render(scene, rng=np.random.default_rng(s))[0].pixels_adu for s in (1, 1, 2))
    np.testing.assert_array_equal(one, two)
    assert np.count_nonzero(one != other) > 100_000
