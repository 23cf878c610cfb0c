    float* const q = packet.data + (long long)base;
    #include "packet.h"
    return RAY_MASK(row(T) >= t_entry);
