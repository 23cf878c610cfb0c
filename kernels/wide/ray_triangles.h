    float* const q = packet.data + (long long)ray;
    const float* const p = rows.data + (long long)first;
    auto once = [=]() CALLED {
    #include "rows.h"
    typedef Row Lanes;
    typedef int LaneInts __attribute__((ext_vector_type(WIDTH), aligned(4)));
    typedef double Doubles __attribute__((ext_vector_type(WIDTH), aligned(8)));
    const LaneInts lane = {0, 1, 2, 3, 4, 5, 6, 7};
    #define MASK ROW_MASK
    #define IN(mask) ((((mask) >> lane) & 1) != 0)
    #define RAY(k) q[k]
    #define RAY_INT(k) ((const int*)q)[k]
    #define MISSED return -1
    #define CORNER(i, axis) (*(const Row*)(p + WIDTH * (3 * (i) + (axis))))
    const int axes = RAY_INT(AXES), kx = axes & AXIS_MASK, ky = axes >> AXIS_BITS & AXIS_MASK, kz = axes >> 2 * AXIS_BITS;
    const float o_x = q[TURNED_X], o_y = q[TURNED_Y], o_z = q[TURNED_Z], s_x = q[SHEAR_X], s_y = q[SHEAR_Y], inf = __builtin_inff();
    const Row v[3][3] = {{CORNER(0, 0), CORNER(0, 1), CORNER(0, 2)}, {CORNER(1, 0), CORNER(1, 1), CORNER(1, 2)},
                         {CORNER(2, 0), CORNER(2, 1), CORNER(2, 2)}};
    const LaneInts id = *(const LaneInts*)(p + WIDTH * PRIM_ID_ROW);
    #include "triangle_hits.h"
#if ANY_HIT
    q[T] = -inf;
    ((int*)q)[PRIM_ID] = 0;  // whichever it is: nobody asks
    return 0;
#else
    int j = __builtin_ctz(m);
    for (int others = m & (m - 1); others; others &= others - 1) {
        const int k = __builtin_ctz(others);
        if (at[k] < at[j] || (at[k] == at[j] && id[k] < id[j])) j = k;
    }
    q[T] = at[j];
    const double whole = area[j], part_1 = w_1[j], part_2 = w_2[j];
    q[U] = (float)(part_1 / whole);
    q[V] = (float)(part_2 / whole);
    ((int*)q)[PRIM_ID] = id[j];
    return j;
#endif
    };
    return once();
