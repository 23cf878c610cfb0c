#if ANY_HIT
    // A level of a ray's stack from one node: the mask of the children that it meets and that are still to come, the last first: so
    // they are ordered for any hit (wrt.accel.bvh.wide_tree).
    const unsigned all = ROW_MASK(met);
    const int place = words[SLOT_PLACE];
    words[SLOT_LEFT] = 0;
    if (all == 0) {
        words[SLOT_PENDING] = TO_POP;
        return 0;
    }
    const int child = 31 - __builtin_clz(all);
    const unsigned rest = all ^ 1u << child;
    int next;
    __builtin_memcpy(&next, nodes.data + (long long)first + REFERENCES + child, sizeof(next));
    unsigned* level = (unsigned*)stacks.data + place + LEVEL;
    level[0] = rest;
    level[LEVEL_REFERENCES] = first + REFERENCES;
    words[SLOT_NEXT] = next;
    words[SLOT_PLACE] = rest != 0 ? place + LEVEL : place;
    words[SLOT_PENDING] = 0;
    return next;
#else
    // A level of a ray's stack from one node: `enter` of all its children and `met`, which of them the ray meets. A network sorts
    // their keys, so that the nearest comes first and what is not met last.
    typedef unsigned Keys __attribute__((ext_vector_type(WIDTH), aligned(4)));
    static_assert(WIDTH == 8, "the network sorts eight keys");
    const int n = __builtin_popcount(ROW_MASK(met));
    const Keys child = {0, 1, 2, 3, 4, 5, 6, 7};
    Keys v = (__builtin_bit_cast(Keys, enter) & ~(unsigned)KEY_MASK) | (child + WIDTH) | ~__builtin_bit_cast(Keys, met);
    #define LAYER(a, b, c, d, e, f, g, h, ...) { \
        const Keys other = __builtin_shufflevector(v, v, a, b, c, d, e, f, g, h); \
        const Keys low = other < v ? other : v, high = other < v ? v : other; \
        v = __builtin_shufflevector(low, high, __VA_ARGS__); }
    LAYER(1, 0, 3, 2, 5, 4, 7, 6, 0, 9, 2, 11, 4, 13, 6, 15)
    LAYER(3, 2, 1, 0, 7, 6, 5, 4, 0, 1, 10, 11, 4, 5, 14, 15)
    LAYER(1, 0, 3, 2, 5, 4, 7, 6, 0, 9, 2, 11, 4, 13, 6, 15)
    LAYER(7, 6, 5, 4, 3, 2, 1, 0, 0, 1, 2, 3, 12, 13, 14, 15)
    LAYER(2, 3, 0, 1, 6, 7, 4, 5, 0, 1, 10, 11, 4, 5, 14, 15)
    LAYER(1, 0, 3, 2, 5, 4, 7, 6, 0, 9, 2, 11, 4, 13, 6, 15)
    const int place = words[SLOT_PLACE], level = (place & ~(LEVEL - 1)) + LEVEL;
    unsigned* keys = (unsigned*)stacks.data + level;
    *(Keys*)keys = v;
    keys[WIDTH] = ~0u;
    keys[LEVEL_REFERENCES] = first + REFERENCES;
    keys[LEVEL_BELOW] = place;
    // The nearest child is next. Its key is taken from the register: the level was just written, and to read it back would wait.
    int next;
    __builtin_memcpy(&next, nodes.data + (long long)first + REFERENCES + (v[0] & (WIDTH - 1)), sizeof(next));
    words[SLOT_NEXT] = next;
    words[SLOT_PLACE] = n > 1 ? level + 1 : place;
    words[SLOT_PENDING] = n == 0 ? TO_POP : 0;
    words[SLOT_LEFT] = 0;
    return next;
#endif
