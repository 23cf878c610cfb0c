"""From a hit to the surface there: point with error bound, normals, texture coordinates, and where new rays start."""

import warp as wp

from wrt.kernels.sampling import PI, TWO_PI, frame_x
from wrt.kernels.structs import Hit, Ray, Surfaces, gamma


@wp.struct
class Surface:
    """A point on a surface, in world space.

    error: bound on the point's rounding error, per axis; geometric: unit normal of the flat triangle (or the sphere), on the
    ray's side; shading: the interpolated one, on that side too; front: the ray comes from outside (counter-clockwise);
    exclude: the triangle that rays from here need not be tested against, -1 on a sphere.
    tangent: unit vector along growing u, not necessarily at right angles to the normal; bitangent_sign: -1 where the texture
    is mirrored, else 1.
    """

    point: wp.vec3
    error: wp.vec3
    geometric: wp.vec3
    shading: wp.vec3
    tangent: wp.vec3
    bitangent_sign: float
    uv: wp.vec2
    material: int
    front: int
    exclude: int


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


@wp.func
def triangle_point(surfaces: Surfaces, prim_id: int, u: float, v: float) -> wp.vec3:
    """The point with these barycentrics."""
    face = surfaces.faces[prim_id]
    return (1.0 - u - v) * surfaces.vertices[face[0]] + u * surfaces.vertices[face[1]] + v * surfaces.vertices[face[2]]


@wp.func
def largest(v: wp.vec3) -> float:
    """The largest of the absolute components."""
    return wp.max(wp.max(wp.abs(v[0]), wp.abs(v[1])), wp.abs(v[2]))


@wp.func
def triangle_point_error(surfaces: Surfaces, prim_id: int, u: float, v: float) -> wp.vec3:
    """How far a ray that starts at triangle_point must stand off to be clear of the triangle's plane, per axis.

    Two parts: the rounding of the point itself, seven roundings in a row (PBR, section 6.8.5), and that of the next ray's
    distance to a neighbour in the same plane, which grows with the triangle's size and not with its coordinates: a floor at
    y = 0 has none of the first.
    """
    face = surfaces.faces[prim_id]
    v0 = surfaces.vertices[face[0]]
    v1 = surfaces.vertices[face[1]]
    v2 = surfaces.vertices[face[2]]
    size = gamma(8.0) * wp.max(largest(v1 - v0), largest(v2 - v0))
    point = gamma(7.0) * (wp.abs((1.0 - u - v) * v0) + wp.abs(u * v1) + wp.abs(v * v2))
    return point + wp.vec3(size, size, size)


@wp.func
def triangle_normal(surfaces: Surfaces, prim_id: int) -> wp.vec3:
    """Unit normal on the counter-clockwise side.

    The edges are scaled to about 1 first: a triangle of size 1e-20 would otherwise have a normal of length 0.
    """
    face = surfaces.faces[prim_id]
    e1 = surfaces.vertices[face[1]] - surfaces.vertices[face[0]]
    e2 = surfaces.vertices[face[2]] - surfaces.vertices[face[0]]
    return wp.normalize(wp.cross(e1 / largest(e1), e2 / largest(e2)))


def make_surface_at(spheres: bool, smooth: bool, uvs: bool, tangents: bool):
    """Interpolation at a hit, with only those attributes that the scene has."""

    @wp.func
    def on_triangle(surfaces: Surfaces, ray: Ray, hit: Hit) -> Surface:
        s = Surface()
        face = surfaces.faces[hit.prim_id]
        w = 1.0 - hit.u - hit.v
        s.point = triangle_point(surfaces, hit.prim_id, hit.u, hit.v)
        s.error = triangle_point_error(surfaces, hit.prim_id, hit.u, hit.v)
        s.geometric = triangle_normal(surfaces, hit.prim_id)
        s.shading = s.geometric
        if wp.static(smooth):
            n = w * surfaces.normals[face[0]] + hit.u * surfaces.normals[face[1]] + hit.v * surfaces.normals[face[2]]
            length = wp.length(n)
            if length > 0.0:  # corners without a normal are zero: flat there
                s.shading = n / length
        if wp.static(uvs):
            s.uv = w * surfaces.uvs[face[0]] + hit.u * surfaces.uvs[face[1]] + hit.v * surfaces.uvs[face[2]]
        if wp.static(tangents):
            e1 = surfaces.vertices[face[1]] - surfaces.vertices[face[0]]
            e2 = surfaces.vertices[face[2]] - surfaces.vertices[face[0]]
            t1 = surfaces.uvs[face[1]] - surfaces.uvs[face[0]]
            t2 = surfaces.uvs[face[2]] - surfaces.uvs[face[0]]
            # dp/du up to a positive factor. v runs down: a picture that is not mirrored has a negative determinant.
            s.bitangent_sign = wp.where(t1[0] * t2[1] - t1[1] * t2[0] > 0.0, -1.0, 1.0)
            along_u = -s.bitangent_sign * (t2[1] * e1 - t1[1] * e2)
            length = wp.length(along_u)
            s.tangent = wp.where(length > 0.0, along_u / length, frame_x(s.geometric))
        return s

    @wp.func
    def on_sphere(surfaces: Surfaces, ray: Ray, hit: Hit) -> Surface:
        s = Surface()
        sphere = surfaces.spheres[hit.prim_id - surfaces.n_triangles]
        center = wp.vec3(sphere[0], sphere[1], sphere[2])
        # The point is moved back onto the sphere, so that its error no longer grows with the ray's length.
        s.geometric = wp.normalize(ray.origin + hit.t * ray.direction - center)
        s.shading = s.geometric
        s.point = center + sphere[3] * s.geometric
        s.error = gamma(6.0) * (wp.vec3(sphere[3], sphere[3], sphere[3]) + wp.abs(center))
        if wp.static(uvs):
            n = s.geometric
            s.uv = wp.vec2(0.5 + wp.atan2(-n[2], n[0]) / TWO_PI, wp.acos(wp.clamp(n[1], -1.0, 1.0)) / PI)
        if wp.static(tangents):
            s.bitangent_sign = 1.0
            along_u = wp.vec3(s.geometric[2], 0.0, -s.geometric[0])
            length = wp.length(along_u)
            s.tangent = wp.where(length > 0.0, along_u / length, wp.vec3(1.0, 0.0, 0.0))
        return s

    @wp.func
    def surface_at(surfaces: Surfaces, ray: Ray, hit: Hit) -> Surface:
        """The surface that `ray` meets at `hit` (which must be one: prim_id >= 0)."""
        s = Surface()
        if wp.static(spheres):
            if hit.prim_id >= surfaces.n_triangles:
                s = on_sphere(surfaces, ray, hit)
            else:
                s = on_triangle(surfaces, ray, hit)
        else:
            s = on_triangle(surfaces, ray, hit)
        s.material = surfaces.prim_material[hit.prim_id]
        s.exclude = wp.where(hit.prim_id < surfaces.n_triangles, hit.prim_id, -1)
        s.front = 1
        # A smooth normal belongs to the outside, which the winding defines: both are turned together, and a normal that
        # disagrees with the winding by more than a right angle is brought to the winding's side.
        if wp.dot(s.shading, s.geometric) < 0.0:
            s.shading = -s.shading
        if wp.dot(ray.direction, s.geometric) > 0.0:
            s.front = 0
            s.geometric = -s.geometric
            s.shading = -s.shading
        return s

    return surface_at
