    // As row_cull.h, for a ray that is a column of a packet.
    #include "rows.h"
    const float *p = rows.data + (long long)first, *q = packet.data + (long long)ray;
    #define CORNER(i, axis) (*(const Row*)(p + WIDTH * (3 * (i) + (axis))))
    const int axes = *(const int*)(q + AXES), kx = axes & AXIS_MASK, ky = axes >> AXIS_BITS & AXIS_MASK, kz = axes >> 2 * AXIS_BITS;
    const float o_x = q[TURNED_X], o_y = q[TURNED_Y], o_z = q[TURNED_Z], s_x = q[SHEAR_X], s_y = q[SHEAR_Y];
    #include "edges.h"
    return ROW_MASK(~outside) & mask;
