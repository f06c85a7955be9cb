/* Horizons traced ray by ray, or interpolated between traced ones.

   The horizon is the largest tan = (z(s) - z(camera)) / s over the ground's heights z(s) in enu. The ray goes from
   crossing to crossing of the map's grid lines; blocks of cells that lie wholly below the sight line to the best
   horizon so far are stepped over at once. */

#include "ground.h"

#define FIRST_GUESS_M 300.0
#define LAST_GUESS_M 50000.0
#define GUESS_RATIO 1.12

/* A first sight line over the ground about the hint, or over a row of places. It lets most blocks be stepped over. */
static void take_first_sight(const struct ground *g, const struct ray *ray, const struct stretch *where,
                             struct crest *best)
{
    const bool has_hint = where->hint > 0.0;
    const double end = smaller(has_hint ? FAR_M : LAST_GUESS_M, where->end);
    double guess = has_hint ? where->hint : greater(FIRST_GUESS_M, where->begin), z = ray->up;
    while (where->begin < guess && guess < end) {
        const double found = mark_at(g, ray, guess, z).z, before = z;
        z = isnan(found) ? before : found; /* NaN: a void */
        const double above = z - ray->up + g->sag * guess * guess;
        if (z != before && above > best->tan * guess) { /* no change: the maps do not reach there */
            best->tan = above / guess;
            best->at = guess;
        }
        guess = has_hint ? FAR_M : guess * GUESS_RATIO;
    }
    if (best->tan == LOWEST_TAN && where->begin > 0.0) { /* a sight line straight down would not get far */
        const double found = mark_at(g, ray, where->begin, z).z;
        if (found != z && !isnan(found)) {
            best->tan = (found - ray->up) / where->begin + g->sag * where->begin;
            best->at = where->begin;
        }
    }
}

/* Take the ground of a step from s on, of a `length`; false where it has a void. `known` is its last place before, and
   becomes its end. */
static bool take_step(const struct ground *g, const struct ray *ray, double s, double length, double guess,
                      struct mark *known, struct crest *best)
{
    const double e = ray->east + s * ray->sin_a, n = ray->north + s * ray->cos_a, half = 0.5 * length;
    if (known->s != s)
        known->z = surface_place(g, e, n, guess, &known->at);
    struct mark end = {s + length, 0.0, {-1, 0.0, 0.0}};
    end.z = surface_place(g, e + length * ray->sin_a, n + length * ray->cos_a, known->z, &end.at);
    double z;
    if (end.at.m == known->at.m && end.at.m >= 0) {
        const struct heading to = {(end.at.column - known->at.column) / length, (end.at.row - known->at.row) / length};
        z = height_on_line(g, ray, known->at, to, e, n, half);
    } else {
        z = surface(g, e + half * ray->sin_a, n + half * ray->cos_a, 0.5 * (known->z + end.z));
    }
    if (isnan(known->z + z + end.z))
        return false;
    const double middle = s + half, stop = s + length;
    const double a = known->z + g->sag * s * s, b = end.z + g->sag * stop * stop, c = z + g->sag * middle * middle;
    take_best_of_step(&best->tan, &best->at, s, stop, a - ray->up, c - ray->up, b - ray->up);
    *known = end;
    return true;
}

struct crest horizon(const struct ground *g, const struct ray *ray, struct stretch where)
{
    struct crest best = {LOWEST_TAN, where.begin, FAR_M};
    take_first_sight(g, ray, &where, &best);
    struct mark known = {-1.0, ray->up, {-1, 0.0, 0.0}};
    struct heading to = {0.0, 0.0};
    double s = where.begin, straight_to = -1.0, straight_tan = best.tan;
    int64_t level = 0, straight_map = -1;
    while (s < where.end) {
        const double e = ray->east + s * ray->sin_a, n = ray->north + s * ray->cos_a;
        const double z = g->radius + ray->up + best.tan * s - g->sag * s * s; /* of the sight line, from the centre */
        const struct place at = locate(g, e, n, z);
        const double r = sqrt(e * e + n * n + z * z);
        const double climb = (e * ray->sin_a + n * ray->cos_a + z * (best.tan - 2 * g->sag * s)) / r;
        if (at.m < 0) {
            best.edge = s;
            break;
        }
        if (climb >= 0.0 && r - g->radius >= g->highest)
            break;
        if (s > straight_to || at.m != straight_map || best.tan != straight_tan) {
            const double step = g->post_m[at.m], rise = greater(-1.0, best.tan);
            to = heading_to(g, at, step, e + step * ray->sin_a, n + step * ray->cos_a, z + step * rise);
            straight_map = at.m;
            straight_tan = best.tan;
            straight_to = s + STRAIGHT_M;
        }
        double length;
        level = least(level, g->levels[at.m] - 1);
        if (!is_below_sight(g, at, to, r - g->radius, climb, 0.0, &level, &length)
            && !take_step(g, ray, s, length, z - g->radius, &known, &best)) {
            best.edge = s; /* a void: as where the maps end */
            break;
        }
        s += length;
    }
    return best;
}

void surfaces(int64_t n, const struct ground *restrict ground, const double *restrict points, double *restrict up)
{
    struct place at = {-1, 0.0, 0.0};
    for (int64_t k = 0; k < n; k++)
        up[k] = surface_from_zero(ground, points[2 * k], points[2 * k + 1], &at);
}

/* A value at (x, y), in steps from the first, of those at nodes [across, across]; beyond them as at the edge. */
static double bilinear(const double *nodes, int64_t across, double x, double y)
{
    const double last = (double)(across - 2); /* NaN: the first node */
    const double i = smaller(greater(floor(x), 0.0), last), j = smaller(greater(floor(y), 0.0), last);
    const double *west = nodes + (int64_t)i * across + (int64_t)j, *east = west + across;
    const double of_west = west[0] + (y - j) * (west[1] - west[0]);
    const double of_east = east[0] + (y - j) * (east[1] - east[0]);
    return of_west + (x - i) * (of_east - of_west);
}

void interpolate_horizons(int64_t azimuths, int64_t across, int64_t n, int64_t rows, int64_t m,
                          const struct ground *restrict ground, const double *restrict nodes,
                          const double *restrict per_height, double middle, double east, double north, double half,
                          const double *restrict points, const int64_t *restrict column, double *restrict found)
{
    (void)azimuths;
    const double scale = (double)(across - 1) / (2 * half);
    struct place at = {-1, 0.0, 0.0};
    double up = 0.0;
    for (int64_t k = 0; k < n; k++) {
        const double *point = points + 2 * k;
        if (k == 0 || point[0] != point[-2] || point[1] != point[-1])
            up = surface_from_zero(ground, point[0], point[1], &at);
        const double x = (point[0] - east + half) * scale, y = (point[1] - north + half) * scale;
        const int64_t *own = column + least(k, rows - 1) * m;
        for (int64_t a = 0; a < m; a++)
            found[k * m + a] = atan(bilinear(nodes + own[a] * across * across, across, x, y)
                                    - (up - middle) * per_height[own[a]]);
    }
}

void horizons_of_circle(int64_t n, int64_t m, const double *restrict points, const double *restrict sines,
                        const double *restrict cosines, double radius, double wall, double *restrict found)
{
    for (int64_t k = 0; k < n; k++) {
        const double x = points[2 * k], y = points[2 * k + 1], inner = radius * radius - x * x - y * y;
        for (int64_t a = 0; a < m; a++) {
            const double along = x * sines[a] + y * cosines[a];
            const double distance = inner > 0.0 ? greater(0.0, sqrt(along * along + inner) - along) : 0.0;
            found[k * m + a] = atan2(wall, distance);
        }
    }
}
