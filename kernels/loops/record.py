"""A record of everything that happens along the rays of a pixel, for wrt.inspect.

A kernel contains this code only if it is compiled with Features.recording. The record wraps an acceleration structure: its traversals
write down each ray that they trace, and the loop (one_ray.py) adds what shading computes. The record is for one thread: a kernel
with it renders one pixel. If an array is too short, its count still grows, so that the host can repeat the sample with longer arrays."""

from functools import cache
from typing import Any

import warp as wp

from wrt.kernels.shade.follow_up import FollowUp
from wrt.kernels.shade.paths import Path
from wrt.kernels.shade.shadows import Shadow
from wrt.kernels.shade.step import DirectLight, Shaded, ShadowRequest
from wrt.kernels.shade.surface import Surface
from wrt.kernels.structs import Hit, Ray, Surfaces

RAYS, ENDS, LIGHTS = (wp.constant(i) for i in range(3))  # Entries of Record.used.


@wp.struct
class TracedRay:
    """The ray of a path, or a part of a shadow ray."""

    ray: Ray
    hit: Hit


@wp.struct
class PathEnd:
    """Where the ray of a path ends: at a surface or, if the ray has no hit, in the background."""

    ray: int  # Index in Record.rays.
    path: Path
    background: wp.vec3  # Its radiance, if the ray has no hit. The fields below are set if it has one.
    surface: Surface  # With the shading normal.
    shaded: Shaded  # With the new paths.
    next: FollowUp  # The verdicts on them; its pending_light is the surface's own light, with the weight of all its light.
    direct: DirectLight


@wp.struct
class AskedLight:
    """A light at a surface. Its shadow ray is traced in the parts rays[first_ray] .. rays[first_ray + shadow.rays - 1]."""

    end: int  # Index of the surface in Record.ends.
    light: int  # Index of the light, or of one of Features.extra_lights behind the scene's lights.
    first_ray: int
    request: ShadowRequest
    shadow: Shadow


@wp.struct
class Record:
    """The events of a sample, each kind in the order in which it happens."""

    used: wp.array(dtype=wp.int32)  # Number of rays, path ends and lights so far.
    rays: wp.array(dtype=TracedRay)
    ends: wp.array(dtype=PathEnd)
    lights: wp.array(dtype=AskedLight)


@cache
def make_struct(accel_struct: Any) -> Any:
    """Return the type of a structure with a record."""

    @wp.struct
    class Recorded:
        accel: accel_struct
        record: Record

    return Recorded


def make_traversal(accel_struct: Any, traverse: Any, any_hit: bool) -> Any:
    """Return a traversal like `traverse` that records the ray and its hit. any_hit: not recorded, because render loops know it."""
    struct = make_struct(accel_struct)

    @wp.func
    def recorded(accel: struct, surfaces: Surfaces, ray: Ray) -> Hit:
        hit = traverse(accel.accel, surfaces, ray)
        i = accel.record.used[RAYS]
        accel.record.used[RAYS] = i + 1
        if i < accel.record.rays.shape[0]:
            entry = TracedRay()
            entry.ray = ray
            entry.hit = hit
            accel.record.rays[i] = entry
        return hit

    return recorded


@wp.func
def record_light(record: Record, light: int, request: ShadowRequest, shadow: Shadow):
    """Record a light that a surface asks, after its shadow ray. The surface is the end that will be recorded next."""
    i = record.used[LIGHTS]
    record.used[LIGHTS] = i + 1
    if i < record.lights.shape[0]:
        entry = AskedLight()
        entry.end = record.used[ENDS]
        entry.light = light
        entry.first_ray = record.used[RAYS] - shadow.rays
        entry.request = request
        entry.shadow = shadow
        record.lights[i] = entry


@wp.func
def record_end(record: Record, entry: PathEnd):
    i = record.used[ENDS]
    record.used[ENDS] = i + 1
    if i < record.ends.shape[0]:
        record.ends[i] = entry
