"""Nodes of wide BVHs, and the test of one ray against the boxes of all children of a node.

Nodes are consecutive in a flat array of float32; layout.py has the constants.
- A plain node has 8 rows of `width` floats, 64 floats for bvh8. The rows are the six planes (PLANES), the children's references (int32),
  and an unused row that aligns nodes to cache lines.
- A compressed node has 24 floats for bvh8c (Ylitie, Karras and Laine 2017, section 3.2). It has an origin (3 floats), a word with three
  exponents and the mask of existing children, six rows of `width` bytes, and the references. A plane is origin + byte * 2^(exponent - 127),
  rounded once. The builder ensures that no plane cuts off a part of the box. An axis with a NaN origin rejects no ray."""

from functools import cache
from typing import Any

import warp as wp

from wrt.kernels.structs import on_cuda
from wrt.kernels.units.box import RAY_AABB
from wrt.kernels.wide.lanes import LANE_PAD, LaneRay, bits, four, lanes_only, larger, row_type, smaller, value
from wrt.kernels.wide.layout import EXIST_SHIFT, EXPONENT_BITS, FIRST_BYTES, HI_X, HI_Y, HI_Z, LO_X, LO_Y, LO_Z, MANTISSA_BITS, WORD

# Factor of far distances for the box tests that have a vectorised form, by their names in RAY_AABB.
ROW_PADS = {"conservative": LANE_PAD, "minmax": 1.0}


@wp.func
def step_of(nodes: wp.array(dtype=wp.float32), first: int, axis: int) -> float:
    """Return the distance between the planes of two successive bytes of a compressed node."""
    exponent = (bits(nodes, first + WORD) >> (EXPONENT_BITS * axis)) & wp.static((1 << EXPONENT_BITS) - 1)
    return wp.cast(exponent << MANTISSA_BITS, wp.float32)


@cache
def make_plane(width: int, compressed: bool) -> Any:
    """Return plane(nodes, first, k, lane), the coordinate of PLANES[k] of child `lane`; and exists(nodes, first, lane) -> bool."""

    @wp.func
    def plane(nodes: wp.array(dtype=wp.float32), first: int, k: int, lane: int) -> float:
        if wp.static(compressed):
            at = k * width + lane  # Index among the bytes; a word has four.
            byte = (bits(nodes, first + FIRST_BYTES + (at >> 2)) >> (8 * (at & 3))) & 255
            return value(nodes, first + (k >> 1)) + float(byte) * step_of(nodes, first, k >> 1)
        return value(nodes, first + k * width + lane)

    @wp.func
    def exists(nodes: wp.array(dtype=wp.float32), first: int, lane: int) -> bool:
        if wp.static(compressed):
            return ((bits(nodes, first + WORD) >> (EXIST_SHIFT + lane)) & 1) != 0
        return True

    return plane, exists


@cache
def make_scalar(width: int, compressed: bool, box: str) -> Any:
    """Return children(nodes, first, ray, t_max) -> (row, mask) for a box test without a vectorised form.
    It tests a node's children one by one with RAY_AABB[box]. `make_children` describes row and mask."""
    (plane, exists), ray_aabb, row = make_plane(width, compressed), RAY_AABB[box], row_type(width)

    @wp.func
    def enters(nodes: wp.array(dtype=wp.float32), first: int, j: int, ray: LaneRay, t_max: float) -> float:
        lo = wp.vec3(plane(nodes, first, LO_X, j), plane(nodes, first, LO_Y, j), plane(nodes, first, LO_Z, j))
        hi = wp.vec3(plane(nodes, first, HI_X, j), plane(nodes, first, HI_Y, j), plane(nodes, first, HI_Z, j))
        return ray_aabb(ray.box, lo, hi, t_max)

    @wp.func
    def children(nodes: wp.array(dtype=wp.float32), first: int, ray: LaneRay, t_max: float):
        entries = row()
        mask = int(0)
        for j in range(width):
            entries[j] = enters(nodes, first, j, ray, t_max)
            if exists(nodes, first, j) and entries[j] < wp.inf:
                mask = mask | (1 << j)
        return entries, mask

    return children


@cache
def make_plain(width: int, compressed: bool) -> Any:
    """Return children(nodes, first, ray, t_max) -> mask and entry(nodes, first, lane, ray) -> t in plain Warp, for CUDA.

    A thread tests four boxes for each load. It computes the entry distance of an entered child anew: to keep the distances of all
    children, a thread would write a row to its local memory for each node."""
    plane, _ = make_plane(width, compressed)

    @wp.func
    def near_plane(ray: LaneRay, axis: int) -> int:
        return wp.where(axis == 0, ray.near_x, wp.where(axis == 1, ray.near_y, ray.near_z))

    @wp.func
    def planes(nodes: wp.array(dtype=wp.float32), first: int, k: int, lane: int) -> wp.vec4:
        """Return PLANES[k] of the four children from `lane` on."""
        if wp.static(compressed):
            word = bits(nodes, first + FIRST_BYTES + ((k * width + lane) >> 2))
            origin, step = value(nodes, first + (k >> 1)), step_of(nodes, first, k >> 1)
            return wp.vec4(origin + float(word & 255) * step, origin + float((word >> 8) & 255) * step,
                           origin + float((word >> 16) & 255) * step, origin + float((word >> 24) & 255) * step)
        return four(nodes, first + k * width + lane)

    @wp.func
    def children(nodes: wp.array(dtype=wp.float32), first: int, ray: LaneRay, t_max: float) -> int:
        mask = int(0)
        for h in range(width // 4):
            enter = wp.vec4(ray.box.t_min)
            leave = wp.vec4(t_max)
            for axis in range(3):
                near = near_plane(ray, axis)
                nearest, farthest = planes(nodes, first, near, 4 * h), planes(nodes, first, near ^ 1, 4 * h)
                for j in range(4):
                    enter[j] = larger((nearest[j] - ray.box.origin[axis]) * ray.box.inv_dir[axis], enter[j])
                    leave[j] = smaller((farthest[j] - ray.box.origin[axis]) * ray.far_inv_dir[axis], leave[j])
            for j in range(4):
                if enter[j] <= leave[j]:
                    mask = mask | (1 << (4 * h + j))
        if wp.static(compressed):
            return mask & (bits(nodes, first + WORD) >> EXIST_SHIFT)
        return mask

    @wp.func
    def entry(nodes: wp.array(dtype=wp.float32), first: int, lane: int, ray: LaneRay) -> float:
        out = float(ray.box.t_min)
        for axis in range(3):
            t = (plane(nodes, first, near_plane(ray, axis), lane) - ray.box.origin[axis]) * ray.box.inv_dir[axis]
            out = larger(t, out)
        return out

    return children, entry


def node_type(width: int, compressed: bool) -> str:
    """Return the C++ definition of `node`, the node at nodes[first] (box.h), for functions in C++."""
    numbers = {"COMPRESSED": int(compressed), "WORD": WORD, "FIRST_BYTES": FIRST_BYTES, "EXPONENT_BITS": EXPONENT_BITS,
               "EXIST_SHIFT": EXIST_SHIFT, "MANTISSA_BITS": MANTISSA_BITS}
    layout = ", ".join(f"{name} = {value}" for name, value in numbers.items())
    return f"struct Layout {{ enum {{ {layout} }}; }}; const wrt::Node<{width}, Layout> node = {{nodes.data + (long long)first}};"


@cache
def make_native(width: int, compressed: bool) -> Any:
    """Return children (see make_children) in C++, for the CPU only."""
    row, node = row_type(width), node_type(width, compressed)

    @wp.func_native(lanes_only(f"""
    {node}
    const auto entries = node.entries(wrt::node_ray(ray));
    return wrt::load<wp::vec_t<{width}, wp::float32>>(&entries);
    """, "{}"))
    def row_entries(nodes: wp.array(dtype=wp.float32), first: int, ray: LaneRay) -> row: ...

    @wp.func_native(lanes_only(f"{node} return node.entered(wrt::node_ray(ray), t_max);"))
    def row_entered(nodes: wp.array(dtype=wp.float32), first: int, ray: LaneRay, t_max: float) -> int: ...

    @wp.func
    def children(nodes: wp.array(dtype=wp.float32), first: int, ray: LaneRay, t_max: float):
        return row_entries(nodes, first, ray), row_entered(nodes, first, ray, t_max)

    return children


@cache
def make_children(width: int, compressed: bool, box: str) -> Any:
    """Return children(nodes, first, ray, t_max) -> (row, mask) for the node at nodes[first] and a finite t_max, and
    entry(row, nodes, first, lane, ray) -> t.

    The mask has the children that the ray's segment [t_min, t_max] enters. Their entry distances are at least t_min. The box test
    `box` is a name in RAY_AABB; ray.far_inv_dir must include the factor far_pad(box). CUDA and the CPU run different forms."""
    row = row_type(width)

    @wp.func
    def entry_of(entries: row, nodes: wp.array(dtype=wp.float32), first: int, lane: int, ray: LaneRay) -> float:
        return entries[lane]

    if box not in ROW_PADS:
        return make_scalar(width, compressed, box), entry_of
    (plain, plain_entry), vector = make_plain(width, compressed), make_native(width, compressed)

    @wp.func
    def children(nodes: wp.array(dtype=wp.float32), first: int, ray: LaneRay, t_max: float):
        if on_cuda():
            return row(), plain(nodes, first, ray, t_max)
        return vector(nodes, first, ray, t_max)

    @wp.func
    def entry(entries: row, nodes: wp.array(dtype=wp.float32), first: int, lane: int, ray: LaneRay) -> float:
        if on_cuda():
            return plain_entry(nodes, first, lane, ray)
        return entries[lane]

    return children, entry


def far_pad(box: str) -> float:
    """Return the factor for LaneRay.far_inv_dir. It is 1 for a box test without a vectorised form, which does not read far_inv_dir."""
    return ROW_PADS.get(box, 1.0)
