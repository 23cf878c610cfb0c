"""Points of hits with error bounds, normals, texture coordinates and ids, for ray queries.

The point is the intersection of the float32 ray with the plane of the triangle, whose corners are float32. An instance's corners are
transformed in float64. The computation is in float64, with a running error bound (Higham 2002, section 3.3). Results are float32.
kernels.shade.surface interpolates the corners by u and v instead. The error of u and v is large on needle-shaped triangles."""

from typing import Any

import warp as wp

from wrt.kernels.query import HitArrays, RayArrays, Worlds, load_hit
from wrt.kernels.shade.surface import Place, corners_at, instance_at, make_triangle_at, sphere_uv, triangle_point, triangle_uv
from wrt.kernels.structs import Hit, Instance, Surfaces, kernel, last_entry
from wrt.kernels.transforms import inverted

U32 = wp.constant(wp.float64(2.0**-24))  # Unit roundoff of float32.
U64 = wp.constant(wp.float64(2.0**-53))  # Unit roundoff of float64.
SAFETY = wp.constant(wp.float64(1.0 + 2.0**-20))  # Factor on error bounds, for their own rounding.
SMALLEST = wp.constant(wp.float64(2.0**-149))  # The smallest positive float32.


@wp.struct
class HitPlaces:
    """The results of hit_places, one entry for each hit, in world space. Arrays of length 0 stay empty. A miss has NaNs and ids -1."""

    point: wp.array(dtype=wp.vec3)
    error: wp.array(dtype=wp.vec3)  # Bound on the error of `point`, per axis.
    normal: wp.array(dtype=wp.vec3)  # Unit normal of the flat triangle or the sphere, on the outside.
    shading: wp.array(dtype=wp.vec3)  # Interpolated unit normal, on the outside.
    uv: wp.array(dtype=wp.vec2)  # Texture coordinates.
    face: wp.array(dtype=wp.int32)  # Index of the face in the object's mesh. Spheres have -1.
    object: wp.array(dtype=wp.int32)  # Index of the object in the scene. Spheres come after the objects.
    instance: wp.array(dtype=wp.int32)  # The user's id of the instance.
    material: wp.array(dtype=wp.int32)  # Index of the material.


@wp.struct
class ObjectIds:
    """The tables from primitives to the ids of objects and instances that users know."""

    first_prim: wp.array(dtype=wp.int32)  # First prim_id of each object or instance, then of each sphere.
    instance: wp.array(dtype=wp.int32)  # The user's id of each entry of Surfaces.instances; empty if it is the object's index.
    world_prim: wp.array(dtype=wp.int32)  # Over worlds: index of each world's first primitive among those of all worlds.
    world_object: wp.array(dtype=wp.int32)  # The same of objects.


@wp.struct
class PlanePoint:
    """A point on a plane or a sphere, its error bound per axis, and the normal there, of any length."""

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
    """Return the sum of the terms' absolute values, per axis, in to_world(i, p). The rounding error of to_world is proportional to it."""
    q = wp.vec4d(wp.abs(p[0]), wp.abs(p[1]), wp.abs(p[2]), wp.float64(1.0))
    return wp.vec3d(wp.dot(wp.abs(i.world_x), q), wp.dot(wp.abs(i.world_y), q), wp.dot(wp.abs(i.world_z), q))


@wp.func
def cross_size(a: wp.vec3d, b: wp.vec3d) -> wp.vec3d:
    """Return wp.cross(a, b) with plus in place of minus signs, for a, b >= 0."""
    return wp.vec3d(a[1] * b[2] + a[2] * b[1], a[2] * b[0] + a[0] * b[2], a[0] * b[1] + a[1] * b[0])


@wp.func
def on_plane(v0: wp.vec3d, v1: wp.vec3d, v2: wp.vec3d, off: wp.vec3d, origin: wp.vec3d, direction: wp.vec3d) -> PlanePoint:
    """Intersect a line with the plane through three corners. off: bound on the error of the corners, per axis.

    If the line is parallel to the plane within the rounding error, the result's error is infinite or NaN."""
    out = PlanePoint()
    e1 = v1 - v0
    e2 = v2 - v0
    out.normal = wp.cross(e1, e2)
    # An edge has the errors of two corners and one rounding. A component of the normal has two products and three roundings.
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
    offset = t * direction
    out.point = origin + offset
    out.error = t_error * wp.abs(direction) + wp.float64(2.0) * U64 * (wp.abs(origin) + wp.abs(offset))
    return out


@wp.func
def clamped_to_triangle(at: PlanePoint, v0: wp.vec3d, v1: wp.vec3d, v2: wp.vec3d) -> PlanePoint:
    """Move a point of the plane outside the triangle onto the triangle, and add the distance to the point's error.

    A ray that hits an edge may miss the triangle by a rounding error. Its point on the plane may then be far away."""
    e1 = v1 - v0
    e2 = v2 - v0
    from_v0 = at.point - v0
    square = wp.dot(at.normal, at.normal)
    u = wp.dot(at.normal, wp.cross(from_v0, e2)) / square
    v = wp.dot(at.normal, wp.cross(e1, from_v0)) / square
    if u >= wp.float64(0.0) and v >= wp.float64(0.0) and u + v <= wp.float64(1.0):
        return at
    u = wp.max(wp.float64(0.0), u)  # In this order of arguments -0 becomes 0 on both the CPU and CUDA.
    v = wp.max(wp.float64(0.0), v)
    over = wp.max(u + v, wp.float64(1.0))
    out = at
    out.point = v0 + (u / over) * e1 + (v / over) * e2
    out.error = at.error + wp.abs(at.point - out.point)
    return out


@wp.func
def on_triangle(surfaces: Surfaces, place: Place, u: float, v: float, origin: wp.vec3d, direction: wp.vec3d) -> PlanePoint:
    """Intersect a line with a face. The normal is on the outside, also for a mirrored instance. u, v: barycentrics of the hit."""
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
    # If the error exceeds the triangle, the ray runs along the plane: the point may be anywhere on the triangle.
    reach = wp.max(wp.max(wp.abs(v0 - middle), wp.abs(v1 - middle)), wp.abs(v2 - middle)) + off
    if not longest(at.error) <= longest(reach):
        at.point = middle
        at.error = reach
    return at


@wp.func
def on_sphere(sphere: wp.vec4, t: float, origin: wp.vec3d, direction: wp.vec3d) -> PlanePoint:
    """Intersect a line with a sphere. Of the two points, return the point on the side of the chord's middle where the hit's t is."""
    center = wp.vec3d(wp.float64(sphere[0]), wp.float64(sphere[1]), wp.float64(sphere[2]))
    radius = wp.float64(sphere[3])
    unit = direction / longest(direction)
    unit = unit / wp.length(unit)
    from_center = origin - center
    along = -wp.dot(from_center, unit)
    foot = from_center + along * unit  # The line's point nearest to the centre, relative to the centre.
    foot_error = wp.float64(16.0) * U64 * wp.length(from_center)
    square = radius * radius - wp.dot(foot, foot)
    square_error = foot_error * (wp.float64(2.0) * wp.length(foot) + foot_error) + wp.float64(8.0) * U64 * radius * radius
    half = wp.sqrt(wp.max(square, wp.float64(0.0)))
    # The square roots of a and b differ by at most sqrt(|a - b|), and by at most |a - b| over either root.
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


flat_triangle, placed_triangle = (make_triangle_at(smooth=True, uvs=False, instances=instances) for instances in (False, True))


@wp.func
def shading_normal(surfaces: Surfaces, place: Place, u: float, v: float, geometric: wp.vec3) -> wp.vec3:
    """Return the interpolated unit normal, on the outside; `geometric` if the corners have no normals."""
    t = flat_triangle(surfaces, place)
    if place.instance >= 0:
        t = placed_triangle(surfaces, place)
    n = (1.0 - u - v) * t.n0 + u * t.n1 + v * t.n2
    length = wp.length(n)
    if not length > 0.0:
        return geometric
    return wp.where(wp.dot(n, geometric) < 0.0, -n, n) / length


@wp.func
def place_of(surfaces: Surfaces, prim_id: int) -> Place:
    """Return the indices of a primitive's data. An index of an instance or material that does not exist is -1."""
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
def write(out: wp.array(dtype=Any), i: int, value: Any):
    """Store `value` in entry i, unless the array has length 0."""
    if out.shape[0] > 0:
        out[i] = value


@wp.func
def write_miss(out: HitPlaces, i: int):
    nothing = wp.vec3(wp.nan, wp.nan, wp.nan)
    write(out.point, i, nothing)
    write(out.error, i, nothing)
    write(out.normal, i, nothing)
    write(out.shading, i, nothing)
    write(out.uv, i, wp.vec2(wp.nan, wp.nan))
    write(out.face, i, -1)
    write(out.object, i, -1)
    write(out.instance, i, -1)
    write(out.material, i, -1)


@wp.func
def write_ids(surfaces: Surfaces, object_ids: ObjectIds, place: Place, world: int, prim_id: int, out: HitPlaces, i: int):
    if out.face.shape[0] + out.object.shape[0] + out.instance.shape[0] > 0:
        index = last_entry(object_ids.first_prim, 0, object_ids.first_prim.shape[0], prim_id)
        write(out.face, i, wp.where(prim_id < surfaces.n_triangles, prim_id - object_ids.first_prim[index], -1))
        if out.instance.shape[0] > 0:
            out.instance[i] = index
            if object_ids.instance.shape[0] > 0:
                out.instance[i] = object_ids.instance[place.instance]
        if object_ids.world_object.shape[0] > 0:
            index = index - object_ids.world_object[world]
        write(out.object, i, index)
    write(out.material, i, place.material)


@wp.func
def write_point(at: PlanePoint, out: HitPlaces, i: int):
    least = wp.vec3d(SMALLEST, SMALLEST, SMALLEST)
    write(out.point, i, wp.vec3(at.point))
    write(out.error, i, wp.vec3(SAFETY * (at.error + U32 * wp.abs(at.point)) + least))


@wp.func
def ids_of(out: HitPlaces) -> int:
    """Return the sum of the lengths of the arrays of ids."""
    return out.face.shape[0] + out.object.shape[0] + out.instance.shape[0] + out.material.shape[0]


@wp.func
def points_of(out: HitPlaces) -> int:
    """Return the sum of the lengths of the other arrays, which need the rays."""
    return out.point.shape[0] + out.error.shape[0] + out.normal.shape[0] + out.shading.shape[0] + out.uv.shape[0]


@wp.func
def write_places(surfaces: Surfaces, object_ids: ObjectIds, world: int, start: wp.vec3, way: wp.vec3, hit: Hit, out: HitPlaces, i: int):
    """Write the results of a hit of the ray from `start` in the direction `way`. hit.prim_id counts within its world."""
    points = points_of(out)
    if ids_of(out) + points == 0:
        return
    prim_id = hit.prim_id
    if prim_id >= 0 and object_ids.world_prim.shape[0] > 0:
        prim_id += object_ids.world_prim[world]
    count = surfaces.n_triangles + surfaces.spheres.shape[0]
    if prim_id < 0 or prim_id >= count:
        write_miss(out, i)
        return
    place = place_of(surfaces, prim_id)
    write_ids(surfaces, object_ids, place, world, prim_id, out, i)
    if points == 0:
        return
    origin = wp.vec3d(start)
    direction = wp.vec3d(way)
    if prim_id >= surfaces.n_triangles:
        on_ball = on_sphere(surfaces.spheres[prim_id - surfaces.n_triangles], hit.t, origin, direction)
        write_point(on_ball, out, i)
        normal = wp.vec3(wp.normalize(on_ball.normal))
        write(out.normal, i, normal)
        write(out.shading, i, normal)
        if out.uv.shape[0] > 0:
            out.uv[i] = sphere_uv(normal)
    else:
        at = on_triangle(surfaces, place, hit.u, hit.v, origin, direction)
        write_point(at, out, i)
        normal = wp.vec3(wp.normalize(at.normal / longest(at.normal)))
        write(out.normal, i, normal)
        if out.shading.shape[0] > 0:
            out.shading[i] = shading_normal(surfaces, place, hit.u, hit.v, normal)
        if out.uv.shape[0] > 0:
            out.uv[i] = triangle_uv(surfaces, place.face, hit.u, hit.v)


@kernel
def place_instances(rows: wp.array(dtype=wp.int32), places: wp.array(dtype=wp.vec4d), instances: wp.array(dtype=Instance)):
    """Write the matrix of each instance, the three rows of `places` from 3 * rows[i] on; -1: its matrix stays."""
    i = wp.tid()
    if rows[i] < 0:
        return
    x, y, z = places[3 * rows[i]], places[3 * rows[i] + 1], places[3 * rows[i] + 2]
    linear = wp.matrix_from_rows(wp.vec3d(x[0], x[1], x[2]), wp.vec3d(y[0], y[1], y[2]), wp.vec3d(z[0], z[1], z[2]))
    inverse = inverted(linear)
    size = wp.max(wp.max(longest(inverse[0]), longest(inverse[1])), longest(inverse[2]))  # squares of normals must not overflow
    instances[i].world_x = x
    instances[i].world_y = y
    instances[i].world_z = z
    instances[i].normal_x = wp.vec3(inverse[0] / size)
    instances[i].normal_y = wp.vec3(inverse[1] / size)
    instances[i].normal_z = wp.vec3(inverse[2] / size)
    instances[i].handedness = wp.where(wp.determinant(linear) < wp.float64(0.0), -1.0, 1.0)


@kernel
def hit_places(surfaces: Surfaces, object_ids: ObjectIds, rays: RayArrays, worlds: Worlds, hits: HitArrays, out: HitPlaces, first: int):
    """Write the results of the hits first .. first + dim - 1, for the launch size dim. An invalid prim_id is a miss."""
    i = first + wp.tid()
    hit = Hit()
    hit.prim_id = hits.prim_id[i]
    origin = wp.vec3()
    direction = wp.vec3()
    if rays.origin.shape[0] > 0:
        origin = rays.origin[i]
        direction = rays.direction[i]
        hit = load_hit(hits, i)
    world = int(0)
    if worlds.id.shape[0] > 0:
        world = worlds.id[i]
    write_places(surfaces, object_ids, world, origin, direction, hit, out, i)
