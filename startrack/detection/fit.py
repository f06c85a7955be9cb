"""Least-squares fits of point sources: centroids and fluxes at the Cramer-Rao bound."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np

from startrack.detection.artifacts import single_pixel_chi2
from startrack.detection.frame import LightNoise, Pixels
from startrack.psf import pixel_profile_single
from startrack.types import Array, Bools, Ints

ROUNDS, ROUNDS_AGAIN = 3, 2  # of flux and level, then of all four; where a fit has been before
BATCH_PIXELS = 65536  # of stamps worked on at a time: what a processor's cache holds
# Products of the profile P and its derivative D by which x and y enter the normal matrix.
PP, PD, DD, P, D, ONE = range(6)


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


@dataclass(frozen=True)
class Stamps:
    """Cut-outs (n, s, s) around the pixels `centres` (n, 2), and the level (n,) of their wider surroundings."""

    data: Pixels
    variance: Pixels
    usable: Bools | None
    centres: Ints
    surround: Array

    def part(self, which: slice | Ints) -> Stamps:
        """Some of them."""
        usable = None if self.usable is None else self.usable[which]
        return Stamps(self.data[which], self.variance[which], usable, self.centres[which], self.surround[which])


def fit_points(
    stamps: Stamps, start_xy_px: Array, sigma_px: float, light_noise: LightNoise, own_part: float, rounds: int = ROUNDS
) -> PointFits:
    """Position, flux and local level of one point source in each stamp.

    Only the significance relies on `surround`, which holds `own_part` of the source's own light. Gauss-Newton on the
    pixel-integrated Gaussian from `start_xy_px` (n, 2); steps are limited to half a pixel, so a hopeless source stays
    near where it was. Weights: the pixels' variance and what the source's own light adds to it.
    """
    size = max(1, BATCH_PIXELS // (stamps.data.shape[1] * stamps.data.shape[2]))
    batches = [
        _fit(stamps.part(slice(at, at + size)), start_xy_px[at : at + size], sigma_px, light_noise, own_part, rounds)
        for at in range(0, max(len(start_xy_px), 1), size)
    ]
    return joined(batches)


def joined(parts: list[PointFits]) -> PointFits:
    """The fits of all parts, one after the other."""
    return PointFits(**{f.name: np.concatenate([getattr(b, f.name) for b in parts]) for f in fields(PointFits)})


def _fit(
    s: Stamps, start_xy_px: Array, sigma_px: float, light_noise: LightNoise, own_part: float, rounds: int
) -> PointFits:
    radius = s.data.shape[1] // 2
    offset = np.clip(start_xy_px - s.centres, -radius, radius)
    n = len(s.data)
    flux, level = np.zeros(n), np.zeros(n)
    weights = _masked(1.0 / s.variance, s.usable)
    for step in range(rounds + 1):
        if step != 1:  # the first step leaves the places as they are
            px, dx = pixel_profile_single(offset[:, 0], sigma_px, radius)
            py, dy = pixel_profile_single(offset[:, 1], sigma_px, radius)
            shape = py[:, :, None] * px[:, None, :]
        if step > 0:  # a flux is known, and with it the noise of the star's own light
            weights = _weights(s, flux, shape, light_noise)
        miss = s.data - flux[:, None, None].astype(np.float32) * shape - level[:, None, None].astype(np.float32)
        normal, right = _normal_equations(weights, miss, flux, (px, dx), (py, dy))
        if step == rounds:
            break
        if step == 0:  # flux and level first: without a flux the position has no gradient
            delta = _solved_pairs(normal[:, 2:, 2:], right[:, 2:])
            flux, level = flux + delta[:, 0], level + delta[:, 1]
            continue
        delta = np.asarray(np.linalg.solve(normal, right[..., None])[..., 0], dtype=np.float64)
        offset = np.clip(offset + np.clip(delta[:, :2], -0.5, 0.5), -radius, radius)
        flux, level = flux + delta[:, 2], level + delta[:, 3]
    chi2: Array = np.einsum("nij,nij,nij->n", weights, miss, miss, dtype=np.float64)
    covariance = np.asarray(np.linalg.inv(normal), dtype=np.float64)
    return _judged(s, offset, flux, level, covariance, chi2, shape, light_noise, own_part)


def _judged(
    s: Stamps, offset: Array, flux: Array, level: Array, covariance: Array, chi2: Array,
    shape: Pixels, light_noise: LightNoise, own_part: float,
) -> PointFits:  # fmt: skip
    plain = _masked(1.0 / s.variance, s.usable)
    filtered = plain * shape
    light = np.maximum(flux, 0.0)[:, None, None].astype(np.float32) * shape
    against_nothing = np.einsum("nij,nij->n", filtered, s.data - s.surround[:, None, None].astype(np.float32))
    norm = np.einsum("nij,nij->n", filtered, shape)
    own = np.einsum("nij,nij->n", filtered, shape / (1.0 + np.float32(light_noise.per_unit) * light / s.variance))
    # The level of the surroundings was taken from pixels that hold the star: it lowers signal by `own_part`, noise by
    # its root.
    undiluted = np.sqrt(np.maximum(norm, 1e-30) * (1.0 - own_part))
    count = s.data.shape[1] * s.data.shape[2] if s.usable is None else s.usable.sum(axis=(1, 2))
    return PointFits(
        xy_px=s.centres + offset,
        flux=flux,
        level=level,
        covariance=covariance,
        chi2=chi2,
        chi2_pixel=single_pixel_chi2(s.data, plain),
        dof=np.broadcast_to(np.maximum(count - 4.0, 1.0), flux.shape).astype(np.float64),
        surround=s.surround,
        significance=against_nothing / undiluted,
        snr=flux * np.sqrt(own),
    )


def _normal_equations(
    weights: Pixels, miss: Pixels, flux: Array, x: tuple[Pixels, Pixels], y: tuple[Pixels, Pixels]
) -> tuple[Array, Array]:
    """Normal matrix (n, 4, 4) and right side (n, 4) for x, y, flux, level: sums over x, then over y.

    A whiff of a prior (positions within ~3 px of the start) keeps sources without light solvable.
    """
    across, down = _products(*x), _products(*y)
    m = np.matmul(down, np.matmul(weights, across.transpose(0, 2, 1))).astype(np.float64)  # (n, 6 of y, 6 of x)
    few_y, few_x = down[:, P:], across[:, P:]
    r = np.matmul(few_y, np.matmul(weights * miss, few_x.transpose(0, 2, 1))).astype(np.float64)  # (n, 3, 3)
    normal = np.empty((len(flux), 4, 4))
    normal[:, 0, 0] = flux * flux * m[:, PP, DD] + 0.1
    normal[:, 1, 1] = flux * flux * m[:, DD, PP] + 0.1
    normal[:, 0, 1] = normal[:, 1, 0] = flux * flux * m[:, PD, PD]
    normal[:, 0, 2] = normal[:, 2, 0] = flux * m[:, PP, PD]
    normal[:, 1, 2] = normal[:, 2, 1] = flux * m[:, PD, PP]
    normal[:, 0, 3] = normal[:, 3, 0] = flux * m[:, P, D]
    normal[:, 1, 3] = normal[:, 3, 1] = flux * m[:, D, P]
    normal[:, 2, 2] = m[:, PP, PP] + 1e-12
    normal[:, 2, 3] = normal[:, 3, 2] = m[:, P, P]
    normal[:, 3, 3] = m[:, ONE, ONE] + 1e-12
    right = np.stack([flux * r[:, 0, 1], flux * r[:, 1, 0], r[:, 0, 0], r[:, 2, 2]], axis=1)
    return normal, right


def _products(profile: Pixels, slope: Pixels) -> Pixels:
    """(n, 6, s): the products PP, PD, DD, P, D, ONE of a profile and its slope."""
    products = np.empty((len(profile), 6, profile.shape[1]), dtype=profile.dtype)
    np.multiply(profile, profile, out=products[:, PP])
    np.multiply(profile, slope, out=products[:, PD])
    np.multiply(slope, slope, out=products[:, DD])
    products[:, P], products[:, D], products[:, ONE] = profile, slope, 1.0
    return products


def _solved_pairs(normal: Array, right: Array) -> Array:
    """Solutions (n, 2) of the 2 x 2 systems."""
    a, b, d = normal[:, 0, 0], normal[:, 0, 1], normal[:, 1, 1]
    determinant = np.maximum(a * d - b * b, 1e-300)
    return (
        np.stack([d * right[:, 0] - b * right[:, 1], a * right[:, 1] - b * right[:, 0]], axis=1) / determinant[:, None]
    )


def _weights(s: Stamps, flux: Array, shape: Pixels, light_noise: LightNoise) -> Pixels:
    light = np.maximum(flux, 0.0)[:, None, None].astype(np.float32) * shape
    variance = s.variance + light * (np.float32(light_noise.per_unit) + np.float32(light_noise.model_error**2) * light)
    return _masked(1.0 / variance, s.usable)


def _masked(weights: Pixels, usable: Bools | None) -> Pixels:
    return weights if usable is None else weights * usable
