// The environment's picture: environment_at of backgrounds.py, in loops that compilers vectorise. The results have the same bits.
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

}  // namespace wrt
