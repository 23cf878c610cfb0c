    typedef unsigned Keys __attribute__((ext_vector_type(WIDTH), aligned(4)));
    int* const words = slots.data + (long long)slot;
    int at = words[SLOT_PLACE];
    #include "ray_take.h"
