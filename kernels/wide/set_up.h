// Set-up of a packet: the scaling of query.py (scaled_ray), then the rays' fields for tests of boxes and triangles, and the beam.
#pragma once
#include "packet.h"

namespace wrt {

// Arrays of rays; each pointer is to the first ray of a packet. `excludes` has values of Ray.exclude_plus_one, or is null.
struct RayPointers {
    const float *origins, *directions, *t_mins, *t_maxs;
    const int* excludes;
    bool one_t_min, one_t_max;  // True if the array has one value for all rays.
};

// Return pointers to ray `first` in contiguous Warp arrays. A stride of 0 means one t_min or t_max for all rays (query.py: RayArrays).
template <class RayArrays> WRT_INLINE RayPointers pointers_to(const RayArrays& rays, int first, const int* excludes) {
    const bool one_t_min = rays.t_min.strides[0] == 0, one_t_max = rays.t_max.strides[0] == 0;
    return {(const float*)(rays.origin.data + first), (const float*)(rays.direction.data + first),
            rays.t_min.data + (one_t_min ? 0 : first), rays.t_max.data + (one_t_max ? 0 : first),
            excludes, one_t_min, one_t_max};
}

// N rays in the units of a query.
template <int N> struct RayBlock {
    Vec3<typename Lanes<N>::Floats> origin, direction;
    typename Lanes<N>::Floats t_min, t_max;
    typename Lanes<N>::Ints exclude;
};

typedef RayBlock<LANES> SixteenRays;

// Return component K of sixteen vectors of three, which are 48 consecutive floats: three vectors of lanes. The first two vectors have 11 or
// 10 values of the component, the third has the others.
template <int K> WRT_INLINE Rays component_of(const float* v) {
    const Rays two = __builtin_shufflevector(load<Rays>(v), load<Rays>(v + LANES), K, K + 3, K + 6, K + 9, K + 12, K + 15, K + 18,
                                             K + 21, K + 24, K + 27, K < 2 ? K + 30 : 0, 0, 0, 0, 0, 0);
    return __builtin_shufflevector(two, load<Rays>(v + 2 * LANES), 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, K < 2 ? 10 : 16, K + 17, K + 20,
                                   K + 23, K + 26, K + 29);
}

WRT_INLINE Vec3<Rays> vectors_of(const float* v) { return {{component_of<0>(v), component_of<1>(v), component_of<2>(v)}}; }

// Load `count` rays. Copies of the last ray fill the other lanes.
WRT_INLINE SixteenRays load_rays(const RayPointers& from, int count) {
    SixteenRays out;
    if (count == LANES) {
        out.origin = vectors_of(from.origins);
        out.direction = vectors_of(from.directions);
        out.t_min = from.one_t_min ? all<Rays>(*from.t_mins) : load<Rays>(from.t_mins);
        out.t_max = from.one_t_max ? all<Rays>(*from.t_maxs) : load<Rays>(from.t_maxs);
    } else {
        float copy[8][LANES];
        for (int j = 0; j < LANES; ++j) {
            const int i = j < count ? j : count - 1;
            for (int k = 0; k < 3; ++k) {
                copy[k][j] = from.origins[3 * i + k];
                copy[3 + k][j] = from.directions[3 * i + k];
            }
            copy[6][j] = from.t_mins[from.one_t_min ? 0 : i];
            copy[7][j] = from.t_maxs[from.one_t_max ? 0 : i];
        }
        out.origin = {{load<Rays>(copy[0]), load<Rays>(copy[1]), load<Rays>(copy[2])}};
        out.direction = {{load<Rays>(copy[3]), load<Rays>(copy[4]), load<Rays>(copy[5])}};
        out.t_min = load<Rays>(copy[6]);
        out.t_max = load<Rays>(copy[7]);
    }
    out.exclude = RayInts{};
    if (from.excludes)
        for (int j = 0; j < LANES; ++j) out.exclude[j] = from.excludes[j < count ? j : count - 1];
    return out;
}

// Return the mask of invalid rays, which a query rejects (wrt.accel.queries.rays).
WRT_INLINE int refused(const SixteenRays& rays) {
    RayInts good = (greatest(rays.direction) > 0.0f) & (rays.t_min >= 0.0f) & (rays.t_max == rays.t_max);
    for (int k = 0; k < 3; ++k) good &= (absolute(rays.origin[k]) <= FARTHEST) & (absolute(rays.direction[k]) <= LARGEST);
    return mask_of(~good);
}

// Scale directions so that their reciprocals neither over- nor underflow, as query.py does; return the factors. A t_min of -0 becomes 0.
template <bool SCALED> WRT_INLINE Rays scale_rays(SixteenRays& rays) {
    const Rays one = all<Rays>(1.0f), largest = all<Rays>(LARGEST), length = greatest(rays.direction);
    Rays scale = one, inverse = one;
    if constexpr (SCALED) {
        scale = length > LONGEST ? all<Rays>(SHORTEN) : (length < SHORTEST ? all<Rays>(LENGTHEN) : one);
        inverse = length > LONGEST ? all<Rays>(1.0f / SHORTEN) : (length < SHORTEST ? all<Rays>(1.0f / LENGTHEN) : one);
        for (int k = 0; k < 3; ++k) rays.direction[k] = scale * rays.direction[k];
    }
    rays.t_min = rays.t_min * inverse + 0.0f;
    rays.t_max = (rays.t_max > largest ? largest : rays.t_max) * inverse;
    return scale;
}

// Return t of the best hit before the traversal, as no_hit in traverse/common.py. A ray that is not finite gets an empty segment.
template <int N> WRT_INLINE auto no_hit(const RayBlock<N>& rays) {
    typedef typename Lanes<N>::Floats Floats;
    const Floats zero_x = 0.0f * rays.origin[0] + 0.0f * rays.direction[0], zero_y = 0.0f * rays.origin[1] + 0.0f * rays.direction[1];
    const Floats zero_z = 0.0f * rays.origin[2] + 0.0f * rays.direction[2], largest = all<Floats>(LARGEST);
    const Floats t = zero_x + zero_y + zero_z == 0.0f ? rays.t_max : all<Floats>(-__builtin_inff());
    return t < largest ? t : largest;
}

template <class T, class Int> WRT_INLINE T component(const Vec3<T>& v, Int k) { return k == 0 ? v[0] : (k == 1 ? v[1] : v[2]); }

template <class Ray, class T> WRT_INLINE void store_vector(const Ray& ray, int first, const Vec3<T>& v) {
    for (int k = 0; k < 3; ++k) ray.put(first + LANES * k, v[k]);
}

// Store the rays' set-up for the triangle unit, as triangle_ray in units/triangle.py computes it.
template <int N, class T> WRT_INLINE void store_triangle_ray(const SomeRays<N>& packet, const Vec3<T>& o, const Vec3<T>& d) {
    typedef typename Lanes<N>::Ints Ints;
    const Ints zero = {}, one = all<Ints>(1), two = all<Ints>(2);
    const T size_x = absolute(d[0]), size_y = absolute(d[1]), size_z = absolute(d[2]);
    Ints kz = size_y > size_x ? one : zero;
    kz = size_z > (kz == 0 ? size_x : size_y) ? two : kz;
    const Ints next = kz == 2 ? zero : kz + 1, after = next == 2 ? zero : next + 1;
    const T d_z = component(d, kz);
    const Ints kx = d_z < 0.0f ? after : next, ky = d_z < 0.0f ? next : after;
    packet.put_bits(AXES, kx | ky << AXIS_BITS | kz << 2 * AXIS_BITS);
    store_vector(packet, TURNED_X, Vec3<T>{{component(o, kx), component(o, ky), component(o, kz)}});
    store_vector(packet, SHEAR_X, Vec3<T>{{component(d, kx) / d_z, component(d, ky) / d_z, 1.0f / d_z}});
}

// Store MARGIN (packet.h: sure_hits). It is infinite if a component of the direction is so small that the shear may underflow.
template <int N, class T> WRT_INLINE void store_margin(const SomeRays<N>& packet, const Vec3<T>& d) {
    const T least = SMALLEST_COMPONENT * greatest(d);
    auto steady = (d[0] == 0.0f) | (absolute(d[0]) > least);
    for (int k = 1; k < 3; ++k) steady &= (d[k] == 0.0f) | (absolute(d[k]) > least);
    packet.put(MARGIN, steady ? absolute(packet[TURNED_X + 2 * LANES]) + LEAST_MARGIN : all<T>(__builtin_inff()));
}

// Return the index of an axis's near planes in a node.
template <int N> WRT_INLINE auto near_row(typename Lanes<N>::Floats inv_dir, int lo, int hi) {
    typedef typename Lanes<N>::Ints Ints;
    return inv_dir < 0.0f ? all<Ints>(WIDTH * hi) : all<Ints>(WIDTH * lo);
}

// Store the fields of N rays that have no hit yet, except SCALE; return their reciprocal directions.
template <int N, bool ANY_HIT> WRT_INLINE auto store_rays(const SomeRays<N>& packet, const RayBlock<N>& rays, float far_pad) {
    typedef typename Lanes<N>::Floats Floats;
    typedef Vec3<Floats> Vector;
    const Vector &o = rays.origin, &d = rays.direction;
    const Vector i = {{1.0f / d[0], 1.0f / d[1], 1.0f / d[2]}};
    store_vector(packet, ORIGIN_X, o);
    store_vector(packet, DIRECTION_X, d);
    store_vector(packet, INVERSE_X, i);
    store_vector(packet, FAR_X, Vector{{far_pad * i[0], far_pad * i[1], far_pad * i[2]}});
    packet.put_bits(NEAR_X, near_row<N>(i[0], LO_X, HI_X));
    packet.put_bits(NEAR_Y, near_row<N>(i[1], LO_Y, HI_Y));
    packet.put_bits(NEAR_Z, near_row<N>(i[2], LO_Z, HI_Z));
    store_triangle_ray<N>(packet, o, d);
    if constexpr (ANY_HIT) store_margin<N>(packet, d);
    packet.put(T_MIN, rays.t_min);
    packet.put_bits(EXCLUDE, rays.exclude);
    packet.put(T, rays.t_max);
    packet.put(U, Floats{});
    packet.put(V, Floats{});
    packet.put_bits(PRIM_ID, all<typename Lanes<N>::Ints>(NO_HIT));
    return i;
}

// Return the minimum of each two neighbouring lanes: of a in the lower half of the result, of b in the upper half. Four layers of calls
// reduce sixteen vectors to one vector of their minima.
WRT_INLINE Rays lesser(Rays a, Rays b) {
    const Rays even = __builtin_shufflevector(a, b, 0, 2, 4, 6, 8, 10, 12, 14, 16, 18, 20, 22, 24, 26, 28, 30);
    const Rays odd = __builtin_shufflevector(a, b, 1, 3, 5, 7, 9, 11, 13, 15, 17, 19, 21, 23, 25, 27, 29, 31);
    return even < odd ? even : odd;
}

WRT_INLINE Rays lesser(Rays a, Rays b, Rays c, Rays d) { return lesser(lesser(a, b), lesser(c, d)); }

// Store the beam around all active rays of the packet (layout.py: BEAM_WORDS); return COHERENT. If their directions differ in sign along an
// axis, return MIXED (and store the beam only if `mixes`), or 0 without MAY_MIX. Return 0 if there are no active rays.
template <bool MAY_MIX>
WRT_INLINE int store_beam(float* packet, const SixteenRays& rays, const Vec3<Rays>& inv_dir, int active, float far_pad, bool mixes = false) {
    if (active == 0) return 0;
    int down[3], kind = COHERENT;
    bool mixed[3] = {};
    for (int k = 0; k < 3; ++k) {
        down[k] = mask_of(inv_dir[k] < 0.0f) & active;
        if (down[k] == 0 || down[k] == active) continue;
        if constexpr (!MAY_MIX) return 0;
        if (!mixes) return MIXED;
        mixed[k] = true;
        kind = MIXED;
    }
    // A lane without an active ray takes the values of an active one.
    const int some = lowest(active);
    const RayInts on = in_mask<RayInts>(active);
    Vec3<Rays> o, i;
    for (int k = 0; k < 3; ++k) {
        o[k] = on ? rays.origin[k] : all<Rays>(packet[ORIGIN_X + LANES * k + some]);
        i[k] = on ? inv_dir[k] : all<Rays>(packet[INVERSE_X + LANES * k + some]);
    }
    const Rays begin = on ? rays.t_min : all<Rays>(packet[T_MIN + some]);
    // A maximum is the minimum of the negated values.
    const Rays least = lesser(lesser(lesser(o[0], o[1], o[2], -o[0]), lesser(-o[1], -o[2], i[0], i[1])),
                              lesser(lesser(i[2], -i[0], -i[1], -i[2]), lesser(begin, begin, begin, begin)));
    // `ends` has the least and greatest origins, then the least and greatest reciprocals. On an axis with positive directions, `beam`
    // exchanges least and greatest. So `beam` has the order near_origin, far_origin, largest, smallest (layout.py).
    const Rays ends = __builtin_shufflevector(least, -least, 0, 1, 2, 19, 20, 21, 6, 7, 8, 25, 26, 27, 12, 13, 14, 15);
    const Rays other_ends = __builtin_shufflevector(ends, ends, 3, 4, 5, 0, 1, 2, 9, 10, 11, 6, 7, 8, 12, 13, 14, 15);
    const int x = down[0], y = down[1], z = down[2];
    const RayInts runs_down = {x, y, z, x, y, z, x, y, z, x, y, z};
    const Rays beam = runs_down != 0 ? ends : other_ends, far = far_pad * beam;
    for (int k = 0; k < 12; ++k) packet[BEAM_NEAR_ORIGIN + k] = beam[k];
    for (int k = 0; k < 6; ++k) packet[BEAM_FAR_LARGEST + k] = far[6 + k];
    for (int k = 0; k < 3; ++k) packet[BEAM_NEAR_ROW + k] = 2 * k + (down[k] != 0);
    packet[BEAM_T_MIN] = least[12];
    if constexpr (MAY_MIX)
        for (int k = 0; k < 3; ++k)
            for (int word = BEAM_NEAR_ORIGIN + k; mixed[k] && word < BEAM_NEAR_ROW; word += 3) packet[word] = __builtin_nanf("");
    return kind;
}

// Set up `count` rays; return the mask of rays whose segments are not empty, plus the result of store_beam. Only packets of any-hit rays may
// be MIXED.
template <bool SCALED, bool ANY_HIT>
WRT_CALLED int set_up(const RayPointers& from, int count, float far_pad, bool mixes, float* numbers) {
    SixteenRays rays = load_rays(from, count);
    const AllRays packet = {numbers};
    store(numbers + REFUSED, refused(rays));
    packet.put(SCALE, scale_rays<SCALED>(rays));
    rays.t_max = no_hit(rays);
    const Vec3<Rays> i = store_rays<LANES, ANY_HIT>(packet, rays, far_pad);
    const int active = mask_of(rays.t_max >= rays.t_min) & ((1 << count) - 1);
    return active | store_beam<ANY_HIT>(numbers, rays, i, active, far_pad, mixes);
}

}  // namespace wrt
