// Steps of a walk over instances: the upper level's nodes, whose boxes are widened, and the change to the space of a placed structure.
// The arithmetic is that of traverse/instances.py, vectorised.
#pragma once
#include "interleaved.h"
#include "set_up.h"

namespace wrt {

// --- nodes of the upper level -------------------------------------------------------------------------------------------------

// Return how far a node's boxes are widened on each side for a ray: by slack times the distance of the origin to the farthest corner of the
// box around all of them. The box and slack follow the references. `enter` widens each box by its own farthest corner, so at most as much.
template <class T> WRT_INLINE T widening(const float* node, const Vec3<T>& origin) {
    const float* const box = node + REFERENCES + WIDTH;
    T farthest = {};
    for (int k = 0; k < 6; ++k) {
        const T distance = absolute(box[k] - origin[k % 3]);
        farthest = distance > farthest ? distance : farthest;
    }
    return box[6] * farthest;
}

// The origins from which a ray meets the near and the far planes of boxes as it would meet those of wider boxes. Their rounding is at most
// u times the distance and a box's coordinates, which `enter` allows for.
template <class T> struct Origins {
    Vec3<T> near, far;
};

template <class T> WRT_INLINE Origins<T> shifted(const BoxRay<T>& ray, T widening) {
    Vec3<T> back, ahead;
    for (int k = 0; k < 3; ++k) {
        back[k] = ray.origin[k] - widening;
        ahead[k] = ray.origin[k] + widening;
    }
    return {near_planes(ray, ahead, back), near_planes(ray, back, ahead)};
}

// As `children`, for a node of the upper level: of a copy with wider boxes.
template <bool ANY_HIT>
WRT_CALLED int top_children(const float* nodes, float* packet, int node, int mask, unsigned* stack, int size) {
    const float* const from = nodes + (long long)node * NODE_SIZE;
    const float *const a = packet + BEAM_NEAR_ORIGIN, *const b = packet + BEAM_FAR_ORIGIN;
    const float one = widening(from, Vec3<float>{{a[0], a[1], a[2]}}), other = widening(from, Vec3<float>{{b[0], b[1], b[2]}});
    const float pad = one > other ? one : other;
    alignas(4 * CACHE_LINE) float planes[NODE_SIZE];
    for (int k = 0; k < 6; ++k) store(planes + WIDTH * k, load<Children>(from + WIDTH * k) + (k % 2 ? pad : -pad));
    store(planes + REFERENCES, load<Children>(from + REFERENCES));
    return children_at<ANY_HIT>(planes, nodes, nodes, packet, mask, stack, size);
}

// As `step`, for a node of the upper level.
template <bool ANY_HIT> WRT_INLINE int top_step(const float* nodes, float* packets, unsigned* stacks, int bottom, int* slot) {
    const int first = slot[SLOT_NEXT] * NODE_SIZE;
    const float* const node = nodes + (long long)first;
    const OneRay ray = {packets + slot[SLOT_RAY]};
    const BoxRay<float> box = {vector<float>(ray, ORIGIN_X), vector<float>(ray, INVERSE_X)};
    const Origins<float> from = shifted(box, widening(node, box.origin));
    return step_at<ANY_HIT>(nodes, node, first, from.near, from.far, packets, stacks, bottom, slot);
}

// As rays_meeting_root, for the root of a world.
WRT_CALLED int rays_meeting_top(const float* nodes, float* packet, int node, int mask) {
    const float* const root = nodes + (long long)node * NODE_SIZE;
    const PacketRay ray = packet_ray({packet});
    const BoxRay<Rays> box = {ray.origin, ray.inv_dir};
    const Origins<Rays> from = shifted(box, widening(root, ray.origin));
    return rays_meeting(root, ray, from.near, from.far, mask, packet);
}

// Store the root of each ray's world in the field ROOT; worlds: index of the packet's first ray's world, and of the next ray's with the given
// stride. Return the mask `active` (see set_up) without rays whose world does not exist. If the other rays are of different worlds, it also
// lacks COHERENT, and ROOT has the complements of the roots.
WRT_CALLED int store_roots(const int* worlds, int stride, const int* roots, int n_worlds, int count, int active, float* numbers) {
    RayInts root = all<RayInts>(-1);
    for (int j = 0; j < count; ++j)
        if (const int world = worlds[stride * j]; world >= 0 && world < n_worlds) root[j] = roots[world];
    active &= mask_of(root >= 0) | COHERENT;
    const int rays = active & ~COHERENT;
    if (rays == 0) return 0;
    const bool together = (rays & ~mask_of(root == root[lowest(rays)])) == 0;
    AllRays{numbers}.put_bits(ROOT, together ? root : ~root);
    return together ? active : rays;
}

// Return the rays of `mask` that see an instance (Units.filtered). filters: `exclude` of each ray of a packet, then `mask` of each.
WRT_CALLED int rays_seeing(const int* filters, int body, int groups, int mask) {
    int out = 0;
    for (int j = 0; j < LANES; ++j)
        out |= ((filters[j] == -1 || filters[j] != body) && (filters[LANES + j] & groups) != 0) << j;
    return out & mask;
}

// --- the space of a placed structure ------------------------------------------------------------------------------------------

// Return powers of two.
template <int N> WRT_INLINE typename Lanes<N>::Doubles power_of_two(typename Lanes<N>::Ints exponent) {
    typedef long long Longs __attribute__((vector_size(8 * N)));
    return __builtin_bit_cast(typename Lanes<N>::Doubles, __builtin_convertvector(exponent + 1023, Longs) << 52);
}

// Return the exponent of power_of_two in traverse/instances.py.
WRT_CALLED int exponent_near_one(double x) {
    int out = 0;
    for (int k = 0; k < 16 && (x > LONGEST || x < SHORTEST); ++k) {
        out += x > LONGEST ? -LENGTHEN_EXPONENT : LENGTHEN_EXPONENT;
        x *= x > LONGEST ? 1.0 / LENGTHEN : LENGTHEN;
    }
    return out;
}

constexpr double HALF_STEP = 0.5 * (double)__FLT_DENORM_MIN__;

// As last_local and first_local in traverse/instances.py.
WRT_CALLED float last_local(float t, double scale) {
    const float local = (float)((t + HALF_STEP) / scale);
    return local > 0.0f && (float)(local * scale) > t ? __builtin_bit_cast(float, __builtin_bit_cast(int, local) - 1) : local;
}

WRT_CALLED float first_local(float t, double scale) {
    const float near = (float)((t - HALF_STEP) / scale), local = near <= 0.0f ? 0.0f : near;
    return (float)(local * scale) < t ? __builtin_bit_cast(float, __builtin_bit_cast(int, local) + 1) : local;
}

// Return the affine map of N vectors (x, y, z, w). The sums have the order of wp.dot, and never are -0.
template <int N, class Placement>
WRT_INLINE auto to_local(const Placement& place, const Vec3<typename Lanes<N>::Doubles>& v, double w) {
    Vec3<typename Lanes<N>::Doubles> out;
    for (int k = 0; k < 3; ++k) {
        const auto& row = k == 0 ? place.local_x : (k == 1 ? place.local_y : place.local_z);
        out[k] = 0.0 + v[0] * row.c[0] + v[1] * row.c[1] + v[2] * row.c[2] + row.c[3] * w;
    }
    return out;
}

template <int N> struct PlacedRays {
    RayBlock<N> rays;
    Vec3<typename Lanes<N>::Floats> inv_dir;
};

// Set up N rays in the space of a placed structure, as local_ray does; `local` gets the fields of store_rays and, in SCALE, the exponents of
// local_scale.
template <int N, bool ANY_HIT, class Placement>
WRT_INLINE PlacedRays<N> place_rays(const SomeRays<N>& world, const Placement& place, float far_pad, const SomeRays<N>& local) {
    typedef typename Lanes<N>::Floats Floats;
    typedef typename Lanes<N>::Doubles Doubles;
    PlacedRays<N> out;
    const Vec3<Doubles> o = to_local<N>(place, wide<N>(vector<Floats>(world, ORIGIN_X)), 1.0);
    Vec3<Doubles> d = to_local<N>(place, wide<N>(vector<Floats>(world, DIRECTION_X)), 0.0);
    const Doubles x = d[0] < 0.0 ? -d[0] : d[0], y = d[1] < 0.0 ? -d[1] : d[1], z = d[2] < 0.0 ? -d[2] : d[2];
    const Doubles longer = y > x ? y : x, longest = z > longer ? z : longer;
    typename Lanes<N>::Ints exponent = {};
    Floats t_min = world[T_MIN], t_max = world[T];
    if (int left = mask_of((longest > (double)LONGEST) | (longest < (double)SHORTEST))) {
        for (int rest = left; rest; rest &= rest - 1) exponent[lowest(rest)] = exponent_near_one(longest[lowest(rest)]);
        const Doubles scale = power_of_two<N>(exponent);
        for (int k = 0; k < 3; ++k) d[k] = scale * d[k];
        for (; left; left &= left - 1) {
            const int i = lowest(left);
            t_min[i] = first_local(t_min[i], scale[i]);
            t_max[i] = last_local(t_max[i], scale[i]);
        }
    }
    for (int k = 0; k < 3; ++k) {
        out.rays.origin[k] = narrowed<N>(o[k]);
        out.rays.direction[k] = narrowed<N>(d[k]);
    }
    out.rays.t_min = t_min;
    out.rays.t_max = t_max;
    out.rays.exclude = world.bits(EXCLUDE) - place.first_prim;
    out.rays.t_max = no_hit(out.rays);
    local.put_bits(SCALE, exponent);
    out.inv_dir = store_rays<N, ANY_HIT>(local, out.rays, far_pad);
    return out;
}

// Set up the rays of a packet that are in `mask`; return as set_up.
template <bool ANY_HIT, class Placement>
WRT_CALLED int place_packet(float* world, const Placement& place, int mask, float far_pad, float* local) {
    const auto placed = place_rays<LANES, ANY_HIT>({world}, place, far_pad, {local});
    const int active = mask & mask_of(placed.rays.t_max >= placed.rays.t_min);
    return active | store_beam<false>(local, placed.rays, placed.inv_dir, active, far_pad);
}

// As place_packet, for one ray.
template <class Placement> WRT_CALLED void place_ray(float* world, const Placement& place, float far_pad, float* local) {
    place_rays<1, false>({world}, place, far_pad, {local});
}

// Store the hits of rays in a placed structure that are better than their best hits so far: closer or, at equal t, of a lower prim_id.
template <int N, bool ANY_HIT, class Placement>
WRT_INLINE void take_hits(const SomeRays<N>& world, const Placement& place, const SomeRays<N>& local) {
    typedef typename Lanes<N>::Floats Floats;
    const auto own = local.bits(PRIM_ID), id = own + place.first_prim;
    const Floats best = world[T], t = narrowed<N>(wide<N>(local[T]) * power_of_two<N>(local.bits(SCALE)));
    const auto better = ANY_HIT ? own != NO_HIT : (own != NO_HIT) & ((t < best) | ((t == best) & (id <= world.bits(PRIM_ID))));
    if (mask_of(better) == 0) return;
    world.put(T, better ? t : best);
    world.put_bits(PRIM_ID, better ? id : world.bits(PRIM_ID));
    if constexpr (!ANY_HIT) {
        world.put(U, better ? local[U] : world[U]);
        world.put(V, better ? local[V] : world[V]);
    }
}

}  // namespace wrt
