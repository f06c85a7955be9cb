/* Stars and triangles looked up in cells of a cube, and triangles compared by their sides. */

#include <math.h>

#include "common.h"
#include "startrack_kernels.h"

/* Number of a cell along one side of the cube from -1 to 1. */
static inline int64_t cell_of(double coordinate, int64_t cells)
{
    return (int64_t)smaller(greater((coordinate + 1.0) * (0.5 * (double)cells), 0.0), (double)(cells - 1));
}

/* Number of the cell of a ray. */
static inline int64_t cell_at(const double *ray, int64_t cells)
{
    return (cell_of(ray[0], cells) * cells + cell_of(ray[1], cells)) * cells + cell_of(ray[2], cells);
}

void bin_stars(int64_t n, int64_t places, const double *restrict rays, int64_t cells, int32_t *restrict first,
               int64_t *restrict star)
{
    for (int64_t c = 0; c <= places; c++)
        first[c] = 0;
    for (int64_t i = 0; i < n; i++)
        first[cell_at(rays + 3 * i, cells)]++;
    for (int64_t c = 1; c <= places; c++) /* the end of each cell */
        first[c] += first[c - 1];
    for (int64_t i = n - 1; i >= 0; i--) /* backwards, so that the order stays */
        star[--first[cell_at(rays + 3 * i, cells)]] = i;
}

int64_t find_stars(int64_t m, int64_t places, int64_t n, int64_t room, const double *restrict rays, double chord,
                   int64_t cells, const int32_t *restrict first, const int64_t *restrict star,
                   const double *restrict star_rays, int64_t *restrict of_ray, int64_t *restrict of_star,
                   double *restrict apart)
{
    (void)places, (void)n;
    int64_t k = 0;
    for (int64_t i = 0; i < m; i++) {
        const double x = rays[3 * i], y = rays[3 * i + 1], z = rays[3 * i + 2];
        const int64_t from_x = cell_of(x - chord, cells), to_x = cell_of(x + chord, cells);
        const int64_t from_y = cell_of(y - chord, cells), to_y = cell_of(y + chord, cells);
        const int64_t from_z = cell_of(z - chord, cells), to_z = cell_of(z + chord, cells);
        for (int64_t cx = from_x; cx <= to_x; cx++) {
            for (int64_t cy = from_y; cy <= to_y; cy++) {
                const int32_t *restrict row = first + (cx * cells + cy) * cells;
                for (int64_t at = row[from_z]; at < row[to_z + 1]; at++) {
                    const double *restrict other = star_rays + 3 * at;
                    const double dx = other[0] - x, dy = other[1] - y, dz = other[2] - z;
                    const double squared = dx * dx + dy * dy + dz * dz;
                    if (squared >= chord * chord)
                        continue;
                    if (k < room) {
                        of_ray[k] = i;
                        of_star[k] = star[at];
                        apart[k] = sqrt(squared);
                    }
                    k++;
                }
            }
        }
    }
    return k;
}

/* Exchange two sides and their vertices where they do not ascend. */
static inline void order_sides(double *sides, int64_t *vertices, int a, int b)
{
    if (sides[a] > sides[b]) {
        const double side = sides[a];
        const int64_t vertex = vertices[a];
        sides[a] = sides[b];
        sides[b] = side;
        vertices[a] = vertices[b];
        vertices[b] = vertex;
    }
}

int64_t sides_of_few(int64_t n, int64_t room, const double *restrict rays, int64_t fresh, double longest,
                     double *restrict chord, int64_t *restrict vertices, double *restrict sides)
{
    for (int64_t i = 0; i < n; i++) {
        for (int64_t j = 0; j < n; j++) {
            const double *restrict a = rays + 3 * i, *restrict b = rays + 3 * j;
            const double x = a[0] - b[0], y = a[1] - b[1], z = a[2] - b[2];
            chord[i * n + j] = sqrt(x * x + y * y + z * z);
        }
    }
    int64_t m = 0;
    for (int64_t i = 0; i < n; i++) {
        for (int64_t j = i + 1; j < n; j++) {
            const double c = chord[i * n + j];
            if (!(c < longest))
                continue;
            for (int64_t k = most(j + 1, fresh); k < n; k++) {
                const double a = chord[j * n + k], b = chord[i * n + k];
                if (!(a < longest && b < longest))
                    continue;
                if (m == room)
                    return m;
                int64_t *restrict vertex = vertices + 3 * m;
                double *restrict side = sides + 3 * m++;
                vertex[0] = i, vertex[1] = j, vertex[2] = k;
                side[0] = a, side[1] = b, side[2] = c;
                order_sides(side, vertex, 0, 1);
                order_sides(side, vertex, 1, 2);
                order_sides(side, vertex, 0, 1);
            }
        }
    }
    return m;
}

/* The triple product of three rays. */
static inline double triple_product(const double *rays)
{
    const double *a = rays, *b = rays + 3, *c = rays + 6;
    const double x = b[1] * c[2] - b[2] * c[1], y = b[2] * c[0] - b[0] * c[2], z = b[0] * c[1] - b[1] * c[0];
    return a[0] * x + a[1] * y + a[2] * z;
}

void are_same_handed(int64_t m, const double *restrict one, const double *restrict other, bool *restrict same)
{
    for (int64_t i = 0; i < m; i++)
        same[i] = triple_product(one + 9 * i) * triple_product(other + 9 * i) > 0.0;
}

void largest_differences(int64_t m, int64_t n, int64_t k, const double *restrict sides, const double *restrict known,
                         const int64_t *restrict row, const int64_t *restrict found, double tolerance,
                         double *restrict off)
{
    (void)m, (void)n;
    for (int64_t i = 0; i < k; i++) {
        const double *restrict a = sides + 3 * row[i], *restrict b = known + 3 * found[i];
        const double largest = greater(greater(fabs(a[0] - b[0]), fabs(a[1] - b[1])), fabs(a[2] - b[2]));
        off[i] = largest < tolerance ? largest / a[0] : INFINITY;
    }
}

int64_t keep_closest(int64_t n, int64_t rows, const int64_t *restrict order, const double *restrict off,
                     const int64_t *restrict row, int64_t each, int64_t *restrict count, int64_t *restrict kept)
{
    int64_t k = 0;
    for (int64_t r = 0; r < rows; r++)
        count[r] = 0;
    for (int64_t i = 0; i < n; i++) {
        const int64_t pair = order[i];
        if (off[pair] < INFINITY && count[row[pair]] < each) {
            count[row[pair]]++;
            kept[k++] = pair;
        }
    }
    return k;
}
