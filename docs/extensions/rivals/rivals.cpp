// Embree's packets of sixteen rays, and tinybvh's trees for CPUs, behind functions for ctypes. rivals.py compiles this file.
#include <cmath>
#include <cstring>
#include <vector>

// RTCRayHit16 of Embree 4 (rtcore_ray.h).
struct alignas(64) RayHits {
    float org_x[16], org_y[16], org_z[16], tnear[16], dir_x[16], dir_y[16], dir_z[16], time[16], tfar[16];
    unsigned mask[16], id[16], flags[16];
    float ng_x[16], ng_y[16], ng_z[16], u[16], v[16];
    unsigned prim_id[16], geom_id[16], inst_id[16], inst_prim_id[16];
};

// Trace n rays by `function`, the address of rtcIntersect16 or, for any hit, of rtcOccluded16. On entry, t has the rays' t_max. For any
// hit, t becomes -inf for a ray that hits, and the other results stay. Embree wants denormals flushed to 0 (its manual, "Performance
// Recommendations").
extern "C" void embree_packets(void* function, void* scene, bool coherent, bool any_hit, int n, const float* origins,
                               const float* directions, float* t, float* u, float* v, int* prim_id) {
    RayHits r;
    struct { unsigned flags, features; void *context, *filter, *intersect; float rest[4]; } arguments = {};  // RTCIntersectArguments
    arguments.flags = coherent ? 1u << 16 : 0u;
    arguments.features = ~0u;
    alignas(64) int valid[16];
    const auto call = (void (*)(const int*, void*, void*, void*))function;
#if defined(__x86_64__)
    const unsigned before = __builtin_ia32_stmxcsr();
    __builtin_ia32_ldmxcsr(before | 0x8040);
#endif
    for (int first = 0; first < n; first += 16) {
        for (int k = 0; k < 16; ++k) {
            const int i = first + k < n ? first + k : n - 1;
            const float *o = origins + 3 * i, *d = directions + 3 * i;
            valid[k] = first + k < n ? -1 : 0;
            r.org_x[k] = o[0]; r.org_y[k] = o[1]; r.org_z[k] = o[2];
            r.dir_x[k] = d[0]; r.dir_y[k] = d[1]; r.dir_z[k] = d[2];
            r.tnear[k] = 0.0f; r.tfar[k] = t[i]; r.time[k] = 0.0f;
            r.mask[k] = ~0u; r.id[k] = 0; r.flags[k] = 0;
            r.prim_id[k] = r.geom_id[k] = r.inst_id[k] = r.inst_prim_id[k] = ~0u;
        }
        call(valid, scene, &r, &arguments);
        for (int k = 0; k < 16 && first + k < n; ++k) {
            t[first + k] = r.tfar[k];
            if (any_hit) continue;
            u[first + k] = r.u[k]; v[first + k] = r.v[k];
            prim_id[first + k] = r.geom_id[k] == ~0u ? -1 : (int)r.prim_id[k];
        }
    }
#if defined(__x86_64__)
    __builtin_ia32_ldmxcsr(before);
#endif
}

#if __has_include("tiny_bvh.h")
#define TINYBVH_IMPLEMENTATION
#include "tiny_bvh.h"

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
#endif
