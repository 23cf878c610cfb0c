"""The leaf of a walk: it tests primitives one after another, and keeps the best hit.
A structure that divides space lists a primitive in every leaf that it meets. A mailbox remembers the last primitives that a ray was tested
against, so that most are tested once; its slot is the index modulo its size. (Amanatides and Woo 1987, "A Fast Voxel Traversal Algorithm
for Ray Tracing", section 3)."""

from typing import Any

import warp as wp

from wrt.kernels.structs import NO_HIT, Hit
from wrt.kernels.traverse.common import Probe, Units, make_intersect
from wrt.kernels.traverse.counters import Counts, make_counters

MAILBOX_SIZE = 8
Mailbox = wp.types.vector(MAILBOX_SIZE, wp.int32)  # index of a primitive + 1; 0: free


def make_leaf(units: Units, any_hit: bool, accepts: Any = None) -> Any:
    """Make visit_leaf(accel, surfaces, probe, first, count, best, counts) -> best hit, counts; accepts: of make_better."""
    intersect = make_intersect(units, accepts)
    _, fetch_primitive, _, _ = make_counters(units, 0)

    @wp.func
    def visit_leaf(accel: Any, surfaces: Any, probe: Probe, first: int, count: int, best: Hit, counts: Counts):
        """Test the primitives first .. first + count - 1; with any_hit, up to the first hit."""
        for i in range(first, first + count):
            best = intersect(probe, surfaces, accel.primitives[i], best)
            counts = fetch_primitive(accel.recorder, probe.ray, counts, i)
            if wp.static(any_hit):
                if best.prim_id != NO_HIT:
                    break
        return best, counts

    return visit_leaf


def make_mailbox_leaf(units: Units, any_hit: bool, accepts: Any = None) -> Any:
    """Make visit_leaf(accel, surfaces, probe, leaf, mailbox, best, counts) -> mailbox, best hit, counts, for leaves of references."""
    intersect = make_intersect(units, accepts)
    _, fetch_primitive, _, _ = make_counters(units, 0)

    @wp.func
    def visit_leaf(accel: Any, surfaces: Any, probe: Probe, leaf: Any, mailbox: Mailbox, best: Hit, counts: Counts):
        """Test the primitives of the leaf's references that are not in the mailbox; all if accel.mailbox is 0."""
        for i in range(leaf.first, leaf.first + leaf.count):
            primitive = accel.references[i]
            slot = primitive % wp.static(MAILBOX_SIZE)
            if accel.mailbox > 0 and mailbox[slot] == primitive + 1:
                continue
            mailbox[slot] = primitive + 1
            best = intersect(probe, surfaces, accel.primitives[primitive], best)
            counts = fetch_primitive(accel.recorder, probe.ray, counts, primitive)
            if wp.static(any_hit):
                if best.prim_id != NO_HIT:
                    break
        return mailbox, best, counts

    return visit_leaf
