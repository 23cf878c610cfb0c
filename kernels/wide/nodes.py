"""Nodes of wide BVHs: the boxes of all children against one ray, as rows of lanes.

Two layouts in a flat array of float32. Plain, 8 rows of `width` numbers: lo_x, hi_x, lo_y, hi_y, lo_z, hi_z, the references of
the children (int32), and one that is not used, so that nodes begin where cache lines do. Compressed (Ylitie, Karras and Laine
2017, section 3.2): an origin (3 numbers), a word of three exponents and the mask of the children that there are, six rows of
`width` bytes, and the references; a plane is origin + byte * 2^(exponent - 127), rounded once, and the builder takes care that
it is never inside of the box. An origin that is NaN says nothing about its axis, and holds no ray back there.

As in kernels.lanes, each native function has its twin in plain Warp.
"""

from functools import cache
from typing import Any, NamedTuple

import warp as wp

from wrt.kernels.units.box import RAY_AABB
from wrt.kernels.wide.lanes import LANE_PAD, LaneRay, row_type


class Nodes(NamedTuple):
    """entries(nodes, first, ray) -> row: where the line enters the boxes of the node that begins at `first`, at least t_min.
    entered(nodes, first, ray, t_max) -> mask of those that it enters before it leaves them, and at or before t_max (finite)."""

    entries: Any
    entered: Any


def node_size(width: int, compressed: bool) -> int:
    """Numbers a node."""
    return 4 + 6 * width // 4 + width if compressed else 8 * width


def first_reference(width: int, compressed: bool) -> int:
    """Where in a node the references of its children begin."""
    return 4 + 6 * width // 4 if compressed else 6 * width


PLAIN = """
    const float* p = nodes.data + (long long)first;
    #define AT(k, axis, j) p[WIDTH * (k) + (j)]
    #define ROW(k, axis) (*(const F*)(p + WIDTH * (k)))
    const unsigned there = (1u << WIDTH) - 1u;
"""

COMPRESSED = """
    const float* p = nodes.data + (long long)first;
    const unsigned char* q = (const unsigned char*)(p + 4);
    unsigned word;
    memcpy(&word, p + 3, 4);
    const unsigned exponents[3] = {(word & 255u) << 23, (word >> 8 & 255u) << 23, (word >> 16 & 255u) << 23};
    float scale[3];
    memcpy(scale, exponents, 12);
    #define AT(k, axis, j) (p[axis] + (float)q[WIDTH * (k) + (j)] * scale[axis])
    #define ROW(k, axis) (p[axis] + __builtin_convertvector(*(const Q*)(q + WIDTH * (k)), F) * scale[axis])
    const unsigned there = word >> 24;
"""

BEGIN = """
    const wp::vec_t<3, wp::float32> o = ray.box.origin, d = ray.box.inv_dir, far = ray.far_inv_dir;
#if !defined(__CUDA_ARCH__)
    typedef float F __attribute__((ext_vector_type(WIDTH), aligned(4)));
    typedef unsigned char Q __attribute__((ext_vector_type(WIDTH), aligned(1)));
    typedef bool B __attribute__((ext_vector_type(WIDTH)));
#endif
    LAYOUT
"""

NEAR = """
    const F begin = (F)(ray.box.t_min);
    F e = (ROW(ray.near_x, 0) - o[0]) * d[0], f;
    e = e > begin ? e : begin;
    f = (ROW(ray.near_y, 1) - o[1]) * d[1]; e = f > e ? f : e;
    f = (ROW(ray.near_z, 2) - o[2]) * d[2]; e = f > e ? f : e;
"""

NEAR_AT = """
        float e = (AT(ray.near_x, 0, j) - o[0]) * d[0], f;
        e = e > ray.box.t_min ? e : ray.box.t_min;
        f = (AT(ray.near_y, 1, j) - o[1]) * d[1]; e = f > e ? f : e;
        f = (AT(ray.near_z, 2, j) - o[2]) * d[2]; e = f > e ? f : e;
"""

ENTRIES = """
    BEGIN
    wp::vec_t<WIDTH, wp::float32> out;
#if defined(__CUDA_ARCH__)
    for (int j = 0; j < WIDTH; ++j) {
        AT_NEAR
        out[j] = e;
    }
#else
    ROW_NEAR
    __builtin_memcpy(&out, &e, sizeof(out));
#endif
    return out;
    #undef AT
    #undef ROW
"""

ENTERED = """
    BEGIN
#if defined(__CUDA_ARCH__)
    int mask = 0;
    for (int j = 0; j < WIDTH; ++j) {
        AT_NEAR
        float l = t_max;
        f = (AT(ray.near_x ^ 1, 0, j) - o[0]) * far[0]; l = f < l ? f : l;
        f = (AT(ray.near_y ^ 1, 1, j) - o[1]) * far[1]; l = f < l ? f : l;
        f = (AT(ray.near_z ^ 1, 2, j) - o[2]) * far[2]; l = f < l ? f : l;
        mask |= (e <= l) << j;
    }
    return mask & there;
#else
    ROW_NEAR
    F l = (F)(t_max);
    f = (ROW(ray.near_x ^ 1, 0) - o[0]) * far[0]; l = f < l ? f : l;
    f = (ROW(ray.near_y ^ 1, 1) - o[1]) * far[1]; l = f < l ? f : l;
    f = (ROW(ray.near_z ^ 1, 2) - o[2]) * far[2]; l = f < l ? f : l;
    return __builtin_bit_cast(unsigned char, __builtin_convertvector(e <= l, B)) & there;
#endif
    #undef AT
    #undef ROW
"""


@cache
def make_nodes(width: int, compressed: bool) -> Nodes:
    """The native functions for nodes of 4 or 8 children."""
    row = row_type(width)

    def source(snippet):
        layout = COMPRESSED if compressed else PLAIN
        parts = {"BEGIN": BEGIN, "LAYOUT": layout, "AT_NEAR": NEAR_AT, "ROW_NEAR": NEAR, "WIDTH": str(width)}
        for name, part in parts.items():
            snippet = snippet.replace(name, part)
        return snippet

    @wp.func_native(source(ENTRIES))
    def entries(nodes: wp.array(dtype=wp.float32), first: int, ray: LaneRay) -> row: ...

    @wp.func_native(source(ENTERED))
    def entered(nodes: wp.array(dtype=wp.float32), first: int, ray: LaneRay, t_max: float) -> int: ...

    return Nodes(entries, entered)


@cache
def make_plane(width: int, compressed: bool):
    """plane(nodes, first, row, lane): of the six rows (lo_x, hi_x, lo_y ...) of one node; and there(nodes, first, lane)."""

    @wp.func
    def word(nodes: wp.array(dtype=wp.float32), i: int) -> int:
        return wp.cast(nodes[i], wp.int32)

    @wp.func
    def plane(nodes: wp.array(dtype=wp.float32), first: int, k: int, lane: int) -> float:
        if wp.static(compressed):
            at = k * width + lane
            byte = (word(nodes, first + 4 + at / 4) >> (8 * (at % 4))) & 255
            exponent = (word(nodes, first + 3) >> (8 * (k / 2))) & 255
            return nodes[first + k / 2] + float(byte) * wp.cast(exponent << 23, wp.float32)
        return nodes[first + k * width + lane]

    @wp.func
    def there(nodes: wp.array(dtype=wp.float32), first: int, lane: int) -> bool:
        if wp.static(compressed):
            return ((word(nodes, first + 3) >> (24 + lane)) & 1) != 0
        return True

    return plane, there


@cache
def make_twins(width: int, compressed: bool) -> Nodes:
    """The same functions in plain Warp, lane by lane."""
    row = row_type(width)
    plane, there = make_plane(width, compressed)

    @wp.func
    def near_row(ray: LaneRay, axis: int) -> int:
        return wp.where(axis == 0, ray.near_x, wp.where(axis == 1, ray.near_y, ray.near_z))

    @wp.func
    def enters(nodes: wp.array(dtype=wp.float32), first: int, lane: int, ray: LaneRay) -> float:
        out = float(ray.box.t_min)
        for axis in range(3):
            t = (plane(nodes, first, near_row(ray, axis), lane) - ray.box.origin[axis]) * ray.box.inv_dir[axis]
            out = wp.where(t > out, t, out)
        return out

    @wp.func
    def leaves(nodes: wp.array(dtype=wp.float32), first: int, lane: int, ray: LaneRay, t_max: float) -> float:
        out = float(t_max)
        for axis in range(3):
            t = (plane(nodes, first, near_row(ray, axis) ^ 1, lane) - ray.box.origin[axis]) * ray.far_inv_dir[axis]
            out = wp.where(t < out, t, out)
        return out

    @wp.func
    def entries(nodes: wp.array(dtype=wp.float32), first: int, ray: LaneRay) -> row:
        out = row()
        for j in range(width):
            out[j] = enters(nodes, first, j, ray)
        return out

    @wp.func
    def entered(nodes: wp.array(dtype=wp.float32), first: int, ray: LaneRay, t_max: float) -> int:
        mask = int(0)
        for j in range(width):
            if there(nodes, first, j) and enters(nodes, first, j, ray) <= leaves(nodes, first, j, ray, t_max):
                mask = mask | (1 << j)
        return mask

    return Nodes(entries, entered)


@cache
def make_scalar(width: int, compressed: bool, box: str) -> Nodes:
    """The same by the scalar unit of that name in RAY_AABB: for a box test that has no form in rows."""
    row = row_type(width)
    plane, there = make_plane(width, compressed)
    ray_aabb = RAY_AABB[box]

    @wp.func
    def enters(nodes: wp.array(dtype=wp.float32), first: int, j: int, ray: LaneRay, t_max: float) -> float:
        lo = wp.vec3(plane(nodes, first, 0, j), plane(nodes, first, 2, j), plane(nodes, first, 4, j))
        hi = wp.vec3(plane(nodes, first, 1, j), plane(nodes, first, 3, j), plane(nodes, first, 5, j))
        return ray_aabb(ray.box, lo, hi, t_max)

    @wp.func
    def entries(nodes: wp.array(dtype=wp.float32), first: int, ray: LaneRay) -> row:
        out = row()
        for j in range(width):
            out[j] = enters(nodes, first, j, ray, float(wp.inf))
        return out

    @wp.func
    def entered(nodes: wp.array(dtype=wp.float32), first: int, ray: LaneRay, t_max: float) -> int:
        mask = int(0)
        for j in range(width):
            if there(nodes, first, j) and enters(nodes, first, j, ray, t_max) < wp.inf:
                mask = mask | (1 << j)
        return mask

    return Nodes(entries, entered)


def make_box_test(box: str, width: int, compressed: bool):
    """entries and entered for a name in RAY_AABB, and by how much far distances are widened."""
    if box == "plain":
        return *make_scalar(width, compressed, box), 1.0
    return *make_nodes(width, compressed), LANE_PAD if box == "conservative" else 1.0
