"""Points inside a closed mesh."""

from __future__ import annotations

from copy import copy
from dataclasses import replace
from functools import cache
from typing import Any, overload

import numpy as np
import numpy.typing as npt
import warp as wp

from wrt.accel.geometry import Geometry, InstancedGeometry, NumberedGeometry
from wrt.accel.queries.accelerator import Accelerator, snapshot_of
from wrt.accel.queries.all_hits import ListQuery
from wrt.accel.queries.arguments import WorldIds, check_world, in_shape, points_of
from wrt.accel.queries.rays import Rays, constant
from wrt.accel.snapshot import Snapshot, once
from wrt.core.arrays import given_like
from wrt.core.errors import InputError
from wrt.core.types import ArrayLike, NumpyLike, TensorT, WarpArray
from wrt.scene.clean import copies, flip_collinear, has_area, merged, windings


@once
def open_edges_of(snapshot: Snapshot) -> int:
    """Count the open edges of a structure's mesh, or of all meshes below its instances."""
    geometry = snapshot.geometry
    parts = [geometry.parts[i] for i in np.unique(geometry.part)] if isinstance(geometry, InstancedGeometry) else [geometry]
    return sum(map(open_edges, parts))


@once
def used_bounds(snapshot: Snapshot) -> tuple[np.ndarray, np.ndarray]:
    """Return the bounding box of all finite faces: low and high, (3,) each; inf and -inf without faces. All of space for instances."""
    geometry = snapshot.geometry
    if isinstance(geometry, InstancedGeometry):
        return np.full(3, -np.inf), np.full(3, np.inf)
    used = geometry.vertices[geometry.faces[finite_faces(geometry)]].reshape(-1, 3)
    return used.min(axis=0, initial=np.inf), used.max(axis=0, initial=-np.inf)


@overload
def contains(accel: Accelerator, points: NumpyLike | WarpArray, threads: int | None = ..., *,
             world: ArrayLike | None = ...) -> npt.NDArray[np.bool_]: ...
@overload
def contains(accel: Accelerator, points: TensorT, threads: int | None = ..., *, world: ArrayLike | None = ...) -> TensorT: ...
def contains(accel: Accelerator, points: ArrayLike, threads: int | None = None, *, world: ArrayLike | None = None) -> object:
    """Test whether points are inside a closed mesh: a ray from an inside point crosses the surface an odd number of times.

    By this rule a point inside two overlapping parts is outside. With the watertight test the result does not depend on the ray's
    direction. For a point within a rounding error of the surface, the result may be True or False.

    Parameters
    ----------
    accel : Accelerator
        Structure over a closed mesh, or over instances of closed meshes, without spheres.
    points : (..., 3) array_like
        Points, converted to float32.
    threads, world
        See `Accelerator.closest_hit`, with points in place of rays.

    Returns
    -------
    (...) bool
        Array of NumPy, or of the library of `points`: PyTorch, JAX.

    Raises
    ------
    InputError
        For a mesh that is not closed, other structures, and points that are not finite.
    """
    query = ListQuery(enclosing(accel), threads, crossings=True)
    rows, shape = points_of(points, query.snapshot.geometry.origin)
    if count := open_edges_of(query.snapshot):
        raise InputError(f"the mesh is not closed: {count} edges have an odd number of faces",
                         hint="for an open mesh, use wrt.winding_number(accel, points) > 0.5, or wrt.signed_distance(..., sign='winding')")
    inside = in_shape(odd_crossings(query, rows, worlds=check_world(query.snapshot, shape, world)), shape)
    return inside if isinstance(points, wp.array) else given_like(points, inside)


def odd_crossings(query: ListQuery, rows: np.ndarray, seed: int = 0, worlds: WorldIds | None = None) -> np.ndarray:
    """Return whether a ray from each point in `rows` crosses the surface an odd number of times.

    rows: (N, 3) float32, valid origins. seed: of the rays' direction.
    """
    inside = np.zeros(len(rows), bool)
    low, high = used_bounds(query.snapshot)
    within = np.nonzero(((rows >= low) & (rows <= high)).all(axis=1))[0]
    if len(within):
        n = len(within)
        rays = Rays(rows[within], np.tile(direction_of(seed), (n, 1)), constant(0.0, n), constant(np.inf, n))
        counts = query.of_valid(rays, worlds).counts()
        inside[within] = counts % 2 == 1
    return inside


@cache
def direction_of(seed: int) -> np.ndarray:
    """Return a random direction, (3,) float32."""
    return np.random.default_rng(seed).normal(size=3).astype(np.float32)


# --- the surface that encloses space: what decides on inside, without copies of faces -----------------------------------------


def finite_faces(geometry: Geometry) -> np.ndarray:
    """Return the indices of the faces whose corners are all finite, (F,); no ray hits the others."""
    return np.flatnonzero(np.isfinite(geometry.vertices).all(axis=1)[geometry.faces].all(axis=1))


def edges_of(faces: np.ndarray) -> np.ndarray:
    """Return a number for each edge of faces (F, 3), (F, 3) int64: of the corners 0 and 1, 1 and 2, 0 and 2. -1: an edge of length 0."""
    p, q = faces[:, [0, 1, 0]].astype(np.int64), faces[:, [1, 2, 2]].astype(np.int64)
    number = np.unique(np.minimum(p, q) << 32 | np.maximum(p, q), return_inverse=True)[1].reshape(-1, 3)
    return np.where(p == q, -1, number)


def open_edges(geometry: Geometry) -> int:
    """Count the edges that an odd number of finite faces share; 0: a closed mesh. Vertices with equal coordinates are merged."""
    edges = edges_of(merged(geometry.vertices)[geometry.faces[finite_faces(geometry)]])
    return int(np.count_nonzero(np.bincount(edges[edges >= 0]) % 2))


def enclosing(accel: Accelerator) -> Accelerator:
    """Return a structure over the surface that decides on inside (`enclosing_faces`) of a mesh, or of the meshes of instances.

    A mesh without copies of faces and without collinear faces is that surface: the result is a copy of `accel`, which a refit does not
    change. Raises InputError for structures with spheres."""
    accel = copy(accel)
    other = _enclosing(snapshot_of(accel, instances=True), accel)
    return accel if other is None else other


@once
def _enclosing(snapshot: Snapshot, accel: Any) -> Accelerator | None:
    geometry: Any = snapshot.geometry
    units = snapshot.structure.units
    if isinstance(geometry, InstancedGeometry):
        parts: list[Any] = [enclosing(bottom) for bottom in accel.bottoms]
        if all(new.snapshot is old.snapshot for new, old in zip(parts, accel.bottoms, strict=True)):
            return None
        geometry = replace(geometry.now(), parts=tuple(part.geometry for part in parts))
        return type(accel).restore(parts, geometry, None, str(accel.device), accel.threads)
    if (found := enclosing_faces(geometry)) is None:
        return None
    rest = geometry.vertices, found[0], geometry.spheres, geometry.origin
    inside = NumberedGeometry(*rest, geometry.prim_ids[found[1]]) if isinstance(geometry, NumberedGeometry) else Geometry(*rest)
    return type(accel)(inside, device=str(accel.device), threads=accel.threads, triangle=units.triangle, box=units.box,
                       **vars(accel.built_with))


def enclosing_faces(geometry: Geometry) -> tuple[np.ndarray, np.ndarray] | None:
    """Return the faces (K, 3) that decide on inside, and the face from which each comes, ascending (K,); None: all faces decide.

    Copies of a face have its corners, by coordinates, in any order. They count once, with the winding of most of them; an equal number
    of both windings takes the winding of the faces around. If the surface is closed without them, they are a wall between two parts that
    touch, which counts for both parts. A collinear face counts if it closes a joint; it is flipped."""
    used = finite_faces(geometry)
    corners = merged(geometry.vertices)[geometry.faces[used]]
    solid = windings(corners) != 0
    used, corners = used[solid], corners[solid]
    first, kind = copies(corners)
    flat, count = ~has_area(geometry.vertices, corners[first]), np.bincount(kind)
    if len(first) == len(used) and not flat.any():
        return None
    distinct = np.sort(corners[first], axis=1)
    free = flat | (count > max(np.gcd.reduce(count[~flat]), 1))  # if the whole mesh is there several times, each face is there once
    single = _counted(edges_of(distinct), free, flat)
    sign = windings(corners)
    total = np.bincount(kind, sign)
    wall = ~single & ~flat & (np.abs(total) == count) & (count % 2 == 0)  # a wall with both windings adds nothing
    turn = np.where(total == 0, sign[first], np.sign(total))
    if len(unsure := np.flatnonzero(single & ~flat & (total == 0))):
        a, b, c = ((geometry.vertices[distinct[:, i]] - geometry.vertices[distinct[0, 0]]).astype(np.float64) for i in range(3))
        volume = np.einsum("ij,ij->i", a, np.cross(b, c))
        turn[unsure] = _turned(edges_of(distinct), single, np.where(flat | (total == 0), 0, turn), volume, turn)[unsure]
    kept = np.flatnonzero(np.where(single[kind], first[kind] == np.arange(len(kind)), wall[kind]))
    faces, wrong = corners[kept], single[kind[kept]] & (sign[kept] != turn[kind[kept]])
    faces[wrong] = faces[wrong][:, ::-1]
    return flip_collinear(geometry.vertices, faces.astype(np.int32))[0], used[kept]


def _counted(edges: np.ndarray, free: np.ndarray, flat: np.ndarray) -> np.ndarray:
    """Return which faces count, (N,) bool: all that are not free, and free ones that close the surface. edges: (N, 3), of `edges_of`.

    Two free faces at an edge that is closed without them form a patch. A patch whose border is open without it counts; a wall does not.
    The last patches are those without a border: copies count, collinear faces do not."""
    counted, free, none, n = ~free, free.copy(), np.zeros(len(free), bool), edges.max(initial=-1) + 1
    lonely = (np.bincount(edges.reshape(-1), minlength=n) == 1)[edges]
    while free.any():
        odd, free_at = np.bincount(edges[counted].reshape(-1), minlength=n) % 2 == 1, np.bincount(edges[free].reshape(-1), minlength=n)
        x, y = _neighbours(edges, (free_at == 2) & ~odd, free)
        label = _connected(len(edges), x // 3, y // 3)
        border = free[:, None] & (free_at == 1)[edges]
        wall, gap, end = ((np.bincount(label, which.any(axis=1), len(label)) > 0)[label] & free
                          for which in (border & ~lonely & ~odd[edges], border & odd[edges], border & lonely))
        rules = (wall | gap, gap & ~wall), (end, none), (free & ~flat, free), (free, none)
        done, yes = next(rule for rule in rules if rule[0].any())
        counted |= done & yes
        free &= ~done
    return counted


def _turned(edges: np.ndarray, single: np.ndarray, known: np.ndarray, volume: np.ndarray, default: np.ndarray) -> np.ndarray:
    """Return the winding of each face that fits to known ones, else the one around a positive volume, else the default, (N,) of 1 and -1.

    edges: (N, 3), of faces whose corners ascend. single: faces that count once. known: windings, or 0. volume: of each face, times 6."""
    x, y = _neighbours(edges, np.bincount(edges[single].reshape(-1), minlength=edges.max() + 1) == 2, single)
    turns = np.array([0, 0, 1])  # an edge from corner 2 to 0 descends
    same = turns[x % 3] == turns[y % 3]
    nodes = 2 * np.arange(len(edges))  # 2 i: face i with winding 1, 2 i + 1: with winding -1
    label = _connected(2 * len(edges), np.append(nodes[x // 3], nodes[x // 3] + 1), np.append(nodes[y // 3] + same, nodes[y // 3] + ~same))
    votes = []
    for weight in (known, volume):
        sums = np.bincount(label, np.stack([weight, -weight], axis=1).reshape(-1) * np.repeat(single, 2), len(label))[label]
        votes.append(np.sign(sums[::2] - sums[1::2]))
    return np.where(votes[0] != 0, votes[0], np.where(votes[1] != 0, votes[1], default))


def _neighbours(edges: np.ndarray, of_two: np.ndarray, used: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return both sides of each edge in `of_two`, as 3 times the face plus the side, (M,) each. used: faces."""
    chosen = np.zeros(edges.shape, bool)
    chosen[used] = of_two[edges[used]]
    sides = np.flatnonzero(chosen)
    x, y = sides[np.argsort(edges.reshape(-1)[sides], kind="stable")].reshape(-1, 2).T
    return x, y


def _connected(n: int, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the smallest index in the component of each of n nodes, (n,); nodes a[i] and b[i] are connected."""
    label = np.arange(n)
    while (label[a] != label[b]).any():
        low = np.minimum(label[a], label[b])
        for side in (a, b):
            np.minimum.at(label, label[side], low)
        while (label[label] != label).any():
            label = label[label]
    return label
