"""A walk for the k nearest hits of a ray, with or without dropping nodes behind the farthest hit that is kept."""

import warp as wp

from wrt.kernels.structs import NO_HIT, Surfaces, kernel, make_ray
from wrt.kernels.study.tree_walk import QUEUE, Rules, StudyRays, StudyTree, Work, entered_children, intersect, probe_of
from wrt.kernels.traverse.common import no_hit
from wrt.kernels.traverse.stack import reference_of, t_of
from wrt.kernels.wide.references import leaf_count, leaf_first

KEPT = 16
Distances = wp.types.vector(KEPT, wp.float32)


@kernel
def walk_k_hits(tree: StudyTree, surfaces: Surfaces, rays: StudyRays, bounded: int, first_ray: int, scratch: wp.array(dtype=wp.uint64),
                out: wp.array(dtype=Work)):
    """Find the KEPT nearest hits of ray first_ray + tid. bounded: 1 to drop nodes behind the last of KEPT hits. scratch: as in
    tree_walk.walk.
    out: counts; prim_id is the number of hits, t the distance of the last one that is kept."""
    i = first_ray + wp.tid()
    base = wp.tid() * QUEUE
    ray = make_ray(rays.origin[i], rays.direction[i])
    ray.t_max = rays.t_max[i]
    probe = probe_of(ray)
    kept = Distances()
    n = int(0)
    bound = no_hit(ray).t
    rules = Rules()
    rules.ordered = 1
    work = Work()
    size = int(0)
    reference = int(0)
    while True:
        if reference < 0:
            work.leaves += 1
            for k in range(leaf_count(reference)):
                none = no_hit(ray)
                if n == wp.static(KEPT):
                    none.t = kept[wp.static(KEPT - 1)]
                hit = intersect(probe, surfaces, tree.primitives[leaf_first(reference) * tree.width + k], none)
                work.tests += 1
                if hit.prim_id != NO_HIT:
                    j = wp.min(n, wp.static(KEPT - 1))
                    n = wp.min(n + 1, wp.static(KEPT))
                    while j > 0 and kept[j - 1] > hit.t:
                        kept[j] = kept[j - 1]
                        j = j - 1
                    kept[j] = hit.t
            if bounded != 0 and n == wp.static(KEPT):
                bound = kept[wp.static(KEPT - 1)]
        else:
            work.inner += 1
            keys, entered = entered_children(tree, reference, rules, probe, bound)
            for j in range(entered):
                scratch[base + size] = keys[j]
                size = size + 1
                work.pushes += 1
        found = bool(False)
        while size > 0 and not found:
            size = size - 1
            key = scratch[base + size]
            found = t_of(key) <= bound
            reference = reference_of(key)
        if not found:
            break
    work.prim_id = n
    work.t = wp.where(n > 0, kept[wp.max(n - 1, 0)], float(wp.inf))
    out[i] = work
