    int* const words = slots.data + (long long)slot;
#if ANY_HIT
    // The last child that is left on the last level; whether there is one. No hit makes the ray shorter.
    const int place = words[SLOT_PLACE];
    if (place == bottom) return false;
    unsigned* level = (unsigned*)stacks.data + place;
    const int child = 31 - __builtin_clz(level[0]);
    level[0] ^= 1u << child;
    __builtin_memcpy(words + SLOT_NEXT, nodes.data + (long long)level[LEVEL_REFERENCES] + child, 4);
    words[SLOT_PLACE] = level[0] != 0 ? place : place - LEVEL;
#else
    // The next child that begins at or before t; whether there is one. Equal stays: a tie may have a lower prim_id there.
    typedef unsigned Keys __attribute__((ext_vector_type(WIDTH), aligned(4)));
    int place = words[SLOT_PLACE];
    unsigned key;
    for (;;) {
        if (place == bottom) return false;
        key = __builtin_reduce_min(*(const Keys*)((const unsigned*)stacks.data + place));
        if (__builtin_bit_cast(float, key & ~(unsigned)KEY_MASK) <= t) break;  // where no child is left, the bits are a NaN's
        place -= LEVEL;
    }
    unsigned* level = (unsigned*)stacks.data + place;
    level[key & (WIDTH - 1)] = ~0u;
    __builtin_memcpy(words + SLOT_NEXT, nodes.data + (long long)level[LEVEL_REFERENCES] + (key & (WIDTH - 1)), 4);
    words[SLOT_PLACE] = place;
#endif
    words[SLOT_PENDING] = 0;
    return true;
