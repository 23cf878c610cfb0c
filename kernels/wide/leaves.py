"""Tests of a leaf's triangles and spheres, for packets and for interleaved rays (batch.py).

With Units.lists, the tests list all hits; their argument `surfaces` is then HitLists. A leaf has rows of up to WIDTH primitives. For one
ray, all triangles of a row are tested at once. For a packet, each triangle is tested against all rays at once."""

from typing import Any

import warp as wp

from wrt.kernels.rows import put_number
from wrt.kernels.structs import NO_HIT, Hit, Surfaces
from wrt.kernels.traverse.common import Probe, Units, make_better, sphere_hit
from wrt.kernels.wide.lanes import bits, lowest
from wrt.kernels.wide.lanes import value as number
from wrt.kernels.wide.layout import FIELD, LANES, PRIM_ID_ROW, ROW_SIZE, WIDTH
from wrt.kernels.wide.packets import (
    Scratch,
    WideBvh,
    count_of,
    keep_best,
    list_triangles,
    make_list_ray_triangles,
    make_ray_triangles,
    make_triangles,
    restore_best,
    spheres_of,
    store_bits,
)
from wrt.kernels.wide.references import leaf_count, leaf_first

PRIM_ID = WIDTH * PRIM_ID_ROW  # Index of the first prim_id in a row of primitives.
FEW_RAYS = 6  # If a packet has at most so many rays in a leaf, the rays are tested one by one.


@wp.func
def vector(packet: wp.array(dtype=wp.float32), first: int) -> wp.vec3:
    """Return three consecutive fields of one ray as a vec3; first: index in `packet` of the ray's entry in the first of these fields."""
    return wp.vec3(number(packet, first), number(packet, first + LANES), number(packet, first + 2 * LANES))


@wp.func
def probe_at(packet: wp.array(dtype=wp.float32), ray: int) -> Probe:
    """Return the sphere unit's input for one ray of a packet; ray: index of the ray's column in `packet`."""
    probe = Probe()
    probe.ray.origin = vector(packet, ray + wp.static(FIELD["origin_x"]))
    probe.ray.direction = vector(packet, ray + wp.static(FIELD["direction_x"]))
    probe.ray.t_min = number(packet, ray + wp.static(FIELD["t_min"]))
    probe.ray.exclude_plus_one = bits(packet, ray + wp.static(FIELD["exclude"]))
    probe.box.origin = probe.ray.origin
    probe.box.inv_dir = vector(packet, ray + wp.static(FIELD["inverse_x"]))
    probe.box.t_min = probe.ray.t_min
    return probe


@wp.func
def best_at(packet: wp.array(dtype=wp.float32), ray: int) -> Hit:
    best = Hit()
    best.t = number(packet, ray + wp.static(FIELD["t"]))
    best.u = number(packet, ray + wp.static(FIELD["u"]))
    best.v = number(packet, ray + wp.static(FIELD["v"]))
    best.prim_id = bits(packet, ray + wp.static(FIELD["prim_id"]))
    return best


@wp.func
def store_best(packet: wp.array(dtype=wp.float32), ray: int, best: Hit):
    put_number(packet, ray + wp.static(FIELD["t"]), best.t)
    put_number(packet, ray + wp.static(FIELD["u"]), best.u)
    put_number(packet, ray + wp.static(FIELD["v"]), best.v)
    store_bits(packet, ray + wp.static(FIELD["prim_id"]), best.prim_id)


def make_sphere_test(units: Units, any_hit: bool, accepts: Any) -> Any:
    """Return test_spheres, which tests the spheres in the mask of a row against one ray (`ray`: index of its column).
    It returns whether the ray is finished: for any-hit rays, whether the ray hits a sphere; else False."""
    better = make_better(units, accepts)

    @wp.func
    def test_spheres(accel: WideBvh, first: int, mask: int, surfaces: Surfaces, scratch: Scratch, ray: int) -> bool:
        probe = probe_at(scratch.packets, ray)
        best = best_at(scratch.packets, ray)
        while mask != 0:
            prim_id = bits(accel.primitives, first + PRIM_ID + lowest(mask))
            mask = mask & (mask - 1)
            if prim_id + 1 != probe.ray.exclude_plus_one:
                best = better(probe.ray, surfaces, sphere_hit(probe, surfaces, prim_id), prim_id, best)
        found = bool(best.prim_id != NO_HIT)
        if wp.static(any_hit):
            best.t = wp.where(found, -float(wp.inf), best.t)  # The ray's segment is now empty, so it enters no further box.
        store_best(scratch.packets, ray, best)
        return wp.static(any_hit) and found

    return test_spheres


def make_accepted(any_hit: bool, accepts: Any, ray_triangles: Any) -> Any:
    """Return nearest_accepted, which make_row_test uses for triangles whose hits `accepts` may reject (cut-outs)."""

    @wp.func
    def nearest_accepted(accel: WideBvh, first: int, mask: int, surfaces: Surfaces, scratch: Scratch, ray: int) -> bool:
        """Find the nearest hit on a triangle in the mask. If `accepts` rejects the hit, drop the triangle from the mask, and repeat."""
        before = best_at(scratch.packets, ray)
        while True:
            lane = ray_triangles(accel, first, mask, scratch, ray)
            if lane < 0:
                return False
            hit = best_at(scratch.packets, ray)
            if accepts(surfaces, hit.prim_id, hit.u, hit.v):
                break
            store_best(scratch.packets, ray, before)
            mask = mask & ~(1 << lane)
        if wp.static(any_hit):
            put_number(scratch.packets, ray + wp.static(FIELD["t"]), -float(wp.inf))
        return wp.static(any_hit)

    return nearest_accepted


def make_row_test(units: Units, any_hit: bool, accepts: Any, inlined: bool) -> Any:
    """Return test_row, which tests the first `count` primitives of a row against one ray.
    It returns whether the ray is finished: for any-hit rays, whether the ray hits a primitive; else False."""
    ray_triangles = make_ray_triangles(any_hit and accepts is None, inlined)
    list_ray_triangles = make_list_ray_triangles(inlined)
    test_spheres, nearest_accepted = make_sphere_test(units, any_hit, accepts), make_accepted(any_hit, accepts, ray_triangles)

    @wp.func
    def test_row(accel: WideBvh, first: int, count: int, surfaces: Any, scratch: Scratch, ray: int) -> bool:
        mask = (2 << (count - 1)) - 1
        if wp.static(units.spheres):
            spheres = spheres_of(accel, first, mask, surfaces.n_triangles)
            if spheres != 0:
                if test_spheres(accel, first, spheres, surfaces, scratch, ray):
                    return True
                mask = mask & ~spheres
        if wp.static(units.lists):
            list_ray_triangles(accel, first, mask, surfaces, scratch, ray)
            return False
        elif wp.static(accepts is None):
            return ray_triangles(accel, first, mask, scratch, ray) >= 0 and wp.static(any_hit)
        else:
            return nearest_accepted(accel, first, mask, surfaces, scratch, ray)

    return test_row


def make_accepted_in_lanes(any_hit: bool, accepts: Any, test_row: Any) -> Any:
    """Return accepted_in_lanes, which tests the first n triangles of a row against the rays in the mask; `accepts` may reject hits.

    It returns the mask of the finished rays, as test_row. First all triangles count as accepted. Rays whose hit is then rejected take
    back their best hit, and test the row again one by one."""
    triangles = make_triangles(False)

    @wp.func
    def accepted_in_lanes(accel: WideBvh, surfaces: Surfaces, first: int, n: int, mask: int, scratch: Scratch, base: int) -> int:
        keep_best(scratch, base)
        left = triangles(accel, first, n, mask, scratch, base)
        finished = int(0)
        while left != 0:
            lane = lowest(left)
            left = left & (left - 1)
            hit = best_at(scratch.packets, base + lane)
            done = bool(wp.static(any_hit))
            if not accepts(surfaces, hit.prim_id, hit.u, hit.v):
                restore_best(scratch, base, lane)
                done = test_row(accel, first, n, surfaces, scratch, base + lane)
            elif wp.static(any_hit):
                put_number(scratch.packets, base + lane + wp.static(FIELD["t"]), -float(wp.inf))
            if done:
                finished = finished | (1 << lane)
        return finished

    return accepted_in_lanes


def make_packet_leaf(units: Units, any_hit: bool, accepts: Any) -> Any:
    """Return test_leaf, which tests a leaf against the packet's rays in its argument `mask`: all at once, or one by one (FEW_RAYS)."""
    test_row = make_row_test(units, any_hit, accepts, False)
    triangles, accepted_in_lanes = make_triangles(any_hit), make_accepted_in_lanes(any_hit, accepts, test_row)

    @wp.func
    def test_leaf(accel: WideBvh, surfaces: Any, reference: int, mask: int, scratch: Scratch, base: int):
        left = leaf_count(reference)
        first = leaf_first(reference) * ROW_SIZE
        while left > 0 and mask != 0:
            n = wp.min(left, WIDTH)
            lanes = bool(count_of(mask) > FEW_RAYS)
            if wp.static(units.spheres):
                lanes = lanes and spheres_of(accel, first, (2 << (n - 1)) - 1, surfaces.n_triangles) == 0
            if lanes:
                found = int(0)
                if wp.static(units.lists):
                    list_triangles(accel, first, n, mask, surfaces, scratch, base)
                elif wp.static(accepts is None):
                    found = triangles(accel, first, n, mask, scratch, base)
                else:
                    found = accepted_in_lanes(accel, surfaces, first, n, mask, scratch, base)
                if wp.static(any_hit):
                    mask = mask & ~found
            else:
                rays = int(mask)
                while rays != 0:
                    lane = lowest(rays)
                    rays = rays & (rays - 1)
                    if test_row(accel, first, n, surfaces, scratch, base + lane):
                        mask = mask & ~(1 << lane)
            left = left - WIDTH
            first = first + ROW_SIZE

    return test_leaf
