"""Packets: sixteen rays side by side, for one CPU thread that has many rays to trace.

A packet is a block of floats: a row of sixteen lanes for each number that a ray has (ROWS), then a few words that it has as a
whole: the beam, an interval of origins and of reciprocals around its rays. The vector code is the compiler's own extension, no
instruction set by name, and runs on every CPU; nothing of it is meant for CUDA. It computes what the scalar units compute, to
the last bit: they are its twins, and tests hold the two together.
"""

import warp as wp

from wrt.kernels.query import HitArrays, RayArrays
from wrt.kernels.units.box import FAR_PAD
from wrt.kernels.units.triangle import HELD_ROUNDING
from wrt.kernels.wide.traverse import STACK_SIZE

LANES = 16
ROWS = ("origin_x", "origin_y", "origin_z", "inverse_x", "inverse_y", "inverse_z", "far_x", "far_y", "far_z", "t_min", "t",
        "direction_x", "direction_y", "direction_z", "turned_x", "turned_y", "turned_z", "shear_x", "shear_y", "shear_z",
        "axes", "u", "v", "prim_id", "scale", "near_x", "near_y", "near_z")
ROW = {name: LANES * i for i, name in enumerate(ROWS)}  # where each row begins
BEAM = LANES * len(ROWS)  # words of the beam: see SET_UP
ENTRY = BEAM + 24  # what `children` leaves: 8 distances at which the beam enters the children
MET = ENTRY + 8  # and 8 masks (int32) of the rays that meet each
FIRST = MET + 16  # what `meets` leaves: for each child a row of the distances at which the rays enter it, inf where they do not
PACKET_SIZE = FIRST + 8 * LANES  # a multiple of 16: where the first row begins at a cache line, all rows do
# A ray's stack, of words: for each node that it is in, the keys of the children that are still to come, from the near to the far,
# an end, where their references begin, and where the level below goes on. Every level but the top one keeps an entry of the walk
# for one ray; under them is the bottom.
LEVEL = 16
STACK_WORDS = LEVEL * (STACK_SIZE + 2)
TO_POP = 256  # in a slot's word 3

# Rows by name, with the numbers of the table above.
HEAD = f"""
    typedef float F __attribute__((ext_vector_type(16), aligned(4)));
    typedef int I __attribute__((ext_vector_type(16), aligned(4)));
    typedef bool B __attribute__((ext_vector_type(16)));
    typedef float G __attribute__((ext_vector_type(8), aligned(4)));
    typedef bool C __attribute__((ext_vector_type(8)));
    enum {{ {", ".join(f"{name.upper()} = {first}" for name, first in ROW.items())},
           BEAM = {BEAM}, ENTRY = {ENTRY}, MET = {MET}, FIRST = {FIRST} }};
    #define LANE_MASK(x) (int)__builtin_bit_cast(unsigned short, __builtin_convertvector((x), B))
    #define CHILD_MASK(x) (int)__builtin_bit_cast(unsigned char, __builtin_convertvector((x), C))
    const I lane = {{0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15}};
"""
END = """
    #undef LANE_MASK
    #undef CHILD_MASK
"""

# The words of a beam: 0 near and 3 far origins, 6 reciprocals of the largest magnitude and 9 of the smallest, 12 and 15 the same
# for far planes, 18 near rows of nodes (as numbers), 21 the lowest t_min.
SET_UP = """
    F ox, oy, oz, dx, dy, dz, t_min, t_max;
    if (count == 16) {
        const float *a = (const float*)(rays.origin.data + first), *b = (const float*)(rays.direction.data + first);
        #define TWO(v, k) __builtin_shufflevector(*(const F*)v, *(const F*)(v + 16), \\
            k, k + 3, k + 6, k + 9, k + 12, k + 15, k + 18, k + 21, k + 24, k + 27, k < 2 ? k + 30 : 0, 0, 0, 0, 0, 0)
        #define X(v) __builtin_shufflevector(TWO(v, 0), *(const F*)(v + 32), 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 17, 20, 23, 26, 29)
        #define Y(v) __builtin_shufflevector(TWO(v, 1), *(const F*)(v + 32), 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 18, 21, 24, 27, 30)
        #define Z(v) __builtin_shufflevector(TWO(v, 2), *(const F*)(v + 32), 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 16, 19, 22, 25, 28, 31)
        ox = X(a); oy = Y(a); oz = Z(a); dx = X(b); dy = Y(b); dz = Z(b);
        #undef TWO
        #undef X
        #undef Y
        #undef Z
        t_min = *(const F*)(rays.t_min.data + first);
        t_max = *(const F*)(rays.t_max.data + first);
    } else {
        float copy[8][16];
        for (int j = 0; j < 16; ++j) {
            const long long i = first + (j < count ? j : count - 1);
            for (int k = 0; k < 3; ++k) {
                copy[k][j] = rays.origin.data[i][k];
                copy[3 + k][j] = rays.direction.data[i][k];
            }
            copy[6][j] = rays.t_min.data[i];
            copy[7][j] = rays.t_max.data[i];
        }
        ox = *(F*)copy[0]; oy = *(F*)copy[1]; oz = *(F*)copy[2]; dx = *(F*)copy[3]; dy = *(F*)copy[4]; dz = *(F*)copy[5];
        t_min = *(F*)copy[6]; t_max = *(F*)copy[7];
    }
    // kernels.query.load_ray
    const F one = 1.0f, nothing = -__builtin_inff(), largest = 3.4028234663852886e38f;
    F ax = __builtin_elementwise_abs(dx), ay = __builtin_elementwise_abs(dy), az = __builtin_elementwise_abs(dz);
    F longest = ay > ax ? ay : ax;
    longest = az > longest ? az : longest;
    const F up = 0x1p96f, up_inverse = 0x1p-96f, down = 0x1p-64f, down_inverse = 0x1p64f;
    const F by = longest > 0x1p64f ? down : (longest < 0x1p-64f ? up : one);
    const F inverse = longest > 0x1p64f ? down_inverse : (longest < 0x1p-64f ? up_inverse : one);
    dx = by * dx; dy = by * dy; dz = by * dz;
    t_min = t_min * inverse + 0.0f;
    t_max = (t_max > largest ? largest : t_max) * inverse;
    // kernels.traverse.no_hit
    const F zero_x = 0.0f * ox + 0.0f * dx, zero_y = 0.0f * oy + 0.0f * dy, zero_z = 0.0f * oz + 0.0f * dz;
    t_max = zero_x + zero_y + zero_z == 0.0f ? t_max : nothing;
    t_max = t_max < largest ? t_max : largest;
    const F ix = one / dx, iy = one / dy, iz = one / dz;
    row(ORIGIN_X) = ox; row(ORIGIN_Y) = oy; row(ORIGIN_Z) = oz;
    row(INVERSE_X) = ix; row(INVERSE_Y) = iy; row(INVERSE_Z) = iz;
    row(FAR_X) = pad * ix; row(FAR_Y) = pad * iy; row(FAR_Z) = pad * iz;
    row(DIRECTION_X) = dx; row(DIRECTION_Y) = dy; row(DIRECTION_Z) = dz;
    row(T_MIN) = t_min; row(T) = t_max; row(SCALE) = by;
    // kernels.ray_triangle.triangle_ray
    ax = __builtin_elementwise_abs(dx); ay = __builtin_elementwise_abs(dy); az = __builtin_elementwise_abs(dz);
    const I axis_0 = 0, axis_1 = 1, axis_2 = 2;
    I kz = ay > ax ? axis_1 : axis_0;
    const F longer = kz == 0 ? ax : ay;
    kz = az > longer ? axis_2 : kz;
    I kx = kz == 2 ? axis_0 : kz + 1, ky = kx == 2 ? axis_0 : kx + 1;
    #define COMPONENT(v, k) ((k) == 0 ? v##x : ((k) == 1 ? v##y : v##z))
    const F d_z = COMPONENT(d, kz);
    const I k = kx;
    kx = d_z < 0.0f ? ky : kx;
    ky = d_z < 0.0f ? k : ky;
    row(TURNED_X) = COMPONENT(o, kx); row(TURNED_Y) = COMPONENT(o, ky); row(TURNED_Z) = COMPONENT(o, kz);
    row(SHEAR_X) = COMPONENT(d, kx) / d_z; row(SHEAR_Y) = COMPONENT(d, ky) / d_z; row(SHEAR_Z) = one / d_z;
    #undef COMPONENT
    *(I*)(q + AXES) = kx | ky << 2 | kz << 4;
    row(U) = 0.0f; row(V) = 0.0f;
    *(I*)(q + PRIM_ID) = 0x7FFFFFFF;
    const I at_0 = 0, at_8 = 8, at_16 = 16, at_24 = 24, at_32 = 32, at_40 = 40;
    *(I*)(q + NEAR_X) = ix < 0.0f ? at_8 : at_0;
    *(I*)(q + NEAR_Y) = iy < 0.0f ? at_24 : at_16;
    *(I*)(q + NEAR_Z) = iz < 0.0f ? at_40 : at_32;

    const int active = LANE_MASK(t_max >= t_min) & ((1 << count) - 1);
    const int nx = LANE_MASK(ix < 0.0f) & active, ny = LANE_MASK(iy < 0.0f) & active, nz = LANE_MASK(iz < 0.0f) & active;
    if (active == 0 || (nx && nx != active) || (ny && ny != active) || (nz && nz != active)) return active;
    // The beam: lanes without a ray take part as one that has one.
    const int some = __builtin_ctz(active);
    const I on = ((active >> lane) & 1) != 0;
    typedef float H __attribute__((ext_vector_type(4)));
    auto lowest = [](F x) {
        const G a = x.lo < x.hi ? x.lo : x.hi;
        const H b = a.lo < a.hi ? a.lo : a.hi;
        const float c = b[0] < b[1] ? b[0] : b[1], d = b[2] < b[3] ? b[2] : b[3];
        return c < d ? c : d;
    };
    auto highest = [](F x) {
        const G a = x.lo > x.hi ? x.lo : x.hi;
        const H b = a.lo > a.hi ? a.lo : a.hi;
        const float c = b[0] > b[1] ? b[0] : b[1], d = b[2] > b[3] ? b[2] : b[3];
        return c > d ? c : d;
    };
    const int negative[3] = {nx != 0, ny != 0, nz != 0};
    float* beam = q + BEAM;
    for (int k = 0; k < 3; ++k) {
        const F o_some = q[ORIGIN_X + 16 * k + some], i_some = q[INVERSE_X + 16 * k + some];
        const F o = on ? row(ORIGIN_X + 16 * k) : o_some, i = on ? row(INVERSE_X + 16 * k) : i_some;
        const float o_lo = lowest(o), o_hi = highest(o), i_lo = lowest(i), i_hi = highest(i);
        beam[k] = negative[k] ? o_lo : o_hi;
        beam[3 + k] = negative[k] ? o_hi : o_lo;
        beam[6 + k] = negative[k] ? i_lo : i_hi;
        beam[9 + k] = negative[k] ? i_hi : i_lo;
        beam[12 + k] = pad * beam[6 + k];
        beam[15 + k] = pad * beam[9 + k];
        beam[18 + k] = (float)(2 * k + negative[k]);
    }
    const F t_some = q[T_MIN + some];
    beam[21] = lowest(on ? t_min : t_some);
    return active | 1 << 16;
"""

# Bounds of the products of intervals: the extreme origin times both reciprocals, where the one that may be infinite comes first,
# so that 0 * inf = NaN says nothing.
CHILDREN = """
    const float *p = nodes.data + (long long)first, *beam = q + BEAM;
    #define PLANES(k) (*(const G*)(p + 8 * (k)))
    const int near[3] = {(int)beam[18], (int)beam[19], (int)beam[20]};
    G enter = (G)(beam[21]), leave = (G)(3.4028234663852886e38f);
    for (int k = 0; k < 3; ++k) {
        const G n = PLANES(near[k]) - beam[k], a = n * beam[6 + k], b = n * beam[9 + k], least = b < a ? b : a;
        enter = least > enter ? least : enter;
        const G f = PLANES(near[k] ^ 1) - beam[3 + k], c = f * beam[12 + k], d = f * beam[15 + k], most = d > c ? d : c;
        leave = most < leave ? most : leave;
    }
    *(G*)(q + ENTRY) = enter;
    int maybe = CHILD_MASK(enter <= leave), out = 0;
    const F t_min = row(T_MIN), t_max = row(T), ox = row(ORIGIN_X), oy = row(ORIGIN_Y), oz = row(ORIGIN_Z), ix = row(INVERSE_X);
    const F iy = row(INVERSE_Y), iz = row(INVERSE_Z), fx = row(FAR_X), fy = row(FAR_Y), fz = row(FAR_Z);
    const float *x = p + 8 * near[0], *y = p + 8 * near[1], *z = p + 8 * near[2];
    const float *x_far = p + 8 * (near[0] ^ 1), *y_far = p + 8 * (near[1] ^ 1), *z_far = p + 8 * (near[2] ^ 1);
    while (maybe) {
        const int c = __builtin_ctz(maybe);
        maybe &= maybe - 1;
        F e = t_min, l = t_max, f;
        f = (x[c] - ox) * ix; e = f > e ? f : e;
        f = (y[c] - oy) * iy; e = f > e ? f : e;
        f = (z[c] - oz) * iz; e = f > e ? f : e;
        f = (x_far[c] - ox) * fx; l = f < l ? f : l;
        f = (y_far[c] - oy) * fy; l = f < l ? f : l;
        f = (z_far[c] - oz) * fz; l = f < l ? f : l;
        const int m = LANE_MASK(e <= l) & mask;
        ((int*)(q + MET))[c] = m;
        out |= (m != 0) << c;
    }
    #undef PLANES
    return out;
"""

MEETS = """
    const float* p = nodes.data + (long long)first;
    const F t_min = row(T_MIN), t_max = row(T), ox = row(ORIGIN_X), oy = row(ORIGIN_Y), oz = row(ORIGIN_Z), ix = row(INVERSE_X);
    const F iy = row(INVERSE_Y), iz = row(INVERSE_Z), fx = row(FAR_X), fy = row(FAR_Y), fz = row(FAR_Z), never = __builtin_inff();
    int out = 0;
    for (int c = 0; c < 8; ++c) {
        const F lo_x = p[c], hi_x = p[8 + c], lo_y = p[16 + c], hi_y = p[24 + c], lo_z = p[32 + c], hi_z = p[40 + c];
        F e = t_min, l = t_max, f;
        f = ((ix < 0.0f ? hi_x : lo_x) - ox) * ix; e = f > e ? f : e;
        f = ((iy < 0.0f ? hi_y : lo_y) - oy) * iy; e = f > e ? f : e;
        f = ((iz < 0.0f ? hi_z : lo_z) - oz) * iz; e = f > e ? f : e;
        f = ((ix < 0.0f ? lo_x : hi_x) - ox) * fx; l = f < l ? f : l;
        f = ((iy < 0.0f ? lo_y : hi_y) - oy) * fy; l = f < l ? f : l;
        f = ((iz < 0.0f ? lo_z : hi_z) - oz) * fz; l = f < l ? f : l;
        row(FIRST + 16 * c) = e <= l ? e : never;
        out |= LANE_MASK(e <= l);
    }
    return out & mask;
"""

REACHING = "return LANE_MASK(row(T) >= t_entry);"

# kernels.ray_triangle.ray_triangle and kernels.traverse.intersect
TRIANGLES = """
    typedef double D __attribute__((ext_vector_type(16), aligned(8)));
    #define WIDE(x) __builtin_convertvector(x, D)
    #define NARROW(x) __builtin_convertvector(x, F)
    #define COMPONENT(v, k) ((k) == 0 ? (F)(v[0]) : ((k) == 1 ? (F)(v[1]) : (F)(v[2])))
    const float* p = rows.data + (long long)first;
    const I axis = *(const I*)(q + AXES), kx = axis & 3, ky = axis >> 2 & 3, kz = axis >> 4;
    const F o_x = row(TURNED_X), o_y = row(TURNED_Y), o_z = row(TURNED_Z), s_x = row(SHEAR_X), s_y = row(SHEAR_Y);
    const F inf = __builtin_inff();
    int found = 0;
    for (int j = 0; j < count; ++j) {
        const float v0[3] = {p[j], p[8 + j], p[16 + j]}, v1[3] = {p[24 + j], p[32 + j], p[40 + j]};
        const float v2[3] = {p[48 + j], p[56 + j], p[64 + j]};
        const F a_z = COMPONENT(v0, kz) - o_z, b_z = COMPONENT(v1, kz) - o_z, c_z = COMPONENT(v2, kz) - o_z;
        const F a_x = (COMPONENT(v0, kx) - o_x) - s_x * a_z, a_y = (COMPONENT(v0, ky) - o_y) - s_y * a_z;
        const F b_x = (COMPONENT(v1, kx) - o_x) - s_x * b_z, b_y = (COMPONENT(v1, ky) - o_y) - s_y * b_z;
        const F c_x = (COMPONENT(v2, kx) - o_x) - s_x * c_z, c_y = (COMPONENT(v2, ky) - o_y) - s_y * c_z;
        const F area_0 = c_x * b_y - c_y * b_x, area_1 = a_x * c_y - a_y * c_x, area_2 = b_x * a_y - b_y * a_x;
        int m = LANE_MASK(~((area_0 < 0.0f | area_1 < 0.0f | area_2 < 0.0f) & (area_0 > 0.0f | area_1 > 0.0f | area_2 > 0.0f)));
        m &= mask;
        if (m == 0) continue;
        const D w_0 = WIDE(c_x) * WIDE(b_y) - WIDE(c_y) * WIDE(b_x), w_1 = WIDE(a_x) * WIDE(c_y) - WIDE(a_y) * WIDE(c_x);
        const D w_2 = WIDE(b_x) * WIDE(a_y) - WIDE(b_y) * WIDE(a_x), area = w_0 + w_1 + w_2;
        m &= LANE_MASK(~((w_0 < 0.0 | w_1 < 0.0 | w_2 < 0.0) & (w_0 > 0.0 | w_1 > 0.0 | w_2 > 0.0)) & (area < 0.0 | area > 0.0));
        if (m == 0) continue;
        F at = NARROW((w_0 * WIDE(a_z) + w_1 * WIDE(b_z) + w_2 * WIDE(c_z)) / area * WIDE(row(SHEAR_Z)));
        float lo[3], hi[3];
        for (int k = 0; k < 3; ++k) {
            lo[k] = v1[k] < v0[k] ? v1[k] : v0[k]; lo[k] = v2[k] < lo[k] ? v2[k] : lo[k];
            hi[k] = v1[k] > v0[k] ? v1[k] : v0[k]; hi[k] = v2[k] > hi[k] ? v2[k] : hi[k];
        }
        F enter, leave;
        auto interval = [&]() {
            enter = -inf; leave = inf;
            for (int k = 0; k < 3; ++k) {
                const F o = row(ORIGIN_X + 16 * k), i = row(INVERSE_X + 16 * k), lower = lo[k], upper = hi[k];
                const F e = ((i < 0.0f ? upper : lower) - o) * i, l = ((i < 0.0f ? lower : upper) - o) * i;
                enter = e > enter ? e : enter;
                leave = l < leave ? l : leave;
            }
        };
        auto padded_interval = [&]() {
            const float e_x = hi[0] - lo[0], e_y = hi[1] - lo[1], e_z = hi[2] - lo[2];
            float pad = e_x > e_y ? e_x : e_y;
            pad = 0x1p-21f * (e_z > pad ? e_z : pad) + 0x1p-148f;
            for (int k = 0; k < 3; ++k) {
                lo[k] = lo[k] - (pad + 0x1p-22f * __builtin_fabsf(lo[k]));
                hi[k] = hi[k] + (pad + 0x1p-22f * __builtin_fabsf(hi[k]));
            }
            interval();
        };
        auto held = [&]() { const F before = at > leave ? leave : at; return before < enter ? enter : before; };
        auto underflowed = [&](F moved) {
            const F size = __builtin_elementwise_abs(at);
            const int far = LANE_MASK(__builtin_elementwise_abs(moved - at) > HELD_ROUNDING * size + 0x1p-149f);
            if ((far & m) == 0) return 0;
            F steep = inf, grazing = 0.0f;
            for (int k = 0; k < 3; ++k) {
                const F inverse = __builtin_elementwise_abs(row(INVERSE_X + 16 * k));
                steep = inverse < steep ? inverse : steep;
                grazing = ((inverse > grazing) & (inverse < inf)) ? inverse : grazing;
            }
            const F least = 0x1p-120f * grazing;
            return far & LANE_MASK((steep < least) | ((size < least) & (__builtin_elementwise_abs(moved) < least)));
        };
        interval();
        F moved = held();
        const int again = (LANE_MASK(~(enter <= leave)) | underflowed(moved)) & m;
        if (again) {
            padded_interval();
            const I on = ((again >> lane) & 1) != 0;
            m &= ~again | LANE_MASK(enter <= leave * FAR_PAD);
            moved = on ? held() : moved;
        }
        at = moved;
        const F best = row(T);
        const I id = __builtin_bit_cast(int, p[72 + j]), best_id = *(const I*)(q + PRIM_ID);
        m &= LANE_MASK((__builtin_elementwise_abs(at) < inf) & (at >= row(T_MIN)) & (at <= best));
        m &= LANE_MASK(~((at == best) & (id > best_id)));
        if (m == 0) continue;
        found |= m;
        const I on = ((m >> lane) & 1) != 0;
        const F best_u = row(U), best_v = row(V);
        row(T) = on ? (any_hit ? -inf : at) : best;
        row(U) = on ? NARROW(w_1 / area) : best_u;
        row(V) = on ? NARROW(w_2 / area) : best_v;
        *(I*)(q + PRIM_ID) = on ? id : best_id;
        if (any_hit && (mask &= ~m) == 0) break;
    }
    #undef WIDE
    #undef NARROW
    #undef COMPONENT
    return found;
""".replace("FAR_PAD", f"{float(FAR_PAD)!r}f").replace("HELD_ROUNDING", f"{float(HELD_ROUNDING)!r}f")

# The children that a ray enters become a level of its stack, sorted by a network. A key is the distance, whose last four bits are
# not needed for an order, and the child's number + 8; what is not entered has all bits, which is no distance.
PUSH = """
    typedef unsigned W __attribute__((ext_vector_type(8), aligned(4)));
    const int n = __builtin_popcount(CHILD_MASK(met));
    const W number = {8, 9, 10, 11, 12, 13, 14, 15};
    W v = (__builtin_bit_cast(W, e) & ~15u) | number | ~__builtin_bit_cast(W, met);
    #define LAYER(a, b, c, d, e, f, g, h, ...) { \
        const W other = __builtin_shufflevector(v, v, a, b, c, d, e, f, g, h); \
        const W low = other < v ? other : v, high = other < v ? v : other; \
        v = __builtin_shufflevector(low, high, __VA_ARGS__); }
    LAYER(1, 0, 3, 2, 5, 4, 7, 6, 0, 9, 2, 11, 4, 13, 6, 15)
    LAYER(3, 2, 1, 0, 7, 6, 5, 4, 0, 1, 10, 11, 4, 5, 14, 15)
    LAYER(1, 0, 3, 2, 5, 4, 7, 6, 0, 9, 2, 11, 4, 13, 6, 15)
    LAYER(7, 6, 5, 4, 3, 2, 1, 0, 0, 1, 2, 3, 12, 13, 14, 15)
    LAYER(2, 3, 0, 1, 6, 7, 4, 5, 0, 1, 10, 11, 4, 5, 14, 15)
    LAYER(1, 0, 3, 2, 5, 4, 7, 6, 0, 9, 2, 11, 4, 13, 6, 15)
    #undef LAYER
    const int place = words[2];
    unsigned* level = (unsigned*)stacks.data + (place & ~15) + 16;
    *(W*)level = v;
    level[8] = ~0u;
    level[9] = first + 48;
    level[10] = place;
    // The nearest is next, and its reference is taken here: where the level is read soon, it is not there yet.
    int next;
    __builtin_memcpy(&next, nodes.data + (long long)first + 48 + (v[0] & 7u), 4);
    const float* at = next < 0 ? rows.data + 80ll * ((-1 - next) >> 6) : nodes.data + 64ll * next;
    for (int k = 0; k < 4; ++k) __builtin_prefetch(at + 16 * k);
    words[1] = next;
    words[2] = n > 1 ? (place & ~15) + 17 : place;
    words[3] = n == 0 ? 256 : 0;
"""

STEP = """
    int* const words = slots.data + (long long)slot;
    const int first = words[1] * 64, ray = words[0];
    const float *p = nodes.data + (long long)first, *q = packet.data + (long long)ray;
    const int* near = (const int*)q;
    #define PLANES(k) (*(const G*)(p + (k)))
    const float ox = q[ORIGIN_X], oy = q[ORIGIN_Y], oz = q[ORIGIN_Z];
    const int x = near[NEAR_X], y = near[NEAR_Y], z = near[NEAR_Z];
    G e = (G)(q[T_MIN]), l = (G)(q[T]), f;
    f = (PLANES(x) - ox) * q[INVERSE_X]; e = f > e ? f : e;
    f = (PLANES(y) - oy) * q[INVERSE_Y]; e = f > e ? f : e;
    f = (PLANES(z) - oz) * q[INVERSE_Z]; e = f > e ? f : e;
    f = (PLANES(x ^ 8) - ox) * q[FAR_X]; l = f < l ? f : l;
    f = (PLANES(y ^ 8) - oy) * q[FAR_Y]; l = f < l ? f : l;
    f = (PLANES(z ^ 8) - oz) * q[FAR_Z]; l = f < l ? f : l;
    #undef PLANES
    const auto met = e <= l;
""" + PUSH

BEGIN = """
    const int first = 0;
    int* const words = slots.data + (long long)slot;
    const float* q = packet.data + (long long)ray + FIRST;
    const G e = {q[0], q[16], q[32], q[48], q[64], q[80], q[96], q[112]};
    const auto met = e < (G)(__builtin_inff());
    words[0] = ray;
    words[2] = bottom;
    unsigned* under = (unsigned*)stacks.data + (long long)bottom;
    *under = ~0u;
""" + PUSH

SIFT = """
    const float *p = rows.data + (long long)first, *q = packet.data + (long long)ray;
    #define ROW_OF(k) (*(const G*)(p + 8 * (k)))
    const int axis = *(const int*)(q + AXES), kx = axis & 3, ky = axis >> 2 & 3, kz = axis >> 4;
    const float o_x = q[TURNED_X], o_y = q[TURNED_Y], o_z = q[TURNED_Z], s_x = q[SHEAR_X], s_y = q[SHEAR_Y];
    const G a_z = ROW_OF(kz) - o_z, b_z = ROW_OF(3 + kz) - o_z, c_z = ROW_OF(6 + kz) - o_z;
    const G a_x = (ROW_OF(kx) - o_x) - s_x * a_z, a_y = (ROW_OF(ky) - o_y) - s_y * a_z;
    const G b_x = (ROW_OF(3 + kx) - o_x) - s_x * b_z, b_y = (ROW_OF(3 + ky) - o_y) - s_y * b_z;
    const G c_x = (ROW_OF(6 + kx) - o_x) - s_x * c_z, c_y = (ROW_OF(6 + ky) - o_y) - s_y * c_z;
    #undef ROW_OF
    const G u = c_x * b_y - c_y * b_x, v = a_x * c_y - a_y * c_x, w = b_x * a_y - b_y * a_x;
    return CHILD_MASK(~((u < 0.0f | v < 0.0f | w < 0.0f) & (u > 0.0f | v > 0.0f | w > 0.0f))) & mask;
"""

WRITE_HITS = """
    const F far = __builtin_inff();
    const I id = *(const I*)(q + PRIM_ID), none = -1;
    const F scaled = row(T) * row(SCALE), at = id == 0x7FFFFFFF ? far : scaled;
    const I told = id == 0x7FFFFFFF ? none : id;
    if (count == 16) {
        *(F*)(hits.t.data + first) = at;
        *(F*)(hits.u.data + first) = row(U);
        *(F*)(hits.v.data + first) = row(V);
        *(I*)(hits.prim_id.data + first) = told;
        return;
    }
    for (int j = 0; j < count; ++j) {
        hits.t.data[first + j] = at[j];
        hits.u.data[first + j] = q[U + j];
        hits.v.data[first + j] = q[V + j];
        hits.prim_id.data[first + j] = told[j];
    }
"""
WRITE_DARK = """
    const int found = LANE_MASK(*(const I*)(q + PRIM_ID) != 0x7FFFFFFF);
    for (int j = 0; j < count; ++j) dark.data[first + j] = found >> j & 1;
"""

# The next child that begins at or before t; whether there is one. Equal stays: a tie may have a lower prim_id there.
POP = """
    int* const words = slots.data + (long long)slot;
    const unsigned* all = (const unsigned*)stacks.data;
    int place = words[2];
    unsigned key;
    float entry;
    for (;;) {
        key = all[place];
        const unsigned begins = key & ~15u;
        __builtin_memcpy(&entry, &begins, 4);
        if (entry <= t) break;
        if (place == bottom) return false;
        place = all[(place & ~15) + 10];
    }
    int next;
    __builtin_memcpy(&next, nodes.data + (long long)all[(place & ~15) + 9] + (key & 7u), 4);
    const float* at = next < 0 ? rows.data + 80ll * ((-1 - next) >> 6) : nodes.data + 64ll * next;
    for (int k = 0; k < 4; ++k) __builtin_prefetch(at + 16 * k);
    words[1] = next;
    words[2] = place + 1;
    words[3] = 0;
    return true;
"""


@wp.struct
class Scratch:
    """What one thread works in. packets; stacks: one a slot. slots, eight words each: 0 the ray that is under way (where its
    column begins in `packets`), 1 the reference that is next, 2 where its stack goes on, 3 what comes before: a mask of triangles
    to be tested, and whether to pop, 4 where their row begins."""

    packets: wp.array(dtype=wp.float32)
    stacks: wp.array(dtype=wp.uint32)
    slots: wp.array(dtype=wp.int32)


def _packet_source(snippet: str) -> str:
    return HEAD + "float* q = packet.data + (long long)base; auto row = [q](int k) -> F& { return *(F*)(q + k); };" + snippet + END


@wp.func_native(_packet_source(SET_UP))
def set_up(rays: RayArrays, first: int, count: int, pad: float, packet: wp.array(dtype=wp.float32), base: int) -> int: ...


@wp.func_native(_packet_source(CHILDREN))
def children(nodes: wp.array(dtype=wp.float32), first: int, mask: int, packet: wp.array(dtype=wp.float32), base: int) -> int: ...


@wp.func_native(_packet_source(MEETS))
def meets(nodes: wp.array(dtype=wp.float32), first: int, mask: int, packet: wp.array(dtype=wp.float32), base: int) -> int: ...


@wp.func_native(_packet_source(REACHING))
def reaching(t_entry: float, packet: wp.array(dtype=wp.float32), base: int) -> int: ...


@wp.func_native(_packet_source(TRIANGLES))
def triangles(rows: wp.array(dtype=wp.float32), first: int, count: int, mask: int, any_hit: bool,
              packet: wp.array(dtype=wp.float32), base: int) -> int: ...


@wp.func_native(_packet_source(WRITE_HITS))
def write_hits(hits: HitArrays, first: int, count: int, packet: wp.array(dtype=wp.float32), base: int): ...


@wp.func_native(_packet_source(WRITE_DARK))
def write_dark(dark: wp.array(dtype=wp.bool), first: int, count: int, packet: wp.array(dtype=wp.float32), base: int): ...


@wp.func_native(HEAD + STEP + END)
def step(nodes: wp.array(dtype=wp.float32), rows: wp.array(dtype=wp.float32), packet: wp.array(dtype=wp.float32),
         stacks: wp.array(dtype=wp.uint32), slots: wp.array(dtype=wp.int32), slot: int): ...


@wp.func_native(HEAD + BEGIN + END)
def begin(nodes: wp.array(dtype=wp.float32), rows: wp.array(dtype=wp.float32), packet: wp.array(dtype=wp.float32), ray: int,
          stacks: wp.array(dtype=wp.uint32), bottom: int, slots: wp.array(dtype=wp.int32), slot: int): ...


@wp.func_native(POP)
def pop(nodes: wp.array(dtype=wp.float32), rows: wp.array(dtype=wp.float32), t: float, stacks: wp.array(dtype=wp.uint32),
        bottom: int, slots: wp.array(dtype=wp.int32), slot: int) -> bool: ...


@wp.func_native(HEAD + SIFT + END)
def sift(rows: wp.array(dtype=wp.float32), first: int, mask: int, packet: wp.array(dtype=wp.float32), ray: int) -> int: ...


@wp.func_native("return __builtin_ctzll(mask);")
def lowest_of_all(mask: wp.uint64) -> int: ...


@wp.func_native("return __builtin_popcount(mask);")
def count_of(mask: int) -> int: ...


@wp.func_native("packet.data[(long long)i] = value;")
def put_number(packet: wp.array(dtype=wp.float32), i: int, value: float): ...


@wp.func_native("__builtin_memcpy(packet.data + (long long)i, &value, 4);")
def put_bits(packet: wp.array(dtype=wp.float32), i: int, value: int): ...


@wp.func_native("return slots.data[(long long)i];")
def slot_at(slots: wp.array(dtype=wp.int32), i: int) -> int: ...


@wp.func_native("slots.data[(long long)i] = value;")
def put_slot(slots: wp.array(dtype=wp.int32), i: int, value: int): ...
