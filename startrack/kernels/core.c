#include <math.h>

#include "common.h"
#include "startrack_kernels.h"

#define NUMBER_ROOM 32 /* bytes of a number and its line break, at most */


void interpolate_circle(int64_t m, int64_t n, const double *restrict values, double *restrict found)
{
    const double per_rad = (double)m / TURN;
    for (int64_t k = 0; k < n; k++) {
        double at = found[k] * per_rad;
        if (!isfinite(at) || m == 0) {
            found[k] = m == 0 ? 0.0 : NAN;
            continue;
        }
        if (at < 0.0 || at >= (double)m) {
            at = fmod(at, (double)m);
            if (at < 0.0)
                at += (double)m;
        }
        int64_t low = (int64_t)at;
        if (low > m - 1)
            low = m - 1;
        const double part = at - (double)low;
        found[k] = (1.0 - part) * values[low] + part * values[low + 1 < m ? low + 1 : 0];
    }
}

int64_t join_columns(int64_t n, int64_t columns, const uint8_t *restrict lines, int64_t *restrict at,
                     uint8_t *restrict rows)
{
    int64_t to = 0;
    while (to < n) {
        for (int64_t c = 0; c < columns; c++) {
            while (at[c] < n && lines[at[c]] != '\n' && to < n)
                rows[to++] = lines[at[c]++];
            if (at[c] >= n || to >= n)
                return -1;
            rows[to++] = c == columns - 1 ? '\n' : ',';
            at[c]++;
        }
    }
    return to;
}

/* The upper 26 bits of a number (Veltkamp). */
static double high_half(double x)
{
    const double large = 134217729.0 * x;
    return large - (large - x);
}

/* a b - product, exactly (Dekker 1971). */
static double product_error(double a, double b, double product)
{
    const double high_a = high_half(a), high_b = high_half(b), low_a = a - high_a, low_b = b - high_b;
    return ((high_a * high_b - product) + high_a * low_b + low_a * high_b) + low_a * low_b;
}

static double power_of_ten(int power)
{
    double found = 1.0; /* exact up to 10**22 */
    for (int k = 0; k < power; k++)
        found *= 10.0;
    return found;
}

/* value * 10**power, rounded to an integer: half to even, as of the exact product. */
static int64_t scaled(double value, int power)
{
    const double scale = power_of_ten(power < 0 ? -power : power);
    const double product = power >= 0 ? value * scale : value / scale, low = floor(product), rest = product - low;
    bool up = rest > 0.5;
    if (rest == 0.5) { /* rounded to it, perhaps: the sign of what the rounding took away */
        const double error = power >= 0 ? product_error(value, scale, product) : value - product * scale;
        up = error > 0.0 || (error == 0.0 && fmod(low, 2.0) == 1.0);
    }
    return (int64_t)low + (up ? 1 : 0);
}

/* Write whole / 10**decimals with that many decimals; the end. */
static uint8_t *write_fixed(uint8_t *out, int64_t whole, int decimals)
{
    uint8_t digits[24];
    int count = 0;
    for (; count <= decimals || whole > 0; count++) {
        digits[count] = (uint8_t)('0' + whole % 10);
        whole /= 10;
    }
    while (count > 0) {
        if (count == decimals)
            *out++ = '.';
        *out++ = digits[--count];
    }
    return out;
}

/* Write as %.<digits>g; the end. */
static uint8_t *write_general(uint8_t *out, double value, int digits)
{
    if (value == 0.0) {
        *out++ = '0';
        return out;
    }
    const int64_t most_whole = (int64_t)power_of_ten(digits);
    int exponent = (int)floor(log10(value));
    int64_t whole = scaled(value, digits - 1 - exponent);
    if (whole < most_whole / 10) /* the logarithm was rounded up */
        whole = scaled(value, digits - 1 - --exponent);
    if (whole >= most_whole)
        whole = scaled(value, digits - 1 - ++exponent);
    const bool is_plain = -4 <= exponent && exponent < digits;
    int decimals = is_plain ? digits - 1 - exponent : digits - 1;
    while (decimals > 0 && whole % 10 == 0) {
        whole /= 10;
        decimals--;
    }
    out = write_fixed(out, whole, decimals);
    if (!is_plain) {
        const int size = exponent < 0 ? -exponent : exponent;
        *out++ = 'e';
        *out++ = exponent > 0 ? '+' : '-';
        *out++ = (uint8_t)('0' + size / 10);
        *out++ = (uint8_t)('0' + size % 10);
    }
    return out;
}

int64_t write_numbers(int64_t n, int64_t room, const double *restrict values, int64_t digits, bool is_general,
                      uint8_t *restrict out)
{
    uint8_t *at = out;
    for (int64_t k = 0; k < n && at + NUMBER_ROOM <= out + room; k++) {
        if (values[k] == values[k]) {
            if (signbit(values[k]))
                *at++ = '-';
            const double size = fabs(values[k]);
            at = is_general ? write_general(at, size, (int)digits)
                            : write_fixed(at, scaled(size, (int)digits), (int)digits);
        }
        *at++ = '\n';
    }
    return at - out;
}
