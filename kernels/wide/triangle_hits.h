        // As kernels.units.triangle.ray_triangle and kernels.traverse.common.intersect, for a packet of rays and one triangle or for one
        // ray and a row of triangles: Lanes, LaneInts and Doubles, of which MASK(x) is a mask of bits, and IN(mask) back again. RAY(k)
        // and RAY_INT(k): a row of the packet, of all rays or of the one; v: corners; id: primitives; inf; and what edges.h reads.
        // Leaves `m`: those of `mask` that hit at or before T, else goes to MISSED; where they hit, `at`; and what u and v are made of.
        #include "edges.h"
        const LaneInts exclude = RAY_INT(EXCLUDE);
        int m = MASK(~outside & (id + 1 != exclude)) & mask;  // a ray's own triangle here, as it is at its origin
        if (m == 0) MISSED;
        #define WIDE(x) __builtin_convertvector(x, Doubles)
        #define NARROW(x) __builtin_convertvector(x, Lanes)
        const Doubles w_0 = WIDE(c_x) * WIDE(b_y) - WIDE(c_y) * WIDE(b_x), w_1 = WIDE(a_x) * WIDE(c_y) - WIDE(a_y) * WIDE(c_x);
        const Doubles w_2 = WIDE(b_x) * WIDE(a_y) - WIDE(b_y) * WIDE(a_x), area = w_0 + w_1 + w_2;
        m &= MASK(~OUTSIDE(w_0, w_1, w_2) & (area < 0.0 | area > 0.0));
        if (m == 0) MISSED;
        const Lanes shear_z = RAY(SHEAR_Z), best = RAY(T);
        Lanes at = NARROW((w_0 * WIDE(a_z) + w_1 * WIDE(b_z) + w_2 * WIDE(c_z)) / area * WIDE(shear_z));
        #include "within_bounds.h"
        const LaneInts best_id = RAY_INT(PRIM_ID);
        m &= MASK((__builtin_elementwise_abs(at) < inf) & (at >= (Lanes)RAY(T_MIN)) & (at <= best));
        m &= MASK(~((at == best) & (id > best_id)));
        if (m == 0) MISSED;
