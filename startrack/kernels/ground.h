/* The ground of height maps, and rays over it.

   Places are east, north and up [m] in enu of the maps' origin, or a column and a row on a map. A ray leaves the camera
   at an azimuth; s is the horizontal distance along it in enu. Air bends the line of sight: heights count with `sag` s^2
   more, half the line's curvature times the squared distance. Such a line still bends less than the sphere: seen from
   the sphere's centre it is convex, so that its tangent lies below it.

   Blocks of level L are 2^L x 2^L cells of a map, a cell lying between four posts. */

#ifndef STARTRACK_GROUND_H
#define STARTRACK_GROUND_H

#include <math.h>

#include "common.h"
#include "startrack_kernels.h"

#define NUDGE_M 0.05 /* past a grid line; a kink is missed by that much at most */
#define FAR_M 1e9
#define LOWEST_TAN (-50.0)
#define STRAIGHT_M 150.0 /* over which a ray crosses a map in one direction: it climbs 60 m at most, bends by a cm */
#define FIXED_POINT_ROUNDS 3
#define SETTLED_M 0.5       /* between rounds, each of which leaves a few per cent of the last one's change */
#define FIRST_COEFFICIENT 3 /* of a map of the Earth in its numbers */

/* Column and row on a map, -1 where no map reaches. */
struct place {
    int64_t m;
    double column, row;
};

struct ray {
    double east, north, up, sin_a, cos_a; /* of the camera, and of the azimuth */
};

/* The part of a ray whose ground counts, and about where the horizon stands there; 0: not known. */
struct stretch {
    double begin, end, hint;
};

/* The horizon's tangent, its distance, and the distance at which maps end or have a void; FAR_M: beyond the horizon. */
struct crest {
    double tan, at, edge;
};

/* Ground at s along a ray: its height in enu, and where on the maps it is. */
struct mark {
    double s, z;
    struct place at;
};

/* Columns and rows per metre of a ray. */
struct heading {
    double column, row;
};

/* The Moon's maps, see Raster.grid_numbers. */
static inline struct place cell_by_projection(const double *grid, int64_t m, double east, double north, double up)
{
    const double v1 = grid[1] * east + grid[2] * north + grid[3] * up;
    const double v2 = grid[4] * east + grid[5] * north + grid[6] * up;
    const double v3 = grid[7] * east + grid[8] * north + grid[9] * up;
    double x, y;
    if (grid[0] == 2.0) {
        x = grid[10] * atan2(v2, v1);
        y = grid[11] * atan2(v3, sqrt(v1 * v1 + v2 * v2));
    } else {
        const double r = sqrt(east * east + north * north + up * up);
        const double k = grid[0] == 0.0 ? grid[10] / (r + v3) : grid[10] / r;
        x = k * v1;
        y = k * v2;
    }
    const struct place at = {m, (x - grid[12]) * grid[13], (y - grid[14]) * grid[15]};
    return at;
}

/* The Earth's maps, see maps/ellipsoid.py; (-1, -1) where their polynomials do not hold. */
static inline struct place cell_by_polynomials(const double *grid, int64_t m, double east, double north, double up)
{
    const double x = (east / up - grid[2]) * grid[4], y = (north / up - grid[3]) * grid[5];
    struct place at = {m, -1.0, -1.0};
    if (!(up > 0.0 && fabs(x) <= 1.0 && fabs(y) <= 1.0))
        return at;
    const double *next = grid + 2 * FIRST_COEFFICIENT;
    at.column = at.row = 0.0;
    for (int64_t terms = 1; terms < (int64_t)grid[0] + 2; terms++) { /* Horner's rule in x, of polynomials in y */
        double a = 0.0, b = 0.0;
        for (int64_t k = 0; k < terms; k++, next += 2) {
            a = a * y + next[0];
            b = b * y + next[1];
        }
        at.column = at.column * x + a;
        at.row = at.row * x + b;
    }
    return at;
}

/* Where on map m the direction (east, north, up) from the sphere's centre points to, on the map or beyond. */
static inline struct place on_map(const struct ground *g, int64_t m, double east, double north, double up)
{
    const double *grid = g->grid + m * g->numbers * g->coordinates;
    return g->coordinates == 1 ? cell_by_projection(grid, m, east, north, up)
                               : cell_by_polynomials(grid, m, east, north, up);
}

/* The place on the finest map that reaches there. */
static inline struct place locate(const struct ground *g, double east, double north, double up)
{
    for (int64_t m = 0; m < g->maps; m++) {
        const struct place at = on_map(g, m, east, north, up);
        const int64_t *posts = g->posts + 3 * m;
        if (at.row >= 0.0 && at.row < (double)(posts[1] - 1) && at.column >= 0.0 && at.column < (double)(posts[2] - 1))
            return at;
    }
    const struct place nowhere = {-1, 0.0, 0.0};
    return nowhere;
}

/* Columns and rows per metre of a ray at a place, which goes on to (east, north, up) within `step`. */
static inline struct heading heading_to(const struct ground *g, struct place from, double step, double east,
                                        double north, double up)
{
    const struct place to = on_map(g, from.m, east, north, up);
    const struct heading found = {(to.column - from.column) / step, (to.row - from.row) / step};
    return found;
}

/* Height above the sphere of the ground in a cell. */
static inline double height_in_cell(const struct ground *g, int64_t m, int64_t i, int64_t j, double column, double row)
{
    const int64_t columns = g->posts[3 * m + 2];
    const double down = row - (double)i, right = column - (double)j;
    const float *at = g->heights + g->posts[3 * m] + i * columns + j;
    const double top = at[0] + right * (at[1] - at[0]);
    const double bottom = at[columns] + right * (at[columns + 1] - at[columns]);
    return top + down * (bottom - top);
}

/* Height in enu of the ground at (east, north), and its place; the guess where no map reaches. */
static inline double surface_place(const struct ground *g, double east, double north, double guess, struct place *at)
{
    const double level2 = east * east + north * north;
    double up = guess, before = guess + 1.0;
    for (int round = 0; round < FIXED_POINT_ROUNDS && fabs(up - before) > SETTLED_M; round++) {
        before = up;
        *at = locate(g, east, north, g->radius + up);
        if (at->m >= 0) {
            const double r = g->radius + height_in_cell(g, at->m, (int64_t)at->row, (int64_t)at->column, at->column,
                                                        at->row);
            up = sqrt(r * r - level2) - g->radius;
        }
    }
    return up;
}

static inline double surface(const struct ground *g, double east, double north, double guess)
{
    struct place at = {-1, 0.0, 0.0};
    return surface_place(g, east, north, guess, &at);
}

/* The same without a guess. */
static inline double surface_from_zero(const struct ground *g, double east, double north, struct place *at)
{
    return surface_place(g, east, north, surface_place(g, east, north, 0.0, at), at);
}

/* Ground at s along a ray. */
static inline struct mark mark_at(const struct ground *g, const struct ray *ray, double s, double guess)
{
    struct mark found = {s, guess, {-1, 0.0, 0.0}};
    found.z = surface_place(g, ray->east + s * ray->sin_a, ray->north + s * ray->cos_a, guess, &found.at);
    return found;
}

/* Height in enu of the ground `s` further along a ray than (east, north), where it is at `from` and goes on as `to`. */
static inline double height_on_line(const struct ground *g, const struct ray *ray, struct place from,
                                    struct heading to, double east, double north, double s)
{
    const double e = east + s * ray->sin_a, n = north + s * ray->cos_a;
    const double column = from.column + s * to.column, row = from.row + s * to.row;
    const int64_t *posts = g->posts + 3 * from.m; /* rounded, the line may end on the last post */
    const int64_t i = most(least((int64_t)row, posts[1] - 2), 0), j = most(least((int64_t)column, posts[2] - 2), 0);
    const double r = g->radius + height_in_cell(g, from.m, i, j, column, row);
    return sqrt(r * r - e * e - n * n) - g->radius;
}

/* Make (tan, at) the better of it and of the highest of the parabola through three heights z above the camera. */
static inline void take_best_of_step(double *tan, double *at, double s0, double s2, double z0, double z1, double z2)
{
    const double half = 0.5 * (s2 - s0);
    if (s0 > 0.0 && z0 > *tan * s0) {
        *tan = z0 / s0;
        *at = s0;
    }
    if (z1 > *tan * (s0 + half)) {
        *tan = z1 / (s0 + half);
        *at = s0 + half;
    }
    if (z2 > *tan * s2) {
        *tan = z2 / s2;
        *at = s2;
    }
    /* z = p + q s + k s^2 is seen highest where s^2 = p / k. */
    const double k = (z0 - 2 * z1 + z2) / (2 * half * half);
    if (!(k < 0.0))
        return;
    const double middle = s0 + half, q = (z2 - z0) / (2 * half) - 2 * k * middle;
    const double p = z1 - q * middle - k * middle * middle;
    if (!(p < 0.0))
        return;
    const double top = sqrt(p / k);
    if (s0 < top && top < s2 && p / top + q + k * top > *tan) {
        *tan = p / top + q + k * top;
        *at = top;
    }
}

/* Distance to the edge of the block of a level that holds a place, going `to`. */
static inline double exit_of(struct place from, struct heading to, int64_t level)
{
    const int64_t size = (int64_t)1 << level;
    const int64_t j = ((int64_t)from.column >> level) << level, i = ((int64_t)from.row >> level) << level;
    double s = FAR_M;
    if (to.column > 0.0)
        s = smaller(((double)(j + size) - from.column) / to.column, s);
    else if (to.column < 0.0)
        s = smaller(((double)j - from.column) / to.column, s);
    if (to.row > 0.0)
        s = smaller(((double)(i + size) - from.row) / to.row, s);
    else if (to.row < 0.0)
        s = smaller(((double)i - from.row) / to.row, s);
    return greater(0.0, s) + NUDGE_M;
}

/* The number of the block of a level that holds a place on a map. */
static inline int64_t block_at(const struct ground *g, struct place at, int64_t level)
{
    const int64_t *block = g->blocks + 3 * (at.m * g->most_levels + level);
    return block[0] + ((int64_t)at.row >> level) * block[2] + ((int64_t)at.column >> level);
}

/* Whether ground `raised` [m] above the map is below a sight line over a block; then `level` is the next one to try.
   Blocks are tried from `level` down. The sight line is at a `height` and climbs by `climb` per metre. The way out is
   that to the edge of the block that is stepped over, else of the cell. */
static inline bool is_below_sight(const struct ground *g, struct place at, struct heading to, double height,
                                  double climb, double raised, int64_t *level, double *way_out)
{
    bool is_over = false;
    int64_t next = *level;
    *way_out = 0.0;
    while (!is_over && next >= 0) {
        *way_out = exit_of(at, to, next);
        is_over = height + smaller(0.0, climb * *way_out) >= (double)g->tops[block_at(g, at, next)] + raised;
        next += is_over ? 1 : -1;
    }
    *level = most(next, 0);
    return is_over;
}

/* horizons.c: the horizon of a camera along a ray. */
struct crest horizon(const struct ground *g, const struct ray *ray, struct stretch where);

#endif
