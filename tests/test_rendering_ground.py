"""Ground of any brightness in rendered pictures: the same everywhere, or in patches of azimuth."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from render_helpers import CRATER, make_scene

from startrack.core.types import BadInput
from startrack.frames import azel_from_rays
from startrack.rendering import Series, diffuse_at_e
from startrack.rendering.series import WALL_REFLECTANCE_1
from startrack.rendering.sky import diffuse_e
from startrack.terrain import GroundBrightness, terrain_from_dict

PATCHES = {"low": 0.3, "high": 3.0, "size_deg": 20.0, "seed": 5}
FILE = {
    "body": "moon", "origin": {"latitude_deg": -89.0, "longitude_deg": 0.0},
    "cylinder": {"diameter_m": 20000.0, "depth_m": 2000.0},
}  # fmt: skip


def ground(brightness: Any) -> GroundBrightness:
    found = terrain_from_dict({**FILE, "ground": {"brightness": brightness}}).file.ground_brightness
    assert found is not None
    return found


def test_patches_have_their_size_and_random_numbers_within_the_limits():
    azimuth = np.radians(np.arange(0, 360, 0.01))
    light = ground(PATCHES)(azimuth)
    changes = np.flatnonzero((light != np.roll(light, 1)) & (np.roll(light, 1) == np.roll(light, 2)))
    assert len(changes) == 18
    np.testing.assert_allclose(np.diff(changes) / 100, 20.0, atol=0.03)
    in_border = np.mean(light != np.roll(light, 1))
    assert in_border == pytest.approx(18 * 0.2 / 360, rel=0.1)
    many = np.concatenate([ground({**PATCHES, "seed": seed})(azimuth) for seed in range(60)])
    assert many.min() >= 0.3 and many.max() <= 3.0
    # Of 1080 uniform numbers: the quantiles of the distribution to three of their errors.
    np.testing.assert_allclose(np.quantile(many, [0.1, 0.5, 0.9]), [0.57, 1.65, 2.73], atol=0.13)
    np.testing.assert_array_equal(light, ground(PATCHES)(azimuth))
    np.testing.assert_allclose(light, ground(PATCHES)(azimuth + 2 * np.pi), rtol=1e-9)


def test_pixels_below_the_skyline_have_the_light_of_their_patch():
    patches = ground(PATCHES)
    scene = make_scene(sky_v_mag_arcsec2=20.0, terrain=CRATER, position_enu_m=np.array([3000.0, 1000.0, 1.5]))
    scene = replace(scene, ground_brightness=patches)
    image, open_sky = diffuse_e(scene), diffuse_e(replace(scene, terrain=None))
    px = np.stack(np.meshgrid(np.arange(512), np.arange(512)), axis=-1)
    azimuth, elevation = azel_from_rays(scene.camera.unproject(px.astype(float)) @ scene.R_cam_enu)
    depth_px = 160 * (CRATER.horizon_rad(scene.position_enu_m[:2], azimuth) - elevation)
    inside = (open_sky > 0) & (np.hypot(*(px - 255.5).transpose(2, 0, 1)) < 225)
    below, above = inside & (depth_px > 8), inside & (depth_px < -8)
    assert below.sum() > 4000
    np.testing.assert_allclose(image[below], (patches(azimuth) * open_sky)[below], rtol=1e-9)
    np.testing.assert_allclose(image[above], open_sky[above], rtol=1e-12)
    # At the edge of a level skyline half of the PSF is on either side.
    edge = inside & (np.abs(depth_px) < 0.02) & (np.abs(patches(azimuth) - patches(azimuth + 0.01)) < 1e-9)
    assert edge.sum() > 20
    np.testing.assert_allclose(image[edge] / open_sky[edge], 0.5 + 0.5 * patches(azimuth[edge]), rtol=0.04)
    near = inside & (np.abs(depth_px) < 8)
    at = np.abs(depth_px[near]) < 6
    np.testing.assert_allclose(diffuse_at_e(scene, px[near], at), image[near], rtol=1e-4, atol=1e-3)


@pytest.mark.parametrize(
    ("brightness", "cause"),
    [
        (-0.1, "ground.brightness must be a number from 0 to 1000, not -0.1"),
        ("snow", "not 'snow'"),
        (float("nan"), "not nan"),
        ({**PATCHES, "low": 4.0}, "ground.brightness: low 4 is above high 3"),
        ({**PATCHES, "size_deg": 0.0}, "ground.brightness.size_deg must be a number from 1 to 360, not 0.0"),
        ({**PATCHES, "seed": 0.5}, "ground.brightness.seed must be a whole number"),
        ({**PATCHES, "contrast": 2.0}, "contrast is an unknown key"),
        ({"low": 0.3, "high": 3.0}, "ground.brightness.size_deg is missing"),
    ],
)
def test_a_brightness_that_no_ground_has_is_refused_with_its_cause(brightness: Any, cause: str):
    with pytest.raises(BadInput, match="brightness") as caught:
        ground(brightness)
    assert caught.value.reason == "bad_terrain"
    assert cause in str(caught.value)


def test_a_given_number_counts_before_that_of_the_file_and_that_before_the_default():
    stated = terrain_from_dict({**FILE, "ground": {"brightness": PATCHES}})
    series = Series(camera=make_scene().camera, terrain=stated, catalog=None, seed=1)  # type: ignore[arg-type]
    assert series.ground_brightness.value == pytest.approx(PATCHES)
    assert replace(series, wall_reflectance=0.7).ground_brightness.value == 0.7
    assert replace(series, terrain=CRATER).ground_brightness.value == WALL_REFLECTANCE_1
