"""The compiled loops that compare an image with its background and noise."""

from __future__ import annotations

# mypy: disable-error-code="no-untyped-def"
import numpy as np

from startrack.core.kernels import REORDERED_SUMS, njit, rows_beside
from startrack.core.smooth_image import Image, SmoothImage
from startrack.core.types import Ints


@njit(cache=True, nogil=True, fastmath=REORDERED_SUMS, error_model="numpy")
def fill_residuals(image, background, noise, side, found, per_unit, found_error, level, level_side, first, out):
    """Fill out (h, W) with rows of the image from `first` on: light above the background in units of the noise.

    `background` and `noise` are rows of a SmoothImage with this `side`, `level` of one in units of the noise. `found`
    is known stars' light, `per_unit` and `found_error` its noise. `found` and `level` may have no rows.
    """
    one = np.float32(1.0)
    for i in range(out.shape[0]):
        y = first + i
        low, high, part = rows_beside(y, side, len(background))
        rest = one - part
        line, light = out[i], image[y]
        below_b, above_b, below_n, above_n = background[low], background[high], noise[low], noise[high]
        if len(found):
            known = found[y]
            for x in range(len(line)):
                sigma = below_n[x] * rest + above_n[x] * part
                variance = sigma * sigma + known[x] * (per_unit + found_error * found_error * known[x])
                line[x] = (light[x] - (below_b[x] * rest + above_b[x] * part) - known[x]) / np.sqrt(variance)
        else:
            for x in range(len(line)):
                sigma = below_n[x] * rest + above_n[x] * part
                line[x] = (light[x] - (below_b[x] * rest + above_b[x] * part)) / sigma
        if len(level):
            low, high, part = rows_beside(y, level_side, len(level))
            rest, below_b, above_b = one - part, level[low], level[high]
            for x in range(len(line)):
                line[x] -= below_b[x] * rest + above_b[x] * part


@njit(cache=True, nogil=True)
def _fill_stamps(image, background, noise, side, centres, light, variance):
    """Fill light and variance (n, s, s) around the pixels `centres` (n, 2); the other arguments: `fill_residuals`."""
    width = light.shape[1]
    for k in range(len(centres)):
        left, top = centres[k, 0] - width // 2, centres[k, 1] - width // 2
        for i in range(width):
            low, high, part = rows_beside(top + i, side, len(background))
            rest, columns = np.float32(1.0) - part, slice(left, left + width)
            below_b, above_b, below_n, above_n = (
                background[low, columns], background[high, columns], noise[low, columns], noise[high, columns]
            )  # fmt: skip
            pixels, own, spread = image[top + i, columns], light[k, i], variance[k, i]
            for j in range(width):
                sigma = below_n[j] * rest + above_n[j] * part
                own[j] = pixels[j] - (below_b[j] * rest + above_b[j] * part)
                spread[j] = sigma * sigma


def cut_light(
    image: Image, background: SmoothImage, noise: SmoothImage, centres: Ints, radius: int
) -> tuple[Image, Image]:
    """Stamps (n, 2r+1, 2r+1) of the light above the background and of the pixels' variance.

    The stamps around the pixels `centres` (n, 2), x and y, must lie in the image.
    """
    light, variance = np.empty((2, len(centres), 2 * radius + 1, 2 * radius + 1), dtype=np.float32)
    _fill_stamps(image, background.rows, noise.rows, background.side, centres, light, variance)
    return light, variance
