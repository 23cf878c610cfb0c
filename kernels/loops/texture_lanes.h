    // As textures.sample_texture, for the first `count` hits of a block, LANES at a time: loops that the compiler makes lanes of.
    // Where the texels are is found for all hits first, once for each different picture among LANES of them, and called in. Of the four
    // channels, those in the mask `channels` are written, one after another.
    const int* const all = wanted.data + first;
    const float *const us = rows.data + U_ROW * BLOCK, *const vs = rows.data + V_ROW * BLOCK;
    const auto wrapped = [](int at, int size, int wrap) {
        const int period = wrap == WRAP_MIRROR ? 2 * size : size;
        int j = at % period;
        j = j < 0 ? j + period : j;
        return j >= size ? 2 * size - 1 - j : j;
    };
    // Of two columns (or rows) next to each other; a division only where a picture is seen more than once beside itself.
    const auto places = [&](const int* at, int size, int wrap, unsigned of, int* here, int* next) {
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
    };
    enum { NONE, LINEAR, SRGB };
    int corner[4][BLOCK], kinds[BLOCK];
    float x[BLOCK], y[BLOCK];
    for (int i = 0; i < count; i += LANES) {
        const int* const want = all + i;
        unsigned left = 0;
        for (int lane = 0; lane < LANES; ++lane) {
            left |= (unsigned)(want[lane] >= 0) << lane;
            corner[0][i + lane] = corner[1][i + lane] = corner[2][i + lane] = corner[3][i + lane] = 0;
            kinds[i + lane] = NONE;
            x[i + lane] = y[i + lane] = 0.0f;
        }
        if (!left) continue;
        while (left) {
            const int index = want[__builtin_ctz(left)];
            const auto& texture = surfaces.textures.data[index];
            int same[LANES];
            unsigned mask = 0;
            for (int lane = 0; lane < LANES; ++lane) {
                same[lane] = want[lane] == index;
                mask |= (unsigned)same[lane] << lane;
            }
            left &= ~mask;
            const int width = texture.width, height = texture.height, kind = texture.srgb != 0 ? SRGB : LINEAR;
            float share_x[LANES], share_y[LANES];
            int column[LANES], row[LANES], here[LANES], right[LANES], above[LANES], under[LANES];
            for (int lane = 0; lane < LANES; ++lane) {
                const float u = texture.row_u[0] * us[i + lane] + texture.row_u[1] * vs[i + lane] + texture.row_u[2];
                const float v = texture.row_v[0] * us[i + lane] + texture.row_v[1] * vs[i + lane] + texture.row_v[2];
                float a = u * (float)width - 0.5f, b = v * (float)height - 0.5f;
                a = a > -FARTHEST ? a : -FARTHEST; a = a < FARTHEST ? a : FARTHEST;
                b = b > -FARTHEST ? b : -FARTHEST; b = b < FARTHEST ? b : FARTHEST;
                share_x[lane] = a - __builtin_floorf(a);
                share_y[lane] = b - __builtin_floorf(b);
                column[lane] = (int)__builtin_floorf(a);
                row[lane] = (int)__builtin_floorf(b);
            }
            places(column, width, texture.wrap_u, mask, here, right);
            places(row, height, texture.wrap_v, mask, above, under);
            for (int lane = 0; lane < LANES; ++lane) {
                const int k = i + lane, begin = texture.first + above[lane] * width, end = texture.first + under[lane] * width;
                corner[0][k] = same[lane] ? begin + here[lane] : corner[0][k];
                corner[1][k] = same[lane] ? begin + right[lane] : corner[1][k];
                corner[2][k] = same[lane] ? end + here[lane] : corner[2][k];
                corner[3][k] = same[lane] ? end + right[lane] : corner[3][k];
                kinds[k] = same[lane] ? kind : kinds[k];
                x[k] = same[lane] ? share_x[lane] : x[k];
                y[k] = same[lane] ? share_y[lane] : y[k];
            }
        }
        for (int lane = 0; lane < LANES; ++lane) {
            __builtin_prefetch(surfaces.texels.data + corner[0][i + lane]);
            __builtin_prefetch(surfaces.texels.data + corner[2][i + lane]);
        }
    }
    for (int i = 0; i < count; i += LANES) {
        int some = 0, srgb = 0;
        for (int lane = 0; lane < LANES; ++lane) {
            some |= kinds[i + lane];
            srgb |= kinds[i + lane] & SRGB;
        }
        int row = to;
        if (some == NONE) {
            for (int c = 0; c < 4; ++c)
                if (channels >> c & 1) {
                    for (int lane = 0; lane < LANES; ++lane) rows.data[row * BLOCK + i + lane] = 1.0f;
                    ++row;
                }
            continue;
        }
        unsigned texel[4][LANES];
        for (int lane = 0; lane < LANES; ++lane)
            for (int k = 0; k < 4; ++k) texel[k][lane] = surfaces.texels.data[corner[k][i + lane]];
        for (int c = 0; c < 4; ++c) {
            if (!(channels >> c & 1)) continue;
            float color[4][LANES];
            for (int k = 0; k < 4; ++k) {
                for (int lane = 0; lane < LANES; ++lane) color[k][lane] = (float)(int)(texel[k][lane] >> 8 * c & 255) / 255.0f;
                if (srgb != 0 && c < 3)
                    for (int lane = 0; lane < LANES; ++lane)
                        color[k][lane] = kinds[i + lane] == SRGB ? surfaces.srgb_to_linear.data[texel[k][lane] >> 8 * c & 255] : color[k][lane];
            }
            float* const out = rows.data + row++ * BLOCK + i;
            for (int lane = 0; lane < LANES; ++lane) {
                const float s = x[i + lane], t = y[i + lane];
                const float upper = (1.0f - s) * color[0][lane] + s * color[1][lane];
                const float lower = (1.0f - s) * color[2][lane] + s * color[3][lane];
                const float between = (1.0f - t) * upper + t * lower;
                out[lane] = kinds[i + lane] == NONE ? 1.0f : between;
            }
        }
    }
