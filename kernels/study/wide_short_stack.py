"""A walk of wide trees with a short stack that restarts at the root: Vaidyanathan, Woop and Benthin 2019, "Wide BVH Traversal with a Short
Stack". The trail holds, for each level, the rank of the child that the walk is in, and whether it was the last. Laine 2010, "Restart Trail
for Stackless BVH Traversal"."""

import warp as wp

from wrt.kernels.structs import NO_HIT, Surfaces, kernel, make_ray
from wrt.kernels.study.tree_walk import Rules, StudyRays, StudyTree, Work, entered_children, probe_of, visit_leaf
from wrt.kernels.traverse.common import no_hit
from wrt.kernels.traverse.stack import reference_of, t_of

LEVELS = 64
CAPACITY = 64
Ranks = wp.types.vector(LEVELS, wp.int32)
Stack = wp.types.vector(CAPACITY, wp.uint64)
Flags = wp.types.vector(CAPACITY, wp.int32)


@kernel
def walk_short(tree: StudyTree, surfaces: Surfaces, rays: StudyRays, entries: int, out: wp.array(dtype=Work)):
    """Trace ray tid with a stack of `entries` entries, 0 to CAPACITY, nearest child first, popped entries culled. Same hits as a full
    stack. The trees have at most LEVELS levels."""
    i = wp.tid()
    ray = make_ray(rays.origin[i], rays.direction[i])
    ray.t_max = rays.t_max[i]
    probe = probe_of(ray)
    any_hit = rays.any_hit[i] != wp.int8(0)
    best = no_hit(ray)
    rules = Rules()
    rules.ordered = 1
    work = Work()
    rank = Ranks()  # of the child below each level; the present node is at `level`
    last = Ranks()  # 1 if that child was the last of its node
    stack = Stack()
    is_last = Flags()
    top = int(0)
    size = int(0)
    level = int(0)
    resumed = int(0)  # After a restart, the levels above this one keep their ranks.
    reference = int(0)
    done = bool(False)
    while not done:
        descended = bool(False)
        if reference < 0:
            best, work = visit_leaf(tree, surfaces, probe, reference, any_hit, best, work)
            if any_hit and best.prim_id != NO_HIT:
                break
        else:
            work.inner += 1
            keys, n = entered_children(tree, reference, rules, probe, best.t)  # the nearest child is the last key
            k = rank[level]
            if k < n:
                descended = True
                # A restart goes again to a child that was left; the children behind it go to the stack again.
                last[level] = wp.where(last[level] == 1 or k == n - 1, 1, 0)
                if last[level] == 0:
                    for j in range(n - 1 - k):
                        if entries > 0:
                            stack[top % entries] = keys[j]
                            is_last[top % entries] = wp.where(j == 0, 1, 0)
                            top = top + 1
                            size = wp.min(size + 1, entries)
                            work.pushes += 1
                reference = reference_of(keys[n - 1 - k])
                if level >= resumed:
                    resumed = int(0)
                    rank[level + 1] = 0
                    last[level + 1] = 0
                level = level + 1
            else:
                resumed = int(0)
                last[level] = 1
        while not descended and not done:
            # Go up to the deepest level that has another child, then take it from the stack, or restart at the root.
            level = level - 1
            while level >= 0 and last[level] == 1:
                level = level - 1
            if level < 0:
                done = True
            else:
                rank[level] = rank[level] + 1
                if size > 0:
                    top = top - 1
                    size = size - 1
                    key = stack[top % entries]
                    last[level] = is_last[top % entries]
                    level = level + 1
                    rank[level] = 0
                    last[level] = 0
                    reference = reference_of(key)
                    descended = t_of(key) <= best.t
                else:
                    resumed = level
                    reference = int(0)
                    level = int(0)
                    descended = True
                    work.dropped += 1  # a restart
    work.prim_id = wp.where(best.prim_id == NO_HIT, -1, best.prim_id)
    work.t = wp.where(best.prim_id == NO_HIT, float(wp.inf), best.t)
    out[i] = work
