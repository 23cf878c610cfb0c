    // As backgrounds.environment_at, for LANES places at a time: loops that the compiler makes lanes of. Behind the last place there
    // may be anything, which is not read.
    float *const x = rows.data + at, *const y = x + length, *const z = y + length;
    for (int i = 0; i < count; i += LANES) {
        float at_x[LANES] = {}, at_y[LANES] = {}, share_x[LANES], share_y[LANES];
        const int n = count - i < LANES ? count - i : LANES;
        memcpy(at_x, x + i, sizeof(float) * n);
        memcpy(at_y, y + i, sizeof(float) * n);
        long long corner[4][LANES];
        for (int lane = 0; lane < LANES; ++lane) {
            const float a = __builtin_floorf(at_x[lane]), b = __builtin_floorf(at_y[lane]);
            share_x[lane] = at_x[lane] - a;
            share_y[lane] = at_y[lane] - b;
            const int w = background.width, h = background.height - 1;
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
        const float* const pixels = (const float*)background.pixels.data;
        float out[3][LANES];
        for (int c = 0; c < 3; ++c)
            for (int lane = 0; lane < LANES; ++lane) {
                const float top = (1.0f - share_x[lane]) * pixels[corner[0][lane] + c] + share_x[lane] * pixels[corner[1][lane] + c];
                const float low = (1.0f - share_x[lane]) * pixels[corner[2][lane] + c] + share_x[lane] * pixels[corner[3][lane] + c];
                out[c][lane] = background.scale * ((1.0f - share_y[lane]) * top + share_y[lane] * low);
            }
        memcpy(x + i, out[0], sizeof(float) * LANES);
        memcpy(y + i, out[1], sizeof(float) * LANES);
        memcpy(z + i, out[2], sizeof(float) * LANES);
    }
