"""The test of a primitive, shared by all traversal units."""

from typing import Any, NamedTuple

import warp as wp

from wrt.kernels.structs import NO_HIT, Hit, Ray, Surfaces
from wrt.kernels.units.box import RAY_AABB, BoxRay, box_ray
from wrt.kernels.units.sphere import ray_sphere
from wrt.kernels.units.triangle import RAY_TRIANGLE, TriangleRay, triangle_ray


class Units(NamedTuple):
    """Options of a traversal unit."""

    triangle: str = "watertight"  # Name in RAY_TRIANGLE.
    box: str = "conservative"  # Name in RAY_AABB.
    spheres: bool = False  # True if primitives may be spheres.
    counters: bool = False  # True to count.
    instances: bool = False  # True below instances: Ray.first_prim is added to each prim_id.
    resumes: bool = False  # True to go on behind a hit: at t_min, only prim_id >= Ray.slot counts; no spheres.
    lists: bool = False  # True to list all hits (kernels.hit_lists) in place of the best.
    stack: str = "local"  # Place of the stack, in kernels.traverse.stack.PLACES, for units that have the choice.

    @property
    def triangle_test(self) -> Any:
        return RAY_TRIANGLE[self.triangle]

    @property
    def box_test(self) -> Any:
        return RAY_AABB[self.box]


@wp.struct
class Probe:
    """A ray with the set-up of both units: what the SM hands to the RT core."""

    ray: Ray
    box: BoxRay
    triangle: TriangleRay


@wp.func
def no_hit(ray: Ray) -> Hit:
    """Best hit before a walk: a miss at the segment's end, so that a hit exactly there still counts. A ray that is not finite gets an
    empty segment: comparisons with NaN would let it enter every box, empty ones too."""
    best = Hit()
    zero = 0.0 * ray.origin + 0.0 * ray.direction  # 0 or NaN; the components' sum could overflow
    s = zero[0] + zero[1] + zero[2]
    best.t = wp.where(s == 0.0, ray.t_max, float(-wp.inf))  # wp.isfinite would be a call
    best.prim_id = NO_HIT
    return best


def make_probe(units: Units) -> Any:
    """Make probe_of(ray) -> Probe, the set-up of both units."""

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
    """Make the unit that keeps the better of two hits.
    accepts(surfaces, prim_id, u, v) -> bool may reject a hit (cut-outs); None accepts all. With units.lists, it is accepts(lists, ray,
    hit, best) -> Hit: it stores the hit in `lists`, passed as `surfaces`, and returns the next `best`."""

    @wp.func
    def better(ray: Ray, surfaces: Any, hit: Hit, prim_id: int, best: Hit) -> Hit:
        """Closer of `best` and a primitive's hit in [t_min, best.t]; the lower prim_id at equal t."""
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
    """Make the unit that tests one primitive and keeps the better hit; accepts: of make_better."""
    record = units.triangle_test.record
    ray_triangle = units.triangle_test.intersect
    better = make_better(units, accepts)

    @wp.func
    def intersect(probe: Probe, surfaces: Any, primitive: record, best: Hit) -> Hit:
        prim_id = primitive.prim_id
        if wp.static(units.instances):
            prim_id = primitive.prim_id + probe.ray.first_prim
        if prim_id + 1 == probe.ray.exclude_plus_one:  # before the test: a ray's own triangle, at its origin, is a hard case
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
