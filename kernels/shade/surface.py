"""The surface at a hit: point with error bound, normals, texture coordinates, and the origins of new rays."""

from typing import Any

import warp as wp

from wrt.kernels.shade.elementary import acos, atan2
from wrt.kernels.shade.sampling import PI, TWO_PI, frame_x, where_vec3
from wrt.kernels.structs import Hit, Instance, Ray, Surfaces, gamma, largest, lift, unit

MIN_COSINE = wp.constant(1.0e-3)  # Smallest cosine between a visible shading normal and the direction to the eye.


@wp.struct
class Surface:
    """A point on a surface, in world space."""

    point: wp.vec3
    error: wp.vec3  # Bound on the point's rounding error, per axis.
    geometric: wp.vec3  # Unit normal of the flat triangle or the sphere, on the ray's side.
    shading: wp.vec3  # Interpolated unit normal, on the ray's side; `shade` gets it with the normal map.
    smooth: wp.vec3  # The same without the normal map. Set for `shade` and shadow rays, in scenes with clear coats.
    tangent: wp.vec3  # Unit vector along growing u, not always perpendicular to the normal.
    bitangent_sign: float  # -1 if the texture is mirrored, else 1.
    u: float  # Texture coordinates: two floats, as a vec2 does not vectorise.
    v: float
    material: int
    front: int  # 1 if the ray comes from the outside, the counter-clockwise side.
    exclude_plus_one: int  # 1 + prim_id of the triangle, which new rays ignore; 0 on a sphere.


@wp.func
def next_away(x: float, direction: float) -> float:
    """Return a float32 at least one float above x if direction > 0, below x if direction < 0, and x if direction = 0."""
    step = wp.abs(x) * wp.static(2.0**-23) + 1.0e-45
    return wp.where(direction > 0.0, x + step, wp.where(direction < 0.0, x - step, x))


@wp.func
def spawn_point(point: wp.vec3, error: wp.vec3, normal: wp.vec3, direction: wp.vec3) -> wp.vec3:
    """Return the origin of a ray in `direction` from a surface point: the point, moved along the normal to the side of `direction`.

    The origin is just outside the box of the point's error (Pharr, Jakob and Humphreys 2023, "Physically Based Rendering", section
    6.8.6). Unlike a fixed epsilon, the step scales with the coordinates."""
    distance = wp.dot(wp.abs(normal), error)
    offset = wp.where(wp.dot(direction, normal) < 0.0, -distance, distance) * normal
    p = point + offset
    return wp.vec3(next_away(p[0], offset[0]), next_away(p[1], offset[1]), next_away(p[2], offset[2]))


@wp.struct
class Place:
    """The indices of a primitive's data."""

    face: int  # In Surfaces.faces; unread for a sphere.
    material: int  # In Surfaces.materials.
    instance: int  # In Surfaces.instances.


@wp.func
def instance_at(surfaces: Surfaces, prim_id: int) -> int:
    """Return the instance of a primitive: the last instance whose first_prim is at most prim_id."""
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
    """Return the texture coordinates of a sphere at unit normal n, in [0, 1]: longitude and colatitude, with +y at v = 0."""
    return wp.vec2(0.5 + atan2(-n[2], n[0]) / TWO_PI, acos(wp.clamp(n[1], -1.0, 1.0)) / PI)


def make_place_of(instances: bool) -> Any:
    """Return place_of(surfaces, prim_id) -> Place."""

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
    """Transform a point (w = 1) or a direction (w = 0) by the rows of a 3x4 matrix, in float64, rounded to float32 at the end."""
    p = wp.vec4d(wp.float64(v[0]), wp.float64(v[1]), wp.float64(v[2]), wp.float64(w))
    return wp.vec3(float(wp.dot(row_x, p)), float(wp.dot(row_y, p)), float(wp.dot(row_z, p)))


@wp.func
def world_point(i: Instance, p: wp.vec3) -> wp.vec3:
    return transformed(i.world_x, i.world_y, i.world_z, p, 1.0)


@wp.func
def world_normal(i: Instance, n: wp.vec3) -> wp.vec3:
    """Transform a normal to a unit normal in world space. It stays on the outside, also for mirrored instances; 0 stays 0."""
    return wp.normalize(n[0] * i.normal_x + n[1] * i.normal_y + n[2] * i.normal_z)


@wp.func
def world_error(i: Instance, p: wp.vec3, error: wp.vec3, world: wp.vec3) -> wp.vec3:
    """Bound the error per axis of `world`, the image in world space of a point p with the error bound `error`.

    The bound includes two roundings in the mesh's space: the origin of the next ray is transformed into that space and rounded."""
    e = error + gamma(2.0) * wp.abs(p)
    return transformed(wp.abs(i.world_x), wp.abs(i.world_y), wp.abs(i.world_z), e, 0.0) + gamma(2.0) * wp.abs(world)


@wp.struct
class Triangle:
    """A triangle. Normals and texture coordinates are unread if no mesh of the scene has them."""

    v0: wp.vec3  # Corners in the space of the mesh.
    v1: wp.vec3
    v2: wp.vec3
    n0: wp.vec3  # Normals at the corners in world space.
    n1: wp.vec3
    n2: wp.vec3
    u: wp.vec3  # Texture coordinates u of the three corners.
    v: wp.vec3  # Texture coordinates v of the three corners.


@wp.func
def corners_at(surfaces: Surfaces, index: int) -> Triangle:
    """Return face `index` as a Triangle with corners only, in the space of its mesh."""
    face = surfaces.faces[index]
    triangle = Triangle()
    triangle.v0 = surfaces.vertices[face[0]]
    triangle.v1 = surfaces.vertices[face[1]]
    triangle.v2 = surfaces.vertices[face[2]]
    return triangle


def make_triangle_at(smooth: bool, uvs: bool, instances: bool) -> Any:
    """Return triangle_at(surfaces, place) -> Triangle, with normals and texture coordinates if the scene has them."""

    @wp.func
    def triangle_at(surfaces: Surfaces, place: Place) -> Triangle:
        triangle = corners_at(surfaces, place.face)
        face = surfaces.faces[place.face]
        if wp.static(smooth):
            triangle.n0 = surfaces.normals[face[0]]
            triangle.n1 = surfaces.normals[face[1]]
            triangle.n2 = surfaces.normals[face[2]]
            if wp.static(instances):  # Transform before interpolating: the order changes the result.
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
    """Return the point at the barycentrics u (of v1) and v (of v2), in the space of the corners."""
    return (1.0 - u - v) * t.v0 + u * t.v1 + v * t.v2


@wp.func
def triangle_uv(surfaces: Surfaces, index: int, u: float, v: float) -> wp.vec2:
    """Return the texture coordinates of face `index` at the barycentrics u and v."""
    face = surfaces.faces[index]
    return (1.0 - u - v) * surfaces.uvs[face[0]] + u * surfaces.uvs[face[1]] + v * surfaces.uvs[face[2]]


@wp.func
def triangle_point_error(t: Triangle, u: float, v: float) -> wp.vec3:
    """Return the error per axis by which spawn_point must move triangle_point, so that a new ray is clear of the triangle's plane.

    The error has two parts. The first covers the point's seven successive roundings (PBR, section 6.8.5). The second covers the
    rounding of the new ray's distance to a neighbour in the same plane, and grows with the triangle's size, not with its coordinates.
    On a floor at y = 0, the first part is 0."""
    size = gamma(8.0) * wp.max(largest(t.v1 - t.v0), largest(t.v2 - t.v0))
    point = gamma(7.0) * (wp.abs((1.0 - u - v) * t.v0) + wp.abs(u * t.v1) + wp.abs(v * t.v2))
    return point + wp.vec3(size, size, size)


@wp.func
def triangle_normal(t: Triangle) -> wp.vec3:
    """Return the unit normal on the counter-clockwise side, in the corners' space; 0 for a degenerate triangle.

    Scaled edges keep the cross product of a triangle of size 1e-20 from underflowing to 0. wrt.renderer.upload computes the same
    bits in NumPy."""
    e1 = t.v1 - t.v0
    e2 = t.v2 - t.v0
    return unit(wp.cross(e1 / largest(e1), e2 / largest(e2)))


@wp.func
def towards_u(t: Triangle, outward: wp.vec3) -> tuple[wp.vec3, float]:
    """Return Surface.tangent and Surface.bitangent_sign of a triangle; `outward` is its unit normal on the outside."""
    e1 = t.v1 - t.v0
    e2 = t.v2 - t.v0
    longer = wp.min(lift(e1), lift(e2))
    u1 = t.u[1] - t.u[0]
    v1 = t.v[1] - t.v[0]
    u2 = t.u[2] - t.u[0]
    v2 = t.v[2] - t.v[0]
    # The tangent is dp/du up to a positive factor. As v runs down, the determinant is negative unless the texture is mirrored.
    sign = wp.where(u1 * v2 - v1 * u2 > 0.0, -1.0, 1.0)
    along = -sign * (v2 * (longer * e1) - v1 * (longer * e2))
    return where_vec3(wp.dot(along, along) > 0.0, unit(along), frame_x(outward)), sign


def make_on_triangle(smooth: bool, uvs: bool, tangents: bool) -> Any:
    """Return on_triangle(triangle, u, v) -> Surface. Like `facing`, it is branch-free, so that loops vectorise."""

    @wp.func
    def on_triangle(t: Triangle, u: float, v: float) -> Surface:
        """Return the surface at the barycentrics u and v, in the corners' space.

        Only the shading normal is in world space. It is 0 if the corners have no normals: `facing` then takes the geometric normal."""
        s = Surface()
        s.point = triangle_point(t, u, v)
        s.error = triangle_point_error(t, u, v)
        s.geometric = triangle_normal(t)
        if wp.static(smooth):  # A corner without a normal has the normal 0.
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
    """Return the surface with `front` set and both normals on the side that a ray of this direction comes from.

    The winding defines the outside. A shading normal more than a right angle away from the geometric normal is negated first."""
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
    """Return the shading normal n, bent towards wo as far as needed for a cosine of about MIN_COSINE."""
    facing = wp.dot(n, wo)
    return where_vec3(facing < MIN_COSINE, unit(n + (MIN_COSINE - facing) * wo), n)


@wp.func
def with_normal(s: Surface, normal: wp.vec3) -> Surface:
    """Return the surface for `shade`: with the shading normal `normal`, while `smooth` keeps the interpolated one."""
    out = s
    out.smooth = s.shading
    out.shading = normal
    return out


def make_on_sphere(uvs: bool, tangents: bool) -> Any:
    """Return on_sphere(sphere, hit_point) -> Surface, in world space. Like on_triangle, it is branch-free.

    The point is projected onto the sphere, so that its error does not grow with the ray's length."""

    @wp.func
    def on_sphere(sphere: wp.vec4, hit_point: wp.vec3) -> Surface:
        s = Surface()
        center = wp.vec3(sphere[0], sphere[1], sphere[2])
        from_center = hit_point - center
        s.geometric = unit(lift(from_center) * from_center)
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
            s.tangent = where_vec3(length > 0.0, along_u / length, wp.vec3(1.0, 0.0, 0.0))
        return s

    return on_sphere


def make_surface_at(spheres: bool, smooth: bool, uvs: bool, tangents: bool, instances: bool = False) -> Any:
    """Return surface_at(surfaces, ray, hit) -> Surface, with the attributes that the scene has."""
    place_of = make_place_of(instances)
    triangle_at = make_triangle_at(smooth, uvs, instances)
    surface_of_triangle, on_sphere = make_on_triangle(smooth, uvs, tangents), make_on_sphere(uvs, tangents)

    @wp.func
    def in_world(local: Surface, instance: Instance) -> Surface:
        """Transform a surface from the mesh's space to world space."""
        s = local
        s.point = world_point(instance, local.point)
        s.error = world_error(instance, local.point, local.error, s.point)
        s.geometric = world_normal(instance, local.geometric)
        if wp.static(tangents):
            s.bitangent_sign = local.bitangent_sign * instance.handedness
            tangent = transformed(instance.world_x, instance.world_y, instance.world_z, local.tangent, 0.0)
            s.tangent = wp.normalize(lift(tangent) * tangent)
        return s

    @wp.func
    def on_triangle(surfaces: Surfaces, hit: Hit, place: Place) -> Surface:
        s = surface_of_triangle(triangle_at(surfaces, place), hit.u, hit.v)
        if wp.static(instances):
            s = in_world(s, surfaces.instances[place.instance])
        return s

    @wp.func
    def surface_at(surfaces: Surfaces, ray: Ray, hit: Hit) -> Surface:
        """Return the surface of `ray` at `hit`, which must not be a miss."""
        place = place_of(surfaces, hit.prim_id)
        s = Surface()
        if wp.static(spheres):
            if hit.prim_id >= surfaces.n_triangles:
                s = on_sphere(surfaces.spheres[hit.prim_id - surfaces.n_triangles], ray.origin + hit.t * ray.direction)
            else:
                s = on_triangle(surfaces, hit, place)
        else:
            s = on_triangle(surfaces, hit, place)
        s = facing(s, ray.direction)
        s.material = place.material
        s.exclude_plus_one = wp.where(hit.prim_id < surfaces.n_triangles, hit.prim_id + 1, 0)
        return s

    return surface_at
