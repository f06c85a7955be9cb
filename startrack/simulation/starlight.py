"""Forced photometry of a frame that is never rendered: means and variances of its fluxes, and normal draws of them."""

from __future__ import annotations

# mypy: disable-error-code="no-untyped-def"
from dataclasses import dataclass

import numpy as np

from startrack.core.kernels import njit
from startrack.core.types import Array
from startrack.evidence import Photometry, Sources, half_width, neighbour_profiles, order_by_cell, profiles_of
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
        """A draw, by `rng`, of what `startrack.evidence.photometry.measure` finds at the sources (n).

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
    """Sums (5, n) of `collect_light` for the stamps about stars (n, 2), over others (m, 2) within reach.

    Others with a `square_weight` are the stars themselves. No position is negative.
    """
    size_px = np.maximum(xy_px.max(axis=0, initial=0.0), others_px.max(axis=0, initial=0.0)) + 1.0
    order, first, columns = order_by_cell(others_px, (int(size_px[1]), int(size_px[0])), reach_px)
    number = np.full(len(order), -1) if square_weight is None else order
    squares = np.zeros(len(order)) if square_weight is None else square_weight[order]
    found = np.empty((len(xy_px), 5))
    collect_light(
        xy_px, others_px[order], number, weight[order], squares, first, columns, reach_px, reach_px,
        half_width(sigma_px), neighbour_profiles(sigma_px), found,
    )  # fmt: skip
    return np.ascontiguousarray(found.T)


@njit(cache=True, nogil=True)
def collect_light(
    xy_px, others_px, number, weight, square_weight, first, columns, side_px, reach_px, radius, table, found
) -> None:  # fmt: skip
    """Fill found (n, 5) for stars at `xy_px` (n, 2) with sums over others (m) within `reach_px`, at most `side_px`.

    The others are ordered by cells of `side_px`, `first` is each cell's first; `number` (m,) is the index of another
    among the stars, or -1. The weights of a stamp are those of linear least squares for flux and level,
    (P - mean(P)) / S with S = sum P (P - mean(P)). Columns: the parts of the others' light that they collect, times
    `weight`; the variance that each of their electrons adds, times `weight`; the squares of the parts, times
    `square_weight`; the variance that each electron of the star itself adds; and S. Positions in px, none negative.
    """
    across, down, centre = profiles_of(xy_px, table)
    others_across, others_down, others_centre = profiles_of(others_px, table)
    half, side, rows = table.shape[1] // 2, 2 * radius + 1, (len(first) - 1) // columns
    in_x, in_y = np.empty(3), np.empty(3)
    for i in range(len(xy_px)):
        _sum_along(across, i, across, i, half - radius, side, half, radius, in_x)
        _sum_along(down, i, down, i, half - radius, side, half, radius, in_y)
        total = in_x[0] * in_y[0]
        middle = total / side**2
        strength = in_x[1] * in_y[1] - middle * total
        found[i, :3] = 0.0
        found[i, 3] = (in_x[2] * in_y[2] - 2 * middle * in_x[1] * in_y[1] + middle**2 * total) / strength**2
        found[i, 4] = strength
        column, row = int(xy_px[i, 0] / side_px), int(xy_px[i, 1] / side_px)
        for cell_row in range(max(row - 1, 0), min(row + 2, rows)):
            start = first[cell_row * columns + max(column - 1, 0)]
            stop = first[cell_row * columns + min(column + 1, columns - 1) + 1]
            for j in range(start, stop):
                dx, dy = others_px[j, 0] - xy_px[i, 0], others_px[j, 1] - xy_px[i, 1]
                if dx * dx + dy * dy <= reach_px * reach_px and number[j] != i:
                    left = half - radius + centre[i, 0] - others_centre[j, 0]
                    top = half - radius + centre[i, 1] - others_centre[j, 1]
                    _sum_along(across, i, others_across, j, left, side, half, radius, in_x)
                    _sum_along(down, i, others_down, j, top, side, half, radius, in_y)
                    light, with_profile = in_x[0] * in_y[0], in_x[1] * in_y[1]
                    part = (with_profile - middle * light) / strength
                    noise = in_x[2] * in_y[2] - 2 * middle * with_profile + middle**2 * light
                    found[i, 0] += weight[j] * part
                    found[i, 1] += weight[j] * noise / strength**2
                    found[i, 2] += square_weight[j] * part * part


@njit(inline="always")
def _sum_along(own, i, others, j, start, side, half, radius, sums) -> None:
    """Write sums (3,) over a stamp along one axis: the profile of star j alone, times star i's, times its square.

    The stamp begins at the place `start` of the profile of star j, which is 0 beyond its 2 `half` + 1 places.
    """
    light, with_profile, with_square = 0.0, 0.0, 0.0
    for c in range(max(0, -start), min(side, 2 * half + 1 - start)):
        p, q = float(own[i, half - radius + c]), float(others[j, start + c])
        light += q
        with_profile += p * q
        with_square += p * p * q
    sums[0], sums[1], sums[2] = light, with_profile, with_square
