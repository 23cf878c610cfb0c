"""The traversal unit of two levels: a binary BVH (TLAS) over placed structures (BLAS), each in a space of its own.
Any traversal unit is the lower level. It gets the ray in its structure's space and returns its usual hit, so that a closed mesh stays
watertight where it is placed. The direction is not normalised: t is the same in both spaces. This level must never pass by a structure
that has a hit: see `enter`."""

from functools import cache
from typing import Any

import warp as wp

from wrt.kernels.structs import NO_HIT, Hit, Ray, Surfaces
from wrt.kernels.traverse.bvh2 import Bvh2Node, Volumes, make_binary_traversal
from wrt.kernels.traverse.common import Probe, Units
from wrt.kernels.traverse.counters import Counts, Recorder, add_counts
from wrt.kernels.units.box import FAR_PAD, BoxRay, slab_interval


@wp.struct
class Placement:
    """A placed structure."""

    bottom: int  # Index of the structure.
    first_prim: int  # prim_id of its first primitive in the scene.
    local_x: wp.vec4d  # Rows of the affine map from the world to the structure's space: local_x, local_y, local_z.
    local_y: wp.vec4d
    local_z: wp.vec4d


@cache
def make_struct(bottom: Any) -> Any:
    """Make the two levels over structures of this kind."""

    @wp.struct
    class Instances:
        nodes: wp.array(dtype=Bvh2Node)  # A tree for each world; leaves are ranges of placements.
        placements: wp.array(dtype=Placement)
        bottoms: wp.array(dtype=bottom)
        bases: wp.array(dtype=wp.int64)  # Where each structure begins in the traces' address space.
        slack: float  # Factor of the boxes' widening: see `enter`.
        recorder: Recorder

    return Instances


@wp.struct
class WidenedRay:
    """The ray as `enter` reads it."""

    box: BoxRay
    slack: float


@wp.func
def enter(ray: BoxRay, lo: wp.vec3, hi: wp.vec3, slack: float, t_max: float) -> float:
    """Distance of `ray_aabb` to the box widened by slack times the distance to its farthest corner.

    In the structure's space the ray is rounded to float32: its point at t is off by u (|o| + t |d|), per axis. A hit may be u 17 t |d|
    outside of its primitive's box (3 for the slabs, 14 for FAR_PAD). Mapped back to the world, with A the map, that is at most u (2 + 17)
    |A| |A^-1| times the distance. The part u |A| times the coordinates is in the builder's box (wrt.accel.instances). The rounding of this
    test adds 4.

    slack = 32 u max |A| |A^-1| (sums of rows) covers them. So this distance never exceeds a hit's t inside: no hit is passed by, in any
    order of visits.
    """
    if lo[0] > hi[0]:
        return float(wp.inf)  # widened, an empty box would not be empty
    to_lo = wp.abs(lo - ray.origin)
    to_hi = wp.abs(hi - ray.origin)
    pad = slack * wp.max(wp.max(to_lo), wp.max(to_hi))
    widening = wp.vec3(pad, pad, pad)
    interval = slab_interval(ray, lo - widening, hi + widening)
    begin = wp.where(interval[0] > ray.t_min, interval[0], ray.t_min)
    end = interval[1] * FAR_PAD
    end = wp.where(end < t_max, end, t_max)
    return wp.where(begin <= end, begin, float(wp.inf))


@wp.func
def power_of_two(longest: wp.float64) -> wp.float64:
    """Power of two that brings a number > 0 between 2^-64 and 2^64, the range of a direction's longest component; usually 1."""
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
    """Power of two that scales the direction in the structure's space; t there times the scale is t in the world."""
    d = wp.vec4d(wp.float64(direction[0]), wp.float64(direction[1]), wp.float64(direction[2]), wp.float64(0.0))
    return power_of_two(
        wp.max(wp.max(wp.abs(wp.dot(place.local_x, d)), wp.abs(wp.dot(place.local_y, d))), wp.abs(wp.dot(place.local_z, d)))
    )


@wp.func
def local_ray(place: Placement, ray: Ray, scale: wp.float64) -> Ray:
    """Ray in the structure's space: computed in float64, rounded once; scale: `local_scale`."""
    o = wp.vec4d(wp.float64(ray.origin[0]), wp.float64(ray.origin[1]), wp.float64(ray.origin[2]), wp.float64(1.0))
    d = wp.vec4d(wp.float64(ray.direction[0]), wp.float64(ray.direction[1]), wp.float64(ray.direction[2]), wp.float64(0.0))
    out = Ray()
    out.origin = wp.vec3(float(wp.dot(place.local_x, o)), float(wp.dot(place.local_y, o)), float(wp.dot(place.local_z, o)))
    out.direction = wp.vec3(
        float(scale * wp.dot(place.local_x, d)), float(scale * wp.dot(place.local_y, d)), float(scale * wp.dot(place.local_z, d))
    )
    out.t_min = float(wp.float64(ray.t_min) / scale)
    out.t_max = float(wp.float64(ray.t_max) / scale)
    out.exclude_plus_one = ray.exclude_plus_one
    out.slot = ray.slot
    out.first_prim = place.first_prim
    return out


def make_placed_leaf(units: Units, any_hit: bool, bottom: Any, struct: Any) -> Any:
    """Make the leaf of the upper level (kernels.traverse.leaf); bottom: traversal of the placed structures."""

    @wp.func
    def visit(accel: struct, surfaces: Surfaces, ray: Ray, index: int, best: Hit) -> Hit:
        """Better of `best` and the hit in one placed structure; the lower prim_id at equal t."""
        place = accel.placements[index]
        structure = accel.bottoms[place.bottom]
        if wp.static(units.counters):
            structure.recorder = accel.recorder
            structure.recorder.base = accel.bases[place.bottom]
        scale = local_scale(place, ray.direction)
        near = ray
        near.t_max = best.t
        hit = bottom(structure, surfaces, local_ray(place, near, scale))
        hit.t = float(wp.float64(hit.t) * scale)
        if hit.prim_id < 0 or hit.t > best.t or (hit.t == best.t and hit.prim_id > best.prim_id):
            return best
        return hit

    @wp.func
    def visit_leaf(accel: struct, surfaces: Surfaces, probe: Probe, first: int, count: int, best: Hit, counts: Counts):
        if wp.static(units.counters):  # the lower level adds its own counts
            add_counts(accel.recorder, probe.ray.slot, counts)
            counts = Counts()
        for i in range(first, first + count):
            best = visit(accel, surfaces, probe.ray, i, best)
            if wp.static(any_hit):
                if best.prim_id != NO_HIT:
                    break
        return best, counts

    return visit_leaf


def make_traversal(units: Units, any_hit: bool, bottom: Any, bottom_struct: Any) -> Any:
    """Make the unit for the closest hit, or for any hit, in the world whose root is ray.first_prim. bottom: the lower level's traversal,
    made with these units."""
    struct = make_struct(bottom_struct)

    @wp.func
    def set_up(accel: struct, probe: Probe) -> WidenedRay:
        out = WidenedRay()
        out.box = probe.box
        out.slack = accel.slack
        return out

    @wp.func
    def enter_both(ray: WidenedRay, node: Bvh2Node, t_max: float) -> wp.vec2:
        return wp.vec2(enter(ray.box, node.lo_0, node.hi_0, ray.slack, t_max),
                       enter(ray.box, node.lo_1, node.hi_1, ray.slack, t_max))

    @wp.func
    def root(ray: Ray) -> int:
        return ray.first_prim

    volumes = Volumes(struct, Bvh2Node, set_up, enter_both, root)
    # Only the lower walk may use shared memory: this walk goes on behind it.
    visit_leaf = make_placed_leaf(units, any_hit, bottom, struct)
    return make_binary_traversal(units._replace(instances=False, stack="local"), volumes, visit_leaf, any_hit)
