"""Frames of stars for the detection benchmark: pixel-integrated Gaussians, Poisson noise, read noise, rounding.

Independent of the package: own PSF, own noise, own Cramer-Rao bound.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree
from scipy.special import ndtr

BACKGROUND_E, READ_NOISE_E = 100.0, 3.0
VARIANCE_E2 = BACKGROUND_E + READ_NOISE_E**2
APART_SIGMAS = 8.0  # stars nearer to another one, and nearer to the border, are not counted


@dataclass(frozen=True)
class Frame:
    """One frame in electrons and the truth about its stars."""

    image: np.ndarray  # (H, W) float32
    sigma_px: float
    xy_px: np.ndarray  # (n, 2)
    snr: np.ndarray  # (n,) of a matched filter with the true PSF, the star's own photon noise included
    bound_px: np.ndarray  # (n,) Cramer-Rao bound of one coordinate, flux and level unknown
    alone: np.ndarray  # (n,) without a near neighbour or border


def profiles(offset_px: np.ndarray, sigma_px: float, radius: int) -> tuple[np.ndarray, np.ndarray]:
    """The Gaussian integrated over pixels -radius..radius (n, 2 radius + 1), and its derivative by the offset."""
    edges = (np.arange(-radius, radius + 2) - 0.5 - offset_px[:, None]) / sigma_px
    density = np.exp(-0.5 * edges**2) / np.sqrt(2 * np.pi)
    return np.diff(ndtr(edges), axis=1), -np.diff(density, axis=1) / sigma_px


def star_frame(
    sigma_px: float, stars: int, snr_range: tuple[float, float], *, rng: np.random.Generator, size_px: int = 2048
) -> Frame:
    """`stars` at random positions, their SNR uniform in the logarithm over `snr_range`."""
    xy = rng.uniform(0, size_px - 1, (stars, 2))
    pixel = np.rint(xy).astype(int)
    radius = int(np.ceil(5 * sigma_px)) + 1
    px, dx = profiles(xy[:, 0] - pixel[:, 0], sigma_px, radius)
    py, dy = profiles(xy[:, 1] - pixel[:, 1], sigma_px, radius)
    shape = py[:, :, None] * px[:, None, :]
    snr = np.exp(rng.uniform(*np.log(snr_range), stars))
    flux = _flux(snr, shape)
    image = np.full((size_px + 2 * radius, size_px + 2 * radius), BACKGROUND_E)
    for (x, y), light in zip(pixel, flux[:, None, None] * shape, strict=True):
        image[y : y + 2 * radius + 1, x : x + 2 * radius + 1] += light
    image = image[radius:-radius, radius:-radius]
    counts = np.rint(rng.poisson(image) + rng.normal(0, READ_NOISE_E, image.shape)).astype(np.float32)
    by_x, by_y = py[:, :, None] * dx[:, None, :], dy[:, :, None] * px[:, None, :]
    apart = cKDTree(xy).query(xy, k=2)[0][:, 1] > APART_SIGMAS * sigma_px if stars > 1 else np.ones(stars, bool)
    inside = (np.abs(xy - (size_px - 1) / 2) < size_px / 2 - APART_SIGMAS * sigma_px - 2).all(axis=1)
    return Frame(counts, sigma_px, xy, snr, _bound(flux, shape, by_x, by_y), apart & inside)


def _flux(snr: np.ndarray, shape: np.ndarray) -> np.ndarray:
    """Fluxes [e] with which stars of these shapes (n, s, s) have the SNR (n,): snr^2 = sum (f P)^2 / (v + f P)."""
    low, high = np.zeros(len(snr)), np.full(len(snr), 1e9)
    for _ in range(80):
        middle = 0.5 * (low + high)
        light = middle[:, None, None] * shape
        short = np.sum(light**2 / (VARIANCE_E2 + light), axis=(1, 2)) < snr**2
        low, high = np.where(short, middle, low), np.where(short, high, middle)
    return high


def _bound(flux: np.ndarray, shape: np.ndarray, by_x: np.ndarray, by_y: np.ndarray) -> np.ndarray:
    """Root of the mean Cramer-Rao variance of x and y (n,) [px], from the Fisher matrix of (x, y, flux, level)."""
    light = flux[:, None, None]
    gradient = np.stack([light * by_x, light * by_y, shape, np.ones_like(shape)], axis=1)
    gradient = gradient.reshape(len(flux), 4, -1)
    weight = 1.0 / (VARIANCE_E2 + (light * shape).reshape(len(flux), -1))
    variance = np.linalg.inv(np.einsum("nip,np,njp->nij", gradient, weight, gradient))
    return np.sqrt(0.5 * (variance[:, 0, 0] + variance[:, 1, 1]))
