/* Horizons, and bounds of them, by a table of horizons; what makes such a table; and bounds that are kept. */

#include "bounds.h"

#define TOUCHING 1e-9 /* of a cell or a bin: what only touches it does not count */
#define FIELDS BOUNDS
#define LARGEST 1e15 /* of numbers that become integers */

/* Rounded down; NaN becomes a number. */
static int64_t floor_of(double x)
{
    return (int64_t)smaller(greater(floor(x), -LARGEST), LARGEST);
}

static int64_t ceil_of(double x)
{
    return -floor_of(-x);
}

/* The bin of a number of bins around the circle. */
static int64_t bin_of(const struct table *t, int64_t number)
{
    const int64_t rest = number % t->bins;
    return rest < 0 ? rest + t->bins : rest;
}

/* A height in a field [m]. */
static double height_of(uint16_t field)
{
    return field > INT16_MAX ? (double)field - 65536.0 : (double)field;
}

/* Between which distances the horizon stands from a point, and about where; anywhere off the table. */
static struct stretch look_up(const struct table *t, double east, double north, double azimuth)
{
    struct stretch found = {0.0, FAR_M, 0.0};
    const double side = 2 * t->reach / (double)t->across, bin_rad = TURN / (double)t->bins, step = t->distance_step;
    const int64_t i = floor_of((east + t->reach) / side), j = floor_of((north + t->reach) / side);
    if (i < 0 || i >= t->across || j < 0 || j >= t->across)
        return found;
    const int64_t b = bin_of(t, floor_of(azimuth / bin_rad));
    const uint16_t *v = t->values + ((i * t->across + j) * t->bins + b) * FIELDS;
    if (v[2] > v[3])
        return found;
    const double along = (east - ((double)i + 0.5) * side + t->reach) * t->sines[b]
                         + (north - ((double)j + 0.5) * side + t->reach) * t->cosines[b];
    const double margin = 0.01 * side + step;
    found.begin = v[2] > 0 ? greater(0.0, v[2] * step - along - margin) : 0.0;
    if (v[3] < UINT16_MAX) /* a ray turned within the bin needs up to 1 / cos of the turn more to get as far */
        found.end = greater(0.0, (v[3] * step - along) / cos(bin_rad / 2) + margin);
    found.hint = greater(0.0, v[4] * step - along);
    return found;
}

static bool is_same_point(const double *one, const double *other)
{
    return one[0] == other[0] && one[1] == other[1];
}

void trace_horizons(int64_t n, const struct ground *restrict ground, const struct table *restrict table,
                    double camera_height, bool is_own, const double *restrict points, const double *restrict azimuths,
                    double *restrict tan, double *restrict distance, double *restrict edge)
{
    double up = 0.0;
    struct place at = {-1, 0.0, 0.0};
    for (int64_t k = 0; k < n; k++) {
        const double *point = points + 2 * k;
        if (k == 0 || !is_same_point(point, point - 2))
            up = surface_from_zero(ground, point[0], point[1], &at) + camera_height;
        struct stretch where = {0.0, FAR_M, 0.0};
        if (table->across > 0) {
            const struct stretch found = look_up(table, point[0], point[1], azimuths[k]);
            where.hint = found.hint;
            where = is_own ? found : where;
        }
        const struct ray ray = {point[0], point[1], up, sin(azimuths[k]), cos(azimuths[k])};
        const struct crest best = horizon(ground, &ray, where);
        tan[k] = best.tan;
        distance[k] = best.at;
        edge[k] = best.edge;
    }
}

/* Where the horizons of a box stand by the table, in both azimuths that limit its rays. */
static struct stretch look_up_box(const struct table *t, double east, double north, double half, double azimuth,
                                  double turn)
{
    struct stretch found = {FAR_M, 0.0, 0.0};
    for (int corner = 0; corner < 4; corner++) {
        const double e = east + half * (2 * (corner & 1) - 1), n = north + half * (corner - (corner & 1) - 1);
        for (int side = -1; side < (turn == 0.0 ? 0 : 2); side += 2) {
            const struct stretch own = look_up(t, e, n, azimuth + turn * side);
            found.begin = smaller(own.begin, found.begin);
            found.end = greater(own.end, found.end);
            found.hint = own.hint;
        }
    }
    found.begin = greater(0.0, found.begin - 2.0 * half);
    found.end += 2.0 * half;
    return found;
}

void box_bounds(int64_t n, const struct ground *restrict ground, const struct table *restrict table,
                double camera_height, const double *restrict centres, const double *restrict half,
                const double *restrict azimuths, const double *restrict turn, double *restrict low,
                double *restrict high)
{
    struct box box = {0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0};
    double found[BOUNDS];
    for (int64_t k = 0; k < n; k++) {
        const double *centre = centres + 2 * k;
        if (k == 0 || !is_same_point(centre, centre - 2) || half[k] != half[k - 1])
            box = box_at(ground, centre[0], centre[1], half[k], camera_height, true);
        struct beam beam = {sin(azimuths[k]), cos(azimuths[k]), turn[k], {0.0, FAR_M, 0.0}};
        if (table->across > 0)
            beam.where = look_up_box(table, centre[0], centre[1], half[k], azimuths[k], turn[k]);
        bounds(ground, box, &beam, true, found);
        low[k] = atan(found[0]);
        high[k] = atan(found[1]);
    }
}

/* A box within a cell of the table, seen in one of its bins. */
struct seen_box {
    double along, aside, wide;     /* from the cell's middle; half the box's width along the ray */
    double low_up, high_up, half;  /* heights of a camera in it; of the cell */
};

/* Widen bounds of tan H by those of a cell's line and point. */
static void take_line(const struct table *t, const uint16_t *v, const struct seen_box *box, double *low, double *high)
{
    double below = t->tangents[v[0]], above = t->tangents[v[1]];
    const double step = t->distance_step, half_bin = TURN / (double)t->bins / 2, cos_turn = cos(half_bin);
    const double near = v[2] * step - box->along - box->wide, far = v[3] * step - box->along - box->wide;
    if (v[3] < UINT16_MAX && v[2] > 0 && near > 0.0) { /* 0: such ground stands behind the cell's middle, too */
        const double line = height_of(v[6]), slope = t->tangents[v[5]], rise = v[9] * t->rise_step;
        const double tan_turn = tan(half_bin), width = box->aside + box->wide + 2 * box->half * tan_turn;
        const double top0 = line + slope * v[2] * step - box->low_up + rise * (width + v[2] * step * tan_turn);
        const double top1 = line + slope * v[3] * step - box->low_up + rise * (width + v[3] * step * tan_turn);
        const double tan0 = top0 > 0.0 ? top0 / near : top0 * cos_turn / (near + 2 * box->wide);
        const double tan1 = top1 > 0.0 ? top1 / far : top1 * cos_turn / (far + 2 * box->wide);
        above = smaller(greater(tan1, tan0), above);
    }
    const double s = v[7] * step;
    if (height_of(v[8]) > INT16_MIN) {
        /* The point reckons with the whole cell's width aside, of which the box takes up a part. */
        const double over = height_of(v[8]) - box->high_up
                            + v[10] * t->rise_step * greater(0.0, box->half - box->aside - box->wide);
        if (over > 0.0)
            below = greater(over * cos_turn / (s + step - box->along + box->wide), below);
        else if (s - box->along - box->wide > 0.0)
            below = greater(over / (s - box->along - box->wide), below);
    }
    *low = smaller(below, *low);
    *high = greater(greater(below, above), *high);
}

/* The first and last of `count` cells of a `side` that an interval touches, about `reach`. */
static void cells_of(double low, double high, double reach, double side, int64_t count, int64_t *first, int64_t *last)
{
    *first = least(most(floor_of((low + reach) / side + TOUCHING), 0), count - 1);
    *last = least(most(ceil_of((high + reach) / side - TOUCHING) - 1, *first), count - 1);
}

/* Cells, or blocks of them, that a box touches, `count` to a side, and the bins that its rays do. */
struct touched {
    int64_t count, i0, i1, j0, j1, first_bin, end_bin;
};

/* Bounds of tan H by the lines and points of the cells that a box of less than a cell touches. */
static void bound_by_lines(const struct table *t, const struct touched *in, const struct box *box, double side,
                           double *low, double *high)
{
    double tan_low = INFINITY, tan_high = -INFINITY;
    for (int64_t i = in->i0; i <= in->i1; i++) {
        for (int64_t j = in->j0; j <= in->j1; j++) {
            const double from_east = box->east - ((double)i + 0.5) * side + t->reach;
            const double from_north = box->north - ((double)j + 0.5) * side + t->reach;
            for (int64_t number = in->first_bin; number < in->end_bin; number++) {
                const int64_t b = bin_of(t, number);
                const double sine = t->sines[b], cosine = t->cosines[b];
                const struct seen_box seen = {
                    from_east * sine + from_north * cosine, fabs(from_east * cosine - from_north * sine),
                    box->half * (fabs(sine) + fabs(cosine)), box->low_up, box->high_up, 0.5 * side,
                };
                const uint16_t *fields = t->values + ((i * in->count + j) * t->bins + b) * FIELDS;
                take_line(t, fields, &seen, &tan_low, &tan_high);
            }
        }
    }
    *low = atan(tan_low);
    *high = atan(tan_high);
}

/* Bounds by the least and most elevation of blocks. */
static void bound_by_blocks(const struct table *t, const struct touched *in, const uint16_t *lows,
                            const uint16_t *highs, double *low, double *high)
{
    int64_t lowest = UINT16_MAX, highest = 0;
    for (int64_t i = in->i0; i <= in->i1; i++) {
        for (int64_t j = in->j0; j <= in->j1; j++) {
            for (int64_t number = in->first_bin; number < in->end_bin; number++) {
                const int64_t at = (i * in->count + j) * t->bins + bin_of(t, number);
                lowest = least(lowest, lows[at]);
                highest = most(highest, highs[at]);
            }
        }
    }
    *low = (double)lowest * t->angle_step - TURN / 4;
    *high = (double)highest * t->angle_step - TURN / 4;
}

void sector_bounds(int64_t blocks, int64_t bins, int64_t rows, int64_t m, int64_t n,
                   const struct ground *restrict ground, const struct table *restrict table,
                   const uint16_t *restrict lows, const uint16_t *restrict highs, double camera_height,
                   const double *restrict azimuths, const double *restrict turn, const double *restrict centres,
                   const double *restrict half, double *restrict low, double *restrict high)
{
    const double side = 2 * table->reach / (double)blocks, bin_rad = TURN / (double)bins;
    struct box box = {0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0};
    for (int64_t k = 0; k < n; k++) {
        const double east = centres[2 * k], north = centres[2 * k + 1], wide = half[k];
        const bool is_fine = blocks == table->across && wide < 0.5 * side;
        if (is_fine && (k == 0 || !is_same_point(centres + 2 * k, centres + 2 * k - 2) || wide != half[k - 1]))
            box = box_at(ground, east, north, wide, camera_height, false);
        struct touched in = {.count = blocks};
        cells_of(east - wide, east + wide, table->reach, side, blocks, &in.i0, &in.i1);
        cells_of(north - wide, north + wide, table->reach, side, blocks, &in.j0, &in.j1);
        for (int64_t a = 0; a < m; a++) {
            const int64_t at = least(k, rows - 1) * m + a;
            in.first_bin = floor_of((azimuths[at] - turn[at]) / bin_rad + TOUCHING);
            in.end_bin = most(ceil_of((azimuths[at] + turn[at]) / bin_rad - TOUCHING), in.first_bin + 1);
            in.end_bin = least(in.end_bin, in.first_bin + bins);
            if (is_fine)
                bound_by_lines(table, &in, &box, side, low + k * m + a, high + k * m + a);
            else
                bound_by_blocks(table, &in, lows, highs, low + k * m + a, high + k * m + a);
        }
    }
}

void fill_table(int64_t n, int64_t m, const struct ground *restrict ground, const double *restrict centres, double half,
                double camera_height, const double *restrict sines, const double *restrict cosines, double turn,
                double *restrict found)
{
    for (int64_t k = 0; k < n; k++) {
        const struct box box = box_at(ground, centres[2 * k], centres[2 * k + 1], half, camera_height, false);
        double hint = 0.0;
        for (int64_t a = 0; a < m; a++) {
            const struct beam beam = {sines[a], cosines[a], turn, {0.0, FAR_M, hint}};
            double *own = found + (k * m + a) * BOUNDS;
            bounds(ground, box, &beam, false, own);
            hint = own[4];
        }
    }
}

/* The slot of the numbers of a box. */
static int64_t slot_of(const uint64_t *key, int64_t numbers, int64_t slots)
{
    const uint64_t mix = 0xBF58476D1CE4E5B9u;
    uint64_t mixed = key[0] * mix;
    for (int64_t number = 1; number < numbers; number++)
        mixed = ((mixed ^ (mixed >> 29)) + key[number]) * mix;
    return (int64_t)((mixed ^ (mixed >> 29)) % (uint64_t)slots);
}

void recall_bounds(int64_t slots, int64_t numbers, int64_t azimuths, int64_t n, const uint64_t *restrict kept,
                   const double *restrict kept_bounds, const uint64_t *restrict keys, double *restrict low,
                   double *restrict high, bool *restrict missing)
{
    for (int64_t k = 0; k < n; k++) {
        const int64_t slot = slot_of(keys + k * numbers, numbers, slots);
        missing[k] = false;
        for (int64_t number = 0; number < numbers; number++)
            missing[k] |= kept[slot * numbers + number] != keys[k * numbers + number];
        if (missing[k])
            continue;
        for (int64_t a = 0; a < azimuths; a++)
            low[k * azimuths + a] = kept_bounds[2 * slot * azimuths + a];
        for (int64_t a = 0; a < azimuths; a++)
            high[k * azimuths + a] = kept_bounds[(2 * slot + 1) * azimuths + a];
    }
}

void keep_bounds(int64_t slots, int64_t numbers, int64_t azimuths, int64_t n, uint64_t *restrict kept,
                 double *restrict kept_bounds, const uint64_t *restrict keys, const double *restrict low,
                 const double *restrict high)
{
    for (int64_t k = 0; k < n; k++) {
        const int64_t slot = slot_of(keys + k * numbers, numbers, slots);
        for (int64_t number = 0; number < numbers; number++)
            kept[slot * numbers + number] = keys[k * numbers + number];
        for (int64_t a = 0; a < azimuths; a++)
            kept_bounds[2 * slot * azimuths + a] = low[k * azimuths + a];
        for (int64_t a = 0; a < azimuths; a++)
            kept_bounds[(2 * slot + 1) * azimuths + a] = high[k * azimuths + a];
    }
}

/* The largest of values [across, across, bins] in cells from `low` to `high` (two numbers each), and some bins. */
static double largest_of(const float *values, int64_t across, int64_t bins, const int64_t *low, const int64_t *high,
                         int64_t count, const int64_t *bin)
{
    double largest = 0.0;
    for (int64_t i = low[0]; i <= high[0]; i++) {
        for (int64_t j = low[1]; j <= high[1]; j++) {
            for (int64_t k = 0; k < count; k++)
                largest = greater(values[(i * across + j) * bins + bin[k]], largest);
        }
    }
    return largest;
}

void largest_of_cells(int64_t across, int64_t bins, int64_t n, int64_t rows, int64_t m, int64_t turns,
                      const float *restrict values, const int64_t *restrict cells, const int64_t *restrict bin,
                      double *restrict found)
{
    for (int64_t k = 0; k < n; k++) {
        const int64_t *low = cells + 4 * k, *row = bin + least(k, rows - 1) * m * turns;
        const bool is_again = k > 0 && rows == 1 && low[0] == low[-4] && low[1] == low[-3] && low[2] == low[-2]
                              && low[3] == low[-1];
        for (int64_t a = 0; a < m; a++)
            found[k * m + a] = is_again ? found[(k - 1) * m + a]
                                        : largest_of(values, across, bins, low, low + 2, turns, row + a * turns);
    }
}
