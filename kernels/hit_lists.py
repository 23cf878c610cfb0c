"""All hits of rays: one walk fills a list for each ray, then the list is put in order."""

from typing import Any

import warp as wp

from wrt.kernels.query import HitArrays, RayArrays, direction_scale, load_ray, put_hit
from wrt.kernels.structs import Hit, Ray, kernel
from wrt.kernels.units.triangle import is_crossed, seen, triangle_ray

FEW = wp.constant(8)  # hits: most rays have so many at most, and so few are sorted in no time


@wp.struct
class HitLists:
    """What a traversal unit with Units.lists gets in place of Surfaces.

    limit: how many hits of a ray are asked for, the first ones; below 2^30. The list of ray i is rows first[i] .. first[i + 1] - 1.
    count: of the hits in it. Where it has room for `limit` or fewer, count may be larger: then a list with room for as many, or for
    2 `limit`, has them all. crossings: list only triangles of
    `vertices` and `faces` that the ray crosses (units.triangle.is_crossed); without it they are not read.
    """

    limit: int
    crossings: bool
    vertices: wp.array(dtype=wp.vec3)
    faces: wp.array(dtype=wp.vec3i)
    first: wp.array(dtype=wp.int32)
    count: wp.array(dtype=wp.int32)
    rows: wp.array(dtype=Hit)


@wp.func
def is_before(a: Hit, b: Hit) -> bool:
    return a.t < b.t or (a.t == b.t and a.prim_id < b.prim_id)


@wp.func
def sort_hits(rows: wp.array(dtype=Hit), first: int, count: int):
    """By t and, where that is equal, by prim_id. Heapsort (Williams 1964, "Algorithm 232"): n log n in any order, in place."""
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
def put_in_order(rows: wp.array(dtype=Hit), first: int, count: int, limit: int) -> int:
    """Sort a list, and keep the first hits, `limit` at most, each once: some structures hold a triangle in several leaves. Returns
    how many are kept."""
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
    """Put a hit into the list of its ray. The returned `best` says where the walk may end, and stays a miss."""
    if lists.crossings:
        shear = triangle_ray(ray)
        face = lists.faces[hit.prim_id]
        if not is_crossed(seen(lists.vertices[face[0]] - ray.origin, shear), seen(lists.vertices[face[1]] - ray.origin, shear),
                          seen(lists.vertices[face[2]] - ray.origin, shear)):
            return best
    first = lists.first[ray.slot]
    room = lists.first[ray.slot + 1] - first
    n = lists.count[ray.slot]
    if n < room:
        lists.rows[first + n] = hit
    n += 1
    if room > lists.limit:
        if n == room or (n == lists.limit and n <= FEW):
            n = put_in_order(lists.rows, first, n, lists.limit)
            if n == lists.limit:
                best.t = lists.rows[first + n - 1].t
    elif n >= 2 * lists.limit:  # in so much room no list is too short
        best.t = float(-wp.inf)
    lists.count[ray.slot] = n
    return best


def make_list_hits_kernel(accel_struct: Any, traverse: Any) -> Any:
    """Fill the list of each ray that has room. traverse: a unit made with Units.lists and accepts=list_hit."""

    @kernel
    def list_hits(accel: accel_struct, rays: RayArrays, lists: HitLists, start: int):
        i = start + wp.tid()
        first = lists.first[i]
        room = lists.first[i + 1] - first
        if room > 0:
            traverse(accel, lists, load_ray(rays, i))
            if lists.count[i] <= room:
                lists.count[i] = put_in_order(lists.rows, first, lists.count[i], lists.limit)

    return list_hits


@kernel
def copy_hits(rays: RayArrays, lists: HitLists, begin: wp.array(dtype=wp.int32), hits: HitArrays, start: int):
    """The list of ray i to rows begin[i] on of `hits`, with t in the caller's units."""
    i = start + wp.tid()
    scale = direction_scale(rays.direction[i])
    for k in range(lists.count[i]):
        put_hit(hits, begin[i] + k, lists.rows[lists.first[i] + k], scale)
