"""Forced photometry of a frame that is never rendered: means and variances of its fluxes, and normal draws of them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from startrack.core.types import Array, Ints
from startrack.evidence.photometry import Photometry, Sources, half_width, neighbour_profiles, order_by_cell
from startrack.psf import pixel_profile

NEIGHBOUR_SIGMAS = 3.0  # of the PSF beyond half a stamp, to the last star whose light is subtracted, as in `measure`
CORNER = float(np.sqrt(2.0))  # half diagonal of a stamp in its half widths: light reaches its corners, too


@dataclass(frozen=True, eq=False)
class Starlight:
    """The stars that shine on a frame (m), and its PSF."""

    xy_px: Array  # (m, 2)
    flux_e: Array  # (m,) whole PSF
    psf_sigma_px: float

    def measure(
        self, sources: Sources, pixel_variance_e2: Array, saturation_e: float, *, rng: np.random.Generator
    ) -> Photometry:
        """A draw, by `rng`, of what `startrack.evidence.photometry.measure` finds at the sources (n).

        The background is known, and the noise of a pixel without stars is the same over the stamp of a star,
        `pixel_variance_e2` (n,). The weights are those of linear least squares for flux and local level; the light of
        `sources` is subtracted as expected, all light of the stars here adds to the flux and to its noise. The errors
        of overlapping stamps are drawn independently. A star with a pixel above `saturation_e` is not usable.
        """
        sigma, radius = self.psf_sigma_px, half_width(self.psf_sigma_px)
        reach_px = CORNER * radius + NEIGHBOUR_SIGMAS * sigma
        lowest_px = np.floor(sources.xy_px.min(axis=0, initial=0.0) - reach_px)
        near = (self.xy_px > lowest_px).all(axis=1)
        collect = _Collector(sources.xy_px - lowest_px, sigma)
        mean, shot, *_ = collect(self.xy_px[near] - lowest_px, self.flux_e[near], reach_px)
        light, visible = sources.flux_e, sources.visible
        spread = visible * (1.0 - visible) + visible * np.square(sources.fraction_sigma)
        subtracted, subtracted_shot, unsure, own_shot, strength = collect(
            collect.xy_px, light * visible, radius + NEIGHBOUR_SIGMAS * sigma, np.square(light) * spread
        )
        without_stars = pixel_variance_e2 / strength
        noise_e = np.sqrt(np.maximum(without_stars + shot, 0.0))
        flux = mean - subtracted + noise_e * rng.standard_normal(len(mean))
        peak = self.flux_e * np.square(pixel_profile(np.zeros(1), sigma, 0)[0][0, 0])
        bright = self.xy_px[peak > saturation_e]
        saturated = np.zeros(len(mean), dtype=bool)
        saturated[_pairs(sources.xy_px, bright, radius)[0]] = True
        return Photometry(
            flux_e=flux, variance_e2=without_stars + subtracted_shot, own_shot=own_shot,
            neighbour_variance_e2=unsure, usable=~saturated,
        )  # fmt: skip


@dataclass(frozen=True, eq=False)
class _Collector:
    """The stamps about stars (n), and the light that their weights collect; see `collect_light`."""

    xy_px: Array  # (n, 2), none negative
    sigma_px: float

    def __call__(self, others_px: Array, weight: Array, reach_px: float, square_weight: Array | None = None) -> Array:
        """The sums (5, n) over others (m) within reach; those with a `square_weight` are the stars (n) themselves."""
        from startrack.simulation.starlight_kernel import collect_light

        size_px = np.maximum(self.xy_px.max(axis=0, initial=0.0), others_px.max(axis=0, initial=0.0)) + 1.0
        order, first, columns = order_by_cell(others_px, (int(size_px[1]), int(size_px[0])), reach_px)
        number = np.full(len(order), -1) if square_weight is None else order
        squares = np.zeros(len(order)) if square_weight is None else square_weight[order]
        found = np.empty((len(self.xy_px), 5))
        collect_light(
            self.xy_px, others_px[order], number, weight[order], squares, first, columns, reach_px, reach_px,
            half_width(self.sigma_px), neighbour_profiles(self.sigma_px), found,
        )  # fmt: skip
        return np.ascontiguousarray(found.T)


def _pairs(xy_px: Array, others_px: Array, reach_px: float) -> tuple[Ints, Ints]:
    """Indices (k,) of positions (n, 2) and of `others_px` (m, 2) that are within reach of each other."""
    from scipy.spatial import cKDTree

    if not len(xy_px) or not len(others_px):
        return np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64)
    near = cKDTree(xy_px).sparse_distance_matrix(cKDTree(others_px), reach_px, output_type="ndarray")
    return near["i"].astype(np.int64), near["j"].astype(np.int64)
