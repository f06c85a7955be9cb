"""Widths of the stars over the image."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from startrack.applications.calibration.region_growing import JointFit
from startrack.core.types import Array
from startrack.psf import pixel_profile, stamp_radius

BRIGHT_SNR = 25.0
MAX_STARS = 400  # of an image
WIDTHS_PX = np.geomspace(0.35, 6.0, 40)


@dataclass(frozen=True)
class PsfWidths:
    """PSF sigma [px] before integration over the pixel, and where in the image it was measured."""

    sigma_px: Array  # (n,)
    angle_rad: Array  # (n,) off the axis
    flux_ratio: Array  # (n,) flux with the star's own width over the flux of the detector


def measure_psf_widths(joint: JointFit) -> PsfWidths:
    """Best-fitting Gaussian widths of the bright, unsaturated stars of all frames."""
    sigma, angle, ratio = [np.zeros(0)], [np.zeros(0)], [np.zeros(0)]
    for i, (frame, matched) in enumerate(zip(joint.frames, joint.matches, strict=True)):
        found = frame.sources
        used = matched.detection[joint.fit.used[joint.points.image == i]]
        used = used[(found.snr[used] > BRIGHT_SNR) & ~found.saturated[used]][:MAX_STARS]
        radius = stamp_radius(1.6 * found.psf_sigma_px) + 2
        width, height = frame.size_px
        px = found.xy_px[used]
        whole = np.all((px > radius + 1) & (px < np.array([width, height]) - radius - 2), axis=1)
        if whole.any():
            width_px, flux = _fit_widths(np.asarray(frame.exposure.pixels_adu), px[whole], radius)
            sigma.append(width_px)
            ratio.append(flux / found.flux_e[used[whole]])
            angle.append(joint.fit.camera.angle_rad(px[whole]))
    return PsfWidths(np.concatenate(sigma), np.concatenate(angle), np.concatenate(ratio))


def _fit_widths(image: Array, px: Array, radius: int) -> tuple[Array, Array]:
    """Width (n,) that fits each stamp best, interpolated between WIDTHS_PX, and the flux (n,) with it."""
    centre = np.rint(px).astype(int)
    side = 2 * radius + 1
    windows = np.lib.stride_tricks.sliding_window_view(image, (side, side))
    data = windows[centre[:, 1] - radius, centre[:, 0] - radius].astype(np.float64).reshape(len(px), -1)
    data = data - data.mean(axis=1, keepdims=True)
    offset = px - centre
    misfit = np.empty((len(WIDTHS_PX), len(px)))
    for k, width in enumerate(WIDTHS_PX):
        shape = _star_shape(offset, float(width), radius)
        misfit[k] = np.sum(data**2, axis=1) - np.sum(data * shape, axis=1) ** 2 / np.sum(shape**2, axis=1)
    best = np.clip(np.argmin(misfit, axis=0), 1, len(WIDTHS_PX) - 2)
    n = np.arange(len(px))
    left, middle, right = misfit[best - 1, n], misfit[best, n], misfit[best + 1, n]
    bend = left - 2 * middle + right
    shift = np.divide(0.5 * (left - right), bend, out=np.zeros_like(bend), where=bend > 0)
    step = np.log(WIDTHS_PX[1] / WIDTHS_PX[0])
    sigma = np.asarray(WIDTHS_PX[best] * np.exp(np.clip(shift, -1, 1) * step))
    shape = _star_shape(offset, sigma, radius)
    return sigma, np.sum(data * shape, axis=1) / np.sum(shape**2, axis=1)


def _star_shape(offset: Array, sigma_px: float | Array, radius: int) -> Array:
    """Star of unit flux in each stamp (n, pixels), its mean subtracted."""
    x, _ = pixel_profile(offset[:, 0], sigma_px, radius)
    y, _ = pixel_profile(offset[:, 1], sigma_px, radius)
    shape = (y[:, :, None] * x[:, None, :]).reshape(len(offset), -1)
    return np.asarray(shape - shape.mean(axis=1, keepdims=True))
