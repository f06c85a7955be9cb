/* The skyline around the compass as a chain of states: emissions, likelihoods, probabilities. */

#include <math.h>

#include "common.h"
#include "profiles.h"
#include "startrack_kernels.h"

#define BLOCK 64 /* points that are computed together */
#define LANES 8  /* their number is filled up to a multiple of it */

/* As `clear_emissions`; `gain` may be 0: none. */
static void fill_clear(const struct cells *c, int64_t sectors, int64_t n, const double *restrict scale, double wrong,
                       const double *restrict shifts, const double *restrict gain, double *restrict found)
{
    for (int64_t s = 0; s < sectors; s++) {
        for (int64_t p = s * n; p < (s + 1) * n; p++) {
            const double at = shifts[p];
            const int64_t k = cell_at(c, s, at);
            const double rise = c->right[k] - c->left[k];
            double value = c->left[k] - c->free[s];
            if (rise != 0.0 || c->bend[k] != 0.0) {
                const double u = smaller(greater((at - c->x[k]) / (c->x[k + 1] - c->x[k]), 0.0), 1.0);
                value += u * rise + u * (1.0 - u) * c->bend[k];
            }
            if (gain)
                value += gain[p];
            found[p] = scale[s] * ((1.0 - wrong) * exp(value) + wrong);
        }
    }
}

void clear_emissions(int64_t sectors, int64_t m, int64_t guides, int64_t n, int64_t gained,
                     const int64_t *restrict first, const double *restrict x, const double *restrict left,
                     const double *restrict right,
                     const double *restrict bend, const double *restrict free, const int32_t *restrict guide,
                     const double *restrict scale, double highest, double wrong, const double *restrict shifts,
                     const double *restrict gain, double *restrict found)
{
    (void)m;
    const struct cells c = {first, x, left, right, bend, 0, free, guide, guides, highest};
    fill_clear(&c, sectors, n, scale, wrong, shifts, gained > 0 ? gain : 0, found);
}

void gains_of_light(int64_t sectors, int64_t m, int64_t guides, int64_t n, const int64_t *restrict first,
                    const double *restrict x, const double *restrict left, const double *restrict right,
                    const double *restrict bend, const double *restrict free, const int32_t *restrict guide,
                    double highest, const double *restrict shifts, const double *restrict lifts,
                    double *restrict found)
{
    (void)m;
    const struct cells c = {first, x, left, right, bend, 0, free, guide, guides, highest};
    for (int64_t p = 0; p < n; p++)
        for (int64_t s = 0; s < sectors; s++) {
            const double at = shifts[p * sectors + s];
            found[p * sectors + s] = log_at(&c, s, at + lifts[p * sectors + s]) - log_at(&c, s, at);
        }
}

void prepare_levels(int64_t sectors, int64_t m, int64_t guides, int64_t edges, int64_t levels, int64_t nodes,
                    const int64_t *restrict first, const double *restrict x, const double *restrict integral,
                    const double *restrict free, const int32_t *restrict guide, const double *restrict scale,
                    const double *restrict hidden, double highest, double wrong, const double *restrict reach,
                    const double *restrict edge, const int64_t *restrict lower, const int64_t *restrict upper,
                    const double *restrict from, const double *restrict until, int64_t risen, double *restrict scratch,
                    float *restrict table)
{
    (void)m;
    const struct cells c = {first, x, 0, 0, 0, integral, free, guide, guides, highest};
    double *restrict place = scratch + edges * nodes; /* of the nodes, from -1 to 1 */
    for (int64_t i = 0; i < nodes; i++)
        place[i] = 2.0 * (double)i / (double)(nodes - 1) - 1.0;
    for (int64_t s = 0; s < sectors; s++) {
        const int64_t last = first[s + 1] - 1;
        const double outside = exp(-free[s]);
        for (int64_t e = 0; e < edges; e++) {
            int64_t k = cell_at(&c, s, edge[e] - reach[s]);
            for (int64_t i = 0; i < nodes; i++) {
                const double at = edge[e] + reach[s] * place[i] * fabs(place[i]);
                while (k < last - 1 && x[k + 1] <= at)
                    k++;
                const double inside = smaller(at, x[last]);
                scratch[e * nodes + i] = integral[k] +
                                         (inside - x[k]) / (x[k + 1] - x[k]) * (integral[k + 1] - integral[k]) +
                                         (at - inside) * outside;
            }
        }
        for (int64_t j = 0; j < levels; j++) {
            const double *restrict high = scratch + upper[j] * nodes, *restrict low = scratch + lower[j] * nodes;
            float *restrict to = table + (s * levels + j) * nodes;
            for (int64_t i = 0; i < nodes; i++) {
                const double mean = j == risen - 1 ? hidden[s] : (high[i] - low[i]) / (until[j] - from[j]) * scale[s];
                to[i] = (float)((1.0 - wrong) * mean + wrong * scale[s]);
            }
        }
    }
}

void emissions(int64_t sectors, int64_t m, int64_t guides, int64_t levels, int64_t states,
               const int64_t *restrict first, const double *restrict x, const double *restrict left,
               const double *restrict right, const double *restrict bend, const double *restrict integral,
               const double *restrict free, const int32_t *restrict guide, const double *restrict scale,
               const double *restrict hidden, double highest, double wrong, const double *restrict shift,
               const double *restrict gain, const double *restrict from, const double *restrict until, int64_t risen,
               double *restrict found)
{
    (void)m;
    const struct cells c = {first, x, left, right, bend, integral, free, guide, guides, highest};
    for (int64_t s = 0; s < sectors; s++) {
        double *restrict to = found + s * states;
        to[0] = scale[s] * ((1.0 - wrong) * exp(log_at(&c, s, shift[s]) + gain[s]) + wrong);
        for (int64_t j = 0; j < levels; j++) {
            double mean = hidden[s];
            if (j != risen - 1) {
                mean = (integral_to(&c, s, shift[s] + until[j]) - integral_to(&c, s, shift[s] + from[j])) /
                       (until[j] - from[j]);
                mean *= scale[s];
            }
            to[j + 1] = (1.0 - wrong) * mean + wrong * scale[s];
        }
    }
}

/* A group of states that go over into each other: rows from begin to end, with a row of zeros on either side. */
struct group {
    int64_t begin, end;
    float start, jump;
};

/* Rows of one float for each of `points` points. */
typedef float row_of[BLOCK];

/* One step of the chain: `off` and `clear` are before it, `moved` and `clear` after it. */
static void move_states(int64_t points, const struct group groups[2], float stop, float keep, float near, float stay,
                        row_of *restrict off, row_of *restrict moved, float *restrict clear, float *restrict total,
                        float *restrict ended)
{
    for (int64_t p = 0; p < points; p++)
        ended[p] = 0.0f;
    for (int g = 0; g < 2; g++) {
        const struct group one = groups[g];
        for (int64_t p = 0; p < points; p++)
            total[p] = 0.0f;
        for (int64_t r = one.begin; r < one.end; r++)
            for (int64_t p = 0; p < points; p++)
                total[p] += off[r][p];
        for (int64_t r = one.begin; r < one.end; r++) {
            const float *restrict here = off[r], *restrict below = off[r - 1], *restrict above = off[r + 1];
            float *restrict to = moved[r];
            for (int64_t p = 0; p < points; p++)
                to[p] = one.start * clear[p] + one.jump * total[p] + keep * here[p] + near * (below[p] + above[p]);
        }
        for (int64_t p = 0; p < points; p++) { /* the outermost levels go to their only neighbour twice as often */
            moved[one.begin + 1][p] += near * off[one.begin][p];
            moved[one.end - 2][p] += near * off[one.end - 1][p];
            ended[p] += stop * total[p];
        }
    }
    for (int64_t p = 0; p < points; p++)
        clear[p] = stay * clear[p] + ended[p];
}

/* off = moved times the emissions of one sector (levels, nodes), between the nodes of each point. */
static void emit_levels(int64_t points, const struct group groups[2], int64_t nodes, const float *restrict table,
                        const int32_t *restrict node, const float *restrict part, row_of *restrict moved,
                        row_of *restrict off)
{
    for (int g = 0; g < 2; g++) {
        for (int64_t r = groups[g].begin; r < groups[g].end; r++) {
            const float *restrict emission = table + (r - 1 - g) * nodes, *restrict from = moved[r];
            float *restrict to = off[r];
            for (int64_t p = 0; p < points; p++) {
                const float low = emission[node[p]];
                to[p] = from[p] * (low + part[p] * (emission[node[p] + 1] - low));
            }
        }
    }
}

/* Divide all states by their sum, which goes into the product. */
static void scale_states(int64_t points, int64_t rows, row_of *restrict off, float *restrict clear,
                         float *restrict total, double *restrict product)
{
    for (int64_t p = 0; p < points; p++)
        total[p] = clear[p];
    for (int64_t r = 1; r < rows; r++)
        for (int64_t p = 0; p < points; p++)
            total[p] += off[r][p];
    for (int64_t p = 0; p < points; p++) {
        product[p] *= (double)total[p];
        clear[p] /= total[p];
    }
    for (int64_t r = 1; r < rows; r++)
        for (int64_t p = 0; p < points; p++)
            off[r][p] /= total[p];
}

static void clear_rows(int64_t rows, row_of *restrict states)
{
    for (int64_t r = 0; r < rows; r++)
        for (int64_t p = 0; p < BLOCK; p++)
            states[r][p] = 0.0f;
}

void chain_log_likelihoods(int64_t sectors, int64_t m, int64_t guides, int64_t star_cells, int64_t levels,
                           int64_t nodes, int64_t lights, int64_t n, int64_t gained, int64_t closings,
                           int64_t rows, const int64_t *restrict first, const double *restrict x, const double *restrict left,
                           const double *restrict right, const double *restrict bend, const double *restrict free,
                           const int32_t *restrict guide, const double *restrict scale,
                           const int64_t *restrict star_first, const double *restrict star_x,
                           const double *restrict star_left, const double *restrict star_right,
                           const double *restrict star_bend, const double *restrict star_free,
                           const int32_t *restrict star_guide, const double *restrict star_scale, double highest,
                           double wrong, const double *restrict reach, const float *restrict table,
                           const double *restrict light, int64_t risen, double risen_start, double risen_jump,
                           double sunk_start, double sunk_jump, double stop, double keep, double near,
                           const double *restrict shifts, const double *restrict gains, int64_t cut,
                           const int64_t *restrict closing, float *restrict states, double *restrict scratch,
                           double *restrict found)
{
    const struct group groups[2] = {{1, risen + 1, (float)risen_start, (float)risen_jump},
                                    {risen + 2, levels + 2, (float)sunk_start, (float)sunk_jump}};
    const float stay = (float)(1.0 - risen_start * (double)risen - sunk_start * (double)(levels - risen));
    const int64_t height = levels + 3; /* rows of states: these and their zeros */
    row_of *restrict off = (row_of *)states, *restrict moved = off + height;
    double *restrict shift = scratch, *restrict at_skyline = shift + sectors * BLOCK;
    double *restrict lit = at_skyline + sectors * BLOCK, *restrict gain = lit + sectors * BLOCK;
    const struct cells c = {first, x, left, right, bend, 0, free, guide, guides, highest};
    float clear[BLOCK], total[BLOCK], ended[BLOCK], part[BLOCK];
    int32_t node[BLOCK];
    double logs[BLOCK], product[BLOCK];
    (void)m;
    (void)rows;
    for (int64_t begin = 0; begin < n; begin += BLOCK) {
        const int64_t points = least(BLOCK, n - begin), filled = (points + LANES - 1) / LANES * LANES;
        double *restrict to = found + begin;
        for (int64_t s = 0; s < sectors; s++)
            for (int64_t p = 0; p < points; p++)
                shift[s * points + p] = shifts[(begin + p) * sectors + s];
        for (int64_t s = 0; s < sectors && gained > 0; s++)
            for (int64_t p = 0; p < points; p++)
                gain[s * points + p] = gains[(begin + p) * sectors + s];
        fill_clear(&c, sectors, points, scale, wrong, shift, gained > 0 ? gain : 0, at_skyline);
        if (lights > 0)
            clear_emissions(sectors, star_cells, guides, points, 0, star_first, star_x, star_left, star_right, star_bend,
                            star_free, star_guide, star_scale, highest, wrong, shift, 0, lit);
        for (int64_t p = 0; p < points; p++)
            to[p] = -INFINITY;
        for (int64_t q = 0; q < closings; q++) {
            const int64_t k = closing[q], at_end = k <= risen ? k : k + 1; /* row of the state */
            clear_rows(2 * height, off);
            for (int64_t p = 0; p < BLOCK; p++) {
                clear[p] = part[p] = logs[p] = 0.0f;
                product[p] = 1.0;
                node[p] = 0;
            }
            for (int64_t step = 0; step <= sectors; step++) {
                const int64_t s = cut + step < sectors ? cut + step : cut + step - sectors;
                if (step > 0)
                    move_states(filled, groups, (float)stop, (float)keep, (float)near, stay, off, moved, clear, total,
                                ended);
                if (step == sectors)
                    break;
                for (int64_t p = 0; p < points; p++) {
                    const double d = shift[s * points + p], u = sqrt(smaller(fabs(d) / reach[s], 0.999));
                    const double at = ((d > 0.0 ? u : -u) + 1.0) * 0.5 * (double)(nodes - 1);
                    node[p] = (int32_t)at;
                    part[p] = (float)(at - (double)node[p]);
                }
                if (step == 0)
                    for (int64_t p = 0; p < BLOCK; p++) {
                        clear[p] = k == 0 ? 1.0f : 0.0f;
                        moved[at_end][p] = k > 0 ? 1.0f : 0.0f;
                    }
                emit_levels(filled, groups, nodes, table + s * levels * nodes, node, part, moved, off);
                if (lights > 0)
                    for (int64_t r = groups[1].begin; r < groups[1].end; r++)
                        for (int64_t p = 0; p < points; p++)
                            off[r][p] = moved[r][p] * (float)(light[s] * lit[s * points + p]);
                for (int64_t p = 0; p < points; p++)
                    clear[p] = (float)((double)clear[p] * at_skyline[s * points + p]);
                if (step % 4 == 3)
                    scale_states(filled, levels + 2, off, clear, total, product);
                if (step % 32 == 31)
                    for (int64_t p = 0; p < points; p++) {
                        logs[p] += log(product[p]);
                        product[p] = 1.0;
                    }
            }
            const float *last = k == 0 ? clear : moved[at_end];
            for (int64_t p = 0; p < points; p++) {
                const double value = logs[p] + log(product[p]) + log(greater((double)last[p], 1e-37));
                const double top = greater(value, to[p]);
                to[p] = top + log(exp(value - top) + exp(to[p] - top));
            }
        }
    }
}

void smooth_states(int64_t sectors, int64_t states, const double *restrict e, const double *restrict T,
                   double *restrict scratch, double *restrict f, double *restrict post)
{
    double *restrict a = scratch, *restrict b = a + states, *restrict turned = b + states;
    for (int64_t j = 0; j < states; j++) {
        a[j] = 0.0;
        for (int64_t i = 0; i < states; i++)
            turned[j * states + i] = T[i * states + j];
    }
    for (int64_t step = 0; step < 2 * sectors; step++) {
        const int64_t s = step % sectors;
        double total = 0.0;
        for (int64_t j = 0; j < states; j++)
            b[j] = step == 0 ? 1.0 : 0.0;
        for (int64_t i = 0; i < states; i++)
            for (int64_t j = 0; j < states; j++)
                b[j] += a[i] * T[i * states + j];
        for (int64_t j = 0; j < states; j++) {
            b[j] *= e[s * states + j];
            total += b[j];
        }
        for (int64_t j = 0; j < states; j++)
            f[s * states + j] = a[j] = b[j] / total;
    }
    for (int64_t j = 0; j < states; j++)
        a[j] = 1.0;
    for (int64_t step = 0; step < 2 * sectors; step++) {
        const int64_t s = sectors - 1 - step % sectors;
        double *restrict to = post + s * states;
        double total = 0.0, whole = 0.0;
        for (int64_t j = 0; j < states; j++) {
            to[j] = f[s * states + j] * a[j];
            b[j] = a[j] * e[s * states + j];
            total += to[j];
        }
        for (int64_t i = 0; i < states; i++) {
            to[i] /= total;
            a[i] = 0.0;
        }
        for (int64_t j = 0; j < states; j++)
            for (int64_t i = 0; i < states; i++)
                a[i] += turned[j * states + i] * b[j];
        for (int64_t i = 0; i < states; i++)
            whole += a[i];
        for (int64_t i = 0; i < states; i++)
            a[i] /= whole;
    }
}

/* found[i] = sum over j of values[j] exp(-|h[i] - h[j]| / rough); decay[i] is the exponential from i - 1 to i. */
static void spread(int64_t n, const double *restrict values, const double *restrict decay, double *restrict found)
{
    double up = values[0], down = 0.0;
    found[0] = values[0];
    for (int64_t i = 1; i < n; i++) {
        up = up * decay[i] + values[i];
        found[i] = up;
    }
    for (int64_t i = n - 2; i >= 0; i--) {
        down = (down + values[i + 1]) * decay[i + 1];
        found[i] += down;
    }
}

void pass_curve(int64_t sectors, int64_t n, const double *restrict likelihood, const double *restrict heights,
                const double *restrict cells, double rough, double jump, double *restrict scratch,
                double *restrict found)
{
    double *restrict a = scratch, *restrict fall = a + n, *restrict norm = fall + n, *restrict moved = norm + n;
    double *restrict decay = moved + n, whole = 0.0;
    for (int64_t i = 0; i < n; i++) {
        decay[i] = i > 0 ? exp((heights[i - 1] - heights[i]) / rough) : 0.0;
        whole += cells[i];
    }
    spread(n, cells, decay, norm);
    for (int64_t i = 0; i < n; i++)
        a[i] = cells[i] / whole;
    for (int64_t s = 0; s < sectors; s++) {
        if (s > 0) {
            for (int64_t i = 0; i < n; i++)
                fall[i] = a[i] / norm[i];
            spread(n, fall, decay, moved);
            for (int64_t i = 0; i < n; i++)
                a[i] = cells[i] * ((1.0 - jump) * moved[i] + jump / whole);
        }
        double total = 0.0;
        for (int64_t i = 0; i < n; i++) {
            a[i] *= likelihood[s * n + i];
            total += a[i];
        }
        for (int64_t i = 0; i < n; i++)
            a[i] /= total;
        found[s] = log(total);
    }
}
