"""The compiled loop over a frame's rows that looks for peaks: one pass, which keeps only the rows that it needs."""

from __future__ import annotations

# mypy: disable-error-code="no-untyped-def"
import numpy as np

from startrack.core.kernels import REORDERED_SUMS, njit, rows_beside
from startrack.detection.background import BLOCK_PX, CLIPPED_SIGMA
from startrack.detection.residual_kernel import fill_row

COARSE_PX = BLOCK_PX // 4  # the local level is a mean over squares of this side
CHUNK_PX = 8 * COARSE_PX  # of a row that is looked at more closely if one of its pixels is high
PAIRS = 4  # of taps in one pass over a row
PEAK_FIELDS = 6  # of a peak: column, row, height, offsets of its top in x and y, level
ZERO, ONE, HALF = np.float32(0.0), np.float32(1.0), np.float32(0.5)


@njit(cache=True, fastmath=REORDERED_SUMS)
def find_maxima(
    image, background, noise, side, found, per_unit, found_error, taps, beside, level_factor, lowest, dead, margin
):  # fmt: skip
    """The PEAK_FIELDS of the local maxima (n, PEAK_FIELDS) above `lowest` and `margin` inside, row by row.

    The residuals, zero beyond the border, are filtered in x and in y by a symmetric kernel, of which `taps` (1 + m,)
    has the middle and one side, m a multiple of PAIRS. The local level, times `level_factor`, is subtracted: the mean
    over the square of COARSE_PX and `beside` others on each side of it, interpolated between their middles. `dead`
    (H, W) pixels are no peaks; it may have no rows. The first arguments are those of `fill_row`.

    Filtered rows follow the rows of the image when these are there that filter and level need; with one tap and no
    level they are the residuals.
    """
    height, width = image.shape
    reach = len(taps) - 1
    has_level = level_factor > ZERO
    lag, kept = max(reach, COARSE_PX * (beside + 2) if has_level else 0), 2 * reach + 1
    lines, across = np.zeros((lag + 1, width + 2 * reach), np.float32), np.zeros((kept, width), np.float32)
    filtered = np.zeros((3, (width + CHUNK_PX - 1) // CHUNK_PX * CHUNK_PX), np.float32)
    squares, columns = (height + COARSE_PX - 1) // COARSE_PX, (width + COARSE_PX - 1) // COARSE_PX
    column, means = np.zeros(COARSE_PX * columns, np.float32), np.empty((squares, columns), np.float32)
    levels, filled = np.zeros((3, COARSE_PX * columns), np.float32), np.int64(0)  # 0 alone: a type of its own
    padded, mean = np.empty(columns + 2 * beside, np.float32), np.empty(columns, np.float32)
    peaks, count = np.empty((0, PEAK_FIELDS)), np.int64(0)
    for y in range(height + lag):
        if y < height:
            line = filtered[y % 3, :width] if lag == 0 else lines[y % (lag + 1), reach : reach + width]
            fill_row(image, background, noise, side, found, per_unit, found_error, y, line)
            if has_level:
                _add_clipped(line, column)
            if has_level and ((y + 1) % COARSE_PX == 0 or y + 1 == height):
                _take_means(column, y % COARSE_PX + 1, width, means[y // COARSE_PX])
        done = y - lag
        if lag > 0:
            if 0 <= done + reach < height:
                _filter_in_x(lines[(done + reach) % (lag + 1)], taps, across[(done + reach) % kept])
            elif done + reach >= height:
                across[(done + reach) % kept] = ZERO
            if done < 0:
                continue
            low, high, part = rows_beside(done, COARSE_PX, squares)
            while has_level and filled <= high:
                _average(means, filled, beside, level_factor, padded, mean)
                _widen(mean, levels[filled % 3])
                filled += 1
            _filter_in_y(across, done, taps, levels[low % 3], levels[high % 3], part, filtered[done % 3, :width])
        row = done - 1
        if margin <= row < height - margin:
            if count + width > len(peaks):
                peaks = np.concatenate((peaks, np.empty((len(peaks) + width, PEAK_FIELDS))))
            before, own, after = filtered[(row - 1) % 3], filtered[row % 3], filtered[done % 3]
            first = count
            count = _add_peaks(before, own, after, row, lowest, dead, margin, width - margin, peaks, count)
            low, high, part = rows_beside(row, COARSE_PX, squares)
            for k in range(first, count):
                x = int(peaks[k, 0])
                peaks[k, 5] = levels[low % 3, x] * (ONE - part) + levels[high % 3, x] * part
    return peaks[:count]


@njit(inner=True)
def _add_clipped(line, column):
    """Add the values of a row to those of a row of squares.

    Values beyond CLIPPED_SIGMA count as zero, not as the nearest value: stars are all on one side.
    """
    limit = np.float32(CLIPPED_SIGMA)
    for x in range(len(line)):
        column[x] += line[x] if abs(line[x]) <= limit else ZERO


@njit(inner=True)
def _take_means(column, rows, width, means):
    """Fill means (w,) from sums over `rows`, at the border of what there is; the sums become zero."""
    last = len(means) - 1
    for j in range(len(means)):
        total = ZERO
        for k in range(COARSE_PX):
            total += column[COARSE_PX * j + k]
        means[j] = total / np.float32(rows * COARSE_PX)
    means[last] *= np.float32(COARSE_PX) / np.float32(width - COARSE_PX * last)
    column[:] = ZERO


@njit(inner=True)
def _average(means, row, beside, factor, padded, out):
    """Fill out (w,) with the average of means (h, w) over `beside` squares on each side, times a factor.

    Means beyond the border are mirror images of those within.
    """
    rows, columns = means.shape
    padded[:] = ZERO
    inner = padded[beside : beside + columns]
    for k in range(-beside, beside + 1):
        line = means[_mirror(row + k, rows)]
        for j in range(columns):
            inner[j] += line[j]
    for k in range(1, beside + 1):
        padded[beside - k] = inner[_mirror(-k, columns)]
        padded[beside + columns - 1 + k] = inner[_mirror(columns - 1 + k, columns)]
    out[:] = ZERO
    share = factor / np.float32((2 * beside + 1) ** 2)
    for k in range(2 * beside + 1):
        line = padded[k : k + columns]
        for j in range(columns):
            out[j] += line[j] * share


@njit(inline="always")
def _mirror(at, length):
    """The index within `length` that stands for one beyond: the last one stands for the next one too."""
    at %= 2 * length
    return at if at < length else 2 * length - 1 - at


@njit(inner=True, fastmath=REORDERED_SUMS)
def _filter_in_x(line, taps, out):
    """Fill out (W,) with the line (W + 2 m,) filtered."""
    reach, width = len(taps) - 1, len(out)
    own, middle = taps[0], line[reach:]
    for x in range(width):
        out[x] = own * middle[x]
    for k in range(1, reach, PAIRS):
        one, two, three, four = taps[k], taps[k + 1], taps[k + 2], taps[k + 3]
        left, right = line[reach - k - 3 :], line[reach + k :]
        for x in range(width):
            out[x] += (
                one * (left[x + 3] + right[x])
                + two * (left[x + 2] + right[x + 1])
                + three * (left[x + 1] + right[x + 2])
                + four * (left[x] + right[x + 3])
            )


@njit(inner=True, fastmath=REORDERED_SUMS)
def _filter_in_y(across, row, taps, level_above, level_below, part, out):
    """Fill out (W,) with the rows about `row`, which lie in `across` (2 m + 1, W) in turn, filtered, above the level.

    The level is `part` of the way from one row of levels to another.
    """
    reach, kept = len(taps) - 1, len(across)
    own, middle, rest = taps[0], across[row % kept], ONE - part
    for x in range(len(out)):
        out[x] = own * middle[x] - (level_above[x] * rest + level_below[x] * part)
    for k in range(1, reach, PAIRS):
        one, two, three, four = taps[k], taps[k + 1], taps[k + 2], taps[k + 3]
        a, b, c, d = (
            across[(row - k) % kept], across[(row - k - 1) % kept], across[(row - k - 2) % kept],
            across[(row - k - 3) % kept],
        )  # fmt: skip
        e, f, g, h = (
            across[(row + k) % kept], across[(row + k + 1) % kept], across[(row + k + 2) % kept],
            across[(row + k + 3) % kept],
        )  # fmt: skip
        for x in range(len(out)):
            out[x] += one * (a[x] + e[x]) + two * (b[x] + f[x]) + three * (c[x] + g[x]) + four * (d[x] + h[x])


@njit(inner=True)
def _widen(values, out):
    """Fill out (COARSE_PX n,) by linear interpolation between the middles of squares with these values (n,)."""
    last = len(values) - 1
    for j in range(len(values)):
        before, own, after = values[max(j - 1, 0)], values[j], values[min(j + 1, last)]
        for k in range(COARSE_PX):
            at = np.float32((k + 0.5) / COARSE_PX - 0.5)
            out[j * COARSE_PX + k] = own + (at * (after - own) if at > ZERO else at * (own - before))


@njit(inner=True)
def _add_peaks(before, own, after, row, lowest, dead, first, stop, peaks, count):
    """Add the maxima of a row from column `first` to before `stop`; return the new number of peaks.

    The row before, the row itself and the next one have whole chunks. Chunks without a high pixel are passed over.
    """
    for start in range(0, len(own), CHUNK_PX):
        is_high = False
        for k in range(CHUNK_PX):
            is_high |= own[start + k] > lowest
        if not is_high:
            continue
        for x in range(max(start, first), min(start + CHUNK_PX, stop)):
            value = own[x]
            if not value > lowest or value < own[x - 1] or value < own[x + 1]:
                continue
            highest = not (len(dead) and dead[row, x])
            for j in range(x - 1, x + 2):
                highest = highest and value >= before[j] and value >= after[j]
            if highest:
                peaks[count, 0], peaks[count, 1], peaks[count, 2] = x, row, value
                peaks[count, 3] = _top(own[x - 1], value, own[x + 1])
                peaks[count, 4] = _top(before[x], value, after[x])
                count += 1
    return count


@njit(inline="always")
def _top(low, middle, high):
    """Offset [px] of the top of the parabola through three neighbours, at most half a pixel."""
    bend = low - np.float32(2.0) * middle + high
    return min(max(HALF * (low - high) / bend, -0.5), 0.5) if bend < 0.0 else 0.0
