"""Rays of sensors, made where they are traced, from the directions in a sensor's frame and from poses; and pictures of their hits.

The arithmetic is in float64, rounded to float32 once, so that a ray has the same bits on each device."""

from typing import Any

import warp as wp

from wrt.kernels.query import HitArrays, WorldRays, Worlds, direction_scale, in_world, load_hit, scaled_ray
from wrt.kernels.shade.hit_points import HitPlaces, ObjectIds, ids_of, points_of, write, write_places
from wrt.kernels.structs import Hit, Surfaces, kernel, query_kernel
from wrt.kernels.transforms import Affine, Transforms, affine_of, times

SIDE = 4  # Pixels of a square of 16 rays, which are a packet (wide.layout.LANES).
SQUARE = wp.constant(SIDE * SIDE)
RAYS = wp.constant(512)  # of a thread on the CPU: few, and the copies of its arguments take long


@wp.struct
class Sensors:
    """Sensors at poses: images of rows x columns pixels. A frame is a table of directions; there is one, or one for each image.

    With `across` and `down`, a direction is (down[0] across[0] + down[2], down[0] across[1] + down[3], down[1])."""

    rows: int
    columns: int
    frames: int
    tiled: bool  # Rays are in the order of squares of SIDE x SIDE pixels; else in the order of pixels.
    axis: int  # Axis of the frame that measures depth.
    own: int  # The pose of a pixel is image * own + row * row_step + column * column_step.
    row_step: int
    column_step: int
    across: wp.array(dtype=wp.vec2d)
    down: wp.array(dtype=wp.vec4d)
    directions: wp.array(dtype=wp.vec3)
    poses: Transforms
    origin: wp.vec3d  # Point of the world that is 0 for the structure.
    t_max: float
    worlds: Worlds  # Index into `id`: image * world_image + pose * world_pose; without `id`, the world itself. Without `root`: no worlds.
    world_image: int
    world_pose: int


@wp.struct
class Images:
    """Pictures of hits, by pixel; arrays of length 0 are not written. See wrt.sensors.Images."""

    hits: HitArrays
    places: HitPlaces
    depth: wp.array(dtype=wp.float32)
    range: wp.array(dtype=wp.float32)
    world: wp.array(dtype=wp.int32)
    origin: wp.array(dtype=wp.vec3)
    direction: wp.array(dtype=wp.vec3)


@wp.struct
class Pixel:
    index: int  # In the pictures.
    image: int
    row: int
    column: int


@wp.struct
class View:
    """What the pixels of one pose share."""

    image: int
    pose: int
    world: int
    map: Affine
    origin: wp.vec3


@wp.func
def pixel_of(sensors: Sensors, i: int) -> Pixel:
    """Return the pixel of ray i."""
    at = Pixel()
    line = i / sensors.columns
    at.column = i - line * sensors.columns
    if sensors.tiled:
        band = i / (SIDE * sensors.columns)
        square = i / SQUARE - band * (sensors.columns / SIDE)
        line = SIDE * band + i % SQUARE / SIDE
        at.column = SIDE * square + i % SIDE
    at.image = line / sensors.rows
    at.row = line - at.image * sensors.rows
    at.index = line * sensors.columns + at.column
    return at


@wp.func
def pixel_after(sensors: Sensors, at: Pixel, i: int) -> Pixel:
    """Return the pixel of ray i, where `at` is that of ray i - 1: within a square without the divisions of `pixel_of`."""
    if i % SQUARE == 0:
        return pixel_of(sensors, i)
    out = at
    out.column += 1
    if sensors.tiled:
        if i % SIDE == 0:
            out.column = at.column - (SIDE - 1)
            out.row += 1
    elif out.column == sensors.columns:
        out.column = 0
        out.row += 1
        if out.row == sensors.rows:
            out.row = 0
            out.image += 1
    out.index = (out.image * sensors.rows + out.row) * sensors.columns + out.column
    return out


@wp.func
def pose_of(sensors: Sensors, at: Pixel) -> int:
    return at.image * sensors.own + at.row * sensors.row_step + at.column * sensors.column_step


@wp.func
def view_of(sensors: Sensors, at: Pixel) -> View:
    view = View()
    view.image = at.image
    view.pose = pose_of(sensors, at)
    view.map = affine_of(sensors.poses, view.pose)
    view.origin = wp.vec3(view.map.t - sensors.origin)
    view.world = at.image * sensors.world_image + view.pose * sensors.world_pose
    if sensors.worlds.id.shape[0] > 0:
        view.world = sensors.worlds.id[view.world]
    return view


@wp.func
def other_view(sensors: Sensors, at: Pixel, view: View) -> bool:
    """Return whether a pixel does not have this view."""
    return at.image != view.image or pose_of(sensors, at) != view.pose


@wp.func
def direction_of(sensors: Sensors, at: Pixel, view: View) -> wp.vec3:
    """Return the direction of a pixel's ray in world space."""
    frame = wp.where(sensors.frames > 1, at.image, 0)
    if sensors.directions.shape[0] > 0:
        return wp.vec3(times(view.map.a, wp.vec3d(sensors.directions[(frame * sensors.rows + at.row) * sensors.columns + at.column])))
    c = sensors.across[frame * sensors.columns + at.column]
    r = sensors.down[frame * sensors.rows + at.row]
    return wp.vec3(times(view.map.a, wp.vec3d(r[0] * c[0] + r[2], r[0] * c[1] + r[3], r[1])))


@wp.func
def show(axis: int, i: int, view: View, direction: wp.vec3, hit: Hit, images: Images):
    """Write pixel i, except images.places. direction: of the ray; hit.t is in units of it."""
    write(images.hits.t, i, hit.t)
    write(images.hits.u, i, hit.u)
    write(images.hits.v, i, hit.v)
    write(images.hits.prim_id, i, hit.prim_id)
    write(images.world, i, wp.where(hit.prim_id < 0, -1, view.world))
    write(images.origin, i, view.origin)
    write(images.direction, i, direction)
    way = wp.vec3d(direction)
    if images.depth.shape[0] > 0:
        forward = wp.vec3d(view.map.a[0, axis], view.map.a[1, axis], view.map.a[2, axis])
        images.depth[i] = wp.where(hit.prim_id < 0, float(wp.inf), float(wp.float64(hit.t) * wp.dot(way, forward)))
    if images.range.shape[0] > 0:
        images.range[i] = wp.where(hit.prim_id < 0, float(wp.inf), float(wp.float64(hit.t) * wp.length(way)))


@kernel
def make_rays(sensors: Sensors, rays: WorldRays, first: int, end: int):
    """Make the rays first .. end - 1 in rays[0 .. end - first - 1]; `first` is a multiple of SQUARE."""
    begin = first + RAYS * wp.tid()
    at = pixel_of(sensors, begin)
    view = view_of(sensors, at)
    for i in range(begin, wp.min(begin + RAYS, end)):
        at = pixel_after(sensors, at, i)
        if other_view(sensors, at, view):
            view = view_of(sensors, at)
        j = i - first
        rays.origin[j] = view.origin
        rays.direction[j] = direction_of(sensors, at, view)
        rays.t_min[j] = 0.0
        rays.t_max[j] = sensors.t_max
        write(rays.world, j, view.world)


@kernel
def show_hits(surfaces: Surfaces, object_ids: ObjectIds, sensors: Sensors, images: Images, rays: WorldRays, hits: HitArrays, first: int,
              end: int):
    """Write the pixels of the rays first .. end - 1, from rays and hits[0 .. end - first - 1]."""
    begin = first + RAYS * wp.tid()
    at = pixel_of(sensors, begin)
    view = view_of(sensors, at)
    places = ids_of(images.places) + points_of(images.places) > 0  # write_places is large: a call takes long
    for i in range(begin, wp.min(begin + RAYS, end)):
        at = pixel_after(sensors, at, i)
        if other_view(sensors, at, view):
            view = view_of(sensors, at)
        hit = load_hit(hits, i - first)
        show(sensors.axis, at.index, view, rays.direction[i - first], hit, images)
        if places:
            write_places(surfaces, object_ids, view.world, view.origin, rays.direction[i - first], hit, images.places, at.index)


def make_sensor_kernel(accel_struct: Any, traverse: Any) -> Any:
    """Make the kernel that makes, traces and shows the rays first .. first + dim - 1, a ray per thread."""

    @query_kernel
    def trace_sensors(accel: accel_struct, surfaces: Surfaces, object_ids: ObjectIds, sensors: Sensors, images: Images, first: int):
        at = pixel_of(sensors, first + wp.tid())
        view = view_of(sensors, at)
        direction = direction_of(sensors, at, view)
        ray = scaled_ray(view.origin, direction, 0.0, sensors.t_max)
        if sensors.worlds.root.shape[0] > 0:
            ray = in_world(ray, sensors.worlds.root, view.world)
        hit = traverse(accel, surfaces, ray)
        hit.t = hit.t * direction_scale(direction)
        show(sensors.axis, at.index, view, direction, hit, images)
        write_places(surfaces, object_ids, view.world, view.origin, direction, hit, images.places, at.index)

    return trace_sensors
