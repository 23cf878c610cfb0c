// The environment's picture: functions of backgrounds.py, in loops that compilers vectorise. The results have the same bits.
#pragma once
#include "layout.h"

namespace wrt {

// Look up `count` columns x and rows y of a Background's picture. Store red, green and blue in x, y and z. Each of the three arrays must
// have room for LANES - 1 more values, which are overwritten.
template <class Background> void environment_at(const Background& background, float* x, float* y, float* z, int count) {
    const int w = background.width, h = background.height - 1;
    const float* const pixels = (const float*)background.pixels.data;
    for (int i = 0; i < count; i += LANES) {
        float at_x[LANES] = {}, at_y[LANES] = {}, share_x[LANES], share_y[LANES];
        const int n = count - i < LANES ? count - i : LANES;
        __builtin_memcpy(at_x, x + i, sizeof(float) * n);
        __builtin_memcpy(at_y, y + i, sizeof(float) * n);
        long long corner[4][LANES];
        for (int lane = 0; lane < LANES; ++lane) {
            const float a = __builtin_floorf(at_x[lane]), b = __builtin_floorf(at_y[lane]);
            share_x[lane] = at_x[lane] - a;
            share_y[lane] = at_y[lane] - b;
            int left = (int)a, right = (int)a + 1, above = (int)b, under = (int)b + 1;
            left = left < 0 ? left + w : left >= w ? left - w : left;
            right = right < 0 ? right + w : right >= w ? right - w : right;
            above = above < 0 ? 0 : above > h ? h : above;
            under = under < 0 ? 0 : under > h ? h : under;
            const long long upper = (long long)above * w, lower = (long long)under * w;
            corner[0][lane] = 3 * (upper + left);
            corner[1][lane] = 3 * (upper + right);
            corner[2][lane] = 3 * (lower + left);
            corner[3][lane] = 3 * (lower + right);
        }
        float out[3][LANES];
        for (int c = 0; c < 3; ++c)
            for (int lane = 0; lane < LANES; ++lane) {
                const float s = share_x[lane], t = share_y[lane];
                const float top = (1.0f - s) * pixels[corner[0][lane] + c] + s * pixels[corner[1][lane] + c];
                const float low = (1.0f - s) * pixels[corner[2][lane] + c] + s * pixels[corner[3][lane] + c];
                out[c][lane] = background.scale * ((1.0f - t) * top + t * low);
            }
        __builtin_memcpy(x + i, out[0], sizeof(float) * LANES);
        __builtin_memcpy(y + i, out[1], sizeof(float) * LANES);
        __builtin_memcpy(z + i, out[2], sizeof(float) * LANES);
    }
}

// Search LANES cdfs of `count` entries, as search_cdf does: place[lane] is the lowest i with x[lane] < cdf[first[lane] + i]. The step
// halves from the largest power of two below `count` on. Each lane takes a step unless that goes beyond its result.
__attribute__((always_inline)) static inline void search_cdf(const float* cdf, const int* first, int count, const float* x, int* place) {
    for (int lane = 0; lane < LANES; ++lane) place[lane] = 0;
    int step = 1;
    while (2 * step < count) step *= 2;
    for (; step; step /= 2)
        for (int lane = 0; lane < LANES; ++lane) {
            const int next = place[lane] + step < count ? place[lane] + step : place[lane];
            const float below = cdf[first[lane] + (next > 0 ? next - 1 : 0)];
            place[lane] = x[lane] < below ? place[lane] : next;
        }
}

// Find, for each lane, the entry of x in a cdf: its index, its probability, and the position of x within its interval.
__attribute__((always_inline)) static inline void entry_of(const float* cdf, const int* first, int count, const float* x, int* place,
                                                           float* share, float* within) {
    search_cdf(cdf, first, count, x, place);
    for (int lane = 0; lane < LANES; ++lane) {
        const float end = cdf[first[lane] + place[lane]], before = cdf[first[lane] + (place[lane] > 0 ? place[lane] - 1 : 0)];
        share[lane] = end - (place[lane] > 0 ? before : 0.0f);
        const float part = 1.0f - (end - x[lane]) / share[lane];
        within[lane] = (float)place[lane] + (part < 0.0f ? 0.0f : part > 1.0f ? 1.0f : part);
    }
}

// Replace `count` random numbers x and y by environment_place's rows, columns, and probabilities z. The arrays are as above.
template <class Background> void environment_place(const Background& background, float* x, float* y, float* z, int count) {
    for (int i = 0; i < count; i += LANES) {
        float xs[LANES] = {}, ys[LANES] = {}, p_row[LANES], p_column[LANES], at_x[LANES], at_y[LANES];
        int first[LANES] = {}, row[LANES], column[LANES];
        const int n = count - i < LANES ? count - i : LANES;
        __builtin_memcpy(xs, x + i, sizeof(float) * n);
        __builtin_memcpy(ys, y + i, sizeof(float) * n);
        entry_of(background.row_cdf.data, first, background.height, xs, row, p_row, at_x);
        for (int lane = 0; lane < LANES; ++lane) first[lane] = row[lane] * background.width;
        entry_of(background.column_cdf.data, first, background.width, ys, column, p_column, at_y);
        for (int lane = 0; lane < LANES; ++lane) p_row[lane] *= p_column[lane];
        __builtin_memcpy(x + i, at_x, sizeof(float) * LANES);
        __builtin_memcpy(y + i, at_y, sizeof(float) * LANES);
        __builtin_memcpy(z + i, p_row, sizeof(float) * LANES);
    }
}

}  // namespace wrt
