/* The rows over boxes of positions: bounds and means of their log-likelihoods around the circle. */

#include <math.h>

#include "common.h"
#include "startrack_kernels.h"

/* Place of an elevation in a table of `count` elevations that are `step` apart, the last one but one at most. */
static inline int64_t place_of(double at, int64_t count)
{
    return (int64_t)smaller(greater(floor(at), 0.0), (double)(count - 2));
}

void sum_above(int64_t n, int64_t sectors, int64_t count, const int64_t *restrict sector, const double *restrict at,
               const double *restrict value, double *restrict found)
{
    for (int64_t k = 0; k < n; k++)
        if (at[k] >= 0.0)
            found[sector[k] * count + (int64_t)smaller(at[k], (double)(count - 1))] += value[k];
    for (int64_t s = 0; s < sectors; s++)
        for (int64_t i = count - 2; i >= 0; i--)
            found[s * count + i] += found[s * count + i + 1];
}

void fill_integral(int64_t sectors, int64_t m, int64_t count, const int64_t *restrict first, const double *restrict x,
                   const double *restrict left, const double *restrict right, const double *restrict integral,
                   const double *restrict free, double lowest, double step, double *restrict found,
                   double *restrict best)
{
    (void)m;
    for (int64_t s = 0; s < sectors; s++) {
        int64_t k = first[s];
        const int64_t last = first[s + 1] - 1;
        best[s] = -INFINITY;
        for (int64_t j = k; j < last; j++)
            best[s] = greater(greater(left[j], right[j]), best[s]);
        const double scale = exp(free[s] - best[s]);
        for (int64_t i = 0; i < count; i++) {
            const double at = lowest + (double)i * step;
            while (k < last - 1 && x[k + 1] <= at)
                k++;
            const double u = (at - x[k]) / (x[k + 1] - x[k]);
            found[s * count + i] = scale * (integral[k] + u * (integral[k + 1] - integral[k]));
        }
    }
}

double log_circle(int64_t n, int64_t sectors, const double *restrict clear, const double *restrict hidden,
                  int64_t every, double hide, double stop)
{
    (void)sectors;
    double total = 0.0, a = 1.0, b = 0.0, c = 0.0, d = 1.0; /* rows of the product: begun clear, begun hidden */
    for (int64_t k = 0; k < n; k++) {
        const double e = clear[k], h = hidden[k * every], a0 = a, c0 = c;
        a = (a0 * (1.0 - hide) + b * stop) * e;
        b = (a0 * hide + b * (1.0 - stop)) * h;
        c = (c0 * (1.0 - hide) + d * stop) * e;
        d = (c0 * hide + d * (1.0 - stop)) * h;
        if (k % 16 == 15) {
            const double size = a + b + c + d;
            a /= size;
            b /= size;
            c /= size;
            d /= size;
            total += log(size);
        }
    }
    return total + log(a + d);
}

void fill_bounds(int64_t sectors, int64_t count, int64_t n, const double *restrict visible,
                 const double *restrict open_from, const double *restrict open_above, const double *restrict best,
                 const double *restrict hidden, const double *restrict low, const double *restrict high, double lowest,
                 double step, double epsilon, double hide, double stop, double *restrict scratch,
                 double *restrict found)
{
    for (int64_t i = 0; i < n; i++) {
        for (int64_t s = 0; s < sectors; s++) {
            const int64_t a = s * count + place_of((low[i * sectors + s] - lowest) / step, count);
            const int64_t b = s * count + place_of((high[i * sectors + s] - lowest) / step, count) + 1;
            const double value = visible[b] + open_from[a] - open_above[b] - best[s];
            scratch[s] = 1.0; /* within a sector a real skyline hardly beats the best level one */
            if (value < 0.0)
                scratch[s] = (1.0 - epsilon) * exp(value) + epsilon;
        }
        found[i] = log_circle(sectors, sectors, scratch, hidden, 1, hide, stop);
    }
}

/* The integral of a sector up to an elevation, linear between those of the table. */
static double integral_at(const double *restrict integral, int64_t count, double at)
{
    const int64_t i = place_of(at, count);
    return integral[i] + (at - (double)i) * (integral[i + 1] - integral[i]);
}

void fill_averages(int64_t sectors, int64_t count, int64_t n, int64_t seen, const double *restrict integral,
                   const double *restrict hidden, const double *restrict low, const double *restrict high,
                   double lowest, double step, double epsilon, double hide, double stop, double *restrict scratch,
                   double *restrict found)
{
    const int64_t every = seen > 0 ? sectors / seen : 1;
    for (int64_t i = 0; i < n; i++) {
        for (int64_t k = 0; k < seen; k++) {
            const double a = low[i * seen + k], b = high[i * seen + k], *of = integral + k * every * count;
            const double rise =
                integral_at(of, count, (b - lowest) / step) - integral_at(of, count, (a - lowest) / step);
            const double mean = smaller(greater(rise / (b - a), 0.0), 1.0);
            scratch[k] = (1.0 - epsilon) * mean + epsilon;
        }
        found[i] = log_circle(seen, sectors, scratch, hidden, every, hide, stop);
    }
}
