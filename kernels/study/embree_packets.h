// Calls of Embree's functions for packets of sixteen rays.
#pragma once
#include "layout.h"

namespace wrt {

// RTCRayHit16 of Embree 4 (rtcore_ray.h).
struct alignas(ALIGNMENT) RayHits {
    float org_x[LANES], org_y[LANES], org_z[LANES], tnear[LANES], dir_x[LANES], dir_y[LANES], dir_z[LANES], time[LANES], tfar[LANES];
    unsigned mask[LANES], id[LANES], flags[LANES];
    float ng_x[LANES], ng_y[LANES], ng_z[LANES], u[LANES], v[LANES];
    unsigned prim_id[LANES], geom_id[LANES], inst_id[LANES], inst_prim_id[LANES];
};

// Trace all rays by `function`, the address of rtcIntersect16 or, for any hit, of rtcOccluded16. On entry, hits.t has the rays' t_max.
// Embree wants denormals flushed to 0 (its manual, "Performance Recommendations").
template <class Vectors, class HitArrays>
inline void trace_packets(unsigned long long function, unsigned long long scene, bool coherent, bool any_hit, const Vectors& origins,
                          const Vectors& directions, const HitArrays& hits) {
    RayHits r;
    struct { unsigned flags, features; void *context, *filter, *intersect; float rest[4]; } arguments = {};  // RTCIntersectArguments
    arguments.flags = coherent ? COHERENT : 0u;
    arguments.features = NONE;
    alignas(ALIGNMENT) int valid[LANES];
    const auto call = (void (*)(const int*, void*, void*, void*))function;
#if defined(__x86_64__)
    const unsigned before = __builtin_ia32_stmxcsr();
    __builtin_ia32_ldmxcsr(before | FLUSH);
#endif
    const int n = (int)origins.shape[0];
    for (int first = 0; first < n; first += LANES) {
        for (int k = 0; k < LANES; ++k) {
            const int i = first + k < n ? first + k : n - 1;
            valid[k] = first + k < n ? -1 : 0;
            r.org_x[k] = origins.data[i][0]; r.org_y[k] = origins.data[i][1]; r.org_z[k] = origins.data[i][2];
            r.dir_x[k] = directions.data[i][0]; r.dir_y[k] = directions.data[i][1]; r.dir_z[k] = directions.data[i][2];
            r.tnear[k] = 0.0f; r.tfar[k] = hits.t.data[i]; r.time[k] = 0.0f;
            r.mask[k] = NONE; r.id[k] = 0; r.flags[k] = 0;
            r.prim_id[k] = r.geom_id[k] = r.inst_id[k] = r.inst_prim_id[k] = NONE;
        }
        call(valid, (void*)scene, &r, &arguments);
        for (int k = 0; k < LANES && first + k < n; ++k) {
            hits.t.data[first + k] = r.tfar[k];
            if (any_hit) continue;
            hits.u.data[first + k] = r.u[k]; hits.v.data[first + k] = r.v[k];
            hits.prim_id.data[first + k] = r.geom_id[k] == NONE ? -1 : (int)r.prim_id[k];
        }
    }
#if defined(__x86_64__)
    __builtin_ia32_ldmxcsr(before);
#endif
}

}  // namespace wrt
