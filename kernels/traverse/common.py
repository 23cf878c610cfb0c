"""What every traversal unit does with a primitive, whatever structure led to it."""

from typing import Any, NamedTuple

import warp as wp

from wrt.kernels.structs import NO_HIT, Hit, Ray, Surfaces
from wrt.kernels.units.box import RAY_AABB, BoxRay, box_ray
from wrt.kernels.units.sphere import ray_sphere
from wrt.kernels.units.triangle import RAY_TRIANGLE, TriangleRay, triangle_ray


class Units(NamedTuple):
    """What a traversal unit is made of: names in RAY_TRIANGLE and RAY_AABB, whether there are spheres, whether it counts, whether
    it walks instances (Ray.first_prim is then added to each prim_id), whether it goes on behind a hit: at t_min, only primitives
    from Ray.slot on are hit; spheres have two hits, and cannot be gone on from. lists: whether it lists all hits
    (kernels.hit_lists) instead of keeping the best. stack: in kernels.traverse.stack.PLACES, for those who look there."""

    triangle: str = "watertight"
    box: str = "conservative"
    spheres: bool = False
    counters: bool = False
    instances: bool = False
    resumes: bool = False
    lists: bool = False
    stack: str = "local"

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
    """The best hit before anything is found: at the segment's end, so that a hit exactly there still counts.

    A ray that is not finite has an empty segment: comparisons with NaN would let it into every box, the empty ones too.
    """
    best = Hit()
    zero = 0.0 * ray.origin + 0.0 * ray.direction  # 0, or NaN; a sum of the components could overflow
    s = zero[0] + zero[1] + zero[2]
    best.t = wp.where(s == 0.0, ray.t_max, float(-wp.inf))  # wp.isfinite would be a call
    best.prim_id = NO_HIT
    return best


def make_probe(units: Units) -> Any:
    """The set-up of both units, once a ray."""

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
    """The unit that keeps the better of two hits.

    accepts(surfaces, prim_id, u, v) -> bool may refuse a hit (cut-outs); None takes all. Where units.lists, it is
    accepts(lists, ray, hit, best) -> Hit, which takes the hit and gives the next `best`; `surfaces` is what it lists them in.
    """

    @wp.func
    def better(ray: Ray, surfaces: Any, hit: Hit, prim_id: int, best: Hit) -> Hit:
        """The closer of `best` and a primitive's hit (prim_id: NO_HIT where there is none) in [t_min, best.t]; at equal t the lower
        prim_id."""
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
    """The unit that tests one primitive and keeps the better hit. accepts: of make_better."""
    record = units.triangle_test.record
    ray_triangle = units.triangle_test.intersect
    better = make_better(units, accepts)

    @wp.func
    def intersect(probe: Probe, surfaces: Any, primitive: record, best: Hit) -> Hit:
        prim_id = primitive.prim_id
        if wp.static(units.instances):
            prim_id = primitive.prim_id + probe.ray.first_prim
        if prim_id + 1 == probe.ray.exclude_plus_one:  # first: a ray's own triangle, at its origin, is a hard case
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
