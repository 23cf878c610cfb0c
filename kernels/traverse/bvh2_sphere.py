"""Traversal of the binary BVH of bounding spheres: a sphere takes 16 bytes, a box 24."""

from functools import cache
from typing import Any

import warp as wp

from wrt.kernels.traverse import bvh2
from wrt.kernels.traverse.bvh2 import STACK_SIZE, Volumes, make_binary_traversal  # noqa: F401 (STACK_SIZE: for the host)
from wrt.kernels.traverse.common import Probe, Units
from wrt.kernels.traverse.leaf import make_leaf
from wrt.kernels.traverse.steps import Step, box_step
from wrt.kernels.units.bounding_sphere import SphereRay, ray_bounding_sphere, sphere_ray


@wp.struct
class SphereNode:
    """A Bvh2Node with a sphere (center, radius) per child instead of a box; a missing child has radius -1."""

    sphere_0: wp.vec4
    sphere_1: wp.vec4
    first_0: int
    count_0: int
    first_1: int
    count_1: int


def make_struct(record: Any) -> Any:
    return bvh2.make_struct(record, SphereNode)


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
    """Make the Volumes of bounding spheres."""
    struct = make_struct(record)

    @wp.func
    def set_up(accel: struct, probe: Probe) -> SphereRay:
        return sphere_ray(probe.ray)

    @wp.func
    def enter(ray: SphereRay, node: SphereNode, t_max: float) -> wp.vec2:
        return wp.vec2(ray_bounding_sphere(ray, node.sphere_0, t_max), ray_bounding_sphere(ray, node.sphere_1, t_max))

    return Volumes(struct, SphereNode, set_up, enter, outline_of)


def make_traversal(units: Units, any_hit: bool, accepts: Any = None) -> Any:
    """Make traverse(accel, surfaces, ray) -> Hit: the closest hit or, with any_hit, the first hit found. Units.box has no effect."""
    volumes = sphere_volumes(units.triangle_test.record)
    return make_binary_traversal(units, volumes, make_leaf(units, any_hit, accepts), any_hit)
