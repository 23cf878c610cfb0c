"""Traversal of binary BVHs of other volumes than boxes (24 bytes): bounding spheres (16 bytes), and 14-DOPs (56 bytes), which are boxes
with their corners cut off by diagonal planes (kernels.units.kdop)."""

from functools import cache
from typing import Any, NamedTuple

import warp as wp

from wrt.kernels.traverse import bvh2
from wrt.kernels.traverse.bvh2 import Volumes, make_binary_traversal
from wrt.kernels.traverse.common import Probe, Units
from wrt.kernels.traverse.leaf import make_leaf
from wrt.kernels.traverse.observer import Recorder
from wrt.kernels.traverse.steps import Step, box_step
from wrt.kernels.units.bounding_sphere import SphereRay, ray_bounding_sphere, sphere_ray
from wrt.kernels.units.kdop import KdopRay, kdop_ray, ray_kdop


@wp.struct
class SphereNode:
    """A Bvh2Node with a sphere (center, radius) per child instead of a box; a missing child has radius -1."""

    sphere_0: wp.vec4
    sphere_1: wp.vec4
    first_0: int
    count_0: int
    first_1: int
    count_1: int


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


class VolumeTree(NamedTuple):
    """A binary BVH with one kind of volumes, in place of a module of kernels.traverse. Units.box has no effect on its traversal."""

    make_struct: Any  # Function (record) -> type of the structure, for primitives stored as `record`.
    make_volumes: Any  # Function (record) -> Volumes.

    def make_traversal(self, units: Units, any_hit: bool, accepts: Any = None) -> Any:
        volumes = self.make_volumes(units.triangle_test.record)
        return make_binary_traversal(units, volumes, make_leaf(units, any_hit, accepts), any_hit)


def make_sphere_tree(record: Any) -> Any:
    return bvh2.make_struct(record, SphereNode)


@cache
def make_kdop_tree(record: Any) -> Any:
    @wp.struct
    class Bvh2Kdop:
        nodes: wp.array(dtype=KdopNode)
        middle: wp.vec3  # Middle of the scene, the origin of the diagonal projections.
        primitives: wp.array(dtype=record)
        recorder: Recorder

    return Bvh2Kdop


@wp.func
def outline_of(node: SphereNode, second: bool) -> Step:
    """Make the step of a child, with the box around its sphere and the sphere's radius."""
    sphere = wp.where(second, node.sphere_1, node.sphere_0)
    center = wp.vec3(sphere[0], sphere[1], sphere[2])
    reach = wp.vec3(sphere[3], sphere[3], sphere[3])
    step = box_step(0, 0, center - reach, center + reach, 0.0)
    step.edges = wp.vec3d(wp.float64(sphere[3]), wp.float64(0.0), wp.float64(0.0))
    return step


@cache
def sphere_volumes(record: Any) -> Volumes:
    struct = make_sphere_tree(record)

    @wp.func
    def set_up(accel: struct, probe: Probe) -> SphereRay:
        return sphere_ray(probe.ray)

    @wp.func
    def enter(ray: SphereRay, node: SphereNode, t_max: float) -> wp.vec2:
        return wp.vec2(ray_bounding_sphere(ray, node.sphere_0, t_max), ray_bounding_sphere(ray, node.sphere_1, t_max))

    return Volumes(struct, SphereNode, set_up, enter, outline_of)


@cache
def kdop_volumes(record: Any) -> Volumes:
    struct = make_kdop_tree(record)

    @wp.func
    def set_up(accel: struct, probe: Probe) -> KdopRay:
        return kdop_ray(probe.ray, probe.box, accel.middle)

    @wp.func
    def enter(ray: KdopRay, node: KdopNode, t_max: float) -> wp.vec2:
        return wp.vec2(ray_kdop(ray, node.lo_0, node.hi_0, node.cut_lo_0, node.cut_hi_0, t_max),
                       ray_kdop(ray, node.lo_1, node.hi_1, node.cut_lo_1, node.cut_hi_1, t_max))

    return Volumes(struct, KdopNode, set_up, enter)


SPHERES, KDOPS = VolumeTree(make_sphere_tree, sphere_volumes), VolumeTree(make_kdop_tree, kdop_volumes)
