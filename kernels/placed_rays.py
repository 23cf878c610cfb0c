"""Rays as other libraries have them: in float64, moved and scaled with a mesh, and the points that they hit; or in rows of six."""

import warp as wp

from wrt.kernels.query import FARTHEST
from wrt.kernels.structs import kernel, largest

# A direction whose largest component is within these limits is used as it is; others are multiplied by STEP or 1 / STEP.
SMALLEST, LARGEST, STEP = 2.0**-30, 2.0**30, 2.0**60


@wp.struct
class Placement:
    """Place of a structure: its point p is (q - shift) * scale * scale_again, where q is the point in the caller's units.

    The scale is a power of two, in two factors, because one could be beyond float64.
    """

    shift: wp.vec3d
    scale: wp.float64
    scale_again: wp.float64
    center: wp.vec3d  # of the structure's box, in its own units
    radius: wp.float64  # half of the box's diagonal
    near: wp.float64  # origins farther than this from the center move towards it


@wp.struct
class PlacedRays:
    """Rays of a caller, and the same rays for a structure, by ray.

    A ray that is not finite, too far away, or without direction is placed at 0, with t_max = -inf: it hits nothing.
    """

    origins: wp.array(dtype=wp.vec3d)
    directions: wp.array(dtype=wp.vec3d)
    placed_origins: wp.array(dtype=wp.vec3)
    placed_directions: wp.array(dtype=wp.vec3)
    t_max: wp.array(dtype=wp.float32)  # inf, or -inf for rays that hit nothing


@wp.struct
class HitPoints64:
    """Hits of rays in float64, by hit, and their points."""

    origins: wp.array(dtype=wp.vec3d)  # By ray, as directions.
    directions: wp.array(dtype=wp.vec3d)
    ray: wp.array(dtype=wp.int64)
    face: wp.array(dtype=wp.int64)
    u: wp.array(dtype=wp.float32)
    v: wp.array(dtype=wp.float32)
    point: wp.array(dtype=wp.vec3d)


@wp.struct
class SplitRays:
    """Rays in rows of origin and direction, and the same in two arrays, by ray. Rays that hit nothing as in PlacedRays."""

    rays: wp.array(dtype=wp.spatial_vector)
    origins: wp.array(dtype=wp.vec3)
    directions: wp.array(dtype=wp.vec3)
    t_max: wp.array(dtype=wp.float32)


@wp.func
def longest_component(direction: wp.vec3d) -> wp.float64:
    """Return the largest absolute component; NaN components do not count."""
    return wp.max(wp.abs(direction[0]), wp.max(wp.abs(direction[1]), wp.abs(direction[2])))


@wp.func
def scaled_near_one(direction: wp.vec3d) -> wp.vec3d:
    """Scale a direction by a power of two until its largest component is between 2^-30 and 2^30. 0, infinite and NaN stay."""
    scaled = wp.vec3d(direction)
    longest = longest_component(scaled)
    while longest >= wp.float64(LARGEST) and longest < wp.float64(wp.inf):
        scaled = scaled * wp.float64(wp.static(1.0 / STEP))
        longest = longest_component(scaled)
    while longest <= wp.float64(SMALLEST) and longest > wp.float64(0.0):
        scaled = scaled * wp.float64(STEP)
        longest = longest_component(scaled)
    return scaled


@kernel
def place_rays(placement: Placement, rays: PlacedRays, first: int):
    """Move and scale rays to the place of a structure, and round them to float32.

    A far origin first moves along its ray in float64 to two radii before the structure's center, because rounding would displace it.
    """
    i = first + wp.tid()
    origin = (rays.origins[i] - placement.shift) * placement.scale * placement.scale_again
    direction = scaled_near_one(rays.directions[i])
    to_center = placement.center - origin
    if wp.dot(to_center, to_center) > placement.near * placement.near:
        unit = direction / wp.length(direction)
        ahead = wp.dot(to_center, unit) - wp.float64(2.0) * placement.radius
        if ahead > wp.float64(0.0):
            origin += unit * ahead
    longest = longest_component(direction)
    finite = wp.dot(direction, direction) == wp.dot(direction, direction) and wp.dot(origin, origin) == wp.dot(origin, origin)
    rays.placed_origins[i] = wp.vec3(0.0)
    rays.placed_directions[i] = wp.vec3(1.0)
    rays.t_max[i] = -wp.inf
    if finite and longest > wp.float64(0.0) and longest < wp.float64(wp.inf) and longest_component(origin) <= wp.float64(FARTHEST):
        rays.placed_origins[i] = wp.vec3(origin)
        rays.placed_directions[i] = wp.vec3(direction)
        rays.t_max[i] = wp.inf


@kernel
def split_rays(rays: SplitRays, first: int):
    """Split rows of six numbers into origins and directions."""
    i = first + wp.tid()
    row = rays.rays[i]
    origin = wp.vec3(row[0], row[1], row[2])
    direction = wp.vec3(row[3], row[4], row[5])
    rays.origins[i] = wp.vec3(0.0)
    rays.directions[i] = wp.vec3(1.0)
    rays.t_max[i] = -wp.inf
    if wp.isfinite(origin) and wp.isfinite(direction) and largest(origin) <= FARTHEST and largest(direction) > 0.0:
        rays.origins[i] = origin
        rays.directions[i] = direction
        rays.t_max[i] = wp.inf


@kernel
def locate_hits(vertices: wp.array(dtype=wp.vec3d), faces: wp.array(dtype=wp.vec3i), hits: HitPoints64, first: int):
    """Compute where rays hit the planes of their triangles, in float64 (Moeller, Trumbore 1997).

    A ray that misses its triangle in float64 has the point at the u and v from float32. Where a direction is 0, the coordinate is the
    origin's, so that the point does not leave the cell of a grid in which the ray is.
    """
    i = first + wp.tid()
    ray = hits.ray[i]
    face = faces[hits.face[i]]
    corner = vertices[face[0]]
    e = vertices[face[1]] - corner
    f = vertices[face[2]] - corner
    s = hits.origins[ray] - corner
    p = wp.cross(hits.directions[ray], f)
    q = wp.cross(s, e)
    det = wp.dot(e, p)
    u = wp.dot(s, p) / det
    v = wp.dot(hits.directions[ray], q) / det
    if not (u >= wp.float64(0.0) and v >= wp.float64(0.0) and u + v <= wp.float64(1.0)):  # also for NaN
        u = wp.float64(hits.u[i])
        v = wp.float64(hits.v[i])
    point = corner + e * u + f * v
    for axis in range(3):
        if hits.directions[ray][axis] == wp.float64(0.0):
            point[axis] = hits.origins[ray][axis]
    hits.point[i] = point
