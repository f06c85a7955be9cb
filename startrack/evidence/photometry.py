"""Forced photometry: the flux at the predicted pixels of catalogue stars.

The compiled loops pass once over the stars, each with the neighbours within reach. Their helpers take whole arrays and
have one exit: views and early exits cost reference counts, more than the arithmetic. Unsigned indices spare the test
for negative ones, so that the compiler treats several pixels at a time. Pixels are in single precision: twice as many
at a time, and rounding is 1e-5 of the noise.
"""

from __future__ import annotations

# mypy: disable-error-code="no-untyped-def"
from dataclasses import dataclass

import numpy as np

from startrack.core.kernels import REORDERED_SUMS, njit, read_only, rows_beside
from startrack.core.types import Array, Bools, Detections, Ints
from startrack.evidence.stamp_edge import edge_profiles, fit_beside_edge
from startrack.psf import pixel_profile_table, stamp_radius

ZERO, ONE = np.float32(0.0), np.float32(1.0)  # literals would be of double precision
LEAST = np.finfo(np.float32).tiny  # of a divisor
SURE_SIGMAS = 5.0  # from here on chance is excluded: two in a million
CLIPPED_SIGMAS = 4.0  # of values about a fit, in a round
OUTLIER_VARIANCES = np.float32(SURE_SIGMAS**2)
MODEL_VARIANCE = np.float32(0.05**2)  # of a star's squared light, pixel by pixel: the real PSF is no Gaussian
# Of the part by which the background's shape in a stamp is wrong: beside the end of a bright sky it bends over 20 px,
# and the image does not. Without it stars 5 to 20 px above that end were too faint by up to 0.8 sigma, with it by 0.1
# at most; with 1 in place of 0.3, circles in rendered frames are 2 % wider.
SHAPE_VARIANCE = np.float32(0.3**2)
MAX_MASKED_PX = 6  # a stamp with more deviant pixels is not a star on a smooth background
PROFILE_SIGMAS = 6.0  # half width of a neighbour's profile: 1e-9 of its light lies beyond


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
    table = neighbour_profiles(sigma_px)
    measured, usable = np.empty((len(order), 4)), np.empty(len(order), dtype=np.bool_)
    pictures = [read_only(a) for a in (d.image_e, d.background.rows, d.noise.rows, d.dead)]
    measure_sources(  # type: ignore[call-arg]
        *pictures, d.background.side, d.noise.side, sources.xy_px[order], sources.flux_e[order],
        sources.fraction_sigma[order], sources.visible[order],
        first, columns, reach_px, reach_px, radius, np.float32(sigma_px), table,
        edge_profiles(radius, sigma_px), measured, usable,
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


@njit(cache=True, fastmath=REORDERED_SUMS)
def measure_sources(
    image, background, noise, dead, background_side, noise_side, xy_px, flux_e, fraction_sigma, visible, first, columns,
    reach_px, side_px, radius, sigma_px, profiles, edges, measured, usable,
) -> None:  # fmt: skip
    """Fill `measured` (n, 4) and `usable` (n,) for sources (n) ordered by cells, their stamps inside the frame.

    The columns are flux, variance, own shot noise and neighbours' variance, as `Photometry` explains them. `background`
    and `noise` are rows of a SmoothImage. `profiles` (steps + 1, 2 k + 1) are pixel profiles at offsets from -1/2 to
    1/2, and `edges` are `edge_profiles`. Neighbours lie within `reach_px`, at most `side_px`, the side of cells;
    `first` is each cell's first source.
    """
    n = len(xy_px)
    k = profiles.shape[1] // 2
    side = 2 * radius + 1
    across, down, centre = profiles_of(xy_px, profiles)
    size = side * side
    profile, light, data = np.empty(size, np.float32), np.empty(size, np.float32), np.empty(size, np.float32)
    variance, weight, shape = np.empty(size, np.float32), np.empty(size, np.float32), np.empty(size, np.float32)
    near = np.empty(n, np.int64)
    for i in range(n):
        count = _find_neighbours(near, i, xy_px, visible, first, columns, side_px, reach_px)
        left, top = centre[i, 0] - radius, centre[i, 1] - radius
        for p in range(size):
            light[p] = ZERO
        for m in range(count):
            j = near[m]
            x, y = k + left - centre[j, 0], k + top - centre[j, 1]
            _add_light(light, side, np.float32(flux_e[j] * visible[j]), across, down, j, x, y)
        _load_stamp(
            image, background, noise, dead, background_side, noise_side, across, down, i, left, top, radius, k, light,
            profile, data, shape, variance, weight,
        )  # fmt: skip
        flux, level, strength, masked = _fit_masking(profile, shape, light, data, variance, weight)
        seen = ZERO  # part of the star's light in pixels that have a weight
        for p in range(size):
            seen += profile[p] if weight[p] > ZERO else ZERO
        usable[i] = masked <= MAX_MASKED_PX and seen > 0.5
        measured[i, 0], measured[i, 1], measured[i, 2], measured[i, 3] = 0.0, 1.0, 0.0, 0.0
        if not usable[i]:
            continue
        measured[i, 0], edge = fit_beside_edge(
            profile, light, data, shape, weight, flux, level, strength, sigma_px, edges
        )
        total, measured[i, 2] = _variances(profile, shape, light, variance, weight)
        measured[i, 1] = total + edge
        for m in range(count):
            j = near[m]
            x, y = k + left - centre[j, 0], k + top - centre[j, 1]
            leak = flux_e[j] * _leak(weight, side, across, down, j, x, y)
            measured[i, 3] += leak**2 * (visible[j] * (1.0 - visible[j]) + visible[j] * fraction_sigma[j] ** 2)


@njit(inline="always")
def _find_neighbours(near, i, xy_px, visible, first, columns, side_px, reach_px) -> int:
    """Write into `near` the sources within reach of source i that may be visible; returns how many there are."""
    rows = (len(first) - 1) // columns
    column, row = int(xy_px[i, 0] / side_px), int(xy_px[i, 1] / side_px)
    count = 0
    for cell_row in range(max(row - 1, 0), min(row + 2, rows)):
        start = first[cell_row * columns + max(column - 1, 0)]
        stop = first[cell_row * columns + min(column + 1, columns - 1) + 1]
        for j in range(start, stop):
            dx, dy = xy_px[j, 0] - xy_px[i, 0], xy_px[j, 1] - xy_px[i, 1]
            if dx * dx + dy * dy <= reach_px * reach_px and visible[j] > 0.0 and j != i:
                near[count] = j
                count += 1
    return count


@njit(inline="always")
def profiles_of(xy_px, profiles):
    """Profiles (n, 2 k + 1) of the sources in x and in y about their middle pixels, and these pixels (n, 2)."""
    n, wide = len(xy_px), profiles.shape[1]
    steps = profiles.shape[0] - 1
    across, down = np.empty((n, wide), np.float32), np.empty((n, wide), np.float32)
    centre = np.empty((n, 2), np.int64)
    for i in range(n):
        for axis in range(2):
            pixel = np.rint(xy_px[i, axis])
            centre[i, axis] = int(pixel)
            step = (xy_px[i, axis] - pixel + 0.5) * steps
            low = min(max(int(step), 0), steps - 1)
            part = step - low
            for j in range(wide):
                value = (1.0 - part) * profiles[low, j] + part * profiles[low + 1, j]
                if axis == 0:
                    across[i, j] = value
                else:
                    down[i, j] = value
    return across, down, centre


@njit(inline="always")
def _load_stamp(
    image, background, noise, dead, background_side, noise_side, across, down, i, left, top, radius, k, light,
    profile, data, shape, variance, weight,
) -> None:  # fmt: skip
    """Source i: its profile, the pixels without background and neighbours, their variances, and their weights.

    `shape` is the background less that of the middle pixel.
    """
    side = 2 * radius + 1
    b_low, b_high, b_part = rows_beside(top + radius, background_side, len(background))
    middle = background[b_low, left + radius] * (ONE - b_part) + background[b_high, left + radius] * b_part
    source, x0, c0 = np.uint64(i), np.uint64(left), np.uint64(k - radius)
    for r in range(side):
        p0, y, height = np.uint64(r * side), np.uint64(top + r), down[i, k - radius + r]
        b_low, b_high, b_part = rows_beside(top + r, background_side, len(background))
        n_low, n_high, n_part = rows_beside(top + r, noise_side, len(noise))
        for c in range(np.uint64(side)):
            p, x = p0 + c, x0 + c
            profile[p] = height * across[source, c0 + c]
            level = background[b_low, x] * (ONE - b_part) + background[b_high, x] * b_part
            sigma = noise[n_low, x] * (ONE - n_part) + noise[n_high, x] * n_part
            shape[p] = level - middle
            data[p] = image[y, x] - level - light[p]
            variance[p] = sigma * sigma
            weight[p] = ZERO if dead[y, x] else ONE / variance[p]


@njit(inline="always")
def _add_light(light, side, flux, across, down, j, x, y) -> None:
    """Add to the stamp the part of the light of neighbour j whose profiles start at -x, -y."""
    wide = across.shape[1]
    neighbour, width, dx, dy = np.uint64(j), np.uint64(side), np.uint64(x), np.uint64(y)
    c0, c1 = np.uint64(max(0, -x)), np.uint64(min(side, wide - x))
    for r in range(np.uint64(max(0, -y)), np.uint64(min(side, wide - y))):
        height = flux * down[neighbour, r + dy]
        for c in range(c0, c1):
            light[r * width + c] += height * across[neighbour, c + dx]


@njit(inline="always")
def _leak(weight, side, across, down, j, x, y):
    """Part of the light of neighbour j that the weights of the stamp take for the star's."""
    wide = across.shape[1]
    neighbour, width, dx, dy = np.uint64(j), np.uint64(side), np.uint64(x), np.uint64(y)
    c0, c1 = np.uint64(max(0, -x)), np.uint64(min(side, wide - x))
    total = ZERO
    for r in range(np.uint64(max(0, -y)), np.uint64(min(side, wide - y))):
        inner = ZERO
        for c in range(c0, c1):
            inner += weight[r * width + c] * across[neighbour, c + dx]
        total += inner * down[neighbour, r + dy]
    return total


@njit(inline="always")
def _fit_masking(profile, shape, light, data, variance, weight):
    """Flux of the profile beside more or less of the background's shape and a level, the flux's strength, and a count.

    It is that of deviant pixels, which got weight 0.
    """
    size = len(profile)
    masked = 0
    flux, level, strength = ZERO, ZERO, ZERO
    while True:
        w, wp, ws, wpp, wps, wss = _sums(profile, shape, weight)
        wd, wpd, wsd = ZERO, ZERO, ZERO
        for p in range(size):
            v = weight[p] * data[p]
            wd += v
            wpd += v * profile[p]
            wsd += v * shape[p]
        total = max(w, LEAST)
        pp, ps, ss = wpp - wp * wp / total, wps - wp * ws / total, wss - ws * ws / total + ONE / SHAPE_VARIANCE
        pd, sd = wpd - wp * wd / total, wsd - ws * wd / total
        strength = pp - ps * ps / ss
        flux = (pd - ps * sd / ss) / strength if strength > ZERO else ZERO
        more = (sd - ps * flux) / ss
        level = (wd - flux * wp - more * ws) / total
        shine = max(flux, ZERO)
        deviant = 0
        for p in range(size):
            stars = shine * profile[p] + light[p]
            rest = data[p] - flux * profile[p] - more * shape[p] - level
            allowed = variance[p] + stars + MODEL_VARIANCE * stars * stars
            deviant += 1 if weight[p] * rest * rest > weight[p] * allowed * OUTLIER_VARIANCES else 0
        if deviant == 0 or masked > MAX_MASKED_PX:
            break
        # The worst pixel first: a bright one shifts the fit so far that normal pixels beside it look deviant too.
        worst, worst_excess = 0, ZERO
        for p in range(size):
            stars = shine * profile[p] + light[p]
            rest = data[p] - flux * profile[p] - more * shape[p] - level
            excess = rest * rest / (variance[p] + stars + MODEL_VARIANCE * stars * stars)
            if weight[p] > ZERO and excess > worst_excess:
                worst, worst_excess = p, excess
        weight[worst] = ZERO
        masked += 1
    return flux, level, strength, masked


@njit(inline="always")
def _sums(profile, shape, weight):
    """Weighted sums of 1, the profile, the shape, and of their products."""
    w, wp, ws, wpp, wps, wss = ZERO, ZERO, ZERO, ZERO, ZERO, ZERO
    for p in range(len(profile)):
        v, q, b = weight[p], profile[p], shape[p]
        w += v
        wp += v * q
        ws += v * b
        wpp += v * q * q
        wps += v * q * b
        wss += v * b * b
    return w, wp, ws, wpp, wps, wss


@njit(inline="always")
def _variances(profile, shape, light, variance, weight):
    """Variance of the flux without and per electron of its own light; the weights become those of flux = sum w data."""
    w, wp, ws, wpp, wps, wss = _sums(profile, shape, weight)
    middle, bent = wp / w, ws / w
    ps, ss = wps - middle * ws, wss - bent * ws + ONE / SHAPE_VARIANCE
    part = ps / ss
    strength = wpp - middle * wp - part * ps
    own, by_shape = ZERO, part / strength
    total = by_shape * by_shape / SHAPE_VARIANCE
    for p in range(len(profile)):
        weight[p] = weight[p] * (profile[p] - middle - part * (shape[p] - bent)) / strength
        squared = weight[p] * weight[p]
        total += squared * (variance[p] + light[p])
        own += squared * profile[p]
    return total, own
