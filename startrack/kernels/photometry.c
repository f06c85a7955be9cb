/* Forced photometry: fluxes of stars at given places, beside an edge of the background too. Pixels are in single
   precision: twice as many at a time, and rounding is 1e-5 of the noise. */

#include <float.h>
#include <math.h>

#include "common.h"
#include "startrack_kernels.h"

#define LANES 8   /* accumulators of a sum over pixels; stamps are filled up with pixels of weight 0 */
#define EDGE_LANES 4
#define COLUMNS 4 /* of the fit beside an edge: the star, the edge, its place and its width */
#define SUMS 15   /* weighted products at each place of an edge */
#define PLACES 32 /* room for places of an edge: rows of a constant width are known not to overlap */

/* Of a stamp (n pixels, a multiple of LANES): the star's profile, light of neighbours, pixels without background and
   neighbours, their variances, their weights, the background less that of the middle pixel, and their distances from
   that pixel. */
struct stamp {
    int64_t side, n;
    float *profile, *light, *data, *variance, *weight, *shape, *x, *y;
};

/* Profiles of stars in x and in y about their middle pixels, which are `centre`. */
struct profiles {
    int64_t wide;
    const float *across, *down;
    const int64_t *centre;
};

/* Write into `near` the sources within reach of source i that may be visible; how many there are. */
static int64_t find_neighbours(int64_t *restrict near, int64_t i, const double *restrict xy_px,
                               const double *restrict visible, const int64_t *restrict first, int64_t rows,
                               int64_t columns, double side_px, double reach_px)
{
    const int64_t column = (int64_t)(xy_px[2 * i] / side_px), row = (int64_t)(xy_px[2 * i + 1] / side_px);
    int64_t count = 0;
    for (int64_t cell_row = most(row - 1, 0); cell_row < least(row + 2, rows); cell_row++) {
        const int64_t start = first[cell_row * columns + most(column - 1, 0)];
        const int64_t stop = first[cell_row * columns + least(column + 1, columns - 1) + 1];
        for (int64_t j = start; j < stop; j++) {
            const double dx = xy_px[2 * j] - xy_px[2 * i], dy = xy_px[2 * j + 1] - xy_px[2 * i + 1];
            if (dx * dx + dy * dy <= reach_px * reach_px && visible[j] > 0.0 && j != i)
                near[count++] = j;
        }
    }
    return count;
}

/* Add to the stamp the part of the light of star j whose profiles start at -x, -y. */
static void add_light(const struct stamp *s, float flux, const struct profiles *p, int64_t j, int64_t x, int64_t y)
{
    const int64_t c0 = most(0, -x), c1 = least(s->side, p->wide - x);
    const float *restrict across = p->across + j * p->wide + x;
    for (int64_t r = most(0, -y); r < least(s->side, p->wide - y); r++) {
        const float height = flux * p->down[j * p->wide + r + y];
        float *restrict light = s->light + r * s->side;
        for (int64_t c = c0; c < c1; c++)
            light[c] += height * across[c];
    }
}

/* Part of the light of star j that the weights of the stamp take for the star's. */
static float leak_of(const struct stamp *s, const struct profiles *p, int64_t j, int64_t x, int64_t y)
{
    const int64_t c0 = most(0, -x), c1 = least(s->side, p->wide - x);
    const float *restrict across = p->across + j * p->wide + x;
    float total = 0.0f;
    for (int64_t r = most(0, -y); r < least(s->side, p->wide - y); r++) {
        const float *restrict weight = s->weight + r * s->side;
        float inner = 0.0f;
        for (int64_t c = c0; c < c1; c++)
            inner += weight[c] * across[c];
        total += inner * p->down[j * p->wide + r + y];
    }
    return total;
}

/* Two rows of a smooth image, and the part of the second one. */
struct blend {
    const float *low, *high;
    float part;
};

static struct blend blend_at(const float *rows, int64_t count, int64_t block, int64_t width, int64_t x, int64_t y)
{
    const struct beside at = rows_beside(y, block, count);
    const struct blend found = {rows + at.low * width + x, rows + at.high * width + x, at.part};
    return found;
}

/* One row of a stamp, `height` times the profile `across`. */
static void load_row(int64_t side, const float *restrict image, const bool *restrict dead, const float *restrict b_low,
                     const float *restrict b_high, float b_part, const float *restrict n_low,
                     const float *restrict n_high, float n_part, float middle, float height,
                     const float *restrict across, const float *restrict light, float *restrict profile,
                     float *restrict shape, float *restrict data, float *restrict variance, float *restrict weight)
{
    for (int64_t c = 0; c < side; c++) {
        const float level = b_low[c] * (1.0f - b_part) + b_high[c] * b_part;
        const float sigma = n_low[c] * (1.0f - n_part) + n_high[c] * n_part;
        profile[c] = height * across[c];
        shape[c] = level - middle;
        data[c] = image[c] - level - light[c];
        variance[c] = sigma * sigma;
        weight[c] = 1.0f / (sigma * sigma);
    }
    for (int64_t c = 0; c < side; c++)
        weight[c] = dead[c] ? 0.0f : weight[c];
}

/* Fill the stamp of source i but for the light of its neighbours, which is there. */
static void load_stamp(const struct stamp *s, int64_t width, int64_t background_rows, int64_t noise_rows,
                       const float *image, const float *background, const float *noise, const bool *dead,
                       int64_t background_side, int64_t noise_side, const struct profiles *p, int64_t i)
{
    const int64_t side = s->side, radius = side / 2, place = p->wide / 2 - radius;
    const int64_t left = p->centre[2 * i] - radius, top = p->centre[2 * i + 1] - radius;
    const struct blend at = blend_at(background, background_rows, background_side, width, left + radius, top + radius);
    const float middle = *at.low * (1.0f - at.part) + *at.high * at.part;
    for (int64_t r = 0; r < side; r++) {
        const struct blend b = blend_at(background, background_rows, background_side, width, left, top + r);
        const struct blend n = blend_at(noise, noise_rows, noise_side, width, left, top + r);
        const int64_t from = (top + r) * width + left, to = r * side;
        load_row(side, image + from, dead + from, b.low, b.high, b.part, n.low, n.high, n.part, middle,
                 p->down[i * p->wide + place + r], p->across + i * p->wide + place, s->light + to, s->profile + to,
                 s->shape + to, s->data + to, s->variance + to, s->weight + to);
    }
}

/* Weighted sums of 1, the profile, the shape, and of their products; of the pixels times these. */
struct sums {
    float w, wp, ws, wpp, wps, wss, wd, wpd, wsd;
};

static struct sums sum_stamp(const struct stamp *s)
{
    float lane[9][LANES] = {{0.0f}};
    const float *restrict weight = s->weight, *restrict profile = s->profile, *restrict shape = s->shape;
    const float *restrict data = s->data;
    for (int64_t p = 0; p < s->n; p += LANES) {
        for (int64_t j = 0; j < LANES; j++) {
            const float v = weight[p + j], q = profile[p + j], b = shape[p + j], vd = v * data[p + j];
            lane[0][j] += v;
            lane[1][j] += v * q;
            lane[2][j] += v * b;
            lane[3][j] += v * q * q;
            lane[4][j] += v * q * b;
            lane[5][j] += v * b * b;
            lane[6][j] += vd;
            lane[7][j] += vd * q;
            lane[8][j] += vd * b;
        }
    }
    const struct sums found = {SUM_OF(lane[0]), SUM_OF(lane[1]), SUM_OF(lane[2]), SUM_OF(lane[3]), SUM_OF(lane[4]),
                               SUM_OF(lane[5]), SUM_OF(lane[6]), SUM_OF(lane[7]), SUM_OF(lane[8])};
    return found;
}

/* A fit of the profile beside more or less of the background's shape and a level, and the number of deviant pixels,
   which got weight 0. */
struct fit {
    float flux, level, strength;
    int64_t masked;
};

static struct fit fit_masking(const struct stamp *s, float outlier, float model, float shape_variance,
                              int64_t most_masked)
{
    const float *restrict profile = s->profile, *restrict light = s->light, *restrict data = s->data;
    const float *restrict variance = s->variance, *restrict shape = s->shape;
    float *restrict weight = s->weight;
    struct fit found = {0.0f, 0.0f, 0.0f, 0};
    for (;;) {
        const struct sums t = sum_stamp(s);
        const float total = t.w > FLT_MIN ? t.w : FLT_MIN;
        const float pp = t.wpp - t.wp * t.wp / total, ps = t.wps - t.wp * t.ws / total;
        const float ss = t.wss - t.ws * t.ws / total + 1.0f / shape_variance;
        const float pd = t.wpd - t.wp * t.wd / total, sd = t.wsd - t.ws * t.wd / total;
        found.strength = pp - ps * ps / ss;
        const float flux = found.strength > 0.0f ? (pd - ps * sd / ss) / found.strength : 0.0f;
        const float more = (sd - ps * flux) / ss;
        const float level = (t.wd - flux * t.wp - more * t.ws) / total;
        const float shine = flux > 0.0f ? flux : 0.0f;
        found.flux = flux;
        found.level = level;
        int32_t deviant[LANES] = {0};
        for (int64_t p = 0; p < s->n; p += LANES) {
            for (int64_t j = 0; j < LANES; j++) {
                const float stars = shine * profile[p + j] + light[p + j];
                const float rest = data[p + j] - flux * profile[p + j] - more * shape[p + j] - level;
                const float allowed = variance[p + j] + stars + model * stars * stars;
                deviant[j] += weight[p + j] * rest * rest > weight[p + j] * allowed * outlier;
            }
        }
        int32_t count = 0;
        for (int64_t j = 0; j < LANES; j++)
            count += deviant[j];
        if (count == 0 || found.masked > most_masked)
            return found;
        /* The worst pixel first: a bright one shifts the fit so far that normal pixels beside it look deviant too. */
        int64_t worst = 0;
        float worst_excess = 0.0f;
        for (int64_t p = 0; p < s->n; p++) {
            const float stars = shine * profile[p] + light[p];
            const float rest = data[p] - flux * profile[p] - more * shape[p] - level;
            const float excess = rest * rest / (variance[p] + stars + model * stars * stars);
            if (weight[p] > 0.0f && excess > worst_excess) {
                worst = p;
                worst_excess = excess;
            }
        }
        weight[worst] = 0.0f;
        found.masked++;
    }
}

/* Variance of the flux without and per electron of its own light; the weights become those of flux = sum w data. */
static void find_variances(const struct stamp *s, float shape_variance, double *total_found, double *own_found)
{
    const float *restrict profile = s->profile, *restrict light = s->light, *restrict variance = s->variance;
    const float *restrict shape = s->shape;
    float *restrict weight = s->weight;
    const struct sums t = sum_stamp(s);
    const float middle = t.wp / t.w, bent = t.ws / t.w;
    const float ps = t.wps - middle * t.ws, ss = t.wss - bent * t.ws + 1.0f / shape_variance;
    const float part = ps / ss, strength = t.wpp - middle * t.wp - part * ps, by_shape = part / strength;
    float total[LANES] = {0.0f}, own[LANES] = {0.0f};
    for (int64_t p = 0; p < s->n; p += LANES) {
        for (int64_t j = 0; j < LANES; j++) {
            const float w = weight[p + j] * (profile[p + j] - middle - part * (shape[p + j] - bent)) / strength;
            weight[p + j] = w;
            total[j] += w * w * (variance[p + j] + light[p + j]);
            own[j] += w * w * profile[p + j];
        }
    }
    *total_found = (double)(by_shape * by_shape / shape_variance + SUM_OF(total));
    *own_found = (double)SUM_OF(own);
}

/* An edge in the stamp: its sharpness, and the table of its light at places that are `step_px` apart. */
struct edge {
    int64_t phases, table_places, places;
    const float *restrict table;
    double width_px, step_px, flat_excess, width_part, contrast_sigmas;
};

/* Add to `sums` of weighted products what one pixel of weight w, with the star p and the light q, adds.

   The columns are the star p, an edge e at each place, what changes where the edge is moved by a pixel, g, or wider by
   its own width, h; q is the light. The rows of `sums` are e, g, h; pe, pg, ph; ee, eg, eh; gg, gh; hh; eq, gq, hq.
   `light` and `slope` of the edge are interpolated between two rows of the table. */
static void add_at_places(int64_t places, double w, double p, double q, float part, double behind_px, double step_px,
                          const float *restrict light, const float *restrict light_next, const float *restrict slope,
                          const float *restrict slope_next, double (*restrict sums)[PLACES])
{
    const double wp = w * p, wq = w * q;
    for (int64_t m = 0; m < places; m++) {
        const double e = (double)(light[m] + part * (light_next[m] - light[m]));
        const double g = (double)(slope[m] + part * (slope_next[m] - slope[m]));
        const double h = (behind_px + step_px * (double)(int32_t)m) * g;
        const double we = w * e, wg = w * g, wh = w * h;
        sums[0][m] += we;
        sums[1][m] += wg;
        sums[2][m] += wh;
        sums[3][m] += wp * e;
        sums[4][m] += wp * g;
        sums[5][m] += wp * h;
        sums[6][m] += we * e;
        sums[7][m] += we * g;
        sums[8][m] += we * h;
        sums[9][m] += wg * g;
        sums[10][m] += wg * h;
        sums[11][m] += wh * h;
        sums[12][m] += wq * e;
        sums[13][m] += wq * g;
        sums[14][m] += wq * h;
    }
}

/* Fill `sums`; those of the star with itself and with the light. */
static void sum_at_places(const struct stamp *s, const struct edge *edge, double x, double y, double mean_p,
                          double mean_q, double (*sums)[PLACES], double star[2])
{
    const int64_t nearest = edge->table_places / 2 - edge->places / 2;
    double pp = 0.0, pq = 0.0;
    for (int64_t k = 0; k < s->side * s->side; k++) {
        const double w = (double)s->weight[k], p = (double)s->profile[k] - mean_p;
        const double q = (double)(s->data[k] + s->shape[k]) - mean_q;
        pp += w * p * p;
        pq += w * p * q;
        const double across = (x * (double)s->x[k] + y * (double)s->y[k]) / edge->step_px;
        const int64_t first = (int64_t)floor(across);
        const double phase = (across - (double)first) * (double)edge->phases;
        const int64_t low = least((int64_t)phase, edge->phases - 1);
        const float *light = edge->table + low * edge->table_places + nearest + first;
        const float *slope = light + (edge->phases + 1) * edge->table_places;
        add_at_places(edge->places, w, p, q, (float)(phase - (double)low),
                      (across - (double)(edge->places / 2)) * edge->step_px, edge->step_px, light,
                      light + edge->table_places, slope, slope + edge->table_places, sums);
    }
    star[0] = pp;
    star[1] = pq;
}

/* Logarithm of the likelihood of an edge's place; the star's flux there and its variance.

   A and b are the products of the columns with each other and with the light; A is overwritten. The edge is within half
   a step of its place. */
static double solve_edge(const struct edge *edge, double A[COLUMNS][COLUMNS], double b[COLUMNS], double pixel_weight,
                         double *flux, double *variance)
{
    A[1][1] += pixel_weight / (edge->contrast_sigmas * edge->contrast_sigmas);
    const double det = A[0][0] * A[1][1] - A[1][0] * A[1][0], contrast = (A[0][0] * b[1] - A[1][0] * b[0]) / det;
    const double contrast2 = contrast * contrast + A[0][0] / det;
    const double moved = 12.0 / (contrast2 * edge->step_px * edge->step_px);
    const double wider = 1.0 / (contrast2 * (edge->width_part * edge->width_part));
    A[2][2] += moved;
    A[3][3] += wider;
    double found = 0.5 * (log(moved) + log(wider));
    for (int i = COLUMNS - 1; i >= 0; i--) { /* A = U D U^T from the last column: the flux is left for the end */
        found += 0.5 * (b[i] * b[i] / A[i][i] - log(A[i][i]));
        for (int j = 0; j < i; j++) {
            const double part = A[i][j] / A[i][i];
            b[j] -= part * b[i];
            for (int k = 0; k <= j; k++)
                A[j][k] -= part * A[i][k];
        }
    }
    *flux = b[0] / A[0][0];
    *variance = 1.0 / A[0][0];
    return found;
}

/* Mean flux of a star, and its variance, over the places of an edge that faces (x, y), by their likelihoods.

   `mean_p` and `mean_q` are the weighted means of the profile and of the light, data + shape; `total` is the sum of the
   weights. */
static double fit_at_places(const struct stamp *s, const struct edge *edge, double x, double y, double mean_p,
                            double mean_q, double total, double (*sums)[PLACES], double *variance)
{
    const int64_t places = edge->places;
    double star[2], A[COLUMNS][COLUMNS], b[COLUMNS], best = -INFINITY, sum_w = 0.0, sum_f = 0.0, sum_v = 0.0;
    for (int64_t r = 0; r < SUMS; r++)
        for (int64_t m = 0; m < places; m++)
            sums[r][m] = 0.0;
    sum_at_places(s, edge, x, y, mean_p, mean_q, sums, star);
    for (int64_t m = 0; m < places; m++) {
        const double we = sums[0][m], wg = sums[1][m], wh = sums[2][m];
        A[0][0] = star[0];
        A[1][0] = sums[3][m];
        A[2][0] = sums[4][m];
        A[3][0] = sums[5][m];
        A[1][1] = sums[6][m] - we * we / total;
        A[2][1] = sums[7][m] - we * wg / total;
        A[3][1] = sums[8][m] - we * wh / total;
        A[2][2] = sums[9][m] - wg * wg / total;
        A[3][2] = sums[10][m] - wg * wh / total;
        A[3][3] = sums[11][m] - wh * wh / total;
        b[0] = star[1];
        b[1] = sums[12][m];
        b[2] = sums[13][m];
        b[3] = sums[14][m];
        double f, v;
        const double found = solve_edge(edge, A, b, total / (double)(s->side * s->side), &f, &v);
        if (found > best) { /* all weights are relative to that of the best place so far */
            const double part = exp(best - found);
            sum_w *= part;
            sum_f *= part;
            sum_v *= part;
            best = found;
        }
        const double part = exp(found - best);
        sum_w += part;
        sum_f += part * f;
        sum_v += part * (f * f + v);
    }
    const double mean = sum_f / sum_w;
    *variance = sum_v / sum_w - mean * mean;
    return mean;
}

/* Flux of a star in a stamp, and its variance beyond 1 / strength.

   The edge is straight; its direction is that of the stamp's slope, its place and its contrast are unknown: the means
   are over all places, by their likelihoods. A stamp whose slope the noise and neighbours that may not shine explain
   has none: the flux is that of the fit with the background's shape. */
static double fit_beside_edge(const struct stamp *s, const struct fit *fit, const struct edge *edge,
                              double (*sums)[PLACES], double *beyond)
{
    enum { W, WP, WQ, WX, WY, WXX, WYY, LX, LY, COUNT };
    double lane[COUNT][EDGE_LANES] = {{0.0}}, t[COUNT];
    const float *weight = s->weight, *profile = s->profile, *data = s->data, *shape = s->shape, *light = s->light;
    for (int64_t k = 0; k < s->n; k += EDGE_LANES) {
        for (int64_t j = 0; j < EDGE_LANES; j++) {
            const float w = weight[k + j];
            const double v = (double)w, dx = (double)s->x[k + j], dy = (double)s->y[k + j];
            const double rest = (double)(w * (data[k + j] - fit->flux * profile[k + j] - fit->level));
            lane[W][j] += v;
            lane[WP][j] += (double)(w * profile[k + j]);
            lane[WQ][j] += (double)(w * (data[k + j] + shape[k + j]));
            lane[WX][j] += dx * rest;
            lane[WY][j] += dy * rest;
            lane[WXX][j] += v * dx * dx;
            lane[WYY][j] += v * dy * dy;
            lane[LX][j] += v * dx * (double)light[k + j];
            lane[LY][j] += v * dy * (double)light[k + j];
        }
    }
    for (int c = 0; c < COUNT; c++)
        t[c] = (lane[c][0] + lane[c][2]) + (lane[c][1] + lane[c][3]);
    const double wx = t[WX], wy = t[WY], lx = t[LX], ly = t[LY], total = t[W], wxx = t[WXX], wyy = t[WYY];
    *beyond = 0.0;
    const double xx = greater(wxx, 1e-30), yy = greater(wyy, 1e-30);
    const double explained = edge->flat_excess * (1.0 / xx + 1.0 / yy) + (lx / xx) * (lx / xx) + (ly / yy) * (ly / yy);
    const double x = wx / xx, y = wy / yy, steep2 = x * x + y * y;
    if (!(steep2 > explained))
        return (double)fit->flux;
    const double steep = sqrt(steep2);
    double variance;
    const double found = fit_at_places(s, edge, x / steep, y / steep, t[WP] / total, t[WQ] / total,
                                       total, sums, &variance);
    *beyond = greater(variance - 1.0 / (double)fit->strength, 0.0);
    return found;
}

void measure_sources(int64_t height, int64_t width, int64_t background_rows, int64_t noise_rows, int64_t n,
                     int64_t cells, int64_t steps, int64_t wide, int64_t phases, int64_t table_places, int64_t room,
                     const float *restrict image, const float *restrict background,
                     const float *restrict noise, const bool *restrict dead, int64_t background_side,
                     int64_t noise_side, const double *restrict xy_px, const double *restrict flux_e,
                     const double *restrict fraction_sigma, const double *restrict visible,
                     const int64_t *restrict first, int64_t columns, double reach_px, double side_px, int64_t radius,
                     float outlier, float model, float shape_variance, int64_t most_masked,
                     const double *restrict profiles, const float *restrict edges, double sigma_px, double step_px,
                     double flat_excess, double width_part, double contrast_sigmas, int64_t places, float *restrict across,
                     float *restrict down, int64_t *restrict centre, int64_t *restrict near, float *restrict stamp,
                     double *restrict sums, double *restrict measured, bool *restrict usable)
{
    (void)height;
    const int64_t k = wide / 2, side = 2 * radius + 1, rows = cells / columns;
    const struct profiles own = {wide, across, down, centre};
    const struct stamp s = {side, room, stamp, stamp + room, stamp + 2 * room, stamp + 3 * room, stamp + 4 * room,
                            stamp + 5 * room, stamp + 6 * room, stamp + 7 * room};
    double(*at_places)[PLACES] = (double(*)[PLACES])sums;
    const struct edge edge = {phases, table_places, places, edges, sigma_px, step_px * sigma_px, flat_excess, width_part,
                              contrast_sigmas};
    profiles_of(n, steps, wide, xy_px, profiles, across, down, centre);
    for (int64_t p = 0; p < room; p++) {
        s.profile[p] = s.data[p] = s.weight[p] = s.shape[p] = s.light[p] = 0.0f;
        s.variance[p] = 1.0f;
        s.x[p] = p < side * side ? (float)(p % side - radius) : 0.0f;
        s.y[p] = p < side * side ? (float)(p / side - radius) : 0.0f;
    }
    for (int64_t i = 0; i < n; i++) {
        const int64_t count = find_neighbours(near, i, xy_px, visible, first, rows, columns, side_px, reach_px);
        const int64_t left = centre[2 * i] - radius, top = centre[2 * i + 1] - radius;
        for (int64_t p = 0; p < side * side; p++)
            s.light[p] = 0.0f;
        for (int64_t m = 0; m < count; m++) {
            const int64_t j = near[m], x = k + left - centre[2 * j], y = k + top - centre[2 * j + 1];
            add_light(&s, (float)(flux_e[j] * visible[j]), &own, j, x, y);
        }
        load_stamp(&s, width, background_rows, noise_rows, image, background, noise, dead, background_side, noise_side,
                   &own, i);
        const struct fit fit = fit_masking(&s, outlier, model, shape_variance, most_masked);
        float lane[LANES] = {0.0f}; /* part of the star's light in pixels that have a weight */
        for (int64_t p = 0; p < room; p += LANES)
            for (int64_t j = 0; j < LANES; j++)
                lane[j] += s.weight[p + j] > 0.0f ? s.profile[p + j] : 0.0f;
        double *restrict to = measured + 4 * i;
        usable[i] = fit.masked <= most_masked && SUM_OF(lane) > 0.5f;
        to[0] = 0.0;
        to[1] = 1.0;
        to[2] = to[3] = 0.0;
        if (!usable[i])
            continue;
        double beyond;
        to[0] = fit_beside_edge(&s, &fit, &edge, at_places, &beyond);
        find_variances(&s, shape_variance, &to[1], &to[2]);
        to[1] += beyond;
        for (int64_t m = 0; m < count; m++) {
            const int64_t j = near[m], x = k + left - centre[2 * j], y = k + top - centre[2 * j + 1];
            const double leak = flux_e[j] * (double)leak_of(&s, &own, j, x, y);
            to[3] += leak * leak * (visible[j] * (1.0 - visible[j]) + visible[j] * fraction_sigma[j] * fraction_sigma[j]);
        }
    }
}
