/* Detection: an image beside its background and noise, and the maxima of its matched filter. Pixels are in single
   precision. */

#include <math.h>

#include "common.h"
#include "startrack_kernels.h"

#define PAIRS 4 /* of taps in one pass over a row */
#define LANES 8 /* pixels of a block that are taken together */
#define WORD 64 /* pixels of a row of which one bit each says whether they are high */


void convert_counts(int64_t height, int64_t width, int64_t bias_rows, int64_t bias_columns, int64_t converted,
                    const float *restrict pixels_adu, const float *restrict recorded_adu, float gain,
                    const float *restrict bias_e, float highest_adu, float *restrict image, bool *restrict saturated)
{
    for (int64_t y = 0; y < height; y++) {
        const float *counts = recorded_adu + y * width, *light = pixels_adu + y * width;
        int32_t above = 0;
        for (int64_t x = 0; x < width; x++)
            above |= counts[x] >= highest_adu;
        if (above) /* seldom: memory that nobody writes to costs no time */
            for (int64_t x = 0; x < width; x++)
                saturated[y * width + x] = counts[x] >= highest_adu;
        if (converted == 0)
            continue;
        const float *bias = bias_e + (bias_rows > 1 ? y * bias_columns : 0);
        if (bias_columns > 1)
            for (int64_t x = 0; x < width; x++)
                image[y * width + x] = light[x] * gain - bias[x];
        else
            for (int64_t x = 0; x < width; x++)
                image[y * width + x] = light[x] * gain - *bias;
    }
}

/* The pixel of `length` that stands for one at or beyond the end: a mirror image about the last one. */
static int64_t reflect(int64_t at, int64_t length)
{
    const int64_t period = most(2 * (length - 1), 1);
    at %= period;
    return at < length ? at : period - at;
}

static inline void add_lanes(const float *restrict a, const float *restrict b, float *restrict to)
{
    for (int64_t j = 0; j < LANES; j++)
        to[j] = a[j] + b[j];
}

void fill_blocks(int64_t height, int64_t width, int64_t px, int64_t rows, int64_t columns, const float *restrict image,
                 int64_t side, int64_t first, const float *restrict part_steps, float *restrict blocks)
{
    const int64_t apart = 2 * side / px;
    for (int64_t i = 0; i < rows; i++) {
        for (int64_t r = 0; r < px; r++) {
            const float *line = image + reflect((first + i) * side + r / 2 * apart + r % 2, height) * width;
            const float *steps = part_steps + r * px;
            for (int64_t j = 0; j < columns; j++) {
                float *block = blocks + ((i * columns + j) * px + r) * px;
                const int64_t left = j * side;
                if (left + side > width || apart > 2)
                    for (int64_t c = 0; c < px; c++)
                        block[c] = line[reflect(left + c / 2 * apart + c % 2, width)] + steps[c];
                else
                    for (int64_t c = 0; c < px; c += LANES)
                        add_lanes(line + left + c, steps + c, block + c);
            }
        }
    }
}

void fill_from_blocks(int64_t height, int64_t width, int64_t rows, int64_t columns, int64_t room,
                      float *restrict image, const bool *restrict masked, const int64_t *restrict good,
                      const int64_t *restrict source, int64_t side, float *restrict values)
{
    for (int64_t i = 0; i < rows * columns; i++) {
        const int64_t top = i / columns * side, bottom = least(top + side, height);
        const int64_t left = i % columns * side, right = least(left + side, width);
        if (good[i] == (bottom - top) * (right - left))
            continue;
        const int64_t from_y = source[i] * side, from_x = source[rows * columns + i] * side;
        int64_t count = 0, next = 0;
        for (int64_t y = from_y; y < least(from_y + side, height); y++)
            for (int64_t x = from_x; x < least(from_x + side, width); x++)
                if (!masked[y * width + x] && count < room)
                    values[count++] = image[y * width + x];
        for (int64_t y = top; y < bottom && count > 0; y++) {
            for (int64_t x = left; x < right; x++) {
                if (!masked[y * width + x])
                    continue;
                image[y * width + x] = values[next];
                next = next + 1 < count ? next + 1 : 0;
            }
        }
    }
}

/* An image, the rows of its background and noise, which stand in the middles of `blocks` blocks of `side` rows, and the
   light of known stars, where there are any. */
struct picture {
    int64_t width, blocks, side, known;
    const float *image, *background, *noise, *found;
    float per_unit, found_error;
};

static void fill_plain(int64_t width, const float *restrict light, const float *restrict low_b,
                       const float *restrict high_b, const float *restrict low_n, const float *restrict high_n,
                       float part, float *restrict line)
{
    const float rest = 1.0f - part;
    for (int64_t x = 0; x < width; x++)
        line[x] = (light[x] - (low_b[x] * rest + high_b[x] * part)) / (low_n[x] * rest + high_n[x] * part);
}

/* Fill `line` with row y of a picture: light above the background, in units of the noise. */
static void fill_row(const struct picture *p, int64_t y, float *restrict line)
{
    const struct beside at = rows_beside(y, p->side, p->blocks);
    const float *light = p->image + y * p->width;
    const float *low_b = p->background + at.low * p->width, *high_b = p->background + at.high * p->width;
    const float *low_n = p->noise + at.low * p->width, *high_n = p->noise + at.high * p->width;
    if (p->known == 0) {
        fill_plain(p->width, light, low_b, high_b, low_n, high_n, at.part, line);
        return;
    }
    const float *known = p->found + y * p->width;
    const float rest = 1.0f - at.part, error = p->found_error * p->found_error;
    for (int64_t x = 0; x < p->width; x++) {
        const float sigma = low_n[x] * rest + high_n[x] * at.part;
        const float variance = sigma * sigma + known[x] * (p->per_unit + error * known[x]);
        line[x] = (light[x] - (low_b[x] * rest + high_b[x] * at.part) - known[x]) / sqrtf(variance);
    }
}

void fill_residuals(int64_t height, int64_t width, int64_t blocks, int64_t known, const float *restrict image,
                    const float *restrict background, const float *restrict noise, int64_t side,
                    const float *restrict found, float per_unit, float found_error, float *restrict residuals)
{
    const struct picture p = {width, blocks, side, known, image, background, noise, found, per_unit, found_error};
    for (int64_t y = 0; y < height; y++)
        fill_row(&p, y, residuals + y * width);
}

void cut_light(int64_t height, int64_t width, int64_t blocks, int64_t n, int64_t stamp, const float *restrict image,
               const float *restrict background, const float *restrict noise, int64_t side,
               const int64_t *restrict centres, float *restrict light, float *restrict variance)
{
    (void)height;
    for (int64_t k = 0; k < n; k++) {
        const int64_t left = centres[2 * k] - stamp / 2, top = centres[2 * k + 1] - stamp / 2;
        for (int64_t i = 0; i < stamp; i++) {
            const struct beside at = rows_beside(top + i, side, blocks);
            const float *low_b = background + at.low * width + left, *high_b = background + at.high * width + left;
            const float *low_n = noise + at.low * width + left, *high_n = noise + at.high * width + left;
            const float *pixels = image + (top + i) * width + left, rest = 1.0f - at.part;
            float *own = light + (k * stamp + i) * stamp, *spread = variance + (k * stamp + i) * stamp;
            for (int64_t j = 0; j < stamp; j++) {
                const float sigma = low_n[j] * rest + high_n[j] * at.part;
                own[j] = pixels[j] - (low_b[j] * rest + high_b[j] * at.part);
                spread[j] = sigma * sigma;
            }
        }
    }
}

/* The search for maxima: rows of scratch, of `stride` pixels each, and means of squares of `coarse` pixels. */
struct search {
    int64_t width, reach, lag, kept, stride, coarse, beside, squares, columns;
    const float *taps;
    float factor;
    float *lines, *across, *filtered, *levels, *sums, *padded, *mean, *means;
};

/* Add the values of a row to sums over columns. Values beyond `clipped` count as zero, not as the nearest value: stars
   are all on one side. */
static void add_clipped(int64_t width, const float *restrict line, float clipped, float *restrict sums)
{
    for (int64_t x = 0; x < width; x++)
        sums[x] += fabsf(line[x]) <= clipped ? line[x] : 0.0f;
}

/* Make means of a row of squares from the sums over so many rows, at the border of what there is; the sums become 0. */
static void take_means(const struct search *s, int64_t rows, float *means)
{
    const int64_t last = s->columns - 1;
    for (int64_t j = 0; j < s->columns; j++) {
        float total = 0.0f;
        for (int64_t k = 0; k < s->coarse; k++)
            total += s->sums[s->coarse * j + k];
        means[j] = total / (float)(rows * s->coarse);
    }
    means[last] *= (float)s->coarse / (float)(s->width - s->coarse * last);
    for (int64_t x = 0; x < s->coarse * s->columns; x++)
        s->sums[x] = 0.0f;
}

/* The index within `length` that stands for one beyond: the last one stands for the next one too. */
static int64_t mirror(int64_t at, int64_t length)
{
    at %= 2 * length;
    at += at < 0 ? 2 * length : 0;
    return at < length ? at : 2 * length - 1 - at;
}

/* Fill `levels` with the level in the middle of a row of squares: the average over the squares beside, which are mirror
   images beyond the border, interpolated between their middles. */
static void fill_levels(const struct search *s, int64_t row, float *levels)
{
    const int64_t last = s->columns - 1;
    const float share = s->factor / (float)((2 * s->beside + 1) * (2 * s->beside + 1));
    const double per_pixel = 1.0 / (double)s->coarse;
    float *inner = s->padded + s->beside;
    for (int64_t j = 0; j < s->columns; j++)
        inner[j] = s->mean[j] = 0.0f;
    for (int64_t k = -s->beside; k <= s->beside; k++) {
        const float *line = s->means + mirror(row + k, s->squares) * s->columns;
        for (int64_t j = 0; j < s->columns; j++)
            inner[j] += line[j];
    }
    for (int64_t k = 1; k <= s->beside; k++) {
        inner[-k] = inner[mirror(-k, s->columns)];
        inner[last + k] = inner[mirror(last + k, s->columns)];
    }
    for (int64_t k = 0; k <= 2 * s->beside; k++)
        for (int64_t j = 0; j < s->columns; j++)
            s->mean[j] += s->padded[j + k] * share;
    for (int64_t j = 0; j < s->columns; j++) {
        const float own = s->mean[j], left = own - s->mean[most(j - 1, 0)], right = s->mean[least(j + 1, last)] - own;
        for (int64_t k = 0; k < s->coarse; k++) {
            const float at = (float)(((double)k + 0.5) * per_pixel - 0.5);
            levels[j * s->coarse + k] = own + at * (at > 0.0f ? right : left);
        }
    }
}

/* Add PAIRS taps times the sums of the two values that stand so far off on either side. */
static void add_pairs(int64_t width, const float *taps, const float *a, const float *b, const float *c, const float *d,
                      const float *e, const float *f, const float *g, const float *h, float *restrict to)
{
    const float one = taps[0], two = taps[1], three = taps[2], four = taps[3];
    for (int64_t x = 0; x < width; x++)
        to[x] += one * (a[x] + e[x]) + two * (b[x] + f[x]) + three * (c[x] + g[x]) + four * (d[x] + h[x]);
}

static void filter_in_x(const struct search *s, const float *line, float *restrict to)
{
    const float *middle = line + s->reach;
    for (int64_t x = 0; x < s->width; x++)
        to[x] = s->taps[0] * middle[x];
    for (int64_t k = 1; k < s->reach; k += PAIRS) {
        const float *left = middle - k, *right = middle + k;
        add_pairs(s->width, s->taps + k, left, left - 1, left - 2, left - 3, right, right + 1, right + 2, right + 3,
                  to);
    }
}

/* A row of those filtered in x, of which as many are kept as the filter in y needs. */
static float *row_across(const struct search *s, int64_t row)
{
    return s->across + (row + s->kept) % s->kept * s->stride;
}

static void filter_in_y(const struct search *s, int64_t row, const float *restrict above, const float *restrict below,
                        float part, float *restrict to)
{
    const float *middle = row_across(s, row), own = s->taps[0], rest = 1.0f - part;
    for (int64_t x = 0; x < s->width; x++)
        to[x] = own * middle[x] - (above[x] * rest + below[x] * part);
    for (int64_t k = 1; k < s->reach; k += PAIRS)
        add_pairs(s->width, s->taps + k, row_across(s, row - k), row_across(s, row - k - 1), row_across(s, row - k - 2),
                  row_across(s, row - k - 3), row_across(s, row + k), row_across(s, row + k + 1),
                  row_across(s, row + k + 2), row_across(s, row + k + 3), to);
}

/* The pixels of a word that are above `lowest`, as bits. */
static uint64_t high_pixels(const float *own, float lowest)
{
    int32_t any = 0;
    for (int64_t k = 0; k < WORD; k++)
        any |= own[k] > lowest;
    uint64_t bits = 0;
    for (int64_t k = 0; any && k < WORD; k++)
        bits |= (uint64_t)(own[k] > lowest) << k;
    return bits;
}

/* Number of the lowest bit that is set, of a word that has one. */
static int64_t lowest_bit(uint64_t bits)
{
    int64_t k = 0;
    for (int64_t half = WORD / 2; half > 0; half /= 2) {
        if ((bits & (((uint64_t)1 << half) - 1)) == 0) {
            bits >>= half;
            k += half;
        }
    }
    return k;
}

/* Offset (pixels) of the top of the parabola through three neighbours, at most half a pixel. */
static float top_of(float low, float middle, float high)
{
    const float bend = low - 2.0f * middle + high;
    return bend < 0.0f ? (float)smaller(greater(0.5f * (low - high) / bend, -0.5), 0.5) : 0.0f;
}

static bool is_maximum(const float *before, const float *own, const float *after, int64_t x)
{
    const float value = own[x];
    if (value < own[x - 1] || value < own[x + 1])
        return false;
    for (int64_t j = x - 1; j <= x + 1; j++)
        if (!(value >= before[j] && value >= after[j]))
            return false;
    return true;
}

int64_t find_maxima(int64_t height, int64_t width, int64_t blocks, int64_t known, int64_t reach, int64_t dead_rows,
                    int64_t count, int64_t stride, int64_t squares, int64_t columns, int64_t room,
                    const float *restrict image, const float *restrict background, const float *restrict noise,
                    int64_t side, const float *restrict found, float per_unit, float found_error,
                    const float *restrict taps, int64_t coarse, int64_t beside, float clipped, float level_factor,
                    float lowest, const bool *restrict dead, int64_t margin, float *restrict rows,
                    float *restrict means, int64_t *restrict pixels, float *restrict values)
{
    const struct picture p = {width, blocks, side, known, image, background, noise, found, per_unit, found_error};
    const int64_t kept = 2 * reach + 1, lag = count - kept - 10;
    float *const across = rows + (lag + 1) * stride, *const filtered = across + kept * stride;
    const struct search s = {width, reach, lag, kept, stride, coarse, beside, squares, columns, taps, level_factor,
                             rows, across, filtered, filtered + 3 * stride, filtered + 6 * stride,
                             filtered + 7 * stride, filtered + 8 * stride, means};
    const bool has_level = level_factor > 0.0f;
    int64_t filled = 0, peaks = 0;
    for (int64_t k = 0; k < count * stride; k++)
        rows[k] = 0.0f;
    for (int64_t y = 0; y < height + lag; y++) {
        if (y < height) {
            float *line = lag == 0 ? s.filtered + y % 3 * stride : s.lines + y % (lag + 1) * stride + reach;
            fill_row(&p, y, line);
            if (has_level)
                add_clipped(width, line, clipped, s.sums);
            if (has_level && ((y + 1) % coarse == 0 || y + 1 == height))
                take_means(&s, y % coarse + 1, means + y / coarse * columns);
        }
        const int64_t done = y - lag, ahead = done + reach, row = done - 1;
        if (lag > 0) {
            if (ahead >= height)
                for (int64_t x = 0; x < width; x++)
                    row_across(&s, ahead)[x] = 0.0f;
            else if (ahead >= 0)
                filter_in_x(&s, s.lines + ahead % (lag + 1) * stride, row_across(&s, ahead));
            if (done < 0)
                continue;
            const struct beside at = rows_beside(done, coarse, squares);
            for (; has_level && filled <= at.high; filled++)
                fill_levels(&s, filled, s.levels + filled % 3 * stride);
            filter_in_y(&s, done, s.levels + at.low % 3 * stride, s.levels + at.high % 3 * stride, at.part,
                        s.filtered + done % 3 * stride);
        }
        if (row < margin || row >= height - margin)
            continue;
        const float *before = s.filtered + (row - 1) % 3 * stride, *own = s.filtered + row % 3 * stride;
        const float *after = s.filtered + done % 3 * stride;
        const struct beside at = rows_beside(row, coarse, squares);
        const float *above = s.levels + at.low % 3 * stride, *below = s.levels + at.high % 3 * stride;
        for (int64_t start = 0; start < width; start += WORD) {
            for (uint64_t bits = high_pixels(own + start, lowest); bits; bits &= bits - 1) {
                const int64_t x = start + lowest_bit(bits);
                const bool is_inside = x >= margin && x < width - margin;
                if (!is_inside || !is_maximum(before, own, after, x) || (dead_rows && dead[row * width + x]))
                    continue;
                if (peaks < room) {
                    pixels[2 * peaks] = x;
                    pixels[2 * peaks + 1] = row;
                    values[4 * peaks] = own[x];
                    values[4 * peaks + 1] = top_of(own[x - 1], own[x], own[x + 1]);
                    values[4 * peaks + 2] = top_of(before[x], own[x], after[x]);
                    values[4 * peaks + 3] = above[x] * (1.0f - at.part) + below[x] * at.part;
                }
                peaks++;
            }
        }
    }
    return peaks;
}
