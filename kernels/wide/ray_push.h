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
    // A level of a ray's stack from one node: the keys of its children, from `enter` of all and `met`, which of them the ray meets.
    // They are not sorted: the least is looked for when one is wanted, since most rays meet one child or two.
    typedef unsigned Keys __attribute__((ext_vector_type(WIDTH), aligned(4)));
    static_assert(WIDTH == 8, "the children have numbers");
    const unsigned all = ROW_MASK(met);
    const Keys child = {0, 1, 2, 3, 4, 5, 6, 7};
    const Keys v = (__builtin_bit_cast(Keys, enter) & ~(unsigned)KEY_MASK) | (child + WIDTH) | ~__builtin_bit_cast(Keys, met);
    const unsigned key = __builtin_reduce_min(v);
    const int place = words[SLOT_PLACE];
    unsigned* level = (unsigned*)stacks.data + place + LEVEL;
    *(Keys*)level = v | __builtin_bit_cast(Keys, v == (Keys)(key));
    level[LEVEL_REFERENCES] = first + REFERENCES;
    int next;
    __builtin_memcpy(&next, nodes.data + (long long)first + REFERENCES + (key & (WIDTH - 1)), sizeof(next));
    words[SLOT_NEXT] = next;
    words[SLOT_PLACE] = (all & (all - 1)) != 0 ? place + LEVEL : place;
    words[SLOT_PENDING] = all == 0 ? TO_POP : 0;
    words[SLOT_LEFT] = 0;
    return next;
#endif
