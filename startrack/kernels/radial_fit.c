/* A lens of one bend (see radial_fit.py): pixels of rays, and its fit to matched stars together with the attitude. */

#include <math.h>

#include "common.h"
#include "startrack_kernels.h"

#define LENS 5             /* parameters: logarithms of focal length and aspect, bend, centre x and y */
#define UNKNOWNS (LENS + 3) /* and a rotation vector */
#define STRAIGHT_BEND 1e-7 /* in radial_fit.py too, as STEEPEST */
#define STEEPEST 1.55      /* radians, of the argument of sine or tangent */
#define NEAREST 1e-12      /* to the axis */

/* Radius in focal lengths, its derivatives by the angle and by the bend, and whether it still rises. */
struct radius {
    double length, slope, by_bend;
    bool rises;
};

static struct radius radius_at(double angle, double bend)
{
    if (fabs(bend) < STRAIGHT_BEND) {
        const struct radius straight = {angle, 1.0, angle * angle * angle, true};
        return straight;
    }
    const double q = bend > 0.0 ? sqrt(3.0 * bend) : sqrt(-6.0 * bend), x = smaller(q * angle, STEEPEST);
    const double c = cos(x), s = sin(x);
    struct radius found = {s / q, c, -3.0 / q, q * angle < STEEPEST};
    if (bend > 0.0) {
        found.length = s / c / q;
        found.slope = 1.0 / (c * c);
        found.by_bend = 1.5 / q;
    }
    found.by_bend *= (angle * found.slope - found.length) / q;
    return found;
}

/* A lens in use: focal lengths (pixels; `fx` with the sign of the mirror), bend and centre. */
struct lens {
    double focal, fx, fy, bend, x, y;
};

static struct lens lens_of(const double *lens, double mirror)
{
    const double fx = mirror * exp(lens[0] + 0.5 * lens[1]), fy = exp(lens[0] - 0.5 * lens[1]);
    const struct lens found = {exp(lens[0]), fx, fy, lens[2], lens[3], lens[4]};
    return found;
}

/* to = R ray. */
static inline void turn(const double *R, const double *ray, double to[3])
{
    for (int a = 0; a < 3; a++)
        to[a] = R[3 * a] * ray[0] + R[3 * a + 1] * ray[1] + R[3 * a + 2] * ray[2];
}

void project_radial(int64_t n, const double *restrict rays_icrs, const double *restrict R,
                    const double *restrict lens, double mirror, double width, double height, double *restrict px,
                    bool *restrict inside)
{
    const struct lens now = lens_of(lens, mirror);
    for (int64_t i = 0; i < n; i++) {
        double cam[3];
        turn(R, rays_icrs + 3 * i, cam);
        const double off_axis = sqrt(cam[0] * cam[0] + cam[1] * cam[1]);
        const struct radius r = radius_at(atan2(off_axis, cam[2]), now.bend);
        const double ratio = r.length / greater(off_axis, NEAREST);
        const double x = now.x + now.fx * cam[0] * ratio, y = now.y + now.fy * cam[1] * ratio;
        px[2 * i] = x;
        px[2 * i + 1] = y;
        inside[i] = r.rises && -0.5 <= x && x <= width - 0.5 && -0.5 <= y && y <= height - 0.5;
    }
}

/* Solve symmetric equations, of which the lower triangle counts, by Cholesky's method; the result is in `right`. */
static void solve(double normal[UNKNOWNS][UNKNOWNS], double right[UNKNOWNS], double ridge)
{
    double unit[UNKNOWNS];
    for (int a = 0; a < UNKNOWNS; a++)
        unit[a] = 1.0 / sqrt(greater(normal[a][a], 1e-300));
    for (int a = 0; a < UNKNOWNS; a++) {
        for (int b = 0; b <= a; b++)
            normal[a][b] *= unit[a] * unit[b];
        normal[a][a] += ridge;
        right[a] *= unit[a];
    }
    for (int a = 0; a < UNKNOWNS; a++) {
        for (int b = 0; b <= a; b++) {
            double rest = normal[a][b];
            for (int k = 0; k < b; k++)
                rest -= normal[a][k] * normal[b][k];
            normal[a][b] = a == b ? sqrt(greater(rest, ridge)) : rest / normal[b][b];
        }
        for (int k = 0; k < a; k++)
            right[a] -= normal[a][k] * right[k];
        right[a] /= normal[a][a];
    }
    for (int a = UNKNOWNS - 1; a >= 0; a--) {
        for (int k = a + 1; k < UNKNOWNS; k++)
            right[a] -= normal[k][a] * right[k];
        right[a] /= normal[a][a];
    }
    for (int a = 0; a < UNKNOWNS; a++)
        right[a] *= unit[a];
}

/* Turn R [3, 3] by a rotation vector (Rodrigues). */
static void turn_by(double *restrict R, const double *vector)
{
    const double angle = sqrt(vector[0] * vector[0] + vector[1] * vector[1] + vector[2] * vector[2]);
    const double unit = greater(angle, 1e-300), x = vector[0] / unit, y = vector[1] / unit, z = vector[2] / unit;
    const double s = sin(angle), c = 1.0 - cos(angle);
    const double turned[3][3] = {
        {1.0 - c * (y * y + z * z), c * x * y - s * z, c * x * z + s * y},
        {c * x * y + s * z, 1.0 - c * (x * x + z * z), c * y * z - s * x},
        {c * x * z - s * y, c * y * z + s * x, 1.0 - c * (x * x + y * y)},
    };
    for (int b = 0; b < 3; b++) {
        const double before[3] = {R[b], R[3 + b], R[6 + b]};
        for (int a = 0; a < 3; a++)
            R[3 * a + b] = turned[a][0] * before[0] + turned[a][1] * before[1] + turned[a][2] * before[2];
    }
}

/* Add an equation, of derivatives `row` and residual `left`, to the normal equations. */
static inline void add_equation(double normal[UNKNOWNS][UNKNOWNS], double right[UNKNOWNS],
                                const double row[UNKNOWNS], double left, double weight)
{
    for (int a = 0; a < UNKNOWNS; a++) {
        const double weighed = weight * row[a];
        right[a] += weighed * left;
        for (int b = 0; b <= a; b++)
            normal[a][b] += weighed * row[b];
    }
}

/* Add the two equations of a match of a pixel and a ray `cam`, whose weight is a half at the squared residual
   `half_px2`. */
static void add_match(double normal[UNKNOWNS][UNKNOWNS], double right[UNKNOWNS], const double *xy_px,
                      const double cam[3], const struct lens *lens, double half_px2)
{
    const double off_axis = greater(sqrt(cam[0] * cam[0] + cam[1] * cam[1]), NEAREST);
    const struct radius r = radius_at(atan2(off_axis, cam[2]), lens->bend);
    const double unit[2] = {cam[0] / off_axis, cam[1] / off_axis}, ratio = r.length / off_axis;
    const double left[2] = {xy_px[0] - lens->x - lens->fx * r.length * unit[0],
                            xy_px[1] - lens->y - lens->fy * r.length * unit[1]};
    const double weight = 1.0 / (1.0 + (left[0] * left[0] + left[1] * left[1]) / half_px2);
    for (int axis = 0; axis < 2; axis++) {
        const double f = axis == 0 ? lens->fx : lens->fy, u = unit[axis], v = unit[1 - axis];
        /* By the ray's components: along the radius, across it, and along the axis. */
        const double own = f * (r.slope * cam[2] * u * u + ratio * v * v);
        const double mixed = f * (r.slope * cam[2] - ratio) * u * v, dz = -f * r.slope * off_axis * u;
        const double dx = axis == 0 ? own : mixed, dy = axis == 0 ? mixed : own;
        const double row[UNKNOWNS] = {
            f * r.length * u,
            (axis == 0 ? 0.5 : -0.5) * f * r.length * u,
            f * r.by_bend * u,
            axis == 0 ? lens->focal : 0.0,
            axis == 0 ? 0.0 : lens->focal,
            cam[1] * dz - cam[2] * dy,
            cam[2] * dx - cam[0] * dz,
            cam[0] * dy - cam[1] * dx,
        };
        add_equation(normal, right, row, left[axis], weight);
    }
}

/* Add what is known of a lens parameter, or take it out of the equations. */
static void add_expected(double normal[UNKNOWNS][UNKNOWNS], double right[UNKNOWNS], int a, bool is_free, double off,
                         double sigma)
{
    if (is_free) {
        const double precision = 1.0 / (sigma * sigma);
        normal[a][a] += precision;
        right[a] += precision * off;
        return;
    }
    for (int b = 0; b < UNKNOWNS; b++)
        normal[a > b ? a : b][a > b ? b : a] = 0.0;
    right[a] = 0.0;
    normal[a][a] = 1.0;
}

void fit_radial(int64_t n, const double *restrict xy_px, const double *restrict rays_icrs, double mirror,
                double sigma_px, double half_chi2, int64_t steps, const bool *restrict free,
                const double *restrict expected, const double *restrict expected_sigma, double longest, double ridge,
                double *restrict R, double *restrict lens)
{
    for (int64_t step = 0; step < steps; step++) {
        double normal[UNKNOWNS][UNKNOWNS] = {{0.0}}, right[UNKNOWNS] = {0.0};
        const struct lens now = lens_of(lens, mirror);
        for (int64_t i = 0; i < n; i++) {
            double cam[3];
            turn(R, rays_icrs + 3 * i, cam);
            add_match(normal, right, xy_px + 2 * i, cam, &now, sigma_px * sigma_px * half_chi2);
        }
        for (int a = 0; a < LENS; a++)
            add_expected(normal, right, a, free[a], (expected[a] - lens[a]) / (a > 2 ? now.focal : 1.0),
                         expected_sigma[a] / sigma_px);
        solve(normal, right, ridge);
        for (int a = 0; a < UNKNOWNS; a++)
            right[a] = smaller(greater(right[a], -longest), longest);
        for (int a = 0; a < LENS; a++)
            lens[a] += a > 2 ? now.focal * right[a] : right[a];
        turn_by(R, right + LENS);
    }
}
