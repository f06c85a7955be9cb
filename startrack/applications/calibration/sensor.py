"""Sensor properties from the pixels: gain and read noise, dark level, saturation, PSF width, hot pixels.

Gain by photon transfer: the variance of the difference of two frames grows with their level by one over the gain.
Source: Janesick 2007, Photon Transfer, SPIE Press.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np

from startrack.applications.calibration.acceptance import IMAGE_RINGS
from startrack.applications.calibration.static_parts import find_hot_pixels, turn_rad
from startrack.applications.calibration.throughput import Throughput, measure_throughput
from startrack.camera import Camera, Sensor
from startrack.core.runner import map_in_threads
from startrack.core.statistics import median, robust_sigma
from startrack.core.types import Array, Exposure, Image
from startrack.estimation.frame_matching import JointFit
from startrack.psf import pixel_profile, stamp_radius

DARK_BEYOND_1 = 1.06  # of the image circle's radius: the sensor is dark beyond
EVERY_PX = 4  # every so many rows and columns
MIN_DARK_EVERY_PXS = 250
LARGEST_DARK_SPREAD_1 = 0.2  # of the levels of the dark corners, over their difference from the sky
MIN_SATURATED_PIXELS = 12
STILL_PX = 0.3
TRANSFER_BLOCK_PX = 32
MIN_BLOCKS = 60
LARGEST_GAIN_ERROR_1 = 0.1  # relative
CLIP_SIGMA = 3.0
CLIP_ROUNDS, LINE_ROUNDS = 8, 12
CORE_SIGMA = 2.0
CORE_VARIANCE_1 = 0.773741  # of a Gaussian truncated there: 1 - 2 c phi(c) / (2 Phi(c) - 1)
MIN_WIDTH_SNR = 25.0
MIN_WIDTHS, MAX_WIDTHS = 5, 400  # stars of a ring, and of an image
TRIED_WIDTHS_PX = np.geomspace(0.35, 6.0, 40)


@dataclass(frozen=True)
class PhotonTransfer:
    """Line of the photon transfer: variance [ADU^2] of one pixel = level / gain + offset."""

    gain_e_per_adu: float
    gain_sigma: float
    offset_adu2: float

    def read_noise_e(self, bias_adu: float) -> float | None:
        """Read noise [e]; None where the line is negative at the bias."""
        squared = self.gain_e_per_adu**2 * (self.offset_adu2 + bias_adu / self.gain_e_per_adu)
        return float(np.sqrt(squared)) if squared > 0 else None


@dataclass(frozen=True, kw_only=True)
class SensorProperties:
    """Measured properties; None where the pictures do not determine them."""

    transfer: PhotonTransfer | None
    same_sky: bool  # whether the sky stood still between the frames of the photon transfer
    bias_adu: float | None
    saturation_adu: float | None
    psf_sigma_px: float | None
    flux_ratio: float  # flux with a star's own width over the flux of the detector
    psf_by_ring_px: tuple[float | None, ...]  # from the axis to the calibrated angle
    hot_px: Array | None  # (n, 2) x, y


def measure_sensor(joint: JointFit) -> SensorProperties:
    """Sensor properties from the exposures of a calibration."""
    camera, exposures = joint.fit.camera, [frame.exposure for frame in joint.frames]
    pairs, same_sky = _pairs(joint)
    sigma_px, angle, ratio = _measure_widths(joint)
    edges = np.linspace(0.0, camera.calibrated_angle_rad, IMAGE_RINGS + 1)
    top = max(float(exposure.recorded_adu.max()) for exposure in exposures)
    saturated = sum(int(np.count_nonzero(exposure.recorded_adu >= top)) for exposure in exposures)
    return SensorProperties(
        transfer=fit_photon_transfer(pairs),
        same_sky=same_sky,
        bias_adu=_dark_level(exposures, camera),
        saturation_adu=top if saturated >= MIN_SATURATED_PIXELS else None,  # the largest value, if pixels share it
        psf_sigma_px=_median_of_enough(sigma_px),
        flux_ratio=_median_of_enough(ratio) or 1.0,
        psf_by_ring_px=tuple(_median_of_enough(sigma_px[(angle >= a) & (angle < b)]) for a, b in pairwise(edges)),
        hot_px=find_hot_pixels(joint),
    )


def _median_of_enough(values: Array) -> float | None:
    """Median of the `values`; None where they are too few."""
    return float(np.median(values)) if len(values) >= MIN_WIDTHS else None


def _pairs(joint: JointFit) -> tuple[list[tuple[Exposure, Exposure]], bool]:
    """Successive exposures between which the sky stood still, and True; without such all successive ones, and False."""
    pairs = [(a.exposure, b.exposure) for a, b in pairwise(joint.frames)]
    moved_px = [turn_rad(a, b) * max(joint.fit.camera.focal_px) for a, b in pairwise(joint.fit.R_cam_icrs)]
    still = [pair for pair, px in zip(pairs, moved_px, strict=True) if px < STILL_PX]
    return (still, True) if still else (pairs, False)


def _dark_level(exposures: list[Exposure], camera: Camera) -> float | None:
    """Level [ADU] of the corners beyond the image circle, where these are uniform and darker than the sky.

    It contains the dark current. The lowest of several frames is taken, because scattered light adds to it.
    """
    width, height = camera.size_px
    x, y = np.meshgrid(
        (np.arange(0, width, EVERY_PX) - camera.centre_px[0]) / camera.focal_px[0],
        (np.arange(0, height, EVERY_PX) - camera.centre_px[1]) / camera.focal_px[1],
    )
    rim = float(camera.lens.rho(np.array(camera.max_angle_rad)))
    dark, lit = np.hypot(x, y) > DARK_BEYOND_1 * rim, np.hypot(x, y) < 0.8 * rim
    if np.count_nonzero(dark) < MIN_DARK_EVERY_PXS:
        return None
    corners = [dark & (right == (x > 0)) & (below == (y > 0)) for right in (True, False) for below in (True, False)]
    levels = []
    for exposure in exposures:
        p = exposure.pixels_adu[::EVERY_PX, ::EVERY_PX]
        level, sky = float(np.median(p[dark])), float(np.median(p[lit]))
        in_corners = [float(np.median(p[corner])) for corner in corners if corner.sum() > MIN_DARK_EVERY_PXS // 5]
        if max(in_corners) - min(in_corners) < LARGEST_DARK_SPREAD_1 * (sky - level):
            levels.append(level)
    return min(levels) if levels else None


def fit_photon_transfer(pairs: list[tuple[Exposure, Exposure]]) -> PhotonTransfer | None:
    """Photon transfer of pairs of frames; None without a pair, or with too small a range of levels.

    From the counts as recorded: after a flat field, variance and level would differ by its sensitivity.

    Where the sky has moved between the two frames, stars below the detection limit add to the variance, by some per
    cent in deep wide-field frames; the gain is then as much too low.
    """
    if not pairs:
        return None
    level, variance = np.concatenate(list(map_in_threads(_block_statistics, pairs)), axis=1)
    good = variance > 0
    return _fit_line(level[good], variance[good]) if good.sum() >= MIN_BLOCKS else None


def _block_statistics(pair: tuple[Exposure, Exposure]) -> Array:
    """Median level of a frame of the `pair` [ADU] and variance of a pixel [ADU^2] (2, n), block by block."""
    a, b = (exposure.recorded_adu for exposure in pair)
    tops = range(0, a.shape[0] // TRANSFER_BLOCK_PX * TRANSFER_BLOCK_PX, TRANSFER_BLOCK_PX)
    return np.concatenate([_row_statistics(*(one[top : top + TRANSFER_BLOCK_PX] for one in (a, b))) for top in tops], 1)


def _row_statistics(a: Image, b: Image) -> Array:
    """Median levels [ADU] and variances of a pixel [ADU^2], (2, n), of a row of blocks of two frames.

    A row at a time stays in the processor's cache. The variance is that of differences between neighbouring pixels in
    the difference of the frames, which the slope of the sky and the sensitivities of the pixels do not affect; clipping
    excludes the stars.
    """
    side = len(a)
    one, other = (rows[:, : rows.shape[1] // side * side].reshape(side, -1, side).swapaxes(0, 1) for rows in (a, b))
    step = np.diff(one - other, axis=2).reshape(-1, side * (side - 1))
    step -= median(step, axis=1)[:, None]
    variance, squared = np.square(robust_sigma(step, 0.0, axis=1)), np.square(step)
    for _ in range(CLIP_ROUNDS):  # clipped to the core of the distribution, without stars
        core = squared < CORE_SIGMA**2 * variance[:, None]
        total = np.einsum("nk,nk->n", squared, core, dtype=np.float64)
        variance = total / np.maximum(np.count_nonzero(core, axis=1), 1) / CORE_VARIANCE_1
    return np.stack([0.5 * median((one + other).reshape(len(one), -1), axis=1), variance / 4.0])


def _fit_line(level: Array, variance: Array) -> PhotonTransfer | None:
    """Robust straight line of variance over level (n,)."""
    weight = np.ones(len(level))
    for _ in range(LINE_ROUNDS):
        design = weight[:, None] * np.stack([level, np.ones_like(level)], axis=1)
        ridge = 1e-6 * np.linalg.norm(design) * np.eye(2)
        observed = np.append(weight * variance, [0.0, 0.0])
        slope, offset = np.linalg.lstsq(np.concatenate([design, ridge]), observed, rcond=None)[0]
        fitted = np.maximum(slope * level + offset, 1e-3 * np.median(variance))
        relative = (variance - fitted) / fitted
        spread = max(robust_sigma(relative, 0.0), 1e-6)
        weight = np.where(np.abs(relative) < CLIP_SIGMA * spread, 1.0 / (fitted * spread), 0.0)
        if np.count_nonzero(weight) < MIN_BLOCKS:
            return None
    error = 1.0 / np.sqrt(np.sum(weight**2) * np.cov(level, aweights=weight**2, ddof=0))
    if slope <= 0 or error > LARGEST_GAIN_ERROR_1 * slope:
        return None
    return PhotonTransfer(float(1.0 / slope), float(error / slope**2), float(offset))


def _measure_widths(joint: JointFit) -> tuple[Array, Array, Array]:
    """Best-fitting Gaussian widths of the bright, unsaturated stars of all frames, each (n,).

    PSF sigma [px] before integration over the pixel, angle off the axis [rad], and the flux with the star's own width
    over the flux of the detector.
    """

    def measure(i: int) -> Array:
        frame, matched, found = joint.frames[i], joint.matches[i], joint.frames[i].sources
        used = matched.detection[joint.fit.used[joint.points.image == i]]
        used = used[(found.snr[used] > MIN_WIDTH_SNR) & ~found.saturated[used]][:MAX_WIDTHS]
        radius = stamp_radius(1.6 * found.psf_sigma_px) + 2
        px = found.xy_px[used]
        whole = np.all((px > radius + 1) & (px < np.array(frame.exposure.size_px) - radius - 2), axis=1)
        if not whole.any():
            return np.zeros((3, 0))
        width_px, flux = _fit_widths(np.asarray(frame.exposure.pixels_adu), px[whole], radius)
        angle = joint.fit.camera.angle_rad(px[whole])
        return np.stack([width_px, angle, flux / found.flux_e[used[whole]]])

    sigma_px, angle, ratio = np.concatenate(list(map_in_threads(measure, range(len(joint.frames)))), axis=1)
    return sigma_px, angle, ratio


def _fit_widths(image: Array, px: Array, radius: int) -> tuple[Array, Array]:
    """Width (n,) that fits each stamp best, interpolated between TRIED_WIDTHS_PX, and the flux (n,) with it."""
    centre = np.rint(px).astype(int)
    side = 2 * radius + 1
    windows = np.lib.stride_tricks.sliding_window_view(image, (side, side))
    data = windows[centre[:, 1] - radius, centre[:, 0] - radius].astype(np.float64).reshape(len(px), -1)
    data = data - data.mean(axis=1, keepdims=True)
    offset = px - centre
    misfit = np.empty((len(TRIED_WIDTHS_PX), len(px)))
    for k, width in enumerate(TRIED_WIDTHS_PX):
        shape = _star_shape(offset, float(width), radius)
        misfit[k] = np.sum(data**2, axis=1) - np.sum(data * shape, axis=1) ** 2 / np.sum(shape**2, axis=1)
    best = np.clip(np.argmin(misfit, axis=0), 1, len(TRIED_WIDTHS_PX) - 2)
    n = np.arange(len(px))
    left, middle, right = misfit[best - 1, n], misfit[best, n], misfit[best + 1, n]
    bend = left - 2 * middle + right
    shift = np.divide(0.5 * (left - right), bend, out=np.zeros_like(bend), where=bend > 0)
    step = np.log(TRIED_WIDTHS_PX[1] / TRIED_WIDTHS_PX[0])
    sigma = np.asarray(TRIED_WIDTHS_PX[best] * np.exp(np.clip(shift, -1, 1) * step))
    shape = _star_shape(offset, sigma, radius)
    return sigma, np.sum(data * shape, axis=1) / np.sum(shape**2, axis=1)


def _star_shape(offset: Array, sigma_px: float | Array, radius: int) -> Array:
    """Star of unit flux in each stamp (n, pixels), its mean subtracted."""
    x, _ = pixel_profile(offset[:, 0], sigma_px, radius)
    y, _ = pixel_profile(offset[:, 1], sigma_px, radius)
    shape = (y[:, :, None] * x[:, None, :]).reshape(len(offset), -1)
    return np.asarray(shape - shape.mean(axis=1, keepdims=True))


@dataclass(frozen=True, kw_only=True)
class KnownSensor:
    """Properties of the sensor that the user gives; None where not known."""

    gain_e_per_adu: float | None = None
    read_noise_e: float | None = None
    bias_adu: float | None = None


@dataclass(frozen=True, kw_only=True)
class Photometry:
    """Throughput and sensor properties, the sensor made from them (None where one is missing), and notes."""

    throughput: Throughput | None
    properties: SensorProperties
    sensor: Sensor | None
    notes: tuple[str, ...]


def measure_photometry(joint: JointFit, known: KnownSensor) -> Photometry:
    """Throughput and sensor from the exposures of a calibration."""
    properties = measure_sensor(joint)
    throughput, notes = measure_throughput(joint, properties.flux_ratio)
    bias = known.bias_adu if known.bias_adu is not None else properties.bias_adu
    gain, noise, transfer = known.gain_e_per_adu, known.read_noise_e, properties.transfer
    if gain is None and transfer is not None:
        gain = transfer.gain_e_per_adu
    if noise is None and transfer is not None and bias is not None:
        noise = transfer.read_noise_e(bias)
    if gain is None:
        notes.append("gain: not measured; give two pictures of equal exposure with bright and dark parts of sky, or "
                     "--gain")  # fmt: skip
    elif known.gain_e_per_adu is None and not properties.same_sky:
        notes.append("gain: the sky moved between the pictures, and faint stars make it some per cent too low; best "
                     "are two pictures in quick succession")  # fmt: skip
    if bias is None:
        notes.append("bias: not measured; no dark corner outside the image circle: give --bias")
    if noise is None:
        notes.append("read noise: not measured; it needs gain and bias, or --read-noise")
    if properties.hot_px is None:
        notes.append("hot pixels: a list needs two pictures between which the sky has turned")
    sensor = None
    if throughput is not None and gain is not None and bias is not None:
        optional: dict[str, Any] = {
            "read_noise_e": noise,
            "saturation_adu": properties.saturation_adu,
            "psf_sigma_px": properties.psf_sigma_px,
        }
        sensor = Sensor(
            zero_point_e_per_s=throughput.zero_point_adu_per_s * gain,
            gain_e_per_adu=gain,
            bias_adu=bias,
            vignetting=throughput.vignetting,
            **{key: value for key, value in optional.items() if value is not None},
        )
    else:
        notes.append("[sensor] is left out of the camera file: it needs zero point, gain and bias")
    return Photometry(throughput=throughput, properties=properties, sensor=sensor, notes=tuple(notes))


def photometry_dict(found: Photometry) -> dict[str, Any]:
    """The photometry's part of the JSON record."""
    throughput, properties = found.throughput, found.properties
    light = None if throughput is None else vars(throughput) | {"vignetting": list(throughput.vignetting)}
    return {
        "light": light,
        "gain_e_per_adu": None if properties.transfer is None else properties.transfer.gain_e_per_adu,
        "gain_sigma_e_per_adu": None if properties.transfer is None else properties.transfer.gain_sigma,
        **{key: getattr(properties, key) for key in ("bias_adu", "saturation_adu", "psf_sigma_px")},
        "psf_by_ring_px": list(properties.psf_by_ring_px),
        "hot_pixels": None if properties.hot_px is None else len(properties.hot_px),
        "notes": list(found.notes),
    }
