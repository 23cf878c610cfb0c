// tinybvh's trees for CPUs behind functions for ctypes. wrt/lab/hard_cases/tinybvh.py compiles this file with tinybvh's header.
#define TINYBVH_IMPLEMENTATION
#include "tiny_bvh.h"
#include <vector>

using namespace tinybvh;

// A ray of tinybvh has a unit direction, so `scale` is the length of the caller's direction.
struct Rays { std::vector<Ray> rays; std::vector<float> scale; };

struct Tree {
    std::vector<bvhvec4> corners;
    BVH4_CPU four;
    BVH8_CPU eight;
    bool wide;
};

template <class T> static void trace(const T& tree, const Rays& rays, float* t, float* u, float* v, int* prim_id) {
    for (size_t i = 0; i < rays.rays.size(); ++i) {
        Ray ray = rays.rays[i];
        const float t_max = ray.hit.t;
        tree.Intersect(ray);
        const bool hit = ray.hit.t < t_max;
        t[i] = hit ? ray.hit.t / rays.scale[i] : INFINITY;
        u[i] = ray.hit.u; v[i] = ray.hit.v;
        prim_id[i] = hit ? (int)ray.hit.prim : -1;
    }
}

template <class T> static void test(const T& tree, const Rays& rays, bool* occluded) {
    for (size_t i = 0; i < rays.rays.size(); ++i) occluded[i] = tree.IsOccluded(rays.rays[i]);
}

extern "C" {

// Whether this processor's instructions suffice for trees of this width.
bool has_tree(int width) {
#if defined BVH_USEAVX2
    return width == 4 || width == 8;
#elif defined BVH_USESSE
    return width == 4;
#else
    return false;
#endif
}

// Build with spatial splits. corners: 3 x 4 floats a triangle.
Tree* make_tree(const float* corners, int triangles, int width) {
    Tree* tree = new Tree;
    tree->wide = width == 8;
    tree->corners.resize(3 * (size_t)triangles);
    memcpy(tree->corners.data(), corners, tree->corners.size() * sizeof(bvhvec4));
    if (tree->wide) tree->eight.BuildHQ(tree->corners.data(), triangles);
    else tree->four.BuildHQ(tree->corners.data(), triangles);
    return tree;
}

void free_tree(Tree* tree) { delete tree; }

Rays* make_rays(const float* origins, const float* directions, const float* t_max, int n) {
    Rays* out = new Rays;
    for (int i = 0; i < n; ++i) {
        const bvhvec3 o(origins[3 * i], origins[3 * i + 1], origins[3 * i + 2]);
        const bvhvec3 d(directions[3 * i], directions[3 * i + 1], directions[3 * i + 2]);
        out->scale.push_back(sqrtf(d.x * d.x + d.y * d.y + d.z * d.z));
        out->rays.push_back(Ray(o, d, t_max[i] < INFINITY ? t_max[i] * out->scale[i] : BVH_FAR));
    }
    return out;
}

void free_rays(Rays* rays) { delete rays; }

void closest(const Tree* tree, const Rays* rays, float* t, float* u, float* v, int* prim_id) {
    if (tree->wide) trace(tree->eight, *rays, t, u, v, prim_id);
    else trace(tree->four, *rays, t, u, v, prim_id);
}

void occluded(const Tree* tree, const Rays* rays, bool* out) {
    if (tree->wide) test(tree->eight, *rays, out);
    else test(tree->four, *rays, out);
}

}
