"""All hits of rays: a walk fills one list a ray, then the list is sorted."""

from typing import Any

import warp as wp

from wrt.kernels.query import HitArrays, RayArrays, direction_scale, load_ray, store_hit
from wrt.kernels.structs import Hit, Ray, kernel
from wrt.kernels.units.triangle import is_crossed, to_ray_space, triangle_ray

FEW = wp.constant(8)  # most rays have at most so many hits, and sorting them takes no time


@wp.struct
class HitLists:
    """Lists of hits, which a traversal unit with Units.lists gets in place of Surfaces."""

    limit: int  # Largest number of hits asked for of a ray; below 2^30.
    crossings: bool  # True: list only triangles that the ray crosses (units.triangle.is_crossed).
    vertices: wp.array(dtype=wp.vec3)  # Read with `crossings` only, as `faces`.
    faces: wp.array(dtype=wp.vec3i)
    first: wp.array(dtype=wp.int32)  # The list of ray i is rows[first[i]] .. rows[first[i + 1] - 1].
    count: wp.array(dtype=wp.int32)  # Hits of ray i; more than fit: see list_hit.
    rows: wp.array(dtype=Hit)


@wp.func
def is_before(a: Hit, b: Hit) -> bool:
    return a.t < b.t or (a.t == b.t and a.prim_id < b.prim_id)


@wp.func
def sort_hits(rows: wp.array(dtype=Hit), first: int, count: int):
    """Sort by t and, at equal t, by prim_id, in place: heapsort (Williams 1964, "Algorithm 232"), n log n for any order."""
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
    """Sort a list, and keep its first hits, at most `limit`, each once; return their number. Some structures hold a triangle in several
    leaves."""
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
    """Append a hit to the list of its ray. The returned `best` stays a miss, and limits the walk.
    If the list is too short, count[i] exceeds its length. One for count[i] hits, or for 2 limit, then holds all."""
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
    elif n >= 2 * lists.limit:  # 2 limit is room enough for all
        best.t = float(-wp.inf)
    lists.count[ray.slot] = n
    return best


def make_list_hits_kernel(accel_struct: Any, traverse: Any) -> Any:
    """Make the kernel that fills the list of each ray; traverse: made with Units.lists and accepts=list_hit."""

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
    """Copy the list of ray i to hits[begin[i]] and on, with t in the caller's units."""
    i = start + wp.tid()
    scale = direction_scale(rays.direction[i])
    for k in range(lists.count[i]):
        store_hit(hits, begin[i] + k, lists.rows[lists.first[i] + k], scale)
