"""Forced photometry of a frame that is never rendered: means and variances of its fluxes, and normal draws of them."""

from __future__ import annotations

# mypy: disable-error-code="no-untyped-def"
from dataclasses import dataclass

import numpy as np

from startrack.core.kernels import REORDERED_SUMS, njit
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
    found, beyond = np.empty((len(xy_px), 5)), int(reach_px) + 2
    profiles = np.pad(neighbour_profiles(sigma_px), ((0, 0), (beyond, beyond)))
    collect_light(
        xy_px, others_px[order], number, weight[order], squares, first, columns, reach_px, reach_px,
        half_width(sigma_px), profiles, found,
    )  # fmt: skip
    return np.ascontiguousarray(found.T)


@njit(cache=True, fastmath=REORDERED_SUMS)
def collect_light(
    xy_px, others_px, number, weight, square_weight, first, columns, side_px, reach_px, radius, table, found
) -> None:  # fmt: skip
    """Fill found (n, 5) for stars at `xy_px` (n, 2) with sums over others (m) within `reach_px`, at most `side_px`.

    The others are ordered by cells of `side_px`, `first` is each cell's first; `number` (m,) is the index of another
    among the stars, or -1. The weights of a stamp are those of linear least squares for flux and level,
    (P - mean(P)) / S with S = sum P (P - mean(P)). Columns: the parts of the others' light that they collect, times
    `weight`; the variance that each of their electrons adds, times `weight`; the squares of the parts, times
    `square_weight`; the variance that each electron of the star itself adds; and S. Positions in px, none negative.
    Profiles of the `table` are 0 as far from their middle as a stamp of another star reaches.
    """
    across, down, centre = profiles_of(xy_px, table)
    others_across, others_down, others_centre = profiles_of(others_px, table)
    side, rows = 2 * radius + 1, (len(first) - 1) // columns
    first_place = table.shape[1] // 2 - radius
    for i in range(len(xy_px)):
        light_x, profile_x, square_x = _sum_along(across, i, across, i, first_place, side, first_place)
        light_y, profile_y, square_y = _sum_along(down, i, down, i, first_place, side, first_place)
        total = light_x * light_y
        middle = total / side**2
        strength = profile_x * profile_y - middle * total
        collected, shot, squares = 0.0, 0.0, 0.0
        found[i, 3] = (square_x * square_y - 2 * middle * profile_x * profile_y + middle**2 * total) / strength**2
        found[i, 4] = strength
        column, row = int(xy_px[i, 0] / side_px), int(xy_px[i, 1] / side_px)
        for cell_row in range(max(row - 1, 0), min(row + 2, rows)):
            start = first[cell_row * columns + max(column - 1, 0)]
            stop = first[cell_row * columns + min(column + 1, columns - 1) + 1]
            for j in range(start, stop):
                dx, dy = others_px[j, 0] - xy_px[i, 0], others_px[j, 1] - xy_px[i, 1]
                if dx * dx + dy * dy <= reach_px * reach_px and number[j] != i:
                    left = first_place + centre[i, 0] - others_centre[j, 0]
                    top = first_place + centre[i, 1] - others_centre[j, 1]
                    light_x, profile_x, square_x = _sum_along(across, i, others_across, j, left, side, first_place)
                    light_y, profile_y, square_y = _sum_along(down, i, others_down, j, top, side, first_place)
                    light, with_profile = light_x * light_y, profile_x * profile_y
                    part = (with_profile - middle * light) / strength
                    noise = square_x * square_y - 2 * middle * with_profile + middle**2 * light
                    collected += weight[j] * part
                    shot += weight[j] * noise / strength**2
                    squares += square_weight[j] * part * part
        found[i, 0], found[i, 1], found[i, 2] = collected, shot, squares


@njit(inline="always")
def _sum_along(own, i, others, j, start, side, first):
    """Sums over a stamp along one axis: the profile of star j alone, times star i's, times its square.

    The stamp begins at the place `first` of star i's profile, and at `start` of star j's.
    """
    light, with_profile, with_square = 0.0, 0.0, 0.0
    row, at, other_row, other_at = np.uint64(i), np.uint64(first), np.uint64(j), np.uint64(start)
    for c in range(np.uint64(side)):
        p, q = float(own[row, at + c]), float(others[other_row, other_at + c])
        light += q
        with_profile += p * q
        with_square += p * p * q
    return light, with_profile, with_square
