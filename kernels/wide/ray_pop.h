    // The next child that begins at or before t; whether there is one. Equal stays: a tie may have a lower prim_id there.
    int* const words = slots.data + (long long)slot;
    const unsigned* all = (const unsigned*)stacks.data;
    int place = words[SLOT_PLACE];
    unsigned key;
    for (;;) {
        key = all[place];
        if (__builtin_bit_cast(float, key & ~(unsigned)KEY_MASK) <= t) break;  // an end's bits are a NaN's
        if (place == bottom) return false;
        place = all[(place & ~(LEVEL - 1)) + LEVEL_BELOW];
    }
    __builtin_memcpy(words + SLOT_NEXT, nodes.data + (long long)all[(place & ~(LEVEL - 1)) + LEVEL_REFERENCES] + (key & (WIDTH - 1)), 4);
    words[SLOT_PLACE] = place + 1;
    words[SLOT_PENDING] = 0;
    return true;
