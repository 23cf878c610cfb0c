    float* const q = packet.data + (long long)base;
    #include "packet.h"
    const Rays far = __builtin_inff();
    const RayInts id = int_row(PRIM_ID), none = -1;
    const Rays scaled = row(T) * row(SCALE), at = id == NO_HIT ? far : scaled;
    const RayInts prim_id = id == NO_HIT ? none : id;
    if (count == LANES) {
        *(Rays*)(hits.t.data + first) = at;
        *(Rays*)(hits.u.data + first) = row(U);
        *(Rays*)(hits.v.data + first) = row(V);
        *(RayInts*)(hits.prim_id.data + first) = prim_id;
        return;
    }
    for (int j = 0; j < count; ++j) {
        hits.t.data[first + j] = at[j];
        hits.u.data[first + j] = q[U + j];
        hits.v.data[first + j] = q[V + j];
        hits.prim_id.data[first + j] = prim_id[j];
    }
