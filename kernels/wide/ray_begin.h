    #include "rows.h"
    const int first = 0;
    int* const words = slots.data + (long long)slot;
    const float* q = packet.data + (long long)ray + ROOT_ENTRIES;
    Row enter;
    for (int child = 0; child < WIDTH; ++child) enter[child] = q[LANES * child];
    const float reach = __builtin_inff();
    const auto met = enter < (Row)(reach);
    words[SLOT_RAY] = ray;
    words[SLOT_PLACE] = bottom;
    #include "ray_push.h"
