/* The inner loops of startrack: functions over plain arrays.

   Rules for all of them:
   - The sizes come first. Arrays are contiguous in C order; their shapes stand in brackets in the comments. Sizes may
     be 0 unless a comment says more; callers check the least ones (`>=` in the declarations in Python).
   - An array that is written to overlaps no other one (`restrict`). Arrays that are only read may be the same.
   - They allocate nothing, keep nothing between calls, and read and write nothing but their arguments.
   - Indices in arrays are those of elements that exist: the callers see to that, the functions do not test it.
   - Sums whose order matters for speed have eight accumulators, so that all compilers give the same bytes.
   - Unless a comment says more, NaN gives NaN in the elements that depend on it.

   startrack/kernels/library.py calls them; tests/test_kernels.py compares these declarations with those there. */

#ifndef STARTRACK_KERNELS_H
#define STARTRACK_KERNELS_H

#include <stdbool.h>
#include <stdint.h>

#if defined(_WIN32)
#define KERNEL __declspec(dllexport)
#else
#define KERNEL
#endif

/* Height maps as one ground, the finest first. See terrain/ground.py. */
struct ground {
    int64_t maps, numbers, coordinates, all_posts, all_blocks, most_levels;
    const double *grid;     /* [maps, numbers, coordinates]: coordinates 1 on the Moon, 2 on the Earth */
    const float *heights;   /* [all_posts] above the sphere through the origin of enu (m); NaN: a void */
    const int64_t *posts;   /* [maps, 3]: where a map's posts begin, rows, columns (2 at least) */
    const float *tops;      /* [all_blocks]: highest post of each block of cells */
    const float *wide_tops; /* [all_blocks]: of each block and its neighbours */
    const int8_t *slopes;   /* [all_blocks, 8]: most fall and rise per step along column, row, both, -column +row */
    const int64_t *blocks;  /* [maps, most_levels, 3]: where a level's blocks begin, block rows, block columns */
    const int64_t *levels;  /* [maps] */
    const double *slope_unit; /* [maps] (m per post) */
    const double *post_m;     /* [maps]: spacing of the posts */
    double radius, highest;   /* of that sphere; highest post of all maps (m) */
    double sag;               /* half the curvature of a sight line in air (1/m) */
};

/* A table of horizons. See terrain/horizon_table.py. */
struct table {
    int64_t cells, bins;
    const uint16_t *values;        /* [cells, bins, 11] of a square of cells, the north running fastest */
    const double *tangents;        /* [65536] of its elevations */
    const double *sines, *cosines; /* [bins] of the middles of its bins */
    int64_t across;                /* cells to a side of the square; 0: there is no table */
    double reach;                  /* half the side (m) */
    double angle_step, distance_step, rise_step;
};

/* levels.c */

/* Whether processor and system have all of x86-64-v3: AVX2, FMA, BMI, F16C, LZCNT, MOVBE. */
KERNEL bool has_x86_64_v3(void);

/* Name and version of the compiler, as it gives them. */
KERNEL const char *compiler_name(void);

/* The flags that it was given. */
KERNEL const char *compiler_flags(void);

/* attitudes.c */

/* Fill `R` [3, 3] with the rotation that minimises sum weight |cam - R icrs|^2 over pairs of rays [n, 3]. */
KERNEL void rotation_between(int64_t n, const double *restrict cam, const double *restrict icrs,
                             const double *restrict weight, double *restrict R);

/* Fill `R` [3, 3] with the rotation of the pairs of rays [n, 3] that it places within a radius (squared; chords), and
   `hit` [n] with which pairs these are; from the pairs that it names, some of them wrong. At most so many `rounds`;
   fewer hits than `fewest` end them. Without a round: the unit matrix. */
KERNEL void settle_rotation(int64_t n, const double *restrict cam, const double *restrict icrs, double squared_radius,
                            int64_t rounds, int64_t fewest, bool *restrict hit, double *restrict R);

/* Of the pairs `which` [m] of a detection and a star: whether they `agree` [m], their `variance` [m] (pixels squared,
   per axis, the common error added) and the rotation `refined` [3, 3] that they agree on, 0 where none is nearer than
   `gate_px`; the greatest change of an element from `R`, or infinity. `detection`, `distance` (pixels) and `rays_icrs`
   are those of all pairs [k]; `variance_px2` and `rays_cam` those of detections [n]. The common error is estimated by
   medians: that of chi^2 of two degrees of freedom is `median_chi2`. Scratch: [2, m]. */
KERNEL double rotate_by_inliers(int64_t m, int64_t k, int64_t n, const int64_t *restrict which,
                                const int64_t *restrict detection, const double *restrict distance,
                                const double *restrict variance_px2, const double *restrict rays_cam,
                                const double *restrict rays_icrs, const double *restrict R, double gate_px,
                                double median_chi2, double least_extra, double outlier_chi2,
                                double *restrict scratch, bool *restrict agree, double *restrict variance,
                                double *restrict refined);

/* column_chain.c */

/* Add to log-likelihoods `total` [columns, n] of skylines at elevations from `lowest` on, `step` apart (radians), those
   of steps of light [k], ordered by column, times `temper`. A skyline at a step has the likelihood `weight` times a
   normal density, one above it the factor exp(`passed`), and one that shows no step the likelihood `nothing`.
   Scratch: `mixture`. Places are finite. */
KERNEL void add_steps(int64_t k, int64_t n, int64_t columns, double temper, double lowest, double step,
                      const int64_t *restrict column, const double *restrict place, const double *restrict sigma,
                      const double *restrict weight, const double *restrict passed, double nothing,
                      double *restrict mixture, float *restrict total);

/* Fill `found` [kinds, columns, n] with the messages that reach each column around the circle: what those before it
   say, or, not `forward`, those after it, of a kind and an elevation. From column to column an elevation changes by
   three Laplace distributions that fall by `ratio` a sample, with the sums `weight`; with the probability `renew` the
   kind is drawn anew from the shares `part`; with the probability `jump` both are, the elevation from `landing`.
   Scratch: [kinds + 6, n]. */
KERNEL void pass_messages(int64_t kinds, int64_t columns, int64_t n, const float *restrict likelihood, bool forward,
                          const double *restrict ratio, const double *restrict weight, double jump,
                          const double *restrict landing, const double *restrict part, double renew,
                          double *restrict scratch, float *restrict found);

/* core.c */

/* Replace the azimuths in `found` [n] (radians, any turn) by the linear interpolation of `values` [m], which stand at
   even steps around the circle from azimuth 0 on. No value: 0. A NaN or infinite azimuth gives NaN. */
KERNEL void interpolate_circle(int64_t m, int64_t n, const double *restrict values, double *restrict found);

/* detection.c */

/* Fill `image` [converted, width], unless it has no rows, with counts `pixels_adu` in electrons, less `bias_e` [1, 1] or
   [height, width], and mark in `saturated`, which begins as false, the recorded counts from `highest_adu` on. */
KERNEL void convert_counts(int64_t height, int64_t width, int64_t bias_rows, int64_t bias_columns, int64_t converted,
                           const float *restrict pixels_adu, const float *restrict recorded_adu, float gain,
                           const float *restrict bias_e, float highest_adu, float *restrict image,
                           bool *restrict saturated);

/* Fill `blocks` [rows, columns, px, px] with those of an image, from the row of blocks `first` on, plus `part_steps`
   [px, px], px a multiple of 8. The border is reflected to fill the last blocks. Of blocks of more pixels (`side`) some, spread evenly, are
   taken: squares of two by two, for colour filters' sake. */
KERNEL void fill_blocks(int64_t height, int64_t width, int64_t px, int64_t rows, int64_t columns,
                        const float *restrict image, int64_t side, int64_t first, const float *restrict part_steps,
                        float *restrict blocks);

/* Replace `masked` pixels of an image by the others of the block `source` [2, rows, columns], one after another. Blocks
   have this `side`, and so many `good` pixels. Scratch: `values` [side^2]. */
KERNEL void fill_from_blocks(int64_t height, int64_t width, int64_t rows, int64_t columns, int64_t room,
                             float *restrict image, const bool *restrict masked, const int64_t *restrict good,
                             const int64_t *restrict source, int64_t side, float *restrict values);

/* Fill `residuals` [height, width] with the light of an image above its `background`, in units of its `noise`. Of both
   there are rows in the middles of blocks of `side` rows, one at least. `found`: light of known stars, subtracted,
   whose noise is `per_unit` of it and the part `found_error`; `known` is height, or 0: there are none. */
KERNEL void fill_residuals(int64_t height, int64_t width, int64_t blocks, int64_t known, const float *restrict image,
                           const float *restrict background, const float *restrict noise, int64_t side,
                           const float *restrict found, float per_unit, float found_error, float *restrict residuals);

/* Fill stamps [n, stamp, stamp] around the pixels `centres` [n, 2], x and y, with the light of an image above its
   background and with the variance of its noise; see `fill_residuals`. `stamp` is odd. The stamps lie in the image. */
KERNEL void cut_light(int64_t height, int64_t width, int64_t blocks, int64_t n, int64_t stamp,
                      const float *restrict image, const float *restrict background, const float *restrict noise,
                      int64_t side, const int64_t *restrict centres, float *restrict light, float *restrict variance);

/* The number of local maxima above `lowest`, at least 0, and `margin`, at least 1, inside the image; the first ones, row
   by row, fill `pixels` [room, 2], x and y, and `values` [room, 4]: height, offsets (pixels) of the top of a parabola in
   x and y, level.

   Residuals (see `fill_residuals`), zero beyond the border, are filtered in x and in y by a symmetric kernel, of which
   `taps` [reach + 1] has the middle and one side; reach is a multiple of 4. The local level, times `level_factor`, is
   subtracted: the mean, without values beyond `clipped`, over a square of `coarse` pixels and so many `beside` on each
   side of it, interpolated between their middles. `dead` pixels are no maxima; `dead_rows` is height, or 0: there are
   none.

   A filtered row follows `lag` rows after that of the image: reach, or with a level coarse (beside + 2), if that is
   more. Scratch: `rows` [lag + 2 reach + 11, stride], stride: a multiple of 64, at least width + 2 reach, coarse *
   columns and columns + 2 beside; `means` [squares, columns], those that cover the image, which has a pixel at least. */
KERNEL int64_t find_maxima(int64_t height, int64_t width, int64_t blocks, int64_t known, int64_t reach,
                           int64_t dead_rows, int64_t count, int64_t stride, int64_t squares, int64_t columns,
                           int64_t room, const float *restrict image, const float *restrict background,
                           const float *restrict noise, int64_t side, const float *restrict found, float per_unit,
                           float found_error, const float *restrict taps, int64_t coarse, int64_t beside, float clipped,
                           float level_factor, float lowest, const bool *restrict dead, int64_t margin,
                           float *restrict rows, float *restrict means, int64_t *restrict pixels,
                           float *restrict values);

/* evidence.c */

/* Fill `weight`, `mean` and `spread` (variance) [n, longest] of the light of the ground, by its sector and those before
   it around the circle, one for each number of sectors since the patch began. `own` and `variance` [n] are what each
   sector shows; `width`: range of levels of another patch; `drift`: variance that a sector adds; `border`: probability
   of another patch. The three arrays begin as 0, 0 and 1, the scratch [3, longest + 1] as 0. */
KERNEL void filter_patches(int64_t n, int64_t longest, const double *restrict own, const double *restrict variance,
                           double width, double drift, double border, double *restrict weight, double *restrict mean,
                           double *restrict spread, double *restrict scratch);

/* Fill `level` [n] with the means by the sectors up to each one and by the patches of those after it, of states
   [n, longest] of `filter_patches`; states of weights below `least_weight` are left out. */
KERNEL void join_patches(int64_t n, int64_t longest, const double *restrict weight, const double *restrict mean,
                         const double *restrict spread, const double *restrict later_weight,
                         const double *restrict later_mean, const double *restrict later_spread, double width,
                         double drift, double border, double least_weight, double *restrict level);

/* Add to `sums` [2, 6, sectors] of pixels [n] on a side (0 or 1; below 0: none) in a sector: their count, heights h,
   h^2, and with the residual q of the light: q, q h, q^2. Level, slope and limit of q [2, sectors]. Pixels beyond the
   limit are left out, those with NaN too. */
KERNEL void sum_sides(int64_t n, int64_t sectors, const int64_t *restrict side, const int64_t *restrict sector,
                      const double *restrict height, const double *restrict light, const double *restrict level,
                      const double *restrict slope, const double *restrict limit, double *restrict sums);

/* Fill `log` [sectors, shifts] with log-likelihoods of a skyline that is higher by `shift` [shifts] (pixels), by cells
   [sectors, cells] at heights with l (`llr`) and c (`extended`). `edge`: its width (pixels). `cdf` [4097]: see
   common.h. */
KERNEL void score_shifts(int64_t sectors, int64_t cells, int64_t shifts, const double *restrict height,
                         const double *restrict llr, const double *restrict extended, double edge,
                         const double *restrict shift, const double *restrict cdf, double *restrict log);

/* Add to `sums` [sectors, cells, 3] of l, c and c times the height, of pixels [n] in cells of `cell` pixels of height,
   and to `scales` [sectors, 2]: pixels, their scale. Level, slope and variance [2, sectors] are those of ground and
   sky; the skyline is within `reach` [sectors] (pixels, may be infinite). Pixels of sectors that are not covered,
   those that differ by more than `clip` sigma from any fraction of sky, and those with NaN are left out. */
KERNEL void sum_cells(int64_t n, int64_t sectors, int64_t cells, const int64_t *restrict sector,
                      const double *restrict height, const double *restrict light, const double *restrict scale,
                      const bool *restrict covered, const double *restrict level, const double *restrict slope,
                      const double *restrict variance, double correlation, double edge, const double *restrict reach,
                      double clip, double cell, const double *restrict cdf, double *restrict sums,
                      double *restrict scales);

/* Clear the pixels of `mask` [height, width] within radii [n] of the pixels `xy_px` [n, 2], which may lie outside, up
   to 1e9 pixels away. Disks up to `large_px` whose middle the mask lacks at first are left out. Scratch: `touching`. */
KERNEL void clear_disks(int64_t height, int64_t width, int64_t n, bool *restrict mask, const int64_t *restrict xy_px,
                        const int64_t *restrict radius_px, double large_px, bool *restrict touching);

/* exposure.c */

/* Undo the filters of the rows [height, length + 1] of a PNG (W3C PNG, section 9), the kind of each in its first byte,
   and write the samples; a row of another kind counts as unfiltered. `pixel_bytes`: of a pixel, at least 1. `scratch`
   [2, room] is zero; room = length + pixel_bytes, length = samples times their bytes. */
KERNEL void unfilter_grey_8(int64_t height, int64_t length, int64_t room, int64_t samples, const uint8_t *restrict rows,
                            int64_t pixel_bytes, uint8_t *restrict scratch, float *restrict found);
KERNEL void unfilter_grey_16(int64_t height, int64_t length, int64_t room, int64_t samples,
                             const uint8_t *restrict rows, int64_t pixel_bytes, uint8_t *restrict scratch,
                             float *restrict found);
KERNEL void unfilter_colour_8(int64_t height, int64_t length, int64_t room, int64_t samples,
                              const uint8_t *restrict rows, int64_t pixel_bytes, uint8_t *restrict scratch,
                              uint8_t *restrict found);
KERNEL void unfilter_colour_16(int64_t height, int64_t length, int64_t room, int64_t samples,
                               const uint8_t *restrict rows, int64_t pixel_bytes, uint8_t *restrict scratch,
                               uint16_t *restrict found);

/* localization.c */

/* Fill `found` [sectors, n] with likelihoods at `shifts` of sectors whose skyline is the map's; `wrong`: probability that
   it is anywhere. `gain` [0 or sectors, n] is added to F: see `gains_of_light`. */
KERNEL void clear_emissions(int64_t sectors, int64_t m, int64_t guides, int64_t n, int64_t gained,
                            const int64_t *restrict first, const double *restrict x, const double *restrict left,
                            const double *restrict right, const double *restrict bend, const double *restrict free,
                            const int32_t *restrict guide, const double *restrict scale, double highest, double wrong,
                            const double *restrict shifts, const double *restrict gain, double *restrict found);

/* Fill `found` [n, sectors] with what the light's log-likelihoods at `shifts` [n, sectors] gain where it stands higher by
   `lifts` [n, sectors] than the skyline. */
KERNEL void gains_of_light(int64_t sectors, int64_t m, int64_t guides, int64_t n, const int64_t *restrict first,
                           const double *restrict x, const double *restrict left, const double *restrict right,
                           const double *restrict bend, const double *restrict free, const int32_t *restrict guide,
                           double highest, const double *restrict shifts, const double *restrict lifts,
                           double *restrict found);

/* Fill `table` [sectors, levels, nodes] with likelihoods of the states but the first at shifts up to `reach` [sectors], on
   nodes closer to each other about 0. The levels' edges are `edge` [edges], each between `lower` and `upper`, which
   stand at `from` and `until`; level `risen` (from 1 on) hides everything. Scratch: [edges + 1, nodes]. */
KERNEL void prepare_levels(int64_t sectors, int64_t m, int64_t guides, int64_t edges, int64_t levels, int64_t nodes,
                           const int64_t *restrict first, const double *restrict x, const double *restrict integral,
                           const double *restrict free, const int32_t *restrict guide, const double *restrict scale,
                           const double *restrict hidden, double highest, double wrong, const double *restrict reach,
                           const double *restrict edge, const int64_t *restrict lower, const int64_t *restrict upper,
                           const double *restrict from, const double *restrict until, int64_t risen,
                           double *restrict scratch, float *restrict table);

/* Fill `found` [sectors, states] with likelihoods of all states at shifts [sectors]; levels = states - 1. `gain` [sectors]
   is added to F of the first state: see `gains_of_light`. */
KERNEL void emissions(int64_t sectors, int64_t m, int64_t guides, int64_t levels, int64_t states,
                      const int64_t *restrict first, const double *restrict x, const double *restrict left,
                      const double *restrict right, const double *restrict bend, const double *restrict integral,
                      const double *restrict free, const int32_t *restrict guide, const double *restrict scale,
                      const double *restrict hidden, double highest, double wrong, const double *restrict shift,
                      const double *restrict gain, const double *restrict from, const double *restrict until,
                      int64_t risen, double *restrict found);

/* Fill `found` [n] with log-likelihoods at `shifts` [n, sectors] of the chain of states around the circle, which is cut at
   the sector `cut` and closed over its states `closing`. `table` and `reach`: see `prepare_levels`. `light` [0 or
   sectors]: likelihoods of light with its own edge, beside the cells of the stars alone. `gains` [0 or n, sectors] of the
   first state: see `gains_of_light`. Probabilities from sector to sector: see obstacle_chain.py. Scratch: `states`
   [2 (levels + 3), 64], [4, sectors, 64]. */
KERNEL void chain_log_likelihoods(int64_t sectors, int64_t m, int64_t guides, int64_t star_cells, int64_t levels,
                                  int64_t nodes, int64_t lights, int64_t n, int64_t gained, int64_t closings,
                                  int64_t rows, const int64_t *restrict first, const double *restrict x, const double *restrict left,
                                  const double *restrict right, const double *restrict bend,
                                  const double *restrict free, const int32_t *restrict guide,
                                  const double *restrict scale, const int64_t *restrict star_first,
                                  const double *restrict star_x, const double *restrict star_left,
                                  const double *restrict star_right, const double *restrict star_bend,
                                  const double *restrict star_free, const int32_t *restrict star_guide,
                                  const double *restrict star_scale, double highest, double wrong,
                                  const double *restrict reach, const float *restrict table,
                                  const double *restrict light, int64_t risen, double risen_start, double risen_jump,
                                  double sunk_start, double sunk_jump, double stop, double keep, double near,
                                  const double *restrict shifts, const double *restrict gains, int64_t cut,
                                  const int64_t *restrict closing, float *restrict states, double *restrict scratch,
                                  double *restrict found);

/* Fill `post` [sectors, states] with the probabilities of the states of a closed chain, of likelihoods `e` and transitions
   `T` from rows to columns, by two rounds forward (which fill `f`) and backward. Scratch: [states + 2, states]. */
KERNEL void smooth_states(int64_t sectors, int64_t states, const double *restrict e, const double *restrict T,
                          double *restrict scratch, double *restrict f, double *restrict post);

/* Fill `found` [sectors] with log-likelihoods of each sector by those before it, of a curve at one of the heights [n] of
   widths `cells`, whose steps have the mean size `rough`, or lead anywhere with probability `jump`; n is at least 1.
   Scratch: [5, n]. */
KERNEL void pass_curve(int64_t sectors, int64_t n, const double *restrict likelihood, const double *restrict heights,
                       const double *restrict cells, double rough, double jump, double *restrict scratch,
                       double *restrict found);

/* profiles.c */

/* Fill `values` [m, knots], at horizons from `low` on, `step` apart (radians), with sums of l V + c V (1 - V) / 2 over
   the rows [n] from `first` to `last` [m], of widths `sigma`. `cdf` [4097]: see common.h. */
KERNEL void fill_profiles(int64_t n, int64_t m, int64_t knots, const double *restrict elevation,
                          const double *restrict llr, const double *restrict extended, const double *restrict sigma,
                          const int64_t *restrict first, const int64_t *restrict last, const double *restrict low,
                          const double *restrict step, const double *restrict cdf, double *restrict values);

/* Make cells (see profiles.h) between stars at heights `above` [stars], in order within a sector, whose first star is
   `starts`; a star above the skyline counts its `llr`. Window from `lowest` to `highest`. The number of cells, or -1
   where they are more than `room`: stars and 2 a sector are enough. */
KERNEL int64_t fill_cells(int64_t stars, int64_t sectors, int64_t room, const double *restrict above,
                          const double *restrict llr, const int64_t *restrict starts, double lowest, double highest,
                          int64_t *restrict first, double *restrict x, double *restrict left);

/* Make cells of those given [m], divided in widths of `cell` (radians) where the sky's light shows the skyline, with the
   `values` [sectors, knots] of that light at heights from `low` on, `step` apart; step 0: none. There are 4 knots at
   least. The number of cells, or -1 where they are more than `room`. */
KERNEL int64_t add_sky(int64_t sectors, int64_t m, int64_t knots, int64_t room, const int64_t *restrict old_first,
                       const double *restrict old_x, const double *restrict old_left, const double *restrict old_right,
                       const double *restrict old_bend, const double *restrict low, const double *restrict step,
                       const double *restrict cell, const double *restrict values, int64_t *restrict first,
                       double *restrict x, double *restrict left, double *restrict right, double *restrict bend);

/* Make cells of those given [m], with exp F averaged over a normal error `sigma` [sectors] of the skyline between `low`
   and `high`, in so many equal cells (`counts`); by bins that end at `ends` [between + 1] sigma, of `weights`. No
   mean is less than `least_mean`, relative to that over all heights. The number of cells, or -1 where they are more
   than `room`. Scratch: [between + 1]. */
KERNEL int64_t average_over_error(int64_t sectors, int64_t m, int64_t guides, int64_t between, int64_t room,
                                  const int64_t *restrict old_first, const double *restrict old_x,
                                  const double *restrict old_left, const double *restrict old_right,
                                  const double *restrict old_bend, const double *restrict old_integral,
                                  const double *restrict free, const int32_t *restrict guide,
                                  const double *restrict sigma, const double *restrict low, const double *restrict high,
                                  const int64_t *restrict counts, double highest, const double *restrict ends,
                                  const double *restrict weights, double least_mean, int64_t *restrict scratch,
                                  int64_t *restrict first, double *restrict x, double *restrict left,
                                  double *restrict right, double *restrict bend);

/* Fill `integral` [m] of exp(F - free) from the lowest height to x, `free` [sectors] (the logarithm of the mean of exp F
   over a window of that `width`), and the guide to cells of heights up to `highest`. Simpson's rule. */
KERNEL void integrate_cells(int64_t sectors, int64_t m, int64_t guides, const int64_t *restrict first,
                            const double *restrict x, const double *restrict left, const double *restrict right,
                            const double *restrict bend, double width, double highest, double *restrict integral,
                            double *restrict free, int32_t *restrict guide);

/* Fill mean and variance [sectors] of heights within `reach` (radians) of 0, by exp F. */
KERNEL void fill_moments(int64_t sectors, int64_t m, int64_t guides, const int64_t *restrict first,
                         const double *restrict x, const double *restrict left, const double *restrict right,
                         const double *restrict bend, const int32_t *restrict guide, double highest, double reach,
                         double *restrict mean, double *restrict variance);

/* search.c */

/* Add values [n] to `found` [sectors, count] at their places `at` (below 0: nowhere), then sum from the last place
   downwards. */
KERNEL void sum_above(int64_t n, int64_t sectors, int64_t count, const int64_t *restrict sector,
                      const double *restrict at, const double *restrict value, double *restrict found);

/* Fill `found` [sectors, count] with integrals of exp(F - best) up to elevations from `lowest` on, `step` apart, and
   `best` [sectors] with the greatest F at an end of a cell. */
KERNEL void fill_integral(int64_t sectors, int64_t m, int64_t count, const int64_t *restrict first,
                          const double *restrict x, const double *restrict left, const double *restrict right,
                          const double *restrict integral, const double *restrict free, double lowest, double step,
                          double *restrict found, double *restrict best);

/* Logarithm of the trace around the circle: every so many sectors are clear [n], or all is `hidden` [sectors]. `hide` and
   `stop`: probabilities to hide all from one sector to the next, and no longer. */
KERNEL double log_circle(int64_t n, int64_t sectors, const double *restrict clear, const double *restrict hidden,
                         int64_t every, double hide, double stop);

/* Fill `found` [n] with upper bounds of log-likelihoods where skylines are between `low` and `high` [n, sectors]. The
   tables [sectors, count] begin at `lowest` and are `step` apart; `epsilon`: least likelihood of a sector beside its
   best. NaN counts as the lowest elevation. Scratch: [sectors]. */
KERNEL void fill_bounds(int64_t sectors, int64_t count, int64_t n, const double *restrict visible,
                        const double *restrict open_from, const double *restrict open_above,
                        const double *restrict best, const double *restrict hidden, const double *restrict low,
                        const double *restrict high, double lowest, double step, double epsilon, double hide,
                        double stop, double *restrict scratch, double *restrict found);

/* Fill `found` [n] with log-likelihoods where skylines are anywhere between `low` and `high` [n, seen], of evenly spread
   sectors. Scratch: [seen]. */
KERNEL void fill_averages(int64_t sectors, int64_t count, int64_t n, int64_t seen, const double *restrict integral,
                          const double *restrict hidden, const double *restrict low, const double *restrict high,
                          double lowest, double step, double epsilon, double hide, double stop,
                          double *restrict scratch, double *restrict found);

/* crests.c */

/* Fill the moments of skylines [n] seen from `points` [n, 2] at `azimuths` [n], on ground whose posts err by `sigma` (m).
   `tan` and `distance` [n] are those of the map. `mean` and `own` [n]: mean tangent, and its variance that follows no
   post. `post` and `response` [n, 64]: posts, and the mean rise of the tangent by a metre of each, as of a camera that
   stays where it is; post -1: none. Where no place of a map makes the skyline, as at the edge where a ray leaves the
   maps, it is the map's own, wrong by `sigma` at its distance. `cdf` [4097]: see common.h. */
KERNEL void crests(int64_t n, const struct ground *restrict ground, double camera_height, double sigma,
                   const double *restrict points, const double *restrict azimuths, const double *restrict tan,
                   const double *restrict distance, const double *restrict cdf, double *restrict mean,
                   double *restrict own, int64_t *restrict post, double *restrict response);

/* horizons.c */

/* Fill `up` [n] with the height in enu of the ground at `points` [n, 2] (m). Beyond the maps: 0. */
KERNEL void surfaces(int64_t n, const struct ground *restrict ground, const double *restrict points,
                     double *restrict up);

/* Fill `found` [n, m] with the horizon (radians) at `points` [n, 2] and columns [rows, m], of each point (rows n) or of
   all (rows 1): bilinear between nodes [azimuths, across, across], the east first, about (east, north) from -half to
   half, less `per_height` [azimuths] times the ground's height above `middle`. */
KERNEL void interpolate_horizons(int64_t azimuths, int64_t across, int64_t n, int64_t rows, int64_t m,
                                 const struct ground *restrict ground, const double *restrict nodes,
                                 const double *restrict per_height, double middle, double east, double north,
                                 double half, const double *restrict points, const int64_t *restrict column,
                                 double *restrict found);

/* Fill `found` [n, m] with elevations (radians) of a circular rim about the origin, `wall` above `points` [n, 2], at
   azimuths [m]; pi/2 from beyond the rim. */
KERNEL void horizons_of_circle(int64_t n, int64_t m, const double *restrict points, const double *restrict sines,
                               const double *restrict cosines, double radius, double wall, double *restrict found);

/* horizon_table.c */

/* Fill `tan`, `distance` and `edge` [n] with the horizon of each of `points` [n, 2] at its azimuth [n]: its tangent, its
   distance, and the distance at which maps end or have a void (1e9: beyond the horizon). Of a table that is not the
   map's own (`is_own`), but of a similar one, only first sight lines are taken. */
KERNEL void trace_horizons(int64_t n, const struct ground *restrict ground, const struct table *restrict table,
                           double camera_height, bool is_own, const double *restrict points,
                           const double *restrict azimuths, double *restrict tan, double *restrict distance,
                           double *restrict edge);

/* Fill `low` and `high` [n] (radians) with bounds over boxes of `half` sides [n] at `centres` [n, 2] and azimuths [n]
   within `turn` [n], traced anew. */
KERNEL void box_bounds(int64_t n, const struct ground *restrict ground, const struct table *restrict table,
                       double camera_height, const double *restrict centres, const double *restrict half,
                       const double *restrict azimuths, const double *restrict turn, double *restrict low,
                       double *restrict high);

/* Fill `low` and `high` [n, m] (radians) with bounds over boxes, and azimuths [rows, m] within `turn` of each box (rows
   n) or of all (rows 1), from the table. `lows` and `highs` [blocks, blocks, bins]: of its level that fits. Boxes smaller than a
   cell take the lines and points of the cells they touch, larger ones the bounds of the level's blocks. */
KERNEL void sector_bounds(int64_t blocks, int64_t bins, int64_t rows, int64_t m, int64_t n,
                          const struct ground *restrict ground, const struct table *restrict table,
                          const uint16_t *restrict lows, const uint16_t *restrict highs, double camera_height,
                          const double *restrict azimuths, const double *restrict turn, const double *restrict centres,
                          const double *restrict half, double *restrict low, double *restrict high);

/* Fill `found` [n, m, 11] for boxes of one size at `centres` [n, 2] and azimuths [m] within `turn`:
   0, 1: bounds of the horizon's tangent; 2, 3: range of distances s from the middle of the ground that may make the
   horizon; 4: s of the middle's horizon; 5: its tangent t; 6: a such that this ground is no higher than a + t s on the
   middle line, and 9: g such that it is no higher than that plus g w at w aside; 7, 8: an s and a height that the
   ground reaches everywhere there, and 10: the slope to the side that this assumes. */
KERNEL void fill_table(int64_t n, int64_t m, const struct ground *restrict ground, const double *restrict centres,
                       double half, double camera_height, const double *restrict sines, const double *restrict cosines,
                       double turn, double *restrict found);

/* Fill `low` and `high` [n, azimuths] from the `bounds` [slots, 2, azimuths] kept in the slots of the `keys`
   [n, numbers], where the numbers kept there are the same; `missing` [n]: they are not. */
KERNEL void recall_bounds(int64_t slots, int64_t numbers, int64_t azimuths, int64_t n, const uint64_t *restrict kept,
                          const double *restrict bounds, const uint64_t *restrict keys, double *restrict low,
                          double *restrict high, bool *restrict missing);

/* Keep these in the slots of their keys. */
KERNEL void keep_bounds(int64_t slots, int64_t numbers, int64_t azimuths, int64_t n, uint64_t *restrict kept,
                        double *restrict bounds, const uint64_t *restrict keys, const double *restrict low,
                        const double *restrict high);

/* Fill `found` [n, m] with the largest of the values [across, across, bins], or 0, of the cells from the first to the
   last [n, 2, 2] of each box, in bins [rows, m, turns] of each box (rows n) or of all (rows 1). */
KERNEL void largest_of_cells(int64_t across, int64_t bins, int64_t n, int64_t rows, int64_t m, int64_t turns,
                             const float *restrict values, const int64_t *restrict cells,
                             const int64_t *restrict bin, double *restrict found);

/* matches.c */

/* Ascending indices `kept` [n] of the pairs of a detection and a star [n] that are each other's cheapest and agree in
   brightness; how many there are. The cost is the distance (infinite: none) and `px_per_mag` for a magnitude by which
   the measured one [m] of the detection differs beyond 2 sigma. `misfit` [n]: that difference, 1 at `dimmed_mag` or
   `brighter_mag`. A saturated detection [m] may be fainter by any amount. Detections ascend. Scratch: `cost`; `of_slot`,
   whose size is a power of 2, at least 2 n. */
KERNEL int64_t compare_pairs(int64_t n, int64_t m, int64_t slots, const int64_t *restrict detection,
                             const int64_t *restrict star, const double *restrict distance,
                             const double *restrict v_mag, const double *restrict v_sigma_mag,
                             const double *restrict measured_mag, const bool *restrict saturated, double brighter_mag,
                             double dimmed_mag, double px_per_mag, double *restrict cost, int64_t *restrict of_slot,
                             double *restrict misfit, int64_t *restrict kept);

/* Number of pairs of a star [n] and an ascending measured magnitude [m] that is less than `dimmed_mag` fainter and at
   most `brighter_mag` brighter. Fast where the stars ascend. */
KERNEL int64_t count_alike(int64_t n, int64_t m, const double *restrict v_mag, const double *restrict measured_mag,
                           double brighter_mag, double dimmed_mag);

/* photometry.c */

/* Fill `measured` [n, 4] (flux, its variance, variance per electron of its own light, variance by neighbours) and
   `usable` [n] for stars at `xy_px` [n, 2], whose stamps of 2 radius + 1 pixels lie inside the image [height, width].
   The stars are ordered by square cells of `side_px`, of `columns` a row; `first` [cells + 1] is each cell's first.
   Neighbours within `reach_px` (at most `side_px`) count by their expected flux, its relative error and their
   probability to be visible [n]. `background` and `noise` are rows, one at least, in the middles of blocks of so many
   rows.
   `outlier`: squared sigma from which a pixel is masked, at most `most_masked`; `model`: variance of a star's squared
   light; `shape_variance`: of the part by which the background's shape is wrong. `edges` [2, phases + 1, table_places]:
   light of an edge and its slope, at places `step_px` (of the PSF's width `sigma_px`) apart; `flat_excess`,
   `width_part`, `contrast_sigmas`: see photometry.py. Scratch: `across` to `near`; `stamp` [8, room], room: the pixels
   of a stamp, filled up to a multiple of 8; `sums` [15, 32], at most 32 places. The image is finite, in dead pixels
   too. */
KERNEL void measure_sources(int64_t height, int64_t width, int64_t background_rows, int64_t noise_rows, int64_t n,
                            int64_t cells, int64_t steps, int64_t wide, int64_t phases, int64_t table_places,
                            int64_t room, const float *restrict image, const float *restrict background,
                            const float *restrict noise, const bool *restrict dead, int64_t background_side,
                            int64_t noise_side, const double *restrict xy_px, const double *restrict flux_e,
                            const double *restrict fraction_sigma, const double *restrict visible,
                            const int64_t *restrict first, int64_t columns, double reach_px, double side_px,
                            int64_t radius, float outlier, float model, float shape_variance, int64_t most_masked,
                            const double *restrict profiles, const float *restrict edges, double sigma_px,
                            double step_px, double flat_excess, double width_part, double contrast_sigmas,
                            int64_t places, float *restrict across, float *restrict down, int64_t *restrict centre,
                            int64_t *restrict near, float *restrict stamp, double *restrict sums,
                            double *restrict measured, bool *restrict usable);

/* point_sources.c: stamps [n, side, side] of an odd side, 3 at least, of light above the background and of its
   variance; places are pixels from the middle pixel, at most 4 radii of a stamp (NaN: the lowest); `usable_rows` is n, or 0: all
   pixels are usable.
   Scratch: `profiles` [7, side + 1], `pixels` [7, room], room: the pixels of a stamp, filled up to a multiple of 8. */

/* Fit one source of a PSF `sigma_px` wide to each of the stamps `which` [m], in so many `rounds` from `start_px` on.
   `signal` [signals, side, side], light of neighbours with the relative error `signal_error`, is subtracted; `signals`
   is m, or 0: there is none. `per_unit` and `model_error`: noise of the source's own light; `surround` [m]: level of its
   surroundings. A step is at most `max_step_px`; priors (1 / variance) of a step in place and in flux, and of the level,
   keep sources without light solvable. Outputs: places `xy_px` [m, 2]; `covariance` of x, y, flux and level; `values` [m, 8]: flux, level,
   chi^2, chi^2 of a single pixel, usable pixels, and the sums of the matched filter times the light above the
   surroundings, times the profile, and times the profile with the noise of the own photons. */
KERNEL void fit_stamps(int64_t n, int64_t side, int64_t usable_rows, int64_t signals, int64_t m, int64_t room,
                       const float *restrict data, const float *restrict variance, const bool *restrict usable,
                       const float *restrict signal, double signal_error, const int64_t *restrict which,
                       const double *restrict start_px, double sigma_px, double per_unit, double model_error,
                       int64_t rounds, double max_step_px, double position_prior, double flux_prior,
                       const double *restrict surround, double *restrict profiles, float *restrict pixels,
                       double *restrict xy_px, double *restrict values, double *restrict covariance);

/* Fill `signal` [count, side, side] with the light of sources in the stamps of the different ones among `star` [m],
   which is sorted. The sources are at `offset_px` [m, 2] there. `changed` [count]: whether the light and its difference
   from `last` exceed `limit_sigma` of a pixel's noise. */
KERNEL void sum_neighbours(int64_t m, int64_t n, int64_t side, int64_t count, const int64_t *restrict star,
                           const double *restrict offset_px, const double *restrict flux, double sigma_px,
                           const float *restrict variance, double limit_sigma, const float *restrict last,
                           double *restrict profiles, float *restrict signal, bool *restrict changed);

/* Fill `misfit` [m] to the PSF, and chi^2 as an `edge` [m], for the sources of the stamps `which` [m], of widths
   `width_px`. `stripe`: the number of the stripe of each pixel in each direction, counted on from one direction to the
   next; `ends` [directions]: the number behind each direction's last. Scratch: `sums` [stripes, 2], `pixels` [4, room]. */
KERNEL void compare_shapes(int64_t n, int64_t side, int64_t usable_rows, int64_t m, int64_t directions, int64_t stripes,
                           int64_t room, const float *restrict data, const float *restrict variance,
                           const bool *restrict usable, const int64_t *restrict which, const double *restrict offset_px,
                           const double *restrict flux, const double *restrict level, const double *restrict width_px,
                           double per_unit, double model_error, const int64_t *restrict stripe,
                           const int64_t *restrict ends, double *restrict profiles, float *restrict sums,
                           float *restrict pixels, double *restrict misfit, double *restrict edge);

/* Fill for the fitted sources of all stamps: their `signal`; the `squared` residual, corrected by the leverage of the
   pixel; the `relative` residual, of unit mean square in each stamp; which pixels are `lit` by more than `faint` of their
   variance, with a leverage below `most_leverage`. `covariance` is that of place, flux and level. */
KERNEL void fill_squared_residuals(int64_t n, int64_t side, const float *restrict data, const float *restrict variance,
                                   const double *restrict offset_px, const double *restrict flux,
                                   const double *restrict level, const double *restrict covariance, double sigma_px,
                                   double model_error, double faint, double most_leverage, double *restrict profiles,
                                   double *restrict signal, double *restrict squared, double *restrict relative,
                                   bool *restrict lit);

/* Fill `explained` [n, m]: how much a star of each width on a constant level reduces chi^2 of the stamps, whose pixels
   have `weights` (1 / variance); and `variance` [n]: chi^2 of a constant level alone. */
KERNEL void explain_by_widths(int64_t n, int64_t side, int64_t m, const float *restrict data,
                              const float *restrict weights, const double *restrict offset_px,
                              const double *restrict widths_px, double *restrict profiles, double *restrict explained,
                              double *restrict variance);

/* radial_fit.c */

/* Fill `px` [n, 2] with the pixels of rays [n, 3] that `R` [3, 3] turns into the camera's frame, and `inside` [n] with
   which lie in the frame and in the image circle. `lens`: logarithms of focal length (pixels) and aspect, bend, centre
   x and y (pixels). `mirror`: -1 for a mirror image, else 1. */
KERNEL void project_radial(int64_t n, const double *restrict rays_icrs, const double *restrict R,
                           const double *restrict lens, double mirror, double width, double height,
                           double *restrict px, bool *restrict inside);

/* Change `R` and the `free` parameters of the `lens` by Gauss-Newton steps to matches of pixels [n, 2] and rays [n, 3],
   some of them wrong: one counts half where its squared residual is `half_chi2` sigma_px^2. The parameters are
   `expected` to a sigma, those of the centre in focal lengths. No step is longer than `longest` (radians, logarithms,
   focal lengths). `ridge`: added to the diagonal of the normal equations, which is 1. */
KERNEL void fit_radial(int64_t n, const double *restrict xy_px, const double *restrict rays_icrs, double mirror,
                       double sigma_px, double half_chi2, int64_t steps, const bool *restrict free,
                       const double *restrict expected, const double *restrict expected_sigma, double longest,
                       double ridge, double *restrict R, double *restrict lens);

/* simulation.c */

/* Fill `found` [n, 5] for stars at `xy_px` [n, 2] with sums over others [m] within `reach_px`, at most `side_px`; the
   others are ordered by cells as in `measure_sources`. `number` [m]: another one's index among the stars, or -1. The
   weights of a stamp are those of linear least squares for flux and level, (P - mean(P)) / S with
   S = sum P (P - mean(P)). Columns: parts of the others' light that they collect, times `weight`; the variance that
   each of their electrons adds, times `weight`; squares of the parts, times `square_weight`; the variance that each
   electron of the star itself adds; S. No position is negative. Profiles and middle pixels as of `profiles_of`; the
   profiles are 0 as far from their middle as a stamp of another star reaches. */
KERNEL void collect_light(int64_t n, int64_t wide, int64_t m, int64_t cells, const double *restrict xy_px,
                          const float *restrict across, const float *restrict down, const int64_t *restrict centre,
                          const double *restrict others_px, const float *restrict others_across,
                          const float *restrict others_down, const int64_t *restrict others_centre,
                          const int64_t *restrict number, const double *restrict weight,
                          const double *restrict square_weight, const int64_t *restrict first, int64_t columns,
                          double side_px, double reach_px, int64_t radius, double *restrict found);

/* star_profiles.c */

/* Fill `across` and `down` [n, wide] with the profiles of stars at `xy_px` [n, 2] in x and in y about their middle
   pixels, which are `centre` [n, 2]. `profiles` [steps + 1, wide] are those at offsets from -1/2 to 1/2. Positions are
   finite. */
KERNEL void profiles_of(int64_t n, int64_t steps, int64_t wide, const double *restrict xy_px,
                        const double *restrict profiles, float *restrict across, float *restrict down,
                        int64_t *restrict centre);

/* triangles.c */

/* Fill `first` [places + 1] with the begin of each cell in the list `star` [n] of rays [n, 3] by cells, which keeps their
   order. A cube from -1 to 1 has `cells` cells on a side, places = cells^3. NaN counts as -1. */
KERNEL void bin_stars(int64_t n, int64_t places, const double *restrict rays, int64_t cells, int32_t *restrict first,
                      int64_t *restrict star);

/* The number of pairs of a ray [m, 3] and a star [n] closer than the `chord`, by the cells of `bin_stars`; `star_rays`
   [n, 3] are in the order of `star`. Ray, star and distance of each are written, as far as there is `room`. */
KERNEL int64_t find_stars(int64_t m, int64_t places, int64_t n, int64_t room, const double *restrict rays,
                          double chord, int64_t cells, const int32_t *restrict first, const int64_t *restrict star,
                          const double *restrict star_rays, int64_t *restrict of_ray, int64_t *restrict of_star,
                          double *restrict apart);

/* Write the triangles [room, 3] of rays [n, 3] with sides (chords) below `longest` and a vertex from `fresh` on, and
   their ascending sides [room, 3]; vertices are in the order of the opposite side. Their number. Scratch: `chord`. */
KERNEL int64_t sides_of_few(int64_t n, int64_t room, const double *restrict rays, int64_t fresh, double longest,
                            double *restrict chord, int64_t *restrict vertices, double *restrict sides);

/* Fill `same` [m] with which triples of rays [m, 3, 3] have triple products of the same sign. */
KERNEL void are_same_handed(int64_t m, const double *restrict one, const double *restrict other, bool *restrict same);

/* Fill `off` [k] with the greatest difference of a side of pairs of triangles, a `row` of `sides` [m, 3] and one `found`
   among the `known` [n, 3], relative to the shortest side; infinite from the `tolerance` on. */
KERNEL void largest_differences(int64_t m, int64_t n, int64_t k, const double *restrict sides,
                                const double *restrict known, const int64_t *restrict row,
                                const int64_t *restrict found, double tolerance, double *restrict off);

/* Write into `kept` [n] the pairs of finite difference `off` [n], in their `order` [n], that are the first `each` of
   their row; how many there are. Scratch: `count` [rows]. */
KERNEL int64_t keep_closest(int64_t n, int64_t rows, const int64_t *restrict order, const double *restrict off,
                            const int64_t *restrict row, int64_t each, int64_t *restrict count,
                            int64_t *restrict kept);

#endif
