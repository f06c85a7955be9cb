/* Profiles of stars along the axes of the image. */

#include <math.h>

#include "common.h"
#include "startrack_kernels.h"

void profiles_of(int64_t n, int64_t steps, int64_t wide, const double *restrict xy_px,
                 const double *restrict profiles, float *restrict across, float *restrict down,
                 int64_t *restrict centre)
{
    for (int64_t i = 0; i < n; i++) {
        for (int64_t axis = 0; axis < 2; axis++) {
            const double pixel = rint(xy_px[2 * i + axis]);
            centre[2 * i + axis] = (int64_t)pixel;
            const double step = (xy_px[2 * i + axis] - pixel + 0.5) * (double)steps;
            const int64_t low = least(most((int64_t)step, 0), steps - 1);
            const double part = step - (double)low;
            const double *restrict from = profiles + low * wide;
            float *restrict to = (axis == 0 ? across : down) + i * wide;
            for (int64_t j = 0; j < wide; j++)
                to[j] = (float)((1.0 - part) * from[j] + part * from[wide + j]);
        }
    }
}
