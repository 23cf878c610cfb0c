    float* const q = packet.data + (long long)base;
    const float* const p = rows.data + (long long)first;
    auto once = [=](int mask) __attribute__((noinline)) {  // the compiler would copy it to where it is called
    // One triangle after another.
    #include "packet.h"
    typedef Rays Lanes;
    typedef RayInts LaneInts;
    typedef double Doubles __attribute__((ext_vector_type(LANES), aligned(8)));
    #define MASK RAY_MASK
    #define RAY row
    #define RAY_INT int_row
    #define MISSED continue
    const RayInts axes = int_row(AXES), kx = axes & AXIS_MASK, ky = axes >> AXIS_BITS & AXIS_MASK, kz = axes >> 2 * AXIS_BITS;
    const Rays o_x = row(TURNED_X), o_y = row(TURNED_Y), o_z = row(TURNED_Z), s_x = row(SHEAR_X), s_y = row(SHEAR_Y);
    const float inf = __builtin_inff();
    int found = 0;
    for (int j = 0; j < count; ++j) {
        float v[3][3];
        for (int k = 0; k < 3; ++k) for (int axis = 0; axis < 3; ++axis) v[k][axis] = p[WIDTH * (3 * k + axis) + j];
        #define CORNER(i, axis) ((axis) == 0 ? (Rays)(v[i][0]) : ((axis) == 1 ? (Rays)(v[i][1]) : (Rays)(v[i][2])))
        const RayInts id = __builtin_bit_cast(int, p[WIDTH * PRIM_ID_ROW + j]);
        #include "triangle_hits.h"
        found |= m;
        const RayInts on = IN(m);
        row(T) = on ? (any_hit ? (Rays)(-inf) : at) : best;
        int_row(PRIM_ID) = on ? id : best_id;
        if (any_hit && (mask &= ~m) == 0) break;
        if (any_hit) continue;
        const Rays best_u = row(U), best_v = row(V);
        row(U) = on ? NARROW(w_1 / area) : best_u;
        row(V) = on ? NARROW(w_2 / area) : best_v;
    }
    return found;
    };
    return once(mask);
