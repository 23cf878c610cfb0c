// The watertight triangle test: units/triangle.py vectorised, with the same names. Either for one ray and a row of triangles, or for the
// rays of a packet and one triangle.
#pragma once
#include "box.h"

namespace wrt {

// A row of N triangles: the first float of all records, then the second float of all records, and so on.
template <int N> struct Row {
    const float* numbers;
    typedef typename Lanes<N>::Floats Floats;
    typedef typename Lanes<N>::Ints Ints;
    WRT_MEMBER Floats component(int corner, int k) const { return load<Floats>(numbers + N * (3 * corner + k)); }
    WRT_MEMBER Vec3<Floats> corner(int i) const { return {{component(i, 0), component(i, 1), component(i, 2)}}; }
};

// A ray set up for the triangle test. `origin` is in the axis order kx, ky, kz.
template <class Int, class Number> struct TriangleRay {
    Int kx, ky, kz;
    Number shear_x, shear_y;
    Vec3<Number> origin;
};

// Return a corner in the space where the ray is the z axis.
template <class Triangles, class Int, class Number>
WRT_INLINE auto to_ray_space(const Triangles& triangles, int corner, const TriangleRay<Int, Number>& ray) {
    auto x = triangles.component(corner, ray.kx) - ray.origin[0];
    auto y = triangles.component(corner, ray.ky) - ray.origin[1];
    auto z = triangles.component(corner, ray.kz) - ray.origin[2];
    return Vec3<decltype(z)>{{x - ray.shear_x * z, y - ray.shear_y * z, z}};
}

template <class T> WRT_INLINE Vec3<T> edge_areas(const Vec3<T>& a, const Vec3<T>& b, const Vec3<T>& c) {
    return {{c[0] * b[1] - c[1] * b[0], a[0] * c[1] - a[1] * c[0], b[0] * a[1] - b[1] * a[0]}};
}

template <class T> WRT_INLINE auto outside(const Vec3<T>& areas) {
    const T zero = {};
    return ((areas[0] < zero) | (areas[1] < zero) | (areas[2] < zero))
           & ((areas[0] > zero) | (areas[1] > zero) | (areas[2] > zero));
}

// Return the lanes that the test in float32 does not reject.
template <class Triangles, class Int, class Number>
WRT_INLINE auto accepted(const Triangles& triangles, const TriangleRay<Int, Number>& ray) {
    return ~outside(edge_areas(to_ray_space(triangles, 0, ray), to_ray_space(triangles, 1, ray), to_ray_space(triangles, 2, ray)));
}

// Return the mask of a row's triangles that the test does not reject in float32.
template <int N, class LaneRay> WRT_INLINE int cull(const float* numbers, const LaneRay& ray) {
    const Row<N> row = {numbers};
    const TriangleRay<int, float> shear = {ray.kx, ray.ky, ray.kz, ray.shear_x, ray.shear_y,
                                           {{ray.origin[0], ray.origin[1], ray.origin[2]}}};
    return mask_of(accepted(row, shear));
}

template <int N> WRT_INLINE typename Lanes<N>::Doubles wide(typename Lanes<N>::Floats x) {
    return __builtin_convertvector(x, typename Lanes<N>::Doubles);
}

template <int N> WRT_INLINE typename Lanes<N>::Floats narrowed(typename Lanes<N>::Doubles x) {
    return __builtin_convertvector(x, typename Lanes<N>::Floats);
}

template <int N> WRT_INLINE Vec3<typename Lanes<N>::Doubles> wide(const Vec3<typename Lanes<N>::Floats>& v) {
    return {{wide<N>(v[0]), wide<N>(v[1]), wide<N>(v[2])}};
}

// Hits in the lanes of `mask`. u is areas[1] / area, and v is areas[2] / area.
template <int N> struct Hits {
    typename Lanes<N>::Floats t;
    Vec3<typename Lanes<N>::Doubles> areas;
    typename Lanes<N>::Doubles area;
    int mask;
};

// Intersect the z axis with triangles with these sheared corners, in float64, in the lanes of `mask`.
template <int N, class Floats>
WRT_INLINE Hits<N> crossing(const Vec3<Floats>& a, const Vec3<Floats>& b, const Vec3<Floats>& c, Floats shear_z, int mask) {
    typedef typename Lanes<N>::Doubles Doubles;
    const Doubles zero = {};
    Hits<N> hit;
    hit.areas = edge_areas(wide<N>(a), wide<N>(b), wide<N>(c));
    hit.area = hit.areas[0] + hit.areas[1] + hit.areas[2];
    hit.mask = mask & mask_of(~outside(hit.areas) & ((hit.area < zero) | (hit.area > zero)));
    if (hit.mask == 0) return hit;
    const Doubles z = hit.areas[0] * wide<N>(a[2]) + hit.areas[1] * wide<N>(b[2]) + hit.areas[2] * wide<N>(c[2]);
    hit.t = narrowed<N>(z / hit.area * wide<N>(shear_z));
    return hit;
}

// Return the mask of triangles on whose side the z axis passes an edge, if it is moved by an infinitesimal where it meets the edge.
// `areas` are those of this edge; `up` is the mask of triangles whose winding is positive.
template <class Doubles, class Floats>
WRT_INLINE int inside_edge(Doubles areas, const Vec3<Floats>& start, const Vec3<Floats>& end, int up) {
    const Doubles zero = {};
    const auto level = start[1] == end[1];
    const int above = mask_of((start[1] > end[1]) | (level & (end[0] > start[0])));
    const int below = mask_of((start[1] < end[1]) | (level & (end[0] < start[0])));
    return mask_of(areas != zero) | (up & above) | (~up & below);
}

// Return the hits that are crossings (units/triangle.py: is_crossed). All areas of a hit that are not 0 have one sign.
template <int N, class Triangles, class Int, class Number>
WRT_INLINE int crossed(const Triangles& triangles, const TriangleRay<Int, Number>& ray, const Hits<N>& hit) {
    const typename Lanes<N>::Doubles zero = {};
    const Vec3<typename Lanes<N>::Doubles>& areas = hit.areas;
    if ((hit.mask & mask_of((areas[0] == zero) | (areas[1] == zero) | (areas[2] == zero))) == 0) return hit.mask;
    const auto a = to_ray_space(triangles, 0, ray), b = to_ray_space(triangles, 1, ray), c = to_ray_space(triangles, 2, ray);
    const int up = mask_of(hit.area > zero);
    return hit.mask & inside_edge(areas[0], c, b, up) & inside_edge(areas[1], a, c, up) & inside_edge(areas[2], b, a, up);
}

template <class T> WRT_INLINE Vec3<T> lower(const Vec3<T>& a, const Vec3<T>& b) {
    return {{b[0] < a[0] ? b[0] : a[0], b[1] < a[1] ? b[1] : a[1], b[2] < a[2] ? b[2] : a[2]}};
}

template <class T> WRT_INLINE Vec3<T> upper(const Vec3<T>& a, const Vec3<T>& b) {
    return {{b[0] > a[0] ? b[0] : a[0], b[1] > a[1] ? b[1] : a[1], b[2] > a[2] ? b[2] : a[2]}};
}

// Return the pad of a box. `Bounds` has the constants of units/box.py and units/triangle.py.
template <class Bounds, class T> WRT_INLINE T box_pad(const Vec3<T>& lo, const Vec3<T>& hi) {
    const T e_x = hi[0] - lo[0], e_y = hi[1] - lo[1], e_z = hi[2] - lo[2];
    const T longer = e_x > e_y ? e_x : e_y;
    return Bounds::PAD_EXTENT * (e_z > longer ? e_z : longer) + Bounds::PAD_SMALLEST;
}

template <class Bounds, class Floats>
WRT_INLINE Interval<Floats> padded_interval(const BoxRay<Floats>& ray, const Vec3<Floats>& lo, const Vec3<Floats>& hi) {
    const Floats pad = box_pad<Bounds>(lo, hi);
    Vec3<Floats> padded_lo, padded_hi;
    for (int k = 0; k < 3; ++k) {
        padded_lo[k] = lo[k] - (pad + Bounds::PAD_COORDINATE * absolute(lo[k]));
        padded_hi[k] = hi[k] + (pad + Bounds::PAD_COORDINATE * absolute(hi[k]));
    }
    return slab_interval(ray, padded_lo, padded_hi);
}

template <class Floats> WRT_INLINE Floats clamped(Floats t, const Interval<Floats>& interval) {
    const Floats inside = t > interval.leave ? interval.leave : t;
    return inside < interval.enter ? interval.enter : inside;
}

// Return the mask of lanes where clamping moved t farther than rounding explains, on a ray whose shear may have underflowed.
template <class Bounds, class Floats>
WRT_INLINE int underflowed(const BoxRay<Floats>& ray, Floats t, Floats moved, int mask) {
    mask &= mask_of(absolute(moved - t) > Bounds::CLAMP_ROUNDING * absolute(t) + Bounds::CLAMP_STEP);
    if (mask == 0) return 0;
    const Floats inf = all<Floats>(__builtin_inff());
    Floats steep = inf, grazing = {};
    for (int axis = 0; axis < 3; ++axis) {
        const Floats inverse = absolute(ray.inv_dir[axis]);
        steep = inverse < steep ? inverse : steep;
        grazing = ((inverse > grazing) & (inverse < inf)) ? inverse : grazing;
    }
    const Floats least = Bounds::SLOWEST * grazing;
    return mask & mask_of((steep < least) | ((absolute(t) < least) & (absolute(moved) < least)));
}

// Clamp the t of hits to the slab intervals of their triangles' boxes or, if the ray misses a box, of the padded box. Remove hits whose ray
// misses even the padded box.
template <class Bounds, int N, class Floats>
WRT_INLINE void within_bounds(const BoxRay<Floats>& ray, Hits<N>& hit, const Vec3<Floats>& lo, const Vec3<Floats>& hi) {
    Interval<Floats> interval = slab_interval(ray, lo, hi);
    Floats moved = clamped(hit.t, interval);
    const int again = (mask_of(~(interval.enter <= interval.leave)) & hit.mask) | underflowed<Bounds>(ray, hit.t, moved, hit.mask);
    if (again) {
        interval = padded_interval<Bounds>(ray, lo, hi);
        hit.mask &= ~again | mask_of(interval.enter <= interval.leave * Bounds::FAR_PAD);
        moved = in_mask<typename Lanes<N>::Ints>(again) ? clamped(hit.t, interval) : moved;
    }
    hit.t = moved;
}

}  // namespace wrt
