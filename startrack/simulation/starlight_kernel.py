"""The compiled sums of the simulated photometry: the light that the weights of each star's stamp collect."""

from __future__ import annotations

# mypy: disable-error-code="no-untyped-def"
import numpy as np

from startrack.core.kernels import njit
from startrack.evidence.photometry_kernel import profiles_of


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
