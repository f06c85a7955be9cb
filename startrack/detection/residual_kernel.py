"""The compiled loops that convert an image and compare it with its background and noise."""

from __future__ import annotations

# mypy: disable-error-code="no-untyped-def"
import numpy as np

from startrack.core.kernels import REORDERED_SUMS, njit, read_only, rows_beside
from startrack.core.smooth_image import Image, SmoothImage
from startrack.core.types import Ints


@njit(cache=True)
def convert_counts(pixels_adu, recorded_adu, gain, bias_e, highest_adu, image, saturated):
    """Fill image (H, W) [e], unless it has no rows, and mark in saturated (H, W) the counts from `highest_adu` on.

    `bias_e` is (1, 1) or (H, W).
    """
    for y in range(len(pixels_adu)):
        counts, above = recorded_adu[y], np.int32(0)
        for x in range(len(counts)):
            above += np.int32(counts[x] >= highest_adu)
        if above:  # seldom: memory that nobody writes to costs no time
            for x in range(len(counts)):
                saturated[y, x] = counts[x] >= highest_adu
        if len(image):
            line, counts = image[y], pixels_adu[y]
            if len(bias_e) == 1:
                bias = bias_e[0, 0]
                for x in range(len(line)):
                    line[x] = counts[x] * gain - bias
            else:
                biases = bias_e[y]
                for x in range(len(line)):
                    line[x] = counts[x] * gain - biases[x]


@njit(inner=True, fastmath=REORDERED_SUMS)
def fill_row(image, background, noise, side, found, per_unit, found_error, y, line):
    """Fill line (W,) with row y of the image: light above the background in units of the noise.

    `background` and `noise` are rows of a SmoothImage with this `side`. `found` is known stars' light, `per_unit` and
    `found_error` its noise; it may have no rows.
    """
    low, high, part = rows_beside(y, side, len(background))
    rest, light = np.float32(1.0) - part, image[y]
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


@njit(cache=True)
def fill_residuals(image, background, noise, side, found, per_unit, found_error, out):
    """Fill out (H, W) with all rows; the other arguments are those of `fill_row`."""
    for y in range(len(out)):
        fill_row(image, background, noise, side, found, per_unit, found_error, y, out[y])


@njit(cache=True)
def _fill_stamps(image, background, noise, side, centres, light, variance):
    """Fill light and variance (n, s, s) around the pixels `centres` (n, 2); the other arguments: `fill_row`."""
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
    _fill_stamps(read_only(image), background.rows, noise.rows, background.side, centres, light, variance)
    return light, variance
