#include <math.h>

#include "common.h"
#include "startrack_kernels.h"

void interpolate_circle(int64_t m, int64_t n, const double *restrict values, double *restrict found)
{
    const double per_rad = (double)m / TURN;
    for (int64_t k = 0; k < n; k++) {
        double at = found[k] * per_rad;
        if (!isfinite(at) || m == 0) {
            found[k] = m == 0 ? 0.0 : NAN;
            continue;
        }
        if (at < 0.0 || at >= (double)m) {
            at = fmod(at, (double)m);
            if (at < 0.0)
                at += (double)m;
        }
        int64_t low = (int64_t)at;
        if (low > m - 1)
            low = m - 1;
        const double part = at - (double)low;
        found[k] = (1.0 - part) * values[low] + part * values[low + 1 < m ? low + 1 : 0];
    }
}
