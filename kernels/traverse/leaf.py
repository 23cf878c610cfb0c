"""The visit of a leaf: test its primitives one after another, and return the best hit.
A grid or octree lists a primitive in every cell that the primitive meets. A mailbox stores the primitives that a ray was tested against
last, so that most are tested only once. Primitive i has the mailbox slot i modulo MAILBOX_SIZE (Amanatides and Woo 1987, "A Fast Voxel
Traversal Algorithm for Ray Tracing", section 3)."""

from typing import Any

import warp as wp

from wrt.kernels.structs import NO_HIT, Hit
from wrt.kernels.traverse.common import Probe, Units
from wrt.kernels.traverse.observer import make_observer, make_test
from wrt.kernels.traverse.steps import SKIP, make_step

MAILBOX_SIZE = 8
Mailbox = wp.types.vector(MAILBOX_SIZE, wp.int32)  # 1 + index of a primitive; 0: empty slot


def make_leaf(units: Units, any_hit: bool, accepts: Any = None, is_leaf: bool = True) -> Any:
    """Make visit_leaf(accel, surfaces, probe, first, count, best) -> best Hit; accepts: see common.make_better.
    is_leaf: False if the primitives are not a leaf of a structure."""
    observe, test = make_observer(units, 0), make_test(units, accepts)

    @wp.func
    def visit_leaf(accel: Any, surfaces: Any, probe: Probe, first: int, count: int, best: Hit) -> Hit:
        """Test the primitives first .. first + count - 1; with any_hit, stop at the first hit."""
        if wp.static(is_leaf):
            observe.leaf(accel.recorder, probe.ray, first, count)
        for i in range(first, first + count):
            best = test(accel.recorder, probe, surfaces, accel.primitives[i], i, best)
            if wp.static(any_hit):
                if best.prim_id != NO_HIT:
                    break
        return best

    return visit_leaf


def make_mailbox_leaf(units: Units, any_hit: bool, accepts: Any = None) -> Any:
    """Make visit_leaf(accel, surfaces, probe, leaf, mailbox, best) -> (Mailbox, best Hit), for leaves of indices."""
    observe, test = make_observer(units, 0), make_test(units, accepts)

    @wp.func
    def visit_leaf(accel: Any, surfaces: Any, probe: Probe, leaf: Any, mailbox: Mailbox, best: Hit):
        """Test the leaf's primitives that are not in the mailbox; if accel.mailbox is 0, test all of them."""
        if leaf.count > 0:
            observe.leaf(accel.recorder, probe.ray, leaf.first, leaf.count)
        for i in range(leaf.first, leaf.first + leaf.count):
            primitive = accel.references[i]
            slot = primitive % wp.static(MAILBOX_SIZE)
            if accel.mailbox > 0 and mailbox[slot] == primitive + 1:
                observe.step(accel.recorder, probe.ray, make_step(SKIP, primitive, 1))
                continue
            mailbox[slot] = primitive + 1
            best = test(accel.recorder, probe, surfaces, accel.primitives[primitive], primitive, best)
            if wp.static(any_hit):
                if best.prim_id != NO_HIT:
                    break
        return mailbox, best

    return visit_leaf
