"""From a hit to the surface there: point with error bound, normals, texture coordinates, and where new rays start."""

from typing import Any

import warp as wp

from wrt.kernels.shade.elementary import acos, atan2
from wrt.kernels.shade.sampling import PI, TWO_PI, frame_x, where_vec3
from wrt.kernels.structs import Hit, Instance, Ray, Surfaces, gamma, largest, lift, unit

MIN_COSINE = wp.constant(1.0e-3)  # the least cosine of a shading normal with the way to the eye


@wp.struct
class Surface:
    """A point on a surface, in world space.

    error: bound on the point's rounding error, per axis; geometric: unit normal of the flat triangle (or the sphere), on the
    ray's side; shading: the interpolated one, on that side too; front: the ray comes from outside (counter-clockwise);
    exclude_plus_one: 1 + the triangle that rays from here need not be tested against, 0 on a sphere.
    tangent: unit vector along growing u, not necessarily at right angles to the normal; bitangent_sign: -1 where the texture
    is mirrored, else 1. u, v: texture coordinates, two numbers since a vector of two would not run in lanes.
    """

    point: wp.vec3
    error: wp.vec3
    geometric: wp.vec3
    shading: wp.vec3
    tangent: wp.vec3
    bitangent_sign: float
    u: float
    v: float
    material: int
    front: int
    exclude_plus_one: int


@wp.func
def next_away(x: float, direction: float) -> float:
    """A float32 at least one step from x on the side that direction's sign says."""
    step = wp.abs(x) * wp.static(2.0**-23) + 1.0e-45
    return wp.where(direction > 0.0, x + step, wp.where(direction < 0.0, x - step, x))


@wp.func
def spawn_point(point: wp.vec3, error: wp.vec3, normal: wp.vec3, direction: wp.vec3) -> wp.vec3:
    """The origin of a ray that leaves towards `direction`: outside the box of the point's error, on that side of the surface.

    The smallest such step along the normal, rounded away (Pharr, Jakob and Humphreys 2023, "Physically Based Rendering",
    section 6.8.6); it scales with the coordinates, which a fixed epsilon does not.
    """
    distance = wp.dot(wp.abs(normal), error)
    offset = wp.where(wp.dot(direction, normal) < 0.0, -distance, distance) * normal
    p = point + offset
    return wp.vec3(next_away(p[0], offset[0]), next_away(p[1], offset[1]), next_away(p[2], offset[2]))


@wp.struct
class Place:
    """Where a primitive's data are: its face in Surfaces.faces (of a sphere: unread), its material, and its instance."""

    face: int
    material: int
    instance: int


@wp.func
def instance_at(surfaces: Surfaces, prim_id: int) -> int:
    """The last instance that does not begin behind a primitive: the one that it is of."""
    low = int(0)
    high = int(surfaces.instances.shape[0])
    while high - low > 1:
        middle = (low + high) / 2
        if surfaces.instances[middle].first_prim <= prim_id:
            low = middle
        else:
            high = middle
    return low


@wp.func
def sphere_uv(n: wp.vec3) -> wp.vec2:
    """Longitude and latitude of a unit normal, in a picture that goes round the sphere once."""
    return wp.vec2(0.5 + atan2(-n[2], n[0]) / TWO_PI, acos(wp.clamp(n[1], -1.0, 1.0)) / PI)


def make_place_of(instances: bool) -> Any:
    """From a prim_id to its data."""

    @wp.func
    def place_of(surfaces: Surfaces, prim_id: int) -> Place:
        place = Place()
        if wp.static(instances):
            place.instance = instance_at(surfaces, prim_id)
            instance = surfaces.instances[place.instance]
            local = prim_id - instance.first_prim
            place.face = instance.first_face + local
            place.material = surfaces.prim_material[instance.first_material + instance.material_step * local]
        else:
            place.face = prim_id
            place.material = surfaces.prim_material[prim_id]
        return place

    return place_of


@wp.func
def transformed(row_x: wp.vec4d, row_y: wp.vec4d, row_z: wp.vec4d, v: wp.vec3, w: float) -> wp.vec3:
    """A point (w = 1) or a direction (w = 0) under an affine map: float64, rounded once."""
    p = wp.vec4d(wp.float64(v[0]), wp.float64(v[1]), wp.float64(v[2]), wp.float64(w))
    return wp.vec3(float(wp.dot(row_x, p)), float(wp.dot(row_y, p)), float(wp.dot(row_z, p)))


@wp.func
def world_point(i: Instance, p: wp.vec3) -> wp.vec3:
    return transformed(i.world_x, i.world_y, i.world_z, p, 1.0)


@wp.func
def world_direction(i: Instance, d: wp.vec3) -> wp.vec3:
    return transformed(i.world_x, i.world_y, i.world_z, d, 0.0)


@wp.func
def world_normal(i: Instance, n: wp.vec3) -> wp.vec3:
    """Unit length; the outside stays outside, also of a mirrored instance. Zero stays zero."""
    return wp.normalize(n[0] * i.normal_x + n[1] * i.normal_y + n[2] * i.normal_z)


@wp.func
def world_error(i: Instance, p: wp.vec3, error: wp.vec3, world: wp.vec3) -> wp.vec3:
    """Bound on the error of `world`, the image of p, which is off by `error`; per axis.

    Two more roundings in the mesh's space are for the next ray, whose origin is taken back there and rounded.
    """
    e = error + gamma(2.0) * wp.abs(p)
    return transformed(wp.abs(i.world_x), wp.abs(i.world_y), wp.abs(i.world_z), e, 0.0) + gamma(2.0) * wp.abs(world)


@wp.struct
class Triangle:
    """Its corners and, where a scene has them, the normals and texture coordinates (u of the three corners, and v) there. Corners
    are in the space of its mesh, normals in the world."""

    v0: wp.vec3
    v1: wp.vec3
    v2: wp.vec3
    n0: wp.vec3
    n1: wp.vec3
    n2: wp.vec3
    u: wp.vec3
    v: wp.vec3


@wp.func
def corners_at(surfaces: Surfaces, index: int) -> Triangle:
    """Face `index` without attributes."""
    face = surfaces.faces[index]
    triangle = Triangle()
    triangle.v0 = surfaces.vertices[face[0]]
    triangle.v1 = surfaces.vertices[face[1]]
    triangle.v2 = surfaces.vertices[face[2]]
    return triangle


def make_triangle_at(smooth: bool, uvs: bool, instances: bool) -> Any:
    """With only those attributes that the scene has."""

    @wp.func
    def triangle_at(surfaces: Surfaces, place: Place) -> Triangle:
        triangle = corners_at(surfaces, place.face)
        face = surfaces.faces[place.face]
        if wp.static(smooth):
            triangle.n0 = surfaces.normals[face[0]]
            triangle.n1 = surfaces.normals[face[1]]
            triangle.n2 = surfaces.normals[face[2]]
            if wp.static(instances):  # each by itself: an interpolated one would turn elsewhere
                instance = surfaces.instances[place.instance]
                triangle.n0 = world_normal(instance, triangle.n0)
                triangle.n1 = world_normal(instance, triangle.n1)
                triangle.n2 = world_normal(instance, triangle.n2)
        if wp.static(uvs):
            t0 = surfaces.uvs[face[0]]
            t1 = surfaces.uvs[face[1]]
            t2 = surfaces.uvs[face[2]]
            triangle.u = wp.vec3(t0[0], t1[0], t2[0])
            triangle.v = wp.vec3(t0[1], t1[1], t2[1])
        return triangle

    return triangle_at


@wp.func
def triangle_point(t: Triangle, u: float, v: float) -> wp.vec3:
    """The point with these barycentrics, in the space of its corners."""
    return (1.0 - u - v) * t.v0 + u * t.v1 + v * t.v2


@wp.func
def triangle_uv(surfaces: Surfaces, index: int, u: float, v: float) -> wp.vec2:
    """Texture coordinates of face `index` at these barycentrics."""
    face = surfaces.faces[index]
    return (1.0 - u - v) * surfaces.uvs[face[0]] + u * surfaces.uvs[face[1]] + v * surfaces.uvs[face[2]]


@wp.func
def triangle_point_error(t: Triangle, u: float, v: float) -> wp.vec3:
    """How far a ray that starts at triangle_point must stand off to be clear of the triangle's plane, per axis.

    Two parts: the rounding of the point itself, seven roundings in a row (PBR, section 6.8.5), and that of the next ray's
    distance to a neighbour in the same plane, which grows with the triangle's size and not with its coordinates: a floor at
    y = 0 has none of the first.
    """
    size = gamma(8.0) * wp.max(largest(t.v1 - t.v0), largest(t.v2 - t.v0))
    point = gamma(7.0) * (wp.abs((1.0 - u - v) * t.v0) + wp.abs(u * t.v1) + wp.abs(v * t.v2))
    return point + wp.vec3(size, size, size)


@wp.func
def triangle_normal(t: Triangle) -> wp.vec3:
    """Unit normal on the counter-clockwise side, in the space of its corners; 0 where there is none. wrt.renderer.upload has the
    same in NumPy.

    The edges are scaled to about 1 first: a triangle of size 1e-20 would otherwise have a normal of length 0.
    """
    e1 = t.v1 - t.v0
    e2 = t.v2 - t.v0
    return unit(wp.cross(e1 / largest(e1), e2 / largest(e2)))


@wp.func
def towards_u(t: Triangle, outward: wp.vec3) -> tuple[wp.vec3, float]:
    """Surface.tangent and bitangent_sign; outward: the normal on the outside."""
    e1 = t.v1 - t.v0
    e2 = t.v2 - t.v0
    longer = wp.min(lift(e1), lift(e2))
    u1 = t.u[1] - t.u[0]
    v1 = t.v[1] - t.v[0]
    u2 = t.u[2] - t.u[0]
    v2 = t.v[2] - t.v[0]
    # dp/du up to a positive factor. v runs down: a picture that is not mirrored has a negative determinant.
    sign = wp.where(u1 * v2 - v1 * u2 > 0.0, -1.0, 1.0)
    along = -sign * (v2 * (longer * e1) - v1 * (longer * e2))
    return where_vec3(wp.dot(along, along) > 0.0, unit(along), frame_x(outward)), sign


def make_on_triangle(smooth: bool, uvs: bool, tangents: bool) -> Any:
    """Where a hit is, and the normals there. Like `facing`, it has no branches, so that loops can run in lanes."""

    @wp.func
    def on_triangle(t: Triangle, u: float, v: float) -> Surface:
        """In the space of its corners, but for the shading normal, which is in the world (0: that of the triangle)."""
        s = Surface()
        s.point = triangle_point(t, u, v)
        s.error = triangle_point_error(t, u, v)
        s.geometric = triangle_normal(t)
        if wp.static(smooth):  # corners without a normal are zero: flat there
            s.shading = unit((1.0 - u - v) * t.n0 + u * t.n1 + v * t.n2)
        if wp.static(uvs):
            s.u = (1.0 - u - v) * t.u[0] + u * t.u[1] + v * t.u[2]
            s.v = (1.0 - u - v) * t.v[0] + u * t.v[1] + v * t.v[2]
        if wp.static(tangents):
            tangent, sign = towards_u(t, s.geometric)
            s.tangent = tangent
            s.bitangent_sign = sign
        return s

    return on_triangle


@wp.func
def facing(surface: Surface, direction: wp.vec3) -> Surface:
    """A surface as a ray of this direction sees it.

    A smooth normal belongs to the outside, which the winding defines: both are turned together, and a normal that disagrees with
    the winding by more than a right angle is brought to the winding's side.
    """
    s = surface
    n = surface.geometric
    shading = where_vec3(wp.dot(surface.shading, surface.shading) > 0.0, surface.shading, n)
    shading = wp.where(wp.dot(shading, n) < 0.0, -1.0, 1.0) * shading
    back = wp.dot(direction, n) > 0.0
    side = wp.where(back, -1.0, 1.0)
    s.front = wp.where(back, 0, 1)
    s.geometric = side * n
    s.shading = side * shading
    return s


@wp.func
def visible_normal(n: wp.vec3, wo: wp.vec3) -> wp.vec3:
    """A shading normal, bent no farther than it is still seen from wo."""
    facing = wp.dot(n, wo)
    return where_vec3(facing < MIN_COSINE, unit(n + (MIN_COSINE - facing) * wo), n)


def make_on_sphere(uvs: bool, tangents: bool) -> Any:
    """As on_triangle, of a sphere."""

    @wp.func
    def on_sphere(surfaces: Surfaces, ray: Ray, hit: Hit) -> Surface:
        s = Surface()
        sphere = surfaces.spheres[hit.prim_id - surfaces.n_triangles]
        center = wp.vec3(sphere[0], sphere[1], sphere[2])
        # The point is moved back onto the sphere, so that its error no longer grows with the ray's length.
        way = ray.origin + hit.t * ray.direction - center
        s.geometric = wp.normalize(lift(way) * way)
        s.shading = s.geometric
        s.point = center + sphere[3] * s.geometric
        s.error = gamma(6.0) * (wp.vec3(sphere[3], sphere[3], sphere[3]) + wp.abs(center))
        if wp.static(uvs):
            uv = sphere_uv(s.geometric)
            s.u = uv[0]
            s.v = uv[1]
        if wp.static(tangents):
            s.bitangent_sign = 1.0
            along_u = wp.vec3(s.geometric[2], 0.0, -s.geometric[0])
            length = wp.length(along_u)
            s.tangent = wp.where(length > 0.0, along_u / length, wp.vec3(1.0, 0.0, 0.0))
        return s

    return on_sphere


def make_surface_at(spheres: bool, smooth: bool, uvs: bool, tangents: bool, instances: bool = False) -> Any:
    """The surface at a hit, with only those attributes that the scene has."""
    place_of = make_place_of(instances)
    triangle_at = make_triangle_at(smooth, uvs, instances)
    surface_of_triangle, on_sphere = make_on_triangle(smooth, uvs, tangents), make_on_sphere(uvs, tangents)

    @wp.func
    def on_triangle(surfaces: Surfaces, hit: Hit, place: Place) -> Surface:
        return surface_of_triangle(triangle_at(surfaces, place), hit.u, hit.v)

    @wp.func
    def in_world(local: Surface, instance: Instance) -> Surface:
        """What is computed in the mesh's space is taken to the world once."""
        s = local
        s.point = world_point(instance, local.point)
        s.error = world_error(instance, local.point, local.error, s.point)
        s.geometric = world_normal(instance, local.geometric)
        if wp.static(tangents):
            s.bitangent_sign = local.bitangent_sign * instance.handedness
            tangent = world_direction(instance, local.tangent)
            s.tangent = wp.normalize(lift(tangent) * tangent)
        return s

    @wp.func
    def surface_at(surfaces: Surfaces, ray: Ray, hit: Hit) -> Surface:
        """The surface that `ray` meets at `hit` (which must be one: prim_id >= 0)."""
        place = place_of(surfaces, hit.prim_id)
        s = Surface()
        if wp.static(spheres):
            if hit.prim_id >= surfaces.n_triangles:
                s = on_sphere(surfaces, ray, hit)
            else:
                s = on_triangle(surfaces, hit, place)
                if wp.static(instances):
                    s = in_world(s, surfaces.instances[place.instance])
        else:
            s = on_triangle(surfaces, hit, place)
            if wp.static(instances):
                s = in_world(s, surfaces.instances[place.instance])
        s = facing(s, ray.direction)
        s.material = place.material
        s.exclude_plus_one = wp.where(hit.prim_id < surfaces.n_triangles, hit.prim_id + 1, 0)
        return s

    return surface_at
