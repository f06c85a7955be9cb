"""Forced photometry: the flux at the predicted pixels of catalogue stars."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from startrack.core.types import Array, Bools, Detections, Ints
from startrack.evidence.photometry_kernel import measure_sources
from startrack.psf import pixel_profile_table, stamp_radius

PROFILE_SIGMAS = 6.0  # half width of a neighbour's profile: 1e-9 of its light lies beyond


@dataclass(frozen=True, kw_only=True)
class Photometry:
    """Measured fluxes at predicted pixels (n)."""

    flux_e: Array  # (n,) local level and neighbours subtracted
    variance_e2: Array  # (n,) from the pixels' noise, without the star's own light
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
    table = neighbour_profiles(sigma_px)
    measured, usable = np.empty((len(order), 4)), np.empty(len(order), dtype=np.bool_)
    measure_sources(
        _read_only(d.image_e), _read_only(d.background_e), _read_only(d.noise_e), _read_only(d.dead),
        sources.xy_px[order], sources.flux_e[order], sources.fraction_sigma[order], sources.visible[order],
        first, columns, reach_px, reach_px, radius, table, measured, usable,
    )  # fmt: skip
    given = np.argsort(order)
    flux_e, variance_e2, own_shot, neighbour_variance_e2 = np.ascontiguousarray(measured[given].T)
    return Photometry(
        flux_e=flux_e, variance_e2=variance_e2, own_shot=own_shot, neighbour_variance_e2=neighbour_variance_e2,
        usable=usable[given],
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


def _read_only(picture: NDArray[Any]) -> NDArray[Any]:
    """The image, contiguous and read-only: another layout or flag would compile the loop again."""
    view = np.ascontiguousarray(picture).view()
    view.flags.writeable = False
    return view
