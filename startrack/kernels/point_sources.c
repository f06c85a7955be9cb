/* Point sources in stamps: fits by Gauss-Newton, and how the pixels compare with the PSF, with edges and with lines.
   Pixels are in single precision, twice as many at a time; places, fluxes and their equations in double precision. */

#include <math.h>

#include "common.h"
#include "startrack_kernels.h"

#define LANES 8 /* accumulators of a sum over pixels */
#define TERMS 4 /* of a fit: x, y, flux, level */
#define SQRT_2PI 2.5066282746310002
#define NARROWEST_PX 0.1 /* a narrower PSF is one pixel as well; its exponentials would overflow */
#define LEAST 1e-30f
#define LEAST_PIVOT 1e-300

/* The error function (Abramowitz & Stegun 1964, 7.1.26), with coefficients as of `pixel_profile_single` in psf.py. */
#define ERF_T ((double)(float)(0.3275911 / 1.4142135623730951))
#define ERF_A1 ((double)(0.5f * 0.254829592f))
#define ERF_A2 ((double)(0.5f * -0.284496736f))
#define ERF_A3 ((double)(0.5f * 1.421413741f))
#define ERF_A4 ((double)(0.5f * -1.453152027f))
#define ERF_A5 ((double)(0.5f * 1.061405429f))

/* A Gaussian integrated over the pixels of a stamp: profiles in x and y, their derivatives by its place, and
   exp(-x^2 / 2 sigma^2) at x = 1/2, 3/2, ... */
struct psf {
    int64_t side;
    double sigma_px, *across, *down, *across_slope, *down_slope, *bell;
};

/* The PSF of this width, in scratch of 7 rows of `side` + 1. */
static struct psf psf_of(int64_t side, double sigma_px, double *scratch)
{
    const int64_t row = side + 1;
    const struct psf found = {side, greater(sigma_px, NARROWEST_PX), scratch, scratch + row, scratch + 2 * row,
                              scratch + 3 * row, scratch + 4 * row};
    for (int64_t k = 0; k <= 5 * (side / 2); k++) {
        const double at = ((double)k + 0.5) / found.sigma_px;
        found.bell[k] = exp(-0.5 * at * at);
    }
    return found;
}

/* One profile and its derivative, of a source so far from the middle pixel, at most 4 radii of the stamp.

   A Gaussian about the source is one about a pixel (`bell`) times exponentials of x, which are powers of one. */
static void fill_profile(const struct psf *psf, double offset, double *restrict profile, double *restrict slope)
{
    const double radius = (double)(psf->side / 2), scale = 1.0 / psf->sigma_px, peak = scale / SQRT_2PI;
    const double place = smaller(greater(offset, -4.0 * radius), 4.0 * radius), whole = rint(place);
    const double part = place - whole, first = -radius - whole - 0.5; /* the first edge, from the nearest pixel */
    const double ratio = exp(part * scale * scale);
    double power = exp((first - 0.5 * part) * part * scale * scale);
    const int edges = (int)psf->side + 1, before = (int)(radius + whole); /* the edges left of that pixel */
    for (int j = 0; j < edges; j++) {
        slope[j] = psf->bell[j > before ? j - before - 1 : before - j] * power;
        power *= ratio;
    }
    for (int j = 0; j < edges; j++) {
        const double edge = (first + (double)j - part) * scale, t = 1.0 / (1.0 + ERF_T * fabs(edge));
        const double area = 0.5 - slope[j] * t * (ERF_A1 + t * (ERF_A2 + t * (ERF_A3 + t * (ERF_A4 + t * ERF_A5))));
        profile[j] = edge >= 0.0 ? area : -area;
    }
    for (int j = 0; j + 1 < edges; j++) {
        profile[j] = profile[j + 1] - profile[j];
        slope[j] = (slope[j] - slope[j + 1]) * peak;
    }
}

static void place_source(const struct psf *psf, double x, double y)
{
    fill_profile(psf, x, psf->across, psf->across_slope);
    fill_profile(psf, y, psf->down, psf->down_slope);
}

/* Of a stamp (n pixels, a multiple of LANES): light, variance and 1 where usable; the source's profile and its slopes
   in x and in y; room for a row. */
struct stamp {
    int64_t side, n;
    float *light, *variance, *use, *shape, *by_x, *by_y, *row;
};

/* A source: flux, level, and the noise of its own light: per unit of it, and the square of the PSF's error. */
struct source {
    float flux, level, shine, own_noise, error;
};

static struct source source_of(double flux, double level, double per_unit, double model_error)
{
    const float bright = (float)flux;
    const struct source found = {bright, (float)level, bright > 0.0f ? bright : 0.0f, (float)per_unit,
                                 (float)(model_error * model_error)};
    return found;
}

/* Fill light, variance and use of a stamp without the `signal` of neighbours, which has this relative error. `usable`
   and `signal` may be null. */
static void read_stamp(const struct stamp *s, const float *data, const float *variance, const bool *usable,
                       const float *signal, double signal_error)
{
    const int64_t pixels = s->side * s->side;
    const float error = (float)(signal_error * signal_error);
    for (int64_t p = 0; p < pixels; p++) {
        const float others = signal ? signal[p] : 0.0f;
        s->light[p] = data[p] - others;
        s->variance[p] = variance[p] + error * others * others;
        s->use[p] = !usable || usable[p] ? 1.0f : 0.0f;
    }
}

static inline void multiply(int64_t n, float factor, const float *restrict values, float *restrict to)
{
    for (int64_t c = 0; c < n; c++)
        to[c] = factor * values[c];
}

static void fill_shapes(const struct stamp *s, const struct psf *psf)
{
    float *across = s->row, *slope = s->row + s->side;
    for (int64_t c = 0; c < s->side; c++) {
        across[c] = (float)psf->across[c];
        slope[c] = (float)psf->across_slope[c];
    }
    for (int64_t r = 0; r < s->side; r++) {
        const int64_t to = r * s->side;
        multiply(s->side, (float)psf->down[r], across, s->shape + to);
        multiply(s->side, (float)psf->down[r], slope, s->by_x + to);
        multiply(s->side, (float)psf->down_slope[r], across, s->by_y + to);
    }
}

/* The normal matrix, symmetric, and the right side, without priors. */
static void sum_normal(const struct stamp *s, const struct source *source, double flux, double A[TERMS][TERMS],
                       double b[TERMS])
{
    enum { XX, YY, XY, XF, YF, XL, YL, FF, FL, LL, BX, BY, BF, BL, COUNT };
    float lane[COUNT][LANES] = {{0.0f}}, t[COUNT];
    const struct source of = *source;
    const float *light = s->light, *variance = s->variance, *use = s->use;
    const float *shape = s->shape, *by_x = s->by_x, *by_y = s->by_y;
    for (int64_t k = 0; k < s->n; k += LANES) {
        for (int64_t j = 0; j < LANES; j++) {
            const float f = shape[k + j], x = by_x[k + j], y = by_y[k + j], own = of.shine * f;
            const float weight = use[k + j] / (variance[k + j] + own * (of.own_noise + of.error * own));
            const float miss = light[k + j] - of.flux * f - of.level, wf = weight * f, wx = weight * x, wy = weight * y;
            lane[XX][j] += wx * x;
            lane[YY][j] += wy * y;
            lane[XY][j] += wx * y;
            lane[XF][j] += wx * f;
            lane[YF][j] += wy * f;
            lane[XL][j] += wx;
            lane[YL][j] += wy;
            lane[FF][j] += wf * f;
            lane[FL][j] += wf;
            lane[LL][j] += weight;
            lane[BX][j] += wx * miss;
            lane[BY][j] += wy * miss;
            lane[BF][j] += wf * miss;
            lane[BL][j] += weight * miss;
        }
    }
    for (int c = 0; c < COUNT; c++)
        t[c] = SUM_OF(lane[c]);
    A[0][0] = flux * flux * (double)t[XX];
    A[1][1] = flux * flux * (double)t[YY];
    A[1][0] = flux * flux * (double)t[XY];
    A[2][0] = flux * (double)t[XF];
    A[2][1] = flux * (double)t[YF];
    A[2][2] = (double)t[FF];
    A[3][0] = flux * (double)t[XL];
    A[3][1] = flux * (double)t[YL];
    A[3][2] = (double)t[FL];
    A[3][3] = (double)t[LL];
    b[0] = flux * (double)t[BX];
    b[1] = flux * (double)t[BY];
    b[2] = (double)t[BF];
    b[3] = (double)t[BL];
}

/* Put the Cholesky factor of a positive definite matrix in place of its lower triangle, 1 / root on the diagonal. */
static void factorise(double A[TERMS][TERMS])
{
    for (int j = 0; j < TERMS; j++) {
        double rest = A[j][j];
        for (int k = 0; k < j; k++)
            rest -= A[j][k] * A[j][k];
        A[j][j] = 1.0 / sqrt(greater(rest, LEAST_PIVOT));
        for (int i = j + 1; i < TERMS; i++) {
            rest = A[i][j];
            for (int k = 0; k < j; k++)
                rest -= A[i][k] * A[j][k];
            A[i][j] = rest * A[j][j];
        }
    }
}

/* Replace a right side by its solution, by the factor of `factorise`. */
static void solve(double A[TERMS][TERMS], double x[TERMS])
{
    for (int i = 0; i < TERMS; i++) {
        double rest = x[i];
        for (int k = 0; k < i; k++)
            rest -= A[i][k] * x[k];
        x[i] = rest * A[i][i];
    }
    for (int i = TERMS - 1; i >= 0; i--) {
        double rest = x[i];
        for (int k = i + 1; k < TERMS; k++)
            rest -= A[k][i] * x[k];
        x[i] = rest * A[i][i];
    }
}

/* Fill chi^2 of the source and of a single pixel, the number of usable pixels, and sums of the matched filter: times
   the light above the surroundings, the profile, and the profile with the noise of the own photons. */
static void judge(const struct stamp *s, const struct source *source, double surround, double *values)
{
    enum { CHI2, PIXEL, NUMBER, ABOVE, NORM, OWN, FOUND, TOTAL = FOUND, LIGHT, COUNT };
    float lane[COUNT][LANES] = {{0.0f}};
    const float around = (float)surround;
    const struct source of = *source;
    const float *light = s->light, *variance = s->variance, *use = s->use, *shape = s->shape;
    float *others = s->by_x; /* the slopes are not needed any more */
    int64_t middle = s->side * s->side / 2, hot = middle - s->side - 1; /* the brightest pixel of the middle nine */
    for (int64_t r = middle - s->side; r <= middle + s->side; r += s->side)
        for (int64_t k = r - 1; k <= r + 1; k++)
            hot = light[k] > light[hot] ? k : hot;
    for (int64_t k = 0; k < s->n; k++)
        others[k] = use[k] / variance[k];
    others[hot] = 0.0f;
    for (int64_t k = 0; k < s->n; k += LANES) {
        for (int64_t j = 0; j < LANES; j++) {
            const float plain = use[k + j] / variance[k + j], f = shape[k + j], glow = of.shine * f;
            const float high = light[k + j] - of.level, miss = high - of.flux * f, filtered = plain * f;
            const float own = glow * (of.own_noise + of.error * glow), rest = others[k + j] * high;
            lane[CHI2][j] += use[k + j] * miss * miss / (variance[k + j] + own);
            lane[NUMBER][j] += use[k + j];
            lane[ABOVE][j] += filtered * (light[k + j] - around);
            lane[NORM][j] += filtered * f;
            lane[OWN][j] += filtered * f / (1.0f + of.own_noise * glow * plain);
            lane[TOTAL][j] += others[k + j];
            lane[LIGHT][j] += rest;
            lane[PIXEL][j] += rest * high;
        }
    }
    const float total = SUM_OF(lane[TOTAL]), excess = SUM_OF(lane[LIGHT]);
    for (int c = 0; c < FOUND; c++)
        values[c] = (double)SUM_OF(lane[c]);
    values[PIXEL] -= (double)(excess * (excess / (total > LEAST ? total : LEAST)));
}

static double within(double value, double limit)
{
    return smaller(greater(value, -limit), limit);
}

void fit_stamps(int64_t n, int64_t side, int64_t usable_rows, int64_t signals, int64_t m, int64_t room,
                const float *restrict data, const float *restrict variance, const bool *restrict usable,
                const float *restrict signal, double signal_error, const int64_t *restrict which,
                const double *restrict start_px, double sigma_px, double per_unit, double model_error, int64_t rounds,
                double max_step_px, double position_prior, double flux_prior, const double *restrict surround,
                double *restrict profiles, float *restrict pixels, double *restrict xy_px, double *restrict values,
                double *restrict covariance)
{
    (void)n;
    const int64_t size = side * side;
    const double radius = (double)(side / 2);
    const struct psf psf = psf_of(side, sigma_px, profiles);
    const struct stamp s = {side, room, pixels, pixels + room, pixels + 2 * room, pixels + 3 * room, pixels + 4 * room,
                            pixels + 5 * room, pixels + 6 * room};
    for (int64_t p = 0; p < 7 * room; p++)
        pixels[p] = p / room == 1 ? 1.0f : 0.0f;
    for (int64_t i = 0; i < m; i++) {
        const int64_t at = which[i] * size;
        double A[TERMS][TERMS], step[TERMS], flux = 0.0, level = 0.0;
        double x = within(start_px[2 * i], radius), y = within(start_px[2 * i + 1], radius);
        read_stamp(&s, data + at, variance + at, usable_rows ? usable + at : 0, signals ? signal + i * size : 0,
                   signal_error);
        for (int64_t round = 0; round <= rounds; round++) {
            if (round != 1) { /* the first step leaves the position as it is */
                place_source(&psf, x, y);
                fill_shapes(&s, &psf);
            }
            const struct source source = source_of(flux, level, per_unit, model_error);
            sum_normal(&s, &source, flux, A, step);
            A[0][0] += position_prior;
            A[1][1] += position_prior;
            A[2][2] += flux_prior;
            A[3][3] += flux_prior;
            if (round == 0) { /* flux and level first: without a flux the position has no gradient */
                const double determinant = greater(A[2][2] * A[3][3] - A[3][2] * A[3][2], LEAST_PIVOT);
                flux = (A[3][3] * step[2] - A[3][2] * step[3]) / determinant;
                level = (A[2][2] * step[3] - A[3][2] * step[2]) / determinant;
                continue;
            }
            factorise(A);
            if (round == rounds)
                break;
            solve(A, step);
            x = within(x + within(step[0], max_step_px), radius);
            y = within(y + within(step[1], max_step_px), radius);
            flux += step[2];
            level += step[3];
        }
        for (int k = 0; k < TERMS; k++) {
            double column[TERMS] = {0.0};
            column[k] = 1.0;
            solve(A, column);
            for (int j = 0; j < TERMS; j++)
                covariance[(i * TERMS + j) * TERMS + k] = column[j];
        }
        xy_px[2 * i] = x;
        xy_px[2 * i + 1] = y;
        values[8 * i] = flux;
        values[8 * i + 1] = level;
        const struct source source = source_of(flux, level, per_unit, model_error);
        judge(&s, &source, surround[i], values + 8 * i + 2);
    }
}

void sum_neighbours(int64_t m, int64_t n, int64_t side, int64_t count, const int64_t *restrict star,
                    const double *restrict offset_px, const double *restrict flux, double sigma_px,
                    const float *restrict variance, double limit_sigma, const float *restrict last,
                    double *restrict profiles, float *restrict signal, bool *restrict changed)
{
    (void)n, (void)count;
    const int64_t size = side * side;
    const struct psf psf = psf_of(side, sigma_px, profiles);
    int64_t k = -1;
    for (int64_t i = 0; i < m; i++) {
        if (i == 0 || star[i] != star[i - 1])
            k++;
        float *light = signal + k * size;
        for (int64_t p = 0; (i == 0 || star[i] != star[i - 1]) && p < size; p++)
            light[p] = 0.0f;
        place_source(&psf, offset_px[2 * i], offset_px[2 * i + 1]);
        const double shine = greater(flux[i], 0.0);
        for (int64_t r = 0; r < side; r++)
            for (int64_t c = 0; c < side; c++)
                light[r * side + c] = (float)((double)light[r * side + c] + shine * psf.down[r] * psf.across[c]);
        if (i + 1 < m && star[i + 1] == star[i])
            continue;
        bool matters = false, differs = false;
        for (int64_t p = 0; p < size; p++) {
            const double limit = limit_sigma * limit_sigma * (double)variance[star[i] * size + p];
            const double own = (double)light[p], moved = (double)(light[p] - last[star[i] * size + p]);
            matters |= own * own > limit;
            differs |= moved * moved > limit;
        }
        changed[k] = matters && differs;
    }
}

/* The largest reduction of chi^2 by stripes in one direction, less the number of stripes. */
static float most_explained(int64_t pixels, int64_t directions, int64_t stripes, const float *weight,
                            const float *moment, const int64_t *stripe, const int64_t *ends, float (*sums)[2])
{
    for (int64_t j = 0; j < stripes; j++)
        sums[j][0] = sums[j][1] = 0.0f;
    for (int64_t p = 0; p < pixels; p++) {
        for (int64_t d = 0; d < directions; d++) {
            float *sum = sums[stripe[p * directions + d]];
            sum[0] += weight[p];
            sum[1] += moment[p];
        }
    }
    float found = -INFINITY;
    for (int64_t d = 0, j = 0; d < directions; d++) {
        float explained = (float)(j - ends[d]);
        for (; j < ends[d]; j++)
            explained += sums[j][1] * sums[j][1] / (sums[j][0] > LEAST ? sums[j][0] : LEAST);
        found = explained > found ? explained : found;
    }
    return found;
}

void compare_shapes(int64_t n, int64_t side, int64_t usable_rows, int64_t m, int64_t directions, int64_t stripes,
                    int64_t room, const float *restrict data, const float *restrict variance,
                    const bool *restrict usable, const int64_t *restrict which, const double *restrict offset_px,
                    const double *restrict flux, const double *restrict level, const double *restrict width_px,
                    double per_unit, double model_error, const int64_t *restrict stripe, const int64_t *restrict ends,
                    double *restrict profiles, float *restrict sums, float *restrict pixels, double *restrict misfit,
                    double *restrict edge)
{
    (void)n;
    enum { EXCESS, SQUARED, TOTAL, COUNT };
    const int64_t size = side * side;
    const float own_noise = (float)per_unit, error = (float)(model_error * model_error);
    float *weight = pixels, *moment = pixels + room, *light = pixels + 2 * room, *spread = pixels + 3 * room;
    struct psf psf = {0};
    for (int64_t p = 0; p < 4 * room; p++)
        pixels[p] = p / room == 3 ? 1.0f : 0.0f;
    for (int64_t i = 0; i < m; i++) {
        const int64_t at = which[i] * size;
        if (i == 0 || width_px[i] != width_px[i - 1])
            psf = psf_of(side, width_px[i], profiles);
        place_source(&psf, offset_px[2 * i], offset_px[2 * i + 1]);
        const double shine = greater(flux[i], 0.0);
        const float flat = (float)level[i];
        float lane[COUNT][LANES] = {{0.0f}};
        for (int64_t r = 0; r < side; r++)
            for (int64_t c = 0; c < side; c++)
                moment[r * side + c] = (float)(shine * psf.down[r] * psf.across[c]);
        for (int64_t p = 0; p < size; p++) {
            light[p] = data[at + p];
            spread[p] = variance[at + p];
            weight[p] = !usable_rows || usable[at + p] ? 1.0f : 0.0f;
        }
        for (int64_t p = 0; p < room; p += LANES) {
            for (int64_t j = 0; j < LANES; j++) {
                const float signal = moment[p + j], use = weight[p + j];
                const float noise = spread[p + j] + own_noise * signal, miss = light[p + j] - signal - flat;
                weight[p + j] = use / (noise + error * signal * signal);
                moment[p + j] = weight[p + j] * light[p + j];
                lane[EXCESS][j] += use * (miss * miss - noise);
                lane[SQUARED][j] += use * signal * signal;
                lane[TOTAL][j] += moment[p + j] * light[p + j];
            }
        }
        const float excess = SUM_OF(lane[EXCESS]), squared = SUM_OF(lane[SQUARED]);
        misfit[i] = sqrt((double)((excess > 0.0f ? excess : 0.0f) / (squared > LEAST ? squared : LEAST)));
        edge[i] = (double)(SUM_OF(lane[TOTAL]) - most_explained(size, directions, stripes, weight, moment, stripe, ends,
                                                                (float(*)[2])sums));
    }
}

void fill_squared_residuals(int64_t n, int64_t side, const float *restrict data, const float *restrict variance,
                            const double *restrict offset_px, const double *restrict flux,
                            const double *restrict level, const double *restrict covariance, double sigma_px,
                            double model_error, double faint, double most_leverage, double *restrict profiles,
                            double *restrict signal, double *restrict squared, double *restrict relative,
                            bool *restrict lit)
{
    const int64_t size = side * side;
    const struct psf psf = psf_of(side, sigma_px, profiles);
    for (int64_t i = 0; i < n; i++) {
        place_source(&psf, offset_px[2 * i], offset_px[2 * i + 1]);
        const double shine = greater(flux[i], 0.0), *c = covariance + i * TERMS * TERMS;
        double total = 0.0;
        for (int64_t row = 0, at = i * size; row < side; row++) {
            for (int64_t column = 0; column < side; column++, at++) {
                const double f = psf.down[row] * psf.across[column];
                const double x = shine * psf.down[row] * psf.across_slope[column];
                const double y = shine * psf.down_slope[row] * psf.across[column];
                signal[at] = shine * f;
                const double residual = (double)data[at] - signal[at] - level[i], error = model_error * signal[at];
                const double spread = x * (c[0] * x + 2.0 * (c[1] * y + c[2] * f + c[3])) +
                                      y * (c[5] * y + 2.0 * (c[6] * f + c[7])) + f * (c[10] * f + 2.0 * c[11]) + c[15];
                const double leverage = spread / greater(residual * residual, (double)variance[at] + error * error);
                lit[at] = signal[at] > faint * (double)variance[at] && leverage < most_leverage;
                squared[at] = residual * residual / (1.0 - leverage);
                relative[at] = residual;
                total += residual * residual;
            }
        }
        const double typical = greater(sqrt(total / (double)size), 1e-30);
        for (int64_t p = i * size; p < (i + 1) * size; p++)
            relative[p] /= typical;
    }
}

void explain_by_widths(int64_t n, int64_t side, int64_t m, const float *restrict data, const float *restrict weights,
                       const double *restrict offset_px, const double *restrict widths_px, double *restrict profiles,
                       double *restrict explained, double *restrict variance)
{
    for (int64_t j = 0; j < m; j++) {
        const struct psf psf = psf_of(side, widths_px[j], profiles);
        for (int64_t i = 0; i < n; i++) {
            const float *light = data + i * side * side, *weight = weights + i * side * side;
            double total = 0.0, signal = 0.0, squared = 0.0, ss = 0.0, s1 = 0.0, sd = 0.0;
            place_source(&psf, offset_px[2 * i], offset_px[2 * i + 1]);
            for (int64_t r = 0; r < side; r++) {
                double row_w = 0.0, row_q = 0.0, row_qq = 0.0, row_ff = 0.0, row_f = 0.0, row_fq = 0.0;
                for (int64_t c = 0; c < side; c++, light++, weight++) {
                    const double q = (double)*light, w = (double)*weight, f = psf.across[c], wf = w * f;
                    row_w += w;
                    row_q += w * q;
                    row_qq += w * q * q;
                    row_ff += wf * f;
                    row_f += wf;
                    row_fq += wf * q;
                }
                total += row_w;
                signal += row_q;
                squared += row_qq;
                ss += psf.down[r] * psf.down[r] * row_ff;
                s1 += psf.down[r] * row_f;
                sd += psf.down[r] * row_fq;
            }
            const double excess = sd - s1 * signal / total;
            explained[i * m + j] = excess * excess / greater(ss - s1 * s1 / total, 1e-30);
            variance[i] = squared - signal * signal / total;
        }
    }
}
