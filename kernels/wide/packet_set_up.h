    float* const q = packet.data + (long long)base;
    // Not `rays` itself: sixteen loads of what was just copied would wait for the copy, longer where the stack is not at a cache line.
    const float *const origins = (const float*)(rays.origin.data + first), *const directions = (const float*)(rays.direction.data + first);
    const bool one_t_min = rays.t_min.strides[0] == 0, one_t_max = rays.t_max.strides[0] == 0;
    const float *const t_mins = rays.t_min.data + (one_t_min ? 0 : first), *const t_maxs = rays.t_max.data + (one_t_max ? 0 : first);
#if QUEUE
    const int* const excludes = rays.exclude.data + first;
#endif
    auto once = [=]() __attribute__((noinline)) {  // the compiler would copy it to where it is called
    #include "packet.h"
    #include "packet_load.h"
    const Rays one = 1.0f, nothing = -__builtin_inff(), largest = LARGEST;
    int_row(EXCLUDE) = exclude;
    // As kernels.query.load_ray.
    Rays size_x = __builtin_elementwise_abs(d_x), size_y = __builtin_elementwise_abs(d_y), size_z = __builtin_elementwise_abs(d_z);
    Rays longest = size_y > size_x ? size_y : size_x;
    longest = size_z > longest ? size_z : longest;
    #define WITHIN(x, most) (__builtin_elementwise_abs(x) <= most)
    const Rays farthest = FARTHEST;
    const auto near = WITHIN(o_x, farthest) & WITHIN(o_y, farthest) & WITHIN(o_z, farthest);
    const auto finite = WITHIN(d_x, largest) & WITHIN(d_y, largest) & WITHIN(d_z, largest);
    ((int*)q)[REFUSED] = RAY_MASK(~(near & finite & (longest > 0.0f) & (t_min >= 0.0f) & (t_max == t_max)));
    const Rays lengthen = LENGTHEN, lengthen_inverse = 1.0f / LENGTHEN, shorten = SHORTEN, shorten_inverse = 1.0f / SHORTEN;
    const Rays scale = QUEUE ? one : longest > LONGEST ? shorten : (longest < SHORTEST ? lengthen : one);
    const Rays inverse = QUEUE ? one : longest > LONGEST ? shorten_inverse : (longest < SHORTEST ? lengthen_inverse : one);
    d_x = scale * d_x; d_y = scale * d_y; d_z = scale * d_z;
    t_min = t_min * inverse + 0.0f;
    t_max = (t_max > largest ? largest : t_max) * inverse;
    // As kernels.traverse.common.no_hit.
    const Rays zero_x = 0.0f * o_x + 0.0f * d_x, zero_y = 0.0f * o_y + 0.0f * d_y, zero_z = 0.0f * o_z + 0.0f * d_z;
    t_max = zero_x + zero_y + zero_z == 0.0f ? t_max : nothing;
    t_max = t_max < largest ? t_max : largest;
    const Rays i_x = one / d_x, i_y = one / d_y, i_z = one / d_z;
    row(ORIGIN_X) = o_x; row(ORIGIN_Y) = o_y; row(ORIGIN_Z) = o_z;
    row(INVERSE_X) = i_x; row(INVERSE_Y) = i_y; row(INVERSE_Z) = i_z;
    row(FAR_X) = pad * i_x; row(FAR_Y) = pad * i_y; row(FAR_Z) = pad * i_z;
    row(DIRECTION_X) = d_x; row(DIRECTION_Y) = d_y; row(DIRECTION_Z) = d_z;
    row(T_MIN) = t_min; row(T) = t_max; row(SCALE) = scale;
    // As kernels.units.triangle.triangle_ray.
    size_x = __builtin_elementwise_abs(d_x); size_y = __builtin_elementwise_abs(d_y); size_z = __builtin_elementwise_abs(d_z);
    const RayInts axis_0 = 0, axis_1 = 1, axis_2 = 2;
    RayInts kz = size_y > size_x ? axis_1 : axis_0;
    const Rays longer = kz == 0 ? size_x : size_y;
    kz = size_z > longer ? axis_2 : kz;
    RayInts kx = kz == 2 ? axis_0 : kz + 1, ky = kx == 2 ? axis_0 : kx + 1;
    #define COMPONENT(v, k) ((k) == 0 ? v##_x : ((k) == 1 ? v##_y : v##_z))
    const Rays along = COMPONENT(d, kz);
    const RayInts k = kx;
    kx = along < 0.0f ? ky : kx;
    ky = along < 0.0f ? k : ky;
    row(TURNED_X) = COMPONENT(o, kx); row(TURNED_Y) = COMPONENT(o, ky); row(TURNED_Z) = COMPONENT(o, kz);
    row(SHEAR_X) = COMPONENT(d, kx) / along; row(SHEAR_Y) = COMPONENT(d, ky) / along; row(SHEAR_Z) = one / along;
    int_row(AXES) = kx | ky << AXIS_BITS | kz << 2 * AXIS_BITS;
    row(U) = 0.0f; row(V) = 0.0f;
    int_row(PRIM_ID) = NO_HIT;
    #define NEAR_ROW(i, lo, hi) ((i) < 0.0f ? (RayInts)(WIDTH * (hi)) : (RayInts)(WIDTH * (lo)))
    int_row(NEAR_X) = NEAR_ROW(i_x, LO_X, HI_X);
    int_row(NEAR_Y) = NEAR_ROW(i_y, LO_Y, HI_Y);
    int_row(NEAR_Z) = NEAR_ROW(i_z, LO_Z, HI_Z);

    const int active = RAY_MASK(t_max >= t_min) & ((1 << count) - 1);
    #include "packet_beam.h"
    return active | COHERENT;
    };
    return once();
