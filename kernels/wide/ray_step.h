    #include "rows.h"
    int* const words = slots.data + (long long)slot;
    const int first = words[SLOT_NEXT] * NODE_SIZE, ray = words[SLOT_RAY];
    const float *p = nodes.data + (long long)first, *q = packet.data + (long long)ray;
    const int *near = (const int*)q, near_x = near[NEAR_X], near_y = near[NEAR_Y], near_z = near[NEAR_Z];
    #define NEAR(axis) (*(const Row*)(p + near_##axis))
    #define FAR(axis) (*(const Row*)(p + (near_##axis ^ WIDTH)))
    const float o_x = q[ORIGIN_X], o_y = q[ORIGIN_Y], o_z = q[ORIGIN_Z];
    const float i_x = q[INVERSE_X], i_y = q[INVERSE_Y], i_z = q[INVERSE_Z], f_x = q[FAR_X], f_y = q[FAR_Y], f_z = q[FAR_Z];
    const float reach = q[T];
    Row enter = (Row)(q[T_MIN]), leave = (Row)(reach);
    #include "slabs.h"
    const auto met = enter <= leave;
    #include "ray_push.h"
