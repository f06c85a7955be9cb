"""The step of the sky's own light at the skyline: how bright the sky is, and images of stars without the step.

A star beside the edge is measured on half a step, which would add light to the one on its brighter side and take it
from the one on its darker side.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from startrack.camera import Camera
from startrack.core.statistics import median, robust_sigma
from startrack.core.types import MIDDLES_RAD, Array, Detections, SmoothImage, sector_of
from startrack.evidence.photometry import SURE_SIGMAS
from startrack.evidence.sky_levels import GROUND, SKY
from startrack.evidence.sky_light import SkyLight
from startrack.evidence.sky_pixels import SkylineBand
from startrack.evidence.skyline import BAND_PX
from startrack.frames import off_axis_rad, rays_from_azel

PREDICTED_SIGMA_PX = 0.1  # of a predicted skyline, errors of the image included
FADE_PX = 3.0  # over which the light beside the skyline goes over to the background at the ends of the band


def exceeds_noise(sky: SkyLight) -> bool:
    """Whether the step of the `sky` is larger than the noise of a pixel: else it shifts no star's flux by much."""
    covered = sky.levels.covered
    step_e = np.abs(sky.levels.step_e[covered])
    return bool(covered.any() and np.median(step_e) >= np.median(sky.levels.noise_e[:, covered]))


def brightness_mag_arcsec2(
    sky: SkyLight, camera: Camera, R_cam_enu: Array, exposure_s: float | None
) -> float | None:  # fmt: skip
    """Brightness of the sky beyond that of the ground [V mag/arcsec2], by the zero point of the `camera`.

    The step per solid angle of the pixel, throughput and second of the exposure (`exposure_s`); `R_cam_enu` gives where
    it is in the image. None where the step is not significant, or the camera has no zero point, or the exposure no
    known duration.
    """
    sensor, covered = camera.sensor, sky.levels.covered
    _, sigma_e = sky.levels.mean_step_e(covered)
    if sensor is None or not exposure_s or not covered.any():
        return None
    step_e = float(np.median(sky.levels.step_e[covered]))
    if not step_e > SURE_SIGMAS * sigma_e:
        return None
    rays_cam = rays_from_azel(MIDDLES_RAD[covered], sky.elevation_rad[covered]) @ R_cam_enu.T
    angle = np.array(np.median(off_axis_rad(rays_cam)))
    arcsec2 = float(camera.pixel_solid_angle_sr(angle)) * np.degrees(3600) ** 2
    per_s = arcsec2 * float(sensor.throughput(angle)) * sensor.zero_point_e_per_s
    return float(-2.5 * np.log10(step_e / (per_s * exposure_s)))


def take_out_sky_step(band: SkylineBand, sky: SkyLight) -> Detections:
    """The detections of the `band` with the step of the sky's light in their background, and each side's noise.

    The step is as wide as the image shows it, and where prediction and image together place it in each sector.
    """
    from scipy.special import ndtr

    levels, sector = sky.levels, sector_of(band.azimuth_rad)
    known = np.flatnonzero(levels.covered[sector])
    s, height_px, pixel = sector[known], band.height_px[known], band.pixel[known]
    background, noise = band.detections.background_e.copy(), band.detections.noise_e.copy()
    image, level, sigma = (values.reshape(-1) for values in (band.detections.image_e, background, noise))
    before_px2 = np.square(band.estimate.sigma_rad * band.to_px(MIDDLES_RAD)) + PREDICTED_SIGMA_PX**2
    shift_px = sky.shift_px * before_px2 / (before_px2 + sky.variance_px2)
    visible = ndtr((height_px - shift_px[s]) / sky.width_px)
    low, high = (levels.level_e[side, s] + levels.slope_e[side, s] * height_px for side in (GROUND, SKY))
    off = image[pixel] - (low + (high - low) * visible)
    # Faint stars, which the levels leave out, are in the background and the noise; both of all sectors together.
    sides = visible < 0.5, visible >= 0.5
    middle = [median(off[side]) for side in sides]
    ground_e2, sky_e2 = (
        np.square(levels.noise_e[k, s]) * robust_sigma(off[side] / levels.noise_e[k, s[side]]) ** 2
        for k, side in zip((GROUND, SKY), sides, strict=True)
    )
    light = low + middle[0] + (high + middle[1] - low - middle[0]) * visible
    ratio = np.sqrt(ground_e2 + (sky_e2 - ground_e2) * visible) / sigma[pixel]
    fade = np.clip((BAND_PX - np.abs(height_px)) / FADE_PX, 0.0, 1.0)
    level[pixel] += (fade * (light - level[pixel])).astype(np.float32)
    sigma[pixel] *= (1.0 + fade * (ratio - 1.0)).astype(np.float32)
    return replace(band.detections, background=SmoothImage.of(background), noise=SmoothImage.of(noise))
