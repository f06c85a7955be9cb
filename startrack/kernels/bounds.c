/* Bounds of the horizon over boxes, by the rays of horizons.c.

   A ray from anywhere in a box passes near the middle line: the steepest slopes to the side bound the ground there.
   Over a block of cells as large as the band is wide the slopes are the same, and the line is straight on the map.

   A ray passes the middle line's point s within w = r + (s + r) tan(turn) to the side, at a distance between s - r and
   (s + r) / cos(turn) of its own, r the half width of the box seen along the ray. There the ground is within w times
   the steepest slope to the side of what it is on the middle line. What air makes of the distance s counts as height of
   the ground; of the ray's own distance it differs by `bent` at most. Close to the box the horizon is no higher than
   the steepest slope along the ray, less what the height of the camera makes of it.

   All heights are relative to the plane of the box: a tangent then is less by the plane's own rise along the ray. */

#include "bounds.h"

#define FINE_POSTS 1.2 /* posts: of narrower bands slopes are taken cell by cell */
#define KINK_M 0.02    /* by which a traced ray may miss a kink of the ground: NUDGE_M times the change of slope */
#define STEP_PARTS 4   /* of a step, whose slopes are taken one by one */
#define NEAR_REACHES 6.0
#define CELL_BEND 0.005 /* by which the direction of a ray on the map changes within a step */

/* Rays from a box as they are followed: numbers that do not change from step to step. */
struct view {
    const struct ground *g;
    struct ray ray; /* the middle one */
    struct crest middle;
    double camera_height, low_up, high_up;
    double reach, tan_turn, cos_turn;
    double aside;                 /* from the middle line to the origin of enu */
    double along_rise, side_rise; /* of the plane */
    double sink;                  /* `sag`, or 0 if lines bend upwards */
    double begin, end;
    bool is_whole; /* the ground from the box on counts */
    bool is_fine;  /* slopes are taken cell by cell where the band is narrow */
};

/* What was found so far. */
struct envelope {
    double low, low_s, low_z, low_rise; /* the highest tangent that is sure, and the place that makes it so */
    double high;
    double first, last; /* range of s of the ground that may make the horizon */
    double line_from;   /* that ground is no higher than this above the middle's sight line */
    double most_rise;   /* to the side */
};

/* Where the rays are. `is_probe`: one step at the middle's own horizon gives a lower bound, which lets much be
   skipped. */
struct walk {
    bool is_probe;
    double s;
    int64_t level;
    struct mark known; /* the last place whose ground was worked out */
    struct heading to, aside;
    int64_t straight_map, known_block;
    double straight_to, straight_low;
    double right, left, ahead; /* steepest slopes in the block */
    double steepest;           /* along the ray, from the box's near side on */
};

/* A step: the band at its begin, the lowest sight line above the sphere there, and the steepest slopes. */
struct step {
    struct place at;
    double east, north, width, floor, climb;
    int64_t least_level;
    bool is_near;
    double bend, rise_aside, span;
};

/* Heights along the middle line, at begin, middle and end of a piece of it. */
struct arc {
    double s[3], z[3];
};

/* Tangents that bound those of an arc, and the distance and height of the lower one. */
struct limits {
    double top, bottom, bottom_s, bottom_z;
};

/* Largest tangent of a height above the lowest camera, at s from the middle of the box. */
static double most_tan(const struct view *v, double above, double s)
{
    if (above > 0.0)
        return s > v->reach ? above / (s - v->reach) : FAR_M;
    return s > -v->reach ? above * v->cos_turn / (s + v->reach) : -FAR_M;
}

/* Least tangent of a height above the highest camera. */
static double least_tan(const struct view *v, double above, double s)
{
    if (above > 0.0)
        return above * v->cos_turn / (s + v->reach);
    return s > v->reach ? above / (s - v->reach) : LOWEST_TAN;
}

/* Limits of an arc; the ground beside the middle line differs by up to `slack`. */
static struct limits limits_of(const struct view *v, const struct arc *arc, double slack)
{
    const double *s = arc->s, *z = arc->z, lowest = smaller(z[2], smaller(z[1], z[0]));
    struct limits found = {-FAR_M, LOWEST_TAN, 0.0, 0.0};
    if (lowest + slack > v->low_up && s[0] > v->reach) {
        const double rest = slack - v->low_up;
        double at = 0.0;
        take_best_of_step(&found.top, &at, s[0] - v->reach, s[2] - v->reach, z[0] + rest, z[1] + rest, z[2] + rest);
    } else {
        const double over = slack + greater(0.0, 2 * z[1] - z[0] - z[2]) / 8;
        for (int k = 0; k < 3; k++) {
            const double tan = most_tan(v, z[k] + over - v->low_up, s[k]);
            found.top = k == 0 ? tan : greater(tan, found.top);
        }
    }
    const double rest = slack + v->high_up;
    if (lowest > rest && s[0] > 0.0) {
        double tan = -FAR_M, at = 0.0;
        take_best_of_step(&tan, &at, s[0] + v->reach, s[2] + v->reach, z[0] - rest, z[1] - rest, z[2] - rest);
        found.bottom = tan * v->cos_turn;
        found.bottom_s = at - v->reach;
        found.bottom_z = tan * at + v->high_up;
        return found;
    }
    for (int k = 0; k < 3; k++) {
        const double tan = least_tan(v, z[k] - slack - v->high_up, s[k]);
        if (s[k] > 0.0 && tan > found.bottom) {
            found.bottom = tan;
            found.bottom_s = s[k];
            found.bottom_z = z[k] - slack;
        }
    }
    return found;
}

/* The plane through the box and the middle's horizon, tilted to the side as the ground is there. The linear change of
   the horizon over the box is then that of the camera's height above this plane, whose bounds over a box are exact:
   h (|dz/de| + |dz/dn|). */
static void tilt_to_crest(const struct view *v, struct box *box)
{
    const struct ray *ray = &v->ray;
    const double at = v->middle.at, tan = v->middle.tan, width = v->reach + (at + v->reach) * v->tan_turn;
    const double e = ray->east + at * ray->sin_a, n = ray->north + at * ray->cos_a;
    const double left = surface(v->g, e - width * ray->cos_a, n + width * ray->sin_a, ray->up + tan * at);
    const double right = surface(v->g, e + width * ray->cos_a, n - width * ray->sin_a, left);
    const double side_rise = (right - left) / (2 * width);
    const double to_e = tan * ray->sin_a + side_rise * ray->cos_a, to_n = tan * ray->cos_a - side_rise * ray->sin_a;
    const double spread = box->half * (fabs(box->slope_e - to_e) + fabs(box->slope_n - to_n));
    box->low_up -= spread;
    box->high_up += spread;
    box->slope_e = to_e;
    box->slope_n = to_n;
}

static struct view view_of(const struct ground *g, struct box *box, const struct beam *beam, bool tilts_to_crest)
{
    const double sin_a = beam->sin_a, cos_a = beam->cos_a;
    const struct stretch where = {greater(0.0, beam->where.begin), beam->where.end, beam->where.hint};
    struct view v = {
        .g = g, .ray = {box->east, box->north, box->up, sin_a, cos_a}, .camera_height = box->camera_height,
        .reach = box->half * (fabs(sin_a) + fabs(cos_a)), .tan_turn = tan(beam->turn), .cos_turn = cos(beam->turn),
        .aside = fabs(box->east * cos_a - box->north * sin_a), .sink = greater(0.0, g->sag),
        .end = beam->where.end, .is_whole = beam->where.begin <= 0.0, .is_fine = tilts_to_crest,
    };
    v.middle = horizon(g, &v.ray, where);
    v.begin = v.is_whole ? -v.reach : beam->where.begin;
    if (tilts_to_crest && box->half > 0.0 && v.middle.tan > LOWEST_TAN)
        tilt_to_crest(&v, box);
    v.low_up = box->low_up;
    v.high_up = box->high_up;
    v.along_rise = box->slope_e * sin_a + box->slope_n * cos_a;
    v.side_rise = box->slope_e * cos_a - box->slope_n * sin_a;
    return v;
}

/* Begin a step: the band there, and the lowest sight line that matters. False where no further ground does. */
static bool begin_step(const struct view *v, const struct envelope *found, struct walk *w, struct step *step,
                       double *line)
{
    const struct ground *g = v->g;
    const struct ray *ray = &v->ray;
    const double s = w->s, low = found->low, e = ray->east + s * ray->sin_a, n = ray->north + s * ray->cos_a;
    const double width = v->reach + (fabs(s) + v->reach) * v->tan_turn, tilted = fabs(v->side_rise);
    if (w->is_probe) {
        w->known.z = surface(g, e, n, w->known.z);
        *line = g->radius + w->known.z;
    } else {
        const double far = (fabs(s) + v->reach) / v->cos_turn, near = greater(0.0, s - v->reach);
        const double own_most = (s + v->reach) / v->cos_turn; /* distance of this ground from a camera in the box */
        *line = g->radius + v->low_up + low * (low >= 0.0 ? near : far);
        *line += v->along_rise * s - tilted * width - v->sink * own_most * own_most;
    }
    const double r = sqrt(e * e + n * n + *line * *line);
    const double fall = 2 * v->sink * (s + v->reach) / (v->cos_turn * v->cos_turn);
    const double rise = low + v->along_rise - tilted * v->tan_turn - fall;
    step->at = locate(g, e, n, *line);
    step->east = e;
    step->north = n;
    step->width = width;
    step->climb = (e * ray->sin_a + n * ray->cos_a + *line * rise) / r;
    step->floor = r - g->radius - (v->aside + width) / g->radius * width;
    if (step->at.m < 0)
        return false;
    return w->is_probe || !(s >= v->end || (step->climb >= 0.0 && step->floor >= g->highest && s > v->reach));
}

/* Which way the ray and its sides go on the map, unless that is known. */
static void find_headings(const struct view *v, const struct envelope *found, struct walk *w, const struct step *step,
                          double line)
{
    const struct place at = step->at;
    if (!(w->s > w->straight_to || at.m != w->straight_map || found->low != w->straight_low))
        return;
    const double post_m = v->g->post_m[at.m], rise = greater(-1.0, found->low + v->along_rise);
    const double sin_m = post_m * v->ray.sin_a, cos_m = post_m * v->ray.cos_a;
    w->to = heading_to(v->g, at, post_m, step->east + sin_m, step->north + cos_m, line + rise * post_m);
    w->aside = heading_to(v->g, at, post_m, step->east + cos_m, step->north - sin_m, line);
    w->straight_map = at.m;
    w->straight_low = found->low;
    w->straight_to = w->s + STRAIGHT_M;
    w->known_block = -1;
}

/* Step over a block that lies with its neighbours below all sight lines that matter; false where none does. */
static bool step_over(const struct view *v, struct walk *w, struct step *step)
{
    const struct ground *g = v->g;
    const struct place at = step->at;
    step->least_level = level_of(g, at.m, step->width * (1 + 3 * v->tan_turn), step->east, step->north);
    step->is_near = v->is_whole && w->s < NEAR_REACHES * v->reach && !w->is_probe;
    if (step->is_near || w->is_probe) {
        w->level = step->least_level;
        return false;
    }
    w->level = least(most(w->level, step->least_level), g->levels[at.m] - 1);
    for (;; w->level--) {
        const double length = exit_of(at, w->to, w->level);
        if (step->floor + smaller(0.0, step->climb * length) >= (double)g->wide_tops[block_at(g, at, w->level)]) {
            w->s += length;
            w->level++;
            return true;
        }
        if (w->level <= step->least_level)
            return false;
    }
}

/* The steepest slopes of the block, and the most rise to the side that they allow over the step. */
static void bound_slopes(const struct view *v, struct walk *w, struct step *step)
{
    const struct ground *g = v->g;
    const int64_t m = step->at.m, block = block_at(g, step->at, step->least_level);
    const struct heading aside = w->aside, back = {-aside.column, -aside.row};
    if (block != w->known_block) {
        w->right = steepness(g, m, block, aside);
        w->left = steepness(g, m, block, back);
        w->ahead = steepness(g, m, block, w->to);
        w->known_block = block;
    }
    const double to_side = greater(0.0, greater(w->left + v->side_rise, w->right - v->side_rise));
    const double steep = greater(fabs(w->left), fabs(w->right)), width = step->width;
    step->bend = sqrt(step->east * step->east + step->north * step->north) / g->radius;
    step->rise_aside = to_side + steep * (CELL_BEND + 2 * step->bend)
                       + (v->aside + width + step->span * v->tan_turn) / g->radius;
    if (step->is_near) {
        const double along =
            fabs(w->ahead) * (2 * CELL_BEND + 2 * step->bend) + step->bend + width / g->radius + steep * v->tan_turn;
        w->steepest = greater(w->ahead - v->along_rise + along, w->steepest);
    }
}

/* Count the tangents of an arc, whose ground rises by up to `rise` to the side. */
static void take_arc(const struct view *v, const struct walk *w, const struct step *step, const struct arc *arc,
                     struct limits limits, double rise, double bent, struct envelope *found)
{
    const double *s = arc->s, *z = arc->z;
    if (limits.bottom > found->low) {
        found->low = limits.bottom;
        found->low_s = limits.bottom_s;
        found->low_z = limits.bottom_z;
        found->low_rise = rise;
    }
    const double own_most = s[2] + v->reach;
    if (step->is_near)
        limits.top = smaller(
            w->steepest + v->sink * own_most / v->cos_turn - v->camera_height * v->cos_turn / own_most, limits.top);
    if (w->is_probe || !(limits.top >= found->low && s[2] > -v->reach))
        return;
    found->first = smaller(s[0], found->first);
    found->last = greater(s[2], found->last);
    found->high = greater(limits.top, found->high);
    found->most_rise = greater(rise, found->most_rise);
    const double over = greater(0.0, 2 * z[1] - z[0] - z[2]) / 8 + bent;
    for (int k = 0; k < 3; k++)
        found->line_from = greater(over + z[k] - v->middle.tan * s[k], found->line_from);
}

/* Count an arc in parts, each with the slopes of the cells that its band touches. `place`: of its begin. */
static void take_parts(const struct view *v, const struct walk *w, const struct step *step, const struct arc *whole,
                       struct place place, double bent, struct envelope *found)
{
    const double *z = whole->z, length = whole->s[2] - whole->s[0], width = step->width;
    const double bend = (z[0] - 2 * z[1] + z[2]) * 2 / (length * length), rise = (z[2] - z[0]) / length - bend * length;
    for (int k = 0; k < STEP_PARTS; k++) {
        const double begin = length * k / STEP_PARTS, end = length * (k + 1) / STEP_PARTS;
        const double at[3] = {begin, 0.5 * (begin + end), end};
        struct arc part;
        for (int i = 0; i < 3; i++) {
            part.s[i] = whole->s[0] + at[i];
            part.z[i] = z[0] + at[i] * (rise + at[i] * bend);
        }
        double least_rise, most_rise, aside = step->rise_aside;
        if (place.m == step->at.m
            && slope_range(v->g, place, w->to, begin, end, w->aside, width, &least_rise, &most_rise)) {
            const double to_side = greater(0.0, greater(v->side_rise - least_rise, most_rise - v->side_rise));
            const double steep = greater(fabs(most_rise), fabs(least_rise));
            const double own = to_side + (steep * (CELL_BEND + 2 * step->bend) + (v->aside + width) / v->g->radius);
            aside = smaller(step->rise_aside, own);
        }
        const double slack = aside * width + (KINK_M * smaller(1.0, width) + bent);
        take_arc(v, w, step, &part, limits_of(v, &part, slack), aside, bent, found);
    }
}

/* Count a piece of the step between grid lines, with heights z at its begin, middle and end. `place`: of its begin. */
static void take_piece(const struct view *v, const struct walk *w, const struct step *step, double begin, double end,
                       const double *z, struct place place, double bent, struct envelope *found)
{
    const double at[3] = {begin, begin + 0.5 * (end - begin), end};
    struct arc arc;
    for (int k = 0; k < 3; k++) {
        arc.s[k] = w->s + at[k];
        arc.z[k] = z[k] - v->along_rise * arc.s[k] + v->g->sag * arc.s[k] * arc.s[k];
    }
    const struct limits limits = limits_of(v, &arc, step->rise_aside * step->width + bent);
    if (v->is_fine && limits.top >= found->low && step->width < FINE_POSTS * v->g->post_m[step->at.m])
        take_parts(v, w, step, &arc, place, bent, found);
    else
        take_arc(v, w, step, &arc, limits, step->rise_aside, bent, found);
}

/* The ground at the end of the step, which is short where it does not lie on the map of its begin; its length. */
static struct mark end_of_step(const struct view *v, const struct walk *w, struct step *step, int64_t *level)
{
    *level = w->is_probe ? 0 : step->least_level;
    for (;; *level = 0) {
        step->span = exit_of(step->at, w->to, *level);
        const struct ray from = {step->east, step->north, 0.0, v->ray.sin_a, v->ray.cos_a};
        struct mark end = mark_at(v->g, &from, step->span, w->known.z);
        end.s = w->s + step->span;
        if (*level == 0 || (end.at.m == w->known.at.m && end.at.m >= 0))
            return end;
    }
}

/* Count the ground of a step, from grid line to grid line; the place of its end becomes known. */
static void take_ground(const struct view *v, struct walk *w, struct step *step, struct envelope *found)
{
    const struct ground *g = v->g;
    const double e = step->east, n = step->north;
    if (w->known.s != w->s)
        w->known.z = surface_place(g, e, n, w->known.z, &w->known.at);
    const struct mark known = w->known;
    int64_t level;
    const struct mark end = end_of_step(v, w, step, &level);
    bound_slopes(v, w, step);
    const double span = step->span;
    const struct heading run = {(end.at.column - known.at.column) / span, (end.at.row - known.at.row) / span};
    const bool is_on_line = end.at.m == known.at.m && end.at.m >= 0, is_always_open = step->is_near || w->is_probe;
    const double floor = step->floor + fabs(v->side_rise) * step->width;
    double begun = 0.0, z_begun = known.z;
    bool is_known = true;
    while (begun < span) {
        const struct place at = {known.at.m, known.at.column + begun * run.column, known.at.row + begun * run.row};
        double done = begun + exit_of(at, run, 0);
        if (level == 0 || done + 2 * NUDGE_M > span)
            done = span;
        const double length = done - begun;
        step->width += length * v->tan_turn;
        const double own_most = (w->s + done + v->reach) / v->cos_turn, s_done = w->s + done;
        const double bent = fabs(g->sag) * greater(v->reach * v->reach, own_most * own_most - s_done * s_done);
        const double low_here = floor + step->climb * begun + smaller(0.0, step->climb * length);
        const double slack = step->rise_aside * step->width + bent;
        const bool is_open = is_always_open || at.m != step->at.m /* beside the edge of a map */
                             || low_here < (double)g->tops[block_at(g, at, 0)] + slack;
        if (is_open) {
            const double middle = begun + 0.5 * length;
            double z[3] = {z_begun, 0.0, end.z};
            if (!is_known)
                z[0] = height_on_line(g, &v->ray, known.at, run, e, n, begun);
            if (is_on_line)
                z[1] = height_on_line(g, &v->ray, known.at, run, e, n, middle);
            else
                z[1] = surface(g, e + middle * v->ray.sin_a, n + middle * v->ray.cos_a, z[0]);
            if (is_on_line && done < span)
                z[2] = height_on_line(g, &v->ray, known.at, run, e, n, done);
            take_piece(v, w, step, begun, done, z, at, bent, found);
            z_begun = z[2];
        }
        is_known = is_open;
        begun = done;
    }
    w->known = end;
    w->s = end.s;
}

/* Follow the rays from s on until no further ground matters, or over one step. */
static void follow(const struct view *v, struct walk *w, double s, struct envelope *found)
{
    struct step step;
    double line;
    w->s = s;
    w->known.z = v->ray.up;
    while (begin_step(v, found, w, &step, &line)) {
        find_headings(v, found, w, &step, line);
        if (!step_over(v, w, &step))
            take_ground(v, w, &step, found);
        if (w->is_probe)
            break;
    }
}

void bounds(const struct ground *g, struct box box, const struct beam *beam, bool tilts_to_crest, double *found)
{
    const struct view v = view_of(g, &box, beam, tilts_to_crest);
    struct envelope all = {LOWEST_TAN, 0.0, v.low_up - FAR_M, 0.0, LOWEST_TAN, FAR_M, -FAR_M, -FAR_M, 0.0};
    struct walk w = {.is_probe = true, .straight_map = -1, .straight_to = -FAR_M, .straight_low = LOWEST_TAN,
                     .known_block = -1, .steepest = -FAR_M, .known = {-FAR_M, v.ray.up, {-1, 0.0, 0.0}}};
    follow(&v, &w, v.middle.at > v.reach ? v.middle.at : 12.0 * v.reach + 1.0, &all);
    w.is_probe = false;
    w.known.s = -FAR_M; /* unknown */
    follow(&v, &w, v.begin, &all);
    /* What the plane itself rises along a ray that is turned by up to `turn`. */
    const double tilted = fabs(v.side_rise), sin_turn = sqrt(1.0 - v.cos_turn * v.cos_turn);
    const double turned = fabs(v.along_rise) * (1.0 - v.cos_turn) + tilted * sin_turn;
    const double values[BOUNDS] = {
        all.low + (v.along_rise - turned), greater(all.low, all.high) + (v.along_rise + turned), all.first, all.last,
        v.middle.at, v.middle.tan, all.line_from, all.low_s, all.low_z, all.most_rise, all.low_rise,
    };
    for (int k = 0; k < BOUNDS; k++)
        found[k] = values[k];
}
