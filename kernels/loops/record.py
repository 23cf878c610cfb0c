"""A record of everything that happens along the rays of a pixel, for wrt.inspect.

A kernel contains this code only if it is compiled with Features.recording. The record wraps an acceleration structure: its traversals
write down each ray that they trace, and the loop (one_ray.py) adds what shading computes. The record is for one thread: a kernel
with it renders one pixel. If an array is too short, its count still grows, so that the host can repeat the sample with longer arrays."""

from functools import cache
from typing import Any, NamedTuple

import warp as wp

from wrt.kernels.shade.features import Features
from wrt.kernels.shade.follow_up import NONE, FollowUp
from wrt.kernels.shade.paths import COATED, ONWARD, REFLECTED, REFRACTED, make_path
from wrt.kernels.shade.shadows import Shadow
from wrt.kernels.shade.step import DirectLight, ShadowRequest, make_shaded
from wrt.kernels.shade.surface import Surface
from wrt.kernels.structs import Hit, Ray, Surfaces

RAYS, ENDS, LIGHTS, PATHS = (wp.constant(i) for i in range(4))  # Entries of Record.used.


@wp.struct
class TracedRay:
    """A traced ray, as in structs.Ray, and its hit, as in structs.Hit: the ray of a path, or a part of a shadow ray."""

    origin: wp.vec3
    direction: wp.vec3
    t_min: float
    t_max: float
    exclude_plus_one: int
    t: float
    u: float
    v: float
    prim_id: int


@wp.struct
class PathEnd:
    """Where the ray of a path ends: at a surface or, if material = -1, in the background. What it adds to the sample is `radiance`."""

    ray: int  # Index in Record.rays.
    depth: int  # Bounces of the path.
    throughput: wp.vec3  # Weight of the ray's radiance in the sample.
    medium: int  # Material of the solid glass around the ray's origin, OUTSIDE or UNKNOWN.
    material: int
    front: int  # 1 if the ray meets the surface's front, else 0.
    point: wp.vec3
    geometric: wp.vec3  # Unit normals on the ray's side of the surface.
    shading: wp.vec3
    weight: wp.vec3  # Weight of the surface's light in the sample: the throughput after absorption in glass and transparency.
    own: wp.vec3  # Radiance of the background, or the surface's emission and ambient term.
    direct: wp.vec3  # Direct light that the surface reflects.
    radiance: wp.vec3


@wp.struct
class AskedLight:
    """A light at a surface. Its shadow ray is traced in the parts rays[first_ray] .. rays[first_ray + n_rays - 1]."""

    end: int  # Index of the surface in Record.ends.
    light: int  # Index of the light, or of one of Features.extra_lights behind the scene's lights.
    value: wp.vec3  # ShadowRequest.value: reflected radiance if nothing occludes the light; 0 if no ray is traced.
    transmittance: wp.vec3
    first_ray: int
    n_rays: int
    cut: int  # 1 if the ray was cut by MAX_TRANSPARENT.


@wp.struct
class NewPath:
    """A path that begins at a surface, and the verdict on it (follow_up.py)."""

    end: int  # Index of the surface in Record.ends.
    branch: int  # REFLECTED, REFRACTED, ONWARD or COATED.
    bends: int  # Scatter.bends: 1 if the refracted path enters another medium.
    verdict: int
    depth: int
    origin: wp.vec3
    direction: wp.vec3
    throughput: wp.vec3


@wp.struct
class Record:
    """The events of a sample, each kind in the order in which it happens."""

    used: wp.array(dtype=wp.int32)  # Number of rays, path ends, lights and new paths so far.
    rays: wp.array(dtype=TracedRay)
    ends: wp.array(dtype=PathEnd)
    lights: wp.array(dtype=AskedLight)
    paths: wp.array(dtype=NewPath)  # In the order in which the loop pushes them on its stack.


@wp.func
def next_index(record: Record, kind: int) -> int:
    """Return the index of the next entry of this kind, and count it."""
    index = record.used[kind]
    record.used[kind] = index + 1
    return index


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
        i = next_index(accel.record, RAYS)
        if i < accel.record.rays.shape[0]:
            entry = TracedRay()
            entry.origin = ray.origin
            entry.direction = ray.direction
            entry.t_min = ray.t_min
            entry.t_max = ray.t_max
            entry.exclude_plus_one = ray.exclude_plus_one
            entry.t = hit.t
            entry.u = hit.u
            entry.v = hit.v
            entry.prim_id = hit.prim_id
            accel.record.rays[i] = entry
        return hit

    return recorded


@wp.func
def last_ray(record: Record) -> int:
    """Return the index of the ray traced last."""
    return record.used[RAYS] - 1


@wp.func
def begin_light(record: Record, light: int, request: ShadowRequest):
    """Record a light that the surface asks, before its shadow ray. The surface is the end that will be recorded next."""
    i = next_index(record, LIGHTS)
    if i < record.lights.shape[0]:
        entry = AskedLight()
        entry.end = record.used[ENDS]
        entry.light = light
        entry.value = request.value
        entry.first_ray = record.used[RAYS]
        record.lights[i] = entry


@wp.func
def end_light(record: Record, shadow: Shadow):
    """Add the result of the shadow ray to the light of begin_light."""
    i = record.used[LIGHTS] - 1
    if i < record.lights.shape[0]:
        entry = record.lights[i]
        entry.transmittance = shadow.transmittance
        entry.n_rays = shadow.rays
        entry.cut = shadow.cut
        record.lights[i] = entry


@wp.func
def store_end(record: Record, entry: PathEnd):
    i = next_index(record, ENDS)
    if i < record.ends.shape[0]:
        record.ends[i] = entry


class Recorder(NamedTuple):
    """The device functions that record the end of a path."""

    miss: Any  # (record, ray, path, radiance of the background).
    surface: Any  # (record, ray, path, surface, shaded, follow-up, direct light).


def make_recorder(features: Features) -> Recorder:
    """Return the Recorder of a scene. `ray` is the index of the path's ray in Record.rays."""
    Path, Shaded = make_path(features.counting), make_shaded(features.counting)

    @wp.func
    def end_of(path: Path, ray: int) -> PathEnd:
        entry = PathEnd()
        entry.ray = ray
        entry.depth = path.depth
        entry.throughput = path.throughput
        entry.medium = path.medium
        return entry

    @wp.func
    def miss(record: Record, ray: int, path: Path, background: wp.vec3):
        entry = end_of(path, ray)
        entry.material = -1
        entry.weight = path.throughput
        entry.own = background
        entry.radiance = wp.cw_mul(path.throughput, background)
        store_end(record, entry)

    @wp.func
    def new_path(record: Record, path: Path, branch: int, bends: int, verdict: int):
        if verdict != NONE:
            i = next_index(record, PATHS)
            if i < record.paths.shape[0]:
                entry = NewPath()
                entry.end = record.used[ENDS]
                entry.branch = branch
                entry.bends = bends
                entry.verdict = verdict
                entry.depth = path.depth
                entry.origin = path.origin
                entry.direction = path.direction
                entry.throughput = path.throughput
                record.paths[i] = entry

    @wp.func
    def surface(record: Record, ray: int, path: Path, s: Surface, shaded: Shaded, next: FollowUp, direct: DirectLight):
        new_path(record, shaded.onward, ONWARD, 0, next.onward)
        new_path(record, shaded.coated, COATED, 0, next.coated)
        new_path(record, shaded.reflected, REFLECTED, 0, next.reflected)
        new_path(record, shaded.refracted, REFRACTED, shaded.scatter.bends, next.refracted)
        entry = end_of(path, ray)
        entry.material = s.material
        entry.front = s.front
        entry.point = s.point
        entry.geometric = s.geometric
        entry.shading = s.shading
        entry.weight = next.pending_light.throughput
        entry.own = next.pending_light.light
        entry.direct = direct.radiance
        entry.radiance = wp.cw_mul(next.pending_light.throughput, next.pending_light.light + direct.radiance)
        store_end(record, entry)

    return Recorder(miss, surface)
