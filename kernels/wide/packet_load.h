    // Rays first .. first + count - 1 as rows; lanes beyond the last ray repeat it.
    Rays o_x, o_y, o_z, d_x, d_y, d_z, t_min, t_max;
    RayInts exclude = 0;
    if (count == LANES) {
        // Three vectors hold 16 times x, y, z: the first two give 11 or 10 numbers of a row, the third gives the rest.
        const float *a = (const float*)(rays.origin.data + first), *b = (const float*)(rays.direction.data + first);
        #define TWO(v, k) __builtin_shufflevector(*(const Rays*)v, *(const Rays*)(v + LANES), \
            k, k + 3, k + 6, k + 9, k + 12, k + 15, k + 18, k + 21, k + 24, k + 27, k < 2 ? k + 30 : 0, 0, 0, 0, 0, 0)
        #define THIRD(v) *(const Rays*)(v + 2 * LANES)
        #define X(v) __builtin_shufflevector(TWO(v, 0), THIRD(v), 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 17, 20, 23, 26, 29)
        #define Y(v) __builtin_shufflevector(TWO(v, 1), THIRD(v), 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 18, 21, 24, 27, 30)
        #define Z(v) __builtin_shufflevector(TWO(v, 2), THIRD(v), 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 16, 19, 22, 25, 28, 31)
        o_x = X(a); o_y = Y(a); o_z = Z(a); d_x = X(b); d_y = Y(b); d_z = Z(b);
        t_min = rays.t_min.strides[0] ? *(const Rays*)(rays.t_min.data + first) : (Rays)(rays.t_min.data[0]);
        t_max = rays.t_max.strides[0] ? *(const Rays*)(rays.t_max.data + first) : (Rays)(rays.t_max.data[0]);
    } else {
        float copy[8][LANES];
        for (int j = 0; j < LANES; ++j) {
            const long long i = first + (j < count ? j : count - 1);
            for (int k = 0; k < 3; ++k) {
                copy[k][j] = rays.origin.data[i][k];
                copy[3 + k][j] = rays.direction.data[i][k];
            }
            copy[6][j] = rays.t_min.data[rays.t_min.strides[0] ? i : 0];
            copy[7][j] = rays.t_max.data[rays.t_max.strides[0] ? i : 0];
        }
        auto copied = [&](int k) { return *(Rays*)copy[k]; };
        o_x = copied(0); o_y = copied(1); o_z = copied(2); d_x = copied(3); d_y = copied(4); d_z = copied(5);
        t_min = copied(6); t_max = copied(7);
    }
#if QUEUE
    for (int j = 0; j < LANES; ++j) exclude[j] = rays.exclude.data[first + (j < count ? j : count - 1)];
#endif
