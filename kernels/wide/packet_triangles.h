    float* const q = packet.data + (long long)base;
    const float* const p = rows.data + (long long)first;
    auto once = [=](int mask) __attribute__((noinline)) {  // the compiler would copy it to where it is called
    // As kernels.units.triangle.ray_triangle and kernels.traverse.common.intersect, one triangle after another.
    #include "packet.h"
    typedef double Doubles __attribute__((ext_vector_type(LANES), aligned(8)));
    #define WIDE(x) __builtin_convertvector(x, Doubles)
    #define NARROW(x) __builtin_convertvector(x, Rays)
    const RayInts axes = int_row(AXES), kx = axes & AXIS_MASK, ky = axes >> AXIS_BITS & AXIS_MASK, kz = axes >> 2 * AXIS_BITS;
    const Rays o_x = row(TURNED_X), o_y = row(TURNED_Y), o_z = row(TURNED_Z), s_x = row(SHEAR_X), s_y = row(SHEAR_Y);
    const Rays inf = __builtin_inff();
    int found = 0;
    for (int j = 0; j < count; ++j) {
        float v[3][3];
        for (int k = 0; k < 3; ++k) for (int axis = 0; axis < 3; ++axis) v[k][axis] = p[WIDTH * (3 * k + axis) + j];
        #define CORNER(i, axis) ((axis) == 0 ? (Rays)(v[i][0]) : ((axis) == 1 ? (Rays)(v[i][1]) : (Rays)(v[i][2])))
        #include "edges.h"
        int m = RAY_MASK(~outside) & mask;
        if (m == 0) continue;
        const Doubles w_0 = WIDE(c_x) * WIDE(b_y) - WIDE(c_y) * WIDE(b_x), w_1 = WIDE(a_x) * WIDE(c_y) - WIDE(a_y) * WIDE(c_x);
        const Doubles w_2 = WIDE(b_x) * WIDE(a_y) - WIDE(b_y) * WIDE(a_x), area = w_0 + w_1 + w_2;
        m &= RAY_MASK(~OUTSIDE(w_0, w_1, w_2) & (area < 0.0 | area > 0.0));
        if (m == 0) continue;
        Rays at = NARROW((w_0 * WIDE(a_z) + w_1 * WIDE(b_z) + w_2 * WIDE(c_z)) / area * WIDE(row(SHEAR_Z)));
        #include "packet_within_bounds.h"
        const Rays best = row(T);
        const RayInts id = __builtin_bit_cast(int, p[WIDTH * PRIM_ID_ROW + j]), best_id = int_row(PRIM_ID);
        m &= RAY_MASK((__builtin_elementwise_abs(at) < inf) & (at >= row(T_MIN)) & (at <= best));
        m &= RAY_MASK(~((at == best) & (id > best_id)) & (id + 1 != int_row(EXCLUDE)));
        if (m == 0) continue;
        found |= m;
        const RayInts on = IN(m);
        row(T) = on ? (any_hit ? -inf : at) : best;
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
