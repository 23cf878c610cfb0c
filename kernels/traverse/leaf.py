"""The visit of a leaf: test its primitives one after another, and return the best hit.
A grid or octree lists a primitive in every cell that the primitive meets. A mailbox stores the primitives that a ray was tested against
last, so that most are tested only once. Primitive i has the mailbox slot i modulo MAILBOX_SIZE (Amanatides and Woo 1987, "A Fast Voxel
Traversal Algorithm for Ray Tracing", section 3)."""

from typing import Any

import warp as wp

from wrt.kernels.structs import NO_HIT, Hit
from wrt.kernels.traverse.common import Probe, Units, make_intersect
from wrt.kernels.traverse.counters import Counts, make_counters, write_step
from wrt.kernels.traverse.recording import make_recorded_test
from wrt.kernels.traverse.steps import LEAF, SKIP, simple_step

MAILBOX_SIZE = 8
Mailbox = wp.types.vector(MAILBOX_SIZE, wp.int32)  # 1 + index of a primitive; 0: empty slot


def make_leaf(units: Units, any_hit: bool, accepts: Any = None, is_leaf: bool = True) -> Any:
    """Make visit_leaf(accel, surfaces, probe, first, count, best, counts) -> (best Hit, Counts); accepts: see common.make_better.
    is_leaf: False if the primitives are not a leaf of a structure."""
    intersect = make_intersect(units, accepts)
    recorded_test = make_recorded_test(units, accepts)
    _, fetch_primitive, _, _ = make_counters(units, 0)

    @wp.func
    def visit_leaf(accel: Any, surfaces: Any, probe: Probe, first: int, count: int, best: Hit, counts: Counts):
        """Test the primitives first .. first + count - 1; with any_hit, stop at the first hit."""
        if wp.static(units.steps and is_leaf):
            write_step(accel.recorder, probe.ray.slot, simple_step(LEAF, first, count))
        for i in range(first, first + count):
            if wp.static(units.steps):
                best = recorded_test(accel.recorder, probe, surfaces, accel.primitives[i], i, best)
            else:
                best = intersect(probe, surfaces, accel.primitives[i], best)
            counts = fetch_primitive(accel.recorder, probe.ray, counts, i)
            if wp.static(any_hit):
                if best.prim_id != NO_HIT:
                    break
        return best, counts

    return visit_leaf


def make_mailbox_leaf(units: Units, any_hit: bool, accepts: Any = None) -> Any:
    """Make visit_leaf(accel, surfaces, probe, leaf, mailbox, best, counts) -> (Mailbox, best Hit, Counts), for leaves of indices."""
    intersect = make_intersect(units, accepts)
    recorded_test = make_recorded_test(units, accepts)
    _, fetch_primitive, _, _ = make_counters(units, 0)

    @wp.func
    def visit_leaf(accel: Any, surfaces: Any, probe: Probe, leaf: Any, mailbox: Mailbox, best: Hit, counts: Counts):
        """Test the leaf's primitives that are not in the mailbox; if accel.mailbox is 0, test all of them."""
        if wp.static(units.steps):
            if leaf.count > 0:
                write_step(accel.recorder, probe.ray.slot, simple_step(LEAF, leaf.first, leaf.count))
        for i in range(leaf.first, leaf.first + leaf.count):
            primitive = accel.references[i]
            slot = primitive % wp.static(MAILBOX_SIZE)
            if accel.mailbox > 0 and mailbox[slot] == primitive + 1:
                if wp.static(units.steps):
                    write_step(accel.recorder, probe.ray.slot, simple_step(SKIP, primitive, 1))
                continue
            mailbox[slot] = primitive + 1
            if wp.static(units.steps):
                best = recorded_test(accel.recorder, probe, surfaces, accel.primitives[primitive], primitive, best)
            else:
                best = intersect(probe, surfaces, accel.primitives[primitive], best)
            counts = fetch_primitive(accel.recorder, probe.ray, counts, primitive)
            if wp.static(any_hit):
                if best.prim_id != NO_HIT:
                    break
        return mailbox, best, counts

    return visit_leaf
