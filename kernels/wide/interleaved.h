// Steps of one interleaved ray (layout.py: LEVEL, SLOT_WORDS). Each step returns the next reference, or EMPTY (0) if the ray is finished.
// `nodes` is the tree's array, `slot` the ray's slot, and `bottom` the index in `stacks` where the ray's stack begins.
#pragma once
#include "packet.h"

namespace wrt {

// Make a ray's stack empty: its first level has one child, the first of the root, for which `take` returns 0.
WRT_INLINE void clear(unsigned* stacks, int bottom) {
    stacks[bottom + LEVEL_REFERENCES] = REFERENCES;
    stacks[bottom + LEVEL_LEFT] = 1;
}

// Take the next child from a ray's stack, whose last level begins at stacks[at]. For any-hit rays, it is the last child of that level, and
// no branch asks whether the stack is empty: it would be mispredicted late. Otherwise, it is the nearest child of a level, and begins at or
// before `reach`.
template <bool ANY_HIT> WRT_INLINE int take(const float* nodes, float reach, unsigned* stacks, int bottom, int at, int* slot) {
    unsigned* level;
    int child;
    if constexpr (ANY_HIT) {
        level = stacks + at;
        child = 31 - __builtin_clz(level[LEVEL_LEFT]);
    } else {
        // Keys are not sorted, because most rays enter only one child or two. So search the least.
        unsigned key;
        for (;; at -= LEVEL) {
            if (at == bottom) return 0;
            level = stacks + at;
            key = least_of(load<Lanes<WIDTH>::Keys>(level));
            // A child that begins exactly at `reach` may have a hit with a lower prim_id.
            if (__builtin_bit_cast(float, key & ~(unsigned)KEY_MASK) <= reach) break;
        }
        child = key & (WIDTH - 1);
        level[child] = ~0u;
    }
    const unsigned left = level[LEVEL_LEFT] ^ 1u << child;
    level[LEVEL_LEFT] = left;
    const int found = load<int>(nodes + (long long)level[LEVEL_REFERENCES] + child);
    const int next = !ANY_HIT || WRT_UNPREDICTABLE(at != bottom) ? found : 0;
    slot[SLOT_NEXT] = next;
    slot[SLOT_PLACE] = left != 0 ? at : at - LEVEL;
    return next;
}

// Push the children of a node that a ray enters onto its stack as a new level, if there are any; then take a child. Both cases share one
// path: in a third of the nodes, the ray enters no child, and a branch would be mispredicted. Distances must not be negative.
template <bool ANY_HIT>
WRT_INLINE int push_and_take(const float* nodes, int first, const Interval<Lanes<WIDTH>::Floats>& t, float reach, unsigned* stacks,
                            int bottom, int* slot) {
    typedef Lanes<WIDTH>::Keys Keys;
    static_assert(WIDTH == 8, "`child` lists eight indices");
    const auto met = t.enter <= t.leave;
    const unsigned left = mask_of(met);
    const int place = slot[SLOT_PLACE];
    unsigned* const level = stacks + place + LEVEL;
    if constexpr (!ANY_HIT) {
        const Keys child = {0, 1, 2, 3, 4, 5, 6, 7};
        store(level, (__builtin_bit_cast(Keys, t.enter) & ~(unsigned)KEY_MASK) | (child + WIDTH) | ~__builtin_bit_cast(Keys, met));
    }
    level[LEVEL_LEFT] = left;
    level[LEVEL_REFERENCES] = first + REFERENCES;
    return take<ANY_HIT>(nodes, reach, stacks, bottom, WRT_UNPREDICTABLE(left != 0) ? place + LEVEL : place, slot);
}

// Put a ray into a slot, and take the first of the children of node `root`. rays_meeting has stored their ROOT_ENTRIES.
template <bool ANY_HIT>
WRT_INLINE int begin(const float* nodes, int root, float* packets, int ray, unsigned* stacks, int bottom, int* slot) {
    typedef Lanes<WIDTH>::Floats Children;
    Children enter;
    for (int child = 0; child < WIDTH; ++child) enter[child] = packets[ray + ROOT_ENTRIES + LANES * child];
    slot[SLOT_RAY] = ray;
    slot[SLOT_PLACE] = bottom;
    clear(stacks, bottom);
    const float reach = __builtin_inff();
    return push_and_take<ANY_HIT>(nodes, root * NODE_SIZE, {enter, all<Children>(LARGEST)}, reach, stacks, bottom, slot);
}

// Visit the node `node` = nodes + first, and take the next child: of this node or, if the ray enters none, from the stack. The ray has one
// origin for near planes and one for far planes (box.h: narrow).
template <bool ANY_HIT>
WRT_INLINE int step_at(const float* nodes, const float* node, int first, const Vec3<float>& near_origin, const Vec3<float>& far_origin,
                       float* packets, unsigned* stacks, int bottom, int* slot) {
    typedef Lanes<WIDTH>::Floats Children;
    const OneRay ray = {packets + slot[SLOT_RAY]};
    const int near_x = ray.bits(NEAR_X), near_y = ray.bits(NEAR_Y), near_z = ray.bits(NEAR_Z);
    const Vec3<Children> near = {{load<Children>(node + near_x), load<Children>(node + near_y), load<Children>(node + near_z)}};
    const Vec3<Children> far = {{load<Children>(node + (near_x ^ WIDTH)), load<Children>(node + (near_y ^ WIDTH)),
                                 load<Children>(node + (near_z ^ WIDTH))}};
    const float reach = ray[T];
    Interval<Children> t = {all<Children>(ray[T_MIN]), all<Children>(reach)};
    narrow(t, near, far, near_origin, far_origin, vector<float>(ray, INVERSE_X), vector<float>(ray, FAR_X));
    return push_and_take<ANY_HIT>(nodes, first, t, reach, stacks, bottom, slot);
}

// Call step_at for the ray's next node.
template <bool ANY_HIT> WRT_INLINE int step(const float* nodes, float* packets, unsigned* stacks, int bottom, int* slot) {
    const int first = slot[SLOT_NEXT] * NODE_SIZE;
    const Vec3<float> origin = vector<float>(OneRay{packets + slot[SLOT_RAY]}, ORIGIN_X);
    return step_at<ANY_HIT>(nodes, nodes + (long long)first, first, origin, origin, packets, stacks, bottom, slot);
}

// After a leaf, take a child from the stack that begins at or before `reach`, the ray's t.
template <bool ANY_HIT> WRT_INLINE int pop(const float* nodes, float reach, unsigned* stacks, int bottom, int* slot) {
    return take<ANY_HIT>(nodes, reach, stacks, bottom, slot[SLOT_PLACE], slot);
}

// Test the triangles of a row that are in the mask. Store the nearest hit in the ray's column; return its lane, or -1 on a miss. For an
// any-hit ray that hits, store only t = -inf and prim_id = 0, and return 0.
template <bool ANY_HIT> WRT_INLINE int ray_triangles_here(const float* row, int mask, float* column) {
    const OneRay ray = {column};
    const LeafRow triangles = {{row}};
    const int axes = ray.bits(AXES);
    if ((mask &= mask_of(candidates<WIDTH>(triangles, ray, axes))) == 0) return -1;
    const Hits<WIDTH> hit = ray_triangle<WIDTH>(triangles, ray, axes, mask);
    if (hit.mask == 0) return -1;
    if constexpr (ANY_HIT) {
        ray.put(T, -__builtin_inff());
        ray.put_bits(PRIM_ID, 0);
        return 0;
    }
    const auto id = triangles.prim_id();
    int j = lowest(hit.mask);
    for (int others = hit.mask & (hit.mask - 1); others; others &= others - 1) {
        const int k = lowest(others);
        if (hit.t[k] < hit.t[j] || (hit.t[k] == hit.t[j] && id[k] < id[j])) j = k;
    }
    const double area = hit.area[j], area_1 = hit.areas[1][j], area_2 = hit.areas[2][j];
    ray.put(T, hit.t[j]);
    ray.put(U, (float)(area_1 / area));
    ray.put(V, (float)(area_2 / area));
    ray.put_bits(PRIM_ID, id[j]);
    return j;
}

// Call ray_triangles_here, without inlining.
template <bool ANY_HIT> WRT_CALLED int ray_triangles(const float* row, int mask, float* column) {
    return ray_triangles_here<ANY_HIT>(row, mask, column);
}

}  // namespace wrt
