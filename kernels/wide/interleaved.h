// Steps of one interleaved ray (layout.py: LEVEL, SLOT_WORDS). Each step returns the next reference, or EMPTY (0) if the ray is finished.
// `nodes` is the tree's array, `slot` the ray's slot, and `bottom` the index in `stacks` where the ray's stack begins.
#pragma once
#include "packet.h"

namespace wrt {

// Make a ray's stack empty: its first level has one child, the first of the root, for which `take_last` returns 0.
WRT_INLINE void clear(unsigned* stacks, int bottom) {
    stacks[bottom + LEVEL_REFERENCES] = REFERENCES;
    stacks[bottom + LEVEL_LEFT] = 1;
}

// A level of a ray's stack, which begins at stacks[at].
struct Level {
    int at;
    unsigned left, references;
};

WRT_INLINE Level level_at(const unsigned* stacks, int at) { return {at, stacks[at + LEVEL_LEFT], stacks[at + LEVEL_REFERENCES]}; }

WRT_INLINE unsigned least_key(const unsigned* stacks, int at) { return least_of(load<Lanes<WIDTH>::Keys>(stacks + at)); }

// Take the last child of an any-hit ray's last level, which begins at stacks[at]. With AVX-512, no branch asks whether the stack is empty:
// it would be mispredicted late. With AVX2, the branch is faster. At the bottom, LEVEL_LEFT may be 0, which has no last bit: `| 1` gives bit 0.
WRT_INLINE int take_last(const float* nodes, unsigned* stacks, int bottom, int at, int* slot) {
    if (REGISTER < LANES && at == bottom) return 0;
    unsigned* const level = stacks + at;
    const int child = 31 - __builtin_clz(level[LEVEL_LEFT] | 1);
    const unsigned left = level[LEVEL_LEFT] ^ 1u << child;
    level[LEVEL_LEFT] = left;
    const int found = load<int>(nodes + (long long)level[LEVEL_REFERENCES] + child);
    const int next = WRT_UNPREDICTABLE(at != bottom) ? found : 0;
    slot[SLOT_NEXT] = next;
    slot[SLOT_PLACE] = left != 0 ? at : at - LEVEL;
    return next;
}

// Take the nearest child of a ray's last level or, if it begins beyond `reach`, of a level below. `key` is the last level's least key: keys
// are not sorted, because most rays enter only one child or two. A child that begins exactly at `reach` may have a hit with a lower prim_id.
// Distances are not negative, so their bits have their order.
WRT_INLINE int take_nearest(const float* nodes, float reach, unsigned* stacks, int bottom, Level level, unsigned key, int* slot) {
    const unsigned last = __builtin_bit_cast(unsigned, reach) | KEY_MASK;
    int at = level.at;
    if (at == bottom) return 0;
    if (key > last) {
        do {
            at -= LEVEL;
            if (at == bottom) return 0;
            key = least_key(stacks, at);
        } while (key > last);
        level = level_at(stacks, at);
    }
    const int child = key & (WIDTH - 1);
    stacks[level.at + child] = ~0u;
    const unsigned left = level.left ^ 1u << child;
    stacks[level.at + LEVEL_LEFT] = left;
    const int next = load<int>(nodes + (long long)level.references + child);
    slot[SLOT_NEXT] = next;
    slot[SLOT_PLACE] = left != 0 ? level.at : level.at - LEVEL;
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
    const unsigned left = mask_of(met), references = first + REFERENCES;
    const int place = slot[SLOT_PLACE], above = place + LEVEL;
    const bool some = WRT_UNPREDICTABLE(left != 0);
    unsigned* const level = stacks + above;
    if constexpr (ANY_HIT) {
        level[LEVEL_LEFT] = left;
        level[LEVEL_REFERENCES] = references;
        return take_last(nodes, stacks, bottom, some ? above : place, slot);
    } else {
        const Keys child = {0, 1, 2, 3, 4, 5, 6, 7};
        const Keys keys = (__builtin_bit_cast(Keys, t.enter) & ~(unsigned)KEY_MASK) | (child + WIDTH) | ~__builtin_bit_cast(Keys, met);
        store(level, keys);
        level[LEVEL_REFERENCES] = references;
        // The level's words are chosen in registers: loads would wait for the stores.
        const Level last = level_at(stacks, place);
        const Level chosen = {some ? above : place, some ? left : last.left, some ? references : last.references};
        const unsigned new_key = least_of(keys), old_key = least_key(stacks, place);
        return take_nearest(nodes, reach, stacks, bottom, chosen, some ? new_key : old_key, slot);
    }
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
    const int place = slot[SLOT_PLACE];
    if constexpr (ANY_HIT) return take_last(nodes, stacks, bottom, place, slot);
    return take_nearest(nodes, reach, stacks, bottom, level_at(stacks, place), least_key(stacks, place), slot);
}

// Test the triangles of a row that are in the mask. Store the nearest hit in the ray's column; return its lane, or -1 on a miss. For an
// any-hit ray that hits, store only t = -inf and prim_id = 0, and return 0. If hits are listed, return -1. SURE: look for sure_hits first.
template <int GOAL, bool SURE = false, class Lists = NoLists>
WRT_INLINE int ray_triangles_here(const float* row, int mask, float* column, const Lists& lists = {}) {
    const OneRay ray = {column};
    const LeafRow triangles = {{row}};
    const int axes = ray.bits(AXES);
    if ((mask &= mask_of(candidates<WIDTH>(triangles, ray, axes))) == 0) return -1;
    const int sure = SURE && !needs_t<GOAL>(lists) ? mask & mask_of(sure_hits(triangles, ray, axes)) : 0;
    Hits<WIDTH> hit = {};
    if (GOAL == LIST_ALL ? sure != mask : sure == 0) hit = ray_triangle<WIDTH>(triangles, ray, axes, mask & ~sure);
    if ((hit.mask | sure) == 0) return -1;
    if constexpr (GOAL == LIST_ALL) {
        const int listed = sure | (lists.crossings ? crossed<WIDTH>(triangles, triangle_ray(ray, axes), hit) : hit.mask);
        int n = ray.bits(LISTED);
        ray.put_bits(LISTED, n + __builtin_popcount(listed));
        ray.put_bits(TOUCHED, ray.bits(TOUCHED) | (hit.mask & ~listed));
        if (!needs_t<GOAL>(lists)) return -1;
        for (int left = listed; left; left &= left - 1) {
            const int k = lowest(left);
            const double area = hit.area[k], area_1 = hit.areas[1][k], area_2 = hit.areas[2][k];
            append(lists, column, n++, hit.t[k], (float)(area_1 / area), (float)(area_2 / area), triangles.prim_id()[k]);
        }
        return -1;
    }
    if constexpr (GOAL == FIND_ANY) {
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

// Call ray_triangles_here, without inlining, for a ray of a packet. It looks for sure_hits; interleaved rays would be 0.8 to 1.0 times as fast.
template <int GOAL, class Lists = NoLists>
WRT_CALLED int ray_triangles(const float* row, int mask, float* column, const Lists& lists = {}) {
    return ray_triangles_here<GOAL, GOAL != FIND_CLOSEST>(row, mask, column, lists);
}

}  // namespace wrt
