    // Slabs, for one ray and a row of boxes or for a packet of rays and one box. `enter` and `leave` are narrowed to the box: its
    // planes are NEAR(axis) and FAR(axis); the ray has its origin in o_, its reciprocals in i_, those for far planes in f_. A
    // comparison with NaN is false: such a plane (0 * inf) says nothing.
    decltype(enter) t;
    t = (NEAR(x) - o_x) * i_x; enter = t > enter ? t : enter;
    t = (NEAR(y) - o_y) * i_y; enter = t > enter ? t : enter;
    t = (NEAR(z) - o_z) * i_z; enter = t > enter ? t : enter;
    t = (FAR(x) - o_x) * f_x; leave = t < leave ? t : leave;
    t = (FAR(y) - o_y) * f_y; leave = t < leave ? t : leave;
    t = (FAR(z) - o_z) * f_z; leave = t < leave ? t : leave;
