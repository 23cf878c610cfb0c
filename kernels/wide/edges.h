    // The watertight unit's edge test in float32 (units/triangle.py), for one ray and a row of triangles or for a packet of rays and
    // one triangle. CORNER(i, axis): a coordinate of corner i; o_: the origin, in the order kx, ky, kz; s_: the shear.
    #define OUTSIDE(u, v, w) (((u) < 0.0f | (v) < 0.0f | (w) < 0.0f) & ((u) > 0.0f | (v) > 0.0f | (w) > 0.0f))
    const auto a_z = CORNER(0, kz) - o_z, b_z = CORNER(1, kz) - o_z, c_z = CORNER(2, kz) - o_z;
    const auto a_x = (CORNER(0, kx) - o_x) - s_x * a_z, a_y = (CORNER(0, ky) - o_y) - s_y * a_z;
    const auto b_x = (CORNER(1, kx) - o_x) - s_x * b_z, b_y = (CORNER(1, ky) - o_y) - s_y * b_z;
    const auto c_x = (CORNER(2, kx) - o_x) - s_x * c_z, c_y = (CORNER(2, ky) - o_y) - s_y * c_z;
    const auto area_0 = c_x * b_y - c_y * b_x, area_1 = a_x * c_y - a_y * c_x, area_2 = b_x * a_y - b_y * a_x;
    const auto outside = OUTSIDE(area_0, area_1, area_2);
