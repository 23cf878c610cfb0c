"""The triangle unit: the intersection of a ray with a triangle.

`watertight` follows Woop, Benthin and Wald 2013, "Watertight Ray/Triangle Intersection" (JCGT 2(1)). The triangle is translated and
sheared so that the ray becomes the z axis, and three signed areas around the origin decide. Two triangles with a common edge compute the
same area with opposite sign, so that no ray passes between them. The other tests serve comparison; RAY_TRIANGLE is the table of all. A
test takes the ray's set-up and one record, and returns a `Hit` on the whole line.

**What runs.** This file tests one triangle and one ray. On a CPU, closest_hit and any_hit of arrays through bvh8 (the default) run the
same steps in lanes, and so do pictures: `kernels/wide/triangle.h`. Both have the same bits (tests/kernels/wide/test_packets.py). The
one-ray walk of bvh4, bvh8 and bvh8c first rejects triangles far from the ray in lanes (`wide/lanes.py`), and tests the others here. The
whole table: kernels/README.md.
"""

from typing import Any, NamedTuple

import warp as wp

from wrt.kernels.structs import NO_HIT, Hit, PlanePrimitive, Primitive, Ray, noinline, on_cuda
from wrt.kernels.units.box import FAR_PAD, BoxRay, box_pad, padded_hi, padded_lo, slab_interval
from wrt.kernels.units.float_float import difference_of_products, pair_quotient, pair_sum, pair_times, rounding_is_certain

# Rounding alone moves t by so much when it is clamped to its box: seven errors (wrt.lab.oracle.bounds), and one step of a denormal.
CLAMP_ROUNDING = wp.constant(7.0 * 2.0**-24)
CLAMP_STEP = wp.constant(2.0**-149)
# A ray whose progress along an axis is below this part of its length may have a shear that underflowed.
SLOWEST = wp.constant(2.0**-120)
U_SQUARED = 2.0**-48  # u^2, u = 2^-24


@wp.struct
class TriangleRay:
    """The ray as the triangle unit reads it: the order of axes (kz: of the direction's largest component) and the shear."""

    kx: int
    ky: int
    kz: int
    shear_x: float
    shear_y: float
    shear_z: float


@wp.func
def component(v: wp.vec3, k: int) -> float:
    """Component v[k] by selection: an index unknown to the compiler would send v through memory."""
    return wp.where(k == 0, v[0], wp.where(k == 1, v[1], v[2]))


@wp.func
def triangle_ray(ray: Ray) -> TriangleRay:
    """Set up a ray for the triangle unit."""
    d = ray.direction
    out = TriangleRay()
    kz = int(0)
    if wp.abs(d[1]) > wp.abs(d[0]):
        kz = int(1)
    if wp.abs(d[2]) > wp.abs(component(d, kz)):
        kz = int(2)
    kx = wp.where(kz == 2, 0, kz + 1)
    ky = wp.where(kx == 2, 0, kx + 1)
    d_z = component(d, kz)
    # A ray against the axis swaps x and y, which keeps the winding.
    out.kx = wp.where(d_z < 0.0, ky, kx)
    out.ky = wp.where(d_z < 0.0, kx, ky)
    out.kz = kz
    out.shear_x = component(d, out.kx) / d_z
    out.shear_y = component(d, out.ky) / d_z
    out.shear_z = 1.0 / d_z
    return out


@wp.func
def sheared(v: wp.vec3, shear_x: float, shear_y: float) -> wp.vec3:
    """Shear a corner, relative to the origin and in the ray's order of axes, so that the ray becomes the z axis."""
    return wp.vec3(v[0] - shear_x * v[2], v[1] - shear_y * v[2], v[2])


@wp.func
def to_ray_space(v: wp.vec3, shear: TriangleRay) -> wp.vec3:
    """Bring a corner, relative to the ray's origin, into the ray's space: axes reordered, then sheared."""
    turned = wp.vec3(component(v, shear.kx), component(v, shear.ky), component(v, shear.kz))
    return sheared(turned, shear.shear_x, shear.shear_y)


@wp.func
def edge_areas(a: Any, b: Any, c: Any):
    """Twice the signed areas that the z axis spans with the edges bc, ca, ab."""
    return type(a)(c[0] * b[1] - c[1] * b[0], a[0] * c[1] - a[1] * c[0], b[0] * a[1] - b[1] * a[0])


@wp.func
def outside(areas: Any) -> bool:
    """Test whether two of the areas have different signs: the z axis passes the triangle. NaN has no sign."""
    zero = areas.dtype(0.0)
    return ((areas[0] < zero or areas[1] < zero or areas[2] < zero)
            and (areas[0] > zero or areas[1] > zero or areas[2] > zero))


@wp.func
def inside_edge(area: wp.float64, start: wp.vec3, end: wp.vec3, winding: wp.float64) -> bool:
    """Test whether the z axis passes the edge from start to end on the side where the triangle lies.
    area: of edge_areas for this edge. winding: sum of the three areas; its sign is the triangle's winding. If the axis meets the edge
    (area 0), the axis moved in x and y by (e, e^2), for an infinitesimal e > 0, decides."""
    zero = wp.float64(0.0)
    side = wp.where(winding < zero, -area, area)
    if side == zero:
        along = start[1] - end[1]
        if along == 0.0:
            along = end[0] - start[0]
        return wp.where(winding < zero, -along, along) > 0.0
    return side > zero


@wp.func
def is_crossed(a: wp.vec3, b: wp.vec3, c: wp.vec3) -> bool:
    """Test whether the z axis, moved by an infinitesimal, crosses the triangle of sheared corners.
    The moved axis meets no edge and no corner. Around an edge, those triangles count that a line beside it crosses (Edelsbrunner and
    Muecke 1990, "Simulation of Simplicity")."""
    areas = edge_areas(wp.vec3d(a), wp.vec3d(b), wp.vec3d(c))
    winding = areas[0] + areas[1] + areas[2]
    return (inside_edge(areas[0], c, b, winding) and inside_edge(areas[1], a, c, winding)
            and inside_edge(areas[2], b, a, winding))


@wp.func
def no_triangle() -> Hit:
    """Miss: t = inf, prim_id = NO_HIT."""
    hit = Hit()
    hit.t = float(wp.inf)
    hit.prim_id = NO_HIT
    return hit


@wp.func
def crossing(a: wp.vec3, b: wp.vec3, c: wp.vec3, shear_z: float) -> Hit:
    """Intersection of the z axis with the triangle of sheared corners, in float64; prim_id is 0 on a hit, else NO_HIT.
    Products of float32 are exact there, and so are the signs of the areas. Nearly edge-on, where the areas cancel, t, u and v keep their
    digits."""
    hit = no_triangle()
    areas = edge_areas(wp.vec3d(a), wp.vec3d(b), wp.vec3d(c))
    if outside(areas):
        return hit
    area = areas[0] + areas[1] + areas[2]
    zero = wp.float64(0.0)
    if not (area < zero or area > zero):
        return hit
    z = areas[0] * wp.float64(a[2]) + areas[1] * wp.float64(b[2]) + areas[2] * wp.float64(c[2])
    hit.t = float(z / area * wp.float64(shear_z))
    hit.u = float(areas[1] / area)
    hit.v = float(areas[2] / area)
    hit.prim_id = 0
    return hit


@noinline
def hard_crossing(a: wp.vec3, b: wp.vec3, c: wp.vec3, shear_z: float) -> Hit:
    """Call `crossing` as a function of its own: on a GPU it holds all float64 code of a traversal."""
    return crossing(a, b, c, shear_z)


@wp.func
def sure_crossing(a: wp.vec3, b: wp.vec3, c: wp.vec3, shear_z: float) -> Hit:
    """Return what `crossing` returns, to the last bit, without float64; prim_id is NO_HIT if the bits are not certain.

    Let w_i be the exact areas, A their sum, Q the sum of the sizes of their products, and Z the largest |z|. An area is off by at most 3.1
    u^2 Q, A by 9.2 u^2 Q. The sum of w_i z_i is off by 12.2 u^2 Q Z, each quotient by 30 u^2 of itself. That is 43 u^2 Q / A for u and v,
    and 56 u^2 (Q / A) Z |shear_z| for t. The error of float64 is below one such u^2, and `rounding_is_certain` needs one. If all numbers
    within 64 u^2 round alike, float64 has rounded to the same bits. The ranges of Q and Z exclude under- and overflow: products of a low
    part may lose 2^-150, but u^2 Q and u^2 Q Z are at least 2^-138.
    """
    hit = no_triangle()
    size = ((wp.abs(c[0] * b[1]) + wp.abs(c[1] * b[0])) + (wp.abs(a[0] * c[1]) + wp.abs(a[1] * c[0]))
            + (wp.abs(b[0] * a[1]) + wp.abs(b[1] * a[0])))
    far = wp.max(wp.abs(a[2]), wp.max(wp.abs(b[2]), wp.abs(c[2])))
    w_0 = difference_of_products(c[0], b[1], c[1], b[0])
    w_1 = difference_of_products(a[0], c[1], a[1], c[0])
    w_2 = difference_of_products(b[0], a[1], b[1], a[0])
    least = wp.static(4.0 * U_SQUARED) * size
    if not ((w_0[0] > least and w_1[0] > least and w_2[0] > least) or (w_0[0] < -least and w_1[0] < -least and w_2[0] < -least)):
        return hit
    if not (size > wp.static(2.0**-60) and size < wp.static(2.0**60) and far > wp.static(2.0**-30) and far < wp.static(2.0**60)):
        return hit
    area = pair_sum(pair_sum(w_0, w_1), w_2)
    inverse = 1.0 / area[0]
    error = wp.static(64.0 * U_SQUARED) * size * wp.abs(inverse)
    z = pair_sum(pair_sum(pair_times(w_0, a[2]), pair_times(w_1, b[2])), pair_times(w_2, c[2]))
    t = pair_times(pair_quotient(z, area, inverse), shear_z)
    u = pair_quotient(w_1, area, inverse)
    v = pair_quotient(w_2, area, inverse)
    if (rounding_is_certain(t, error * far * wp.abs(shear_z)) and rounding_is_certain(u, error)
            and rounding_is_certain(v, error)):
        hit.t = t[0]
        hit.u = u[0]
        hit.v = v[0]
        hit.prim_id = 0
    return hit


@wp.func
def watertight(origin: wp.vec3, shear: TriangleRay, v0: wp.vec3, v1: wp.vec3, v2: wp.vec3) -> Hit:
    """Intersect a line with a triangle, both sides; prim_id is 0 on a hit, else NO_HIT. t may be negative.

    Products of two float32 are monotone: an area's sign can be wrong only if the area is 0 or under- or overflows. So float32 rejects most
    triangles, and `crossing` decides the others in float64. On GPUs, where float64 is slow, float-float arithmetic gives the same bits if
    it is certain of them, and float64 decides the rest.

    A triangle seen exactly edge-on is missed, and so are NaN coordinates. Triangles without area are stored as NaN, since rounding here
    may give corners on a line an area (wrt.accel.triangle_data.corners).

    Domain: coordinates differ by less than 2^127, and the direction's longest component is between 2^-64 and 2^64 (`kernels.query` scales
    others). wrt.lab.oracle.bounds has the error bounds.
    """
    a = to_ray_space(v0 - origin, shear)
    b = to_ray_space(v1 - origin, shear)
    c = to_ray_space(v2 - origin, shear)
    if outside(edge_areas(a, b, c)):
        return no_triangle()
    if on_cuda():
        hit = sure_crossing(a, b, c, shear.shear_z)
        if hit.prim_id == NO_HIT:
            hit = hard_crossing(a, b, c, shear.shear_z)
        return hit
    return crossing(a, b, c, shear.shear_z)


@wp.func
def lower(a: wp.vec3, b: wp.vec3) -> wp.vec3:
    """Componentwise minimum; wp.min's care for NaN costs more than the comparison."""
    return wp.vec3(wp.where(b[0] < a[0], b[0], a[0]), wp.where(b[1] < a[1], b[1], a[1]), wp.where(b[2] < a[2], b[2], a[2]))


@wp.func
def upper(a: wp.vec3, b: wp.vec3) -> wp.vec3:
    """Componentwise maximum, as `lower`."""
    return wp.vec3(wp.where(b[0] > a[0], b[0], a[0]), wp.where(b[1] > a[1], b[1], a[1]), wp.where(b[2] > a[2], b[2], a[2]))


@wp.func
def padded_interval(ray: BoxRay, lo: wp.vec3, hi: wp.vec3) -> wp.vec2:
    """Slab interval of a primitive's padded box, the box that structures are built from."""
    pad = box_pad(lo, hi)
    return slab_interval(ray, padded_lo(lo, pad), padded_hi(hi, pad))


@wp.func
def clamped(t: float, interval: wp.vec2) -> float:
    """Clamp t to the interval; an empty interval gives its entry."""
    inside = wp.where(t > interval[1], interval[1], t)
    return wp.where(inside < interval[0], interval[0], inside)


@wp.func
def underflowed(ray: BoxRay, t: float, moved: float) -> bool:
    """Test whether the clamp to a box moved t farther than rounding explains, on a ray whose shear may have underflowed.
    Along some axis, such a ray moves less than 2^-120 until t, or less than 2^-120 of its length. Underflow moves the sheared corners by
    2^-150 (1 + distance). For any other ray that is at most 2^-29 of its way. Divided by so small a component of the direction, as in the
    distance to a slab, it can be any length."""
    if not wp.abs(moved - t) > CLAMP_ROUNDING * wp.abs(t) + CLAMP_STEP:
        return False
    steep = float(wp.inf)
    grazing = float(0.0)
    for axis in range(3):
        inverse = wp.abs(ray.inv_dir[axis])
        steep = wp.where(inverse < steep, inverse, steep)
        grazing = wp.where(inverse > grazing and inverse < wp.inf, inverse, grazing)
    least = SLOWEST * grazing
    return steep < least or (wp.abs(t) < least and wp.abs(moved) < least)


@wp.func
def within_bounds(ray: BoxRay, t: float, lo: wp.vec3, hi: wp.vec3) -> float:
    """Clamp t to the interval of the primitive's own box; inf if the ray misses even the padded box.

    Rounding can put t before the point where the ray enters the triangle's box. A traversal from front to back would then drop some nodes
    or keep them, by the order of its visits. With t inside the box's interval, and boxes monotone (a node's box contains the padded boxes
    of its triangles), every structure finds the same hits to the last bit.

    If the shear underflowed, the slabs belong to the exact ray, but t belongs to a neighbouring one, which may miss the box. It meets the
    padded box: t is clamped to that interval.
    """
    interval = slab_interval(ray, lo, hi)
    moved = clamped(t, interval)
    if not interval[0] <= interval[1] or underflowed(ray, t, moved):
        interval = padded_interval(ray, lo, hi)
        if not interval[0] <= interval[1] * FAR_PAD:
            return float(wp.inf)
        moved = clamped(t, interval)
    return moved


@wp.func
def ray_triangle(box: BoxRay, shear: TriangleRay, v0: wp.vec3, v1: wp.vec3, v2: wp.vec3) -> Hit:
    """Default unit: `watertight`, with t clamped to the triangle's own box."""
    hit = watertight(box.origin, shear, v0, v1, v2)
    if hit.prim_id != NO_HIT:
        hit.t = within_bounds(box, hit.t, lower(lower(v0, v1), v2), upper(upper(v0, v1), v2))
        if not wp.abs(hit.t) < wp.inf:
            hit.prim_id = NO_HIT
    return hit


@wp.func
def watertight_triangle(box: BoxRay, shear: TriangleRay, ray: Ray, triangle: Primitive) -> Hit:
    """Default unit for a record: `ray_triangle`."""
    return ray_triangle(box, shear, triangle.v0, triangle.v1, triangle.v2)


@wp.func
def moeller_trumbore(box: BoxRay, shear: TriangleRay, ray: Ray, triangle: Primitive) -> Hit:
    """Solve for t, u, v by Cramer's rule on two edges (v1 and v2 of the record).
    Moeller and Trumbore 1997, "Fast, Minimum Storage Ray/Triangle Intersection". Each triangle rounds its own edges: a ray can pass
    between two neighbours, or hit both."""
    p = wp.cross(ray.direction, triangle.v2)
    determinant = wp.dot(triangle.v1, p)
    if determinant == 0.0:
        return no_triangle()
    inverse = 1.0 / determinant
    s = ray.origin - triangle.v0
    q = wp.cross(s, triangle.v1)
    hit = Hit()
    hit.u = wp.dot(s, p) * inverse
    hit.v = wp.dot(ray.direction, q) * inverse
    hit.t = wp.dot(triangle.v2, q) * inverse
    if not (hit.u >= 0.0 and hit.v >= 0.0 and hit.u + hit.v <= 1.0):
        return no_triangle()
    return hit


@wp.func
def on_plane(plane: wp.vec4, point: wp.vec3) -> float:
    """Value of the plane's equation at a point."""
    return plane[0] * point[0] + plane[1] * point[1] + plane[2] * point[2] + plane[3]


@wp.func
def along(plane: wp.vec4, direction: wp.vec3) -> float:
    """Dot product of the plane's normal with a direction."""
    return plane[0] * direction[0] + plane[1] * direction[1] + plane[2] * direction[2]


@wp.func
def plane_equation(box: BoxRay, shear: TriangleRay, ray: Ray, triangle: PlanePrimitive) -> Hit:
    """Solve the plane equation for t, and take u and v of the point there.
    A ray parallel to the plane (divisor 0) misses. The caller compares t with t_min and t_max. The point counts if u, v >= 0 and u + v <=
    1. The triangle's plane is `c`; `a` and `b` give u and v of a point on it."""
    slope = along(triangle.c, ray.direction)
    if slope == 0.0:
        return no_triangle()
    hit = Hit()
    hit.t = -on_plane(triangle.c, ray.origin) / slope
    point = ray.origin + hit.t * ray.direction
    hit.u = on_plane(triangle.a, point)
    hit.v = on_plane(triangle.b, point)
    if not (hit.u >= 0.0 and hit.v >= 0.0 and hit.u + hit.v <= 1.0):
        return no_triangle()
    return hit


@wp.func
def baldwin_weber(box: BoxRay, shear: TriangleRay, ray: Ray, triangle: PlanePrimitive) -> Hit:
    """Map the ray to the space where the triangle is (0,0,0), (1,0,0), (0,1,0), and intersect the ray with the plane z = 0.
    Baldwin and Weber 2016, "Fast Ray-Triangle Intersections by Coordinate Transformation" (JCGT 5(3)). a, b, c are the rows of the affine
    map. The triangle does not determine which direction becomes the z axis. The paper picks a coordinate axis, so that three of the map's
    twelve numbers are constants. Here it is the triangle's unit normal, and all twelve numbers are stored."""
    slope = along(triangle.c, ray.direction)
    if slope == 0.0:
        return no_triangle()
    hit = Hit()
    hit.t = -on_plane(triangle.c, ray.origin) / slope
    hit.u = on_plane(triangle.a, ray.origin) + hit.t * along(triangle.a, ray.direction)
    hit.v = on_plane(triangle.b, ray.origin) + hit.t * along(triangle.b, ray.direction)
    if not (hit.u >= 0.0 and hit.v >= 0.0 and hit.u + hit.v <= 1.0):
        return no_triangle()
    return hit


class TriangleTest(NamedTuple):
    """A triangle test and the record that it reads."""

    intersect: Any
    record: Any
    layout: str  # Name in wrt.accel.triangle_data.LAYOUTS: how corners become a record.
    uses_shear: bool = False  # True if the test reads the watertight test's set-up.


RAY_TRIANGLE = {
    "watertight": TriangleTest(watertight_triangle, Primitive, "corners", uses_shear=True),
    "moeller_trumbore": TriangleTest(moeller_trumbore, Primitive, "edges"),
    "baldwin_weber": TriangleTest(baldwin_weber, PlanePrimitive, "transform"),
    "plane": TriangleTest(plane_equation, PlanePrimitive, "transform"),
}
