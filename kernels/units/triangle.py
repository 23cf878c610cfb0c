"""The triangle unit: the intersection of a ray with a triangle. RAY_TRIANGLE is the table of triangle tests.

`watertight` follows Woop, Benthin and Wald 2013, "Watertight Ray/Triangle Intersection" (JCGT 2(1)). The triangle is translated and
sheared so that the ray becomes the z axis. The signs of three areas around the origin decide. Two triangles with a common edge compute
the same area with opposite signs, so no ray passes between them. The other tests serve for comparison. A test takes the ray's set-up and
one record, and returns the `Hit` on the infinite line: the caller compares t with the segment.

**What runs.** This file tests one triangle and one ray. On a CPU, pictures and the queries closest_hit, any_hit and all_hits through bvh8
(the default) run the same steps vectorised, in `kernels/wide/triangle.h`, with the same bits (tests/kernels/wide/test_packets.py). The
traversal of bvh4, bvh8 and bvh8c for one ray first rejects most triangles of a row with vector instructions (`wide/lanes.py`), and tests
the other triangles here. The table of all cases is in kernels/README.md.
"""

from typing import Any, NamedTuple

import warp as wp

from wrt.kernels.structs import NO_HIT, Hit, PlanePrimitive, Primitive, Ray, fast_float64, noinline, on_cuda
from wrt.kernels.units.box import FAR_PAD, BoxRay, box_pad, padded_hi, padded_lo, slab_interval
from wrt.kernels.units.float_float import difference_of_products, pair_quotient, pair_sum, pair_times, rounding_is_certain

# Clamping t to the triangle's box moves t by up to seven rounding errors (wrt.lab.oracle.bounds) plus the smallest denormal.
CLAMP_ROUNDING = wp.constant(7.0 * 2.0**-24)
CLAMP_STEP = wp.constant(2.0**-149)
# The shear may underflow on a ray that advances along some axis by less than this fraction of its length.
SLOWEST = wp.constant(2.0**-120)
U_SQUARED = 2.0**-48  # u^2, u = 2^-24


@wp.struct
class TriangleRay:
    """A ray set up for the triangle unit: the order of axes (kz: the axis of the direction's largest component) and the shear."""

    kx: int
    ky: int
    kz: int
    shear_x: float
    shear_y: float
    shear_z: float


@wp.func
def component(v: wp.vec3, k: int) -> float:
    """Return v[k] by selection. With an index unknown at compile time, the compiler would store v to memory."""
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
    # If the ray runs against axis kz, swapping x and y keeps the triangles' winding.
    out.kx = wp.where(d_z < 0.0, ky, kx)
    out.ky = wp.where(d_z < 0.0, kx, ky)
    out.kz = kz
    out.shear_x = component(d, out.kx) / d_z
    out.shear_y = component(d, out.ky) / d_z
    out.shear_z = 1.0 / d_z
    return out


@wp.func
def sheared(v: wp.vec3, shear_x: float, shear_y: float) -> wp.vec3:
    """Shear a corner so that the ray becomes the z axis. The corner is relative to the ray's origin, in the axis order kx, ky, kz."""
    return wp.vec3(v[0] - shear_x * v[2], v[1] - shear_y * v[2], v[2])


@wp.func
def to_ray_space(v: wp.vec3, shear: TriangleRay) -> wp.vec3:
    """Reorder the axes of a corner, relative to the ray's origin, and shear it: into the space in which the ray is the z axis."""
    turned = wp.vec3(component(v, shear.kx), component(v, shear.ky), component(v, shear.kz))
    return sheared(turned, shear.shear_x, shear.shear_y)


@wp.func
def edge_areas(a: Any, b: Any, c: Any):
    """Return twice the signed areas of the triangles (0, b, c), (0, c, a), (0, a, b) in the xy plane; vec3 or vec3d."""
    return type(a)(c[0] * b[1] - c[1] * b[0], a[0] * c[1] - a[1] * c[0], b[0] * a[1] - b[1] * a[0])


@wp.func
def outside(areas: Any) -> bool:
    """Test whether two of the areas have opposite signs, which means that the z axis misses the triangle. NaN has no sign here."""
    zero = areas.dtype(0.0)
    return ((areas[0] < zero or areas[1] < zero or areas[2] < zero)
            and (areas[0] > zero or areas[1] > zero or areas[2] > zero))


@wp.func
def inside_edge(area: wp.float64, start: wp.vec3, end: wp.vec3, winding: wp.float64) -> bool:
    """Test whether the z axis passes the edge from start to end on the triangle's side.
    Argument `area` is the entry of edge_areas for this edge, `winding` the sum of all three, whose sign is the triangle's winding. If the
    axis meets the edge (area 0), it is moved in x and y by (e, e^2), for an infinitesimal e > 0."""
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
    """Test whether the z axis, moved by an infinitesimal, crosses the triangle with these sheared corners.
    The moved axis meets no edge and no corner, so a ray through a common edge crosses exactly one of two neighbours (Edelsbrunner and
    Muecke 1990, "Simulation of Simplicity")."""
    areas = edge_areas(wp.vec3d(a), wp.vec3d(b), wp.vec3d(c))
    winding = areas[0] + areas[1] + areas[2]
    return (inside_edge(areas[0], c, b, winding) and inside_edge(areas[1], a, c, winding)
            and inside_edge(areas[2], b, a, winding))


@wp.func
def no_triangle() -> Hit:
    """Return a miss: t = inf, prim_id = NO_HIT."""
    hit = Hit()
    hit.t = float(wp.inf)
    hit.prim_id = NO_HIT
    return hit


@wp.func
def crossing(a: wp.vec3, b: wp.vec3, c: wp.vec3, shear_z: float) -> Hit:
    """Intersect the z axis with the triangle with these sheared corners, in float64; prim_id is 0 on a hit, else NO_HIT.
    Products of two float32 are exact in float64, and so are the signs of the areas. Therefore t, u and v are accurate even for triangles
    nearly edge-on, where the areas suffer from cancellation."""
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
    """Call `crossing`, without inlining. So the float64 code, which takes many registers, occurs only once in a GPU traversal."""
    return crossing(a, b, c, shear_z)


@wp.func
def sure_crossing(a: wp.vec3, b: wp.vec3, c: wp.vec3, shear_z: float) -> Hit:
    """Compute the bits of `crossing` without float64; prim_id is NO_HIT if they are not certain, or on a miss.

    Let w_i be the exact areas, A their sum, Q the sum of the absolute values of their products, and Z the largest |z|. The error of an area
    is at most 3.1 u^2 Q, of A 9.2 u^2 Q, and of the sum of w_i z_i 12.2 u^2 Q Z. A division adds 30 u^2 of the quotient. In total, u and v
    are off by 43 u^2 Q / A, and t by 56 u^2 (Q / A) Z |shear_z|. Arithmetic in float64 adds less than one such u^2, `rounding_is_certain`
    needs another. If all numbers within 64 u^2 round to the same float32, `crossing` returns that float32. The ranges of Q and Z exclude
    under- and overflow: products of a low part may lose 2^-150, but u^2 Q and u^2 Q Z are at least 2^-138.
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
    """Intersect the infinite line of a ray with a triangle, from both sides; prim_id is 0 on a hit, else NO_HIT. t may be negative.

    Rounded products of two float32 are monotone, so a float32 area with the wrong sign is 0, or has under- or overflowed. Therefore float32
    rejects most triangles, and `crossing` decides the others in float64. On GPUs, where float64 is slow, `sure_crossing` computes the same
    bits in float-float arithmetic; float64 decides only where the bits are uncertain.

    The line misses a triangle exactly edge-on, and a triangle with a NaN coordinate. A triangle without area is stored with NaN, because
    here the rounded shear could give it an area (wrt.accel.geometry.corners).

    Domain: coordinates differ by less than 2^127, and the direction's longest component is between 2^-64 and 2^64 (`kernels.query` scales
    other directions). wrt.lab.oracle.bounds has the error bounds.
    """
    a = to_ray_space(v0 - origin, shear)
    b = to_ray_space(v1 - origin, shear)
    c = to_ray_space(v2 - origin, shear)
    if outside(edge_areas(a, b, c)):
        return no_triangle()
    if on_cuda() and not fast_float64():
        hit = sure_crossing(a, b, c, shear.shear_z)
        if hit.prim_id == NO_HIT:
            hit = hard_crossing(a, b, c, shear.shear_z)
        return hit
    return crossing(a, b, c, shear.shear_z)


@wp.func
def lower(a: wp.vec3, b: wp.vec3) -> wp.vec3:
    """Return the componentwise minimum. wp.min also handles NaN, and takes longer."""
    return wp.vec3(wp.where(b[0] < a[0], b[0], a[0]), wp.where(b[1] < a[1], b[1], a[1]), wp.where(b[2] < a[2], b[2], a[2]))


@wp.func
def upper(a: wp.vec3, b: wp.vec3) -> wp.vec3:
    """Return the componentwise maximum. wp.max also handles NaN, and takes longer."""
    return wp.vec3(wp.where(b[0] > a[0], b[0], a[0]), wp.where(b[1] > a[1], b[1], a[1]), wp.where(b[2] > a[2], b[2], a[2]))


@wp.func
def padded_interval(ray: BoxRay, lo: wp.vec3, hi: wp.vec3) -> wp.vec2:
    """Return the slab interval of the padded box of a primitive with the box lo .. hi. Structures are built from padded boxes."""
    pad = box_pad(lo, hi)
    return slab_interval(ray, padded_lo(lo, pad), padded_hi(hi, pad))


@wp.func
def clamped(t: float, interval: wp.vec2) -> float:
    """Clamp t to the interval (entry, exit); return the entry if the interval is empty."""
    inside = wp.where(t > interval[1], interval[1], t)
    return wp.where(inside < interval[0], interval[0], inside)


@wp.func
def underflowed(ray: BoxRay, t: float, moved: float) -> bool:
    """Test whether clamping moved t farther than rounding explains, on a ray whose shear may have underflowed.
    Such a ray advances along some axis by less than 2^-120 up to t, or by less than 2^-120 of its length. Underflow moves sheared corners
    by 2^-150 (1 + distance): at most 2^-29 of the advance of any other ray. Divided by a tiny component of the direction, as in the
    distance to a slab, the error can have any size."""
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
    """Clamp t to the slab interval of the triangle's box lo .. hi; return inf if the ray misses even the padded box.

    Rounding can put t in front of the triangle's box. Then a traversal from front to back would drop some nodes or not, depending on the
    order of its visits. With t inside the interval, and monotone boxes (a node's box contains the padded boxes of its triangles), every
    structure finds the same hits to the last bit.

    If the shear underflowed, t belongs to a ray beside the exact one, and the exact ray may miss the box. But it meets the padded box, so t
    is clamped to the interval of the padded box.
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
    """Intersect by `watertight`, and clamp t to the triangle's box; prim_id is 0 on a hit, else NO_HIT."""
    hit = watertight(box.origin, shear, v0, v1, v2)
    if hit.prim_id != NO_HIT:
        hit.t = within_bounds(box, hit.t, lower(lower(v0, v1), v2), upper(upper(v0, v1), v2))
        if not wp.abs(hit.t) < wp.inf:
            hit.prim_id = NO_HIT
    return hit


@wp.func
def watertight_triangle(box: BoxRay, shear: TriangleRay, ray: Ray, triangle: Primitive) -> Hit:
    """Intersect a record by `ray_triangle`. This is the default test of RAY_TRIANGLE."""
    return ray_triangle(box, shear, triangle.v0, triangle.v1, triangle.v2)


@wp.func
def moeller_trumbore(box: BoxRay, shear: TriangleRay, ray: Ray, triangle: Primitive) -> Hit:
    """Solve for t, u, v by Cramer's rule; v1 and v2 of the record are the edges from v0.
    Moeller and Trumbore 1997, "Fast, Minimum Storage Ray/Triangle Intersection". Two neighbours round their common edge differently, so a
    ray can pass between them or hit both."""
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
    """Return the value of the plane's equation, normal . point + offset, at a point."""
    return plane[0] * point[0] + plane[1] * point[1] + plane[2] * point[2] + plane[3]


@wp.func
def along(plane: wp.vec4, direction: wp.vec3) -> float:
    """Return the dot product of the plane's normal with a direction."""
    return plane[0] * direction[0] + plane[1] * direction[1] + plane[2] * direction[2]


@wp.func
def plane_equation(box: BoxRay, shear: TriangleRay, ray: Ray, triangle: PlanePrimitive) -> Hit:
    """Solve the equation of the triangle's plane for t, then compute u and v of the point at t.
    The record's plane `c` is the triangle's plane; the values of planes `a` and `b` at the point are u and v. The point is inside if u, v
    >= 0 and u + v <= 1. A ray parallel to the plane (divisor 0) misses."""
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
    Baldwin and Weber 2016, "Fast Ray-Triangle Intersections by Coordinate Transformation" (JCGT 5(3)). The record's a, b, c are the rows of
    the affine map. The direction that maps to the z axis is arbitrary. The paper takes a coordinate axis, so that three of the map's twelve
    numbers are constants. wrt takes the triangle's unit normal, and stores all twelve."""
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

    intersect: Any  # Function (BoxRay, TriangleRay, Ray, record) -> Hit.
    record: Any  # Primitive or PlanePrimitive.
    layout: str  # Name in wrt.accel.geometry.LAYOUTS of the function that converts corners to records.
    uses_shear: bool = False  # True if `intersect` reads the TriangleRay.


RAY_TRIANGLE = {
    "watertight": TriangleTest(watertight_triangle, Primitive, "corners", uses_shear=True),
    "moeller_trumbore": TriangleTest(moeller_trumbore, Primitive, "edges"),
    "baldwin_weber": TriangleTest(baldwin_weber, PlanePrimitive, "transform"),
    "plane": TriangleTest(plane_equation, PlanePrimitive, "transform"),
}
