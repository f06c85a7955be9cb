#include "startrack_kernels.h"

#if defined(__x86_64__)
#include <cpuid.h>

#define BITS_1_ECX (1u << 12 | 1u << 22 | 1u << 27 | 1u << 28 | 1u << 29) /* FMA, MOVBE, OSXSAVE, AVX, F16C */
#define BITS_7_EBX (1u << 3 | 1u << 5 | 1u << 8)                         /* BMI1, AVX2, BMI2 */
#define BIT_LZCNT (1u << 5)
#define AVX_STATE 6u /* the system keeps the registers of SSE and AVX */

bool has_x86_64_v3(void)
{
    unsigned a, b, c, d, low, high;
    if (!__get_cpuid(1, &a, &b, &c, &d) || (c & BITS_1_ECX) != BITS_1_ECX)
        return false;
    __asm__ volatile("xgetbv" : "=a"(low), "=d"(high) : "c"(0));
    if ((low & AVX_STATE) != AVX_STATE)
        return false;
    if (!__get_cpuid_count(7, 0, &a, &b, &c, &d) || (b & BITS_7_EBX) != BITS_7_EBX)
        return false;
    return __get_cpuid(0x80000001u, &a, &b, &c, &d) && (c & BIT_LZCNT);
}
#else
bool has_x86_64_v3(void)
{
    return false;
}
#endif

const char *compiler_name(void)
{
#if defined(__clang__) || !defined(__GNUC__)
    return __VERSION__;
#else
    return "gcc " __VERSION__;
#endif
}

#if !defined(FLAGS) /* build.py states them */
#define FLAGS ""
#endif

const char *compiler_flags(void)
{
    return FLAGS;
}
