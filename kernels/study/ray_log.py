"""A log of every ray of a picture: closest hit or any hit, its kind, and its number of bounces.
A logged structure wraps an acceleration structure. Its traversal logs the ray, sets Ray.slot for the counters, and calls the wrapped
traversal. Only the kernels of profiles are compiled with it."""

from functools import cache
from typing import Any

import warp as wp

from wrt.kernels.structs import Hit, Ray, Surfaces


@wp.struct
class LoggedRay:
    """A ray as in structs.Ray, its kind, and whether it hit."""

    origin: wp.vec3
    direction: wp.vec3
    t_min: float
    t_max: float
    exclude_plus_one: int
    label: int  # Kind and number of bounces, packed by shade.paths.label.
    any_hit: int  # 1 for an any-hit query, 0 for a closest hit.
    hit: int  # 1 if the ray hit anything, else 0.


@wp.struct
class RayLog:
    """The log of a tile, a rectangle of pixels; `used` and `first` have an entry per pixel."""

    used: wp.array(dtype=wp.int32)  # Number of rays of each pixel so far.
    first: wp.array(dtype=wp.int64)  # Index in `rays` of each pixel's first ray. Length 0: count rays, but do not log them.
    rays: wp.array(dtype=LoggedRay)


@cache
def make_struct(accel_struct: Any) -> Any:
    """Make the type of the logged structure."""

    @wp.struct
    class Logged:
        accel: accel_struct
        log: RayLog
        row: int  # Index in the tile of this thread's pixel; each thread sets it in its own copy.

    return Logged


def make_traversal(accel_struct: Any, traverse: Any, any_hit: bool) -> Any:
    """Wrap `traverse` with a log. Ray.slot, the index for counters, becomes the ray's index in the log; without a log, the pixel's."""
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
