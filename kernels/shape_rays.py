"""Rays among the shapes of a simulation: poses of shapes from those of bodies, and answers by shape."""

from typing import Any

import warp as wp

from wrt.kernels.structs import kernel


@wp.struct
class Answers:
    """Answers of rays; arrays of length 0 are not wanted. Then the values on a miss."""

    distance: wp.array(dtype=wp.float32)
    normal: wp.array(dtype=wp.vec3)
    shape: wp.array(dtype=wp.int32)  # Found: the instance, -1 on a miss. Wanted: the simulation's index of its shape.
    no_distance: float
    no_normal: wp.vec3
    no_shape: int


@kernel
def place_shapes(shape_of: wp.array(dtype=wp.int32), shape_body: wp.array(dtype=wp.int32), shape_pose: wp.array(dtype=wp.transformf),
                 body_pose: wp.array(dtype=wp.transformf), poses: wp.array(dtype=wp.transformf), first: int):
    """Write the poses of instances. shape_pose: in the space of the shape's body; body -1 is the world."""
    i = first + wp.tid()
    shape = shape_of[i]
    pose = shape_pose[shape]
    if shape_body[shape] >= 0:
        pose = wp.transform_multiply(body_pose[shape_body[shape]], pose)
    poses[i] = pose


@kernel
def known_worlds(given: wp.array(dtype=wp.int32), count: int, world: wp.array(dtype=wp.int32), first: int):
    """Write the world of each ray: `count` for -1, which all worlds share. In other worlds that do not exist, rays miss."""
    i = first + wp.tid()
    world[i] = wp.where(given[i] == -1, count, wp.where(given[i] < count, given[i], -1))


@wp.func
def write(out: wp.array(dtype=Any), i: int, found: wp.array(dtype=Any), hit: bool, miss: Any):
    if out.shape[0] > 0:
        out[i] = miss
        if hit:
            out[i] = found[i]


@kernel
def write_answers(found: Answers, shape_of: wp.array(dtype=wp.int32), out: Answers, first: int):
    i = first + wp.tid()
    instance = found.shape[i]
    write(out.distance, i, found.distance, instance >= 0, out.no_distance)
    write(out.normal, i, found.normal, instance >= 0, out.no_normal)
    if out.shape.shape[0] > 0:
        out.shape[i] = out.no_shape
        if instance >= 0:
            out.shape[i] = shape_of[instance]
