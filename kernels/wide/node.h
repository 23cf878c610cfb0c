    // The children of one node against one ray, which reaches to t_max: `enter` and `leave`, and the mask of children that exist.
    #include "rows.h"
    const float* p = nodes.data + (long long)first;
#if COMPRESSED
    typedef unsigned char Bytes __attribute__((ext_vector_type(WIDTH), aligned(1)));
    const unsigned char* bytes = (const unsigned char*)(p + FIRST_BYTES);
    unsigned word;
    memcpy(&word, p + WORD, sizeof(word));
    auto step = [word](int axis) {
        return __builtin_bit_cast(float, (word >> EXPONENT_BITS * axis & ((1u << EXPONENT_BITS) - 1)) << MANTISSA_BITS);
    };
    const float low_x = p[0], low_y = p[1], low_z = p[2], step_x = step(0), step_y = step(1), step_z = step(2);
    #define PLANE(row, axis) (low_##axis + __builtin_convertvector(*(const Bytes*)(bytes + WIDTH * (row)), Row) * step_##axis)
    const unsigned exist = word >> EXIST_SHIFT;
#else
    #define PLANE(row, axis) (*(const Row*)(p + WIDTH * (row)))
    const unsigned exist = (1u << WIDTH) - 1u;
#endif
    #define NEAR(axis) PLANE(ray.near_##axis, axis)
    #define FAR(axis) PLANE(ray.near_##axis ^ 1, axis)
    const wp::vec_t<3, wp::float32> o = ray.box.origin, i = ray.box.inv_dir, f = ray.far_inv_dir;
    const float o_x = o[0], o_y = o[1], o_z = o[2], i_x = i[0], i_y = i[1], i_z = i[2], f_x = f[0], f_y = f[1], f_z = f[2];
    Row enter = (Row)(ray.box.t_min), leave = (Row)(t_max);
    #include "slabs.h"
