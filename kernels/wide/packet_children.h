    float* const q = packet.data + (long long)base;
    const float *const all = nodes.data, *const p = all + (long long)first, *const rows = primitives.data;
    unsigned* const stack = stacks.data;
    auto once = [=]() __attribute__((noinline)) {  // the compiler would copy it to where it is called
    #include "packet.h"
    #include "rows.h"
    // The beam first. Distances are products of two intervals: bounds are the extreme origin times both reciprocals. The largest
    // reciprocal comes first: it may be infinite, and 0 * inf = NaN then says nothing.
    #define PLANES(k) (*(const Row*)(p + WIDTH * (k)))
    const int near[3] = {(int)q[BEAM_NEAR_ROW], (int)q[BEAM_NEAR_ROW + 1], (int)q[BEAM_NEAR_ROW + 2]};
    Row beam_enter = (Row)(q[BEAM_T_MIN]), beam_leave = (Row)(LARGEST);
    for (int k = 0; k < 3; ++k) {
        const Row n = PLANES(near[k]) - q[BEAM_NEAR_ORIGIN + k], a = n * q[BEAM_LARGEST + k], b = n * q[BEAM_SMALLEST + k];
        const Row least = b < a ? b : a;
        beam_enter = least > beam_enter ? least : beam_enter;
        const Row f = PLANES(near[k] ^ 1) - q[BEAM_FAR_ORIGIN + k], c = f * q[BEAM_FAR_LARGEST + k], d = f * q[BEAM_FAR_SMALLEST + k];
        const Row most = d > c ? d : c;
        beam_leave = most < beam_leave ? most : beam_leave;
    }
    int left = ROW_MASK(beam_enter <= beam_leave), top = size;
    // Then the rays, for each child that the beam meets.
    #include "packet_rays.h"
    const float *near_x = p + WIDTH * near[0], *near_y = p + WIDTH * near[1], *near_z = p + WIDTH * near[2];
    const float *far_x = p + WIDTH * (near[0] ^ 1), *far_y = p + WIDTH * (near[1] ^ 1), *far_z = p + WIDTH * (near[2] ^ 1);
    #define NEAR(axis) near_##axis[child]
    #define FAR(axis) far_##axis[child]
    while (left) {
        const int child = __builtin_ctz(left);
        left &= left - 1;
        Rays enter = t_min, leave = t_max;
        #include "slabs.h"
        const int met = RAY_MASK(enter <= leave) & mask;
        if (!met) continue;
        int next;
        __builtin_memcpy(&next, p + REFERENCES + child, sizeof(next));
        const float* const there = next < 0 ? rows + (long long)(~next >> LEAF_BITS) * ROW_SIZE : all + (long long)next * NODE_SIZE;
        for (int k = 0; k < LINES; ++k) __builtin_prefetch(there + CACHE_LINE * k);
        const float entry = beam_enter[child];  // of `beam_enter[child]` itself clang 22 casts the bits of element 0
        const wp::uint64 key = (wp::uint64)__builtin_bit_cast(unsigned, entry) << 32 | (unsigned)next;
        unsigned* at = stack + ENTRY * top++;
#if !ANY_HIT
        wp::uint64 below;  // the farthest is deepest
        for (; at > stack + ENTRY * size && (__builtin_memcpy(&below, at - ENTRY, sizeof(below)), below < key); at -= ENTRY)
            __builtin_memcpy(at, at - ENTRY, ENTRY * sizeof(unsigned));
#endif
        __builtin_memcpy(at, &key, sizeof(key));
        at[ENTRY_RAYS] = met;
    }
    return top;
    };
    return once();
