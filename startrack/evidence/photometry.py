"""Forced photometry: the flux at the predicted pixels of catalogue stars.

The loop over the stars, each with the neighbours within reach, is in kernels/photometry.c.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import ceil, sqrt

import numpy as np

from startrack.core.types import Array, Bools, Detections, Image, Ints
from startrack.kernels import STAMP_LANES
from startrack.kernels.library import kernel
from startrack.psf import pixel_profile_table, stamp_radius

FLAT_SLOPE_EXCESS = 3.0  # squared slopes that the noise explains, in its variance: 5 % of flat stamps have more
EDGE_FARTHEST_PX, EDGE_STEP_PX = 6.0, 0.5  # of its place from the star, for a PSF of 1 px; beyond, it has no part
EDGE_PLACES = int(2 * EDGE_FARTHEST_PX / EDGE_STEP_PX) + 1
WIDTH_PART = 0.3  # sigma of how much wider or sharper the edge is: in a real photograph stars had 0.58 px, a wall 0.95
EDGE_PHASES = 64  # of a pixel between two places of the edge, in the table of its light: right to 2e-6 of a contrast
CONTRAST_SIGMAS = 10.0  # of an edge, in the noise of a pixel: a normal prior about none
SURE_SIGMAS = 5.0  # from here on chance is excluded: two in a million
CLIPPED_SIGMAS = 4.0  # of values about a fit, in a round
MODEL_VARIANCE = 0.05**2  # of a star's squared light, pixel by pixel: the real PSF is no Gaussian
# Of the part by which the background's shape in a stamp is wrong: beside the end of a bright sky it bends over 20 px,
# and the image does not. Without it stars 5 to 20 px above that end were too faint by up to 0.8 sigma, with it by 0.1
# at most; with 1 in place of 0.3, circles in rendered frames are 2 % wider.
SHAPE_VARIANCE = 0.3**2
MAX_MASKED_PX = 6  # a stamp with more deviant pixels is not a star on a smooth background
PROFILE_SIGMAS = 6.0  # half width of a neighbour's profile: 1e-9 of its light lies beyond


def edge_profiles(radius: int, width_px: float) -> Array:
    """Light of an edge of `width_px`, and its slope [1/px], (2, EDGE_PHASES + 1, n) single, for stamps of that radius.

    Rows are phases of a pixel between two places of the edge; the column is the number of places from the edge to the
    pixel, from the farthest before it to the farthest behind it.
    """
    from scipy.special import ndtr

    spread_px, step_px = sqrt(width_px * width_px + 1.0 / 12.0), width_px * EDGE_STEP_PX  # pixels have a side of 1
    farthest = ceil(radius * sqrt(2.0) / step_px) + 1 + EDGE_PLACES // 2
    places = np.arange(-farthest, farthest + 1.0) + np.linspace(0.0, 1.0, EDGE_PHASES + 1)[:, None]
    z = places * step_px / spread_px
    slope = np.exp(-0.5 * z * z) / (np.sqrt(2.0 * np.pi) * spread_px)
    return np.stack([ndtr(z), slope]).astype(np.float32)


@dataclass(frozen=True, kw_only=True)
class Photometry:
    """Measured fluxes at predicted pixels (n)."""

    flux_e: Array  # (n,) local level and neighbours subtracted
    variance_e2: Array  # (n,) from the pixels' noise and an edge among them, without the star's own light
    own_shot: Array  # (n,) variance per electron of the star's own light
    neighbour_variance_e2: Array  # (n,) from the unknown visibility and brightness of the neighbours
    usable: Bools  # (n,) enough good pixels


@dataclass(frozen=True, kw_only=True)
class Sources:
    """Predicted positions and fluxes of stars (n)."""

    xy_px: Array  # (n, 2)
    flux_e: Array  # (n,) expected if visible
    fraction_sigma: Array  # (n,) its relative uncertainty
    visible: Array  # (n,) probability that it is visible, for its part in its neighbours' measurements


def half_width(sigma_px: float) -> int:
    """Half width [px] of the measuring stamp of a PSF of `sigma_px`: the star and enough of the level around it."""
    return stamp_radius(sigma_px) + 1


def measure(detections: Detections, sources: Sources) -> Photometry:
    """Flux and local level at each source by linear least squares, deviant pixels masked.

    The `detections` have the image, its background and noise, its saturated pixels and the PSF. All sources must lie at
    least `half_width` inside the frame. The neighbours' expected light is subtracted.
    """
    sigma_px, d = detections.psf_sigma_px, detections
    radius = half_width(sigma_px)
    reach_px = radius + 3.0 * sigma_px
    order, first, columns = order_by_cell(sources.xy_px, d.image_e.shape, reach_px)
    table, n, pixels = neighbour_profiles(sigma_px), len(order), (2 * radius + 1) ** 2
    measured, usable = np.empty((n, 4)), np.empty(n, dtype=np.bool_)
    profiles, places = np.empty((2, n, table.shape[1]), np.float32), (np.empty((n, 2), np.int64), np.empty(n, np.int64))
    stamp, sums = np.empty((8, -(-pixels // STAMP_LANES) * STAMP_LANES), np.float32), np.empty((15, 32))
    pictures = [np.ascontiguousarray(a) for a in (d.image_e, d.background.rows, d.noise.rows, d.dead)]
    columns_of = (sources.flux_e, sources.fraction_sigma, sources.visible)
    _measure_sources(
        *pictures, d.background.side, d.noise.side, sources.xy_px[order],
        *(np.asarray(column, dtype=np.float64)[order] for column in columns_of), first, columns, reach_px, reach_px,
        radius, SURE_SIGMAS**2, MODEL_VARIANCE, SHAPE_VARIANCE, MAX_MASKED_PX, table, edge_profiles(radius, sigma_px),
        sigma_px, EDGE_STEP_PX, FLAT_SLOPE_EXCESS, WIDTH_PART, CONTRAST_SIGMAS, EDGE_PLACES, *profiles, *places, stamp,
        sums, measured, usable,
    )  # fmt: skip
    columns_e, is_usable = np.empty(measured.shape[::-1]), np.empty_like(usable)
    columns_e[:, order], is_usable[order] = measured.T, usable
    flux_e, variance_e2, own_shot, neighbour_variance_e2 = columns_e
    return Photometry(
        flux_e=flux_e, variance_e2=variance_e2, own_shot=own_shot, neighbour_variance_e2=neighbour_variance_e2,
        usable=is_usable,
    )  # fmt: skip


def neighbour_profiles(sigma_px: float) -> Array:
    """The table of pixel profiles of a PSF of `sigma_px`, wide enough for a star's light in its neighbours' stamps."""
    return pixel_profile_table(sigma_px, max(half_width(sigma_px), int(np.ceil(PROFILE_SIGMAS * sigma_px)) + 1))


def order_by_cell(xy_px: Array, shape: tuple[int, ...], side_px: float) -> tuple[Ints, Ints, int]:
    """Order (n,) of the sources at `xy_px` (n, 2) by square cells of side `side_px`; each cell's first; the columns.

    The grid of cells covers an image of `shape` (H, W).
    """
    columns, rows = int(shape[1] / side_px) + 1, int(shape[0] / side_px) + 1
    position = (xy_px / side_px).astype(np.int64)
    cell = position[:, 1] * columns + position[:, 0]
    first = np.concatenate([[0], np.cumsum(np.bincount(cell, minlength=rows * columns))])
    return np.argsort(cell * len(cell) + np.arange(len(cell))), first, columns  # of different numbers: stable and fast


def profiles_of(xy_px: Array, profiles: Array) -> tuple[Image, Image, Ints]:
    """Profiles (n, 2 k + 1) of sources at `xy_px` (n, 2), in x and in y, about their middle pixels, and these (n, 2).

    `profiles` (steps + 1, 2 k + 1) are those at offsets from -1/2 to 1/2.
    """
    n, wide = len(xy_px), profiles.shape[1]
    across, down = np.empty((2, n, wide), np.float32)
    centre = np.empty((n, 2), np.int64)
    _profiles_of(xy_px, profiles, across, down, centre)
    return across, down, centre


_profiles_of = kernel(
    "profiles_of", "xy_px: float64[n, 2]", "profiles: float64[steps + 1, wide]", "across: out float32[n, wide]",
    "down: out float32[n, wide]", "centre: out int64[n, 2]",
)  # fmt: skip
_measure_sources = kernel(
    "measure_sources", "image: float32[height, width]", "background: float32[background_rows >= 1, width]",
    "noise: float32[noise_rows >= 1, width]", "dead: bool[height, width]", "background_side: int64",
    "noise_side: int64", "xy_px: float64[n, 2]", "flux_e: float64[n]", "fraction_sigma: float64[n]",
    "visible: float64[n]", "first: int64[cells + 1]", "columns: int64", "reach_px: float64", "side_px: float64",
    "radius: int64", "outlier: float32", "model: float32", "shape_variance: float32", "most_masked: int64",
    "profiles: float64[steps + 1, wide]", "edges: float32[2, phases + 1, table_places]", "sigma_px: float64",
    "step_px: float64", "flat_excess: float64", "width_part: float64", "contrast_sigmas: float64", "places: int64",
    "across: out float32[n, wide]", "down: out float32[n, wide]", "centre: out int64[n, 2]", "near: out int64[n]",
    "stamp: out float32[8, room]", "sums: out float64[15, 32]", "measured: out float64[n, 4]",
    "usable: out bool[n]",
)  # fmt: skip
