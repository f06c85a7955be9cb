/* The elevation of a skyline in columns of azimuth: evidence of steps of light, and the chain around the compass. */

#include <math.h>

#include "common.h"
#include "startrack_kernels.h"

#define REACH_SIGMAS 10.0 /* beyond, exp(-z^2 / 2) is lost in rounding beside the likelihood of no step */
#define LANES 8
#define SCALES 3 /* exponentials whose mixture a change of elevation is */

void add_steps(int64_t k, int64_t n, int64_t columns, double temper, double lowest, double step,
               const int64_t *restrict column, const double *restrict place, const double *restrict sigma,
               const double *restrict weight, const double *restrict passed, double nothing,
               double *restrict mixture, float *restrict total)
{
    (void)columns;
    const double no_step = temper * log(nothing);
    for (int64_t begin = 0, end; begin < k; begin = end) {
        float *restrict own = total + column[begin] * n;
        int64_t low = n, high = 0;
        for (int64_t i = 0; i < n; i++)
            mixture[i] = nothing;
        for (end = begin; end < k && column[end] == column[begin]; end++) {
            const double at = place[end], width = sigma[end], top = (double)n;
            const double from = (at - REACH_SIGMAS * width - lowest) / step;
            const double to = (at + REACH_SIGMAS * width - lowest) / step;
            const int64_t first = (int64_t)smaller(greater(from, 0.0), top);
            const int64_t last = least((int64_t)smaller(greater(to, -3.0), top) + 2, n);
            low = least(low, first);
            high = most(high, last);
            for (int64_t i = first; i < last; i++) {
                const double z = (lowest + step * (double)i - at) / width;
                mixture[i] += weight[end] * exp(-0.5 * z * z) / (width * sqrt(TURN));
            }
            for (int64_t i = 0; i < n && lowest + step * (double)i < at - 2.0 * width; i++)
                own[i] = (float)((double)own[i] + temper * passed[end]);
        }
        for (int64_t i = 0; i < n; i++)
            own[i] = (float)((double)own[i] + (low <= i && i < high ? temper * log(mixture[i]) : no_step));
    }
}

/* Replace a message [n] by `after` [n] at other elevations: sums over exponentials of their distance, from below and
   from above, that fall by `ratio` a sample. The sums from both ends take their steps beside each other.
   Scratch: `below` [n], `above` [n + 1]. */
static void change_elevation(int64_t n, const double ratio[SCALES], const double scale[SCALES],
                             const double *restrict after, double *restrict below, double *restrict above,
                             double *restrict message)
{
    const double r0 = ratio[0], r1 = ratio[1], r2 = ratio[2];
    const double w0[2] = {scale[0], scale[0] * r0}, w1[2] = {scale[1], scale[1] * r1};
    const double w2[2] = {scale[2], scale[2] * r2};
    double s0[2] = {0.0, 0.0}, s1[2] = {0.0, 0.0}, s2[2] = {0.0, 0.0}, out[2];
    for (int64_t i = 0; i < n; i++) {
        const double in[2] = {after[i], after[n - 1 - i]};
        for (int e = 0; e < 2; e++) {
            s0[e] = s0[e] * r0 + in[e];
            s1[e] = s1[e] * r1 + in[e];
            s2[e] = s2[e] * r2 + in[e];
            out[e] = w0[e] * s0[e] + w1[e] * s1[e] + w2[e] * s2[e];
        }
        below[i] = out[0];
        above[n - 1 - i] = out[1];
    }
    above[n] = 0.0;
    for (int64_t i = 0; i < n; i++)
        message[i] = below[i] + above[i + 1];
}

/* Fill `whole` [n] with 1 over what the exponentials about each sample hold within the n samples. */
static void fill_whole(int64_t n, const double ratio[SCALES], const double weight[SCALES], double *restrict whole)
{
    for (int64_t i = 0; i < n; i++)
        whole[i] = weight[0] + weight[1] + weight[2];
    for (int j = 0; j < SCALES; j++) {
        double beyond = weight[j] / (1.0 + ratio[j]);
        for (int64_t i = 0; i < n; i++) {
            beyond *= ratio[j];
            whole[i] -= beyond;
            whole[n - 1 - i] -= beyond;
        }
    }
    for (int64_t i = 0; i < n; i++)
        whole[i] = 1.0 / whole[i];
}

/* Fill `after` [n] with a message times the likelihood; its sum, and into `landed` its sum weighted by `landing`. */
static double weigh(int64_t n, const double *restrict message, const float *restrict likelihood,
                    const double *restrict landing, double *restrict after, double *restrict landed)
{
    double sum[LANES] = {0.0}, weighted[LANES] = {0.0};
    int64_t i = 0;
    for (; i + LANES <= n; i += LANES) {
        for (int j = 0; j < LANES; j++) {
            after[i + j] = message[i + j] * (double)likelihood[i + j];
            sum[j] += after[i + j];
            weighted[j] += after[i + j] * landing[i + j];
        }
    }
    for (; i < n; i++) {
        after[i] = message[i] * (double)likelihood[i];
        sum[0] += after[i];
        weighted[0] += after[i] * landing[i];
    }
    *landed = SUM_OF(weighted);
    return SUM_OF(sum);
}

static void multiply(int64_t n, const double *restrict factors, double *restrict values)
{
    for (int64_t i = 0; i < n; i++)
        values[i] *= factors[i];
}

void pass_messages(int64_t kinds, int64_t columns, int64_t n, const float *restrict likelihood, bool forward,
                   const double *restrict ratio, const double *restrict weight, double jump,
                   const double *restrict landing, const double *restrict part, double renew,
                   double *restrict scratch, float *restrict found)
{
    double *restrict message = scratch, *restrict after = scratch + kinds * n, *restrict both = after + n;
    double *restrict whole = both + n, *restrict below = whole + n, *restrict above = below + n;
    double scale[SCALES];
    fill_whole(n, ratio, weight, whole);
    for (int j = 0; j < SCALES; j++)
        scale[j] = weight[j] * (1.0 - ratio[j]) / (1.0 + ratio[j]);
    for (int64_t k = 0; k < kinds; k++)
        for (int64_t i = 0; i < n; i++)
            message[k * n + i] = forward ? part[k] * landing[i] : 1.0;
    for (int64_t step = 0; step < 2 * columns; step++) { /* the second round starts where the first one ended */
        const int64_t c = forward ? step % columns : columns - 1 - step % columns;
        double total = 0.0, jumped = 0.0;
        for (int64_t i = 0; i < n; i++)
            both[i] = 0.0;
        for (int64_t k = 0; k < kinds; k++) {
            double *restrict own = message + k * n, landed;
            float *restrict to = found + (k * columns + c) * n;
            const double taken = forward ? 1.0 : part[k];
            for (int64_t i = 0; i < n; i++)
                to[i] = (float)own[i];
            const double sum = weigh(n, own, likelihood + (k * columns + c) * n, landing, after, &landed);
            total += sum;
            jumped += taken * (forward ? sum : landed);
            if (forward)
                multiply(n, whole, after);
            change_elevation(n, ratio, scale, after, below, above, own);
            if (!forward) /* through the transposed matrix */
                multiply(n, whole, own);
            for (int64_t i = 0; i < n; i++)
                both[i] += taken * own[i];
        }
        const double kept = (1.0 - jump) * (1.0 - renew) / total, drawn = (1.0 - jump) * renew / total;
        jumped *= jump / total;
        for (int64_t k = 0; k < kinds; k++) {
            double *restrict own = message + k * n;
            const double given = forward ? part[k] : 1.0;
            for (int64_t i = 0; i < n; i++)
                own[i] = kept * own[i] + given * (drawn * both[i] + jumped * (forward ? landing[i] : 1.0));
        }
    }
}
