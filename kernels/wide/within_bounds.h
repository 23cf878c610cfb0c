        // As kernels.units.triangle.within_bounds: `at` is moved into the interval of the triangle's own box, or of the padded one;
        // m loses those that pass by even that.
        decltype(v[0][0] + 0.0f) lo[3], hi[3];
        for (int k = 0; k < 3; ++k) {
            lo[k] = v[1][k] < v[0][k] ? v[1][k] : v[0][k]; lo[k] = v[2][k] < lo[k] ? v[2][k] : lo[k];
            hi[k] = v[1][k] > v[0][k] ? v[1][k] : v[0][k]; hi[k] = v[2][k] > hi[k] ? v[2][k] : hi[k];
        }
        Lanes box_enter, box_leave;
        auto interval = [&]() {
            const Lanes o_x = RAY(ORIGIN_X), o_y = RAY(ORIGIN_Y), o_z = RAY(ORIGIN_Z);
            const Lanes i_x = RAY(INVERSE_X), i_y = RAY(INVERSE_Y), i_z = RAY(INVERSE_Z), &f_x = i_x, &f_y = i_y, &f_z = i_z;
            const Lanes lo_x = lo[0], lo_y = lo[1], lo_z = lo[2], hi_x = hi[0], hi_y = hi[1], hi_z = hi[2];
            #define NEAR(axis) (i_##axis < 0.0f ? hi_##axis : lo_##axis)
            #define FAR(axis) (i_##axis < 0.0f ? lo_##axis : hi_##axis)
            Lanes enter = -inf, leave = inf;
            #include "slabs.h"
            box_enter = enter; box_leave = leave;
        };
        auto padded_interval = [&]() {
            const auto e_x = hi[0] - lo[0], e_y = hi[1] - lo[1], e_z = hi[2] - lo[2];
            auto pad = e_x > e_y ? e_x : e_y;
            pad = PAD_EXTENT * (e_z > pad ? e_z : pad) + PAD_SMALLEST;
            for (int k = 0; k < 3; ++k) {
                lo[k] = lo[k] - (pad + PAD_COORDINATE * __builtin_elementwise_abs(lo[k]));
                hi[k] = hi[k] + (pad + PAD_COORDINATE * __builtin_elementwise_abs(hi[k]));
            }
            interval();
        };
        auto clamped = [&]() {
            const Lanes before = at > box_leave ? box_leave : at;
            return before < box_enter ? box_enter : before;
        };
        auto underflowed = [&](Lanes moved) {
            const Lanes size = __builtin_elementwise_abs(at);
            const int far = MASK(__builtin_elementwise_abs(moved - at) > CLAMP_ROUNDING * size + CLAMP_STEP);
            if ((far & m) == 0) return 0;
            Lanes steep = inf, grazing = 0.0f;
            for (int k = 0; k < 3; ++k) {
                const Lanes inverse = __builtin_elementwise_abs(RAY(INVERSE_X + LANES * k));
                steep = inverse < steep ? inverse : steep;
                grazing = ((inverse > grazing) & (inverse < inf)) ? inverse : grazing;
            }
            const Lanes least = SLOWEST * grazing;
            return far & MASK((steep < least) | ((size < least) & (__builtin_elementwise_abs(moved) < least)));
        };
        interval();
        Lanes moved = clamped();
        const int again = (MASK(~(box_enter <= box_leave)) | underflowed(moved)) & m;
        if (again) {
            padded_interval();
            m &= ~again | MASK(box_enter <= box_leave * FAR_PAD);
            moved = IN(again) ? clamped() : moved;
        }
        at = moved;
