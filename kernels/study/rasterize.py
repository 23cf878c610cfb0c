"""A rasterizer with a z-buffer, to compare with ray casting. It shares no code with the ray units.

Triangles are in homogeneous pixel coordinates (Olano and Greer 1997, "Triangle scan conversion using 2D homogeneous coordinates"), so that
a triangle through the camera's plane needs no clipping. Edges are closed, and each pixel keeps the smallest key (depth, prim_id), as rays
do."""

import warp as wp

from wrt.kernels.structs import kernel

HALF = wp.constant(wp.float64(0.5))
ZERO = wp.constant(wp.float64(0.0))


@wp.func
def key_of(depth: wp.float32, prim_id: int) -> wp.uint64:
    """Return a key that sorts by depth, then by prim_id. For floats >= 0, the bits have the same order as the values."""
    return (wp.uint64(wp.cast(depth, wp.uint32)) << wp.uint64(32)) | wp.uint64(prim_id)


@wp.func
def pixels_between(a: wp.float64, b: wp.float64, c: wp.float64, size: int) -> wp.vec2i:
    """Return the first and the last of the pixels 0 .. size - 1 whose centres lie between the least and the largest coordinate."""
    low = wp.clamp(wp.min(a, wp.min(b, c)), ZERO, wp.float64(size))
    high = wp.clamp(wp.max(a, wp.max(b, c)), ZERO, wp.float64(size))
    return wp.vec2i(int(wp.ceil(low - HALF)), wp.min(int(wp.floor(high - HALF)), size - 1))


@kernel
def rasterize(origin: wp.vec3d, to_pixels: wp.mat33d, from_pixels: wp.mat33d, size: wp.vec2i, vertices: wp.array(dtype=wp.vec3),
              faces: wp.array(dtype=wp.vec3i), keys: wp.array(dtype=wp.uint64)):
    """Draw triangle wp.tid(). to_pixels: maps a point minus `origin` to homogeneous pixels (x w, y w, w); from_pixels: its inverse.
    On the CPU, one thread draws all triangles, because its atomic_min is not atomic."""
    i = wp.tid()
    a = to_pixels @ (wp.vec3d(vertices[faces[i][0]]) - origin)
    b = to_pixels @ (wp.vec3d(vertices[faces[i][1]]) - origin)
    c = to_pixels @ (wp.vec3d(vertices[faces[i][2]]) - origin)
    columns = wp.vec2i(0, size[0] - 1)
    rows = wp.vec2i(0, size[1] - 1)
    if a[2] > ZERO and b[2] > ZERO and c[2] > ZERO:  # else the triangle reaches behind the camera, and may cover any pixel
        columns = pixels_between(a[0] / a[2], b[0] / b[2], c[0] / c[2], size[0])
        rows = pixels_between(a[1] / a[2], b[1] / b[2], c[1] / c[2], size[1])
    # An edge function is 0 on its edge. Its values at a pixel are the corners' weights, up to a common factor.
    edge_a = wp.cross(b, c)
    edge_b = wp.cross(c, a)
    edge_c = wp.cross(a, b)
    for row in range(rows[0], rows[1] + 1):
        for column in range(columns[0], columns[1] + 1):
            pixel = wp.vec3d(wp.float64(column) + HALF, wp.float64(row) + HALF, wp.float64(1.0))
            weights = wp.vec3d(wp.dot(edge_a, pixel), wp.dot(edge_b, pixel), wp.dot(edge_c, pixel))
            sum = weights[0] + weights[1] + weights[2]
            if wp.min(weights) * wp.max(weights) >= ZERO and sum != ZERO:
                w = wp.dot(weights, wp.vec3d(a[2], b[2], c[2])) / sum
                if w > ZERO:
                    depth = wp.float32(w * wp.length(from_pixels @ pixel))
                    wp.atomic_min(keys, row * size[0] + column, key_of(depth, i))
