/* The light that stamps of stars collect in a frame that is never rendered. */

#include "common.h"
#include "startrack_kernels.h"

/* Sums over a stamp along one axis: the profile of another star alone, times the star's own, times its square. */
struct along {
    double light, with_profile, with_square;
};

static struct along sum_along(const float *restrict own, const float *restrict other, int64_t side)
{
    struct along found = {0.0, 0.0, 0.0};
    for (int64_t c = 0; c < side; c++) {
        const double p = own[c], q = other[c], pq = p * q;
        found.light += q;
        found.with_profile += pq;
        found.with_square += p * pq;
    }
    return found;
}

void collect_light(int64_t n, int64_t wide, int64_t m, int64_t cells, const double *restrict xy_px,
                   const float *restrict across, const float *restrict down, const int64_t *restrict centre,
                   const double *restrict others_px, const float *restrict others_across,
                   const float *restrict others_down, const int64_t *restrict others_centre,
                   const int64_t *restrict number, const double *restrict weight, const double *restrict square_weight,
                   const int64_t *restrict first, int64_t columns, double side_px, double reach_px, int64_t radius,
                   double *restrict found)
{
    (void)m;
    const int64_t side = 2 * radius + 1, rows = cells / columns, place = wide / 2 - radius;
    for (int64_t i = 0; i < n; i++) {
        const float *restrict own_x = across + i * wide + place, *restrict own_y = down + i * wide + place;
        const struct along x = sum_along(own_x, own_x, side), y = sum_along(own_y, own_y, side);
        const double total = x.light * y.light, middle = total / (double)(side * side);
        const double strength = x.with_profile * y.with_profile - middle * total, strength2 = strength * strength;
        double *restrict to = found + 5 * i;
        to[0] = to[1] = to[2] = 0.0;
        to[3] = (x.with_square * y.with_square - 2 * middle * x.with_profile * y.with_profile +
                 middle * middle * total) / strength2;
        to[4] = strength;
        const int64_t column = (int64_t)(xy_px[2 * i] / side_px), row = (int64_t)(xy_px[2 * i + 1] / side_px);
        for (int64_t cell_row = most(row - 1, 0); cell_row < least(row + 2, rows); cell_row++) {
            const int64_t start = first[cell_row * columns + most(column - 1, 0)];
            const int64_t stop = first[cell_row * columns + least(column + 1, columns - 1) + 1];
            for (int64_t j = start; j < stop; j++) {
                const double dx = others_px[2 * j] - xy_px[2 * i], dy = others_px[2 * j + 1] - xy_px[2 * i + 1];
                if (!(dx * dx + dy * dy <= reach_px * reach_px) || number[j] == i)
                    continue;
                const int64_t left = place + centre[2 * i] - others_centre[2 * j];
                const int64_t top = place + centre[2 * i + 1] - others_centre[2 * j + 1];
                const struct along u = sum_along(own_x, others_across + j * wide + left, side);
                const struct along v = sum_along(own_y, others_down + j * wide + top, side);
                const double light = u.light * v.light, with_profile = u.with_profile * v.with_profile;
                const double part = (with_profile - middle * light) / strength;
                const double noise = u.with_square * v.with_square - 2 * middle * with_profile +
                                     middle * middle * light;
                to[0] += weight[j] * part;
                to[1] += weight[j] * noise / strength2;
                to[2] += square_weight[j] * part * part;
            }
        }
    }
}
