"""Fits of all candidates, each with the flux of its neighbours subtracted."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from startrack.core.limits import check_time
from startrack.core.types import Array, Ints
from startrack.detection.fit import (
    FIT_ROUNDS,
    FIT_ROUNDS_AGAIN,
    PointFits,
    Stamps,
    fit_points,
    measure_source_noise,
    profile_scratch,
)
from startrack.detection.frame import Frame, Pixels, SourceNoise, cut_stamps, radius_for
from startrack.detection.peaks import MAX_STAMP_PIXELS, Peaks
from startrack.kernels.library import kernel
from startrack.psf import pixel_profile_single

CROWDED_ROUNDS = 3  # of subtracting neighbours and fitting again
NEIGHBOUR_SIGMA = 0.1  # of a pixel's noise: a neighbour's signal above this is subtracted


@dataclass(frozen=True)
class Fitted:
    """All candidates (n) with their stamps and fits, and the noise of the sources' own signal."""

    stamps: Stamps
    fits: PointFits
    source_noise: SourceNoise


def fit_all(frame: Frame, peaks: Peaks, sigma: float, known: PointFits | None = None) -> Fitted:
    """Fits of all candidates. `known`: earlier fits of the first peaks, refined once; `frame.found` contains them."""
    from scipy.spatial import cKDTree

    check_time()
    radius, centres = radius_for(sigma), peaks.centres
    data, variance = frame.cut_light(centres, radius)
    stamps = Stamps(data, variance, frame.usable_pixels(centres, radius), centres, peaks.surround)
    every, refined = np.arange(len(centres)), 0 if known is None else len(known.flux)
    last = np.zeros_like(data)  # neighbours' signal subtracted in the last fit
    if known is not None and frame.found is not None:
        last = cut_stamps(frame.found, centres, radius)
        last[:refined] -= source_signal(known.xy_px - centres[:refined], known.flux, sigma, radius)
        last[np.square(last).max(axis=(1, 2)) <= NEIGHBOUR_SIGMA**2 * variance[:, radius, radius]] = 0.0
    parts = [
        fit_points(
            stamps, which, peaks.start_xy_px[which], sigma, frame.source_noise, peaks.own_part, rounds,
            None if known is None else last[which],
        )
        for which, rounds in ((every[:refined], FIT_ROUNDS_AGAIN), (every[refined:], FIT_ROUNDS))
        if len(which)
    ]  # fmt: skip
    fits = parts[0] if len(parts) == 1 else PointFits.concatenate(*parts)
    pairs = cKDTree(centres).query_pairs(1.5 * radius + 3.0 * sigma, output_type="ndarray")  # stamps that overlap
    pairs = np.concatenate([pairs, pairs[:, ::-1]])
    star, other = pairs[np.argsort(pairs[:, 0], kind="stable")].T
    alone = np.ones(len(centres), dtype=bool)
    alone[star[_are_relevant(stamps, fits, star, other, sigma)]] = False
    source_noise = measure_source_noise(stamps, fits, alone, sigma, frame.source_noise)

    def fit_again(which: Ints, signal: Pixels) -> PointFits:
        again = fit_points(
            stamps, which, fits.xy_px[which], sigma, source_noise, peaks.own_part, FIT_ROUNDS_AGAIN, signal
        )
        return fits.with_rows(which, again)

    bright = _find_reweighted(fits, sigma, variance, frame.source_noise, source_noise)
    if len(bright):
        fits = fit_again(bright, last[bright])
    for _ in range(CROWDED_ROUNDS):
        check_time()
        counts = _are_relevant(stamps, fits, star, other, sigma)
        crowded, signal = _changed_signal(stamps, fits, star[counts], other[counts], sigma, last)
        if not len(crowded):
            break
        last[crowded] = signal
        fits = fit_again(crowded, signal)
    return Fitted(stamps, fits, source_noise)


def _find_reweighted(fits: PointFits, sigma: float, variance: Pixels, was: SourceNoise, now: SourceNoise) -> Ints:
    """Candidates whose middle pixel's variance changes by more than a tenth with the measured source noise."""
    signal = np.maximum(fits.flux, 0.0) / (2.0 * np.pi * sigma**2 + 1.0)
    dark = variance[:, variance.shape[1] // 2, variance.shape[2] // 2]
    before, after = (dark + signal * (n.per_unit + n.model_error**2 * signal) for n in (was, now))
    return np.flatnonzero(np.abs(after - before) > 0.1 * before)


def _changed_signal(
    s: Stamps, fits: PointFits, star: Ints, other: Ints, sigma: float, last: Pixels
) -> tuple[Ints, Pixels]:
    """The candidates (k,) whose stamps hold other neighbours' light than `last` (n, s, s), and that light (k, s, s).

    `star` and `other` (m,) are pairs of a candidate and a neighbour, sorted by the first.
    """
    crowded = star[np.flatnonzero(np.diff(star, prepend=-1))]
    signal = np.empty((len(crowded), *last.shape[1:]), dtype=np.float32)
    offset_px = fits.xy_px[other] - s.centres[star]
    changed = np.zeros(len(crowded), dtype=np.bool_)
    _sum_neighbours(
        star, offset_px, fits.flux[other], sigma, s.variance, NEIGHBOUR_SIGMA, last, profile_scratch(last.shape[1]),
        signal, changed,
    )  # fmt: skip
    return crowded[changed], signal[changed]


def _are_relevant(s: Stamps, fits: PointFits, star: Ints, other: Ints, sigma: float) -> Array:
    """Whether pairs (m,) are relevant: the neighbour's signal at the stamp's nearest pixel exceeds the noise limit."""
    radius = s.data.shape[1] // 2
    beyond = np.maximum(np.abs(fits.xy_px[other] - s.centres[star]) - radius - 0.5, 0.0)
    wing = np.exp(-0.5 * np.sum(np.square(beyond), axis=1) / (sigma**2 + 0.1))
    top = min(1.0, 1.0 / (2 * np.pi * sigma**2))
    noise = np.sqrt(s.variance[star, radius, radius])
    return np.asarray(fits.flux[other] * top * wing > 0.3 * NEIGHBOUR_SIGMA * noise)


def source_signal(offset_px: Array, flux: Array, sigma: float | Array, radius: int) -> Pixels:
    """Signal (n, s, s) of sources of these fluxes (n,) at offsets (n, 2) [px] from the middle of their stamps.

    s is 2 `radius` + 1, `sigma` [px] that of the PSF; negative fluxes count as 0.
    """
    px, _ = pixel_profile_single(offset_px[:, 0], sigma, radius)
    py, _ = pixel_profile_single(offset_px[:, 1], sigma, radius)
    py *= np.maximum(flux, 0.0)[:, None].astype(np.float32)
    return np.asarray(py[:, :, None] * px[:, None, :])


def paint_sources(fits: PointFits, sigma: float, shape: tuple[int, int]) -> Pixels:
    """Image (H, W) of the fitted sources, out to 5 `sigma` [px] of the PSF, in the unit of their fluxes."""
    radius = int(np.ceil(5.0 * sigma))
    side = 2 * radius + 1
    image = np.zeros((shape[0] + 2 * side, shape[1] + 2 * side), dtype=np.float32)
    centres = np.clip(np.rint(fits.xy_px).astype(np.int64), -radius, np.array([shape[1], shape[0]]) + radius)
    size = max(1, MAX_STAMP_PIXELS // (side * side))
    for at in range(0, len(centres), size):
        here = np.arange(at, min(at + size, len(centres)))
        signals = source_signal(fits.xy_px[here] - centres[here], fits.flux[here], sigma, radius)
        for (column, row), signal in zip(centres[here] + side - radius, signals, strict=True):
            image[row : row + side, column : column + side] += signal
    return image[side:-side, side:-side]


_sum_neighbours = kernel(
    "sum_neighbours", "star: int64[m]", "offset_px: float64[m, 2]", "flux: float64[m]", "sigma_px: float64",
    "variance: float32[n, side, side]", "limit_sigma: float64", "last: float32[n, side, side]",
    "profiles: out float64[7, side + 1]", "signal: out float32[count, side, side]", "changed: out bool[count]",
)  # fmt: skip
