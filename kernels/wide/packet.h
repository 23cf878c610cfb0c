// Steps of a packet's traversal: tests of nodes and triangles, and the stack. layout.py describes the memory layouts.
#pragma once
#include "layout.h"
#include "triangle.h"

namespace wrt {

// --- access to the fields of N rays of a packet, or of one ray (layout.py: FIELDS) -----------------------------------------------

typedef Lanes<LANES>::Floats Rays;
typedef Lanes<LANES>::Ints RayInts;

template <int N> struct SomeRays {
    float* rows;
    typedef typename Lanes<N>::Floats Floats;
    typedef typename Lanes<N>::Ints Ints;
    WRT_MEMBER Floats operator[](int row) const { return load<Floats>(rows + row); }
    WRT_MEMBER Ints bits(int row) const { return load<Ints>(rows + row); }
    WRT_MEMBER void put(int row, Floats value) const { store(rows + row, value); }
    WRT_MEMBER void put_bits(int row, Ints value) const { store(rows + row, value); }
};

typedef SomeRays<LANES> AllRays;

struct OneRay {
    float* rows;
    WRT_MEMBER float operator[](int row) const { return rows[row]; }
    WRT_MEMBER int bits(int row) const { return load<int>(rows + row); }
    WRT_MEMBER void put(int row, float value) const { rows[row] = value; }
    WRT_MEMBER void put_bits(int row, int value) const { store(rows + row, value); }
};

template <class T, class Number> WRT_INLINE Vec3<T> in_lanes(const Vec3<Number>& v) {
    return {{all<T>(v[0]), all<T>(v[1]), all<T>(v[2])}};
}

// Return a vector of three consecutive fields; `first` is the index of the x field.
template <class T, class Ray> WRT_INLINE Vec3<T> vector(const Ray& ray, int first) {
    return {{all<T>(ray[first]), all<T>(ray[first + LANES]), all<T>(ray[first + 2 * LANES])}};
}

// --- triangles ----------------------------------------------------------------------------------------------------------------

// A row of a leaf's triangles, for one ray.
struct LeafRow : Row<WIDTH> {
    WRT_MEMBER Ints prim_id() const { return load<Ints>(numbers + WIDTH * PRIM_ID_ROW); }
};

// Triangle j of a row, for N rays of a packet.
template <int N> struct Triangle {
    const float* numbers;

    WRT_MEMBER Triangle(const float* row, int j) : numbers(row + j) {}
    WRT_MEMBER float number(int corner, int k) const { return numbers[WIDTH * (3 * corner + k)]; }
    WRT_MEMBER auto component(int corner, int k) const { return all<typename Lanes<N>::Floats>(number(corner, k)); }
    WRT_MEMBER auto component(int corner, typename Lanes<N>::Ints k) const {
        return k == 0 ? component(corner, 0) : (k == 1 ? component(corner, 1) : component(corner, 2));
    }
    WRT_MEMBER Vec3<float> corner(int i) const { return {{number(i, 0), number(i, 1), number(i, 2)}}; }
    WRT_MEMBER int id() const { return load<int>(numbers + WIDTH * PRIM_ID_ROW); }
    WRT_MEMBER auto prim_id() const { return all<typename Lanes<N>::Ints>(id()); }
};

// Return the rays' set-up for the triangle test. `axes` has the axes of all rays (layout.py: FIELDS).
template <class Ray, class Axes> WRT_INLINE auto triangle_ray(const Ray& ray, Axes axes) {
    auto s_x = ray[SHEAR_X], s_y = ray[SHEAR_Y];
    return TriangleRay<Axes, decltype(s_x)>{axes & AXIS_MASK, axes >> AXIS_BITS & AXIS_MASK, axes >> 2 * AXIS_BITS, s_x, s_y,
                                           vector<decltype(s_x)>(ray, TURNED_X)};
}

// Return the lanes that the test in float32 does not reject, without a ray's own triangle.
template <int N, class Triangles, class Ray, class Axes>
WRT_INLINE typename Lanes<N>::Ints candidates(const Triangles& triangles, const Ray& ray, Axes axes) {
    return accepted(triangles, triangle_ray(ray, axes)) & (triangles.prim_id() + 1 != all<typename Lanes<N>::Ints>(ray.bits(EXCLUDE)));
}

// Return the largest absolute value among the components.
template <class T> WRT_INLINE T greatest(const Vec3<T>& v) {
    const T x = absolute(v[0]), y = absolute(v[1]), z = absolute(v[2]), longer = y > x ? y : x;
    return z > longer ? z : longer;
}

// Return the lanes in which float32 proves that `ray_triangle` finds a hit. An any-hit ray needs no more, nor does a count: such a
// hit is a crossing. The exact test takes three times as long. The proof:
// - Rounding is monotone, so areas that are not 0 have the signs of the exact areas.
// - t is a mean of the corners' t, whose least and greatest are the slab interval of axis kz, bit for bit. So t, also if it is clamped to the
//   triangle's box, lies between them. It may pass them by the rounding of t and, if it is clamped to the padded box, by the pad. `margin`
//   is more than twice as much: with x and y the largest absolute coordinates of the sheared corners, the box's extent is at most
//   2 (x + y + |z|), and its largest coordinate along kz is |origin| + |z|.
// - MARGIN excludes rays whose shear may underflow (units/triangle.py: underflowed). For all others, the padded box contains the hit.
template <class Triangles, class Ray, class Axes> WRT_INLINE auto sure_hits(const Triangles& triangles, const Ray& ray, Axes axes) {
    const auto shear = triangle_ray(ray, axes);
    const auto a = to_ray_space(triangles, 0, shear), b = to_ray_space(triangles, 1, shear), c = to_ray_space(triangles, 2, shear);
    const auto areas = edge_areas(a, b, c);
    typedef decltype(areas[0] + areas[1]) Floats;
    const Floats zero = {}, x = greatest(Vec3<Floats>{{a[0], b[0], c[0]}}), y = greatest(Vec3<Floats>{{a[1], b[1], c[1]}});
    const Floats s = all<Floats>(ray[SHEAR_Z]), t_a = a[2] * s, t_b = b[2] * s, t_c = c[2] * s;
    const Floats nearer = t_b < t_a ? t_b : t_a, near = t_c < nearer ? t_c : nearer;
    const Floats farther = t_b > t_a ? t_b : t_a, far = t_c > farther ? t_c : farther;
    const Floats margin = MARGIN_FACTOR * ((x + y + all<Floats>(ray[MARGIN])) * absolute(s) + far);
    auto sure = (near > all<Floats>(ray[T_MIN]) + margin) & (far + margin < all<Floats>(ray[T]));
    for (int k = 0; k < 3; ++k) sure &= (areas[k] < zero) | (areas[k] > zero);
    return sure;
}

// Return the hits that are better than the best hit of each ray: with t in [t_min, T] and, at t = T, a prim_id that is not higher. The
// steps are those of `watertight`, `within_bounds` and `better` (traverse/common.py) for candidates, in the lanes of `mask`.
template <int N, class Triangles, class Ray, class Axes>
WRT_INLINE Hits<N> ray_triangle(const Triangles& triangles, const Ray& ray, Axes axes, int mask) {
    typedef typename Lanes<N>::Floats Floats;
    typedef typename Lanes<N>::Ints Ints;
    const auto shear = triangle_ray(ray, axes);
    const Vec3<Floats> a = to_ray_space(triangles, 0, shear), b = to_ray_space(triangles, 1, shear), c = to_ray_space(triangles, 2, shear);
    Hits<N> hit = crossing<N>(a, b, c, all<Floats>(ray[SHEAR_Z]), mask);
    if (hit.mask == 0) return hit;
    const BoxRay<Floats> box = {vector<Floats>(ray, ORIGIN_X), vector<Floats>(ray, INVERSE_X)};
    const auto lo = lower(lower(triangles.corner(0), triangles.corner(1)), triangles.corner(2));
    const auto hi = upper(upper(triangles.corner(0), triangles.corner(1)), triangles.corner(2));
    within_bounds<Bounds>(box, hit, in_lanes<Floats>(lo), in_lanes<Floats>(hi));
    const Floats t_min = all<Floats>(ray[T_MIN]), best = all<Floats>(ray[T]);
    const Ints id = triangles.prim_id(), best_id = all<Ints>(ray.bits(PRIM_ID));
    hit.mask &= mask_of((absolute(hit.t) < all<Floats>(__builtin_inff())) & (hit.t >= t_min) & (hit.t <= best));
    hit.mask &= mask_of(~((hit.t == best) & (id > best_id)));
    return hit;
}

// Return the mask of the primitives of a row that are spheres.
WRT_INLINE int spheres_of(const float* row, int n_triangles) {
    return mask_of(LeafRow{{row}}.prim_id() >= n_triangles);
}

// --- nodes --------------------------------------------------------------------------------------------------------------------

struct PacketRay {
    Vec3<Rays> origin, inv_dir, far_inv_dir;
    Rays t_min, t_max;
};

WRT_INLINE PacketRay packet_ray(const AllRays& packet) {
    return {vector<Rays>(packet, ORIGIN_X), vector<Rays>(packet, INVERSE_X), vector<Rays>(packet, FAR_X), packet[T_MIN], packet[T]};
}

WRT_INLINE Interval<Rays> interval_in(const PacketRay& ray, const Vec3<Rays>& near, const Vec3<Rays>& far) {
    Interval<Rays> t = {ray.t_min, ray.t_max};
    narrow(t, near, far, ray.origin, ray.origin, ray.inv_dir, ray.far_inv_dir);
    return t;
}

typedef Lanes<WIDTH>::Floats Children;

// Return the distances at which the beam enters and leaves the children of a node. A distance is a product of two intervals, so its bounds
// are products of the extreme origin with both extreme reciprocals. The largest reciprocal comes first, because it may be infinite: then
// the comparison ignores a product 0 * inf = NaN.
WRT_INLINE Interval<Children> beam_interval(const float* packet, const float* node, const int near[3]) {
    Interval<Children> t = {all<Children>(packet[BEAM_T_MIN]), all<Children>(LARGEST)};
    for (int k = 0; k < 3; ++k) {
        const Children n = load<Children>(node + WIDTH * near[k]) - packet[BEAM_NEAR_ORIGIN + k];
        const Children a = n * packet[BEAM_LARGEST + k], b = n * packet[BEAM_SMALLEST + k], least = b < a ? b : a;
        t.enter = least > t.enter ? least : t.enter;
        const Children f = load<Children>(node + WIDTH * (near[k] ^ 1)) - packet[BEAM_FAR_ORIGIN + k];
        const Children c = f * packet[BEAM_FAR_LARGEST + k], d = f * packet[BEAM_FAR_SMALLEST + k], most = d > c ? d : c;
        t.leave = most < t.leave ? most : t.leave;
    }
    return t;
}

// Prefetch the first cache lines of the row of triangles, or the node, that a reference points to.
WRT_INLINE void prefetch(const float* nodes, const float* primitives, int reference) {
    const float* const first = reference < 0 ? primitives + (long long)(~reference >> LEAF_BITS) * ROW_SIZE
                                             : nodes + (long long)reference * NODE_SIZE;
    for (int k = 0; k < LINES; ++k) __builtin_prefetch(first + CACHE_LINE * k);
}

// Push an entry onto a stack of `size` entries, and sort the entries from `begin` on, with the farthest deepest. For any-hit rays, entries
// stay in the order of the node's children.
template <bool ANY_HIT> WRT_INLINE void push(unsigned* stack, int begin, int size, unsigned long long key, int rays) {
    unsigned* at = stack + ENTRY * size;
    if constexpr (!ANY_HIT)
        for (; at > stack + ENTRY * begin && load<unsigned long long>(at - ENTRY) < key; at -= ENTRY)
            __builtin_memcpy(at, at - ENTRY, ENTRY * sizeof(unsigned));
    store(at, key);
    at[ENTRY_RAYS] = rays;
}

// Push the children of the node at `p` that rays of the mask enter onto a stack of `size` entries; return the new size. The packet must
// have a beam. MIXED: near planes differ by ray. What the children's references lead to, in `nodes` or `primitives`, is prefetched.
template <bool ANY_HIT, bool MIXED = false>
WRT_INLINE int children_at(const float* p, const float* nodes, const float* primitives, float* packet, int mask, unsigned* stack, int size) {
    const int near[3] = {(int)packet[BEAM_NEAR_ROW], (int)packet[BEAM_NEAR_ROW + 1], (int)packet[BEAM_NEAR_ROW + 2]};
    const Interval<Children> beam = beam_interval(packet, p, near);
    const int x = MIXED ? LO_X : near[0], y = MIXED ? LO_Y : near[1], z = MIXED ? LO_Z : near[2];
    const float *near_x = p + WIDTH * x, *near_y = p + WIDTH * y, *near_z = p + WIDTH * z;
    const float *far_x = p + WIDTH * (x ^ 1), *far_y = p + WIDTH * (y ^ 1), *far_z = p + WIDTH * (z ^ 1);
    int left = mask_of(beam.enter <= beam.leave), top = size;
    for (; left; left &= left - 1) {
        const int child = lowest(left);
        const AllRays rays = {REGISTER < LANES ? opaque(packet) : packet};
        const PacketRay ray = packet_ray(rays);
        const BoxRay<Rays> box = {ray.origin, ray.inv_dir};
        const auto lo = in_lanes<Rays>(Vec3<float>{{near_x[child], near_y[child], near_z[child]}});
        const auto hi = in_lanes<Rays>(Vec3<float>{{far_x[child], far_y[child], far_z[child]}});
        const Interval<Rays> t = MIXED ? interval_in(ray, near_planes(box, lo, hi), near_planes(box, hi, lo)) : interval_in(ray, lo, hi);
        const int met = mask_of(t.enter <= t.leave) & mask;
        if (!met) continue;
        const int next = load<int>(p + REFERENCES + child);
        prefetch(nodes, primitives, next);
        const float entry = beam.enter[child];  // Without this copy, clang 22 casts the bits of beam.enter[0].
        const auto key = (unsigned long long)__builtin_bit_cast(unsigned, entry) << 32 | (unsigned)next;
        push<ANY_HIT>(stack, size, top++, key, met);
    }
    return top;
}

// Call children_at, without inlining, for the node with index `node`.
template <bool ANY_HIT, bool MIXED>
WRT_CALLED int children(const float* nodes, const float* primitives, float* packet, int node, int mask, unsigned* stack, int size) {
    return children_at<ANY_HIT, MIXED>(nodes + (long long)node * NODE_SIZE, nodes, primitives, packet, mask, stack, size);
}

// Return the mask of the rays in `mask` that enter a child of the root, and store their entry distances in ROOT_ENTRIES. The rays have one
// origin for near planes and one for far planes (box.h: narrow).
WRT_INLINE int rays_meeting(const float* root, const PacketRay& ray, const Vec3<Rays>& near_origin, const Vec3<Rays>& far_origin, int mask,
                            float* packet) {
    const BoxRay<Rays> box = {ray.origin, ray.inv_dir};
    const Rays never = all<Rays>(__builtin_inff());
    int out = 0;
    for (int child = 0; child < WIDTH; ++child) {
        const float* const p = root + child;
        const auto lo = in_lanes<Rays>(Vec3<float>{{p[WIDTH * LO_X], p[WIDTH * LO_Y], p[WIDTH * LO_Z]}});
        const auto hi = in_lanes<Rays>(Vec3<float>{{p[WIDTH * HI_X], p[WIDTH * HI_Y], p[WIDTH * HI_Z]}});
        Interval<Rays> t = {ray.t_min, ray.t_max};
        narrow(t, near_planes(box, lo, hi), near_planes(box, hi, lo), near_origin, far_origin, ray.inv_dir, ray.far_inv_dir);
        store(packet + ROOT_ENTRIES + LANES * child, t.enter <= t.leave ? t.enter : never);
        out |= mask_of(t.enter <= t.leave);
    }
    return out & mask;
}

WRT_INLINE int rays_meeting_root(const float* root, int mask, float* packet) {
    const PacketRay ray = packet_ray({packet});
    return rays_meeting(root, ray, ray.origin, ray.origin, mask, packet);
}

// Return the mask of the rays whose t is at least t_entry.
WRT_INLINE int rays_reaching(float t_entry, float* packet) { return mask_of(AllRays{packet}[T] >= t_entry); }

struct NoLists {};

// Return whether the traversal needs t of hits, and not only their number.
template <int GOAL, class Lists> WRT_INLINE bool needs_t(const Lists& lists) {
    if constexpr (GOAL == LIST_ALL) return lists.rows.data != nullptr;
    return GOAL == FIND_CLOSEST;
}

// Store hit n of a ray in the list of the ray, if it has room (hit_lists.py: HitLists); column: where the ray's fields begin.
template <class Lists> WRT_INLINE void append(const Lists& lists, const float* column, int n, float t, float u, float v, int prim_id) {
    const int ray = load<int>(column + ROOT), row = lists.first.data[ray] + n;
    if (row >= lists.first.data[ray + 1]) return;
    lists.rows.data[row].t = t;
    lists.rows.data[row].u = u;
    lists.rows.data[row].v = v;
    lists.rows.data[row].prim_id = prim_id;
}

// Test a triangle against N rays of a packet, the candidates in the lanes of `mask`, and store hits; return their mask. Listed hits are not
// in the result.
template <int N, int GOAL, class Axes, class Lists>
WRT_INLINE int test(const Triangle<N>& triangle, const SomeRays<N>& rays, Axes axes, int mask, const Lists& lists) {
    typedef typename Lanes<N>::Floats Floats;
    typedef typename Lanes<N>::Ints Ints;
    const int sure = needs_t<GOAL>(lists) ? 0 : mask & mask_of(sure_hits(triangle, rays, axes));
    Hits<N> hit = {};
    if (sure != mask) hit = ray_triangle<N>(triangle, rays, axes, mask & ~sure);
    const int found = hit.mask | sure;
    if (found == 0) return 0;
    const Ints on = in_mask<Ints>(found);
    if constexpr (GOAL == LIST_ALL) {
        const int listed = sure | (lists.crossings ? crossed<N>(triangle, triangle_ray(rays, axes), hit) : hit.mask);
        const Ints before = rays.bits(LISTED);
        rays.put_bits(LISTED, before - in_mask<Ints>(listed));
        rays.put_bits(TOUCHED, rays.bits(TOUCHED) | in_mask<Ints>(hit.mask & ~listed));
        if (!needs_t<GOAL>(lists)) return 0;
        const auto u = narrowed<N>(hit.areas[1] / hit.area), v = narrowed<N>(hit.areas[2] / hit.area);
        for (int left = listed; left; left &= left - 1) {
            const int k = lowest(left);
            append(lists, rays.rows + k, before[k], hit.t[k], u[k], v[k], triangle.id());
        }
        return 0;
    }
    rays.put(T, on ? (GOAL == FIND_ANY ? all<Floats>(-__builtin_inff()) : hit.t) : rays[T]);
    rays.put_bits(PRIM_ID, on ? triangle.prim_id() : rays.bits(PRIM_ID));
    if constexpr (GOAL == FIND_CLOSEST) {
        rays.put(U, on ? narrowed<N>(hit.areas[1] / hit.area) : rays[U]);
        rays.put(V, on ? narrowed<N>(hit.areas[2] / hit.area) : rays[V]);
    }
    return found;
}

// Test the first `count` triangles of a row, one after another, against the rays of the mask, which have the same axes; return the mask of
// the rays that hit a triangle. The rays of one register are tested at a time: the values of more do not fit into sixteen registers.
template <int GOAL, class Axes, class Lists>
WRT_INLINE int triangles_along(Axes axes, const float* row, int count, int mask, float* numbers, const Lists& lists) {
    constexpr int PARTS = LANES / REGISTER, FULL = (1 << REGISTER) - 1;
    int found = 0;
    for (int j = 0; j < count; ++j) {
        const Triangle<REGISTER> triangle(row, j);
        int hits = 0;
        for (int k = 0; k < PARTS; ++k) {
            const SomeRays<REGISTER> rays = {numbers + REGISTER * k};
            const int left = mask_of(candidates<REGISTER>(triangle, rays, axes)) & mask >> REGISTER * k & FULL;
            if (left) hits |= test<REGISTER, GOAL>(triangle, rays, axes, left, lists) << REGISTER * k;
        }
        found |= hits;
        if (GOAL == FIND_ANY && (mask &= ~hits) == 0) break;
    }
    return found;
}

// Test the first `count` triangles of a row against the rays of the mask; return the mask of the rays that hit a triangle. In any-hit rays
// that hit, t becomes -inf. Rays with the same axes are tested together, so that corners need no selection by ray: mostly, these are all.
template <int GOAL, class Lists = NoLists>
WRT_CALLED int triangles(const float* row, int count, int mask, float* numbers, const Lists& lists = {}) {
    const AllRays packet = {numbers};
    if constexpr (REGISTER == LANES) return triangles_along<GOAL>(packet.bits(AXES), row, count, mask, numbers, lists);
    int found = 0;
    while (mask) {
        const int axes = load<int>(numbers + AXES + lowest(mask));
        const int along = mask & mask_of(packet.bits(AXES) == axes);
        found |= triangles_along<GOAL>(axes, row, count, along, numbers, lists);
        mask &= ~along;
    }
    return found;
}

constexpr int BEST[] = {T, U, V, PRIM_ID};  // the fields of a ray's best hit

// Copy the best hits of all rays of a packet to `kept`, one vector for each field of BEST.
WRT_INLINE void keep_best(const float* numbers, float* kept) {
    for (int k = 0; k < 4; ++k) store(kept + LANES * k, load<Rays>(numbers + BEST[k]));
}

// Give one ray of a packet the best hit that keep_best kept.
WRT_INLINE void restore_best(float* numbers, const float* kept, int lane) {
    for (int k = 0; k < 4; ++k) store(numbers + BEST[k] + lane, load<int>(kept + LANES * k + lane));
}

// Write the hits of `count` rays to HitArrays (query.py), from index `first` on. A miss gets t = inf and prim_id = -1.
template <class HitArrays> WRT_INLINE void write_hits(const HitArrays& hits, int first, int count, float* numbers) {
    const AllRays packet = {numbers};
    const RayInts id = packet.bits(PRIM_ID), prim_id = id == NO_HIT ? all<RayInts>(-1) : id;
    const Rays t = id == NO_HIT ? all<Rays>(__builtin_inff()) : packet[T] * packet[SCALE];
    if (count == LANES) {
        store(hits.t.data + first, t);
        store(hits.u.data + first, packet[U]);
        store(hits.v.data + first, packet[V]);
        store(hits.prim_id.data + first, prim_id);
        return;
    }
    for (int j = 0; j < count; ++j) {
        hits.t.data[first + j] = t[j];
        hits.u.data[first + j] = numbers[U + j];
        hits.v.data[first + j] = numbers[V + j];
        hits.prim_id.data[first + j] = prim_id[j];
    }
}

// Make the lists of all rays of a packet empty; first: index of its first ray.
WRT_INLINE void begin_lists(int first, float* numbers) {
    store(numbers + LISTED, RayInts{});
    store(numbers + TOUCHED, RayInts{});
    for (int j = 0; j < LANES; ++j) store(numbers + ROOT + j, first + j);
}

WRT_INLINE void write_occluded(bool* occluded, int count, float* numbers) {
    const int found = mask_of(AllRays{numbers}.bits(PRIM_ID) != NO_HIT);
    for (int j = 0; j < count; ++j) occluded[j] = found >> j & 1;
}

}  // namespace wrt
