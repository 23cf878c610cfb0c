"""End-point overlap: how much of the surface lies in the boxes of a hierarchy without belonging to what is below them."""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp

from wrt.accel.geometry import Geometry
from wrt.core.device import launch, start, upload
from wrt.kernels.build import end_point_overlap as kernels

TRIANGLES_PER_LAUNCH = 16384


def end_point_overlap(tree: Any, geometry: Geometry, threads: int) -> float:
    """The metric EPO of a hierarchy (kernels.build.end_point_overlap.Children on the CPU) with both costs 1; 0 without any area.

    Aila, Karras and Laine 2013, "On Quality Metrics of Bounding Volume Hierarchies", equation 2: the sum, over all nodes, of
    the node's cost times the share of the whole surface that is in its box and not below it. Only triangles have surface here;
    spheres count where they are tested. A triangle with several references is below a node that has any of them. Triangles with
    a corner that is not finite have no surface.
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


def children(lo: np.ndarray, hi: np.ndarray, first: np.ndarray, count: np.ndarray, order: np.ndarray) -> Any:
    """Children for end_point_overlap: lo, hi (N, width, 3); first, count (N, width); order: of the primitives."""
    cpu = start("cpu")
    tree = kernels.Children()
    tree.width = first.shape[1]
    tree.lo, tree.hi = (upload(array.reshape(-1, 3), wp.vec3, cpu) for array in (lo, hi))
    tree.first, tree.count, tree.order = (upload(array.reshape(-1), wp.int32, cpu) for array in (first, count, order))
    return tree
