/* Pairs of a detection and a star compared in position and brightness. */

#include <math.h>

#include "common.h"
#include "startrack_kernels.h"

/* Slot of the star of pair i in a hash table of pairs with open addressing, or the empty one (-1) for it. The number of
   slots is a power of 2. */
static inline int64_t slot_of(int64_t i, const int64_t *star, int64_t slots, const int64_t *of_slot)
{
    int64_t at = star[i] & (slots - 1);
    while (of_slot[at] >= 0 && star[of_slot[at]] != star[i])
        at = (at + 1) & (slots - 1);
    return at;
}

/* Fill `of_slot` with the pairs of least finite cost of each star. */
static void find_cheapest(int64_t n, int64_t slots, const int64_t *restrict star, const double *restrict cost,
                          int64_t *restrict of_slot)
{
    for (int64_t s = 0; s < slots; s++)
        of_slot[s] = -1;
    for (int64_t i = 0; i < n; i++) {
        if (cost[i] < INFINITY) {
            const int64_t at = slot_of(i, star, slots, of_slot);
            if (of_slot[at] < 0 || cost[i] < cost[of_slot[at]])
                of_slot[at] = i;
        }
    }
}

int64_t compare_pairs(int64_t n, int64_t m, int64_t slots, const int64_t *restrict detection,
                      const int64_t *restrict star, const double *restrict distance, const double *restrict v_mag,
                      const double *restrict v_sigma_mag, const double *restrict measured_mag,
                      const bool *restrict saturated, double brighter_mag, double dimmed_mag, double px_per_mag,
                      double *restrict cost, int64_t *restrict of_slot, double *restrict misfit,
                      int64_t *restrict kept)
{
    (void)m;
    for (int64_t i = 0; i < n; i++) {
        const double dimmed = measured_mag[detection[i]] - v_mag[i];
        double beyond = greater(fabs(dimmed) - 2.0 * v_sigma_mag[i], 0.0);
        if (saturated[detection[i]] && dimmed > 0.0)
            beyond = 0.0;
        misfit[i] = beyond / (dimmed > 0.0 ? dimmed_mag : brighter_mag);
        cost[i] = distance[i] + px_per_mag * beyond;
    }
    find_cheapest(n, slots, star, cost, of_slot);
    int64_t k = 0;
    for (int64_t i = 0; i < n; i++) {
        if (misfit[i] >= 1.0 || of_slot[slot_of(i, star, slots, of_slot)] != i)
            continue;
        if (k == 0 || detection[kept[k - 1]] != detection[i])
            kept[k++] = i;
        else if (cost[i] < cost[kept[k - 1]])
            kept[k - 1] = i;
    }
    return k;
}

int64_t count_alike(int64_t n, int64_t m, const double *restrict v_mag, const double *restrict measured_mag,
                    double brighter_mag, double dimmed_mag)
{
    int64_t count = 0, first = 0, last = 0;
    for (int64_t i = 0; i < n; i++) {
        const double low = v_mag[i] - brighter_mag, high = v_mag[i] + dimmed_mag;
        while (first > 0 && measured_mag[first - 1] >= low)
            first--;
        while (first < m && measured_mag[first] < low)
            first++;
        while (last > 0 && measured_mag[last - 1] >= high)
            last--;
        while (last < m && measured_mag[last] < high)
            last++;
        count += last - first;
    }
    return count;
}
