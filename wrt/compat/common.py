"""What the adapters share: all hits of rays, counted as in other libraries, the structure over the meshes of a RaycastingScene, and curved
shapes of simulators."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple, Self

import numpy as np

from wrt.accel.geometry import Geometry
from wrt.accel.points.contains import open_edges_of
from wrt.accel.queries.accelerator import Accelerator
from wrt.accel.queries.all_hits import ALL, ListQuery, first_hits
from wrt.accel.queries.answers import Hits
from wrt.accel.queries.rays import Rays
from wrt.accel.scenes.build import build
from wrt.core.errors import warn
from wrt.scene import shapes
from wrt.scene.clean import flip_collinear
from wrt.scene.mesh import Mesh, unit_rows
from wrt.scene.values import near_zero, warn_if_alone, warn_if_far


def every_hit(accel: Accelerator, rays: Rays, threads: int, limit: int = ALL) -> tuple[np.ndarray, ...]:
    """Return ray, face, t, u and v of each hit, ray by ray in order of distance, at most `limit` per ray. rays: see ListQuery.of_valid.

    A ray hits the faces that it crosses (`all_hits` with crossings). A ray that only touches faces hits the first touched face. If
    the mesh is closed, that ray hits up to two touched faces, the nearest ones, as entry and exit.
    """
    query = ListQuery(accel, threads, crossings=True).of_valid(rays, None)
    crossed = query.all(limit)
    found = [crossed.ray_id, crossed.prim_id, crossed.t, crossed.u, crossed.v]
    if len(rest := np.flatnonzero(query.touches)):
        touched = _touched(accel, rays.of(rest), threads)
        row, column = np.nonzero(touched.prim_id >= 0)
        more = rest[row], *(array[row, column] for array in (touched.prim_id, touched.t, touched.u, touched.v))
        found = [np.concatenate(pair) for pair in zip(found, more, strict=True)]
        order = np.argsort(found[0], kind="stable")
        found = [array[order] for array in found]
    return tuple(found)


def hit_counts(accel: Accelerator, rays: Rays, threads: int) -> np.ndarray:
    """Return the number of hits of each ray in `every_hit`, (N,) int64."""
    query = ListQuery(accel, threads, crossings=True).of_valid(rays, None)
    counts = query.counts()
    if len(rest := np.flatnonzero(query.touches)):
        counts[rest] = (_touched(accel, rays.of(rest), threads).prim_id >= 0).sum(axis=1)
    return counts


def _touched(accel: Accelerator, rays: Rays, threads: int) -> Hits[np.ndarray]:
    """Return the hits of rays that only touch faces, (N, 1) or (N, 2)."""
    return first_hits(accel, 1 if open_edges_of(accel.snapshot) else 2, *rays, threads=threads)


def mesh_of(kind: str, size: np.ndarray, segments: int) -> Mesh | None:
    """Return the mesh of a simulator's shape without data: an upper-case name and half sizes. None for other kinds.

    A plane with a size of 0 is endless: 10 km to each side."""
    if kind == "PLANE":
        x, y = np.where(size[:2] > 0.0, size[:2], 1e4)
        return shapes.quad((-x, -y, 0.0), (2.0 * x, 0.0, 0.0), (0.0, 2.0 * y, 0.0))
    if kind == "BOX":
        return shapes.box(-size, size)
    return turned(kind, size, segments) if kind in ("SPHERE", "CAPSULE", "ELLIPSOID", "CYLINDER", "CONE") else None


def warn_of(left: list[str]) -> None:
    """Warn of what a simulator's model has and a structure has not."""
    if left:
        warn(f"rays miss what cannot be traced: {', '.join(left[:5])}{f' and {len(left) - 5} more' if len(left) > 5 else ''}")


def turned(kind: str, size: np.ndarray, segments: int) -> Mesh:
    """Return a curved shape, a surface of revolution around z."""
    scale = size if kind == "ELLIPSOID" else np.ones(3)
    radius, half, barrel = (1.0, 0.0, 0.0) if kind == "ELLIPSOID" else size
    angle, middle = np.linspace(-0.5 * np.pi, 0.5 * np.pi, 2 * (segments // 4) + 1), segments // 4
    arc = radius * np.round(np.stack([np.cos(angle), np.sin(angle)], axis=1), 15)  # exactly 0 on the axis
    height = np.linspace(-half, half, len(arc) if barrel > 0.0 else 2)
    side = radius + np.sqrt(np.maximum(barrel**2 - height**2, 0.0)) - np.sqrt(max(barrel**2 - half**2, 0.0))
    wall, bottom, top = np.stack([side, height], axis=1), [[0.0, -half]], [[0.0, half]]
    profiles: Any = {"CAPSULE": np.concatenate([arc[: middle + 1] + bottom, arc[middle:] + top]),
                     "CYLINDER": np.concatenate([bottom, wall[:1], wall, wall[-1:], top]),  # repeated points are sharp
                     "CONE": np.concatenate([bottom, wall[:1], wall[:1], top, top])}
    mesh: Any = shapes.lathe(profiles.get(kind, arc), segments)
    return Mesh(np.roll(mesh.vertices, 1, axis=1) * scale, mesh.faces, unit_rows(np.roll(mesh.normals, 1, axis=1) / scale))


def scatter(found: np.ndarray, valid: np.ndarray | None, missing: object) -> np.ndarray:
    """Return an array with the rows of `found` where `valid`, and with `missing` elsewhere. valid None: all rows."""
    if valid is None:
        return found
    out = np.full((len(valid), *found.shape[1:]), missing, found.dtype)
    out[valid] = found
    return out


class JoinedMeshes(NamedTuple):
    """A structure, and what the answers say about its faces, with a last row for prim_id -1."""

    accel: Accelerator
    geometry_ids: np.ndarray  # (F + 1,) uint32, as primitive_ids
    primitive_ids: np.ndarray
    normals: np.ndarray  # (F + 1, 3) float32
    origin: np.ndarray | None  # (3,) float64: subtracted from meshes, rays and points that are far from 0
    turned: np.ndarray  # (K,) faces that were flipped, ascending
    uvs: np.ndarray  # (K, 3, 2), coordinates of their corners in the faces that were added

    @classmethod
    def of(cls, meshes: Sequence[tuple[np.ndarray, np.ndarray]], none: int, device: str, threads: int | None) -> Self:
        """Join meshes (positions, indices) and build. none: id of a miss. Collinear faces that close T joints are flipped."""
        vertices, faces, n = [], [np.zeros((0, 3), np.int64)], 0
        for positions, indices in meshes:
            faces.append(indices + n)
            vertices.append(positions)
            n += len(positions)
            warn_if_far(positions, "mesh of add_triangles")
        positions, origin = near_zero(np.concatenate(vertices) if n else np.zeros((1, 3)))
        for each in vertices if origin is None else ():
            if each.dtype == np.float64 and len(each):
                warn_if_alone(each.min(axis=0), each.max(axis=0), "mesh of add_triangles")
        given, flips = np.concatenate(faces).astype(np.int32), np.isfinite(positions).all()
        corners, source = flip_collinear(positions, given, by_place=True) if flips else (given, np.arange(len(given)))
        mesh, rows = Geometry(positions, corners, np.zeros((0, 4), np.float32)), np.append(source, -1)
        ids = [(np.full(len(indices), i, np.uint32), np.arange(len(indices), dtype=np.uint32)) for i, (_, indices) in enumerate(meshes)]
        of_face, of_mesh = (np.concatenate(column)[rows] for column in zip(*ids, ([np.uint32(none)],) * 2, strict=True))
        return cls(build(mesh, "bvh8", device=device, threads=threads), of_face, of_mesh, _normals(mesh), origin,
                   *_turned(positions, given[source], corners))

    def found(self, prim_id: np.ndarray, u: np.ndarray, v: np.ndarray) -> dict[str, np.ndarray]:
        """Return the IDs and coordinates of hits, by the names of the answers."""
        uvs = np.empty((len(u), 2), np.float32)
        uvs[:, 0], uvs[:, 1] = u, v
        if len(self.turned) and len(some := np.flatnonzero(np.isin(prim_id, self.turned))):
            weights = np.stack([1.0 - uvs[some, 0] - uvs[some, 1], uvs[some, 0], uvs[some, 1]], axis=-1)
            uvs[some] = np.einsum("ni,nij->nj", weights, self.uvs[np.searchsorted(self.turned, prim_id[some])])
        return {"geometry_ids": self.geometry_ids.take(prim_id), "primitive_ids": self.primitive_ids.take(prim_id), "primitive_uvs": uvs}


def _turned(vertices: np.ndarray, given: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return which faces (F, 3) differ from the faces `given` in which they lie, and the coordinates of their corners in these."""
    rows = np.flatnonzero((given != faces).any(axis=1))
    own, other = (vertices[corners[rows]].astype(np.float64) for corners in (faces, given))
    edges = (other[:, 1:] - other[:, :1]).transpose(0, 2, 1)
    return rows, (np.linalg.pinv(edges) @ (own - other[:, :1]).transpose(0, 2, 1)).transpose(0, 2, 1)


def _normals(mesh: Geometry) -> np.ndarray:
    """Compute the unit normals of all faces, with a last row 0."""
    a, b, c = (mesh.vertices[mesh.faces[:, i]].astype(np.float64) for i in range(3))
    with np.errstate(invalid="ignore"):  # for corners that are not finite
        normal = np.cross(b - a, c - a)
        length = np.linalg.norm(normal, axis=1, keepdims=True)
        unit = np.divide(normal, length, out=np.zeros_like(normal), where=length > 0.0)
    return np.concatenate([unit, np.zeros((1, 3))]).astype(np.float32)
