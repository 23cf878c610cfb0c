    float* const q = packet.data + (long long)base;
    const float* const p = nodes.data + (long long)first;
    auto once = [=]() __attribute__((noinline)) {  // the compiler would copy it to where it is called
    #include "packet.h"
    #include "rows.h"
    // The beam first. Distances are products of two intervals: bounds are the extreme origin times both reciprocals. The largest
    // reciprocal comes first: it may be infinite, and 0 * inf = NaN then says nothing.
    #define PLANES(k) (*(const Row*)(p + WIDTH * (k)))
    const int near[3] = {(int)q[BEAM_NEAR_ROW], (int)q[BEAM_NEAR_ROW + 1], (int)q[BEAM_NEAR_ROW + 2]};
    Row beam_enter = (Row)(q[BEAM_T_MIN]), beam_leave = (Row)(LARGEST);
    for (int k = 0; k < 3; ++k) {
        const Row n = PLANES(near[k]) - q[BEAM_NEAR_ORIGIN + k], a = n * q[BEAM_LARGEST + k], b = n * q[BEAM_SMALLEST + k];
        const Row least = b < a ? b : a;
        beam_enter = least > beam_enter ? least : beam_enter;
        const Row f = PLANES(near[k] ^ 1) - q[BEAM_FAR_ORIGIN + k], c = f * q[BEAM_FAR_LARGEST + k], d = f * q[BEAM_FAR_SMALLEST + k];
        const Row most = d > c ? d : c;
        beam_leave = most < beam_leave ? most : beam_leave;
    }
    *(Row*)(q + CHILD_ENTRY) = beam_enter;
    int left = ROW_MASK(beam_enter <= beam_leave), out = 0;
    // Then the rays, for each child that the beam meets.
    #include "packet_rays.h"
    const float *near_x = p + WIDTH * near[0], *near_y = p + WIDTH * near[1], *near_z = p + WIDTH * near[2];
    const float *far_x = p + WIDTH * (near[0] ^ 1), *far_y = p + WIDTH * (near[1] ^ 1), *far_z = p + WIDTH * (near[2] ^ 1);
    #define NEAR(axis) near_##axis[child]
    #define FAR(axis) far_##axis[child]
    while (left) {
        const int child = __builtin_ctz(left);
        left &= left - 1;
        Rays enter = t_min, leave = t_max;
        #include "slabs.h"
        const int met = RAY_MASK(enter <= leave) & mask;
        ((int*)(q + CHILD_RAYS))[child] = met;
        out |= (met != 0) << child;
    }
    return out;
    };
    return once();
