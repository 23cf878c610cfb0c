"""All hits of rays: the traversal fills one list per ray, then each list is sorted."""

from typing import Any

import warp as wp

from wrt.kernels.query import HitArrays, RayArrays, direction_scale, load_ray, store_hit
from wrt.kernels.structs import Hit, Ray, kernel
from wrt.kernels.units.triangle import is_crossed, to_ray_space, triangle_ray

FEW = wp.constant(8)  # hits: most rays have no more, and sorting so few takes no measurable time


@wp.struct
class HitLists:
    """Lists of hits, one per ray. A traversal made with Units.lists gets them as its argument `surfaces`."""

    limit: int  # Largest number of hits to return for a ray; below 2^30.
    crossings: bool  # True: list only triangles that the ray crosses (units.triangle.is_crossed).
    vertices: wp.array(dtype=wp.vec3)  # vertices and faces are read only if `crossings` is True.
    faces: wp.array(dtype=wp.vec3i)
    first: wp.array(dtype=wp.int32)  # Ray i has room for the hits rows[first[i]] .. rows[first[i + 1] - 1].
    count: wp.array(dtype=wp.int32)  # Number of hits of ray i; above the list's length, the list is incomplete (list_hit).
    rows: wp.array(dtype=Hit)


@wp.func
def is_before(a: Hit, b: Hit) -> bool:
    return a.t < b.t or (a.t == b.t and a.prim_id < b.prim_id)


@wp.func
def sort_hits(rows: wp.array(dtype=Hit), first: int, count: int):
    """Sort rows[first : first + count] in place by t, then by prim_id. Heapsort (Williams 1964, "Algorithm 232"): n log n steps."""
    begin = count / 2
    end = int(count)
    while end > 1:
        if begin > 0:
            begin -= 1
            hit = rows[first + begin]
        else:
            end -= 1
            hit = rows[first + end]
            rows[first + end] = rows[first]
        hole = int(begin)
        child = 2 * hole + 1
        while child < end:
            if child + 1 < end and is_before(rows[first + child], rows[first + child + 1]):
                child += 1
            if is_before(hit, rows[first + child]):
                rows[first + hole] = rows[first + child]
                hole = child
                child = 2 * hole + 1
            else:
                child = end
        rows[first + hole] = hit


@wp.func
def sort_and_trim(rows: wp.array(dtype=Hit), first: int, count: int, limit: int) -> int:
    """Sort a list, drop repeated hits, and cut the list to `limit` hits; return the number of hits left.
    Hits repeat because some structures store a triangle in several leaves."""
    sort_hits(rows, first, count)
    kept = int(0)
    last = int(-1)
    for i in range(count):
        hit = rows[first + i]
        if hit.prim_id != last and kept < limit:
            rows[first + kept] = hit
            kept += 1
            last = hit.prim_id
    return kept


@wp.func
def list_hit(lists: HitLists, ray: Ray, hit: Hit, best: Hit) -> Hit:
    """Append a hit to the list of its ray. The returned `best` stays a miss, but the walk may stop beyond best.t.
    If the list is too short, count[i] exceeds the list's length. Then a list for count[i] or 2 limit hits suffices, whichever is less."""
    if lists.crossings:
        shear = triangle_ray(ray)
        face = lists.faces[hit.prim_id]
        if not is_crossed(to_ray_space(lists.vertices[face[0]] - ray.origin, shear),
                          to_ray_space(lists.vertices[face[1]] - ray.origin, shear),
                          to_ray_space(lists.vertices[face[2]] - ray.origin, shear)):
            return best
    first = lists.first[ray.slot]
    capacity = lists.first[ray.slot + 1] - first
    n = lists.count[ray.slot]
    if n < capacity:
        lists.rows[first + n] = hit
    n += 1
    if capacity > lists.limit:
        if n == capacity or (n == lists.limit and n <= FEW):
            n = sort_and_trim(lists.rows, first, n, lists.limit)
            if n == lists.limit:
                best.t = lists.rows[first + n - 1].t
    elif n >= 2 * lists.limit:  # stop the walk: a list of 2 limit hits is long enough, so the exact count does not matter
        best.t = float(-wp.inf)
    lists.count[ray.slot] = n
    return best


def make_list_hits_kernel(accel_struct: Any, traverse: Any) -> Any:
    """Make the kernel that fills the list of each ray; `traverse` is made with Units.lists and accepts=list_hit."""

    @kernel
    def list_hits(accel: accel_struct, rays: RayArrays, lists: HitLists, start: int):
        i = start + wp.tid()
        first = lists.first[i]
        capacity = lists.first[i + 1] - first
        if capacity > 0:
            traverse(accel, lists, load_ray(rays, i))
            if lists.count[i] <= capacity:
                lists.count[i] = sort_and_trim(lists.rows, first, lists.count[i], lists.limit)

    return list_hits


@kernel
def copy_hits(rays: RayArrays, lists: HitLists, begin: wp.array(dtype=wp.int32), hits: HitArrays, start: int):
    """Copy the list of ray i = start + tid to the entries of `hits` from begin[i] on, with t in units of the caller's direction."""
    i = start + wp.tid()
    scale = direction_scale(rays.direction[i])
    for k in range(lists.count[i]):
        store_hit(hits, begin[i] + k, lists.rows[lists.first[i] + k], scale)
