"""Diffuse sky and the step at the skyline."""

from dataclasses import dataclass, replace

import numpy as np
import pytest
from render_helpers import CRATER, FISHEYE, SENSOR, SITE, make_scene, stars_at_azel

from startrack.camera import Decentring, KannalaBrandt
from startrack.frames import azel_from_rays
from startrack.rendering import light_e, render
from startrack.rendering.sky import coverage, sky_e_per_s
from startrack.terrain import GroundBrightness, load_terrain

PLACE = np.array([5000.0, 3000.0, 1.5])


def test_sky_of_magnitude_22_on_the_axis_by_hand():
    # 44000 e/s x 10^(-8.8) x (206265 / 652 arcsec)^2 = 6.98 e/s per pixel.
    camera = replace(FISHEYE, focal_px=(652.0, 652.0))
    by_hand = 44_000 * 10**-8.8 * (206_264.8 / 652) ** 2
    assert by_hand == pytest.approx(6.98, abs=0.01)
    assert sky_e_per_s(camera, 22.0, np.zeros(1))[0] == pytest.approx(by_hand, rel=1e-6)
    # Off the axis a pixel of an equidistant lens sees sin a / a of that.
    assert sky_e_per_s(camera, 22.0, np.ones(1))[0] == pytest.approx(by_hand * np.sin(1.0), rel=1e-6)


@pytest.mark.parametrize("k", [(), (-0.03, 0.004, -0.001)])
def test_the_flux_of_the_image_circle_is_that_of_its_solid_angle(k):
    # Independent of the lens: 2 pi (1 - cos 85) sr, whatever each pixel's share.
    camera = replace(FISHEYE, lens=KannalaBrandt(k))
    total = light_e(make_scene(camera=camera, sky_v_mag_arcsec2=20.0)).sum()
    arcsec2 = 2 * np.pi * (1 - np.cos(np.radians(85))) * 206_264.806**2
    assert total == pytest.approx(44_000 * 10**-8 * arcsec2, rel=5e-4)


def test_vignetting_and_gradient():
    flat = light_e(make_scene(sky_v_mag_arcsec2=20.0))
    dimmer = replace(FISHEYE, sensor=replace(SENSOR, vignetting=(-0.2, 0.0)))
    vignetted = light_e(make_scene(camera=dimmer, sky_v_mag_arcsec2=20.0))
    left, right = np.hypot([160.5, 159.5], 0.5) / 160  # angles off the axis of the two pixels [rad]
    assert vignetted[255, 415] / flat[255, 415] == pytest.approx(1 - 0.2 * right**2, rel=1e-5)
    east = light_e(make_scene(sky_v_mag_arcsec2=20.0, sky_gradient=0.3, sky_gradient_azimuth_rad=np.pi / 2))
    # East is on the left.
    assert east[255, 95] / flat[255, 95] == pytest.approx(1 + 0.3 * np.sin(left), rel=1e-4)
    assert east[255, 415] / flat[255, 415] == pytest.approx(1 - 0.3 * np.sin(right), rel=1e-4)


@pytest.mark.parametrize("tilt", [(0.0, 0.0, 0.0), (25.0, 5.0, -4.0)])
@pytest.mark.parametrize(
    "changes",
    [
        {},
        pytest.param({"lens": KannalaBrandt((-0.03, 0.004, -0.001))}, marks=pytest.mark.slow),
        pytest.param({"decentring": Decentring(0.02, -0.01)}, marks=pytest.mark.slow),  # 20 px, far more than the PSF
        {"lens": KannalaBrandt((-0.03,)), "decentring": Decentring(-0.02, 0.005), "mirrored": True},
    ],
)
def test_the_step_stands_at_the_skyline(tilt, changes):
    camera = replace(FISHEYE, **changes)
    settings = {"camera": camera, "heading_pitch_roll_deg": tilt, "sky_v_mag_arcsec2": 20.0}
    open_sky = light_e(make_scene(**settings))
    scene = make_scene(**settings, terrain=CRATER, position_enu_m=PLACE)
    walled = light_e(scene)
    measured = 0
    for azimuth in np.radians(np.arange(0, 360, 30.0)):
        horizon = CRATER.horizon_rad(PLACE[:2], azimuth)
        elevations = horizon + np.radians(np.linspace(-3, 3, 1201))
        rays = np.stack(
            [np.sin(azimuth) * np.cos(elevations), np.cos(azimuth) * np.cos(elevations), np.sin(elevations)], -1
        )
        px, inside = camera.project(rays @ scene.R_cam_enu.T)
        if not inside.all():
            continue
        level = (bilinear(walled, px) / bilinear(open_sky, px) - 0.04) / 0.96
        middle = px[np.argmin(np.abs(level - 0.5))]
        assert np.linalg.norm(middle - px[600]) < 0.05, np.degrees(azimuth)
        assert level[0] == pytest.approx(0.0, abs=1e-3)
        assert level[-1] == pytest.approx(1.0, abs=1e-3)
        measured += 1
    assert measured >= 4


def test_the_image_circle_of_a_decentred_lens_ends_where_its_last_rays_fall():
    camera = replace(FISHEYE, decentring=Decentring(0.02, -0.01))
    sky = light_e(make_scene(camera=camera, sky_v_mag_arcsec2=20.0))
    turn = np.linspace(0, 2 * np.pi, 24, endpoint=False)

    def pixels_at(angle_rad):
        rays = [np.sin(angle_rad) * np.cos(turn), np.sin(angle_rad) * np.sin(turn), np.full(24, np.cos(angle_rad))]
        return camera.project_unlimited(np.stack(rays, axis=-1))

    edge, within = pixels_at(np.radians(85.0)), pixels_at(np.radians(82.0))
    inside = np.all((edge > 2) & (edge < 509), axis=-1)
    assert inside.sum() >= 12
    dimmer = np.sinc(85 / 180) / np.sinc(82 / 180)  # a pixel farther out sees less sky
    ratio = bilinear(sky, edge[inside]) / bilinear(sky, within[inside])
    assert ratio == pytest.approx(0.5 * dimmer, abs=0.03)  # a pixel of displacement makes 0.3


def bilinear(image, px):
    from scipy.ndimage import map_coordinates

    return map_coordinates(image, [px[:, 1], px[:, 0]], order=3)


@dataclass(frozen=True)
class Ragged:
    """Teeth 8 px wide with flanks of 50 degrees, on waves: ground without holes has a steep skyline, never a cliff."""

    name: str = "ragged"
    site: object = SITE
    camera_height_m: float = 1.5
    search_radius_m: float = 1e4

    def horizon_rad(self, points_m, azimuths_rad):
        a = np.asarray(azimuths_rad)
        return 0.3 + 0.03 * np.sin(7 * a) + 0.06 * np.abs(((a * 60 / np.pi) % 2) - 1)

    def without_table(self):
        return self


def test_a_ragged_skyline_against_brute_force():
    scene = make_scene(terrain=Ragged(), heading_pitch_roll_deg=(10, 6, 3), sky_v_mag_arcsec2=20.0)
    rng = np.random.default_rng(3)
    azimuth = rng.uniform(0, 2 * np.pi, 60)
    elevation = Ragged().horizon_rad(None, azimuth) + rng.normal(0, 1 / 160, 60)
    rays = np.stack([np.sin(azimuth) * np.cos(elevation), np.cos(azimuth) * np.cos(elevation), np.sin(elevation)], -1)
    pixels = np.rint(FISHEYE.project(rays @ scene.R_cam_enu.T)[0])
    # Brightness at each point of a fine grid, convolved with the PSF and integrated over the square pixel.
    from scipy.special import ndtr

    offset = (np.arange(240) + 0.5) / 240 * 12 - 6
    weight = ndtr(offset + 0.5) - ndtr(offset - 0.5)
    weight = weight[:, None] * weight / weight.sum() ** 2
    grid = np.stack(np.meshgrid(offset, offset), axis=-1)
    expected = []
    for pixel in pixels:
        a, e = azel_from_rays(FISHEYE.unproject(pixel + grid) @ scene.R_cam_enu)
        expected.append((weight * (e > Ragged().horizon_rad(None, a))).sum())
    expected = np.array(expected)
    assert np.ptp(expected) > 0.6
    # 1 % of the step is 0.03 px of skyline.
    np.testing.assert_allclose(coverage(scene, pixels), expected, atol=0.005)
    assert abs(np.mean(coverage(scene, pixels) - expected)) < 0.001


def test_the_wall_reflects_and_the_frame_is_dark_off_the_image_circle():
    scene = make_scene(
        sky_v_mag_arcsec2=20.0, terrain=CRATER, position_enu_m=PLACE, ground_brightness=GroundBrightness.of(0.1)
    )
    image, sky = light_e(scene), light_e(replace(scene, terrain=None))
    rows = slice(255, 256)
    wall = image[rows, 255 - int(160 * np.radians(82))]  # east, 8 degrees up: the rim is far above
    assert wall / sky[rows, 255 - int(160 * np.radians(82))] == pytest.approx(0.1, rel=1e-9)
    assert image[5, 5] == 0
    # The edge of the circle is as wide as the PSF: half the brightness at 85 degrees, 237.36 px from the centre.
    assert bilinear(sky, np.array([[255.5 + 160 * np.radians(85), 255.5]]))[0] / sky[255, 255 + 233] == pytest.approx(
        0.5, abs=0.02
    )


@pytest.mark.slow
def test_a_picture_on_a_height_map_does_not_depend_on_its_table(own_cache):
    """A table of horizons makes other last digits of a traced horizon: the picture must not show them."""
    terrain = replace(load_terrain("shackleton"), search_radius_m=150.0)
    elevation_deg = np.degrees(terrain.horizon_rad(np.zeros(2), np.radians(np.arange(360.0))))
    scene = make_scene(
        stars_at_azel(np.arange(360.0), elevation_deg, np.full(360, 5.0)), terrain=terrain, sky_v_mag_arcsec2=20.0
    )
    pictures = []
    for _ in range(2):  # before the table, and with it in memory
        exposure, truth = render(replace(scene), rng=np.random.default_rng(1))
        pictures.append((exposure.pixels_adu, truth.hidden, light_e(replace(scene))))
        terrain.prepare()
    for before, after in zip(*pictures, strict=True):
        np.testing.assert_array_equal(before, after)
