"""Traversal of a wide BVH for many rays on the CPU: packets and interleaved rays. The hits have the bits of the traversal for one ray.

Sixteen rays with similar directions walk the tree as a packet (Wald et al. 2001, "Interactive Rendering with Coherent Ray Tracing"). At a
node, a beam around all rays is tested first. The children that the beam enters are then tested against all sixteen rays at once. All other
rays are interleaved: one thread has many rays in progress, and each ray takes one step in turn. So the core has work, while some rays
wait for memory or for the result of an instruction."""

from functools import cache
from typing import Any

import warp as wp

from wrt.kernels.memory import put_int, put_number
from wrt.kernels.query import HitArrays, RayArrays
from wrt.kernels.structs import NO_HIT, Hit, Surfaces
from wrt.kernels.traverse.common import Probe, Units, make_better, sphere_hit
from wrt.kernels.traverse.stack import reference_of, t_of
from wrt.kernels.wide.lanes import bits, lowest
from wrt.kernels.wide.lanes import value as number
from wrt.kernels.wide.layout import (
    ACTIVE,
    COHERENT,
    FIELD,
    LANES,
    MIXED,
    PACKET_SIZE,
    PRIM_ID_ROW,
    REFUSED,
    ROW_SIZE,
    SLOT,
    SLOT_SIZE,
    WIDTH,
)
from wrt.kernels.wide.nodes import far_pad
from wrt.kernels.wide.packets import (
    ANY_REFUSED,
    FAILED,
    MIXED_FAILED,
    MIXED_PAUSED,
    PAUSED,
    REPORT_SIZE,
    Scratch,
    WideBvh,
    count_of,
    keep_best,
    key_at,
    lowest_of_all,
    make_children,
    make_ray_triangles,
    make_set_up,
    make_steps,
    make_triangles,
    packet_kernel,
    prefetch_next,
    rays_at,
    rays_meeting_root,
    rays_reaching,
    restore_best,
    slot_at,
    spheres_of,
    store_bits,
    write_hits,
    write_occluded,
)
from wrt.kernels.wide.references import EMPTY, leaf_count, leaf_first

PRIM_ID = WIDTH * PRIM_ID_ROW  # Index of the first prim_id in a row of primitives.
PACKETS = 4  # Number of packets that are set up together.
SLOTS = 24  # Number of interleaved rays in progress.
FEW_RAYS = 6  # If a packet has at most so many rays in a leaf, the rays are tested one by one.
MIN_VISITS = 6  # Mean number of rays per node from which a packet is faster than interleaving its rays.
# Numbers of nodes between which the walk of a MIXED packet stops if it is below MIN_VISITS.
FIRST_STOP, LAST_STOP = 6, 16
# Results of a packet's walk: all rays are finished, and their visits reached or did not reach MIN_VISITS; or the walk has stopped, and the
# rays begin again one by one. The hits found so far shorten them.
TOGETHER, APART, STOPPED = (wp.constant(result) for result in range(3))
# A packet below MIN_VISITS has failed. After MAX_FAILED failures in succession, the rays of the next PAUSE packets are interleaved, or of
# the next MIXED_PAUSE packets of the kind MIXED.
MAX_FAILED, PAUSE, MIXED_PAUSE = 4, 32, 128


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
    test_spheres, nearest_accepted = make_sphere_test(units, any_hit, accepts), make_accepted(any_hit, accepts, ray_triangles)

    @wp.func
    def test_row(accel: WideBvh, first: int, count: int, surfaces: Surfaces, scratch: Scratch, ray: int) -> bool:
        mask = (2 << (count - 1)) - 1
        if wp.static(units.spheres):
            spheres = spheres_of(accel, first, mask, surfaces.n_triangles)
            if spheres != 0:
                if test_spheres(accel, first, spheres, surfaces, scratch, ray):
                    return True
                mask = mask & ~spheres
        if wp.static(accepts is None):
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
    def test_leaf(accel: WideBvh, surfaces: Surfaces, reference: int, mask: int, scratch: Scratch, base: int):
        left = leaf_count(reference)
        first = leaf_first(reference) * ROW_SIZE
        while left > 0 and mask != 0:
            n = wp.min(left, WIDTH)
            lanes = bool(count_of(mask) > FEW_RAYS)
            if wp.static(units.spheres):
                lanes = lanes and spheres_of(accel, first, (2 << (n - 1)) - 1, surfaces.n_triangles) == 0
            if lanes:
                found = int(0)
                if wp.static(accepts is None):
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


def make_packet_walk(units: Units, any_hit: bool, accepts: Any) -> Any:
    """Return walk, which traces a packet of rays through the tree.
    The packet must have a beam: bounds of the origins and directions of all its rays, tested first at each node (layout.BEAM).
    Only any-hit packets may be MIXED: for closest hits, interleaving their rays is faster."""
    children, test_leaf = make_children(any_hit), make_packet_leaf(units, any_hit, accepts)
    mixed_children = make_children(any_hit, True) if any_hit else children

    @wp.func
    def walk(accel: WideBvh, surfaces: Surfaces, scratch: Scratch, base: int, active: int) -> int:
        """Trace the active rays; active: the result of set_up. Return TOGETHER, APART or STOPPED."""
        result = int(APART)
        nodes = int(0)
        visits = int(0)
        size = int(0)
        reference = int(0)
        mask = active & wp.static(COHERENT - 1)
        while True:
            if reference < 0:
                test_leaf(accel, surfaces, reference, mask, scratch, base)
            else:
                nodes += 1
                visits += count_of(mask)
                if wp.static(not any_hit):
                    size = children(accel, scratch, base, reference, mask, size)
                elif active < MIXED:
                    size = children(accel, scratch, base, reference, mask, size)
                elif visits < MIN_VISITS * nodes and nodes >= FIRST_STOP and nodes <= LAST_STOP:
                    result = STOPPED
                    size = int(0)
                else:
                    size = mixed_children(accel, scratch, base, reference, mask, size)
            mask = int(0)
            while size > 0 and mask == 0:
                size = size - 1
                mask = rays_at(scratch.stacks, size) & rays_reaching(t_of(key_at(scratch.stacks, size)), scratch, base)
            if mask == 0:
                break
            reference = reference_of(key_at(scratch.stacks, size))
        if result != STOPPED and visits >= MIN_VISITS * nodes:
            result = TOGETHER
        return result

    return walk


@wp.func
def count_walk(scratch: Scratch, failed_at: int, together: bool):
    """Count a packet's walk in scratch.report; failed_at: FAILED or MIXED_FAILED. The entry behind it is PAUSED or MIXED_PAUSED."""
    failed = wp.where(together, 0, slot_at(scratch.report, failed_at) + 1)
    if failed == MAX_FAILED:  # After this pause, a single failure starts the next pause.
        failed = failed - 1
        pause = wp.where(failed_at == MIXED_FAILED, MIXED_PAUSE, PAUSE)
        put_int(scratch.report, failed_at + wp.static(PAUSED - FAILED), pause)
    put_int(scratch.report, failed_at, failed)


def make_interleaved(units: Units, any_hit: bool, accepts: Any) -> Any:
    """Return interleaved, which traces rays of PACKETS packets through the tree, one step of each ray in turn.

    The mask `waiting` has a bit for each ray to trace: bit LANES * packet + lane."""
    test_row = make_row_test(units, any_hit, accepts, True)  # Inlining makes closest hits 1.02 times, any hits 1.05 times as fast.
    begin, step, pop = make_steps(any_hit)

    @wp.func
    def start(accel: WideBvh, scratch: Scratch, slot: int, ray: int):
        """Put ray `ray` = LANES * packet + lane into a slot. It enters a child of the root (rays_meeting_root), so a next node exists."""
        column = ray / LANES * PACKET_SIZE + ray % LANES
        prefetch_next(accel, begin(accel, scratch, slot, column))

    @wp.func
    def turn(accel: WideBvh, surfaces: Surfaces, scratch: Scratch, slot: int) -> bool:
        """Visit the node or leaf of a slot's ray, and choose the next one. Return False if the ray is finished."""
        words = slot * SLOT_SIZE
        reference = slot_at(scratch.slots, words + wp.static(SLOT["next"]))
        if reference < 0:
            ray = slot_at(scratch.slots, words + wp.static(SLOT["ray"]))
            left = leaf_count(reference)
            first = leaf_first(reference) * ROW_SIZE
            while left > 0:
                if test_row(accel, first, wp.min(left, WIDTH), surfaces, scratch, ray):
                    return False
                left = left - WIDTH
                first = first + ROW_SIZE
            next = pop(accel, scratch, slot, number(scratch.packets, ray + wp.static(FIELD["t"])))
        else:
            next = step(accel, scratch, slot)
        if next == EMPTY:
            return False
        prefetch_next(accel, next)
        return True

    @wp.func
    def interleaved(accel: WideBvh, surfaces: Surfaces, scratch: Scratch, waiting: wp.uint64):
        live = int(0)
        slot = int(0)
        while slot < SLOTS and waiting != wp.uint64(0):
            start(accel, scratch, slot, lowest_of_all(waiting))
            waiting = waiting & (waiting - wp.uint64(1))
            live = live | (1 << slot)
            slot = slot + 1
        while live != 0:
            todo = int(live)
            while todo != 0:
                slot = lowest(todo)
                todo = todo & (todo - 1)
                if not turn(accel, surfaces, scratch, slot):
                    if waiting != wp.uint64(0):
                        start(accel, scratch, slot, lowest_of_all(waiting))
                        waiting = waiting & (waiting - wp.uint64(1))
                    else:
                        live = live & ~(1 << slot)

    return interleaved


@cache
def make_kernel(units: Units, any_hit: bool, rays_struct: Any = RayArrays, accepts: Any = None) -> Any:
    """Return the kernel that traces the rays first .. end - 1 in a single thread, PACKETS packets at a time.

    The kernel writes to `out` (HitArrays or, with any_hit, an array of bool) and to scratch.report. All arrays must be contiguous."""
    walk_packet = make_packet_walk(units, any_hit, accepts)
    interleaved = make_interleaved(units, any_hit, accepts)
    set_up = make_set_up(rays_struct, may_mix=any_hit)
    write = write_occluded if any_hit else write_hits
    out_type = wp.array(dtype=wp.bool) if any_hit else HitArrays

    @packet_kernel
    def trace(accel: WideBvh, surfaces: Surfaces, rays: rays_struct, out: out_type, scratch: Scratch, first: int, end: int):
        for i in range(REPORT_SIZE):
            put_int(scratch.report, i, 0)
        for block in range(first, end, wp.static(PACKETS * LANES)):
            single_rays = wp.uint64(0)
            mixes = slot_at(scratch.report, MIXED_PAUSED) == 0  # Else MIXED packets get no beam, which takes long.
            packets = wp.min((end - block + LANES - 1) / LANES, PACKETS)  # Not a constant: Warp would unroll the loop over the walk.
            for p in range(packets):
                base = PACKET_SIZE * p
                count = wp.min(end - block - LANES * p, LANES)
                active = set_up(rays, block + LANES * p, count, wp.static(far_pad(units.box)), mixes, scratch, base)
                store_bits(scratch.packets, base + ACTIVE, active)
                if bits(scratch.packets, base + REFUSED) != 0:
                    put_int(scratch.report, ANY_REFUSED, 1)
            for p in range(packets):
                base = PACKET_SIZE * p
                active = bits(scratch.packets, base + ACTIVE)
                failed_at = wp.where(wp.static(any_hit) and active >= MIXED, MIXED_FAILED, FAILED)
                paused = slot_at(scratch.report, failed_at + wp.static(PAUSED - FAILED))
                result = int(STOPPED)
                if active >= COHERENT and paused == 0 and (mixes or active < MIXED):
                    result = walk_packet(accel, surfaces, scratch, base, active)
                    count_walk(scratch, failed_at, result == TOGETHER)
                else:
                    put_int(scratch.report, failed_at + wp.static(PAUSED - FAILED), wp.max(paused - 1, 0))
                if result == STOPPED:
                    active = rays_meeting_root(accel, scratch, base, active & wp.static(COHERENT - 1))
                    single_rays = single_rays | (wp.uint64(active) << wp.uint64(LANES * p))
            interleaved(accel, surfaces, scratch, single_rays)
            for p in range(packets):
                write(out, block + LANES * p, wp.min(end - block - LANES * p, LANES), scratch, PACKET_SIZE * p)

    return trace
