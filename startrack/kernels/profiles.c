/* The cells of profiles: made of stars, divided by the light of the sky, averaged over errors, integrated. */

#include <math.h>

#include "common.h"
#include "profiles.h"
#include "startrack_kernels.h"

void fill_profiles(int64_t n, int64_t m, int64_t knots, const double *restrict elevation, const double *restrict llr,
                   const double *restrict extended, const double *restrict sigma, const int64_t *restrict first,
                   const int64_t *restrict last, const double *restrict low, const double *restrict step,
                   const double *restrict cdf, double *restrict values)
{
    (void)n;
    for (int64_t i = 0; i < m; i++) {
        for (int64_t j = 0; j < knots; j++) {
            const double horizon = low[i] + (double)j * step[i];
            double total = 0.0;
            for (int64_t k = first[i]; k <= last[i]; k++) {
                const double visible = normal_cdf(cdf, (elevation[k] - horizon) / sigma[k]);
                total += visible * (llr[k] + 0.5 * extended[k] * (1.0 - visible));
            }
            values[i * knots + j] = total;
        }
    }
}

int64_t fill_cells(int64_t stars, int64_t sectors, int64_t room, const double *restrict above,
                   const double *restrict llr, const int64_t *restrict starts, double lowest, double highest,
                   int64_t *restrict first, double *restrict x, double *restrict left)
{
    (void)stars;
    int64_t n = 0;
    first[0] = 0;
    for (int64_t s = 0; s < sectors; s++) {
        if (n + starts[s + 1] - starts[s] + 2 > room)
            return -1;
        double total = 0.0;
        for (int64_t k = starts[s]; k < starts[s + 1]; k++)
            total += llr[k];
        x[n] = lowest;
        left[n] = total;
        for (int64_t k = starts[s]; k < starts[s + 1]; k++) {
            if (above[k] > x[n])
                x[++n] = above[k];
            total -= llr[k];
            left[n] = total;
        }
        x[n + 1] = highest;
        left[n + 1] = 0.0;
        n += 2;
        first[s + 1] = n;
    }
    return n;
}

/* Value between the knots of a uniform grid; constant beyond its ends. */
static double cubic(const double *restrict values, int64_t knots, double at)
{
    at = smaller(greater(at, 0.0), (double)knots - 1.0);
    const int64_t j = least(most((int64_t)at, 1), knots - 3);
    const double u = at - (double)j, *v = values + j;
    return -v[-1] * u * (u - 1) * (u - 2) / 6 + v[0] * (u + 1) * (u - 1) * (u - 2) / 2 -
           v[1] * (u + 1) * u * (u - 2) / 2 + v[2] * (u + 1) * u * (u - 1) / 6;
}

int64_t add_sky(int64_t sectors, int64_t m, int64_t knots, int64_t room, const int64_t *restrict old_first,
                const double *restrict old_x, const double *restrict old_left, const double *restrict old_right,
                const double *restrict old_bend, const double *restrict low, const double *restrict step,
                const double *restrict cell, const double *restrict values, int64_t *restrict first, double *restrict x,
                double *restrict left, double *restrict right, double *restrict bend)
{
    (void)m;
    const struct cells old = {old_first, old_x, old_left, old_right, old_bend, 0, 0, 0, 0, 0.0};
    int64_t n = 0;
    first[0] = 0;
    for (int64_t s = 0; s < sectors; s++) {
        const int64_t begin = old_first[s], last = old_first[s + 1] - 1;
        const double *restrict sky = values + s * knots;
        double sky_at = greater(low[s], old_x[begin] + cell[s]);
        const double sky_end = smaller(low[s] + ((double)knots - 1.0) * step[s], old_x[last] - cell[s]);
        for (int64_t k = begin; k < last; k++) {
            const double from = old_x[k], width = old_x[k + 1] - old_x[k];
            double at = from;
            while (at < old_x[k + 1]) {
                if (n + 1 >= room)
                    return -1;
                double following = old_x[k + 1];
                if (step[s] > 0.0 && sky_at <= sky_end)
                    following = smaller(sky_at, following);
                const double u = (at - from) / width, v = (following - from) / width;
                x[n] = at;
                left[n] = value_in(&old, k, u);
                right[n] = value_in(&old, k, v);
                double middle = value_in(&old, k, 0.5 * (u + v));
                if (step[s] > 0.0) {
                    const double a = (at - low[s]) / step[s], b = (following - low[s]) / step[s];
                    left[n] += cubic(sky, knots, a);
                    right[n] += cubic(sky, knots, b);
                    middle += cubic(sky, knots, 0.5 * (a + b));
                }
                bend[n] = 4.0 * (middle - 0.5 * (left[n] + right[n]));
                if (sky_at <= following)
                    sky_at += cell[s];
                at = following;
                n++;
            }
        }
        if (n >= room)
            return -1;
        x[n] = old_x[last];
        left[n] = right[n] = bend[n] = 0.0;
        n++;
        first[s + 1] = n;
    }
    return n;
}

/* Logarithm of the mean of exp F over a normal error about a height. `at` [bins] holds the cells of the ends of the bins
   about a lower height, from which on they are searched. */
static double mean_over(const struct cells *c, int64_t s, double height, double sigma, int64_t bins,
                        const double *restrict ends, const double *restrict weights, double least_mean,
                        int64_t *restrict cell)
{
    const double *x = c->x, *integral = c->integral, free = c->free[s];
    const int64_t last = c->first[s + 1] - 1;
    double total = 0.0, before = 0.0;
    for (int64_t q = 0; q < bins; q++) {
        const double at = height + ends[q] * sigma;
        int64_t k = cell[q];
        while (k < last - 1 && x[k + 1] <= at)
            k++;
        cell[q] = k;
        double after = integral[k] +
                       (smaller(at, c->high) - x[k]) / (x[k + 1] - x[k]) * (integral[k + 1] - integral[k]);
        after += greater(at - c->high, 0.0) * exp(-free);
        if (q > 0)
            total += weights[q - 1] * (after - before) / ((ends[q] - ends[q - 1]) * sigma);
        before = after;
    }
    return log(greater(total, least_mean)) + free;
}

int64_t average_over_error(int64_t sectors, int64_t m, int64_t guides, int64_t between, int64_t room,
                           const int64_t *restrict old_first, const double *restrict old_x,
                           const double *restrict old_left, const double *restrict old_right,
                           const double *restrict old_bend, const double *restrict old_integral,
                           const double *restrict free, const int32_t *restrict guide, const double *restrict sigma,
                           const double *restrict low, const double *restrict high, const int64_t *restrict counts,
                           double highest, const double *restrict ends, const double *restrict weights,
                           double least_mean, int64_t *restrict scratch, int64_t *restrict first, double *restrict x,
                           double *restrict left, double *restrict right, double *restrict bend)
{
    (void)m;
    const struct cells old = {old_first, old_x, old_left, old_right, old_bend, old_integral, free, guide, guides,
                              highest};
    const int64_t bins = between + 1;
    int64_t n = 0;
    first[0] = 0;
    for (int64_t s = 0; s < sectors; s++) {
        const int64_t begin = old_first[s], last = old_first[s + 1] - 1;
        if (n + last + 1 - begin + counts[s] + 2 > room)
            return -1;
        int64_t rest = begin; /* from here on the cells stay */
        if (sigma[s] > 0.0) {
            int64_t k = begin;
            for (; k < last && old_x[k] < low[s]; k++, n++) {
                x[n] = old_x[k];
                left[n] = old_left[k];
                right[n] = old_right[k];
                bend[n] = old_bend[k];
            }
            const double step = (high[s] - low[s]) / (double)counts[s];
            for (int64_t q = 0; q < bins; q++)
                scratch[q] = begin;
            double before = mean_over(&old, s, low[s], sigma[s], bins, ends, weights, least_mean, scratch);
            for (int64_t i = 0; i < counts[s]; i++, n++) {
                const double at = low[s] + (double)i * step;
                const double middle =
                    mean_over(&old, s, at + 0.5 * step, sigma[s], bins, ends, weights, least_mean, scratch);
                const double after = mean_over(&old, s, at + step, sigma[s], bins, ends, weights, least_mean, scratch);
                const double rise = fabs(after - before);
                x[n] = at;
                left[n] = before;
                right[n] = after;
                bend[n] = 4.0 * (middle - 0.5 * (before + after));
                if (smaller(before, after) <= middle && middle <= greater(before, after)) /* nor has the parabola a peak */
                    bend[n] = smaller(greater(bend[n], -rise), rise);
                before = after;
            }
            k = last - 1;
            if (high[s] < highest) {
                k = cell_at(&old, s, high[s]);
                x[n] = high[s];
                left[n] = log_at(&old, s, high[s]) + free[s];
                right[n] = old_right[k];
                bend[n] = 0.0;
                n++;
            }
            rest = k + 1;
        }
        for (int64_t j = rest; j <= last; j++, n++) {
            x[n] = old_x[j];
            left[n] = old_left[j];
            right[n] = old_right[j];
            bend[n] = old_bend[j];
        }
        first[s + 1] = n;
    }
    return n;
}

void integrate_cells(int64_t sectors, int64_t m, int64_t guides, const int64_t *restrict first,
                     const double *restrict x, const double *restrict left, const double *restrict right,
                     const double *restrict bend, double width, double highest, double *restrict integral,
                     double *restrict free, int32_t *restrict guide)
{
    (void)m;
    const double half = (double)(guides / 2);
    for (int64_t s = 0; s < sectors; s++) {
        const int64_t begin = first[s], last = first[s + 1] - 1;
        double top = -INFINITY, total = 0.0;
        for (int64_t k = begin; k < last; k++)
            top = greater(greater(left[k], right[k]), greater(0.5 * (left[k] + right[k]) + 0.25 * bend[k], top));
        for (int64_t k = begin; k < last; k++) {
            integral[k] = total;
            const double middle = exp(0.5 * (left[k] + right[k]) + 0.25 * bend[k] - top);
            total += (x[k + 1] - x[k]) / 6.0 * (exp(left[k] - top) + 4.0 * middle + exp(right[k] - top));
        }
        integral[last] = total;
        free[s] = top + log(total / width);
        for (int64_t k = begin; k <= last; k++)
            integral[k] *= width / total;
        int64_t k = begin;
        for (int64_t i = 0; i < guides; i++) {
            const double u = (double)i / half - 1.0;
            while (k < last - 1 && x[k + 1] <= u * fabs(u) * highest)
                k++;
            guide[s * guides + i] = (int32_t)k;
        }
    }
}

void fill_moments(int64_t sectors, int64_t m, int64_t guides, const int64_t *restrict first, const double *restrict x,
                  const double *restrict left, const double *restrict right, const double *restrict bend,
                  const int32_t *restrict guide, double highest, double reach, double *restrict mean,
                  double *restrict variance)
{
    (void)m;
    const struct cells c = {first, x, left, right, bend, 0, 0, guide, guides, highest};
    for (int64_t s = 0; s < sectors; s++) {
        const int64_t last = first[s + 1] - 1, begin = cell_at(&c, s, -reach);
        double top = -INFINITY, total = 0.0, sum = 0.0, squares = 0.0;
        for (int64_t k = begin; k < last && x[k] < reach; k++)
            top = greater(greater(left[k], right[k]), top);
        for (int64_t k = begin; k < last && x[k] < reach; k++) {
            const double a = greater(x[k], -reach), b = smaller(x[k + 1], reach);
            const double middle = 0.5 * (a + b), width = b - a;
            const double at = value_in(&c, k, (middle - x[k]) / (x[k + 1] - x[k]));
            const double weight = width * exp(smaller(at - top, 50.0));
            total += weight;
            sum += weight * middle;
            squares += weight * (middle * middle + width * width / 12.0);
        }
        mean[s] = sum / total;
        variance[s] = squares / total - mean[s] * mean[s];
    }
}
