"""Traversal without a structure: test every primitive. The hits of the other structures are compared with its hits."""

from functools import cache
from typing import Any

import warp as wp

from wrt.kernels.structs import Hit, Ray
from wrt.kernels.traverse.common import Units, make_probe, no_hit
from wrt.kernels.traverse.leaf import make_leaf
from wrt.kernels.traverse.observer import Recorder, make_observer


@cache
def make_struct(record: Any) -> Any:
    """Make the structure's type, for primitives stored as `record` in the order of prim_id."""

    @wp.struct
    class BruteForce:
        primitives: wp.array(dtype=record)
        recorder: Recorder

    return BruteForce


def make_traversal(units: Units, any_hit: bool, accepts: Any = None) -> Any:
    """Make traverse(accel, surfaces, ray) -> Hit: the closest hit or, with any_hit, the first hit found; accepts: common.make_better."""
    probe_of = make_probe(units)
    visit_leaf = make_leaf(units, any_hit, accepts, is_leaf=False)
    observe = make_observer(units, 0)
    struct = make_struct(units.triangle_test.record)

    @wp.func
    def traverse(accel: struct, surfaces: Any, ray: Ray) -> Hit:
        probe = probe_of(ray)
        best = visit_leaf(accel, surfaces, probe, 0, accel.primitives.shape[0], no_hit(ray))
        return observe.finish(accel.recorder, ray, best)

    return traverse
