"""Stars painted by scipy's normal distribution function, and the Cramer-Rao bound of their parameters.

Shares no code with the package, so that a mistake in its PSF is noticed.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import brentq
from scipy.special import ndtr

from startrack.camera import Camera, Sensor
from startrack.core.types import Exposure

SKYLINE_SIGMAS = 6.0


def paint(image: np.ndarray, xy_px: np.ndarray, flux: np.ndarray, sigma_px: float) -> None:
    """Add Gaussian stars, integrated over the pixels, to the image (H, W) in place."""
    reach = int(np.ceil(SKYLINE_SIGMAS * sigma_px)) + 1
    height, width = image.shape
    for (x, y), f in zip(xy_px, flux, strict=True):
        i, j = round(x), round(y)
        columns = np.arange(max(i - reach, 0), min(i + reach + 1, width))
        rows = np.arange(max(j - reach, 0), min(j + reach + 1, height))
        px = ndtr((columns + 0.5 - x) / sigma_px) - ndtr((columns - 0.5 - x) / sigma_px)
        py = ndtr((rows + 0.5 - y) / sigma_px) - ndtr((rows - 0.5 - y) / sigma_px)
        image[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1] += f * py[:, None] * px


def stamp(offset: np.ndarray, sigma_px: float, reach: int = 9) -> np.ndarray:
    """Normalised PSF (2 reach + 1)^2 of a star at the offset (2,) from the middle pixel."""
    image = np.zeros((2 * reach + 1, 2 * reach + 1))
    paint(image, np.array([offset]) + reach, np.ones(1), sigma_px)
    return image


def snr_of(flux: float, sigma_px: float, variance: float, offset: np.ndarray | None = None) -> float:
    """Matched-filter signal-to-noise ratio with the true PSF, the star's own shot noise included."""
    p = stamp(np.zeros(2) if offset is None else offset, sigma_px)
    return float(flux * np.sqrt(np.sum(p**2 / (variance + flux * p))))


def flux_of(snr: float, sigma_px: float, variance: float) -> float:
    """The flux that has this signal-to-noise ratio."""
    return brentq(lambda flux: snr_of(flux, sigma_px, variance) - snr, 0.0, 1e8, rtol=1e-9)


def cramer_rao(offset: np.ndarray, flux: float, sigma_px: float, variance: float) -> np.ndarray:
    """Lowest possible covariance (4, 4) of x, y, flux and level of one star on a flat background."""
    step = 1e-4
    p = stamp(offset, sigma_px)
    dx, dy = (
        flux * (stamp(offset + step * e, sigma_px) - stamp(offset - step * e, sigma_px)) / (2 * step) for e in np.eye(2)
    )
    gradient = np.stack([dx, dy, p, np.ones_like(p)]).reshape(4, -1)
    return np.linalg.inv((gradient / (variance + flux * p).ravel()) @ gradient.T)


def plain_camera(size_px: tuple[int, int], sigma_px: float, **sensor: float) -> Camera:
    """A camera whose numbers are electrons: gain 1, no bias."""
    return Camera(
        name="plain", size_px=size_px, focal_px=(600.0, 600.0), centre_px=(size_px[0] / 2, size_px[1] / 2),
        max_angle_rad=3.0, calibrated_angle_rad=3.0,
        sensor=Sensor(**({"zero_point_e_per_s": 1e5, "psf_sigma_px": sigma_px} | sensor)),
    )  # fmt: skip


@dataclass(frozen=True)
class StarField:
    """A frame of isolated stars and the truth about them."""

    exposure: Exposure
    xy_px: np.ndarray
    flux: np.ndarray
    snr: np.ndarray


def isolated_stars(
    sigma_px: float, background: float, read_noise: float, snr_range: tuple[float, float], *, rng: np.random.Generator,
    size: int = 1024, spacing: int = 24,
) -> StarField:  # fmt: skip
    """Stars on a jittered grid, signal-to-noise ratios spread evenly in their logarithm; values are whole electrons."""
    variance = background + read_noise**2
    grid = np.arange(spacing, size - spacing, spacing)
    xy = np.stack(np.meshgrid(grid, grid), axis=-1).reshape(-1, 2) + rng.uniform(-3, 3, (len(grid) ** 2, 2))
    ladder = np.geomspace(*snr_range, 40)
    fluxes = np.array([flux_of(s, sigma_px, variance) for s in ladder])
    snr = np.exp(rng.uniform(*np.log(snr_range), len(xy)))
    flux = np.interp(snr, ladder, fluxes)
    image = np.full((size, size), background)
    paint(image, xy, flux, sigma_px)
    counts = np.rint(rng.poisson(image) + rng.normal(0, read_noise, image.shape))
    exposure = Exposure(pixels_adu=counts.astype(np.float32), saturation_adu=65535.0)
    return StarField(exposure, xy, flux, snr)
