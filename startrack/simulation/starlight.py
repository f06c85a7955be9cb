"""Forced photometry of a frame that is never rendered: means and variances of its fluxes, and normal draws of them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from startrack.core.types import Array
from startrack.evidence import Photometry, Sources, half_width, neighbour_profiles, order_by_cell, profiles_of
from startrack.kernels.library import kernel
from startrack.psf import pixel_profile

NEIGHBOUR_SIGMAS = 3.0  # of the PSF beyond half a stamp, to the last star whose light is subtracted, as in `measure`


@dataclass(frozen=True, eq=False)
class Starlight:
    """The stars that shine on a frame (m), and its PSF."""

    xy_px: Array  # (m, 2)
    flux_e: Array  # (m,) whole PSF
    psf_sigma_px: float

    def measure(
        self, sources: Sources, pixel_variance_e2: Array, saturation_e: float, *, rng: np.random.Generator
    ) -> Photometry:
        """Photometry of `sources` (n): a draw, by `rng`, of what `startrack.evidence.photometry.measure` would find.

        The background is known, and the noise of a pixel without stars is the same over the stamp of a star,
        `pixel_variance_e2` (n,). The weights are those of linear least squares for flux and local level; the light of
        `sources` is subtracted as expected, all light of the stars here adds to the flux and to its noise. The errors
        of overlapping stamps are drawn independently. A star with a pixel above `saturation_e` is not usable.
        """
        from scipy.spatial import cKDTree

        sigma, radius = self.psf_sigma_px, half_width(self.psf_sigma_px)
        reach_px = np.hypot(radius, radius) + NEIGHBOUR_SIGMAS * sigma  # from the corners of a stamp
        lowest_px = np.floor(sources.xy_px.min(axis=0, initial=0.0) - reach_px)
        near = (self.xy_px > lowest_px).all(axis=1)
        own_px = sources.xy_px - lowest_px
        mean, shot, *_ = _collect(own_px, sigma, self.xy_px[near] - lowest_px, self.flux_e[near], reach_px)
        light, visible = sources.flux_e, sources.visible
        spread = visible * (1.0 - visible) + visible * np.square(sources.fraction_sigma)
        subtracted, subtracted_shot, unsure, own_shot, strength = _collect(
            own_px, sigma, own_px, light * visible, radius + NEIGHBOUR_SIGMAS * sigma, np.square(light) * spread
        )
        without_stars = pixel_variance_e2 / strength
        noise_e = np.sqrt(np.maximum(without_stars + shot, 0.0))
        flux = mean - subtracted + noise_e * rng.standard_normal(len(mean))
        peak = self.flux_e * np.square(pixel_profile(np.zeros(1), sigma, 0)[0][0, 0])
        bright = self.xy_px[peak > saturation_e]
        distance, _ = cKDTree(bright).query(sources.xy_px, distance_upper_bound=radius)
        return Photometry(
            flux_e=flux, variance_e2=without_stars + subtracted_shot, own_shot=own_shot,
            neighbour_variance_e2=unsure, usable=np.isinf(distance),
        )  # fmt: skip


def _collect(
    xy_px: Array, sigma_px: float, others_px: Array, weight: Array, reach_px: float, square_weight: Array | None = None
) -> Array:
    """Sums (5, n) for the stamps about stars (n, 2), over others (m, 2) within reach; no position is negative.

    Rows of the result: parts of the others' light that the stamps collect, times `weight`; the variance that
    each of their electrons adds, times `weight`; squares of the parts, times `square_weight`; the variance that each
    electron of the star itself adds; the strength of the fit. Others with a `square_weight` are the stars themselves.
    """
    size_px = np.maximum(xy_px.max(axis=0, initial=0.0), others_px.max(axis=0, initial=0.0)) + 1.0
    order, first, columns = order_by_cell(others_px, (int(size_px[1]), int(size_px[0])), reach_px)
    number = np.full(len(order), -1) if square_weight is None else order
    squares = np.zeros(len(order)) if square_weight is None else square_weight[order]
    found, beyond = np.empty((len(xy_px), 5)), int(reach_px) + 2
    profiles = np.pad(neighbour_profiles(sigma_px), ((0, 0), (beyond, beyond)))
    others_px = others_px[order]
    _collect_light(
        xy_px, *profiles_of(xy_px, profiles), others_px, *profiles_of(others_px, profiles), number, weight[order],
        squares, first, columns, reach_px, reach_px, half_width(sigma_px), found,
    )  # fmt: skip
    return np.ascontiguousarray(found.T)


_SIDES = ("across: float32[{0}, wide]", "down: float32[{0}, wide]", "centre: int64[{0}, 2]")
_collect_light = kernel(
    "collect_light", "xy_px: float64[n, 2]", *(side.format("n") for side in _SIDES), "others_px: float64[m, 2]",
    *(f"others_{side.format('m')}" for side in _SIDES), "number: int64[m]", "weight: float64[m]",
    "square_weight: float64[m]", "first: int64[cells + 1]", "columns: int64", "side_px: float64", "reach_px: float64",
    "radius: int64", "found: out float64[n, 5]",
)  # fmt: skip
