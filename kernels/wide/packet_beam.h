    // The beam around all active rays, if they run the same way along each axis: packets.py, BEAM_WORDS.
    const int nx = RAY_MASK(i_x < 0.0f) & active, ny = RAY_MASK(i_y < 0.0f) & active, nz = RAY_MASK(i_z < 0.0f) & active;
    if (active == 0 || (nx && nx != active) || (ny && ny != active) || (nz && nz != active)) return active;
    // A lane without an active ray takes the numbers of one that has one.
    const int some = __builtin_ctz(active);
    const RayInts on = IN(active);
    typedef float Eight __attribute__((ext_vector_type(8), aligned(4)));
    typedef float Four __attribute__((ext_vector_type(4)));
    auto lowest = [](Rays x) {
        const Eight a = x.lo < x.hi ? x.lo : x.hi;
        const Four b = a.lo < a.hi ? a.lo : a.hi;
        const float c = b[0] < b[1] ? b[0] : b[1], d = b[2] < b[3] ? b[2] : b[3];
        return c < d ? c : d;
    };
    auto highest = [](Rays x) {
        const Eight a = x.lo > x.hi ? x.lo : x.hi;
        const Four b = a.lo > a.hi ? a.lo : a.hi;
        const float c = b[0] > b[1] ? b[0] : b[1], d = b[2] > b[3] ? b[2] : b[3];
        return c > d ? c : d;
    };
    const int negative[3] = {nx != 0, ny != 0, nz != 0};
    for (int axis = 0; axis < 3; ++axis) {
        const Rays o_some = q[ORIGIN_X + LANES * axis + some], i_some = q[INVERSE_X + LANES * axis + some];
        const Rays o = on ? row(ORIGIN_X + LANES * axis) : o_some, i = on ? row(INVERSE_X + LANES * axis) : i_some;
        const float o_low = lowest(o), o_high = highest(o), i_low = lowest(i), i_high = highest(i);
        q[BEAM_NEAR_ORIGIN + axis] = negative[axis] ? o_low : o_high;
        q[BEAM_FAR_ORIGIN + axis] = negative[axis] ? o_high : o_low;
        q[BEAM_LARGEST + axis] = negative[axis] ? i_low : i_high;
        q[BEAM_SMALLEST + axis] = negative[axis] ? i_high : i_low;
        q[BEAM_FAR_LARGEST + axis] = pad * q[BEAM_LARGEST + axis];
        q[BEAM_FAR_SMALLEST + axis] = pad * q[BEAM_SMALLEST + axis];
        q[BEAM_NEAR_ROW + axis] = (float)(2 * axis + negative[axis]);
    }
    const Rays t_some = q[T_MIN + some];
    q[BEAM_T_MIN] = lowest(on ? t_min : t_some);
