"""Traversal of two levels: a binary BVH (TLAS) over placed structures (BLAS), each in its own space.
The lower level is any traversal of kernels.traverse or kernels.wide. It gets the ray in its structure's space, so that a closed mesh stays
watertight when it is placed. The direction is not normalised, so t is equal in both spaces except for a power of two (local_scale). The
upper level must not miss a structure that contains a hit: see `enter`."""

from functools import cache
from typing import Any

import warp as wp

from wrt.kernels.structs import NO_HIT, Hit, Ray
from wrt.kernels.traverse.bvh2 import Bvh2Node, Volumes, make_binary_traversal
from wrt.kernels.traverse.common import Probe, Units
from wrt.kernels.traverse.observer import Recorder, make_observer
from wrt.kernels.units.box import BoxRay, ray_aabb

HALF_STEP = wp.constant(wp.float64(2.0**-150))  # Half the distance of the numbers in float32 that are below 2^-126.


@wp.struct
class Placement:
    """A structure placed in the scene."""

    bottom: int  # Index of the structure in Instances.bottoms.
    first_prim: int  # prim_id, in the scene, of the structure's first primitive.
    local_x: wp.vec4d  # local_x, local_y, local_z: rows of the affine map from world space to the structure's space.
    local_y: wp.vec4d
    local_z: wp.vec4d


@cache
def make_struct(bottom: Any) -> Any:
    """Make the type of the two-level structure over structures of type `bottom`."""

    @wp.struct
    class Instances:
        nodes: wp.array(dtype=Bvh2Node)  # One tree per world (separate scene); leaves are ranges of placements.
        wide: wp.array(dtype=wp.float32)  # The same trees in plain nodes with 8 children (wide/layout.py), if `bottom` is WideBvh.
        roots: wp.array(dtype=wp.int32)  # Index in `wide` of each world's root.
        placements: wp.array(dtype=Placement)
        bottoms: wp.array(dtype=bottom)
        ids: wp.array(dtype=wp.int32)  # Value of hits.instance of each placement.
        bodies: wp.array(dtype=wp.int32)  # By the value of hits.instance: a number that a ray can exclude.
        masks: wp.array(dtype=wp.int32)  # By the value of hits.instance: 32 bits; a ray that shares none does not see the instance.
        bases: wp.array(dtype=wp.int64)  # Address at which each structure begins in traces (Recorder.base).
        slack: wp.array(dtype=float)  # For the root of each tree in `nodes`: factor by which `enter` widens boxes.
        recorder: Recorder

    return Instances


@wp.struct
class WidenedRay:
    """A ray for the box test `enter`, which widens the boxes of the upper level so that rounding loses no hit."""

    box: BoxRay  # The ray in world space.
    slack: float  # Widening of a box on each side, as a fraction of the distance to the box's farthest corner.


@wp.func
def enter(ray: BoxRay, lo: wp.vec3, hi: wp.vec3, slack: float, t_max: float) -> float:
    """Return the result of `ray_aabb` for the box widened by slack times the distance to the box's farthest corner.

    In the structure's space, origin o and direction d are rounded to float32: a point is off by u (|o| + t |d|) per axis. A hit may
    be 17 u t |d| outside its primitive's box (3 for the slabs, 14 for FAR_PAD). In world space, with the map A from the structure to the
    world, that is at most u (2 + 17) |A| |A^-1| times the distance. The builder's box contains the part u |A| times the coordinates
    (kernels.build.moves). The rounding of this test adds 4.

    slack = 32 u max |A| |A^-1| covers these errors; |A| is the largest sum of absolute values in a row. So the returned t is never greater
    than the t of a hit inside, and no hit is lost, in any order of visits.
    """
    if lo[0] > hi[0]:
        return float(wp.inf)  # an empty box, which widening would make non-empty
    to_lo = wp.abs(lo - ray.origin)
    to_hi = wp.abs(hi - ray.origin)
    pad = slack * wp.max(wp.max(to_lo), wp.max(to_hi))
    widening = wp.vec3(pad, pad, pad)
    return ray_aabb(ray, lo - widening, hi + widening, t_max)


@wp.func
def power_of_two(longest: wp.float64) -> wp.float64:
    """Return a power of two. Its product with `longest` (> 0) is between 2^-64 and 2^64, the range for a direction's longest component."""
    scale = wp.float64(1.0)
    x = longest
    steps = int(0)
    while steps < 16 and (x > wp.float64(wp.static(2.0**64)) or x < wp.float64(wp.static(2.0**-64))):  # 16 steps suffice for any float64
        if x > wp.float64(wp.static(2.0**64)):
            x = x * wp.float64(wp.static(2.0**-96))
            scale = scale * wp.float64(wp.static(2.0**-96))
        else:
            x = x * wp.float64(wp.static(2.0**96))
            scale = scale * wp.float64(wp.static(2.0**96))
        steps += 1
    return scale


@wp.func
def local_scale(place: Placement, direction: wp.vec3) -> wp.float64:
    """Return the power of two by which `local_ray` scales the direction. Multiplied by it, a local t becomes t in world space."""
    d = wp.vec4d(wp.float64(direction[0]), wp.float64(direction[1]), wp.float64(direction[2]), wp.float64(0.0))
    return power_of_two(
        wp.max(wp.max(wp.abs(wp.dot(place.local_x, d)), wp.abs(wp.dot(place.local_y, d))), wp.abs(wp.dot(place.local_z, d)))
    )


@wp.func
def last_local(t: float, scale: wp.float64) -> float:
    """Return the largest local t whose t in world space, rounded to float32, is at most t. Below 2^-126 many local t round to one."""
    local = float((wp.float64(t) + HALF_STEP) / scale)
    if local > 0.0 and float(wp.float64(local) * scale) > t:
        local = wp.cast(wp.cast(local, wp.int32) - 1, wp.float32)
    return local


@wp.func
def first_local(t: float, scale: wp.float64) -> float:
    """Return the smallest local t >= 0 that is at least t in world space."""
    local = float((wp.float64(t) - HALF_STEP) / scale)
    local = wp.where(local <= 0.0, 0.0, local)  # also for -0
    if float(wp.float64(local) * scale) < t:
        local = wp.cast(wp.cast(local, wp.int32) + 1, wp.float32)
    return local


@wp.func
def local_ray(place: Placement, ray: Ray, scale: wp.float64) -> Ray:
    """Transform a ray to the structure's space, in float64, rounded once; scale: the result of `local_scale`."""
    o = wp.vec4d(wp.float64(ray.origin[0]), wp.float64(ray.origin[1]), wp.float64(ray.origin[2]), wp.float64(1.0))
    d = wp.vec4d(wp.float64(ray.direction[0]), wp.float64(ray.direction[1]), wp.float64(ray.direction[2]), wp.float64(0.0))
    out = Ray()
    out.origin = wp.vec3(float(wp.dot(place.local_x, o)), float(wp.dot(place.local_y, o)), float(wp.dot(place.local_z, o)))
    out.direction = wp.vec3(
        float(scale * wp.dot(place.local_x, d)), float(scale * wp.dot(place.local_y, d)), float(scale * wp.dot(place.local_z, d))
    )
    out.t_min = first_local(ray.t_min, scale)
    out.t_max = last_local(ray.t_max, scale)
    out.exclude_plus_one = ray.exclude_plus_one
    out.slot = ray.slot
    out.first_prim = place.first_prim
    return out


def make_sees(lists: bool, struct: Any) -> Any:
    """Make sees(accel, surfaces, ray, placement), which tests whether a ray sees a placement; lists: see Units."""

    @wp.func
    def sees(accel: struct, surfaces: Any, ray: Ray, placement: int) -> bool:
        id = accel.ids[placement]
        if wp.static(lists):
            exclude = surfaces.exclude[ray.slot]
            mask = surfaces.mask[ray.slot]
        else:
            exclude = surfaces.exclude
            mask = surfaces.mask
        return (exclude == -1 or accel.bodies[id] != exclude) and (accel.masks[id] & mask) != 0

    return sees


def make_placed_leaf(units: Units, any_hit: bool, bottom: Any, struct: Any) -> Any:
    """Make visit_leaf (kernels.traverse.leaf) for the upper level; bottom: the traversal of the placed structures."""
    observe, sees = make_observer(units, 0), make_sees(units.lists, struct)

    @wp.func
    def visit(accel: struct, surfaces: Any, ray: Ray, index: int, best: Hit) -> Hit:
        """Return the closer of `best` and the hit in placement `index`; at equal t, the hit with the lower prim_id.
        With Units.lists, `surfaces` is HitLists, which receives the hits; the result is a miss."""
        if wp.static(units.filtered):
            if not sees(accel, surfaces, ray, index):
                return best
        place = accel.placements[index]
        structure = accel.bottoms[place.bottom]
        if wp.static(units.observer != ""):
            structure.recorder = accel.recorder
            structure.recorder.base = accel.bases[place.bottom]
        scale = local_scale(place, ray.direction)
        near = ray
        near.t_max = best.t
        local = local_ray(place, near, scale)
        if wp.static(units.lists):
            surfaces.scale[ray.slot] = scale
            surfaces.to_face[ray.slot] = surfaces.first_face[place.bottom] - place.first_prim
            bottom(structure, surfaces, local)
            best.t = wp.min(best.t, surfaces.end[ray.slot])
            return best
        if wp.static(units.resumes):
            local.t_min = last_local(near.t_min, scale)  # else a hit whose t rounds to t_min would be found again
        hit = bottom(structure, surfaces, local)
        hit.t = float(wp.float64(hit.t) * scale)
        if hit.prim_id < 0 or hit.t > best.t or (hit.t == best.t and hit.prim_id > best.prim_id):
            return best
        return hit

    @wp.func
    def visit_leaf(accel: struct, surfaces: Any, probe: Probe, first: int, count: int, best: Hit) -> Hit:
        observe.leaf(accel.recorder, probe.ray, first, count)
        for i in range(first, first + count):
            best = visit(accel, surfaces, probe.ray, i, best)
            if wp.static(any_hit):
                if best.prim_id != NO_HIT:
                    break
        return best

    return visit_leaf


def make_traversal(units: Units, any_hit: bool, bottom: Any, bottom_struct: Any) -> Any:
    """Make traverse(accel, surfaces, ray) -> Hit: the closest hit or, with any_hit, the first hit found. The root of the upper level is
    node ray.first_prim. bottom: the lower level's traversal, made with the same units."""
    struct = make_struct(bottom_struct)

    @wp.func
    def set_up(accel: struct, probe: Probe) -> WidenedRay:
        out = WidenedRay()
        out.box = probe.box
        out.slack = accel.slack[probe.ray.first_prim]
        return out

    @wp.func
    def enter_both(ray: WidenedRay, node: Bvh2Node, t_max: float) -> wp.vec2:
        return wp.vec2(enter(ray.box, node.lo_0, node.hi_0, ray.slack, t_max),
                       enter(ray.box, node.lo_1, node.hi_1, ray.slack, t_max))

    @wp.func
    def root(ray: Ray) -> int:
        return ray.first_prim

    volumes = Volumes(struct, Bvh2Node, set_up, enter_both, root=root)
    visit_leaf = make_placed_leaf(units, any_hit, bottom, struct)
    return make_binary_traversal(units._replace(instances=False), volumes, visit_leaf, any_hit)
