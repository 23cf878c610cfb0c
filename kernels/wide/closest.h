// Closest points: the functions of closest_points.py that are vectorised. They compute bounds in float32, and no results.
#pragma once
#include "triangle.h"

namespace wrt {

// Return a number not above the squared distance from any point within `blur` of p, along each axis, to each of the boxes lo .. hi. Rounding
// is covered by a factor and, where squares underflow, by a bound of 0. A plane NaN bounds nothing.
template <class T> WRT_INLINE T squared_bounds(const Vec3<T>& lo, const Vec3<T>& hi, const Vec3<float>& p, T blur) {
    const float below = 1.0f - 1.0f / (1 << 20), tiny = 1e-36f, largest = __FLT_MAX__;
    T out = {};
    for (int axis = 0; axis < 3; ++axis) {
        const T ahead = lo[axis] - p[axis], behind = p[axis] - hi[axis];
        const T apart = (ahead > behind ? ahead : behind) - blur;
        const T distance = apart > 0.0f ? apart : T{};
        out = out + distance * distance;
    }
    out = out > tiny ? below * out : T{};
    return out < largest ? out : all<T>(largest);
}

// Return squared_bounds of the boxes of a node's children.
template <class T, class Node> WRT_INLINE T child_bounds(const Node& node, const Vec3<float>& p, float blur) {
    const Vec3<T> lo = {{node.plane(0, 0), node.plane(2, 1), node.plane(4, 2)}}, hi = {{node.plane(1, 0), node.plane(3, 1), node.plane(5, 2)}};
    return squared_bounds(lo, hi, p, all<T>(blur));
}

// Return the mask of the triangles of a row whose padded boxes may be within the squared distance `reach`, and of those without area.
template <int N> WRT_INLINE int near_triangles(const float* numbers, const Vec3<float>& p, float blur, float reach) {
    typedef typename Lanes<N>::Floats T;
    const Row<N> row = {numbers};
    const Vec3<T> a = row.corner(0), b = row.corner(1), c = row.corner(2);
    Vec3<T> lo, hi;
    T largest = {};
    for (int axis = 0; axis < 3; ++axis) {
        const T less = a[axis] < b[axis] ? a[axis] : b[axis], more = a[axis] < b[axis] ? b[axis] : a[axis];
        lo[axis] = less < c[axis] ? less : c[axis];
        hi[axis] = more > c[axis] ? more : c[axis];
        const T size = -lo[axis] > hi[axis] ? -lo[axis] : hi[axis];
        largest = size > largest ? size : largest;
    }
    const T pad = blur + 1.0f / (1 << 19) * largest + 1e-30f;  // more than units/box.py adds: box_pad, padded_lo and padded_hi
    return mask_of((squared_bounds(lo, hi, p, pad) <= reach) | (a[0] != a[0]));
}

}  // namespace wrt
