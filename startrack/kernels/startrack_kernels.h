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

/* core.c */

/* Replace the azimuths in `found` [n] (radians, any turn) by the linear interpolation of `values` [m], which stand at
   even steps around the circle from azimuth 0 on. No value: 0. A NaN or infinite azimuth gives NaN. */
KERNEL void interpolate_circle(int64_t m, int64_t n, const double *restrict values, double *restrict found);

#endif
