/* Small functions that several sources use. */

#ifndef STARTRACK_COMMON_H
#define STARTRACK_COMMON_H

#include <stdint.h>

#define TURN 6.283185307179586 /* radians */

/* The sum of eight accumulators, of float or double, in an order that all compilers keep. */
#define SUM_OF(lane) \
    ((((lane)[0] + (lane)[4]) + ((lane)[2] + (lane)[6])) + (((lane)[1] + (lane)[5]) + ((lane)[3] + (lane)[7])))

static inline int64_t least(int64_t a, int64_t b)
{
    return a < b ? a : b;
}

static inline int64_t most(int64_t a, int64_t b)
{
    return a > b ? a : b;
}

/* The smaller and the greater of two numbers; the second one where a number is NaN. */
static inline double smaller(double a, double b)
{
    return a < b ? a : b;
}

static inline double greater(double a, double b)
{
    return a > b ? a : b;
}

/* The normal distribution function by linear interpolation of a table of CDF_STEPS + 1 values from -CDF_REACH to
   CDF_REACH, to 5e-7. NaN counts as -CDF_REACH. */
#define CDF_REACH 8.0
#define CDF_STEPS 4096

static inline double normal_cdf(const double *table, double x)
{
    const double at = (smaller(greater(x, -CDF_REACH), CDF_REACH) + CDF_REACH) * (CDF_STEPS / (2 * CDF_REACH));
    const int64_t i = least((int64_t)at, CDF_STEPS - 1);
    return table[i] + (at - (double)i) * (table[i + 1] - table[i]);
}

/* Rows, of `count`, of a smooth image on either side of row y, and the part of the second one; rows stand in the
   middles of blocks of `side` rows. */
struct beside {
    int64_t low, high;
    float part;
};

static inline struct beside rows_beside(int64_t y, int64_t side, int64_t count)
{
    const double at = smaller(greater(((double)y + 0.5) / (double)side - 0.5, 0.0), (double)count - 1.0);
    const int64_t low = (int64_t)at;
    const struct beside found = {low, least(low + 1, count - 1), (float)(at - (double)low)};
    return found;
}

#endif
