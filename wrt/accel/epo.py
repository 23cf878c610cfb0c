"""End-point overlap of a BVH: the part of the surface that lies in a node's box but not in the node's subtree."""

import numpy as np
import warp as wp

from wrt.accel.geometry import Geometry
from wrt.core.device import launch, start, upload
from wrt.core.types import WarpStruct
from wrt.kernels.build import end_point_overlap as kernels

TRIANGLES_PER_LAUNCH = 16384


def end_point_overlap(tree: WarpStruct, geometry: Geometry, threads: int) -> float:
    """Compute the end-point overlap of a BVH, at cost 1 per node and 1 per primitive; 0 without any area.

    tree: kernels.build.end_point_overlap.Children on the CPU. The source is Aila, Karras and Laine 2013, "On Quality Metrics of Bounding
    Volume Hierarchies", equation 2. It sums over all nodes: cost times the fraction of the surface that is in the node's box, but not in
    its subtree. Only finite triangles have surface. A triangle with several references is in several subtrees.
    """
    cpu = start("cpu")
    n = len(geometry.faces)
    corners = geometry.vertices[geometry.faces].astype(np.float64)
    finite = np.isfinite(corners).all(axis=(1, 2))
    corners = corners[finite]
    surface = 0.5 * np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1).sum()
    if not surface > 0.0:
        return 0.0
    vertices, faces = upload(geometry.vertices, wp.vec3, cpu), upload(geometry.faces, wp.vec3i, cpu)
    out = wp.zeros(n, dtype=wp.float64, device=cpu)
    launch(kernels.end_point_overlap, n, tree, vertices, faces, None, out, threads=threads, step=TRIANGLES_PER_LAUNCH)
    return float(out.numpy()[finite].sum() / surface)


def children(lo: np.ndarray, hi: np.ndarray, first: np.ndarray, count: np.ndarray, order: np.ndarray) -> WarpStruct:
    """Make Children for end_point_overlap. lo, hi: (N, width, 3); first, count: (N, width); order: (R,) prim_ids of the leaves."""
    cpu = start("cpu")
    tree = kernels.Children()
    tree.width = first.shape[1]
    tree.lo, tree.hi = (upload(array.reshape(-1, 3), wp.vec3, cpu) for array in (lo, hi))
    tree.first, tree.count, tree.order = (upload(array.reshape(-1), wp.int32, cpu) for array in (first, count, order))
    return tree
