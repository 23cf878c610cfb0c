"""bvh6: nodes of 64 bytes, one primitive per leaf. Hits, counters and refits are tested with those of all structures."""

from __future__ import annotations

import numpy as np
import pytest

from tests.refused import refused
from wrt.accel.bvh.six import Bvh6
from wrt.accel.geometry import Geometry
from wrt.accel.scenes.build import build
from wrt.core.device import record_dtype
from wrt.kernels.traverse.bvh6 import Bvh6Node
from wrt.scene.shapes import icosphere

BALL = icosphere(3)


def test_a_node_has_64_bytes() -> None:
    assert record_dtype(Bvh6Node).itemsize == 64


@pytest.mark.parametrize("builder", ["binned", "refined", "sbvh", "lbvh"])
def test_every_leaf_has_one_primitive_and_every_box_contains_it(builder: str) -> None:
    geometry = Geometry.of(BALL)
    accel = Bvh6(geometry, builder=builder)
    tree, order = accel.decoded(), accel.built.order
    lo, hi = geometry.bounds()
    below: dict[int, set[int]] = {}
    for node in reversed(range(len(tree.children))):
        below[node] = set()
        for slot, child in enumerate(tree.children[node]):
            if child == 0:
                continue
            inside = below[child] if child > 0 else {int(order[(-1 - int(child)) >> 6])}
            members = sorted(inside)
            if builder != "sbvh":  # its references are clipped
                assert (tree.lo[node, slot] <= lo[members]).all() and (tree.hi[node, slot] >= hi[members]).all()
            below[node] |= inside
    assert below[0] == set(range(len(geometry))) and accel.stats.leaves == len(order)


@pytest.mark.parametrize(("field", "value"), [("counts", 7), ("counts", -1), ("node", 1 << 20), ("node", 0), ("primitive", 1 << 20),
                                              ("primitive", -5)])
def test_a_damaged_node_is_refused(field: str, value: int) -> None:
    accel = build(BALL, "bvh6")
    nodes = accel.built.arrays["nodes"]
    at = int(np.flatnonzero((nodes["counts"] & 255 > 0) & (nodes["counts"] >> 8 > 0))[0])
    accel._check(accel.built)
    nodes[field][at] = value
    with refused(what="damaged"):
        accel._check(accel.built)


def test_a_node_that_leads_to_the_root_is_refused() -> None:
    """A ray would go round in circles. In a list of references, the root stands for an empty slot."""
    accel = build(BALL, "bvh6")
    counts = accel.built.arrays["nodes"]["counts"]
    counts[np.flatnonzero((counts & 255 == 0) & (counts >> 8 < 6))[0]] += 1
    with refused(what="damaged"):
        accel._check(accel.built)
