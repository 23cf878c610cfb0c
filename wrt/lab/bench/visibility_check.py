"""Comparison of z-buffer and rays: each pixel where they differ is explained by rounding, or counted."""

from __future__ import annotations

import numpy as np

from wrt.accel.geometry import Geometry
from wrt.lab.bench.rasterizer import Rasterizer, RayCaster, directions_from_pixels
from wrt.lab.bench.report import Row
from wrt.renderer.upload import camera_struct
from wrt.scene.cameras import Camera

# Bound on the ray units' roundings that move a corner, in units of roundoff times its distance. The direction's sum and length, the
# offset from the origin, and the shear take a few each.
ROUNDINGS = 16.0
ROUNDOFF = 2.0**-24
AROUND = [(np.cos(a), np.sin(a)) for a in np.arange(8) * (np.pi / 4.0)]
MAX_RINGS = 8  # the last of 128 times the smallest radius


def agreement(rasterizer: Rasterizer, caster: RayCaster, geometry: Geometry, camera: Camera, size: tuple[int, int]) -> Row:
    """Draw the same picture with both and `compare`. The rasterizer holds another picture afterwards."""
    caster.draw(camera, size)
    return compare(rasterizer, caster.depth(), caster.prim_id(), geometry, camera, size)


def compare(rasterizer: Rasterizer, depth: np.ndarray, prim_id: np.ndarray, geometry: Geometry, camera: Camera,
            size: tuple[int, int]) -> Row:
    """Compare a picture by rays, depth (H, W) float32 and prim_id (H, W) int32, with the rasterizer's, pixel by pixel.

    - covered: pixels where the z-buffer has a triangle. differ: pixels with another prim_id, split into the next three.
    - ties: depths agree within their bound: the centre is on a common edge, or triangles coincide.
    - silhouettes: less than a rounding error (some 1e-4 pixels) beside the centre, the exact depth is that of the rays.
    - unexplained: the rest. depth_error: largest relative difference at the same prim_id; depth_share: its share of the bound."""
    rasterizer.draw(camera, size)
    exact_depth, exact_id = rasterizer.depth(), rasterizer.prim_id()
    same = (exact_id == prim_id) & (exact_id >= 0)
    bound = depth_bound(geometry, camera, size, exact_id)
    error = np.zeros(exact_depth.shape)
    error[same] = np.abs(exact_depth[same].astype(np.float64) - depth[same])
    share = np.divide(error, bound, out=np.zeros_like(error), where=same & (error > 0.0))
    relative = np.divide(error, exact_depth, out=np.zeros_like(error), where=same & (error > 0.0))

    differ = exact_id != prim_id
    bound = bound + depth_bound(geometry, camera, size, prim_id)
    tied = differ & _close(exact_depth, depth, bound)
    asked = differ & ~tied
    reach = np.maximum(edge_reach(geometry, camera, size, exact_id, exact_depth), edge_reach(geometry, camera, size, prim_id, depth))
    beside = _beside(rasterizer, depth, bound, np.where(asked, reach, 0.0), camera, size, geometry)
    return Row(
        pixels=differ.size, covered=int((exact_id >= 0).sum()), differ=int(differ.sum()), ties=int(tied.sum()),
        silhouettes=int(beside.sum()), unexplained=int((asked & ~beside).sum()),
        depth_error=float(relative.max(initial=0.0)), depth_share=float(share.max(initial=0.0)))


def _close(a: np.ndarray, b: np.ndarray, bound: np.ndarray) -> np.ndarray:
    with np.errstate(invalid="ignore"):  # inf - inf, of two misses
        return (a == b) | (np.abs(a.astype(np.float64) - b) <= bound)


def _corners(geometry: Geometry, camera: Camera, size: tuple[int, int], prim_id: np.ndarray) -> np.ndarray:
    """Return the corners of the triangles of prim_id as offsets from the camera: (N, 3 corners, 3) float64."""
    origin = np.array(list(camera_struct(camera, size).origin), np.float64)
    return geometry.vertices[geometry.faces[prim_id]].astype(np.float64) - origin


def depth_bound(geometry: Geometry, camera: Camera, size: tuple[int, int], prim_id: np.ndarray) -> np.ndarray:
    """Bound the error of a ray's depth on the triangles of `prim_id` (H, W), to first order; 0 on a miss.
    Corners that are off by e move the plane by at most e and the hit by e / cos(angle of incidence), and by no more than the triangle's
    size."""
    row, column = np.nonzero(prim_id >= 0)
    out = np.zeros(prim_id.shape)
    corners = _corners(geometry, camera, size, prim_id[row, column])
    d = np.column_stack([column + 0.5, row + 0.5, np.ones(len(row))]) @ directions_from_pixels(camera, size).T
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-300)
    cosine = np.abs(np.einsum("ij,ij->i", normal, d))
    far = np.linalg.norm(corners, axis=2).max(axis=1)
    error = ROUNDINGS * ROUNDOFF * far
    along = np.einsum("nij,nj->ni", corners, d)
    out[row, column] = np.minimum(error / np.maximum(cosine, 1e-300), np.ptp(along, axis=1) + error)
    return out


def _beside(rasterizer: Rasterizer, depth: np.ndarray, bound: np.ndarray, reach: np.ndarray, camera: Camera,
            size: tuple[int, int], geometry: Geometry) -> np.ndarray:
    """Return where the exact picture has the rays' depth within `reach` pixels of the centre (0: not looked for).
    Look on rings around the centre, each of twice the radius."""
    found = np.zeros(depth.shape, bool)
    radius = reach[reach > 0.0].min(initial=np.inf)
    for _ in range(MAX_RINGS):
        left = ~found & (reach >= radius)
        if not left.any():
            break
        for x, y in AROUND:
            rasterizer.draw(camera, size, (radius * x, radius * y))
            there = np.where(left, rasterizer.prim_id(), -1)
            found |= left & _close(rasterizer.depth(), depth, bound + depth_bound(geometry, camera, size, there))
        radius *= 2.0
    return found


def edge_reach(geometry: Geometry, camera: Camera, size: tuple[int, int], prim_id: np.ndarray, depth: np.ndarray) -> np.ndarray:
    """Bound how far rounding moves an edge of the triangles of `prim_id` (H, W) at `depth`, in pixels; 0 on a miss.
    The error of a far corner counts where a near part of the triangle is seen, too."""
    c = camera_struct(camera, size)
    per_radian = 0.5 * max(size[0] / c.tan_x, size[1] / c.tan_y) * (1.0 + c.tan_x**2 + c.tan_y**2)
    out = np.zeros(prim_id.shape)
    hit = prim_id >= 0
    far = np.linalg.norm(_corners(geometry, camera, size, prim_id[hit]), axis=2).max(axis=1)
    out[hit] = ROUNDINGS * ROUNDOFF * per_radian * far / np.maximum(depth[hit], 1e-300)
    return out
