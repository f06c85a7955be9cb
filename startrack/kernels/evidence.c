/* The light of the sky and of the ground beside a skyline. */

#include <math.h>

#include "common.h"
#include "startrack_kernels.h"

enum { GROUND, SKY };

void filter_patches(int64_t n, int64_t longest, const double *restrict own, const double *restrict variance,
                    double width, double drift, double border, double *restrict weight, double *restrict mean,
                    double *restrict spread, double *restrict scratch)
{
    double *restrict w = scratch, *restrict m = scratch + longest + 1, *restrict s = scratch + 2 * (longest + 1);
    int64_t count = 0;
    for (int64_t k = 0; k < 2 * n; k++) {
        const int64_t i = k % n;
        const double y = own[i], v = variance[i];
        for (int64_t r = count; r > 0; r--) { /* one sector longer */
            const double before = s[r - 1] + drift, both = before + v, off = y - m[r - 1];
            w[r] = w[r - 1] * (1.0 - border) * exp(-0.5 * off * off / both) / sqrt(TURN * both);
            m[r] = m[r - 1] + before / both * off;
            s[r] = before * v / both;
        }
        w[0] = count ? border / width : 1.0;
        m[0] = y;
        s[0] = v;
        if (count == longest) {
            const double total = w[longest] + w[longest - 1];
            if (total > 0.0) {
                const double part = w[longest] / total;
                m[longest - 1] += part * (m[longest] - m[longest - 1]);
                s[longest - 1] += part * (s[longest] - s[longest - 1]);
            }
            w[longest - 1] = total;
        }
        count = least(count + 1, longest);
        double total = 0.0;
        for (int64_t r = 0; r < count; r++)
            total += w[r];
        for (int64_t r = 0; r < count; r++) {
            w[r] /= total;
            weight[i * longest + r] = w[r];
            mean[i * longest + r] = m[r];
            spread[i * longest + r] = s[r];
        }
    }
}

void join_patches(int64_t n, int64_t longest, const double *restrict weight, const double *restrict mean,
                  const double *restrict spread, const double *restrict later_weight,
                  const double *restrict later_mean, const double *restrict later_spread, double width, double drift,
                  double border, double least_weight, double *restrict level)
{
    for (int64_t i = 0; i < n; i++) {
        double total = 0.0, first = 0.0;
        for (int64_t r = i * longest; r < (i + 1) * longest; r++) {
            if (weight[r] < least_weight)
                continue;
            const double alone = weight[r] * border;
            total += alone;
            first += alone * mean[r];
            for (int64_t q = i * longest; q < (i + 1) * longest; q++) {
                if (later_weight[q] < least_weight)
                    continue;
                const double both = spread[r] + (later_spread[q] + drift), off = later_mean[q] - mean[r];
                const double agree = exp(-0.5 * off * off / both) / sqrt(TURN * both);
                const double part = weight[r] * later_weight[q] * (1.0 - border) * width * agree;
                total += part;
                first += part * (mean[r] + spread[r] / both * off);
            }
        }
        level[i] = first / total;
    }
}

void sum_sides(int64_t n, int64_t sectors, const int64_t *restrict side, const int64_t *restrict sector,
               const double *restrict height, const double *restrict light, const double *restrict level,
               const double *restrict slope, const double *restrict limit, double *restrict sums)
{
    for (int64_t k = 0; k < n; k++) {
        if (side[k] < 0)
            continue;
        const int64_t at = side[k] * sectors + sector[k];
        const double h = height[k], q = light[k] - level[at] - slope[at] * h;
        if (fabs(q) <= limit[at]) {
            double *restrict to = sums + 6 * sectors * side[k] + sector[k];
            to[0] += 1.0;
            to[sectors] += h;
            to[2 * sectors] += h * h;
            to[3 * sectors] += q;
            to[4 * sectors] += q * h;
            to[5 * sectors] += q * q;
        }
    }
}

void score_shifts(int64_t sectors, int64_t cells, int64_t shifts, const double *restrict height,
                  const double *restrict llr, const double *restrict extended, double edge,
                  const double *restrict shift, const double *restrict cdf, double *restrict log)
{
    for (int64_t i = 0; i < sectors; i++) {
        for (int64_t m = 0; m < shifts; m++) {
            double total = 0.0;
            for (int64_t j = i * cells; j < (i + 1) * cells; j++) {
                const double visible = normal_cdf(cdf, (height[j] - shift[m]) / edge);
                total += visible * (llr[j] + 0.5 * extended[j] * (1.0 - visible));
            }
            log[i * shifts + m] = total;
        }
    }
}

void sum_cells(int64_t n, int64_t sectors, int64_t cells, const int64_t *restrict sector,
               const double *restrict height, const double *restrict light, const double *restrict scale,
               const bool *restrict covered, const double *restrict level, const double *restrict slope,
               const double *restrict variance, double correlation, double edge, const double *restrict reach,
               double clip, double cell, const double *restrict cdf, double *restrict sums, double *restrict scales)
{
    const double half = 0.5 * (double)cells * cell;
    for (int64_t k = 0; k < n; k++) {
        const int64_t i = sector[k], above = SKY * sectors + i, below = GROUND * sectors + i;
        const double h = height[k];
        if (!covered[i] || !(fabs(h) < half) || isnan(light[k]))
            continue;
        const double ground = level[below] + slope[below] * h;
        const double step = level[above] + slope[above] * h - ground;
        const double visible = normal_cdf(cdf, h / edge);
        const double fewest = step * normal_cdf(cdf, (h - reach[i]) / edge);
        const double all = step * normal_cdf(cdf, (h + reach[i]) / edge);
        const double s2 = variance[below] + (variance[above] - variance[below]) * visible;
        const double q = light[k] - ground;
        const double low = smaller(fewest, all), high = greater(fewest, all);
        const double beyond = greater(greater(low - q, q - high), 0.0);
        if (beyond * beyond * correlation <= clip * clip * s2) {
            const int64_t j = least((int64_t)((h + half) / cell), cells - 1);
            double *restrict to = sums + 3 * (i * cells + j);
            to[0] += (q * step - 0.5 * step * step) / s2;
            to[1] += step * step / s2;
            to[2] += step * step / s2 * h;
            scales[2 * i] += 1.0;
            scales[2 * i + 1] += scale[k];
        }
    }
}

void clear_disks(int64_t height, int64_t width, int64_t n, bool *restrict mask, const int64_t *restrict xy_px,
                 const int64_t *restrict radius_px, double large_px, bool *restrict touching)
{
    for (int64_t k = 0; k < n; k++) {
        const int64_t x = xy_px[2 * k], y = xy_px[2 * k + 1];
        touching[k] = (double)radius_px[k] > large_px ||
                      (0 <= x && x < width && 0 <= y && y < height && mask[y * width + x]);
    }
    for (int64_t k = 0; k < n; k++) {
        const int64_t x = xy_px[2 * k], y = xy_px[2 * k + 1], r = radius_px[k];
        if (!touching[k])
            continue;
        for (int64_t row = most(y - r, 0); row < least(y + r + 1, height); row++)
            for (int64_t column = most(x - r, 0); column < least(x + r + 1, width); column++)
                if ((column - x) * (column - x) + (row - y) * (row - y) <= r * r)
                    mask[row * width + column] = false;
    }
}
