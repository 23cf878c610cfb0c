"""Smooth vertex normals for meshes without normals."""

from dataclasses import replace

import numpy as np

from wrt.scene.mesh import Mesh


def smooth(mesh: Mesh) -> Mesh:
    """Return the mesh with smooth normals: the sum of the unit normals of adjacent faces, weighted by their angle at the vertex.

    Vertices at exactly the same position get the same normal, so that texture seams do not show. With these weights the normal
    does not depend on the triangulation (Thuermer and Wuethrich, "Computing vertex normals from polygonal facets", 1998). A sum that
    cancels out gives a zero normal (flat shading). A mesh with normals is returned unchanged."""
    if mesh.normals is not None:
        return mesh
    _, place = np.unique(mesh.vertices + np.float32(0.0), axis=0, return_inverse=True)  # -0 is 0
    place = place.reshape(-1)
    normals = corner_normals(mesh.vertices[mesh.faces], place[mesh.faces], int(place.max()) + 1)
    return replace(mesh, normals=normals[place].astype(np.float32))


def corner_normals(corners: np.ndarray, place: np.ndarray, count: int) -> np.ndarray:
    """Return the normals of `smooth` (count, 3) float64 at `count` places. corners: (F, 3, 3); place: (F, 3), the place of each corner."""
    points = corners.astype(np.float64)
    edges = np.roll(points, -1, axis=1) - points  # from each corner to the next
    normal = np.cross(edges[:, 0], edges[:, 1])
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-300)
    back = -np.roll(edges, 1, axis=1)
    sine = np.linalg.norm(np.cross(edges, back), axis=2)
    angle = np.arctan2(sine, (edges * back).sum(axis=2))

    weighted = normal[:, None, :] * angle[:, :, None]
    where = place.reshape(-1)
    total = np.stack([np.bincount(where, weighted[..., axis].reshape(-1), count) for axis in range(3)], axis=1)
    length = np.linalg.norm(total, axis=1, keepdims=True)
    return np.where(length > 1e-6, total / np.maximum(length, 1e-300), 0.0)
