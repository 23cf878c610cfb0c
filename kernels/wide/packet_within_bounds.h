        // As kernels.units.triangle.within_bounds: `at` is moved into the interval of the triangle's own box, or of the padded one;
        // m loses the rays that pass by even that.
        float lo[3], hi[3];
        for (int k = 0; k < 3; ++k) {
            lo[k] = v[1][k] < v[0][k] ? v[1][k] : v[0][k]; lo[k] = v[2][k] < lo[k] ? v[2][k] : lo[k];
            hi[k] = v[1][k] > v[0][k] ? v[1][k] : v[0][k]; hi[k] = v[2][k] > hi[k] ? v[2][k] : hi[k];
        }
        Rays box_enter, box_leave;
        auto interval = [&]() {
            const Rays o_x = row(ORIGIN_X), o_y = row(ORIGIN_Y), o_z = row(ORIGIN_Z);
            const Rays i_x = row(INVERSE_X), i_y = row(INVERSE_Y), i_z = row(INVERSE_Z), &f_x = i_x, &f_y = i_y, &f_z = i_z;
            const Rays lo_x = lo[0], lo_y = lo[1], lo_z = lo[2], hi_x = hi[0], hi_y = hi[1], hi_z = hi[2];
            #define NEAR(axis) (i_##axis < 0.0f ? hi_##axis : lo_##axis)
            #define FAR(axis) (i_##axis < 0.0f ? lo_##axis : hi_##axis)
            Rays enter = -inf, leave = inf;
            #include "slabs.h"
            box_enter = enter; box_leave = leave;
        };
        auto padded_interval = [&]() {
            const float e_x = hi[0] - lo[0], e_y = hi[1] - lo[1], e_z = hi[2] - lo[2];
            float pad = e_x > e_y ? e_x : e_y;
            pad = PAD_EXTENT * (e_z > pad ? e_z : pad) + PAD_SMALLEST;
            for (int k = 0; k < 3; ++k) {
                lo[k] = lo[k] - (pad + PAD_COORDINATE * __builtin_fabsf(lo[k]));
                hi[k] = hi[k] + (pad + PAD_COORDINATE * __builtin_fabsf(hi[k]));
            }
            interval();
        };
        auto clamped = [&]() {
            const Rays before = at > box_leave ? box_leave : at;
            return before < box_enter ? box_enter : before;
        };
        auto underflowed = [&](Rays moved) {
            const Rays size = __builtin_elementwise_abs(at);
            const int far = RAY_MASK(__builtin_elementwise_abs(moved - at) > CLAMP_ROUNDING * size + CLAMP_STEP);
            if ((far & m) == 0) return 0;
            Rays steep = inf, grazing = 0.0f;
            for (int k = 0; k < 3; ++k) {
                const Rays inverse = __builtin_elementwise_abs(row(INVERSE_X + LANES * k));
                steep = inverse < steep ? inverse : steep;
                grazing = ((inverse > grazing) & (inverse < inf)) ? inverse : grazing;
            }
            const Rays least = SLOWEST * grazing;
            return far & RAY_MASK((steep < least) | ((size < least) & (__builtin_elementwise_abs(moved) < least)));
        };
        interval();
        Rays moved = clamped();
        const int again = (RAY_MASK(~(box_enter <= box_leave)) | underflowed(moved)) & m;
        if (again) {
            padded_interval();
            m &= ~again | RAY_MASK(box_enter <= box_leave * FAR_PAD);
            moved = IN(again) ? clamped() : moved;
        }
        at = moved;
