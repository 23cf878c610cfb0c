"""The cost of bounding volumes: kernels with tests alone, and numbers of visits and tests as another library (tinybvh) counts them."""

from functools import cache
from typing import Any

import warp as wp

from wrt.kernels.query import RayArrays, load_ray
from wrt.kernels.structs import kernel
from wrt.kernels.traverse.bvh2 import STACK_SIZE, Bvh2Node, Volumes
from wrt.kernels.traverse.common import Units, make_probe
from wrt.kernels.units.box import box_ray, ray_aabb


@cache
def make_enter_kernel(volumes: Volumes) -> Any:
    """Make the kernel that tests each ray against the volumes of both children of every node."""
    struct, set_up, enter = volumes.struct, volumes.set_up, volumes.enter
    probe_of = make_probe(Units())

    @kernel
    def enter_all(accel: struct, rays: RayArrays, entered: wp.array(dtype=wp.int32)):
        """Store the number of volumes that each ray enters."""
        i = wp.tid()
        ray = load_ray(rays, i)
        prepared = set_up(accel, probe_of(ray))
        n = int(0)
        for k in range(accel.nodes.shape[0]):
            entry = enter(prepared, accel.nodes[k], ray.t_max)
            n = n + wp.where(entry[0] < wp.inf, 1, 0) + wp.where(entry[1] < wp.inf, 1, 0)
        entered[i] = n

    return enter_all


@kernel
def count_popped(nodes: wp.array(dtype=Bvh2Node), order: wp.array(dtype=wp.int32), rays: RayArrays, t: wp.array(dtype=wp.float32),
                 prim_id: wp.array(dtype=wp.int32), visits: wp.array(dtype=wp.int32), primitives: wp.array(dtype=wp.int32)):
    """Count visits and primitive tests of rays with known closest hits (t, prim_id), as tinybvh counts them.
    Each popped node or leaf counts as a visit, even if it begins behind the closest hit."""
    i = wp.tid()
    box = box_ray(load_ray(rays, i))
    best = float(wp.inf)
    stack = wp.zeros(shape=wp.static(STACK_SIZE), dtype=wp.vec2i)
    size = int(1)
    while size > 0:
        size = size - 1
        at = stack[size]
        visits[i] = visits[i] + 1
        if at[1] > 0:
            primitives[i] = primitives[i] + at[1]
            for k in range(at[0], at[0] + at[1]):
                if order[k] == prim_id[i]:
                    best = t[i]
        else:
            node = nodes[at[0]]
            t_0 = ray_aabb(box, node.lo_0, node.hi_0, best)
            t_1 = ray_aabb(box, node.lo_1, node.hi_1, best)
            child_0 = wp.vec2i(node.first_0, node.count_0)
            child_1 = wp.vec2i(node.first_1, node.count_1)
            if t_0 < wp.inf and t_1 < wp.inf:
                stack[size] = wp.where(t_1 < t_0, child_0, child_1)
                stack[size + 1] = wp.where(t_1 < t_0, child_1, child_0)
                size = size + 2
            elif t_0 < wp.inf or t_1 < wp.inf:
                stack[size] = wp.where(t_0 < wp.inf, child_0, child_1)
                size = size + 1
