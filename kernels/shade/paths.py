"""Paths: pending rays, and where they begin, at the camera or at a surface."""

from functools import cache
from typing import Any, NamedTuple

import warp as wp

from wrt.kernels.shade.sampling import hash_pair
from wrt.kernels.shade.surface import Surface, spawn_point
from wrt.kernels.structs import Ray, make_ray

UNKNOWN = wp.constant(-2)  # the medium in which a camera ray begins: within glass, or not
CAMERA, REFLECTED, REFRACTED, ONWARD = (wp.constant(branch) for branch in range(4))  # the branch that made a path
BRANCHES = wp.constant(4)


@wp.func
def label(branch: int, depth: int) -> int:
    """Return Ray.slot of a path's ray until it is logged. A shadow ray has 0: it belongs to the path's ray before it."""
    return 1 + branch + BRANCHES * depth


@cache
def make_path(counting: bool) -> Any:
    """Return the struct Path. counting: as of Features."""

    @wp.struct
    class Path:
        """A pending ray.

        throughput: the share of its radiance that counts in the picture; depth: bounces so far; passed: surfaces in a row that it
        went straight through; medium: the solid glass that it is in (a material, OUTSIDE or UNKNOWN); key: of its samples;
        exclude_plus_one: 1 + the triangle that it starts on, or 0; branch, where rays are counted: CAMERA to ONWARD.
        """

        origin: wp.vec3
        direction: wp.vec3
        throughput: wp.vec3
        depth: int
        passed: int
        medium: int
        exclude_plus_one: int
        key: wp.uint32
        if counting:
            branch: int

    return Path


class Paths(NamedTuple):
    """camera_path(ray, key) -> Path; ray_of(path) -> Ray; child(path, surface, direction, throughput, branch) -> Path."""

    camera_path: Any
    ray_of: Any
    child: Any


@cache
def make_paths(counting: bool) -> Paths:
    """Return the functions that begin paths. counting: as of Features."""
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
