"""Cameras of the simulated images: the thesis's sensor, under a sky that is a share of the background."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from startrack.camera import Camera, Sensor, load_camera
from startrack.rendering.sky import ARCSEC2_PER_SR

SENSOR = Sensor(
    zero_point_e_per_s=4973.0, gain_e_per_adu=0.5, bias_adu=200.0, read_noise_e=3.0, dark_e_per_s=9.3, psf_sigma_px=1.0
)
EXPOSURE_S, BACKGROUND_E = 10.0, 100.0
SKYLINE_ANGLE_RAD = np.radians(75.0)  # off the axis; here the background is BACKGROUND_E and the share is exact


def camera_for_share(share: float) -> tuple[Camera, float | None]:
    """A camera with BACKGROUND_E near the skyline, and the sky [V mag/arcsec2] that is the `share` of it."""
    camera = load_camera("fisheye-2048")
    camera = replace(camera, sensor=replace(SENSOR, dark_e_per_s=(1.0 - share) * BACKGROUND_E / EXPOSURE_S))
    if share == 0:
        return camera, None
    arcsec2 = float(camera.pixel_solid_angle_sr(np.array(SKYLINE_ANGLE_RAD))) * ARCSEC2_PER_SR
    return camera, float(-2.5 * np.log10(share * BACKGROUND_E / EXPOSURE_S / (SENSOR.zero_point_e_per_s * arcsec2)))
