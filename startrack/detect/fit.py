"""Least-squares fits of point sources: centroids and fluxes at the Cramer-Rao bound."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from startrack.detect.impostors import single_pixel_chi2
from startrack.psf import pixel_profile, stamp_radius
from startrack.types import Array, Bools, Ints

ITERATIONS = 4
MODEL_ERROR = 0.03  # fraction of a star's own light by which real PSFs differ from the Gaussian


@dataclass(frozen=True, kw_only=True)
class PointFits:
    """Fitted point sources (n) and how well they fit."""

    xy_px: Array  # (n, 2)
    flux: Array  # (n,)
    level: Array  # (n,) local background
    covariance: Array  # (n, 4, 4) of x, y, flux, level
    chi2: Array  # (n,) of the point source
    chi2_pixel: Array  # (n,) of a single bright pixel instead
    dof: Array  # (n,)
    surround: Array  # (n,) level of the wider surroundings
    significance: Array  # (n,) matched-filter SNR of the light against nothing but background noise
    snr: Array  # (n,) matched-filter SNR, the source's own photon noise included

    def take(self, which: Ints) -> PointFits:
        """The fits selected by indices."""
        return PointFits(**{f.name: getattr(self, f.name)[which] for f in fields(self)})

    def replaced(self, which: Ints, others: PointFits) -> PointFits:
        """These fits with those at the indices exchanged for the `others`."""
        values = {f.name: getattr(self, f.name).copy() for f in fields(self)}
        for name, value in values.items():
            value[which] = getattr(others, name)
        return PointFits(**values)


def stamps(image: NDArray[Any], centres: Ints, radius: int) -> Array:
    """Cut-outs (n, 2r+1, 2r+1) of the image around the integer pixels (n, 2) (x, y), which must be `radius` inside."""
    side = 2 * radius + 1
    windows = np.lib.stride_tricks.sliding_window_view(image, (side, side))
    return windows[centres[:, 1] - radius, centres[:, 0] - radius].astype(np.float64)


def fit_points(
    data: Array,
    variance: Array,
    usable: Bools,
    centres: Ints,
    start_xy_px: Array,
    surround: Array,
    sigma_px: float,
    shot: bool,
) -> PointFits:
    """Position, flux and local level of one point source in each stamp.

    `data`, `variance`, `usable` are stamps (n, s, s) around the pixels `centres` (n, 2); `surround` (n,) is the level
    of the wider surroundings, which only the significance relies on. With `shot`, the source's own photon noise (flux
    in electrons) is added to the variance; a model error of a few per cent always is. Gauss-Newton on the
    pixel-integrated Gaussian; steps are limited to half a pixel, so a hopeless source stays near where it was.
    """
    radius = data.shape[1] // 2
    offset = start_xy_px - centres
    n = len(data)
    weights: Array = usable / variance
    flux: Array = np.zeros(n)
    level: Array = np.zeros(n)
    covariance: Array = np.zeros((n, 4, 4))
    for step in range(ITERATIONS + 1):
        px, dx = pixel_profile(offset[:, 0], sigma_px, radius)
        py, dy = pixel_profile(offset[:, 1], sigma_px, radius)
        shape = py[:, :, None] * px[:, None, :]
        if step > 0:
            light = np.maximum(flux, 0.0)[:, None, None] * shape
            weights = usable / (variance + (light if shot else 0.0) + np.square(MODEL_ERROR * light))
        gradient = np.stack(
            [
                flux[:, None, None] * py[:, :, None] * dx[:, None, :],
                flux[:, None, None] * dy[:, :, None] * px[:, None, :],
                shape,
                np.ones_like(shape),
            ],
            axis=1,
        ).reshape(n, 4, -1)
        miss = (data - flux[:, None, None] * shape - level[:, None, None]).reshape(n, -1)
        w = weights.reshape(n, -1)
        weighted = gradient * w[:, None, :]
        normal = weighted @ gradient.transpose(0, 2, 1)
        right = (weighted @ miss[:, :, None])[..., 0]
        # A whiff of a prior (positions within ~3 px of the start) keeps sources without light solvable.
        normal[:, [0, 1], [0, 1]] += 0.1
        normal[:, [2, 3], [2, 3]] += 1e-12
        delta: Array = np.zeros((n, 4))
        if step == 0:  # flux and level first: without a flux the position has no gradient
            delta[:, 2:] = np.linalg.solve(normal[:, 2:, 2:], right[:, 2:, None])[..., 0]
        elif step < ITERATIONS:
            delta[:] = np.linalg.solve(normal, right[..., None])[..., 0]
        else:
            covariance[:] = np.linalg.inv(normal)
            break
        offset = offset + np.clip(delta[:, :2], -0.5, 0.5)
        offset = np.clip(offset, -radius, radius)
        flux, level = flux + delta[:, 2], level + delta[:, 3]
    chi2 = np.einsum("np,np->n", w, miss**2)
    filtered = usable / variance * shape
    against_nothing = np.sum(filtered * (data - surround[:, None, None]), axis=(1, 2))
    own = np.sum(usable * shape**2 / (variance + (light if shot else 0.0)), axis=(1, 2))
    return PointFits(
        xy_px=centres + offset,
        flux=flux,
        level=level,
        covariance=covariance,
        chi2=chi2,
        chi2_pixel=single_pixel_chi2(data, usable / variance),
        dof=np.maximum(usable.sum(axis=(1, 2)) - 4.0, 1.0),
        surround=surround,
        significance=against_nothing / np.sqrt(np.maximum(np.sum(filtered * shape, axis=(1, 2)), 1e-300)),
        snr=flux * np.sqrt(own),
    )


def fit_widths(data: Array, variance: Array, usable: Bools, fits: PointFits, centres: Ints, widths_px: Array) -> Array:
    """Best-fitting PSF sigma (n,) [px] of each stamp among `widths_px` (m,), refined by a parabola through chi^2."""
    radius = data.shape[1] // 2
    offset = fits.xy_px - centres
    w = (usable / variance).reshape(len(data), -1)
    flat = data.reshape(len(data), -1)
    chi2 = np.empty((len(data), len(widths_px)))
    for i, width in enumerate(widths_px):
        px, _ = pixel_profile(offset[:, 0], float(width), radius)
        py, _ = pixel_profile(offset[:, 1], float(width), radius)
        shape = (py[:, :, None] * px[:, None, :]).reshape(len(data), -1)
        sums = [np.einsum("np,np->n", w, q) for q in (shape * shape, shape, np.ones_like(shape), shape * flat, flat)]
        ss, s1, n1, sd, d1 = sums
        determinant = ss * n1 - s1 * s1
        flux = (n1 * sd - s1 * d1) / determinant
        level = (ss * d1 - s1 * sd) / determinant
        chi2[:, i] = np.einsum("np,np->n", w, np.square(flat - flux[:, None] * shape - level[:, None]))
    best = np.clip(np.argmin(chi2, axis=1), 1, len(widths_px) - 2)
    row = np.arange(len(data))
    left, middle, right = chi2[row, best - 1], chi2[row, best], chi2[row, best + 1]
    bend = left - 2 * middle + right
    shift = np.divide(0.5 * (left - right), bend, out=np.zeros_like(bend), where=bend > 0)
    log_width = np.log(widths_px)
    step = log_width[1] - log_width[0]
    return np.exp(log_width[best] + np.clip(shift, -1, 1) * step)


def radius_for(sigma_px: float) -> int:
    """Half width [px] of the fitting stamp: the star and a rim of background for the local level."""
    return stamp_radius(sigma_px) + 1
