"""Meshes made by formulas. The faces of closed shapes are counter-clockwise seen from outside.

`SHAPES` names the shapes of scene files. Every function raises InputError for an argument that is out of range."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np

from wrt.core.checks import as_integer
from wrt.core.errors import InputError
from wrt.scene.clean import clean
from wrt.scene.mesh import Mesh
from wrt.scene.values import as_number, as_vector

Point = Sequence[float] | np.ndarray
MAX_FACES = 1 << 23  # triangles of one shape: a short scene file must not fill the memory or take minutes


def quad(corner: Point = (-0.5, -0.5, 0.0), edge_u: Point = (1.0, 0.0, 0.0), edge_v: Point = (0.0, 1.0, 0.0)) -> Mesh:
    """Return a parallelogram of two triangles whose front is towards cross(edge_u, edge_v).

    On the front, with edge_u to the right and edge_v up, an image is upright: uv is (0, 1) at `corner` and (0, 0) at the end of edge_v."""
    origin, u, v = (np.array(as_vector(value, "quad: " + name))
                    for value, name in ((corner, "corner"), (edge_u, "edge_u"), (edge_v, "edge_v")))
    if not np.linalg.norm(np.cross(u, v)) > 0.0:
        raise InputError(f"edge_u and edge_v must span an area, got {u.tolist()} and {v.tolist()}", argument="edge_u", place="quad")
    return Mesh(np.array([origin, origin + u, origin + u + v, origin + v]), np.array([[0, 1, 2], [0, 2, 3]]),
                uvs=np.array([[0, 1], [1, 1], [1, 0], [0, 0]]), name="quad")


def box(low: Point = (-0.5, -0.5, -0.5), high: Point = (0.5, 0.5, 0.5)) -> Mesh:
    """Return a closed box with opposite corners `low` and `high`, flat-shaded; each side has uvs from 0 to 1."""
    bottom, top = np.array(as_vector(low, "box: low")), np.array(as_vector(high, "box: high"))
    if not (top > bottom).all():
        raise InputError(f"must be above low ({bottom.tolist()}) in every axis, got {top.tolist()}", argument="high", place="box")
    return Mesh(np.where(_BOX_TOP, top, bottom), _BOX_FACES, uvs=_BOX_UVS, name="box")


# True where a corner (24 rows) is at `high` in an axis (3 columns). The low and the high side across x come first, then those across y
# and z. Each has four corners in the order of a quad, reversed on the low side so that it faces out.
_BOX_SIDES = np.array([[[0, 1, 0], [0, 0, 0], [0, 0, 1], [0, 1, 1]], [[1, 0, 0], [1, 1, 0], [1, 1, 1], [1, 0, 1]]], dtype=bool)
_BOX_TOP = np.concatenate([np.roll(_BOX_SIDES, axis, axis=2) for axis in range(3)]).reshape(24, 3)
_BOX_FACES = (np.array([[0, 1, 2], [0, 2, 3]]) + 4 * np.arange(6)[:, None, None]).reshape(12, 3).astype(np.int32)
_BOX_UVS = np.tile(np.array([[0, 1], [1, 1], [1, 0], [0, 0]], np.float32), (6, 1))
_BOX_FACES.flags.writeable = _BOX_UVS.flags.writeable = False  # all boxes share them


def icosphere(subdivisions: int = 3, radius: float = 1.0) -> Mesh:
    """Return a sphere of 20 * 4^subdivisions nearly equal triangles around the origin, with exact normals and no uvs."""
    subdivisions = as_integer(subdivisions, "icosphere: subdivisions", 0, 9)
    radius = as_number(radius, "icosphere: radius", low=1e-30)
    golden = 0.5 + math.sqrt(1.25)
    corner = np.array([[a, b * golden, 0.0] for a in (-1.0, 1.0) for b in (-1.0, 1.0)])
    points = np.concatenate([np.roll(corner, turn, axis=1) for turn in range(3)])
    # The faces are the triples of corners at the distance 2 from each other.
    near = np.isclose(np.linalg.norm(points[:, None] - points[None], axis=2), 2.0)
    faces = np.array([(i, j, k) for i in range(12) for j in range(i) for k in range(j) if near[i, j] and near[j, k] and near[k, i]])
    turned = np.linalg.det(points[faces]) < 0.0
    faces[turned] = faces[turned][:, ::-1]
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    for _ in range(subdivisions):
        edges = np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]], axis=2)
        ends, middle = np.unique(edges.reshape(-1, 2), axis=0, return_inverse=True)
        middle = middle.reshape(-1, 3) + len(points)
        points = np.concatenate([points, points[ends].sum(axis=1)])
        points /= np.linalg.norm(points, axis=1, keepdims=True)
        (a, b, c), (ab, bc, ca) = faces.T, middle.T
        faces = np.stack([a, ab, ca, ab, b, bc, ca, bc, c, ab, bc, ca], axis=1).reshape(-1, 3)
    return Mesh(points * radius, faces, normals=points, name="icosphere")


def torus(radius: float = 1.0, tube_radius: float = 0.35, segments: int = 64, tube_segments: int = 32) -> Mesh:
    """Return a torus around the y axis. u runs around the axis, v around the tube."""
    radius = as_number(radius, "torus: radius", low=1e-30)
    tube_radius = as_number(tube_radius, "torus: tube_radius", low=1e-30, high=radius)
    _require_segments("torus", segments, tube_segments)
    around = np.linspace(0.0, 2.0 * np.pi, segments + 1)
    along = np.linspace(0.0, 2.0 * np.pi, tube_segments + 1)
    a, b = np.meshgrid(around, along, indexing="ij")
    normals = np.stack([np.cos(b) * np.sin(a), np.sin(b), np.cos(b) * np.cos(a)], axis=-1)
    middle = radius * np.stack([np.sin(a), np.zeros_like(a), np.cos(a)], axis=-1)
    points = middle + tube_radius * normals
    points[-1], points[:, -1] = points[0], points[:, 0]  # closed to the last bit
    return _grid(points, normals, "torus")


def lathe(profile: Sequence[Point], segments: int = 64) -> Mesh:
    """Return a surface of revolution of a profile around the y axis.

    profile: two or more points (radius, height). If it runs upwards, the surface faces outwards. It is closed if both ends are on the
    axis. A repeated point makes a sharp edge; other points are smooth. u runs around the axis, v from the end of the profile to its start.
    """
    # In float32 like the vertices: points that are equal in float32 count as repeated.
    line = np.asarray(profile, dtype=np.float32).astype(np.float64)
    well_formed = line.ndim == 2 and line.shape[1:] == (2,) and len(line) >= 2
    if not well_formed or not np.isfinite(line).all() or (line[:, 0] < 0.0).any():
        raise InputError("must be two or more pairs (radius >= 0, height)", argument="profile", place="lathe")
    _require_segments("lathe", segments, rows=len(line) - 1)
    step = np.diff(line, axis=0)
    length = np.linalg.norm(step, axis=1)
    if not length.any():
        raise InputError("must hold two different points", argument="profile", place="lathe")
    # The normal of a step is its direction turned right; a point has the mean of its two steps, unless it is repeated.
    side = np.stack([step[:, 1], -step[:, 0]], axis=1) / np.where(length > 0.0, length, 1.0)[:, None]
    normal = np.concatenate([side, side[-1:]]) + np.concatenate([side[:1], side])
    # On the axis, the normal of a smooth surface is parallel to the axis.
    on_axis = (line[:, 0] == 0.0) & (np.abs(normal[:, 1]) > 1e-6 * np.abs(normal[:, 0]))
    normal[on_axis, 0] = np.where(np.arange(len(line)) % (len(line) - 1) == 0, 0.0, normal[:, 0])[on_axis]
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-300)

    angle = np.linspace(0.0, 2.0 * np.pi, segments + 1)
    sine, cosine = np.sin(angle), np.cos(angle)
    sine[-1], cosine[-1] = 0.0, 1.0
    turn = np.stack([sine, np.zeros_like(sine), cosine], axis=1)[:, None]
    up = np.array([0.0, 1.0, 0.0])
    points = turn * line[None, :, :1] + up * line[None, :, 1:]
    normals = turn * normal[None, :, :1] + up * normal[None, :, 1:]
    return _grid(points, normals, "lathe")


def prism(sides: int = 3, radius: float = 1.0, length: float = 2.0) -> Mesh:
    """Return a closed, flat-shaded prism along z, without uvs. Its base is a regular polygon in a circle of `radius`, one corner at +y."""
    sides = as_integer(sides, "prism: sides", 3, 4096)
    radius, length = as_number(radius, "prism: radius", low=1e-30), as_number(length, "prism: length", low=1e-30)
    angle = np.pi / 2.0 + np.arange(sides) * (2.0 * np.pi / sides)
    ring = radius * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    points = np.concatenate([np.column_stack([ring, np.full(sides, z)]) for z in (-0.5 * length, 0.5 * length)])
    i = np.arange(sides)
    j = (i + 1) % sides
    walls = np.concatenate([np.stack([i, j, j + sides], axis=1), np.stack([i, j + sides, i + sides], axis=1)])
    fan = np.arange(1, sides - 1)
    back = np.stack([np.zeros_like(fan), fan + 1, fan], axis=1)
    return Mesh(points, np.concatenate([walls, back, back[:, ::-1] + sides]), name="prism")


def tube(points: Sequence[Point] | np.ndarray, radius: float | Point = 0.1, segments: int = 24) -> Mesh:
    """Return a round tube along a polyline, with flat ends; `radius` is one number, or one for each point.

    Its rings turn as little as possible from point to point (parallel transport). u runs around the tube, v along it."""
    line = np.asarray(points, dtype=np.float64)
    if line.ndim != 2 or line.shape[1:] != (3,) or len(line) < 2 or not np.isfinite(line).all():
        raise InputError("must be two or more finite points (x, y, z)", argument="points", place="tube")
    _require_segments("tube", segments, rows=len(line) - 1)
    try:
        radii = np.broadcast_to(np.asarray(radius, dtype=np.float64), (len(line),))
    except ValueError:
        raise InputError(f"must be one number or {len(line)}, one for each point", argument="radius", place="tube") from None
    if not (radii > 0.0).all() or not np.isfinite(radii).all():
        raise InputError("must be above 0 at every point", argument="radius", place="tube")
    step = np.diff(line, axis=0)
    length = np.linalg.norm(step, axis=1, keepdims=True)
    if not (length > 0.0).all():
        raise InputError("must not hold the same point twice in a row", argument="points", place="tube")
    step /= length
    tangent = np.concatenate([step[:1], step[1:] + step[:-1], step[-1:]])
    tangent /= np.maximum(np.linalg.norm(tangent, axis=1, keepdims=True), 1e-300)
    x = np.empty_like(line)
    x[0] = np.cross(tangent[0], np.eye(3)[np.argmin(np.abs(tangent[0]))])
    for i in range(1, len(line)):
        x[i] = x[i - 1] - tangent[i] * (x[i - 1] @ tangent[i])
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    y = np.cross(tangent, x)

    angle = np.linspace(0.0, 2.0 * np.pi, segments + 1)[:, None, None]
    normals = np.cos(angle) * x + np.sin(angle) * y
    normals[-1] = normals[0]
    wall = line + radii[:, None] * normals
    parts = [_grid(wall, normals, "tube")]
    for end, outward in ((0, -1.0), (-1, 1.0)):
        rim = wall[:-1, end]
        fan = np.arange(1, segments - 1)
        faces = np.stack([np.zeros_like(fan), fan, fan + 1], axis=1)[:, ::int(outward)]
        flat = np.tile(outward * tangent[end], (segments, 1))
        parts.append(Mesh(np.asarray(rim, np.float32), faces, normals=flat, uvs=np.zeros((segments, 2))))
    return merged(parts, "tube")


def teapot(segments: int = 64) -> Mesh:
    """Return a pot with lid, spout and handle, about 2 units wide and 1 high, on y = 0. Its parts are closed meshes that overlap.

    The outlines are this project's own: body and lid are lathes, spout and handle are tubes."""
    _require_segments("teapot", segments)
    rows = max(segments // 2, 8)
    t = np.linspace(0.0, 1.0, rows)
    side = np.stack([0.42 + 0.24 * np.sin(np.pi * (0.15 + 0.8 * t)) ** 1.5, 0.04 + 0.66 * t], axis=1)
    foot = [(0.0, 0.0), (0.40, 0.0), (0.40, 0.0), (0.40, 0.03)]
    rim = [(side[-1, 0], 0.70), (side[-1, 0], 0.73), (side[-1, 0], 0.73), (0.0, 0.73)]
    dome = [(0.40 * math.cos(a), 0.735 + 0.13 * math.sin(a)) for a in np.linspace(0.0, 0.92 * math.pi / 2.0, rows // 2)]
    knob = [(0.03 + 0.06 * math.sin(a), 0.93 - 0.07 * math.cos(a)) for a in np.linspace(0.15, math.pi, rows // 2)]
    lid = [(0.0, 0.735), (0.40, 0.735), *dome, dome[-1], knob[0], *knob, (0.0, knob[-1][1])]
    a = np.linspace(-1.92, 2.15, rows)  # both ends are inside the body
    handle = np.stack([-0.60 - 0.34 * np.cos(a), 0.42 + 0.25 * np.sin(a), 0.0 * a], axis=1)
    s = np.linspace(0.0, 1.0, rows)
    spout = np.stack([0.50 + 0.46 * s + 0.10 * s * (1.0 - s), 0.20 + 0.18 * s + 0.36 * s**2.5, 0.0 * s], axis=1)
    return merged([lathe([*foot, *side.tolist(), *rim], segments), lathe(lid, segments),
                   tube(handle, 0.045, rows), tube(spout, 0.14 - 0.09 * s**0.7, rows)], "teapot")


def merged(parts: Sequence[Mesh], name: str) -> Mesh:
    """Return the parts as one mesh. It has normals if all parts have normals, and uvs if all parts have uvs."""
    start = np.cumsum([0, *(len(part.vertices) for part in parts)])
    normals = [part.normals for part in parts if part.normals is not None]
    uvs = [part.uvs for part in parts if part.uvs is not None]
    return Mesh(
        np.concatenate([part.vertices if part.origin is None else part.positions for part in parts]),
        np.concatenate([part.faces + offset for part, offset in zip(parts, start, strict=False)]),
        normals=np.concatenate(normals) if len(normals) == len(parts) else None,
        uvs=np.concatenate(uvs) if len(uvs) == len(parts) else None,
        name=name,
    )


def _grid(points: np.ndarray, normals: np.ndarray, name: str) -> Mesh:
    """Return the mesh of a grid of points (M, N, 3), without triangles of zero area. u grows along axis 0, v falls along axis 1."""
    m, n = points.shape[:2]
    u, v = np.meshgrid(np.linspace(0.0, 1.0, m), np.linspace(1.0, 0.0, n), indexing="ij")
    i, j = np.meshgrid(np.arange(m - 1), np.arange(n - 1), indexing="ij")
    corner = (i * n + j).reshape(-1)
    faces = np.stack([corner, corner + n, corner + n + 1, corner, corner + n + 1, corner + 1], axis=1).reshape(-1, 3)
    result = clean(points.reshape(-1, 3), faces, normals.reshape(-1, 3), np.stack([u, v], axis=-1).reshape(-1, 2))
    return Mesh(result.vertices, result.faces, normals=result.normals, uvs=result.uvs, name=name)


def _require_segments(shape: str, *segments: int, rows: int = 1) -> None:
    """Raise InputError if a number of segments is out of range, or a grid of `rows` times all segments exceeds MAX_FACES triangles."""
    for count in segments:
        as_integer(count, f"{shape}: segments", 3, 4096)
    if (faces := 2 * rows * math.prod(segments)) > MAX_FACES:
        raise InputError(f"must make at most {MAX_FACES} triangles, got {faces}", argument="segments", place=shape)


SHAPES: dict[str, Callable[..., Mesh]] = {
    "icosphere": icosphere, "torus": torus, "lathe": lathe, "prism": prism, "tube": tube, "teapot": teapot,
}
