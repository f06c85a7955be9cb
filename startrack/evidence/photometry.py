"""Forced photometry: the light at the very pixel where the catalogue says that a star is."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from startrack.psf import pixel_profile_single, stamp_radius
from startrack.types import Array, Bools, Ints

OUTLIER_SIGMA = 5.0
MODEL_ERROR = 0.05  # of a star's light, pixel by pixel: the real PSF is not quite the Gaussian
STARS_AT_ONCE = 2000  # stamps that stay in the processor's cache together
MOST_MASKED_PX = 6  # a stamp with more deviant pixels is not a star on a smooth background


@dataclass(frozen=True, kw_only=True)
class Photometry:
    """Measured fluxes at predicted places (n)."""

    flux_e: Array  # (n,) local level and neighbours subtracted
    variance_e2: Array  # (n,) from the pixels' noise, without the star's own light
    own_shot: Array  # (n,) variance per electron of the star's own light
    neighbour_variance_e2: Array  # (n,) from not knowing whether and how brightly the neighbours shine
    usable: Bools  # (n,) enough good pixels


@dataclass(frozen=True, kw_only=True)
class Sources:
    """Where stars would shine and how brightly (n)."""

    xy_px: Array  # (n, 2)
    flux_e: Array  # (n,) expected if visible
    fraction_sigma: Array  # (n,) its relative uncertainty
    visible: Array  # (n,) probability that it shines, for its part in its neighbours' measurements


def half_width(sigma_px: float) -> int:
    """Half width [px] of the measuring stamp: the star and enough around it to know the local level."""
    return stamp_radius(sigma_px) + 1


def measure(
    image: NDArray[np.float32], noise: NDArray[np.float32], dead: NDArray[np.bool_], sources: Sources, sigma_px: float
) -> Photometry:
    """Flux and local level at each source by linear least squares, deviant pixels masked.

    `image` is background-subtracted [e], `noise` the standard deviation of a pixel [e], `dead` marks saturated pixels.
    All sources must lie at least `half_width` inside the frame. The neighbours' expected light is subtracted.
    """
    from scipy.spatial import cKDTree

    radius = half_width(sigma_px)
    # Down the frame, so that neighbours in the list are neighbours in memory.
    order = np.argsort(sources.xy_px[:, 1], kind="stable")
    sources = Sources(**{name: getattr(sources, name)[order] for name in Sources.__dataclass_fields__})
    centre = np.rint(sources.xy_px).astype(np.int64)
    found = cKDTree(sources.xy_px).query_pairs(radius + 3.0 * sigma_px, output_type="ndarray")
    pairs = np.concatenate([found, found[:, ::-1]]).astype(np.int64)  # of a star and its neighbour
    pairs = pairs[np.argsort(pairs[:, 0], kind="stable")]
    pictures = image, noise, dead
    parts = []
    for start in range(0, max(len(centre), 1), STARS_AT_ONCE):
        some = slice(start, start + STARS_AT_ONCE)
        first, last = np.searchsorted(pairs[:, 0], [start, start + STARS_AT_ONCE])
        parts.append(_measured(pictures, sources, centre[some], pairs[first:last], start, sigma_px, radius))
    fields = Photometry.__dataclass_fields__
    back = np.argsort(order)
    return Photometry(**{name: np.concatenate([getattr(part, name) for part in parts])[back] for name in fields})


def _measured(
    pictures: tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.bool_]],
    sources: Sources,
    centre: Ints,
    pairs: Ints,
    start: int,
    sigma_px: float,
    radius: int,
) -> Photometry:
    """The sources `start`.. whose stamps are around the pixels `centre` (n, 2); `pairs` (m, 2) are theirs."""
    n = len(centre)
    profile = _profiles(sources.xy_px[start : start + n] - centre, sigma_px, radius)
    image, noise, dead = (_stamps(picture, centre, radius).reshape(profile.shape) for picture in pictures)
    own_row, neighbour = pairs[:, 0] - start, pairs[:, 1]
    overlap = _profiles(sources.xy_px[neighbour] - centre[own_row], sigma_px, radius)
    expected = (sources.flux_e[neighbour] * sources.visible[neighbour]).astype(np.float32)
    light = _summed(expected[:, None] * overlap, own_row, n)
    data, variance, good = image - light, np.square(noise), ~dead
    flux, weights = _fit(data, profile, good / variance)
    masked = np.zeros(n, dtype=np.int64)
    redo = np.arange(n)
    # The worst pixel first: a bright one drags the fit so far that its innocent neighbours look deviant too.
    for _ in range(MOST_MASKED_PX + 1):
        excess = _excess(data[redo], variance[redo], light[redo], profile[redo], good[redo], flux[redo])
        worst = np.argmax(excess, axis=1)
        deviant = excess[np.arange(len(redo)), worst] > OUTLIER_SIGMA**2
        redo, worst = redo[deviant], worst[deviant]
        if not len(redo):
            break
        good[redo, worst] = False
        masked[redo] += 1
        flux[redo], weights[redo] = _fit(data[redo], profile[redo], good[redo] / variance[redo])
    usable = (masked <= MOST_MASKED_PX) & (np.where(good, profile, 0.0).sum(axis=1) > 0.5)
    weights[~usable] = 0.0
    shining, fraction = sources.visible[neighbour], sources.fraction_sigma[neighbour]
    uncertain = np.square(sources.flux_e[neighbour]) * (shining * (1 - shining) + shining * np.square(fraction))
    leak = np.square(np.einsum("mp,mp->m", weights[own_row], overlap))
    return Photometry(
        flux_e=np.where(usable, flux, 0.0),
        variance_e2=np.where(usable, np.einsum("np,np,np->n", weights, weights, variance + light), 1.0),
        own_shot=np.einsum("np,np,np->n", weights, weights, profile),
        neighbour_variance_e2=np.bincount(own_row, weights=leak * uncertain, minlength=n).astype(np.float64),
        usable=usable,
    )


def _stamps(picture: NDArray[Any], centre: Ints, radius: int) -> NDArray[Any]:
    """The squares (n, side, side) around the pixels `centre` (n, 2)."""
    windows = np.lib.stride_tricks.sliding_window_view(picture, (2 * radius + 1, 2 * radius + 1))
    return windows[centre[:, 1] - radius, centre[:, 0] - radius]


def _excess(data: Array, variance: Array, light: Array, profile: Array, good: Bools, flux: Array) -> Array:
    """Squared deviation (n, pixels) of the good pixels from the fit, in units of its variance."""
    stars = np.maximum(flux, 0.0)[:, None] * profile + light
    rest = data - flux[:, None] * profile - _level(data, profile, good / variance, flux)[:, None]
    return np.where(good, np.square(rest) / (variance + stars + np.square(MODEL_ERROR * stars)), 0.0)


def _profiles(offset_px: Array, sigma_px: float, radius: int) -> Any:
    """PSF on the stamps (n, pixels), float32."""
    px, _ = pixel_profile_single(offset_px[:, 0], sigma_px, radius)  # stamps are large and pixels have no more digits
    py, _ = pixel_profile_single(offset_px[:, 1], sigma_px, radius)
    return (py[:, :, None] * px[:, None, :]).reshape(len(px), (2 * radius + 1) ** 2)


def _summed(rows: Array, group: Ints, n: int) -> Array:
    """Sums (n, pixels) of the rows by group."""
    from scipy.sparse import csr_matrix

    ones = np.ones(len(group), np.float32)
    sparse = csr_matrix((ones, (group, np.arange(len(group)))), shape=(n, len(group)))
    return np.asarray(sparse @ rows)


def _fit(data: Array, profile: Array, weight: Array) -> tuple[Array, Array]:
    """Flux (n,) with a free constant level, and the weights (n, pixels) that give it: flux = sum weights data."""
    total = np.maximum(weight.sum(axis=1), 1e-30)
    middle = np.einsum("np,np->n", weight, profile) / total
    centred = weight * (profile - middle[:, None])
    strength = np.einsum("np,np->n", centred, profile)
    # A stamp without a good pixel measures nothing; the caller marks it unusable.
    weights = np.divide(centred, strength[:, None], out=np.zeros_like(centred), where=strength[:, None] > 0)
    return np.einsum("np,np->n", weights, data), weights


def _level(data: Array, profile: Array, weight: Array, flux: Array) -> Array:
    rest = data - flux[:, None] * profile
    return np.einsum("np,np->n", weight, rest) / np.maximum(weight.sum(axis=1), 1e-30)
