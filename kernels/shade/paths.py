"""Paths: rays from the camera or from a surface that wait to be traced, with their throughput."""

import warp as wp

from wrt.kernels.shade.sampling import hash_pair
from wrt.kernels.shade.surface import Surface, spawn_point
from wrt.kernels.structs import Ray, make_ray

UNKNOWN = wp.constant(-2)  # Path.medium of a camera ray, which may start inside glass.
CAMERA, REFLECTED, REFRACTED, ONWARD, COATED = (wp.constant(branch) for branch in range(5))  # The branch that made a path.
BRANCHES = wp.constant(5)


@wp.struct
class Path:
    """A ray that waits to be traced."""

    origin: wp.vec3
    direction: wp.vec3
    throughput: wp.vec3  # Weight of the ray's radiance in the sample.
    depth: int  # Bounces so far.
    passed: int  # Blended surfaces that the path has passed straight since its last bounce.
    medium: int  # Material of the solid glass around the origin, OUTSIDE or UNKNOWN.
    exclude_plus_one: int  # 1 + prim_id of the triangle that the ray starts on and ignores; 0: none.
    key: wp.uint32  # Seed of the random numbers at the ray's hit.
    branch: int  # CAMERA, REFLECTED, REFRACTED, ONWARD or COATED.


@wp.func
def label(branch: int, depth: int) -> int:
    """Return the Ray.slot that gives branch and depth to the ray log. A shadow ray has 0: it belongs to the path ray logged before it."""
    return 1 + branch + BRANCHES * depth


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
    ray.slot = label(path.branch, path.depth)
    return ray


@wp.func
def child(path: Path, s: Surface, direction: wp.vec3, throughput: wp.vec3, branch: int) -> Path:
    """Return the path that leaves surface s after one more bounce, in the medium of `path`."""
    out = Path()
    out.origin = spawn_point(s.point, s.error, s.geometric, direction)
    out.direction = direction
    out.throughput = throughput
    out.depth = path.depth + 1
    out.medium = path.medium
    out.exclude_plus_one = s.exclude_plus_one
    out.key = hash_pair(path.key, wp.uint32(branch))
    out.branch = branch
    return out
