// Samples: functions of sampling.py with the same names and bits, in loops that compilers vectorise.
#pragma once
#include "layout.h"

namespace wrt {

static inline unsigned reverse_bits(unsigned x) {
#if defined(__clang__)
    return __builtin_bitreverse32(x);
#else
    x = ((x >> 1) & BITS_1) | ((x & BITS_1) << 1);
    x = ((x >> 2) & BITS_2) | ((x & BITS_2) << 2);
    x = ((x >> 4) & BITS_4) | ((x & BITS_4) << 4);
    return __builtin_bswap32(x);
#endif
}

static inline unsigned hash_u32(unsigned x) {
    x ^= x >> 16;
    x *= HASH_1;
    x ^= x >> 15;
    x *= HASH_2;
    return x ^ (x >> 15);
}

static inline unsigned laine_karras(unsigned x, unsigned seed) {
    x ^= x * LK_1;
    x += seed;
    x *= (seed >> 16) | 1;
    x ^= x * LK_2;
    return x ^ (x * LK_3);
}

static inline unsigned sobol_second(unsigned x) {
    x ^= (x >> 1) & BITS_1;
    x ^= (x >> 2) & BITS_2;
    x ^= (x >> 4) & BITS_4;
    x ^= (x >> 8) & BITS_8;
    return x ^ (x >> 16);
}

static inline float unit_float(unsigned x) { return (float)(x >> 8) * UNIT; }

// Store the points first .. first + count - 1 of sample_2d's sequence in `to`. The seed is hash_pair(key, dimension). `to` must have
// room for LANES - 1 more points, which are overwritten.
static inline void sample_2d(unsigned seed, unsigned first, int count, float* to) {
    const unsigned seed_x = hash_u32(seed ^ SEED_X), seed_y = hash_u32(seed ^ SEED_Y);
    for (int j = 0; j < count; j += LANES) {
        float points[2 * LANES];
        for (int lane = 0; lane < LANES; ++lane) {
            const unsigned i = reverse_bits(laine_karras(reverse_bits(first + j + lane), seed));
            points[2 * lane] = unit_float(reverse_bits(laine_karras(i, seed_x)));
            points[2 * lane + 1] = unit_float(reverse_bits(laine_karras(sobol_second(i), seed_y)));
        }
        __builtin_memcpy(to + 2 * j, points, sizeof(points));
    }
}

// Replace `count` values in [0, 1) by their quantiles. `icdf`, the inverse distribution, has `size` entries. Results go to the local
// array `out` first: otherwise the compiler must assume that storing them changes the table.
static inline void quantile(const float* icdf, int size, float* values, int count) {
    for (int j = 0; j < count; j += LANES) {
        const int n = count - j < LANES ? count - j : LANES;
        float in[LANES] = {}, out[LANES];
        __builtin_memcpy(in, values + j, sizeof(float) * n);
        for (int lane = 0; lane < LANES; ++lane) {
            const float position = in[lane] * (float)(size - 1);
            const int whole = (int)position, i = whole < size - 2 ? whole : size - 2;
            const float t = position - (float)i;
            out[lane] = icdf[i] * (1.0f - t) + icdf[i + 1] * t;
        }
        __builtin_memcpy(values + j, out, sizeof(float) * n);
    }
}

}  // namespace wrt
