"""Stars and bodies: positions, fluxes, visibility and trails."""

from dataclasses import replace

import numpy as np
import pytest
from render_helpers import CRATER, FISHEYE, SENSOR, centroid_px, make_scene, stars_at_azel

from startrack.core.types import Body
from startrack.rendering import exposure_for_snr, light_e, truth_of


def test_flux_of_a_star_is_zero_point_times_exposure_times_throughput():
    camera = replace(FISHEYE, sensor=replace(SENSOR, vignetting=(-0.3, 0.05)))
    scene = make_scene(stars_at_azel([40.0], [50.0], [4.0]), camera=camera, exposure_s=2.0)
    a2 = np.radians(40.0) ** 2
    expected = 44_000 * 10**-1.6 * 2.0 * (1 - 0.3 * a2 + 0.05 * a2 * a2)
    assert light_e(scene).sum() == pytest.approx(expected, rel=2e-4)
    np.testing.assert_allclose(truth_of(scene).flux_e, expected, rtol=1e-12)


def test_magnitude_errors_change_the_flux_but_not_the_truth():
    scene = make_scene(stars_at_azel([40.0], [50.0], [4.0]))
    brighter = replace(scene, v_error_mag=np.array([-0.1]))
    assert light_e(brighter).sum() / light_e(scene).sum() == pytest.approx(10**0.04, rel=1e-4)
    np.testing.assert_array_equal(truth_of(brighter).flux_e, truth_of(scene).flux_e)


def test_noiseless_centroid_is_the_projected_position():
    azimuth, elevation = 123.0, 37.0
    scene = make_scene(stars_at_azel([azimuth], [elevation], [1.0]), heading_pitch_roll_deg=(31.0, 4.0, -3.0))
    np.testing.assert_allclose(centroid_px(light_e(scene)), truth_of(scene).xy_px[0], atol=1e-3)


def test_from_below_with_north_on_top_east_is_on_the_left():
    north, east = (centroid_px(light_e(make_scene(stars_at_azel([azimuth], [45.0], [0.0])))) for azimuth in (0.0, 90.0))
    r = 160 * np.pi / 4
    np.testing.assert_allclose(north, [255.5, 255.5 - r], atol=1e-3)
    np.testing.assert_allclose(east, [255.5 - r, 255.5], atol=1e-3)


def test_pitching_the_nose_up_moves_the_zenith_up_and_rolling_right_moves_it_right():
    # Nose up: the boresight leans backwards, so the zenith appears towards the front (image top).
    # Right side down: the boresight leans to the right, so the zenith appears towards the left side, image RIGHT.
    zenith = stars_at_azel([0.0], [90.0], [0.0])
    pitched = truth_of(make_scene(zenith, heading_pitch_roll_deg=(0, 5, 0))).xy_px[0]
    rolled = truth_of(make_scene(zenith, heading_pitch_roll_deg=(0, 0, 5))).xy_px[0]
    d = 160 * np.radians(5)
    np.testing.assert_allclose(pitched, [255.5, 255.5 - d], atol=1e-9)
    np.testing.assert_allclose(rolled, [255.5 + d, 255.5], atol=1e-9)


def test_mirrored_camera_gives_the_mirror_image():
    stars = stars_at_azel([20.0, 100.0, 250.0], [40.0, 60.0, 30.0], [1.0, 2.0, 3.0])
    sky = {"sky_v_mag_arcsec2": 20.0, "terrain": CRATER, "position_enu_m": np.array([5000.0, 3000.0, 1.5])}
    plain = light_e(make_scene(stars, **sky))
    mirrored = light_e(make_scene(stars, camera=replace(FISHEYE, mirrored=True), **sky))
    np.testing.assert_allclose(mirrored, plain[:, ::-1], atol=1e-6)


def test_the_terrain_hides_stars_and_the_truth_states_which():
    # At the middle of the crater the rim stands at atan(1998.5 / 10000) = 11.302 degrees.
    rim = np.degrees(np.arctan2(1998.5, 10_000))
    stars = stars_at_azel([10.0, 100.0, 200.0], [rim - 0.01, rim + 0.01, 60.0], [2.0, 2.0, 2.0])
    scene = make_scene(stars, terrain=CRATER)
    np.testing.assert_array_equal(truth_of(scene).hidden, [True, False, False])
    x, y = np.rint(truth_of(scene).xy_px).astype(int).T
    at_stars = light_e(scene)[y, x]
    assert at_stars[0] == 0
    assert np.all(at_stars[1:] > 100)


def test_nothing_shines_beyond_the_image_circle():
    scene = make_scene(stars_at_azel([10.0, 100.0], [4.9, 5.1], [0.0, 0.0]))
    assert truth_of(scene).sources.catalog_id.tolist() == ["HIP 2"]
    assert light_e(scene).sum() == pytest.approx(44_000, rel=1e-3)


def test_a_trail_is_as_long_as_the_skys_rotation_and_centred_on_mid_exposure():
    rotvec = np.array([0.0, 0.0, 0.06])  # about the zenith: a star at 45 degrees runs along a circle around it
    scene = make_scene(stars_at_azel([90.0], [45.0], [0.0]), sky_rotvec_rad=rotvec)
    image = light_e(scene)
    y, x = np.indices(image.shape)
    cx, cy = centroid_px(image)
    length_px = 160 * np.pi / 4 * 0.06
    assert (image * (y - cy) ** 2).sum() / image.sum() == pytest.approx(1 + 1 / 12 + length_px**2 / 12, rel=2e-3)
    assert (image * (x - cx) ** 2).sum() / image.sum() == pytest.approx(1 + 1 / 12, rel=2e-2)
    # Across the trail the arc's own sagitta shows, L^2 / 24 r towards the zenith, which is on the right.
    x0, y0 = truth_of(scene).xy_px[0]
    assert cy == pytest.approx(y0, abs=0.003)
    assert cx - x0 == pytest.approx(length_px**2 / (24 * 160 * np.pi / 4), abs=0.003)
    assert image.sum() == pytest.approx(44_000, rel=1e-3)


def test_the_earth_is_a_disk_that_the_rim_can_cut():
    rim = np.degrees(np.arctan2(1998.5, 10_000))
    whole, half = (
        light_e(make_scene(terrain=CRATER, bodies=(Body(name="Earth", ray_icrs=ray, v_mag=0.0),)))
        for ray in stars_at_azel([0.0, 0.0], [50.0, rim], [0, 0]).rays_icrs
    )
    y, _ = np.indices(whole.shape)
    cy = centroid_px(whole)[1]
    radius_px = 160 * 6371 / 384_400
    # An even disk of radius r has second moment r^2/4 about each axis; across, the lens stretches a / sin a.
    assert (whole * (y - cy) ** 2).sum() / whole.sum() == pytest.approx(1 + 1 / 12 + radius_px**2 / 4, rel=0.02)
    assert whole.sum() == pytest.approx(44_000, rel=1e-3)
    assert half.sum() / whole.sum() == pytest.approx(0.5, abs=0.05)


def test_a_planet_is_a_point_in_the_truth_under_its_name():
    ray = stars_at_azel([30.0], [40.0], [0]).rays_icrs[0]
    truth = truth_of(make_scene(terrain=CRATER, bodies=(Body(name="Venus", ray_icrs=ray, v_mag=-4.0),)))
    assert truth.sources.catalog_id.tolist() == ["Venus"]
    assert not truth.hidden[0]


def test_the_default_exposure_reaches_five_sigma_at_magnitude_six():
    # SNR by hand: weights = PSF, noise area 1 / sum(P^2), 6.98 e/s of sky with f = 652 px/rad (theory: V 22).
    camera = replace(FISHEYE, focal_px=(652.0, 652.0))
    t = exposure_for_snr(camera, 22.0, v_mag=6.0, snr=5.0)
    star = light_e(make_scene(stars_at_azel([0.0], [90.0], [6.0]), camera=camera, exposure_s=t))
    area = star.sum() ** 2 / np.square(star).sum()
    snr = star.sum() / np.sqrt(star.sum() + area * (2.5**2 + 6.98 * t))
    assert snr == pytest.approx(5.0, abs=0.02)
    assert t == pytest.approx(0.40, abs=0.01)
