"""Points of hits with error bounds, normals, texture coordinates and ids, for ray queries.

The point is the intersection of the given float32 ray with the plane of the triangle. Corners are as given; an instance's map is
float64. The computation is in float64, with a running error bound (Higham 2002, section 3.3), and rounded to float32 at the end.
Barycentric coordinates, which kernels.shade.surface starts from, carry the error of u and v, which is large on needles."""

import warp as wp

from wrt.kernels.query import HitArrays, RayArrays
from wrt.kernels.shade.surface import Place, corners_at, instance_at, sphere_uv, triangle_point, triangle_uv, world_normal
from wrt.kernels.structs import Instance, Surfaces, kernel

U32 = wp.constant(wp.float64(2.0**-24))  # Unit roundoffs.
U64 = wp.constant(wp.float64(2.0**-53))
SAFETY = wp.constant(wp.float64(1.0 + 2.0**-20))  # For the rounding of the bounds themselves.
SMALLEST = wp.constant(wp.float64(2.0**-149))  # Of float32.


@wp.struct
class HitPlaces:
    """The results, one entry a hit. An array of length 0 is not asked for. A miss is NaN, and -1 among the ids."""

    point: wp.array(dtype=wp.vec3)  # World space, as all vectors.
    error: wp.array(dtype=wp.vec3)  # Bound for each axis.
    normal: wp.array(dtype=wp.vec3)
    shading: wp.array(dtype=wp.vec3)
    uv: wp.array(dtype=wp.vec2)
    object: wp.array(dtype=wp.int32)
    instance: wp.array(dtype=wp.int32)
    material: wp.array(dtype=wp.int32)


@wp.struct
class ObjectIds:
    """The ids that users know."""

    first_prim: wp.array(dtype=wp.int32)  # Of each object and each sphere, in their order.
    instance: wp.array(dtype=wp.int32)  # The user's id of each of Surfaces.instances.


@wp.struct
class PlanePoint:
    """A point, its error bound per axis, and the normal of its plane, of any length."""

    point: wp.vec3d
    error: wp.vec3d
    normal: wp.vec3d


@wp.func
def longest(v: wp.vec3d) -> wp.float64:
    return wp.max(wp.max(wp.abs(v[0]), wp.abs(v[1])), wp.abs(v[2]))


@wp.func
def to_world(i: Instance, p: wp.vec3d, w: wp.float64) -> wp.vec3d:
    q = wp.vec4d(p[0], p[1], p[2], w)
    return wp.vec3d(wp.dot(i.world_x, q), wp.dot(i.world_y, q), wp.dot(i.world_z, q))


@wp.func
def to_world_size(i: Instance, p: wp.vec3d) -> wp.vec3d:
    """Return the sums of the absolute terms of `to_world`, to which its rounding error is proportional."""
    q = wp.vec4d(wp.abs(p[0]), wp.abs(p[1]), wp.abs(p[2]), wp.float64(1.0))
    return wp.vec3d(wp.dot(wp.abs(i.world_x), q), wp.dot(wp.abs(i.world_y), q), wp.dot(wp.abs(i.world_z), q))


@wp.func
def cross_size(a: wp.vec3d, b: wp.vec3d) -> wp.vec3d:
    """Add all terms of wp.cross; a, b >= 0."""
    return wp.vec3d(a[1] * b[2] + a[2] * b[1], a[2] * b[0] + a[0] * b[2], a[0] * b[1] + a[1] * b[0])


@wp.func
def on_plane(v0: wp.vec3d, v1: wp.vec3d, v2: wp.vec3d, off: wp.vec3d, origin: wp.vec3d, direction: wp.vec3d) -> PlanePoint:
    """Intersect a line with the plane through three corners, which are known to `off` per axis.

    If rounding leaves open whether they intersect, the error is infinite or NaN."""
    out = PlanePoint()
    e1 = v1 - v0
    e2 = v2 - v0
    out.normal = wp.cross(e1, e2)
    # An edge is off by two corners and its own rounding. A component of the normal has two products and three roundings.
    slack = wp.float64(2.0) * off + U64 * wp.max(wp.abs(e1), wp.abs(e2))
    size = cross_size(wp.abs(e1), wp.abs(e2))
    normal_error = cross_size(slack, wp.abs(e1) + wp.abs(e2) + slack) + wp.float64(4.0) * U64 * size

    to_plane = v0 - origin
    to_plane_error = off + U64 * wp.abs(to_plane)
    height = wp.dot(out.normal, to_plane)
    height_error = (wp.dot(normal_error, wp.abs(to_plane) + to_plane_error) + wp.dot(wp.abs(out.normal), to_plane_error)
                    + wp.float64(4.0) * U64 * wp.dot(wp.abs(out.normal), wp.abs(to_plane)))
    slope = wp.dot(out.normal, direction)
    slope_error = wp.dot(normal_error + wp.float64(4.0) * U64 * wp.abs(out.normal), wp.abs(direction))
    if not wp.abs(slope) > wp.float64(2.0) * slope_error:
        out.error = wp.vec3d(wp.float64(wp.inf), wp.float64(wp.inf), wp.float64(wp.inf))
        return out
    t = height / slope
    t_error = (height_error + wp.abs(t) * slope_error) / (wp.abs(slope) - slope_error) + wp.float64(2.0) * U64 * wp.abs(t)
    way = t * direction
    out.point = origin + way
    out.error = t_error * wp.abs(direction) + wp.float64(2.0) * U64 * (wp.abs(origin) + wp.abs(way))
    return out


@wp.func
def clamped_to_triangle(at: PlanePoint, v0: wp.vec3d, v1: wp.vec3d, v2: wp.vec3d) -> PlanePoint:
    """Move a point beside the triangle onto it, and add the distance to its error.

    A ray at an edge, or on an outline, may pass its triangle by a rounding error and then meet the plane far away."""
    e1 = v1 - v0
    e2 = v2 - v0
    way = at.point - v0
    square = wp.dot(at.normal, at.normal)
    u = wp.dot(at.normal, wp.cross(way, e2)) / square
    v = wp.dot(at.normal, wp.cross(e1, way)) / square
    if u >= wp.float64(0.0) and v >= wp.float64(0.0) and u + v <= wp.float64(1.0):
        return at
    u = wp.max(wp.float64(0.0), u)  # In this order -0 becomes 0 on the CPU as on CUDA.
    v = wp.max(wp.float64(0.0), v)
    over = wp.max(u + v, wp.float64(1.0))
    out = at
    out.point = v0 + (u / over) * e1 + (v / over) * e2
    out.error = at.error + wp.abs(at.point - out.point)
    return out


@wp.func
def on_triangle(surfaces: Surfaces, place: Place, u: float, v: float, origin: wp.vec3d, direction: wp.vec3d) -> PlanePoint:
    """Return the point on a face; its normal points outside, also on a mirrored instance."""
    t = corners_at(surfaces, place.face)
    v0 = wp.vec3d(t.v0)
    v1 = wp.vec3d(t.v1)
    v2 = wp.vec3d(t.v2)
    middle = wp.vec3d(triangle_point(t, u, v))
    off = wp.vec3d()
    side = wp.float64(1.0)
    if place.instance >= 0:
        instance = surfaces.instances[place.instance]
        size = wp.max(wp.max(to_world_size(instance, v0), to_world_size(instance, v1)), to_world_size(instance, v2))
        off = wp.float64(5.0) * U64 * size
        v0 = to_world(instance, v0, wp.float64(1.0))
        v1 = to_world(instance, v1, wp.float64(1.0))
        v2 = to_world(instance, v2, wp.float64(1.0))
        middle = to_world(instance, middle, wp.float64(1.0))
        side = wp.float64(instance.handedness)
    at = clamped_to_triangle(on_plane(v0, v1, v2, off, origin, direction), v0, v1, v2)
    at.normal = side * at.normal
    # To rounding, the ray runs along the plane: its point may be anywhere on the triangle.
    reach = wp.max(wp.max(wp.abs(v0 - middle), wp.abs(v1 - middle)), wp.abs(v2 - middle)) + off
    if not longest(at.error) <= longest(reach):
        at.point = middle
        at.error = reach
    return at


@wp.func
def on_sphere(sphere: wp.vec4, t: float, origin: wp.vec3d, direction: wp.vec3d) -> PlanePoint:
    """Return the line's point on the sphere that is on t's side of the middle."""
    center = wp.vec3d(wp.float64(sphere[0]), wp.float64(sphere[1]), wp.float64(sphere[2]))
    radius = wp.float64(sphere[3])
    unit = direction / longest(direction)
    unit = unit / wp.length(unit)
    way = origin - center
    along = -wp.dot(way, unit)
    foot = way + along * unit  # The line's point nearest to the centre.
    foot_error = wp.float64(16.0) * U64 * wp.length(way)
    square = radius * radius - wp.dot(foot, foot)
    square_error = foot_error * (wp.float64(2.0) * wp.length(foot) + foot_error) + wp.float64(8.0) * U64 * radius * radius
    half = wp.sqrt(wp.max(square, wp.float64(0.0)))
    # Roots of two numbers d apart differ by at most sqrt(d), and by at most d over either root.
    half_error = wp.sqrt(square_error)
    if half > half_error:
        half_error = square_error / half
    if wp.float64(t) * wp.dot(direction, unit) < along:
        half = -half
    out = PlanePoint()
    out.normal = foot + half * unit
    out.point = center + out.normal
    error = half_error + foot_error + wp.float64(8.0) * U64 * radius
    out.error = wp.vec3d(error, error, error) + U64 * wp.abs(out.point)
    return out


@wp.func
def shading_normal(surfaces: Surfaces, place: Place, u: float, v: float, geometric: wp.vec3) -> wp.vec3:
    """Return the interpolated normal, on the outside; the geometric one if the corners have none."""
    face = surfaces.faces[place.face]
    n0 = surfaces.normals[face[0]]
    n1 = surfaces.normals[face[1]]
    n2 = surfaces.normals[face[2]]
    if place.instance >= 0:
        instance = surfaces.instances[place.instance]
        n0 = world_normal(instance, n0)
        n1 = world_normal(instance, n1)
        n2 = world_normal(instance, n2)
    n = (1.0 - u - v) * n0 + u * n1 + v * n2
    length = wp.length(n)
    if not length > 0.0:
        return geometric
    return wp.where(wp.dot(n, geometric) < 0.0, -n, n) / length


@wp.func
def last_entry(first: wp.array(dtype=wp.int32), prim_id: int) -> int:
    """Return the last entry that does not begin behind prim_id. Entries without primitives begin where the next one does."""
    low = int(0)
    high = int(first.shape[0])
    while high - low > 1:
        middle = (low + high) / 2
        if first[middle] <= prim_id:
            low = middle
        else:
            high = middle
    return low


@wp.func
def place_of(surfaces: Surfaces, prim_id: int) -> Place:
    """Return the data as kernels.shade.surface.make_place_of does, with or without instances (-1); material -1 without
    materials."""
    place = Place()
    place.face = prim_id
    place.instance = -1
    index = prim_id
    if surfaces.instances.shape[0] > 0:
        place.instance = instance_at(surfaces, prim_id)
        run = surfaces.instances[place.instance]
        place.face = run.first_face + prim_id - run.first_prim
        index = run.first_material + run.material_step * (prim_id - run.first_prim)
    place.material = -1
    if index < surfaces.prim_material.shape[0]:
        place.material = surfaces.prim_material[index]
    return place


@wp.func
def write_miss(out: HitPlaces, i: int):
    nothing = wp.vec3(wp.nan, wp.nan, wp.nan)
    if out.point.shape[0] > 0:
        out.point[i] = nothing
    if out.error.shape[0] > 0:
        out.error[i] = nothing
    if out.normal.shape[0] > 0:
        out.normal[i] = nothing
    if out.shading.shape[0] > 0:
        out.shading[i] = nothing
    if out.uv.shape[0] > 0:
        out.uv[i] = wp.vec2(wp.nan, wp.nan)
    if out.object.shape[0] > 0:
        out.object[i] = -1
    if out.instance.shape[0] > 0:
        out.instance[i] = -1
    if out.material.shape[0] > 0:
        out.material[i] = -1


@wp.func
def write_ids(surfaces: Surfaces, object_ids: ObjectIds, place: Place, prim_id: int, out: HitPlaces, i: int):
    if out.object.shape[0] > 0:
        out.object[i] = last_entry(object_ids.first_prim, prim_id)
    if out.instance.shape[0] > 0:
        out.instance[i] = object_ids.instance[place.instance]
    if out.material.shape[0] > 0:
        out.material[i] = place.material


@wp.func
def write_point(at: PlanePoint, out: HitPlaces, i: int):
    point = wp.vec3(at.point)
    if out.point.shape[0] > 0:
        out.point[i] = point
    if out.error.shape[0] > 0:
        least = wp.vec3d(SMALLEST, SMALLEST, SMALLEST)
        out.error[i] = wp.vec3(SAFETY * (at.error + U32 * wp.abs(at.point)) + least)


@wp.func
def write_interpolated(surfaces: Surfaces, place: Place, u: float, v: float, normal: wp.vec3, out: HitPlaces, i: int):
    if out.shading.shape[0] > 0:
        out.shading[i] = shading_normal(surfaces, place, u, v, normal)
    if out.uv.shape[0] > 0:
        out.uv[i] = triangle_uv(surfaces, place.face, u, v)


@wp.func
def write_interpolated_on_sphere(normal: wp.vec3, out: HitPlaces, i: int):
    if out.shading.shape[0] > 0:
        out.shading[i] = normal
    if out.uv.shape[0] > 0:
        out.uv[i] = sphere_uv(normal)


@kernel
def hit_places(surfaces: Surfaces, object_ids: ObjectIds, rays: RayArrays, hits: HitArrays, out: HitPlaces, first: int):
    """Write the results of hits first .. first + dim - 1. A prim_id that is none of the surfaces' is a miss."""
    i = first + wp.tid()
    prim_id = hits.prim_id[i]
    count = surfaces.n_triangles + surfaces.spheres.shape[0]
    if prim_id < 0 or prim_id >= count:
        write_miss(out, i)
        return
    place = place_of(surfaces, prim_id)
    write_ids(surfaces, object_ids, place, prim_id, out, i)
    if out.point.shape[0] + out.error.shape[0] + out.normal.shape[0] + out.shading.shape[0] + out.uv.shape[0] == 0:
        return
    origin = wp.vec3d(rays.origin[i])
    direction = wp.vec3d(rays.direction[i])
    if prim_id >= surfaces.n_triangles:
        on_ball = on_sphere(surfaces.spheres[prim_id - surfaces.n_triangles], hits.t[i], origin, direction)
        write_point(on_ball, out, i)
        normal = wp.vec3(wp.normalize(on_ball.normal))
        if out.normal.shape[0] > 0:
            out.normal[i] = normal
        write_interpolated_on_sphere(normal, out, i)
    else:
        at = on_triangle(surfaces, place, hits.u[i], hits.v[i], origin, direction)
        write_point(at, out, i)
        normal = wp.vec3(wp.normalize(at.normal / longest(at.normal)))
        if out.normal.shape[0] > 0:
            out.normal[i] = normal
        write_interpolated(surfaces, place, hits.u[i], hits.v[i], normal, out, i)
