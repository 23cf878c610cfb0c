"""All hits of rays: the traversal fills one list per ray, then each list is sorted."""

from functools import cache
from typing import Any

import warp as wp

from wrt.kernels.query import HitArrays, RayArrays, direction_scale, load_ray, store_hit
from wrt.kernels.structs import Hit, Ray, kernel
from wrt.kernels.units.triangle import is_crossed, to_ray_space, triangle_ray

FEW = wp.constant(8)  # hits: most rays have no more, and sorting so few takes no measurable time
TOUCHES = wp.constant(-1)  # value of HitLists.count for a ray that hits triangles and crosses none


@wp.struct
class HitLists:
    """Lists of hits, one per ray. A traversal made with Units.lists gets them as its argument `surfaces`."""

    limit: int  # Largest number of hits to return for a ray; below 2^30.
    crossings: bool  # True: list only triangles that the ray crosses (units.triangle.is_crossed).
    vertices: wp.array(dtype=wp.vec3)  # vertices and faces are read only if `crossings` is True.
    faces: wp.array(dtype=wp.vec3i)
    first_face: wp.array(dtype=wp.int32)  # For instances: index in `faces` of the face with prim_id 0 of each structure below.
    first: wp.array(dtype=wp.int32)  # Ray i has room for the hits rows[first[i]] .. rows[first[i + 1] - 1].
    count: wp.array(dtype=wp.int32)  # Number of hits of ray i, or TOUCHES; above the list's length, the list is incomplete (list_hit).
    rows: wp.array(dtype=Hit)
    # The other arrays are for instances only.
    root: wp.array(dtype=wp.int32)  # Root node of the world of ray i; below 0, the ray hits nothing.
    # Of the placement that ray i is in now (kernels.traverse.instances): the results of local_scale, and face index minus prim_id.
    scale: wp.array(dtype=wp.float64)
    to_face: wp.array(dtype=wp.int32)
    exclude: wp.array(dtype=wp.int32)  # exclude, mask: of the structs.Filter of ray i; only with Units.filtered.
    mask: wp.array(dtype=wp.int32)
    end: wp.array(dtype=wp.float32)  # t, in world space, behind which the walk of ray i needs no hits.


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
def off_edges(hit: Hit) -> bool:
    """Return True only if the watertight test found areas of one sign, none of them 0: then the ray crosses the triangle (is_crossed).
    u and v round areas' ratios, and are above 0 only if the areas are; the third ratio is 1 - u - v up to 2^-22."""
    return hit.u > 0.0 and hit.v > 0.0 and hit.u + hit.v < wp.static(1.0 - 2.0**-20)


@cache
def make_list_hit(instances: bool, watertight: bool) -> Any:
    """Make list_hit, which stores the hits of a traversal in its lists (common.make_better).
    watertight: whether the traversal's triangle test is the watertight one."""

    @wp.func
    def list_hit(lists: HitLists, ray: Ray, hit: Hit, best: Hit) -> Hit:
        """Append a hit to the list of its ray. The returned `best` stays a miss, but the walk may stop beyond best.t.
        If the list is too short, count[i] exceeds the list's length. Then a list for count[i] or 2 limit hits suffices, whichever is
        less."""
        crosses = not lists.crossings
        if wp.static(watertight):
            crosses = crosses or off_edges(hit)
        if not crosses:
            shear = triangle_ray(ray)
            index = hit.prim_id
            if wp.static(instances):
                index += lists.to_face[ray.slot]
            face = lists.faces[index]
            if not is_crossed(to_ray_space(lists.vertices[face[0]] - ray.origin, shear),
                              to_ray_space(lists.vertices[face[1]] - ray.origin, shear),
                              to_ray_space(lists.vertices[face[2]] - ray.origin, shear)):
                if lists.count[ray.slot] == 0:
                    lists.count[ray.slot] = TOUCHES
                return best
        if wp.static(instances):
            hit.t = float(wp.float64(hit.t) * lists.scale[ray.slot])
        first = lists.first[ray.slot]
        capacity = lists.first[ray.slot + 1] - first
        n = wp.max(lists.count[ray.slot], 0)
        if n < capacity:
            lists.rows[first + n] = hit
        n += 1
        end = float(wp.inf)
        if capacity > lists.limit:
            if n == capacity or (n == lists.limit and n <= FEW):
                n = sort_and_trim(lists.rows, first, n, lists.limit)
                if n == lists.limit:
                    end = lists.rows[first + n - 1].t
        elif n >= 2 * lists.limit:  # stop the walk: a list of 2 limit hits is long enough, so the exact count does not matter
            end = float(-wp.inf)
        if end < wp.inf:
            best.t = end
            if wp.static(instances):
                lists.end[ray.slot] = end
                best.t = float(wp.float64(end) / lists.scale[ray.slot])
        lists.count[ray.slot] = n
        return best

    return list_hit


def make_list_hits_kernel(accel_struct: Any, traverse: Any, instances: bool) -> Any:
    """Make the kernel that fills the list of each ray; `traverse` is made with Units.lists and accepts=make_list_hit."""

    @kernel
    def list_hits(accel: accel_struct, rays: RayArrays, lists: HitLists, start: int):
        i = start + wp.tid()
        first = lists.first[i]
        capacity = lists.first[i + 1] - first
        ray = load_ray(rays, i)
        if wp.static(instances):
            ray.first_prim = lists.root[i]
            lists.end[i] = float(wp.inf)
        if capacity > 0 and ray.first_prim >= 0:
            traverse(accel, lists, ray)
            if lists.count[i] > 1 and lists.count[i] <= capacity:
                lists.count[i] = sort_and_trim(lists.rows, first, lists.count[i], lists.limit)

    return list_hits


@kernel
def copy_hits(rays: RayArrays, lists: HitLists, begin: wp.array(dtype=wp.int32), hits: HitArrays, start: int):
    """Copy the list of ray i = start + tid to the entries of `hits` from begin[i] on, with t in units of the caller's direction."""
    i = start + wp.tid()
    scale = direction_scale(rays.direction[i])
    for k in range(lists.count[i]):
        store_hit(hits, begin[i] + k, lists.rows[lists.first[i] + k], scale)
