// Textures: sample_texture of textures.py for pictures, in loops that compilers vectorise. The results have the same bits.
//
// The indices of the texels are computed first, for all hits of a block, and prefetched. This takes one pass over LANES hits for each
// picture that they use.
#pragma once
#include "layout.h"

namespace wrt {

enum Kind { NONE, LINEAR, SRGB };

// The look-ups of a block: the indices of the four texels around each point, and the weights x of the right texels and y of the lower
// texels.
template <int BLOCK> struct Places {
    int corner[4][BLOCK], kinds[BLOCK];
    float x[BLOCK], y[BLOCK];
};

static inline int wrapped(int at, int size, int wrap) {
    const int period = wrap == WRAP_MIRROR ? 2 * size : size;
    int j = at % period;
    j = j < 0 ? j + period : j;
    return j >= size ? 2 * size - 1 - j : j;
}

// Wrap LANES columns (or rows), and their right (or lower) neighbours, for the lanes in the mask `of`. Only columns more than one
// picture outside need a division.
__attribute__((always_inline)) static inline void wrapped(const int* at, int size, int wrap, unsigned of, int* here, int* next) {
    if (wrap == WRAP_CLAMP) {
        for (int lane = 0; lane < LANES; ++lane) {
            const int a = at[lane], b = at[lane] + 1;
            here[lane] = a < 0 ? 0 : a > size - 1 ? size - 1 : a;
            next[lane] = b < 0 ? 0 : b > size - 1 ? size - 1 : b;
        }
        return;
    }
    const int least = wrap == WRAP_REPEAT ? -size : 0, most = wrap == WRAP_REPEAT ? 2 * size - 1 : size - 1;
    unsigned far = 0;
    for (int lane = 0; lane < LANES; ++lane) {
        const int a = at[lane], b = at[lane] + 1;
        far |= (unsigned)(a < least || b > most) << lane;
        here[lane] = a + (a < 0 ? size : 0) - (a >= size ? size : 0);
        next[lane] = b + (b < 0 ? size : 0) - (b >= size ? size : 0);
    }
    for (far &= of; far; far &= far - 1) {
        const int lane = __builtin_ctz(far);
        here[lane] = wrapped(at[lane], size, wrap);
        next[lane] = wrapped(at[lane] + 1, size, wrap);
    }
}

// Compute `places` for the look-ups i .. i + LANES - 1 that use `texture`: those with same[lane] != 0, the bits of `mask`.
template <int BLOCK, class Texture>
__attribute__((always_inline)) static inline void place_picture(Places<BLOCK>& places, int i, const Texture& texture, const int* same,
                                                                unsigned mask, const float* us, const float* vs) {
    const int width = texture.width, height = texture.height, kind = texture.srgb != 0 ? SRGB : LINEAR;
    float share_x[LANES], share_y[LANES];
    int column[LANES], row[LANES], here[LANES], right[LANES], above[LANES], under[LANES];
    for (int lane = 0; lane < LANES; ++lane) {
        const float u = texture.row_u[0] * us[lane] + texture.row_u[1] * vs[lane] + texture.row_u[2];
        const float v = texture.row_v[0] * us[lane] + texture.row_v[1] * vs[lane] + texture.row_v[2];
        float a = u * (float)width - 0.5f, b = v * (float)height - 0.5f;
        a = a > -FARTHEST ? a : -FARTHEST;
        a = a < FARTHEST ? a : FARTHEST;
        b = b > -FARTHEST ? b : -FARTHEST;
        b = b < FARTHEST ? b : FARTHEST;
        share_x[lane] = a - __builtin_floorf(a);
        share_y[lane] = b - __builtin_floorf(b);
        column[lane] = (int)__builtin_floorf(a);
        row[lane] = (int)__builtin_floorf(b);
    }
    wrapped(column, width, texture.wrap_u, mask, here, right);
    wrapped(row, height, texture.wrap_v, mask, above, under);
    for (int lane = 0; lane < LANES; ++lane) {
        // Unsigned, because the product may overflow in a lane that needs another texture.
        const int k = i + lane, begin = (int)((unsigned)texture.first + (unsigned)above[lane] * (unsigned)width);
        const int end = (int)((unsigned)texture.first + (unsigned)under[lane] * (unsigned)width);
        places.corner[0][k] = same[lane] ? begin + here[lane] : places.corner[0][k];
        places.corner[1][k] = same[lane] ? begin + right[lane] : places.corner[1][k];
        places.corner[2][k] = same[lane] ? end + here[lane] : places.corner[2][k];
        places.corner[3][k] = same[lane] ? end + right[lane] : places.corner[3][k];
        places.kinds[k] = same[lane] ? kind : places.kinds[k];
        places.x[k] = same[lane] ? share_x[lane] : places.x[k];
        places.y[k] = same[lane] ? share_y[lane] : places.y[k];
    }
}

// Compute `places` for the look-ups i .. i + LANES - 1, and prefetch their texels.
template <int BLOCK, class Surfaces>
__attribute__((always_inline)) static inline void find_texels(Places<BLOCK>& places, int i, const Surfaces& surfaces, const int* wanted,
                                                              const float* us, const float* vs) {
    unsigned left = 0;
    for (int lane = 0; lane < LANES; ++lane) {
        left |= (unsigned)(wanted[lane] >= 0) << lane;
        places.corner[0][i + lane] = places.corner[1][i + lane] = places.corner[2][i + lane] = places.corner[3][i + lane] = 0;
        places.kinds[i + lane] = NONE;
        places.x[i + lane] = places.y[i + lane] = 0.0f;
    }
    if (!left) return;
    while (left) {
        const int index = wanted[__builtin_ctz(left)];
        int same[LANES];
        unsigned mask = 0;
        for (int lane = 0; lane < LANES; ++lane) {
            same[lane] = wanted[lane] == index;
            mask |= (unsigned)same[lane] << lane;
        }
        left &= ~mask;
        place_picture(places, i, surfaces.textures.data[index], same, mask, us, vs);
    }
    for (int lane = 0; lane < LANES; ++lane) {
        __builtin_prefetch(surfaces.texels.data + places.corner[0][i + lane]);
        __builtin_prefetch(surfaces.texels.data + places.corner[2][i + lane]);
    }
}

// Interpolate one channel of the look-ups i .. i + LANES - 1 from the four texels around each. any_srgb: one of the pictures is sRGB.
template <int BLOCK>
__attribute__((always_inline)) static inline void mix(const Places<BLOCK>& places, int i, unsigned (*texel)[LANES], int channel,
                                                      bool any_srgb, const float* srgb_to_linear, float* out) {
    float color[4][LANES];
    for (int k = 0; k < 4; ++k) {
        for (int lane = 0; lane < LANES; ++lane) color[k][lane] = (float)(int)(texel[k][lane] >> 8 * channel & 255) / 255.0f;
        if (any_srgb && channel < 3)  // Alpha is always linear.
            for (int lane = 0; lane < LANES; ++lane)
                color[k][lane] = places.kinds[i + lane] == SRGB ? srgb_to_linear[texel[k][lane] >> 8 * channel & 255] : color[k][lane];
    }
    for (int lane = 0; lane < LANES; ++lane) {
        const float s = places.x[i + lane], t = places.y[i + lane];
        const float upper = (1.0f - s) * color[0][lane] + s * color[1][lane];
        const float lower = (1.0f - s) * color[2][lane] + s * color[3][lane];
        const float between = (1.0f - t) * upper + t * lower;
        out[lane] = places.kinds[i + lane] == NONE ? 1.0f : between;
    }
}

// Sample the textures wanted[0 .. count - 1] at (us, vs), for count <= BLOCK. The index -1 means no texture; `wanted` is filled with -1
// up to a multiple of LANES. Each channel in the mask `channels` is stored in a row of BLOCK values, from `to` on.
template <int BLOCK, class Surfaces>
__attribute__((noinline)) void sample_texture(const Surfaces& surfaces, const int* wanted, const float* us, const float* vs, int count,
                                              int channels, float* to) {
    Places<BLOCK> places;
    for (int i = 0; i < count; i += LANES) find_texels(places, i, surfaces, wanted + i, us + i, vs + i);
    for (int i = 0; i < count; i += LANES) {
        int some = 0, srgb = 0;
        for (int lane = 0; lane < LANES; ++lane) {
            some |= places.kinds[i + lane];
            srgb |= places.kinds[i + lane] & SRGB;
        }
        unsigned texel[4][LANES];
        for (int lane = 0; lane < LANES; ++lane)
            for (int k = 0; k < 4; ++k) texel[k][lane] = some == NONE ? 0 : surfaces.texels.data[places.corner[k][i + lane]];
        float* out = to + i;
        for (int c = 0; c < 4; ++c) {
            if (!(channels >> c & 1)) continue;
            if (some == NONE)
                for (int lane = 0; lane < LANES; ++lane) out[lane] = 1.0f;
            else
                mix(places, i, texel, c, srgb != 0, surfaces.srgb_to_linear.data, out);
            out += BLOCK;
        }
    }
}

}  // namespace wrt
