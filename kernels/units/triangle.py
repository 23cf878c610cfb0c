"""The triangle unit: where does a ray meet a triangle?

`watertight` is Woop, Benthin and Wald 2013, "Watertight Ray/Triangle Intersection" (JCGT 2(1)): the triangle is moved and
sheared so that the ray becomes the z axis, and three signed areas around the origin decide. Two triangles with a common
edge compute the same area with opposite sign, so that no ray passes between them. The other tests are here to be compared with
it: RAY_TRIANGLE is the table of all. A test takes the ray's set-up and one record, and gives a `Hit` on the whole line.

**What runs.** This file takes one triangle and one ray. It runs everywhere but in two places on a CPU: closest_hit and any_hit of
arrays through bvh8 (the default), and pictures through it. Those run the same steps in lanes, kernels/wide/triangle.h, and
tests/kernels/wide/test_packets.py holds both to the same bits. The one-ray walk of bvh4, bvh8 and bvh8c drops triangles that the
ray misses by far in lanes (wide/lanes.py), and asks this file about the others. kernels/README.md has the whole table.
"""

from typing import Any, NamedTuple

import warp as wp

from wrt.kernels.structs import NO_HIT, Hit, PlanePrimitive, Primitive, Ray, noinline, on_cuda
from wrt.kernels.units.box import FAR_PAD, BoxRay, box_pad, padded_hi, padded_lo, slab_interval
from wrt.kernels.units.float_float import difference_of_products, pair_quotient, pair_sum, pair_times, rounds_to_one

# How far clamping t to its box may move it through rounding: seven of them (wrt.lab.oracle.bounds), and one step of a denormal t.
CLAMP_ROUNDING = wp.constant(7.0 * 2.0**-24)
CLAMP_STEP = wp.constant(2.0**-149)
# A ray that crosses an axis by less than this part of its way, or of its length, may have a shear that underflowed.
SLOWEST = wp.constant(2.0**-120)
U_SQUARED = 2.0**-48  # of float32's unit roundoff u


@wp.struct
class TriangleRay:
    """What the triangle unit needs of a ray: the axis order (kz: the direction's largest), and the shear."""

    kx: int
    ky: int
    kz: int
    shear_x: float
    shear_y: float
    shear_z: float


@wp.func
def component(v: wp.vec3, k: int) -> float:
    """v[k] by selection: an index that is not known when compiling would send v through memory."""
    return wp.where(k == 0, v[0], wp.where(k == 1, v[1], v[2]))


@wp.func
def triangle_ray(ray: Ray) -> TriangleRay:
    """Set-up, once a ray."""
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
    # Swapping x and y where the ray runs against the axis keeps the winding.
    out.kx = wp.where(d_z < 0.0, ky, kx)
    out.ky = wp.where(d_z < 0.0, kx, ky)
    out.kz = kz
    out.shear_x = component(d, out.kx) / d_z
    out.shear_y = component(d, out.ky) / d_z
    out.shear_z = 1.0 / d_z
    return out


@wp.func
def sheared(v: wp.vec3, shear_x: float, shear_y: float) -> wp.vec3:
    """A corner, relative to the origin and in the ray's order of axes, moved so that the ray is the z axis."""
    return wp.vec3(v[0] - shear_x * v[2], v[1] - shear_y * v[2], v[2])


@wp.func
def seen(v: wp.vec3, shear: TriangleRay) -> wp.vec3:
    """A corner, relative to the origin in world space, as the ray sees it."""
    turned = wp.vec3(component(v, shear.kx), component(v, shear.ky), component(v, shear.kz))
    return sheared(turned, shear.shear_x, shear.shear_y)


@wp.func
def edge_areas(a: Any, b: Any, c: Any):
    """Twice the signed areas of the z axis with each edge: of bc, ca, ab."""
    return type(a)(c[0] * b[1] - c[1] * b[0], a[0] * c[1] - a[1] * c[0], b[0] * a[1] - b[1] * a[0])


@wp.func
def outside(areas: Any) -> bool:
    """Whether two of the areas have different signs: the z axis passes the triangle. NaN has no sign."""
    zero = areas.dtype(0.0)
    return ((areas[0] < zero or areas[1] < zero or areas[2] < zero)
            and (areas[0] > zero or areas[1] > zero or areas[2] > zero))


@wp.func
def inside_edge(area: wp.float64, start: wp.vec3, end: wp.vec3, winding: wp.float64) -> bool:
    """Whether the z axis is on the triangle's side of the edge from start to end, where its area is; if it is on the edge, whether
    it would be with the axis moved to (e, e^2), e > 0 and as small as one likes."""
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
    """Whether the z axis, moved aside as little as that, meets the triangle of sheared corners.

    It then meets no edge and no corner: of the triangles around one, those count that a line beside it crosses. Symbolic
    perturbation: Edelsbrunner and Muecke 1990, "Simulation of Simplicity"."""
    areas = edge_areas(wp.vec3d(a), wp.vec3d(b), wp.vec3d(c))
    winding = areas[0] + areas[1] + areas[2]
    return (inside_edge(areas[0], c, b, winding) and inside_edge(areas[1], a, c, winding)
            and inside_edge(areas[2], b, a, winding))


@wp.func
def no_triangle() -> Hit:
    hit = Hit()
    hit.t = float(wp.inf)
    hit.prim_id = NO_HIT
    return hit


@wp.func
def crossing(a: wp.vec3, b: wp.vec3, c: wp.vec3, shear_z: float) -> Hit:
    """Where the z axis meets the triangle of sheared corners, in float64, where products of float32 are exact: the areas' signs
    are exact, and seen nearly edge-on, where the areas cancel, t, u and v keep their digits."""
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
    """`crossing`, for a GPU: all float64 of its traversals is in this function."""
    return crossing(a, b, c, shear_z)


@wp.func
def sure_crossing(a: wp.vec3, b: wp.vec3, c: wp.vec3, shear_z: float) -> Hit:
    """What `crossing` finds, to the last bit, without float64; prim_id is NO_HIT where that is not sure.

    With w_i the exact areas, A their sum, Q the sum of their products' sizes and Z the farthest of |z|: an area is off by 3.1 u^2 Q
    here, A by 9.2, the sum of w_i z_i by 12.2 Z and each quotient by 30 u^2 of itself. That is 43 u^2 Q / A for u and v and
    56 u^2 Q / A Z |shear_z| for t; float64 is off by less than one of these u^2, and `rounds_to_one` takes one. Where nothing
    that is nearer than 64 rounds otherwise, float64 has rounded to the same. The ranges of Q and Z keep what under- and overflows
    out of this: products of a low part may lose 2^-150, but u^2 Q and u^2 Q Z are 2^-138 at least.
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
    if rounds_to_one(t, error * far * wp.abs(shear_z)) and rounds_to_one(u, error) and rounds_to_one(v, error):
        hit.t = t[0]
        hit.u = u[0]
        hit.v = v[0]
        hit.prim_id = 0
    return hit


@wp.func
def watertight(origin: wp.vec3, shear: TriangleRay, v0: wp.vec3, v1: wp.vec3, v2: wp.vec3) -> Hit:
    """Both sides count. The hit lies on the whole line: t may be negative. prim_id is 0 on a hit, else NO_HIT.

    Products of two float32 are monotone, so an area's sign can only be wrong where it is 0, under- or overflows: most
    triangles are refused in float32. For the others the areas are taken again in float64 (`crossing`). GPUs are slow at that: there
    float-float arithmetic gives the same bits where it is sure of them, and float64 decides the hard cases alone. A triangle that
    is seen exactly edge-on is missed, and so are NaN coordinates: the record of a triangle without area has them, as corners
    on a line may no longer be on one after their rounding here (wrt.accel.triangle_data.corners).

    Domain: differences of coordinates below 2^127, and a direction whose longest component is between 2^-64 and 2^64
    (kernels.query brings others there); beyond, rays may be lost. The error bounds are in wrt.lab.oracle.bounds.
    """
    a = seen(v0 - origin, shear)
    b = seen(v1 - origin, shear)
    c = seen(v2 - origin, shear)
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
    """wp.min without its care for NaN, which costs more than the comparison."""
    return wp.vec3(wp.where(b[0] < a[0], b[0], a[0]), wp.where(b[1] < a[1], b[1], a[1]), wp.where(b[2] < a[2], b[2], a[2]))


@wp.func
def upper(a: wp.vec3, b: wp.vec3) -> wp.vec3:
    return wp.vec3(wp.where(b[0] > a[0], b[0], a[0]), wp.where(b[1] > a[1], b[1], a[1]), wp.where(b[2] > a[2], b[2], a[2]))


@wp.func
def padded_interval(ray: BoxRay, lo: wp.vec3, hi: wp.vec3) -> wp.vec2:
    """The slab interval of a primitive's padded box: the box that structures are built from."""
    pad = box_pad(lo, hi)
    return slab_interval(ray, padded_lo(lo, pad), padded_hi(hi, pad))


@wp.func
def clamped(t: float, interval: wp.vec2) -> float:
    """t moved into the interval; its entry where the interval is empty."""
    inside = wp.where(t > interval[1], interval[1], t)
    return wp.where(inside < interval[0], interval[0], inside)


@wp.func
def underflowed(ray: BoxRay, t: float, moved: float) -> bool:
    """Whether clamping t to a box moved it farther than rounding explains, on a ray whose shear may have underflowed.

    Such a ray crosses some axis by less than 2^-120 on its way to t, or by less than 2^-120 of its length. What underflows puts the
    sheared corners off by 2^-150 (1 + the distance): of any other ray's way that is 2^-29 at most, but divided by such a component
    of the direction, as in the distance to a slab, it is any length.
    """
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
    """t moved into the interval of the primitive's own box, or inf where the ray passes by even the padded box.

    Rounding can put t before the place where the ray enters the box around the triangle. A traversal that visits boxes front
    to back would then drop some nodes or not, depending on the order. With t inside the box's own interval, and boxes
    monotone (a node's contains its triangles' padded ones), every structure finds the same hits to the last bit.

    Where the shear underflowed, the slabs tell where the exact ray enters and leaves, but t belongs to a ray beside it, which may
    never be in the box. It is in the padded box: t is then only moved into the interval of that.
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
    """The default unit: watertight, with t clamped to the triangle's own box."""
    hit = watertight(box.origin, shear, v0, v1, v2)
    if hit.prim_id != NO_HIT:
        hit.t = within_bounds(box, hit.t, lower(lower(v0, v1), v2), upper(upper(v0, v1), v2))
        if not wp.abs(hit.t) < wp.inf:
            hit.prim_id = NO_HIT
    return hit


@wp.func
def watertight_triangle(box: BoxRay, shear: TriangleRay, ray: Ray, triangle: Primitive) -> Hit:
    return ray_triangle(box, shear, triangle.v0, triangle.v1, triangle.v2)


@wp.func
def moeller_trumbore(box: BoxRay, shear: TriangleRay, ray: Ray, triangle: Primitive) -> Hit:
    """Moeller and Trumbore 1997, "Fast, Minimum Storage Ray/Triangle Intersection": Cramer's rule on two edges (v1, v2 here).

    Each triangle rounds its edges by itself: a ray can pass between two neighbours, or hit both.
    """
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
    return plane[0] * point[0] + plane[1] * point[1] + plane[2] * point[2] + plane[3]


@wp.func
def along(plane: wp.vec4, direction: wp.vec3) -> float:
    return plane[0] * direction[0] + plane[1] * direction[1] + plane[2] * direction[2]


@wp.func
def plane_equation(box: BoxRay, shear: TriangleRay, ray: Ray, triangle: PlanePrimitive) -> Hit:
    """The plane equation A x + B y + C z = X, solved for t, and the point there in barycentric coordinates.

    Three caveats: a ray parallel to the plane (the divisor is 0) is out before the division; a t outside the segment is out
    (the caller looks at t_min and t_max); and the point counts only within the triangle, u, v >= 0 and u + v <= 1. c is the
    plane with its unit normal; a and b give u and v of a point on it.
    """
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
    """Baldwin and Weber 2016, "Fast Ray-Triangle Intersections by Coordinate Transformation" (JCGT 5(3)).

    The rows a, b, c are the affine map that takes the triangle to (0,0,0), (1,0,0), (0,1,0); the ray is mapped, and meets
    z = 0. The paper saves three of the twelve numbers by fixing one coordinate of the free direction; here all are kept.
    """
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
    """One way to test a triangle: the unit, the record that it reads, how corners are written to a record (a name in
    wrt.accel.triangle_data.LAYOUTS), and whether it needs the watertight test's set-up."""

    intersect: Any
    record: Any
    layout: str
    uses_shear: bool = False


RAY_TRIANGLE = {
    "watertight": TriangleTest(watertight_triangle, Primitive, "corners", uses_shear=True),
    "moeller_trumbore": TriangleTest(moeller_trumbore, Primitive, "edges"),
    "baldwin_weber": TriangleTest(baldwin_weber, PlanePrimitive, "transform"),
    "plane": TriangleTest(plane_equation, PlanePrimitive, "transform"),
}
