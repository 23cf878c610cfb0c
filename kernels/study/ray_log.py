"""A log of every ray of a picture: what it asks, its kind, and its number of bounces.
A logged structure wraps the structure proper: its traversal logs the ray, gives it a row of the counters, and hands it on. Only kernels
that profile are compiled with it."""

from functools import cache
from typing import Any

import warp as wp

from wrt.kernels.structs import Hit, Ray, Surfaces


@wp.struct
class LoggedRay:
    """A ray as in structs.Ray, with its kind and its answer."""

    origin: wp.vec3
    direction: wp.vec3
    t_min: float
    t_max: float
    exclude_plus_one: int
    label: int  # By shade.paths.label.
    any_hit: int  # 1: an any-hit query.
    hit: int  # 1: it hit.


@wp.struct
class RayLog:
    """The log of a tile."""

    used: wp.array(dtype=wp.int32)  # Rays of each pixel so far.
    first: wp.array(dtype=wp.int64)  # First entry of each pixel in `rays`; length 0: count, do not log.
    rays: wp.array(dtype=LoggedRay)


@cache
def make_struct(accel_struct: Any) -> Any:
    """Make the logged structure."""

    @wp.struct
    class Logged:
        accel: accel_struct
        log: RayLog
        row: int  # Pixel of this thread in the tile; each thread sets it in its own copy.

    return Logged


def make_traversal(accel_struct: Any, traverse: Any, any_hit: bool) -> Any:
    """Make `traverse` with a log; its counters go to the ray's row, or to the pixel's if rays are only counted."""
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
