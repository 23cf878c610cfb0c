    // The next child on a ray's stack, whose last level is at `at`: for any hit the last one there, else the nearest that begins at
    // or before `reach`; 0 (EMPTY) where there is none.
#if ANY_HIT
    if (at == bottom) return 0;
    unsigned* const level = (unsigned*)stacks.data + at;
    const int child = 31 - __builtin_clz(level[LEVEL_LEFT]);
#else
    // Keys are not sorted: the least is looked for when one is wanted, since most rays meet one child or two.
    unsigned *level, key;
    for (;; at -= LEVEL) {
        if (at == bottom) return 0;
        level = (unsigned*)stacks.data + at;
        key = __builtin_reduce_min(*(const Keys*)level);
        if (__builtin_bit_cast(float, key & ~(unsigned)KEY_MASK) <= reach) break;  // equal stays: a tie may have a lower prim_id
    }
    const int child = key & (WIDTH - 1);
    level[child] = ~0u;
#endif
    const unsigned left = level[LEVEL_LEFT] ^ 1u << child;
    level[LEVEL_LEFT] = left;
    int next;
    __builtin_memcpy(&next, nodes.data + (long long)level[LEVEL_REFERENCES] + child, sizeof(next));
    words[SLOT_NEXT] = next;
    words[SLOT_PLACE] = left != 0 ? at : at - LEVEL;
    return next;
