    // A new level of a ray's stack for the children of a node that it meets (`met`, from `enter` on), if it meets any; then the next
    // child of the last level. Both cases share one path: about every third node has no child that is met, and a branch on that is
    // mispredicted. Distances are not negative.
    typedef unsigned Keys __attribute__((ext_vector_type(WIDTH), aligned(4)));
    static_assert(WIDTH == 8, "the children have numbers");
    const unsigned all = ROW_MASK(met);
    const int place = words[SLOT_PLACE];
    unsigned* const own = (unsigned*)stacks.data + place + LEVEL;
#if !ANY_HIT
    const Keys number = {0, 1, 2, 3, 4, 5, 6, 7};
    *(Keys*)own = (__builtin_bit_cast(Keys, enter) & ~(unsigned)KEY_MASK) | (number + WIDTH) | ~__builtin_bit_cast(Keys, met);
#endif
    own[LEVEL_LEFT] = all;
    own[LEVEL_REFERENCES] = first + REFERENCES;
    int at = __builtin_unpredictable(all != 0) ? place + LEVEL : place;
    #include "ray_take.h"
