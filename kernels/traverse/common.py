"""The test of one primitive, and the options of a traversal: common to all structures."""

from typing import Any, NamedTuple

import warp as wp

from wrt.kernels.structs import NO_HIT, Hit, Ray, Surfaces
from wrt.kernels.units.box import RAY_AABB, BoxRay, box_ray
from wrt.kernels.units.sphere import ray_sphere
from wrt.kernels.units.triangle import RAY_TRIANGLE, TriangleRay, triangle_ray


class Units(NamedTuple):
    """Options with which a traversal is compiled."""

    triangle: str = "watertight"  # Name of the triangle test in RAY_TRIANGLE.
    box: str = "conservative"  # Name of the box test in RAY_AABB.
    spheres: bool = False  # True if primitives may be spheres.
    observer: str = ""  # How a walk is observed (kernels.traverse.observer): "" (not at all), "sum", or "log".
    instances: bool = False  # True if the structure is placed by instances: Ray.first_prim is added to each prim_id.
    resumes: bool = False  # True to resume behind a hit: a hit at t_min counts only if prim_id >= Ray.slot. No spheres.
    filtered: bool = False  # True to pass through instances by body and mask. `surfaces` is structs.Filter, or with lists HitLists.
    lists: bool = False  # True to list all hits (kernels.hit_lists) instead of the best hit.

    @property
    def triangle_test(self) -> Any:
        return RAY_TRIANGLE[self.triangle]

    @property
    def box_test(self) -> Any:
        return RAY_AABB[self.box]


@wp.struct
class Probe:
    """A ray, set up for the box unit and the triangle unit."""

    ray: Ray
    box: BoxRay
    triangle: TriangleRay


@wp.func
def no_hit(ray: Ray) -> Hit:
    """Return the best hit at the start of a walk: a miss with t = t_max, so that a hit exactly at t_max still counts.
    A ray that is not finite gets t = -inf, an empty segment: with NaN in its comparisons, it would enter every box."""
    best = Hit()
    zero = 0.0 * ray.origin + 0.0 * ray.direction  # components are 0 or NaN; a sum of the components themselves could overflow
    s = zero[0] + zero[1] + zero[2]
    best.t = wp.where(s == 0.0, ray.t_max, float(-wp.inf))  # the compiler would not inline wp.isfinite
    best.prim_id = NO_HIT
    return best


def make_probe(units: Units) -> Any:
    """Make probe_of(ray) -> Probe. The triangle set-up is left out if the triangle test does not use it."""

    @wp.func
    def probe_of(ray: Ray) -> Probe:
        probe = Probe()
        probe.ray = ray
        probe.box = box_ray(ray)
        if wp.static(units.triangle_test.uses_shear):
            probe.triangle = triangle_ray(ray)
        return probe

    return probe_of


def make_better(units: Units, accepts: Any = None) -> Any:
    """Make better(ray, surfaces, hit, prim_id, best), which returns the better of two hits.
    accepts(surfaces, prim_id, u, v) -> bool may reject a hit, as cut-outs do; None accepts all hits. With units.lists, the signature is
    accepts(lists, ray, hit, best) -> Hit. It stores the hit in `lists`, which is passed as `surfaces`, and returns the next `best`."""

    @wp.func
    def better(ray: Ray, surfaces: Any, hit: Hit, prim_id: int, best: Hit) -> Hit:
        """Return the hit of primitive prim_id if t is in [t_min, best.t], else `best`; at equal t, the hit with the lower prim_id."""
        if hit.prim_id == NO_HIT or not (hit.t >= ray.t_min and hit.t <= best.t):
            return best
        if hit.t == best.t and prim_id > best.prim_id:
            return best
        if wp.static(units.resumes):
            if hit.t == ray.t_min and prim_id < ray.slot:
                return best
        if wp.static(units.lists):
            hit.prim_id = prim_id
            return accepts(surfaces, ray, hit, best)
        if wp.static(accepts is not None and not units.lists):
            if not accepts(surfaces, prim_id, hit.u, hit.v):
                return best
        hit.prim_id = prim_id
        return hit

    return better


@wp.func
def sphere_hit(probe: Probe, surfaces: Surfaces, prim_id: int) -> Hit:
    sphere = surfaces.spheres[prim_id - surfaces.n_triangles]
    return ray_sphere(probe.box, probe.ray, wp.vec3(sphere[0], sphere[1], sphere[2]), sphere[3])


def make_intersect(units: Units, accepts: Any = None) -> Any:
    """Make intersect(probe, surfaces, primitive, best), which tests one primitive and returns the better hit; accepts: see make_better."""
    record = units.triangle_test.record
    ray_triangle = units.triangle_test.intersect
    better = make_better(units, accepts)

    @wp.func
    def intersect(probe: Probe, surfaces: Any, primitive: record, best: Hit) -> Hit:
        prim_id = primitive.prim_id
        if wp.static(units.instances):
            prim_id = primitive.prim_id + probe.ray.first_prim
        if prim_id + 1 == probe.ray.exclude_plus_one:  # first, because the test of the triangle at the ray's origin takes long
            return best
        hit = Hit()
        if wp.static(units.spheres):
            if prim_id >= surfaces.n_triangles:
                hit = sphere_hit(probe, surfaces, prim_id)
            else:
                hit = ray_triangle(probe.box, probe.triangle, probe.ray, primitive)
        else:
            hit = ray_triangle(probe.box, probe.triangle, probe.ray, primitive)
        return better(probe.ray, surfaces, hit, prim_id, best)

    return intersect
