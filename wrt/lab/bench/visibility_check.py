"""Compare the pictures of z-buffer and rays: rounding must explain each pixel that differs; count the unexplained pixels."""

import numpy as np

from wrt.accel.geometry import Geometry
from wrt.lab.bench.rasterizer import Rasterizer, RayCaster, directions_from_pixels
from wrt.lab.bench.report import Row
from wrt.renderer.upload import camera_struct
from wrt.scene.cameras import Camera

# Bound on how far rounding in a ray's generation and triangle test moves a corner, over ROUNDOFF times the corner's distance. The sum and
# length of the direction, the offset from the origin, and the shear add a few roundings each.
ROUNDINGS = 16.0
ROUNDOFF = 2.0**-24
AROUND = [(np.cos(a), np.sin(a)) for a in np.arange(8) * (np.pi / 4.0)]  # points of a ring of radius 1
MAX_RINGS = 8  # each ring has twice the radius of the last


def agreement(rasterizer: Rasterizer, caster: RayCaster, geometry: Geometry, camera: Camera, size: tuple[int, int]) -> Row:
    """Draw a picture with both methods and compare the results. Afterwards `rasterizer` may hold a picture of shifted samples."""
    caster.draw(camera, size)
    return compare(rasterizer, caster.depth(), caster.prim_id(), geometry, camera, size)


def compare(rasterizer: Rasterizer, depth: np.ndarray, prim_id: np.ndarray, geometry: Geometry, camera: Camera,
            size: tuple[int, int]) -> Row:
    """Compare the rays' depth (H, W) float32 and prim_id (H, W) int32 with the rasterizer's, pixel by pixel.

    - covered: pixels where the z-buffer has a triangle. differ: pixels whose prim_id differs; each is a tie, silhouette or unexplained.
    - ties: depths agree within their bound, because the pixel's centre is on a common edge or triangles coincide.
    - silhouettes: the z-buffer has the rays' depth at a point within a rounding error, some 1e-4 pixels, of the pixel's centre.
    - depth_error, depth_share: where prim_id agrees, the largest difference of depth over the depth, and over its bound."""
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
    untied = differ & ~tied
    reach = np.maximum(edge_reach(geometry, camera, size, exact_id, exact_depth), edge_reach(geometry, camera, size, prim_id, depth))
    beside = _beside(rasterizer, depth, bound, np.where(untied, reach, 0.0), camera, size, geometry)
    return Row(
        pixels=differ.size, covered=int((exact_id >= 0).sum()), differ=int(differ.sum()), ties=int(tied.sum()),
        silhouettes=int(beside.sum()), unexplained=int((untied & ~beside).sum()),
        depth_error=float(relative.max(initial=0.0)), depth_share=float(share.max(initial=0.0)))


def _close(a: np.ndarray, b: np.ndarray, bound: np.ndarray) -> np.ndarray:
    with np.errstate(invalid="ignore"):  # inf - inf, of two misses
        return (a == b) | (np.abs(a.astype(np.float64) - b) <= bound)


def _corners(geometry: Geometry, camera: Camera, size: tuple[int, int], prim_id: np.ndarray) -> np.ndarray:
    """Return the corners of the triangles `prim_id` as offsets from the camera: (N, 3 corners, 3) float64."""
    origin = np.array(list(camera_struct(camera, size).origin), np.float64)
    return geometry.vertices[geometry.faces[prim_id]].astype(np.float64) - origin


def depth_bound(geometry: Geometry, camera: Camera, size: tuple[int, int], prim_id: np.ndarray) -> np.ndarray:
    """Bound to first order the error of the depth of each pixel's ray on its triangle `prim_id` (H, W); 0 on a miss.
    An error e of the corners moves the hit by at most e / cos(angle of incidence), and at most e + the triangle's extent along the ray."""
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
    """Return flags of the pixels for which the z-buffer has the ray's depth at a point within `reach` pixels of the centre.
    All arrays are (H, W). Skip pixels of reach 0. Search on rings around the centre, each with twice the radius of the last."""
    found = np.zeros(depth.shape, bool)
    radius = reach[reach > 0.0].min(initial=np.inf)
    for _ in range(MAX_RINGS):
        pending = ~found & (reach >= radius)
        if not pending.any():
            break
        for x, y in AROUND:
            rasterizer.draw(camera, size, (radius * x, radius * y))
            nearby = np.where(pending, rasterizer.prim_id(), -1)
            found |= pending & _close(rasterizer.depth(), depth, bound + depth_bound(geometry, camera, size, nearby))
        radius *= 2.0
    return found


def edge_reach(geometry: Geometry, camera: Camera, size: tuple[int, int], prim_id: np.ndarray, depth: np.ndarray) -> np.ndarray:
    """Bound in pixels how far rounding moves an edge of each pixel's triangle `prim_id` (H, W), seen at `depth`; 0 on a miss.
    The farthest corner sets the error of the whole triangle, also for a pixel that shows a nearer part."""
    c = camera_struct(camera, size)
    per_radian = 0.5 * max(size[0] / c.tan_x, size[1] / c.tan_y) * (1.0 + c.tan_x**2 + c.tan_y**2)
    out = np.zeros(prim_id.shape)
    hit = prim_id >= 0
    far = np.linalg.norm(_corners(geometry, camera, size, prim_id[hit]), axis=2).max(axis=1)
    out[hit] = ROUNDINGS * ROUNDOFF * per_radian * far / np.maximum(depth[hit], 1e-300)
    return out
