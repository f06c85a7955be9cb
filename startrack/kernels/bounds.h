/* Boxes on the ground of height maps, and bounds of the horizon over them. */

#ifndef STARTRACK_BOUNDS_H
#define STARTRACK_BOUNDS_H

#include "ground.h"

/* A box of places of a camera. Heights are in enu, the lowest and highest ones relative to a plane through its
   middle. */
struct box {
    double east, north, half; /* of its middle; half its side */
    double camera_height, up; /* above the ground; in the middle */
    double low_up, high_up;   /* of a camera anywhere in it */
    double slope_e, slope_n;  /* of the plane to the east and to the north */
};

/* Rays from a box: their middle azimuth, the turn to each side, and the part of them whose ground counts. */
struct beam {
    double sin_a, cos_a, turn;
    struct stretch where;
};

/* What bounds of the horizon over a box give, in the order of a table's fields; see `fill_cells`. */
#define BOUNDS 11

/* slopes.c: the box about a place. `is_tilted`: the plane fits its corners; else it is level. */
struct box box_at(const struct ground *g, double east, double north, double half, double camera_height, bool is_tilted);

/* slopes.c: most rise per metre in block `at` of map m and in its neighbours, going `to`. */
double steepness(const struct ground *g, int64_t m, int64_t at, struct heading to);

/* slopes.c: lowest level of map m whose blocks' neighbours reach `width` to the side, at (east, north). */
int64_t level_of(const struct ground *g, int64_t m, double width, double east, double north);

/* slopes.c: least and most rise per metre to the side (`aside` per metre) in a band that reaches `width` to each side
   of the segment which begins and ends at these distances from a place, going `to`. False where the band leaves the
   map or touches many cells. */
bool slope_range(const struct ground *g, struct place from, struct heading to, double begin, double end,
                 struct heading aside, double width, double *least_rise, double *most_rise);

/* bounds.c: fill `found` [BOUNDS]. */
void bounds(const struct ground *g, struct box box, const struct beam *beam, bool tilts_to_crest, double *found);

#endif
