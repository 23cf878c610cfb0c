"""Traversal of the binary BVH of 14-DOPs: boxes with their corners cut off by diagonal planes, 56 bytes each (kernels.units.kdop)."""

from functools import cache
from typing import Any

import warp as wp

from wrt.kernels.traverse.bvh2 import STACK_SIZE, Volumes, make_binary_traversal  # noqa: F401 (STACK_SIZE: for the host)
from wrt.kernels.traverse.common import Probe, Units
from wrt.kernels.traverse.leaf import make_leaf
from wrt.kernels.traverse.observer import Recorder
from wrt.kernels.units.kdop import KdopRay, kdop_ray, ray_kdop


@wp.struct
class KdopNode:
    """A Bvh2Node with diagonal slabs too: for a point x of child k, cut_lo_k <= units.kdop.project(x - middle) <= cut_hi_k."""

    lo_0: wp.vec3
    hi_0: wp.vec3
    lo_1: wp.vec3
    hi_1: wp.vec3
    cut_lo_0: wp.vec4
    cut_hi_0: wp.vec4
    cut_lo_1: wp.vec4
    cut_hi_1: wp.vec4
    first_0: int
    count_0: int
    first_1: int
    count_1: int


@cache
def make_struct(record: Any) -> Any:
    """Make the structure's type, for primitives stored as `record`; `middle` is the origin of the diagonal projections."""

    @wp.struct
    class Bvh2Kdop:
        nodes: wp.array(dtype=KdopNode)
        middle: wp.vec3  # Middle of the scene.
        primitives: wp.array(dtype=record)
        recorder: Recorder

    return Bvh2Kdop


@cache
def kdop_volumes(record: Any) -> Volumes:
    """Make the Volumes of 14-DOPs."""
    struct = make_struct(record)

    @wp.func
    def set_up(accel: struct, probe: Probe) -> KdopRay:
        return kdop_ray(probe.ray, probe.box, accel.middle)

    @wp.func
    def enter(ray: KdopRay, node: KdopNode, t_max: float) -> wp.vec2:
        return wp.vec2(ray_kdop(ray, node.lo_0, node.hi_0, node.cut_lo_0, node.cut_hi_0, t_max),
                       ray_kdop(ray, node.lo_1, node.hi_1, node.cut_lo_1, node.cut_hi_1, t_max))

    return Volumes(struct, KdopNode, set_up, enter)


def make_traversal(units: Units, any_hit: bool, accepts: Any = None) -> Any:
    """Make traverse(accel, surfaces, ray) -> Hit: the closest hit or, with any_hit, the first hit found. Units.box has no effect."""
    volumes = kdop_volumes(units.triangle_test.record)
    return make_binary_traversal(units, volumes, make_leaf(units, any_hit, accepts), any_hit)
