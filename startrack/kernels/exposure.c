/* Filtered rows of a PNG. */

#include "startrack_kernels.h"

static inline int size_of(int x)
{
    return x < 0 ? -x : x;
}

/* Of three bytes the one nearest to left + up - corner. */
static inline int paeth(int left, int up, int corner)
{
    const int to_left = size_of(up - corner), to_up = size_of(left - corner), to_corner = size_of(left + up - 2 * corner);
    if (to_left <= to_up && to_left <= to_corner)
        return left;
    return to_up <= to_corner ? up : corner;
}

/* Fill the `row` of `length` bytes, below the row `above`; both begin with zeros for the pixel to the left. */
static void undo(const uint8_t *restrict filtered, int64_t length, int64_t pixel_bytes, int kind,
                 const uint8_t *restrict above, uint8_t *row)
{
    uint8_t *const to = row + pixel_bytes;
    const uint8_t *restrict up = above + pixel_bytes;
    switch (kind) {
    case 1:
        for (int64_t x = 0; x < length; x++)
            to[x] = (uint8_t)(filtered[x] + row[x]);
        break;
    case 2:
        for (int64_t x = 0; x < length; x++)
            to[x] = (uint8_t)(filtered[x] + up[x]);
        break;
    case 3:
        for (int64_t x = 0; x < length; x++)
            to[x] = (uint8_t)(filtered[x] + ((row[x] + up[x]) >> 1));
        break;
    case 4:
        for (int64_t x = 0; x < length; x++)
            to[x] = (uint8_t)(filtered[x] + paeth(row[x], up[x], above[x]));
        break;
    default:
        for (int64_t x = 0; x < length; x++)
            to[x] = filtered[x];
    }
}

/* As `undo` for the mean of 16-bit samples: two chains of bytes in registers. */
static void undo_mean_16(const uint8_t *restrict filtered, int64_t length, const uint8_t *restrict above,
                         uint8_t *restrict row)
{
    unsigned high = 0, low = 0;
    for (int64_t x = 0; x + 1 < length; x += 2) {
        high = (filtered[x] + ((high + above[x + 2]) >> 1)) & 255u;
        low = (filtered[x + 1] + ((low + above[x + 3]) >> 1)) & 255u;
        row[x + 2] = (uint8_t)high;
        row[x + 3] = (uint8_t)low;
    }
}

/* Rows (height, 1 + length) to samples; `scratch` holds two rows of `room` bytes, which are zero. `LOAD` makes a sample
   of the bytes at x. */
#define UNFILTER(NAME, SAMPLE, BYTES, LOAD)                                                                            \
    void NAME(int64_t height, int64_t length, int64_t room, int64_t samples, const uint8_t *restrict rows,             \
              int64_t pixel_bytes, uint8_t *restrict scratch, SAMPLE *restrict found)                                  \
    {                                                                                                                  \
        uint8_t *above = scratch, *row = scratch + room;                                                               \
        for (int64_t y = 0; y < height; y++) {                                                                         \
            const uint8_t *restrict filtered = rows + y * (length + 1);                                                \
            if (BYTES == 2 && filtered[0] == 3 && pixel_bytes == 2)                                                    \
                undo_mean_16(filtered + 1, length, above, row);                                                        \
            else                                                                                                       \
                undo(filtered + 1, length, pixel_bytes, filtered[0], above, row);                                      \
            const uint8_t *restrict from = row + pixel_bytes;                                                          \
            for (int64_t x = 0; x < samples; x++)                                                                      \
                found[y * samples + x] = (SAMPLE)(LOAD);                                                               \
            uint8_t *const swap = above;                                                                               \
            above = row;                                                                                               \
            row = swap;                                                                                                \
        }                                                                                                              \
    }

UNFILTER(unfilter_grey_8, float, 1, from[x])
UNFILTER(unfilter_grey_16, float, 2, from[2 * x] << 8 | from[2 * x + 1])
UNFILTER(unfilter_colour_8, uint8_t, 1, from[x])
UNFILTER(unfilter_colour_16, uint16_t, 2, from[2 * x] << 8 | from[2 * x + 1])
