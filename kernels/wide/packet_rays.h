    // What slabs.h reads of a packet.
    const Rays t_min = row(T_MIN), t_max = row(T), o_x = row(ORIGIN_X), o_y = row(ORIGIN_Y), o_z = row(ORIGIN_Z);
    const Rays i_x = row(INVERSE_X), i_y = row(INVERSE_Y), i_z = row(INVERSE_Z);
    const Rays f_x = row(FAR_X), f_y = row(FAR_Y), f_z = row(FAR_Z);
