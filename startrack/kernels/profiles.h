/* Log-likelihoods F of the skyline's height in each sector, in cells of heights in which they are quadratic.

   Cell k of a sector reaches from x[k] to x[k + 1]; the last one is a sentinel. See localization/likelihood/skyline_profiles.py. */

#ifndef STARTRACK_PROFILES_H
#define STARTRACK_PROFILES_H

#include <math.h>
#include <stdint.h>

#include "common.h"

struct cells {
    const int64_t *first; /* [sectors + 1] */
    const double *x, *left, *right, *bend, *integral, *free;
    const int32_t *guide; /* [sectors, guides]: cells of heights closer to each other about 0 */
    int64_t guides;
    double high; /* highest height */
};

/* The cell of a sector that holds a height, or the nearest one. NaN: the first one of the guide. */
static inline int64_t cell_at(const struct cells *c, int64_t s, double height)
{
    const double half = (double)(c->guides / 2), u = copysign(sqrt(fabs(height) * (1.0 / c->high)), height);
    const int32_t *at = c->guide + s * c->guides + (int64_t)smaller(greater((u + 1.0) * half, 0.0), 2.0 * half - 1.0);
    int64_t k = at[0];
    const int64_t last = at[1];
    k += k < last && c->x[k + 1] <= height;
    while (k < last && c->x[k + 1] <= height)
        k++;
    return k;
}

/* F at a part u of the way through cell k. */
static inline double value_in(const struct cells *c, int64_t k, double u)
{
    return c->left[k] + u * (c->right[k] - c->left[k]) + u * (1.0 - u) * c->bend[k];
}

/* F less its mean over all heights, of a sector at a height. */
static inline double log_at(const struct cells *c, int64_t s, double height)
{
    if (height >= c->high)
        return -c->free[s];
    const int64_t k = cell_at(c, s, height);
    const double u = smaller(greater((height - c->x[k]) / (c->x[k + 1] - c->x[k]), 0.0), 1.0);
    return value_in(c, k, u) - c->free[s];
}

/* Integral of the exponential of that up to a height; constant beyond the window's ends, where none is. */
static inline double integral_to(const struct cells *c, int64_t s, double height)
{
    if (height >= c->high)
        return c->integral[c->first[s + 1] - 1] + (height - c->high) * exp(-c->free[s]);
    const int64_t k = cell_at(c, s, height);
    const double u = (height - c->x[k]) / (c->x[k + 1] - c->x[k]);
    return c->integral[k] + u * (c->integral[k + 1] - c->integral[k]);
}

#endif
