    // Sixteen rays at a time through rtcIntersect16 or rtcOccluded16 of Embree 4 (rtcore_ray.h, rtcore_common.h), which `function`
    // is the address of. Embree wants denormals flushed (its manual, "Performance Recommendations").
    struct alignas(64) RayHits {
        float org_x[16], org_y[16], org_z[16], tnear[16], dir_x[16], dir_y[16], dir_z[16], time[16], tfar[16];
        unsigned mask[16], id[16], flags[16];
        float ng_x[16], ng_y[16], ng_z[16], u[16], v[16];
        unsigned prim_id[16], geom_id[16], inst_id[16], inst_prim_id[16];
    } r;
    struct { unsigned flags, features; void *context, *filter, *intersect; float rest[4]; } arguments = {};
    arguments.flags = coherent ? 1u << 16 : 0u;
    arguments.features = 0xffffffffu;
    alignas(64) int valid[16];
    const auto call = (void (*)(const int*, void*, void*, void*))function;
    #if defined(__x86_64__)
    const unsigned before = __builtin_ia32_stmxcsr();
    __builtin_ia32_ldmxcsr(before | 0x8040);
    #endif
    const int n = (int)origins.shape[0];
    for (int first = 0; first < n; first += 16) {
        for (int k = 0; k < 16; ++k) {
            const int i = first + k < n ? first + k : n - 1;
            valid[k] = first + k < n ? -1 : 0;
            r.org_x[k] = origins.data[i][0]; r.org_y[k] = origins.data[i][1]; r.org_z[k] = origins.data[i][2];
            r.dir_x[k] = directions.data[i][0]; r.dir_y[k] = directions.data[i][1]; r.dir_z[k] = directions.data[i][2];
            r.tnear[k] = 0.0f; r.tfar[k] = hits.t.data[i]; r.time[k] = 0.0f;
            r.mask[k] = 0xffffffffu; r.id[k] = 0; r.flags[k] = 0;
            r.prim_id[k] = r.geom_id[k] = r.inst_id[k] = r.inst_prim_id[k] = 0xffffffffu;
        }
        call(valid, (void*)scene, &r, &arguments);
        for (int k = 0; k < 16 && first + k < n; ++k) {
            hits.t.data[first + k] = r.tfar[k];
            if (any_hit) continue;
            hits.u.data[first + k] = r.u[k]; hits.v.data[first + k] = r.v[k];
            hits.prim_id.data[first + k] = r.geom_id[k] == 0xffffffffu ? -1 : (int)r.prim_id[k];
        }
    }
    #if defined(__x86_64__)
    __builtin_ia32_ldmxcsr(before);
    #endif
