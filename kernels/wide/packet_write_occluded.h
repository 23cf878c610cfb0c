    float* const q = packet.data + (long long)base;
    #include "packet.h"
    const int found = RAY_MASK(int_row(PRIM_ID) != NO_HIT);
    for (int j = 0; j < count; ++j) occluded.data[first + j] = found >> j & 1;
