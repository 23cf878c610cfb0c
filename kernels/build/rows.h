// Rows of triangles for vector instructions, gathered from a mesh.
#pragma once

namespace wrt {

constexpr int FACES_AHEAD = 32, CORNERS_AHEAD = 12;  // primitives between a prefetch and the use of its cache line
constexpr double DOUBT = 1.0 / (1ll << 50);  // as in shape.py

// Write a row of W primitives with corners: lane i holds order[begin + i], and lanes from `count` on repeat the last primitive. Return false
// if a primitive is no face, or may have no area: the caller then writes the row anew.
template <int W, class Shape, class Order>
inline bool store_triangles(const Shape& shape, const Order& order, int begin, int count, float* out) {
    float row[10][W];
    const int* id = order.data + begin;
    const int left = order.shape[0] - begin - count, faces = shape.faces.shape[0];
    const int far = left < FACES_AHEAD ? left : FACES_AHEAD, near = left < CORNERS_AHEAD ? left : CORNERS_AHEAD;
    bool whole = true;
    for (int lane = 0; lane < count; ++lane) {
        __builtin_prefetch(shape.faces.data + id[lane + far]);
        const int next = id[lane + near], own = id[lane];
        const auto& ahead = shape.faces.data[next < faces ? next : 0];
        for (int k = 0; k < 3; ++k) __builtin_prefetch(shape.vertices.data + ahead[k]);
        whole &= own < faces;
        const auto& corner = shape.faces.data[own < faces ? own : 0];
        for (int k = 0; k < 3; ++k)
            for (int axis = 0; axis < 3; ++axis) row[3 * k + axis][lane] = shape.vertices.data[corner[k]][axis];
        memcpy(&row[9][lane], &own, sizeof own);
    }
    for (int lane = count; lane < W; ++lane)
        for (int k = 0; k < 10; ++k) row[k][lane] = row[k][count - 1];
    int doubts = 0;
    for (int lane = 0; lane < W; ++lane) {
        bool flat = true;
        for (int i = 0, j = 1; i < 3; ++i, j = (i + 1) % 3) {  // `surely_across` of shape.py
            const double p = row[i][lane], q = row[j][lane];
            const double a = (row[3 + i][lane] - p) * (row[6 + j][lane] - q), b = (row[3 + j][lane] - q) * (row[6 + i][lane] - p);
            flat &= __builtin_fabs(a - b) <= DOUBT * (__builtin_fabs(a) + __builtin_fabs(b));
        }
        doubts += flat;
    }
    memcpy(out, row, sizeof row);
    return whole && !doubts;
}

}  // namespace wrt
