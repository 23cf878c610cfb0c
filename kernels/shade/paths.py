"""Paths: rays that wait to be traced, from the camera or from a surface."""

from functools import cache
from typing import Any, NamedTuple

import warp as wp

from wrt.kernels.shade.sampling import hash_pair
from wrt.kernels.shade.surface import Surface, spawn_point
from wrt.kernels.structs import Ray, make_ray

UNKNOWN = wp.constant(-2)  # The medium of a camera ray: it may start inside glass.
CAMERA, REFLECTED, REFRACTED, ONWARD = (wp.constant(branch) for branch in range(4))  # The branch that made a path.
BRANCHES = wp.constant(4)


@wp.func
def label(branch: int, depth: int) -> int:
    """Return the Ray.slot of a path's ray before it is logged. A shadow ray has 0: it belongs to the path's ray before it."""
    return 1 + branch + BRANCHES * depth


@cache
def make_path(counting: bool) -> Any:
    """Return the struct Path. `counting` as in Features."""

    @wp.struct
    class Path:
        """A ray that waits to be traced."""

        origin: wp.vec3
        direction: wp.vec3
        throughput: wp.vec3  # Weight of its radiance in the sample.
        depth: int  # Bounces so far.
        passed: int  # Surfaces in a row that it passed straight.
        medium: int  # The solid glass around it: a material, OUTSIDE or UNKNOWN.
        exclude_plus_one: int  # 1 + the triangle that it starts on, or 0.
        key: wp.uint32  # Seed of its samples.
        if counting:
            branch: int  # CAMERA to ONWARD.

    return Path


class Paths(NamedTuple):
    """The functions that make paths and their rays."""

    camera_path: Any  # (ray, key) -> Path.
    ray_of: Any  # (path) -> Ray.
    child: Any  # (path, surface, direction, throughput, branch) -> Path.


@cache
def make_paths(counting: bool) -> Paths:
    """Return the functions that make paths. `counting` as in Features."""
    Path = make_path(counting)

    @wp.func
    def camera_path(camera_ray: Ray, key: wp.uint32) -> Path:
        path = Path()
        path.origin = camera_ray.origin
        path.direction = camera_ray.direction
        path.throughput = wp.vec3(1.0, 1.0, 1.0)
        path.medium = UNKNOWN
        path.key = key
        return path

    @wp.func
    def ray_of(path: Path) -> Ray:
        ray = make_ray(path.origin, path.direction)
        ray.exclude_plus_one = path.exclude_plus_one
        if wp.static(counting):
            ray.slot = label(path.branch, path.depth)
        return ray

    @wp.func
    def child(path: Path, s: Surface, direction: wp.vec3, throughput: wp.vec3, branch: int) -> Path:
        out = Path()
        out.origin = spawn_point(s.point, s.error, s.geometric, direction)
        out.direction = direction
        out.throughput = throughput
        out.depth = path.depth + 1
        out.medium = path.medium
        out.exclude_plus_one = s.exclude_plus_one
        out.key = hash_pair(path.key, wp.uint32(branch))
        if wp.static(counting):
            out.branch = branch
        return out

    return Paths(camera_path, ray_of, child)
