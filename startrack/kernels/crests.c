/* Skylines of ground whose posts err: mean, variance, and how they follow each post.

   The tangent of the skyline is the largest of those of many places along a ray. Each is normal about the map's, by the
   posts of its cell and those of the camera's. The larger of two normal numbers is taken as normal again (Clark 1961,
   Operations Research 9, 145). Its covariance with the error of a post is exact for two places, by Stein's lemma: the
   mean of the response to the post. Places at about one distance are compared first, because their errors are alike:
   the largest of them is nearly normal. The largest of each octave of distance are then compared, from the farthest
   on. */

#include "ground.h"

#define LOW_SIGMAS 2.0 /* of the crest's post, by which the skyline is surely no lower than the map's */
#define POSTS 64       /* that one ray follows; the variance by more of them counts as its own */
#define CERTAIN 4.0    /* sigmas by which a place is sure to be hidden, or to hide the others */
#define LEAST_TAN 1e-9 /* standard deviation of the difference of two places, below which they are the same */
#define OCTAVES 16     /* of distance; the first holds what is nearer than FIRST_OCTAVE_M */
#define FIRST_OCTAVE_M 16.0
#define SQRT_2 1.4142135623730951
#define SQRT_TURN 2.5066282746310002

/* Posts of a cell and their bilinear weights. */
struct weights {
    int64_t post[4];
    double weight[4];
};

/* A tangent that is normal by errors of posts: its mean, variance that follows no post, mean of 1 / s, and its rise by
   a metre of each post. Of no posts it is none. */
struct tangent {
    double mean, own, per_m;
    int64_t used, post[POSTS];
    double response[POSTS];
};

/* A camera that looks along a ray, over posts that err by `sigma` metres. */
struct sight {
    const struct ground *g;
    const double *cdf;
    struct ray ray;
    double sigma, low; /* tangent that the skyline surely reaches */
    struct weights seat;
};

static struct weights weights_of(const struct ground *g, struct place at)
{
    struct weights found = {{-1, -1, -1, -1}, {0.0, 0.0, 0.0, 0.0}};
    if (at.m < 0)
        return found;
    const int64_t *posts = g->posts + 3 * at.m, i = (int64_t)at.row, j = (int64_t)at.column;
    const double down = at.row - (double)i, right = at.column - (double)j;
    for (int corner = 0; corner < 4; corner++) {
        const int a = corner >> 1, b = corner & 1;
        found.post[corner] = posts[0] + (i + a) * posts[2] + j + b;
        found.weight[corner] = (a ? down : 1.0 - down) * (b ? right : 1.0 - right);
    }
    return found;
}

static double square_of_responses(const struct tangent *one)
{
    double sum = 0.0;
    for (int64_t j = 0; j < one->used; j++)
        sum += one->response[j] * one->response[j];
    return sum;
}

static int64_t place_of_post(const struct tangent *one, int64_t post)
{
    int64_t j = 0;
    while (j < one->used && one->post[j] != post)
        j++;
    return j;
}

/* The response to a post, which is added where there is room; else a place that does not count. */
static double *response_to(struct tangent *one, int64_t post, double *beyond)
{
    const int64_t j = place_of_post(one, post);
    if (j == one->used) {
        if (j == POSTS)
            return beyond;
        one->post[j] = post;
        one->response[j] = 0.0;
        one->used++;
    }
    return one->response + j;
}

/* Replace `into` by the larger of it and the `other` tangent. */
static void take_larger(struct tangent *into, const struct tangent *other, double sigma, const double *cdf)
{
    if (other->used == 0)
        return;
    if (into->used == 0)
        into->mean = into->own = into->per_m = 0.0;
    double common = 0.0;
    for (int64_t i = 0; i < other->used; i++) {
        const int64_t j = place_of_post(into, other->post[i]);
        common += j < into->used ? other->response[i] * into->response[j] : 0.0;
    }
    const double one = into->mean, two = other->mean;
    const double variance = into->own + sigma * sigma * square_of_responses(into);
    const double variance_there = other->own + sigma * sigma * square_of_responses(other);
    const double apart = sqrt(
        greater(LEAST_TAN * LEAST_TAN, variance + variance_there - 2.0 * sigma * sigma * common));
    const double above = into->used > 0 ? (one - two) / apart : -INFINITY;
    if (!(above < CERTAIN))
        return;
    double kept = 0.0, second = variance_there, largest = two; /* of the square, its mean */
    if (above > -CERTAIN) {
        kept = normal_cdf(cdf, above);
        const double density = exp(-0.5 * above * above) / SQRT_TURN;
        largest = one * kept + two * (1.0 - kept) + apart * density;
        second = (one * one + variance) * kept + (two * two + variance_there) * (1.0 - kept);
        second += (one + two) * apart * density - largest * largest;
    }
    for (int64_t j = 0; j < into->used; j++)
        into->response[j] *= kept;
    for (int64_t i = 0; i < other->used; i++) {
        double beyond = 0.0;
        *response_to(into, other->post[i], &beyond) += (1.0 - kept) * other->response[i];
    }
    into->mean = largest;
    into->own = greater(0.0, second - sigma * sigma * square_of_responses(into));
    into->per_m = kept * into->per_m + (1.0 - kept) * other->per_m;
}

/* Take the place at a distance s into the largest of its octave, unless it is surely below the tangent `low`. */
static void add_place(const struct sight *sight, double s, struct tangent *octaves)
{
    const struct ray *ray = &sight->ray;
    const struct mark here = mark_at(sight->g, ray, s, ray->up + sight->low * s);
    const double mean = (here.z - ray->up) / greater(NUDGE_M, s) + sight->g->sag * s;
    if (here.at.m < 0 || !(s > NUDGE_M) || !(mean + CERTAIN * sight->sigma * SQRT_2 / s > sight->low))
        return;
    const struct weights weights = weights_of(sight->g, here.at);
    struct tangent one;
    double beyond;
    one.mean = mean;
    one.own = 0.0;
    one.per_m = 1.0 / s;
    one.used = 4;
    for (int i = 0; i < 4; i++) {
        one.post[i] = weights.post[i];
        one.response[i] = weights.weight[i] / s;
    }
    for (int i = 0; i < 4; i++)
        *response_to(&one, sight->seat.post[i], &beyond) -= sight->seat.weight[i] / s;
    int octave = 0;
    for (double end = FIRST_OCTAVE_M; s > end && octave < OCTAVES - 1; end *= 2.0)
        octave++;
    take_larger(octaves + octave, &one, sight->sigma, sight->cdf);
}

/* Fill the largest tangents of octaves of distance: of the map's crest, and of places on the edges and in the middles
   of cells from the camera on. Those whose ground stands far below the sight line of the tangent `low` are left out. */
static void fill_octaves(const struct sight *sight, double distance, struct tangent *octaves)
{
    const struct ground *g = sight->g;
    const struct ray *ray = &sight->ray;
    const double low = sight->low, raised = CERTAIN * sight->sigma;
    double s = 0.0, known = -1.0;
    int64_t level = 0;
    add_place(sight, distance, octaves);
    for (;;) {
        const double e = ray->east + s * ray->sin_a, n = ray->north + s * ray->cos_a;
        const double z = g->radius + ray->up + low * s - g->sag * s * s;
        const struct place at = locate(g, e, n, z);
        const double r = sqrt(e * e + n * n + z * z);
        const double climb = (e * ray->sin_a + n * ray->cos_a + z * (low - 2 * g->sag * s)) / r;
        if (at.m < 0 || (climb >= 0.0 && r - g->radius >= g->highest + raised))
            return;
        const struct heading to = heading_to(g, at, 1.0, e + ray->sin_a, n + ray->cos_a, z + low);
        double length;
        level = least(level, g->levels[at.m] - 1);
        if (is_below_sight(g, at, to, r - g->radius, climb, raised, &level, &length)) {
            s += length;
            continue;
        }
        for (int part = known == s; part < 3; part++)
            add_place(sight, s + 0.5 * part * length, octaves);
        s += length;
        known = s;
    }
}

void crests(int64_t n, const struct ground *restrict ground, double camera_height, double sigma,
            const double *restrict points, const double *restrict azimuths, const double *restrict tan,
            const double *restrict distance, const double *restrict cdf, double *restrict mean, double *restrict own,
            int64_t *restrict post, double *restrict response)
{
    struct tangent octaves[OCTAVES], largest;
    for (int64_t k = 0; k < n; k++) {
        const double east = points[2 * k], north = points[2 * k + 1];
        struct place at = {-1, 0.0, 0.0};
        const double up = surface_from_zero(ground, east, north, &at) + camera_height;
        const struct sight sight = {
            ground, cdf, {east, north, up, sin(azimuths[k]), cos(azimuths[k])}, sigma,
            tan[k] - LOW_SIGMAS * sigma / distance[k], weights_of(ground, at),
        };
        for (int octave = 0; octave < OCTAVES; octave++)
            octaves[octave].used = 0;
        largest.used = 0;
        fill_octaves(&sight, distance[k], octaves);
        for (int octave = OCTAVES - 1; octave >= 0; octave--)
            take_larger(&largest, octaves + octave, sigma, cdf);
        const double of_post = sigma / greater(NUDGE_M, distance[k]);
        mean[k] = largest.used > 0 ? largest.mean : tan[k];
        own[k] = largest.used > 0 ? largest.own : of_post * of_post;
        for (int64_t j = 0; j < POSTS; j++) {
            const bool is_used = j < largest.used;
            post[k * POSTS + j] = is_used ? largest.post[j] : -1;
            response[k * POSTS + j] = is_used ? largest.response[j] : 0.0;
            for (int i = 0; i < 4 && is_used; i++) {
                if (largest.post[j] == sight.seat.post[i])
                    response[k * POSTS + j] += sight.seat.weight[i] * largest.per_m;
            }
        }
    }
}
