    float* const q = packet.data + (long long)base;
    #include "packet.h"
    #include "packet_rays.h"
    const float* p = nodes.data + (long long)first;
    const Rays never = __builtin_inff();
    #define NEAR(axis) (i_##axis < 0.0f ? hi_##axis : lo_##axis)
    #define FAR(axis) (i_##axis < 0.0f ? lo_##axis : hi_##axis)
    int out = 0;
    for (int child = 0; child < WIDTH; ++child) {
        const Rays lo_x = p[WIDTH * LO_X + child], lo_y = p[WIDTH * LO_Y + child], lo_z = p[WIDTH * LO_Z + child];
        const Rays hi_x = p[WIDTH * HI_X + child], hi_y = p[WIDTH * HI_Y + child], hi_z = p[WIDTH * HI_Z + child];
        Rays enter = t_min, leave = t_max;
        #include "slabs.h"
        row(ROOT_ENTRIES + LANES * child) = enter <= leave ? enter : never;
        out |= RAY_MASK(enter <= leave);
    }
    return out & mask;
