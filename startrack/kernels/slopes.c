/* Slopes and heights of height maps over blocks of cells, bands and boxes. */

#include "bounds.h"

#define SHIFT_HEIGHT_M 1000.0 /* height of a sight line above the ground that its place on the map allows for */
#define MAX_TOUCHED 25        /* cells of a part */
#define TOUCH_MARGIN 0.02     /* of a cell: more than maps bend over a step */
#define ALONG 1e-12           /* cells per metre, below which a ray keeps to its row or column */
#define BOX_STEPS 8           /* steps along each side of a box */

double steepness(const struct ground *g, int64_t m, int64_t at, struct heading to)
{
    const int8_t *slopes = g->slopes + 8 * at;
    const double a = fabs(to.column), b = fabs(to.row);
    const int straight = a >= b ? (to.column > 0.0 ? 4 : 0) : (to.row > 0.0 ? 5 : 1);
    const int slanted = to.column * to.row >= 0.0 ? (to.row + to.column > 0.0 ? 6 : 2) : (to.row > 0.0 ? 7 : 3);
    return g->slope_unit[m] * (fabs(a - b) * slopes[straight] + smaller(b, a) * slopes[slanted]);
}

int64_t level_of(const struct ground *g, int64_t m, double width, double east, double north)
{
    const double shift = SHIFT_HEIGHT_M * sqrt(east * east + north * north) / g->radius; /* by a km of height */
    const double across = (1.05 * width + shift) / g->post_m[m] + 1e-6;
    int64_t level = 0;
    while ((double)((int64_t)1 << level) < across && level < g->levels[m] - 1)
        level++;
    return level;
}

/* Narrow a range of distances to those at which a band, `side` wide, touches a cell, seen x cells from its edge. */
static void narrow(double x, double per_m, double side, double *first, double *last)
{
    if (!(fabs(per_m) > ALONG))
        return;
    const double a = (-side - x) / per_m, b = (1 + side - x) / per_m;
    *first = greater(smaller(b, a), *first);
    *last = smaller(greater(b, a), *last);
}

/* The least and the most of `least_rise` and `most_rise` and of the rise to the side in a bilinear cell, which is
   linear in column and row: its extremes are at the ends of the part of the segment whose band touches the cell. */
static void take_cell(const float *at, int64_t columns, double x, double y, struct heading to, struct heading aside,
                      double width, double first, double last, double *least_rise, double *most_rise)
{
    const float twist = at[0] - at[1] - at[columns] + at[columns + 1];
    const double straight =
        aside.column * (at[1] - at[0] + twist * y) + aside.row * (at[columns] - at[0] + twist * x);
    const double along = twist * (aside.column * to.row + aside.row * to.column);
    const double beside = 2 * fabs(twist * aside.column * aside.row) * width
                          + fabsf(twist) * TOUCH_MARGIN * (fabs(aside.column) + fabs(aside.row));
    *least_rise = smaller(straight + smaller(along * last, along * first) - beside, *least_rise);
    *most_rise = greater(straight + greater(along * last, along * first) + beside, *most_rise);
}

bool slope_range(const struct ground *g, struct place from, struct heading to, double begin, double end,
                 struct heading aside, double width, double *least_rise, double *most_rise)
{
    const int64_t *posts = g->posts + 3 * from.m, rows = posts[1], columns = posts[2];
    const double side_column = width * fabs(aside.column) + TOUCH_MARGIN;
    const double side_row = width * fabs(aside.row) + TOUCH_MARGIN;
    const double west = floor(from.column + smaller(to.column * end, to.column * begin) - side_column);
    const double east = floor(from.column + greater(to.column * end, to.column * begin) + side_column);
    const double top = floor(from.row + smaller(to.row * end, to.row * begin) - side_row);
    const double bottom = floor(from.row + greater(to.row * end, to.row * begin) + side_row);
    const bool is_inside = west >= 0.0 && top >= 0.0 && east < (double)(columns - 1) && bottom < (double)(rows - 1);
    if (!is_inside || (east - west + 1.0) * (bottom - top + 1.0) > MAX_TOUCHED)
        return false;
    *least_rise = INFINITY;
    *most_rise = -INFINITY;
    for (int64_t i = (int64_t)top; i <= (int64_t)bottom; i++) {
        for (int64_t j = (int64_t)west; j <= (int64_t)east; j++) {
            const double x = from.column - (double)j, y = from.row - (double)i;
            double first = begin, last = end;
            narrow(x, to.column, side_column, &first, &last);
            narrow(y, to.row, side_row, &first, &last);
            if (first <= last)
                take_cell(g->heights + posts[0] + i * columns + j, columns, x, y, to, aside, width, first, last,
                          least_rise, most_rise);
        }
    }
    return *least_rise <= *most_rise;
}

/* Corner of a box, of four: -1 or 1 to the east and to the north. */
static double corner_east(int corner)
{
    return 2 * (corner & 1) - 1;
}

static double corner_north(int corner)
{
    return corner - (corner & 1) - 1;
}

/* Height of the ground at (east, north) relative to the plane of a box; `middle`: in its middle. */
static double height_on_plane(const struct ground *g, const struct box *box, double middle, double east, double north,
                              struct place *at)
{
    const double z = surface_place(g, east, north, middle, at);
    return z - box->slope_e * (east - box->east) - box->slope_n * (north - box->north);
}

/* What a box's ground between the places that were tried may be higher or lower: by the steepest slopes, relative to
   the plane. `step`: between places. */
static double slack_of_box(const struct ground *g, const struct box *box, double middle, double step)
{
    const struct place at = locate(g, box->east, box->north, g->radius + middle);
    if (at.m < 0)
        return 2 * box->half;
    const double post_m = g->post_m[at.m], half = box->half;
    const int64_t block = block_at(g, at, level_of(g, at.m, 1.5 * half, box->east, box->north));
    double to_east = 0.0, to_north = 0.0;
    for (int side = -1; side < 2; side += 2) {
        const struct heading by_east =
            heading_to(g, at, post_m, box->east + side * post_m, box->north, g->radius + middle);
        const struct heading by_north =
            heading_to(g, at, post_m, box->east, box->north + side * post_m, g->radius + middle);
        const double east = steepness(g, at.m, block, by_east), north = steepness(g, at.m, block, by_north);
        to_east = greater(fabs(east - box->slope_e * side) + 0.03 * fabs(east), to_east);
        to_north = greater(fabs(north - box->slope_n * side) + 0.03 * fabs(north), to_north);
    }
    return (to_east + to_north) * step / 2 + half * half / g->radius
           + half * (fabs(box->east) + fabs(box->north)) / g->radius;
}

struct box box_at(const struct ground *g, double east, double north, double half, double camera_height, bool is_tilted)
{
    struct box box = {east, north, half, camera_height, 0.0, 0.0, 0.0, 0.0, 0.0};
    struct place at = {-1, 0.0, 0.0}, first = at;
    const double middle = surface_from_zero(g, east, north, &at);
    for (int corner = 0; corner < 4 && is_tilted && half > 0.0; corner++) {
        const double to_e = corner_east(corner), to_n = corner_north(corner);
        const double z = surface(g, east + half * to_e, north + half * to_n, middle);
        box.slope_e += to_e * z / (4 * half);
        box.slope_n += to_n * z / (4 * half);
    }
    double low = middle, high = middle, wide_column = 0.0, wide_row = 0.0;
    bool is_one_cell = true;
    for (int corner = 0; corner < 4; corner++) {
        const double e = east + half * corner_east(corner), n = north + half * corner_north(corner);
        const double z = surface(g, e, n, middle), level = box.slope_e * (e - east) + box.slope_n * (n - north);
        at = locate(g, e, n, g->radius + z);
        low = smaller(z - level, low);
        high = greater(z - level, high);
        first = corner == 0 ? at : first;
        wide_column = greater(fabs(at.column - first.column), wide_column);
        wide_row = greater(fabs(at.row - first.row), wide_row);
        is_one_cell = is_one_cell && at.m >= 0 && at.m == first.m && (int64_t)at.row == (int64_t)first.row
                      && (int64_t)at.column == (int64_t)first.column;
    }
    double slack;
    if (is_one_cell) { /* a bilinear patch: nothing inside exceeds the corners by more than its twist allows */
        const int64_t *posts = g->posts + 3 * first.m, columns = posts[2];
        const float *cell = g->heights + posts[0] + (int64_t)first.row * columns + (int64_t)first.column;
        const float twist = fabsf(cell[0] - cell[1] - cell[columns] + cell[columns + 1]);
        slack = twist * wide_column * wide_row / 2 + half * half / g->radius;
    } else {
        const double step = 2 * half / BOX_STEPS;
        for (int i = 0; i <= BOX_STEPS; i++) {
            for (int j = 0; j <= BOX_STEPS; j++) {
                const double z = height_on_plane(g, &box, middle, east - half + step * i, north - half + step * j, &at);
                low = smaller(z, low);
                high = greater(z, high);
            }
        }
        slack = slack_of_box(g, &box, middle, step);
    }
    box.up = middle + camera_height;
    box.low_up = low - slack + camera_height;
    box.high_up = high + slack + camera_height;
    return box;
}
