"""Small scenes for the renderer's tests: a 512 px fisheye and a few stars."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from startrack.camera import Camera, Sensor
from startrack.core.types import Stars
from startrack.frames import R_body_enu_from_heading_pitch_roll, Site, rays_from_azel
from startrack.rendering import Scene
from startrack.terrain import Cylinder, GroundBrightness

SITE = Site("moon", np.radians(-89.66), np.radians(129.78))
CRATER = Cylinder(
    name="crater", site=SITE, diameter_m=20_000.0, depth_m=2000.0, camera_height_m=1.5, search_radius_m=10_000.0
)
SENSOR = Sensor(zero_point_e_per_s=44_000.0, gain_e_per_adu=0.5, bias_adu=100.0, read_noise_e=2.5, psf_sigma_px=1.0)
FISHEYE = Camera(
    name="small",
    size_px=(512, 512),
    focal_px=(160.0, 160.0),
    centre_px=(255.5, 255.5),
    max_angle_rad=float(np.radians(85.0)),
    calibrated_angle_rad=float(np.radians(85.0)),
    sensor=SENSOR,
)


def stars_at(rays_icrs: Any, v_mag: Any) -> Stars:
    """Stars "HIP 1", "HIP 2", ... in the given directions."""
    n = len(v_mag)
    return Stars(
        catalog_id=np.array([f"HIP {k + 1}" for k in range(n)], dtype=np.str_),
        hip=np.arange(1, n + 1),
        rays_icrs=np.reshape(rays_icrs, (n, 3)),
        v_mag=np.asarray(v_mag, dtype=float),
        v_sigma_mag=np.zeros(n),
    )


def stars_at_azel(azimuth_deg: Any, elevation_deg: Any, v_mag: Any) -> Stars:
    """Stars in enu directions, for scenes in which enu and icrs axes are the same."""
    return stars_at(rays_from_azel(np.radians(azimuth_deg), np.radians(elevation_deg)), v_mag)


def make_scene(stars: Stars | None = None, *, heading_pitch_roll_deg: Any = (0.0, 0.0, 0.0), **changes: Any) -> Scene:
    """A scene with a black sky at the crater's middle; enu and icrs axes are the same."""
    stars = stars_at(np.empty((0, 3)), np.empty(0)) if stars is None else stars
    camera = changes.pop("camera", FISHEYE)
    R_body_enu = R_body_enu_from_heading_pitch_roll(*np.radians(heading_pitch_roll_deg))
    scene = Scene(
        camera=camera,
        terrain=None,
        stars=stars,
        v_error_mag=np.zeros(len(stars)),
        position_enu_m=np.array([0.0, 0.0, 1.5]),
        R_cam_enu=camera.R_body_cam.T @ R_body_enu,
        R_enu_icrs=np.eye(3),
        exposure_s=1.0,
        sky_v_mag_arcsec2=None,
        sky_gradient=0.0,
        sky_gradient_azimuth_rad=0.0,
        ground_brightness=GroundBrightness.of(0.04),
        cosmic_rays=0,
    )
    return replace(scene, **changes)


def centroid_px(image: Any) -> Any:
    """Flux-weighted mean (x, y) of an image without background."""
    y, x = np.indices(image.shape)
    return np.array([(image * x).sum(), (image * y).sum()]) / image.sum()
