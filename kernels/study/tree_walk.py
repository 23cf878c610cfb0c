"""A walk of wide trees whose rules are arguments: order of children, culling at the pop; with a log of each ray.

The walk pushes every child that the ray enters, then pops the next one. So a ray's log tells how many entries waited at each step."""

import warp as wp

from wrt.kernels.structs import NO_HIT, Hit, Primitive, Surfaces, kernel, make_ray
from wrt.kernels.traverse.common import Probe, Units, make_intersect, make_probe, no_hit
from wrt.kernels.traverse.stack import key_of, reference_of, t_of
from wrt.kernels.units.box import ray_aabb
from wrt.kernels.wide.references import EMPTY, leaf_count, leaf_first

MAX_WIDTH = 8
STACK = wp.constant(2048)  # Entries of a ray's stack.
Keys = wp.types.vector(MAX_WIDTH, wp.uint64)
probe_of, intersect = make_probe(Units()), make_intersect(Units())


@wp.struct
class StudyTree:
    """A wide tree. Node i has the entries i * width .. i * width + width - 1 of children, lo and hi."""

    width: int
    children: wp.array(dtype=wp.int32)  # References (kernels.wide.references); a leaf's first row has `width` primitives.
    lo: wp.array(dtype=wp.vec3)
    hi: wp.array(dtype=wp.vec3)
    primitives: wp.array(dtype=Primitive)


@wp.struct
class StudyRays:
    """Rays, arrays (N,). any_hit: 1 for a ray that ends at its first hit."""

    origin: wp.array(dtype=wp.vec3)
    direction: wp.array(dtype=wp.vec3)
    t_max: wp.array(dtype=wp.float32)
    any_hit: wp.array(dtype=wp.int8)


@wp.struct
class Rules:
    """Rules of a walk: 1 or 0 each. ordered: nearest child first, else the last slot first. culled: drop popped entries behind the best
    hit."""

    ordered: int
    culled: int


@wp.struct
class Work:
    """Counts of one ray."""

    inner: int  # Inner nodes fetched.
    leaves: int  # Leaves fetched.
    boxes: int  # Boxes tested.
    tests: int  # Primitives tested.
    full: int  # 1 if the stack had no room for an entry.
    prim_id: int  # The hit, -1 for a miss.


@wp.struct
class WalkLog:
    """Counts and log of rays. Length 0 of fetch_first: write no log."""

    work: wp.array(dtype=Work)  # Indexed by ray.
    fetch_first: wp.array(dtype=wp.int64)  # Ray i has the fetches fetch_first[i] .. fetch_first[i + 1] - 1.
    fetch: wp.array(dtype=wp.int32)  # Reference of each fetched node or leaf.
    entered: wp.array(dtype=wp.int8)  # Number of entries that each fetch pushed.


@wp.func
def entered_children(tree: StudyTree, node: int, rules: Rules, probe: Probe, t_max: float):
    """Return the keys of the children that the ray enters, in the order of their pushes, and their number."""
    keys = Keys()
    n = int(0)
    for slot in range(tree.width):
        at = node * tree.width + slot
        if tree.children[at] != EMPTY:
            t = ray_aabb(probe.box, tree.lo[at], tree.hi[at], t_max)
            if t < wp.inf:
                key = key_of(t + 0.0, tree.children[at])  # t + 0.0: never -0
                j = int(n)
                if rules.ordered != 0:
                    while j > 0 and keys[j - 1] < key:  # the nearest child is pushed last
                        keys[j] = keys[j - 1]
                        j = j - 1
                keys[j] = key
                n = n + 1
    return keys, n


@wp.func
def visit_leaf(tree: StudyTree, surfaces: Surfaces, probe: Probe, reference: int, any_hit: bool, best: Hit, work: Work):
    """Test the primitives of a leaf; return the best hit and the new counts."""
    work.leaves += 1
    for i in range(leaf_count(reference)):
        best = intersect(probe, surfaces, tree.primitives[leaf_first(reference) * tree.width + i], best)
        work.tests += 1
        if any_hit and best.prim_id != NO_HIT:
            break
    return best, work


@wp.func
def write_fetch(log: WalkLog, i: int, work: Work, reference: int, entered: int):
    """Log the fetch that `work` already includes."""
    if log.fetch_first.shape[0] > 0:
        at = log.fetch_first[i] + wp.int64(work.inner + work.leaves - 1)
        log.fetch[at] = reference
        log.entered[at] = wp.int8(entered)


@kernel
def walk(tree: StudyTree, surfaces: Surfaces, rays: StudyRays, rules: Rules, first_ray: int, scratch: wp.array(dtype=wp.uint64),
         log: WalkLog):
    """Trace ray first_ray + tid. scratch: STACK entries for each thread. A full stack ends the walk, and sets log.work[i].full."""
    i = first_ray + wp.tid()
    base = wp.tid() * STACK
    ray = make_ray(rays.origin[i], rays.direction[i])
    ray.t_max = rays.t_max[i]
    probe = probe_of(ray)
    any_hit = rays.any_hit[i] != wp.int8(0)
    best = no_hit(ray)
    work = Work()
    size = int(0)
    reference = int(0)
    while True:
        if reference < 0:
            best, work = visit_leaf(tree, surfaces, probe, reference, any_hit, best, work)
            write_fetch(log, i, work, reference, 0)
            if any_hit and best.prim_id != NO_HIT:
                break
        else:
            work.inner += 1
            keys, n = entered_children(tree, reference, rules, probe, best.t)
            for slot in range(tree.width):
                work.boxes += wp.where(tree.children[reference * tree.width + slot] != EMPTY, 1, 0)
            write_fetch(log, i, work, reference, n)
            if size + n > STACK:
                work.full = 1
                break
            for j in range(n):
                scratch[base + size] = keys[j]
                size = size + 1
        found = bool(False)
        while size > 0 and not found:
            size = size - 1
            key = scratch[base + size]
            if rules.culled == 0 or t_of(key) <= best.t:
                reference = reference_of(key)
                found = True
        if not found:
            break
    work.prim_id = wp.where(best.prim_id == NO_HIT, -1, best.prim_id)
    log.work[i] = work
