"""Advice on an image that is not identified: what it shows of its sky, and whether sky or camera file comes first."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np

from startrack.camera import Camera
from startrack.core.errors import Reason
from startrack.core.limits import stating_work
from startrack.core.types import Array, Centroids, Detections, Exposure, NotIdentified, TooFewStars
from startrack.detection import MIN_BINNED_SIGMA_PX, ROUNDED, WIDTH_TOLERANCE, is_rounded, smallest_step

STEP_PX = 16  # of the pixels at which the background is looked up
VISIBLE_SNR = 5.0
# Of the range, that 95 % of the background stay below: 0.05 on a clear night of an all-sky camera, 0.08 under clouds,
# 0.53 beside a bright Moon.
BRIGHT_PART = 0.25
FEW_PART = 0.25  # of the stars of a clear sky: 14 clear images, half hidden by ground, have 0.45 to 0.76
# Where no zero point tells: an all-sky camera then has 3.7 times the stars of a clear sky on a clear night, 0.98 beside
# a bright Moon, and 0.16 under clouds.
ASSUMED_LIMIT_MAG = 5.0
BRIGHT_SKY = "the background is bright, as clouds, the Moon or twilight make it: try a picture of a clear, dark sky"
BRIGHT_VIEW = "the background is bright, as the Sun, the Earth or lit ground make it: try a picture without stray light"
FEW_STARS = "few stars for a clear sky: try a longer exposure, or a picture without clouds if some were in view"
WIDE_STARS = "if the focus may be off, try a sharper picture"
GROUND = "if ground, trees or lamps are in view, try --mask"
OTHER_ROWS = (
    "ROWORDER in its header is {}, and rows are taken in the order of the file: is the camera file of pictures with "
    "the other order? Flip the rows of this one, or make a camera file of such pictures"
)
DARK_SKY = "do clouds or the lens cap cover the sky, or was the exposure too short?"
DARK_VIEW = "was the lens cap on, or the exposure too short?"


@contextmanager
def stating_sky(
    exposure: Exposure, found: Centroids | None = None, camera: Camera | None = None, v_mag: Array | None = None, *,
    fov_rad: float = 0.0, on_moon: bool = False, more: str = "",
) -> Iterator[None]:  # fmt: skip
    """Context in which a refusal that no attitude fits also states what the `exposure` shows of its sky.

    Its advice is that of the likely cause; that of a mirror image names the order of rows in its header. `found` are
    the point sources (None: there are none). `camera` (None: not known, then `fov_rad` is the field of view, if known)
    gives with `v_mag` (n,), magnitudes of the whole sky in ascending order, how many stars a clear sky would show.
    `on_moon`: above ground without air. `more` follows the advice about the lens.
    """
    try:
        with stating_work(lambda: "the sources were sought" if found is None else measured_text(exposure, found)):
            yield
    except (NotIdentified, TooFewStars) as cause:
        if cause.reason in (NotIdentified.reason, TooFewStars.reason):
            clear = None if v_mag is None else count_clear(exposure, found, camera, v_mag, fov_rad)
            lens = (cause.advice or ("" if found else DARK_VIEW if on_moon else DARK_SKY)) + more
            if found and not (on_moon or exposure.mask is not None or (camera is not None and camera.mask is not None)):
                lens += f"; {GROUND}"
            if found and is_wide(found, camera):
                lens = f"{WIDE_STARS}; {lens}"
            text = sky_text(exposure, found, clear, on_moon, _rounding(exposure, found, camera), lens)
            cause.args = (f"{cause.fact.rstrip('.?')}. {text}",)
        elif cause.reason is Reason.MIRRORED and exposure.row_order:
            cause.args = (f"{cause.fact}: {OTHER_ROWS.format(exposure.row_order)}",)
        raise


def sky_text(
    exposure: Exposure, found: Centroids | None, clear: float | None, on_moon: bool, rounding: str, lens: str
) -> str:  # fmt: skip
    """The measured state of the sky as text, with the advice of what comes first: sky, rounding of the counts or lens.

    `found` are the point sources of the `exposure`, `clear` is how many a clear sky would show (None: not known).
    `rounding` is the advice where rounding hides stars, `lens` that where nothing else is the likely cause.
    """
    count, part = 0 if found is None else len(found), _bright_part(exposure)
    advice = rounding or lens
    if part >= BRIGHT_PART:
        advice = BRIGHT_VIEW if on_moon else BRIGHT_SKY
    elif not rounding and not on_moon and count and clear is not None and count < FEW_PART * clear:
        advice = f"{FEW_STARS}; {lens}" if lens else FEW_STARS
    return measured_text(exposure, found, clear) + (f": {advice}" if advice else "")


def measured_text(exposure: Exposure, found: Centroids | None, clear: float | None = None) -> str:
    """The point sources and the background of an `exposure` as text; the arguments are those of `sky_text`."""
    sources = f"{0 if found is None else len(found)} point source{'s' * (found is None or len(found) != 1)}"
    if found:
        sources += f" (SNR {found.snr.min():.0f} to {found.snr.max():.0f}, sigma of {found.psf_sigma_px:.1f} px)"
    of_clear = "" if clear is None else f" where a clear sky would show about {float(f'{clear:.2g}'):.0f}"
    low, high = np.percentile(exposure.recorded_adu[::STEP_PX, ::STEP_PX], [5, 95])
    part = _bright_part(exposure)
    of_range = f" ({100 * part:.0f} % of the range)" if part else ""
    width, height = exposure.size_px
    background = f"background from {low:.0f} to {high:.0f} ADU{of_range}"
    return f"Measured: {sources}{of_clear}, in {width} x {height} px, {background}"


def is_wide(found: Centroids, camera: Camera | None) -> bool:
    """Whether the point sources are wider than those of a sharp picture, and than the `camera` file states."""
    stated = None if camera is None or camera.sensor is None else camera.sensor.psf_sigma_px
    return found.psf_sigma_px > max(MIN_BINNED_SIGMA_PX, (1 + WIDTH_TOLERANCE) * (stated or 0.0))


def _bright_part(exposure: Exposure) -> float:
    """Part of the range of the pixels below which 95 % of them are; 0 where the range is not known."""
    high = float(np.percentile(exposure.recorded_adu[::STEP_PX, ::STEP_PX], 95))
    return high / exposure.saturation_adu if exposure.saturation_adu else 0.0


def _rounding(exposure: Exposure, found: Centroids | None, camera: Camera | None) -> str:
    """The advice where the rounding of the counts hides faint stars, else an empty text."""
    if not isinstance(found, Detections):
        return ""
    gain = 1.0 if camera is None or camera.sensor is None else camera.sensor.gain_e_per_adu
    coarse = is_rounded(found.noise_e[::STEP_PX, ::STEP_PX] / gain, smallest_step(exposure.recorded_adu))
    return ROUNDED if coarse else ""


def count_clear(
    exposure: Exposure, found: Centroids | None, camera: Camera | None, v_mag: Array, fov_rad: float
) -> float | None:
    """Expected number of stars that a clear sky would show; None where no field is known.

    The stars have the magnitudes `v_mag` (n,), ascending, of the whole sky. By the zero point of the `camera`, the
    exposure time and the noise of the `found` sources; where one is not known, down to ASSUMED_LIMIT_MAG. Without a
    camera `fov_rad` is the field of view.
    """
    expected = None
    if isinstance(found, Detections) and camera is not None:
        expected = count_expected_stars(exposure, found, camera, v_mag)
    field_rad = camera.max_angle_rad if camera is not None else 0.5 * fov_rad
    if expected is None and field_rad:
        expected = np.searchsorted(v_mag, ASSUMED_LIMIT_MAG) * 0.5 * (1.0 - np.cos(field_rad))
    return expected


def count_expected_stars(exposure: Exposure, found: Detections, camera: Camera, v_mag: Array) -> float | None:
    """Expected number of stars that a clear sky would show above the measured noise.

    Stars have the magnitudes `v_mag` (n,), ascending, of the whole sky. None where the `camera` states no zero point
    or the exposure time is not known; `found` has the noise.
    """
    sensor, exposure_s = camera.sensor, exposure.exposure_s
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
    brighter = np.searchsorted(v_mag, limit_mag)
    solid_angle_sr = STEP_PX**2 * camera.pixel_solid_angle_sr(angle_rad)
    inside = angle_rad < camera.max_angle_rad
    return float(np.sum((brighter * solid_angle_sr)[inside]) / (4 * np.pi))
