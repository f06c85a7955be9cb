/* The inner loops of startrack: functions over plain arrays.

   Rules for all of them:
   - The sizes come first. Arrays are contiguous in C order; their shapes stand in brackets in the comments.
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

/* Rows of comma-separated fields `rows` [n] from the lines [n] of several columns one after another, which begin at
   `at` [columns]; `at` is advanced. The end of the rows, or -1 where a column has fewer lines than another. */
KERNEL int64_t join_columns(int64_t n, int64_t columns, const uint8_t *restrict lines, int64_t *restrict at,
                            uint8_t *restrict rows);

/* Write the `values` [n] into `out` [room], 32 bytes for each, a line break after each, as %.<digits>g where
   `is_general`, else as %.<digits>f; nothing for NaN. Digits: 1 to 9. Magnitudes: below 1e15 / 10**digits, or of general
   ones 0 and 1e-12 to 1e15. The end of what was written. */
KERNEL int64_t write_numbers(int64_t n, int64_t room, const double *restrict values, int64_t digits, bool is_general,
                             uint8_t *restrict out);

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
   and write the samples; false where a filter is unknown, whose row counts as unfiltered. `pixel_bytes`: of a pixel, at
   least 1. `scratch` [2, room] is zero; room = length + pixel_bytes, length = samples times their bytes. */
KERNEL bool unfilter_grey_8(int64_t height, int64_t length, int64_t room, int64_t samples, const uint8_t *restrict rows,
                            int64_t pixel_bytes, uint8_t *restrict scratch, float *restrict found);
KERNEL bool unfilter_grey_16(int64_t height, int64_t length, int64_t room, int64_t samples,
                             const uint8_t *restrict rows, int64_t pixel_bytes, uint8_t *restrict scratch,
                             float *restrict found);
KERNEL bool unfilter_colour_8(int64_t height, int64_t length, int64_t room, int64_t samples,
                              const uint8_t *restrict rows, int64_t pixel_bytes, uint8_t *restrict scratch,
                              uint8_t *restrict found);
KERNEL bool unfilter_colour_16(int64_t height, int64_t length, int64_t room, int64_t samples,
                               const uint8_t *restrict rows, int64_t pixel_bytes, uint8_t *restrict scratch,
                               uint16_t *restrict found);

/* localization.c */

/* Fill `found` [sectors, n] with likelihoods at `shifts` of sectors whose skyline is the map's; `wrong`: probability that
   it is anywhere. */
KERNEL void clear_emissions(int64_t sectors, int64_t m, int64_t guides, int64_t n, const int64_t *restrict first,
                            const double *restrict x, const double *restrict left, const double *restrict right,
                            const double *restrict bend, const double *restrict free, const int32_t *restrict guide,
                            const double *restrict scale, double highest, double wrong, const double *restrict shifts,
                            double *restrict found);

/* Fill `found` [sectors, n] with logarithms of likelihoods of sectors that show the map's skyline with probabilities
   `clear` [sectors], else anything. */
KERNEL void clear_logs(int64_t sectors, int64_t m, int64_t guides, int64_t n, const int64_t *restrict first,
                       const double *restrict x, const double *restrict left, const double *restrict right,
                       const double *restrict bend, const double *restrict free, const int32_t *restrict guide,
                       const double *restrict scale, double highest, double wrong, const double *restrict shifts,
                       const double *restrict clear, double *restrict found);

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

/* Fill `found` [sectors, states] with likelihoods of all states at shifts [sectors]; levels = states - 1. */
KERNEL void emissions(int64_t sectors, int64_t m, int64_t guides, int64_t levels, int64_t states,
                      const int64_t *restrict first, const double *restrict x, const double *restrict left,
                      const double *restrict right, const double *restrict bend, const double *restrict integral,
                      const double *restrict free, const int32_t *restrict guide, const double *restrict scale,
                      const double *restrict hidden, double highest, double wrong, const double *restrict shift,
                      const double *restrict from, const double *restrict until, int64_t risen, double *restrict found);

/* Fill `found` [n] with log-likelihoods at `shifts` [n, sectors] of the chain of states around the circle, which is cut at
   the sector `cut` and closed over its states `closing`. `table` and `reach`: see `prepare_levels`. `light` [0 or
   sectors]: likelihoods of light with its own edge, beside the cells of the stars alone. Probabilities from sector to
   sector: see obstacle_chain.py. Scratch: `states` [2 (levels + 3), 64], [3, sectors, 64]. */
KERNEL void chain_log_likelihoods(int64_t sectors, int64_t m, int64_t guides, int64_t star_cells, int64_t levels,
                                  int64_t nodes, int64_t lights, int64_t n, int64_t closings, int64_t rows,
                                  const int64_t *restrict first, const double *restrict x, const double *restrict left,
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
                                  const double *restrict shifts, int64_t cut, const int64_t *restrict closing,
                                  float *restrict states, double *restrict scratch, double *restrict found);

/* Fill `post` [sectors, states] with the probabilities of the states of a closed chain, of likelihoods `e` and transitions
   `T` from rows to columns, by two rounds forward (which fill `f`) and backward. Scratch: [states + 2, states]. */
KERNEL void smooth_states(int64_t sectors, int64_t states, const double *restrict e, const double *restrict T,
                          double *restrict scratch, double *restrict f, double *restrict post);

/* Fill `found` [sectors] with log-likelihoods of each sector by those before it, of a curve at one of the heights [n] of
   widths `cells`, whose steps have the mean size `rough`, or lead anywhere with probability `jump`. Scratch: [5, n]. */
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
   `values` [sectors, knots] of that light at heights from `low` on, `step` apart; step 0: none. The number of cells, or
   -1 where they are more than `room`. */
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
   probability to be visible [n]. `background` and `noise` are rows in the middles of blocks of so many rows.
   `outlier`: squared sigma from which a pixel is masked, at most `most_masked`; `model`: variance of a star's squared
   light; `shape_variance`: of the part by which the background's shape is wrong. `edges` [2, phases + 1, table_places]:
   light of an edge and its slope, at places `step_px` (of the PSF's width `sigma_px`) apart; `flat_excess`,
   `width_part`, `contrast_sigmas`: see stamp_edge.py. Scratch: `across` to `near`; `stamp` [8, room], room: the pixels
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
