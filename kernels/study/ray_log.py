"""A log of every ray that a picture takes: what it asks, of which kind it is, and behind how many bounces.

A logged structure is one more in front of the structure proper: its traversal writes the ray down, gives it a row of the
counters, and hands it on. Only kernels that profile are compiled with it.
"""

from functools import cache
from typing import Any

import warp as wp

from wrt.kernels.structs import Hit, Ray, Surfaces


@wp.struct
class LoggedRay:
    """As structs.Ray; label: of shade.paths.label; any_hit: 1 where only whether was asked; hit: 1 where there was one."""

    origin: wp.vec3
    direction: wp.vec3
    t_min: float
    t_max: float
    exclude_plus_one: int
    label: int
    any_hit: int
    hit: int


@wp.struct
class RayLog:
    """Of a tile. used: rays so far of each pixel; first: where each pixel's begin in `rays` (length 0: they are counted, and
    not written down)."""

    used: wp.array(dtype=wp.int32)
    first: wp.array(dtype=wp.int64)
    rays: wp.array(dtype=LoggedRay)


@cache
def make_struct(accel_struct: Any) -> Any:
    """row: the pixel of this thread, counted from the tile's first; each thread sets it in its own copy."""

    @wp.struct
    class Logged:
        accel: accel_struct
        log: RayLog
        row: int

    return Logged


def make_traversal(accel_struct: Any, traverse: Any, any_hit: bool) -> Any:
    """`traverse`, with the ray in the log. Its counters go to the ray's own row, or without rows to the pixel's."""
    struct = make_struct(accel_struct)

    @wp.func
    def logged(accel: struct, surfaces: Surfaces, ray: Ray) -> Hit:
        pixel = accel.row
        used = accel.log.used[pixel]
        accel.log.used[pixel] = used + 1
        numbered = ray
        numbered.slot = pixel
        if accel.log.first.shape[0] == 0:
            return traverse(accel.accel, surfaces, numbered)
        numbered.slot = int(accel.log.first[pixel]) + used
        entry = LoggedRay()
        entry.origin = ray.origin
        entry.direction = ray.direction
        entry.t_min = ray.t_min
        entry.t_max = ray.t_max
        entry.exclude_plus_one = ray.exclude_plus_one
        entry.label = ray.slot
        entry.any_hit = wp.static(1 if any_hit else 0)
        hit = traverse(accel.accel, surfaces, numbered)
        entry.hit = wp.where(hit.prim_id >= 0, 1, 0)
        accel.log.rays[numbered.slot] = entry
        return hit

    return logged
