"""Rays among the shapes of a simulation: poses of shapes from those of bodies, and answers by shape."""

import warp as wp

from wrt.kernels.structs import kernel, last_entry


@wp.struct
class Shapes:
    """Shapes in a structure over worlds; an instance is a shape in a world."""

    shape: wp.array(dtype=wp.int32)  # The simulation's index of each instance's shape.
    first_instance: wp.array(dtype=wp.int32)  # First instance of each world and, last, the number of instances.
    first_prim: wp.array(dtype=wp.int32)  # prim_id of each instance's first face, counted in its world.


@wp.struct
class Answers:
    """Answers of rays; arrays of length 0 are not wanted."""

    distance: wp.array(dtype=wp.float32)
    normal: wp.array(dtype=wp.vec3)
    shape: wp.array(dtype=wp.int32)


@wp.struct
class GeomRays:
    """Rays in rows of a world each. Those given have one row for all worlds or a row for each, and no mask and world."""

    origin: wp.array2d(dtype=wp.vec3)
    direction: wp.array2d(dtype=wp.vec3)
    exclude: wp.array2d(dtype=wp.int32)  # Body that the ray does not see, or -1; given as one row.
    mask: wp.array2d(dtype=wp.int32)
    world: wp.array2d(dtype=wp.int32)


@kernel
def place_shapes(shapes: Shapes, shape_body: wp.array(dtype=wp.int32), shape_pose: wp.array(dtype=wp.transformf),
                 body_pose: wp.array(dtype=wp.transformf), poses: wp.array(dtype=wp.transformf), first: int):
    """Write the poses of instances. shape_pose: in the space of the shape's body; body -1 is the world."""
    i = first + wp.tid()
    shape = shapes.shape[i]
    pose = shape_pose[shape]
    if shape_body[shape] >= 0:
        pose = wp.transform_multiply(body_pose[shape_body[shape]], pose)
    poses[i] = pose


@kernel
def place_geoms(geom_of: wp.array(dtype=wp.int32), count: int, hidden: wp.array(dtype=wp.int32), position: wp.array(dtype=wp.float32),
                turn: wp.array(dtype=wp.float32), poses: wp.array3d(dtype=wp.float32), first: int):
    """Write the poses of instances. geom_of: the geoms of a world; position, turn: 3 and 9 numbers for each of `count` geoms of each world.
    The pose of a hidden geom is NaN, so that a move removes its instance."""
    i = first + wp.tid()
    row = i % geom_of.shape[0]
    at = i / geom_of.shape[0] * count + geom_of[row]
    for k in range(3):
        for j in range(3):
            poses[i, k, j] = turn[9 * at + 3 * k + j]
        poses[i, k, 3] = wp.where(hidden[row] > 0, wp.nan, position[3 * at + k])


@kernel
def spread_rays(given: GeomRays, planes: wp.array(dtype=wp.int32), count: int, turn: wp.array(dtype=wp.float32), out: GeomRays, first: int):
    """Write the rays of all worlds. planes: geoms that only rays against their axis z see; the k-th has bit k + 1 of masks, and other
    geoms have bit 0. count, turn: see place_geoms."""
    i = first + wp.tid()
    world = i / out.origin.shape[1]
    ray = i % out.origin.shape[1]
    direction = given.direction[world % given.direction.shape[0], ray]
    mask = int(1)
    for k in range(planes.shape[0]):
        at = 9 * (world * count + planes[k])
        if wp.dot(direction, wp.vec3(turn[at + 2], turn[at + 5], turn[at + 8])) < 0.0:
            mask |= 2 << k
    out.origin[world, ray] = given.origin[world % given.origin.shape[0], ray]
    out.direction[world, ray] = direction
    out.exclude[world, ray] = given.exclude[0, ray]
    out.mask[world, ray] = mask
    out.world[world, ray] = world


@kernel
def known_worlds(given: wp.array(dtype=wp.int32), count: int, world: wp.array(dtype=wp.int32), first: int):
    """Write the world of each ray: `count` for -1, which all worlds share. In other worlds that do not exist, rays miss."""
    i = first + wp.tid()
    world[i] = wp.where(given[i] == -1, count, wp.where(given[i] < count, given[i], -1))


@kernel
def write_answers(shapes: Shapes, world: wp.array(dtype=wp.int32), found: Answers, out: Answers, first: int):
    """Write the answers that are wanted. found.shape: prim_ids."""
    i = first + wp.tid()
    prim_id = found.shape[i]
    if out.shape.shape[0] > 0:
        out.shape[i] = -1
        if prim_id >= 0:
            begin = shapes.first_instance[world[i]]
            out.shape[i] = shapes.shape[last_entry(shapes.first_prim, begin, shapes.first_instance[world[i] + 1], prim_id)]
    if out.distance.shape[0] > 0:
        out.distance[i] = wp.where(prim_id >= 0, found.distance[i], -1.0)
    if out.normal.shape[0] > 0:
        out.normal[i] = wp.where(prim_id >= 0, found.normal[i], wp.vec3())
