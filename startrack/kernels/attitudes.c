/* The attitude on which pairs of a detection and a star agree, and which of the pairs these are. */

#include <math.h>

#include "common.h"
#include "startrack_kernels.h"

#define NEWTON_STEPS 30 /* three suffice where most pairs are right */
#define EQUAL 1e-15     /* relative step that changes nothing more */

/* Sums over pairs of rays: weight cam icrs^T, and the weight. */
struct profile {
    double of[3][3], weight;
};

static inline void add_pair(struct profile *sum, double weight, const double *cam, const double *icrs)
{
    sum->weight += weight;
    for (int a = 0; a < 3; a++)
        for (int b = 0; b < 3; b++)
            sum->of[a][b] += weight * cam[a] * icrs[b];
}

/* The rotation R [3, 3] that maximises trace(R^T B), which is at most the sum of weights.
   Source: Markley 1993, J. Astronaut. Sci. 41, 261 (FOAM). */
static void find_rotation(const struct profile *sum, double *restrict R)
{
    const double (*B)[3] = sum->of;
    double cofactor[3][3], norm = 0.0, cofactor_norm = 0.0;
    for (int a = 0; a < 3; a++) {
        const int c = (a + 1) % 3, d = (a + 2) % 3;
        for (int b = 0; b < 3; b++) {
            const int e = (b + 1) % 3, f = (b + 2) % 3;
            cofactor[a][b] = B[c][e] * B[d][f] - B[c][f] * B[d][e];
            norm += B[a][b] * B[a][b];
            cofactor_norm += cofactor[a][b] * cofactor[a][b];
        }
    }
    const double determinant = B[0][0] * cofactor[0][0] + B[0][1] * cofactor[0][1] + B[0][2] * cofactor[0][2];
    double trace = sum->weight;
    for (int round = 0; round < NEWTON_STEPS; round++) { /* from above, where the quartic has its largest root */
        const double over = trace * trace - norm, slope = 4.0 * trace * over - 8.0 * determinant;
        const double rest = over * over - 8.0 * trace * determinant - 4.0 * cofactor_norm;
        const double step = slope > 0.0 ? rest / slope : 0.0;
        trace -= step;
        if (fabs(step) < EQUAL * trace)
            break;
    }
    const double half = 0.5 * (trace * trace - norm), divisor = half * trace - determinant;
    for (int a = 0; a < 3; a++) {
        for (int b = 0; b < 3; b++) {
            double cubic = 0.0;
            for (int c = 0; c < 3; c++)
                for (int d = 0; d < 3; d++)
                    cubic += B[a][c] * B[d][c] * B[d][b];
            R[3 * a + b] = ((half + norm) * B[a][b] + trace * cofactor[a][b] - cubic) / divisor;
        }
    }
}

void rotation_between(int64_t n, const double *restrict cam, const double *restrict icrs,
                      const double *restrict weight, double *restrict R)
{
    struct profile sum = {{{0.0}}, 0.0};
    for (int64_t i = 0; i < n; i++)
        add_pair(&sum, weight[i], cam + 3 * i, icrs + 3 * i);
    find_rotation(&sum, R);
}

/* Squared length of cam - R icrs. */
static inline double squared_off(const double *R, const double *cam, const double *icrs)
{
    double squared = 0.0;
    for (int a = 0; a < 3; a++) {
        const double off = cam[a] - R[3 * a] * icrs[0] - R[3 * a + 1] * icrs[1] - R[3 * a + 2] * icrs[2];
        squared += off * off;
    }
    return squared;
}

void settle_rotation(int64_t n, const double *restrict cam, const double *restrict icrs, double squared_radius,
                     int64_t rounds, int64_t fewest, bool *restrict hit, double *restrict R)
{
    for (int a = 0; a < 9; a++)
        R[a] = a % 4 == 0 ? 1.0 : 0.0;
    bool same = false;
    for (int64_t round = 0; round < rounds && !same; round++) {
        struct profile sum = {{{0.0}}, 0.0};
        int64_t hits = 0;
        for (int64_t i = 0; i < n; i++) {
            if (hit[i]) {
                add_pair(&sum, 1.0, cam + 3 * i, icrs + 3 * i);
                hits++;
            }
        }
        if (hits < fewest)
            break;
        find_rotation(&sum, R);
        same = true;
        for (int64_t i = 0; i < n; i++) {
            const bool now = squared_off(R, cam + 3 * i, icrs + 3 * i) < squared_radius;
            same &= now == hit[i];
            hit[i] = now;
        }
    }
}

/* The upper median of values [n], at least one, which are reordered.
   Source: Hoare 1961, Communications of the ACM 4, 321 (FIND). */
static double upper_median(int64_t n, double *restrict values)
{
    const int64_t middle = n / 2;
    int64_t low = 0, high = n - 1;
    while (low < high) {
        const double pivot = values[middle];
        int64_t i = low, j = high;
        while (i <= j) {
            while (values[i] < pivot)
                i++;
            while (pivot < values[j])
                j--;
            if (i <= j) {
                const double value = values[i];
                values[i++] = values[j];
                values[j--] = value;
            }
        }
        if (j < middle)
            low = i;
        if (middle < i)
            high = j;
    }
    return values[middle];
}

double rotate_by_inliers(int64_t m, int64_t k, int64_t n, const int64_t *restrict which,
                         const int64_t *restrict detection, const double *restrict distance,
                         const double *restrict variance_px2, const double *restrict rays_cam,
                         const double *restrict rays_icrs, const double *restrict R, double gate_px,
                         double median_chi2, double least_extra, double outlier_chi2, double *restrict scratch,
                         bool *restrict agree, double *restrict variance, double *restrict refined)
{
    (void)k, (void)n;
    double *restrict squared = scratch, *restrict stated = scratch + m;
    int64_t near = 0;
    for (int64_t i = 0; i < m; i++) {
        const double apart = distance[which[i]];
        variance[i] = variance_px2[detection[which[i]]];
        agree[i] = false;
        if (apart < gate_px) {
            squared[near] = apart * apart;
            stated[near++] = variance[i];
        }
    }
    for (int a = 0; a < 9; a++)
        refined[a] = 0.0;
    if (near == 0)
        return INFINITY;
    const double extra = upper_median(near, squared) / median_chi2 - upper_median(near, stated);
    struct profile sum = {{{0.0}}, 0.0};
    for (int64_t i = 0; i < m; i++) {
        const double apart = distance[which[i]];
        variance[i] += greater(extra, least_extra);
        agree[i] = apart < gate_px && apart * apart < outlier_chi2 * variance[i];
        if (agree[i])
            add_pair(&sum, 1.0 / variance[i], rays_cam + 3 * detection[which[i]], rays_icrs + 3 * which[i]);
    }
    find_rotation(&sum, refined);
    double change = 0.0;
    for (int a = 0; a < 9; a++)
        change = greater(fabs(refined[a] - R[a]), change);
    return change;
}
