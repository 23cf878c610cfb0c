"""Traversal of bvh6: six children in a node of 64 bytes, one primitive per leaf.
Ray tracing units with such nodes: Intel's, and those of Vulkan-Sim (Saed et al. 2022, "Vulkan-Sim: A GPU Architecture Simulator for Ray
Tracing"). Boxes have 8 bits per plane, as in Ylitie, Karras and Laine 2017, section 3.2. The walk visits the nearest child next, keeps
the others sorted on the stack, and drops a popped child that begins behind the closest hit."""

from functools import cache
from typing import Any

import warp as wp

from wrt.kernels.structs import NO_HIT, Hit, Ray, size_of
from wrt.kernels.traverse.common import Probe, Units, make_probe, no_hit
from wrt.kernels.traverse.leaf import make_leaf
from wrt.kernels.traverse.observer import Recorder, make_observer
from wrt.kernels.traverse.stack import key_of, make_stack, reference_of, t_of
from wrt.kernels.traverse.steps import ENTERED, INNER, box_step

WIDTH = 6
STACK_SIZE = 64
LEAVES_SHIFT = 8  # Bits of Bvh6Node.counts below the number of leaves.
EXPONENT_BITS, MANTISSA_BITS = 8, 23
Planes = wp.types.vector(6 * WIDTH // 4, wp.int32)
Entries = wp.types.vector(WIDTH, wp.uint64)


@wp.struct
class Bvh6Node:
    """A node of 64 bytes. The slots hold inner nodes, then leaves, then nothing.

    A plane is origin + byte * 2^(exponent - 127), rounded once; a NaN origin stands for an infinite extent."""

    origin: wp.vec3
    exponents: int  # Biased exponents of x, y and z, EXPONENT_BITS each.
    node: int  # Index of the first inner child; the other inner children follow it.
    primitive: int  # Index of the first leaf's primitive; the other leaves' primitives follow it.
    counts: int  # Number of inner children, plus the number of leaves << LEAVES_SHIFT.
    planes: Planes  # A byte for each plane: low x of the slots 0 to 5, high x, low y, high y, low z, high z.


@cache
def make_struct(record: Any) -> Any:
    """Make the type of a bvh6 whose primitives are stored as `record`."""

    @wp.struct
    class Bvh6:
        nodes: wp.array(dtype=Bvh6Node)
        primitives: wp.array(dtype=record)
        recorder: Recorder

    return Bvh6


@wp.func
def plane(node: Bvh6Node, k: int, slot: int) -> float:
    """Return plane k of a slot's box; k: 2 * axis, plus 1 for the high plane."""
    at = k * WIDTH + slot
    byte = (node.planes[at >> 2] >> (8 * (at & 3))) & 255
    exponent = (node.exponents >> (EXPONENT_BITS * (k >> 1))) & 255
    return node.origin[k >> 1] + float(byte) * wp.cast(exponent << MANTISSA_BITS, wp.float32)


@wp.func
def reference(node: Bvh6Node, slot: int) -> int:
    """Return the index of a slot's inner node, or -1 - the index of its leaf's primitive."""
    inner = node.counts & wp.static((1 << LEAVES_SHIFT) - 1)
    return wp.where(slot < inner, node.node + slot, -1 - (node.primitive + slot - inner))


@wp.func
def index_of(child: int) -> int:
    """Return the index of a child's node, or of its leaf's primitive."""
    return wp.max(child, -1 - child)


@wp.func
def count_of(child: int) -> int:
    """Return Step.count of a child."""
    return wp.where(child < 0, 1, INNER)


def make_enter_children(units: Units) -> Any:
    """Make enter_children(recorder, probe, node, children, t_max) -> (Entries, n): keys of the n entered children, the nearest last."""
    ray_aabb, observe = units.box_test, make_observer(units, 0)

    @wp.func
    def enter_children(recorder: Recorder, probe: Probe, node: Bvh6Node, children: int, t_max: float):
        entered = Entries()
        n = int(0)
        for slot in range(children):
            lo = wp.vec3(plane(node, 0, slot), plane(node, 2, slot), plane(node, 4, slot))
            hi = wp.vec3(plane(node, 1, slot), plane(node, 3, slot), plane(node, 5, slot))
            t = ray_aabb(probe.box, lo, hi, t_max)
            child = reference(node, slot)
            observe.step(recorder, probe.ray, box_step(index_of(child), count_of(child), lo, hi, t))
            if t < wp.inf:
                key = key_of(t + 0.0, child)  # t + 0.0: never -0
                j = int(n)
                while j > 0 and entered[j - 1] < key:
                    entered[j] = entered[j - 1]
                    j = j - 1
                entered[j] = key
                n = n + 1
        return entered, n

    return enter_children


def make_traversal(units: Units, any_hit: bool, accepts: Any = None) -> Any:
    """Make traverse(accel, surfaces, ray) -> Hit: the closest hit or, with any_hit, the first hit found; accepts: common.make_better."""
    struct = make_struct(units.triangle_test.record)
    probe_of = make_probe(units)
    visit_leaf = make_leaf(units, any_hit, accepts)
    observe, enter_children = make_observer(units, size_of(Bvh6Node)), make_enter_children(units)
    new_stack, put, get = make_stack(STACK_SIZE, wp.uint64)

    @wp.func
    def traverse(accel: struct, surfaces: Any, ray: Ray) -> Hit:
        probe = probe_of(ray)
        best = no_hit(ray)
        stack = new_stack()
        size = int(0)
        current = int(0)
        while True:
            if current < 0:
                best = visit_leaf(accel, surfaces, probe, -1 - current, 1, best)
                if wp.static(any_hit):
                    if best.prim_id != NO_HIT:
                        break
            else:
                node = accel.nodes[current]
                children = (node.counts & wp.static((1 << LEAVES_SHIFT) - 1)) + (node.counts >> LEAVES_SHIFT)
                observe.node(accel.recorder, ray, current, children, 1)
                entered, n = enter_children(accel.recorder, probe, node, children, best.t)
                if n > 0:
                    for j in range(n - 1):
                        put(stack, size, entered[j])
                        child = reference_of(entered[j])
                        size = size + 1
                        observe.push(accel.recorder, ray, index_of(child), count_of(child), t_of(entered[j]), size - 1, size)
                    current = reference_of(entered[n - 1])
                    continue
            # Pop the next child that begins at or before the closest hit: at the same t, it may have a hit with a lower prim_id.
            found = bool(False)
            while size > 0 and not found:
                size = size - 1
                key = get(stack, size)
                found = t_of(key) <= best.t
                current = reference_of(key)
                observe.pop(accel.recorder, ray, index_of(current), count_of(current), t_of(key), wp.where(found, ENTERED, 0))
            if not found:
                break
        return observe.finish(accel.recorder, ray, best)

    return traverse
