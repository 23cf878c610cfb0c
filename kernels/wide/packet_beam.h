    // The beam around all active rays, if they run the same way along each axis: packets.py, BEAM_WORDS.
    const int nx = RAY_MASK(i_x < 0.0f) & active, ny = RAY_MASK(i_y < 0.0f) & active, nz = RAY_MASK(i_z < 0.0f) & active;
    if (active == 0 || (nx && nx != active) || (ny && ny != active) || (nz && nz != active)) return active;
    // A lane without an active ray takes the numbers of one that has one.
    const int some = __builtin_ctz(active);
    const RayInts on = IN(active);
    #define OF_ACTIVE(x, k) (on ? (x) : (Rays)(q[(k) + some]))
    const Rays b_x = OF_ACTIVE(o_x, ORIGIN_X), b_y = OF_ACTIVE(o_y, ORIGIN_Y), b_z = OF_ACTIVE(o_z, ORIGIN_Z);
    const Rays r_x = OF_ACTIVE(i_x, INVERSE_X), r_y = OF_ACTIVE(i_y, INVERSE_Y), r_z = OF_ACTIVE(i_z, INVERSE_Z);
    const Rays begin = OF_ACTIVE(t_min, T_MIN);
    // The lesser of two neighbours, a's in the lower half and b's in the upper: four layers leave the least of each of sixteen rows.
    // A greatest number is the least of the negative ones.
    auto lesser = [](Rays a, Rays b) {
        const Rays even = __builtin_shufflevector(a, b, 0, 2, 4, 6, 8, 10, 12, 14, 16, 18, 20, 22, 24, 26, 28, 30);
        const Rays odd = __builtin_shufflevector(a, b, 1, 3, 5, 7, 9, 11, 13, 15, 17, 19, 21, 23, 25, 27, 29, 31);
        return even < odd ? even : odd;
    };
    auto lesser_of_4 = [=](Rays a, Rays b, Rays c, Rays d) { return lesser(lesser(a, b), lesser(c, d)); };
    const Rays least = lesser(lesser(lesser_of_4(b_x, b_y, b_z, -b_x), lesser_of_4(-b_y, -b_z, r_x, r_y)),
                              lesser(lesser_of_4(r_z, -r_x, -r_y, -r_z), lesser_of_4(begin, begin, begin, begin)));
    // The least origins, the greatest ones, the least reciprocals, the greatest; or of an axis where rays run down, the other way
    // round: in order those to near planes, to far planes, the largest reciprocals in magnitude, the smallest.
    const Rays ends = __builtin_shufflevector(least, -least, 0, 1, 2, 19, 20, 21, 6, 7, 8, 25, 26, 27, 12, 13, 14, 15);
    const Rays other_ends = __builtin_shufflevector(ends, ends, 3, 4, 5, 0, 1, 2, 9, 10, 11, 6, 7, 8, 12, 13, 14, 15);
    const RayInts down = {nx, ny, nz, nx, ny, nz, nx, ny, nz, nx, ny, nz};
    const Rays beam = down != 0 ? ends : other_ends, far = pad * beam;
    for (int k = 0; k < 12; ++k) q[BEAM_NEAR_ORIGIN + k] = beam[k];
    for (int k = 0; k < 6; ++k) q[BEAM_FAR_LARGEST + k] = far[6 + k];
    q[BEAM_NEAR_ROW] = nx != 0; q[BEAM_NEAR_ROW + 1] = 2 + (ny != 0); q[BEAM_NEAR_ROW + 2] = 4 + (nz != 0);
    q[BEAM_T_MIN] = least[12];
