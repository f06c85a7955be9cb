"""Images of point sources.

The estimator's PSF is deliberately not used here: a half-pixel error in it must not cancel against the renderer's.
"""

from __future__ import annotations

import math

import numpy as np

from startrack.core.types import Array

# A stamp ends where a star leaves less than this in a pixel: far under any sensor's noise, even summed over the rim.
INVISIBLE_E_PER_PX = 0.02
MIN_RADIUS_PX = 3
CHUNK_ELEMENTS = 1 << 20  # of stamps spread at a time; keeps the work inside the processor's cache


def splat(image_e: Array, xy_px: Array, flux_e: Array, sigma_px: float) -> None:
    """Add to the image (H, W) [e] a Gaussian PSF, integrated over each pixel, for every source.

    image[y, x] += flux (Phi((x + 1/2 - x0)/s) - Phi((x - 1/2 - x0)/s)) (the same in y). Sources may lie off the frame.

    Args:
        image_e: (H, W) float64, C-contiguous; changed in place.
        xy_px: (n, 2) centres x0, y0; (0, 0) is the centre of the top-left pixel.
        flux_e: (n,) whole-PSF flux [electrons].
        sigma_px: standard deviation s of the Gaussian before integration over the pixel.
    """
    height, width = image_e.shape
    flat = image_e.reshape(-1)
    radii = stamp_radius_px(flux_e, sigma_px)
    near = np.all((xy_px > -0.5 - radii[:, None]) & (xy_px < np.array([width, height]) - 0.5 + radii[:, None]), axis=1)
    for radius in np.unique(radii[near]):
        members = np.flatnonzero(near & (radii == radius))
        step = max(1, CHUNK_ELEMENTS // (2 * radius + 1) ** 2)
        for start in range(0, len(members), step):
            chunk = members[start : start + step]
            columns, across = _profile(xy_px[chunk, 0], sigma_px, radius, width)
            rows, down = _profile(xy_px[chunk, 1], sigma_px, radius, height)
            light = (down * flux_e[chunk, None])[:, :, None] * across[:, None, :]
            index = (rows * width)[:, :, None] + columns[:, None, :]
            np.add.at(flat, index.reshape(-1), light.reshape(-1))


def stamp_radius_px(flux_e: Array, sigma_px: float) -> Array:
    """Half widths (n,) [px, whole] of the stamps outside which a source leaves under INVISIBLE_E_PER_PX in a pixel."""
    wide2 = sigma_px**2 + 1 / 12  # the pixel's own second moment widens the PSF
    peak = np.maximum(np.asarray(flux_e) / (2 * math.pi * wide2), INVISIBLE_E_PER_PX)
    radius = np.sqrt(2 * wide2 * np.log(peak / INVISIBLE_E_PER_PX))
    return np.maximum(np.ceil(radius).astype(np.int64), min(MIN_RADIUS_PX, math.ceil(4 * sigma_px)))


def _profile(centres_px: Array, sigma_px: float, radius: int, size: int) -> tuple[Array, Array]:
    """Pixel numbers (n, 2 r + 1) and the fractions of the flux in them; zero, and a legal number, off the frame."""
    from scipy.special import ndtr

    pixels = np.rint(centres_px).astype(np.int64)[:, None] + np.arange(-radius, radius + 1)
    edges = np.concatenate([pixels - 0.5, pixels[:, -1:] + 0.5], axis=1)
    fraction = np.diff(ndtr((edges - centres_px[:, None]) / sigma_px), axis=1)
    on_frame = (pixels >= 0) & (pixels < size)
    return np.where(on_frame, pixels, 0), np.where(on_frame, fraction, 0.0)
