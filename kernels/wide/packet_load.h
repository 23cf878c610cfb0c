    // Rays first .. first + count - 1 as rows; lanes beyond the last ray repeat it.
    Rays o_x, o_y, o_z, d_x, d_y, d_z, t_min, t_max;
    RayInts exclude = 0;
    if (count == LANES) {
        // Three vectors hold 16 times x, y, z: the first two give 11 or 10 numbers of a row, the third gives the rest.
        #define TWO(v, k) __builtin_shufflevector(*(const Rays*)v, *(const Rays*)(v + LANES), \
            k, k + 3, k + 6, k + 9, k + 12, k + 15, k + 18, k + 21, k + 24, k + 27, k < 2 ? k + 30 : 0, 0, 0, 0, 0, 0)
        #define THIRD(v) *(const Rays*)(v + 2 * LANES)
        #define X(v) __builtin_shufflevector(TWO(v, 0), THIRD(v), 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 17, 20, 23, 26, 29)
        #define Y(v) __builtin_shufflevector(TWO(v, 1), THIRD(v), 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 18, 21, 24, 27, 30)
        #define Z(v) __builtin_shufflevector(TWO(v, 2), THIRD(v), 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 16, 19, 22, 25, 28, 31)
        o_x = X(origins); o_y = Y(origins); o_z = Z(origins); d_x = X(directions); d_y = Y(directions); d_z = Z(directions);
        t_min = one_t_min ? (Rays)(*t_mins) : *(const Rays*)t_mins;
        t_max = one_t_max ? (Rays)(*t_maxs) : *(const Rays*)t_maxs;
    } else {
        float copy[8][LANES];
        for (int j = 0; j < LANES; ++j) {
            const int i = j < count ? j : count - 1;
            for (int k = 0; k < 3; ++k) {
                copy[k][j] = origins[3 * i + k];
                copy[3 + k][j] = directions[3 * i + k];
            }
            copy[6][j] = t_mins[one_t_min ? 0 : i];
            copy[7][j] = t_maxs[one_t_max ? 0 : i];
        }
        auto copied = [&](int k) { return *(Rays*)copy[k]; };
        o_x = copied(0); o_y = copied(1); o_z = copied(2); d_x = copied(3); d_y = copied(4); d_z = copied(5);
        t_min = copied(6); t_max = copied(7);
    }
#if QUEUE
    for (int j = 0; j < LANES; ++j) exclude[j] = excludes[j < count ? j : count - 1];
#endif
