// Box tests: units/box.py vectorised, with the same names. Either for one ray and the boxes of a node's children, or for the rays of a
// packet and one box.
#pragma once
#include "lanes.h"

namespace wrt {

template <class T> struct BoxRay { Vec3<T> origin, inv_dir; };

template <class T> struct Interval { T enter, leave; };

// Narrow the interval t to the part of a line between the near and far planes of a box. A distance NaN (0 * inf) changes nothing, because
// it compares as false. far_inv_dir is inv_dir times a factor that covers the rounding of far distances. The ray has an origin for near
// planes and one for far planes: the same, but for instances.h.
template <class T, class Plane, class Number>
WRT_INLINE void narrow(Interval<T>& t, const Vec3<Plane>& near, const Vec3<Plane>& far, const Vec3<Number>& near_origin,
                       const Vec3<Number>& far_origin, const Vec3<Number>& inv_dir, const Vec3<Number>& far_inv_dir) {
    const T enter_x = (near[0] - near_origin[0]) * inv_dir[0];
    const T enter_y = (near[1] - near_origin[1]) * inv_dir[1];
    const T enter_z = (near[2] - near_origin[2]) * inv_dir[2];
    t.enter = enter_x > t.enter ? enter_x : t.enter;
    t.enter = enter_y > t.enter ? enter_y : t.enter;
    t.enter = enter_z > t.enter ? enter_z : t.enter;

    const T leave_x = (far[0] - far_origin[0]) * far_inv_dir[0];
    const T leave_y = (far[1] - far_origin[1]) * far_inv_dir[1];
    const T leave_z = (far[2] - far_origin[2]) * far_inv_dir[2];
    t.leave = leave_x < t.leave ? leave_x : t.leave;
    t.leave = leave_y < t.leave ? leave_y : t.leave;
    t.leave = leave_z < t.leave ? leave_z : t.leave;
}

// Return the planes of boxes that rays meet first, by the signs of the rays' directions. With lo and hi exchanged: the far planes.
template <class T> WRT_INLINE Vec3<T> near_planes(const BoxRay<T>& ray, const Vec3<T>& lo, const Vec3<T>& hi) {
    return {{ray.inv_dir[0] < 0.0f ? hi[0] : lo[0], ray.inv_dir[1] < 0.0f ? hi[1] : lo[1], ray.inv_dir[2] < 0.0f ? hi[2] : lo[2]}};
}

template <class T> WRT_INLINE Interval<T> slab_interval(const BoxRay<T>& ray, const Vec3<T>& lo, const Vec3<T>& hi) {
    Interval<T> t = {all<T>(-__builtin_inff()), all<T>(__builtin_inff())};
    narrow(t, near_planes(ray, lo, hi), near_planes(ray, hi, lo), ray.origin, ray.origin, ray.inv_dir, ray.inv_dir);
    return t;
}

// --- one ray and the children of a node --------------------------------------------------------------------------------------

// The part of a LaneRay (lanes.py) that the test of a node needs. `near` has, for each axis, the index of the plane that the ray meets
// first (layout.py: PLANES).
struct NodeRay {
    Vec3<float> origin, inv_dir, far_inv_dir;
    int near[3];
    float t_min;
};

template <class LaneRay> WRT_INLINE NodeRay node_ray(const LaneRay& ray) {
    const auto &o = ray.box.origin, &i = ray.box.inv_dir, &f = ray.far_inv_dir;
    return {{{o[0], o[1], o[2]}}, {{i[0], i[1], i[2]}}, {{f[0], f[1], f[2]}}, {ray.near_x, ray.near_y, ray.near_z}, ray.box.t_min};
}

// A node with N children, in the layout that nodes.py describes. `Layout` has the constants.
template <int N, class Layout> struct Node {
    typedef typename Lanes<N>::Floats Row;
    const float* numbers;

    WRT_MEMBER unsigned word() const { return load<unsigned>(numbers + Layout::WORD); }

    // Return plane `k` of all children; `axis` is its axis.
    WRT_MEMBER Row plane(int k, int axis) const {
        if constexpr (Layout::COMPRESSED) {
            typedef unsigned char Bytes __attribute__((vector_size(N)));
            const Bytes bytes = load<Bytes>((const unsigned char*)(numbers + Layout::FIRST_BYTES) + N * k);
            const unsigned exponent = word() >> Layout::EXPONENT_BITS * axis & ((1u << Layout::EXPONENT_BITS) - 1);
            const float size = __builtin_bit_cast(float, exponent << Layout::MANTISSA_BITS);
            return numbers[axis] + __builtin_convertvector(bytes, Row) * size;
        } else {
            return load<Row>(numbers + N * k);
        }
    }

    WRT_MEMBER int exist() const { return Layout::COMPRESSED ? (int)(word() >> Layout::EXIST_SHIFT) : (1 << N) - 1; }

    WRT_MEMBER Interval<Row> interval(const NodeRay& ray, float t_max) const {
        Interval<Row> t = {all<Row>(ray.t_min), all<Row>(t_max)};
        const Vec3<Row> near = {{plane(ray.near[0], 0), plane(ray.near[1], 1), plane(ray.near[2], 2)}};
        const Vec3<Row> far = {{plane(ray.near[0] ^ 1, 0), plane(ray.near[1] ^ 1, 1), plane(ray.near[2] ^ 1, 2)}};
        narrow(t, near, far, ray.origin, ray.origin, ray.inv_dir, ray.far_inv_dir);
        return t;
    }

    // Return the mask of the children that the ray enters.
    WRT_MEMBER int entered(const NodeRay& ray, float t_max) const {
        const Interval<Row> t = interval(ray, t_max);
        return mask_of(t.enter <= t.leave) & exist();
    }

    // Return the ray's entry distances of all children.
    WRT_MEMBER Row entries(const NodeRay& ray) const { return interval(ray, 0.0f).enter; }
};

}  // namespace wrt
