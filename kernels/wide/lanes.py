"""Lanes: rows of 4 or 8 numbers that one CPU instruction works on, for the few loops where a ray's time goes.

`make_lanes(width)` gives native functions. What each of them means is said by its twin of plain Warp in `make_twins`: a test
holds the two to the same bits. The vector code is the compiler's own extension, no instruction set by name, and so runs on
every CPU; CUDA gets the loop over the lanes. Rows lie one after another in a flat array of float32.
"""

from functools import cache
from typing import Any, NamedTuple

import warp as wp

from wrt.kernels.units.box import FAR_PAD, BoxRay

EMPTY = wp.constant(0)  # a child that does not exist: the root is nobody's child


# The lanes' far distances are widened by way of the reciprocals, in one product instead of two: 8 u more than FAR_PAD outweigh
# the four roundings by which the two ways may differ, so that no box is left out that the box unit enters.
LANE_PAD = wp.constant(FAR_PAD * (1.0 + 8.0 * 2.0**-24))


@wp.struct
class LaneRay:
    """A ray as the rows are met. box: for the box unit, t_min never -0; far_inv_dir: reciprocals for far planes; near_x, near_y,
    near_z: which row (0 .. 5: lo_x, hi_x, lo_y ...) is met first on each axis; kx, ky, kz, shear_x, shear_y: as in TriangleRay;
    origin: in the order kx, ky, kz."""

    box: BoxRay
    far_inv_dir: wp.vec3
    near_x: int
    near_y: int
    near_z: int
    kx: int
    ky: int
    kz: int
    shear_x: float
    shear_y: float
    origin: wp.vec3


class Lanes(NamedTuple):
    """candidates(rows, first, ray) -> mask of the triangles whose nine rows begin at `first`, without those that the watertight
    unit refuses in float32. lowest(mask) -> its lowest lane. value(rows, i) -> rows[i]; bits(rows, i) -> the int32 that is there.
    prefetch(rows, first): their next use is near."""

    candidates: Any
    lowest: Any
    value: Any
    bits: Any
    prefetch: Any


HEAD = """
    typedef float F __attribute__((ext_vector_type(WIDTH), aligned(4)));
    const float* p = rows.data + (long long)first;
    #define ROW(k) (*(const F*)(p + WIDTH * (k)))
"""

CANDIDATES = """
#if defined(__CUDA_ARCH__)
    int mask = 0;
    const float* p = rows.data + (long long)first;
    for (int j = 0; j < WIDTH; ++j) {
        float x[3], y[3];
        for (int k = 0; k < 3; ++k) {
            float z = p[WIDTH * (3 * k + ray.kz) + j] - ray.origin[2];
            x[k] = (p[WIDTH * (3 * k + ray.kx) + j] - ray.origin[0]) - ray.shear_x * z;
            y[k] = (p[WIDTH * (3 * k + ray.ky) + j] - ray.origin[1]) - ray.shear_y * z;
        }
        float u = x[2] * y[1] - y[2] * x[1], v = x[0] * y[2] - y[0] * x[2], w = x[1] * y[0] - y[1] * x[0];
        mask |= !((u < 0.0f | v < 0.0f | w < 0.0f) & (u > 0.0f | v > 0.0f | w > 0.0f)) << j;
    }
    return mask;
#else
    HEAD
    typedef bool B __attribute__((ext_vector_type(WIDTH)));
    const int kx = ray.kx, ky = ray.ky, kz = ray.kz;
    const float o_x = ray.origin[0], o_y = ray.origin[1], o_z = ray.origin[2], s_x = ray.shear_x, s_y = ray.shear_y;
    F a_z = ROW(kz) - o_z, b_z = ROW(3 + kz) - o_z, c_z = ROW(6 + kz) - o_z;
    F a_x = (ROW(kx) - o_x) - s_x * a_z, b_x = (ROW(3 + kx) - o_x) - s_x * b_z, c_x = (ROW(6 + kx) - o_x) - s_x * c_z;
    F a_y = (ROW(ky) - o_y) - s_y * a_z, b_y = (ROW(3 + ky) - o_y) - s_y * b_z, c_y = (ROW(6 + ky) - o_y) - s_y * c_z;
    #undef ROW
    F u = c_x * b_y - c_y * b_x, v = a_x * c_y - a_y * c_x, w = b_x * a_y - b_y * a_x;
    auto refused = (u < 0.0f | v < 0.0f | w < 0.0f) & (u > 0.0f | v > 0.0f | w > 0.0f);
    return __builtin_bit_cast(unsigned char, __builtin_convertvector(~refused, B)) & ((1 << WIDTH) - 1);
#endif
"""

LOWEST = """
#if defined(__CUDA_ARCH__)
    return __ffs(mask) - 1;
#else
    return __builtin_ctz(mask);
#endif
"""

VALUE = "return rows.data[(long long)i];"

BITS = "int value; memcpy(&value, rows.data + (long long)i, 4); return value;"

PREFETCH = """
#if !defined(__CUDA_ARCH__)
    const char* p = (const char*)(rows.data + (long long)first);
    __builtin_prefetch(p); __builtin_prefetch(p + 64);
#endif
"""


@cache
def row_type(width: int):
    """A row of `width` float32."""
    return wp.types.vector(width, wp.float32)


@cache
def make_lanes(width: int) -> Lanes:
    """The native functions for rows of 4 or 8."""

    def source(snippet):
        return snippet.replace("HEAD", HEAD).replace("WIDTH", str(width))

    @wp.func_native(source(CANDIDATES))
    def candidates(rows: wp.array(dtype=wp.float32), first: int, ray: LaneRay) -> int: ...

    @wp.func_native(LOWEST)
    def lowest(mask: int) -> int: ...

    @wp.func_native(VALUE)
    def value(rows: wp.array(dtype=wp.float32), i: int) -> float: ...

    @wp.func_native(BITS)
    def bits(rows: wp.array(dtype=wp.float32), i: int) -> int: ...

    @wp.func_native(PREFETCH)
    def prefetch(rows: wp.array(dtype=wp.float32), first: int): ...

    return Lanes(candidates, lowest, value, bits, prefetch)


@cache
def make_twins(width: int) -> Lanes:
    """The same functions in plain Warp, lane by lane."""

    @wp.func
    def bits(rows: wp.array(dtype=wp.float32), i: int) -> int:
        return wp.cast(rows[i], wp.int32)

    @wp.func
    def value(rows: wp.array(dtype=wp.float32), i: int) -> float:
        return rows[i]

    @wp.func
    def sheared(rows: wp.array(dtype=wp.float32), i: int, ray: LaneRay) -> wp.vec2:
        """The corner whose three rows have this lane at i, i + width, i + 2 width."""
        z = rows[i + width * ray.kz] - ray.origin[2]
        return wp.vec2((rows[i + width * ray.kx] - ray.origin[0]) - ray.shear_x * z,
                       (rows[i + width * ray.ky] - ray.origin[1]) - ray.shear_y * z)

    @wp.func
    def candidates(rows: wp.array(dtype=wp.float32), first: int, ray: LaneRay) -> int:
        mask = int(0)
        for j in range(width):
            a = sheared(rows, first + j, ray)
            b = sheared(rows, first + 3 * width + j, ray)
            c = sheared(rows, first + 6 * width + j, ray)
            u = c[0] * b[1] - c[1] * b[0]
            v = a[0] * c[1] - a[1] * c[0]
            w = b[0] * a[1] - b[1] * a[0]
            if not ((u < 0.0 or v < 0.0 or w < 0.0) and (u > 0.0 or v > 0.0 or w > 0.0)):
                mask = mask | (1 << j)
        return mask

    @wp.func
    def lowest(mask: int) -> int:
        lane = int(0)
        while (mask >> lane) & 1 == 0:
            lane = lane + 1
        return lane

    @wp.func
    def prefetch(rows: wp.array(dtype=wp.float32), first: int):
        pass

    return Lanes(candidates, lowest, value, bits, prefetch)
