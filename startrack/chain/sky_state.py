"""What an image that is not identified shows of its sky: sources, background, and the stars of a clear sky."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np

from startrack.camera import Camera
from startrack.chain.stages import Detected
from startrack.core.types import NotIdentified, Stars, TooFewStars
from startrack.detection import ROUNDED, is_rounded, smallest_step

STEP_PX = 16  # of the pixels at which the background is looked up
VISIBLE_SNR = 5.0
CAUSES = "clouds, moonlight or twilight?"


@contextmanager
def stating_sky(detected: Detected, camera: Camera | None, stars: Stars) -> Iterator[None]:
    """In the block a refusal that no attitude fits also states what the image shows of its sky.

    `camera` (None: not known) gives with the `stars` of the catalogue how many a clear sky would show.
    """
    try:
        yield
    except (NotIdentified, TooFewStars) as cause:
        if cause.reason in (NotIdentified.reason, TooFewStars.reason):
            cause.args = (f"{str(cause).rstrip('.?')}. {sky_text(detected, camera, stars)}",)
        raise


def sky_text(detected: Detected, camera: Camera | None, stars: Stars) -> str:
    """The measured state of the sky of an image as text; `camera` and `stars` as for `stating_sky`."""
    exposure, found = detected.exposure, detected.detections
    low, high = np.percentile(exposure.recorded_adu[::STEP_PX, ::STEP_PX], [5, 95])
    of_range = f" ({100 * high / exposure.saturation_adu:.0f} % of the range)" if exposure.saturation_adu else ""
    expected = None if camera is None else count_expected_stars(detected, camera, stars)
    clear = "" if expected is None else f" where a clear sky would show about {float(f'{expected:.2g}'):.0f}"
    on_moon = detected.terrain is not None and detected.terrain.air is None
    text = f"Measured: {len(found)} point sources{clear}, background from {low:.0f} to {high:.0f} ADU{of_range}"
    gain = 1.0 if camera is None or camera.sensor is None else camera.sensor.gain_e_per_adu
    if is_rounded(found.noise_e[::STEP_PX, ::STEP_PX] / gain, smallest_step(exposure.recorded_adu)):
        return f"{text}; {ROUNDED}"
    return text if on_moon else f"{text}: {CAUSES}"


def count_expected_stars(detected: Detected, camera: Camera, stars: Stars) -> float | None:
    """How many of the `stars` (of the whole sky) a clear sky would show above the measured noise, on average.

    None where the `camera` states no zero point or the exposure time is not known.
    """
    sensor, exposure_s, found = camera.sensor, detected.exposure.exposure_s, detected.detections
    if sensor is None or exposure_s is None:
        return None
    rows, columns = (np.arange(STEP_PX // 2, size, STEP_PX) for size in found.image_e.shape)
    xy_px = np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2)
    angle_rad = camera.angle_rad(xy_px.astype(float))
    noise_e = found.noise_e[xy_px[:, 1], xy_px[:, 0]]
    limit_e = VISIBLE_SNR * noise_e * np.sqrt(4 * np.pi) * sensor.psf_sigma_px
    clear_e = sensor.zero_point_e_per_s * exposure_s * sensor.throughput(angle_rad)
    with np.errstate(divide="ignore"):
        limit_mag = -2.5 * np.log10(limit_e / clear_e)
    brighter = np.searchsorted(np.sort(stars.v_mag), limit_mag)
    solid_angle_sr = STEP_PX**2 * camera.pixel_solid_angle_sr(angle_rad)
    inside = angle_rad < camera.max_angle_rad
    return float(np.sum((brighter * solid_angle_sr)[inside]) / (4 * np.pi))
