"""`python -m wrt bench closed`: what is inside of closed meshes, and rays through their corners and edges; others beside it."""

from __future__ import annotations

import importlib
import importlib.util
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from time import perf_counter
from typing import Any

import numpy as np

from wrt.accel.base import Accelerator
from wrt.accel.geometry import Geometry
from wrt.accel.queries.all_hits import AllHits, all_hits, count_hits
from wrt.accel.queries.contains import contains, open_edges
from wrt.accel.scenes.build import build
from wrt.core.errors import InputError
from wrt.io.mesh_file import as_mesh
from wrt.lab.bench.report import Columns, Part, Row, mesh_name, tabled
from wrt.lab.hard_cases.common import targets, unit_vectors
from wrt.lab.oracle.oracle import Place, Reference
from wrt.lab.plans import Closed as Plan
from wrt.scene.mesh import Mesh
from wrt.scene.shapes import box, icosphere, lathe, merged, teapot, torus, tube

CHUNK = 1 << 18
AT_EDGE = 2.0**-23  # by which float32 may have a weight beside 0
# Along which points are aimed at corners: the first direction of wrt.contains, trimesh's and Open3D's only one, and an axis.
AIMS = np.array([np.random.default_rng(0).normal(size=3), [0.4395064455, 0.617598629942, 0.652231566745], [1.0, 1.0, 1.0], [0.0, 0.0, 1.0]])
TITLE = "Closed meshes: points inside, and crossings"
COLUMNS: Columns = {"what": "{what}", "mesh": "{mesh}", "triangles": "{triangles}", "who": "{who}", "asked": "{asked}",
                    "wrong": "{wrong}", "touching": "{touching}", "us each": "{microseconds:.2f}"}
LEGEND = """\
inside: points in the mesh's box, a third of them beside a corner by one of the directions in which wrt, trimesh and Open3D ask;
wrong: otherwise than exact arithmetic on rays that meet no edge; touching: of those, points within 1e-6 of the mesh's size of it.
crossings: rays from outside at corners and at edges, through the mesh; wrong: an odd number. wrt: count_hits with crossings. Rays
that touch an outline (touching) are not held against the others, who may see it once. us each: microseconds a point, or a crossing.
"""


def rows(plan: Plan) -> Iterator[Row]:
    for mesh in [*made(), *map(as_mesh, plan.meshes)]:
        geometry = Geometry.of(mesh)
        if open_edges(geometry):
            raise InputError("the mesh is not closed", mesh.name)
        reference, accel = Reference(geometry), build(geometry)
        known = {"mesh": mesh_name(mesh), "triangles": len(geometry.faces)}
        for who, n in asked(plan, plan.points):
            answer = partial(contains, accel) if who == "wrt" else OTHERS[who][1](geometry)[0]
            answer(np.zeros((2, 3), np.float32))
            yield Row(what="inside", who=who, **known, **points_wrong(geometry, reference, answer, n, plan.seed))
        for who, n in asked(plan, plan.rays):
            count = None if who == "wrt" else OTHERS[who][1](geometry)[1]
            (count or own_crossings(accel))(np.full((2, 3), 9.0, np.float32), np.ones((2, 3), np.float32))
            yield Row(what="crossings", who=who, **known, **crossed(geometry, accel, count, n, plan.seed))


def made() -> list[Mesh]:
    """A box, a ball, a torus, a knot, a solid of revolution, a teapot, a ball with a hollow in it."""
    a = np.linspace(0.0, 2.0 * np.pi, 120)
    knot = np.stack([np.sin(a) + 2.0 * np.sin(2.0 * a), np.cos(a) - 2.0 * np.cos(2.0 * a), -np.sin(3.0 * a)], axis=1)
    parts = {"box": box(), "ball": icosphere(5), "torus": torus(), "knot": tube(knot, 0.3, 16),
             "lathe": lathe([(0.0, -1.0), (0.5, -1.0), (0.3, 0.0), (0.8, 1.0), (0.0, 1.0)], 32), "teapot": teapot(24),
             "hollow": merged([icosphere(4), icosphere(4, 0.5)], "")}
    return [Mesh(mesh.vertices, mesh.faces, name=name) for name, mesh in parts.items()]


def asked(plan: Plan, n: int) -> Iterator[tuple[str, int]]:
    """Who, and how many: the others fewer."""
    yield "wrt", n
    for name, (package, _) in OTHERS.items():
        most = plan.others // (100 if name == "trimesh" else 1)
        if most and importlib.util.find_spec(package) is not None:
            yield name, min(n, most)


def points_wrong(geometry: Geometry, reference: Reference, answer: Callable[[np.ndarray], np.ndarray], n: int, seed: int) -> dict[str, Any]:
    rng, wrong, touching, seconds = np.random.default_rng(seed), 0, 0, 0.0
    for first in range(0, n, CHUNK):
        points = points_in(geometry, rng, min(CHUNK, n - first))
        begin = perf_counter()
        inside = answer(points)
        seconds += perf_counter() - begin
        exactly, on_surface = exactly_inside(reference, points, rng)
        differ = np.flatnonzero((inside != exactly) & ~on_surface)
        wrong += len(differ)
        touching += int((distances(geometry, points[differ]) < 1e-6 * np.ptp(geometry.vertices, axis=0).max()).sum())
    return {"asked": n, "wrong": wrong, "touching": touching, "microseconds": 1e6 * seconds / n}


def points_in(geometry: Geometry, rng: np.random.Generator, n: int) -> np.ndarray:
    """(n, 3) float32 in the mesh's box; of every third, a ray along one of AIMS meets a corner."""
    low, high = geometry.vertices.min(axis=0).astype(np.float64), geometry.vertices.max(axis=0)
    points = rng.uniform(low, high, (n, 3))
    aimed = np.arange(0, n, 3)
    corner = geometry.vertices[geometry.faces[rng.integers(len(geometry.faces), size=len(aimed)), 0]].astype(np.float64)
    along = AIMS[rng.integers(len(AIMS), size=len(aimed))]
    points[aimed] = corner - along * (rng.random((len(aimed), 1)) * 0.5 * (high - low).max())
    return points.astype(np.float32)


def exactly_inside(reference: Reference, points: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """(N,) bool: whether a ray crosses an odd number of triangles by exact arithmetic; those that meet an edge are sent again
    elsewhere. And (N,) bool: whether the point is exactly on the surface, where either is right."""
    inside, on_surface = np.zeros((2, len(points)), bool)
    left = np.arange(len(points))
    while len(left):
        directions = unit_vectors(rng, len(left)).astype(np.float32)
        hits = reference.all_hits(points[left], directions)
        again = np.zeros(len(left), bool)
        again[hits.ray[hits.place != Place.INSIDE]] = True
        inside[left] = np.bincount(hits.ray, minlength=len(left)) % 2 == 1
        on_surface[left[hits.ray[hits.t == 0.0]]] = True
        left = left[again & ~on_surface[left]]
    return inside, on_surface


def distances(geometry: Geometry, points: np.ndarray) -> np.ndarray:
    """(N,) to the nearest triangle, one point after another."""
    from trimesh.triangles import closest_point

    corners = geometry.vertices[geometry.faces].astype(np.float64)
    return np.array([np.linalg.norm(closest_point(corners, np.tile(point, (len(corners), 1))) - point, axis=1).min()
                     for point in points.astype(np.float64)])


def crossed(geometry: Geometry, accel: Accelerator, count: Callable[..., Any] | None, n: int, seed: int) -> dict[str, Any]:
    """All rays begin and end outside. count: how many hits another library has for each; None: wrt's crossings. Rays that touch an
    outline are counted, and not held against others, who may see it once."""
    rng, wrong, touching, hits, seconds = np.random.default_rng(seed), 0, 0, 0, 0.0
    low, high = (bound.astype(np.float64) for bound in (geometry.vertices.min(axis=0), geometry.vertices.max(axis=0)))
    for first in range(0, n, CHUNK):
        size = min(CHUNK, n - first)
        origins = (0.5 * (low + high) + 1.5 * np.linalg.norm(high - low) * unit_vectors(rng, size)).astype(np.float32)
        at = np.where(np.arange(size)[:, None] % 2 == 0, *(targets(geometry, rng, size, aim) for aim in ("vertices", "edges")))
        directions = (at - origins).astype(np.float32)
        begin = perf_counter()
        crossings = np.asarray((count or own_crossings(accel))(origins, directions))
        seconds, hits = seconds + perf_counter() - begin, hits + int(crossings.sum())
        touches = crossings_of(geometry, all_hits(accel, origins, directions), directions)[1] > 0
        touching += int(touches.sum())
        wrong += int((crossings % 2 == 1)[~touches | (count is None)].sum())
    return {"asked": n, "wrong": wrong, "touching": touching, "hits": hits, "microseconds": 1e6 * seconds / max(hits, 1)}


def own_crossings(accel: Accelerator) -> Callable[..., Any]:
    return partial(count_hits, accel, crossings=True)


def crossings_of(geometry: Geometry, found: AllHits, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(N,) how often each ray crosses the surface, and how often it touches it. Faces that it meets at the same edge or corner are
    a crossing where their signed angles around it make a whole turn. It meets an edge where two of its faces have it there: of one
    weight, 1 - u - v, rounding hides whether it is 0."""
    corners = geometry.vertices[geometry.faces[found.prim_id]].astype(np.float64)
    d, ray = directions[found.ray_id].astype(np.float64), found.ray_id
    side = np.sign((np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]) * d).sum(axis=1))
    zero = np.stack([1.0 - found.u.astype(np.float64) - found.v, found.u, found.v], axis=1) <= np.array([AT_EDGE, 0.0, 0.0])
    place = np.unique(geometry.vertices + np.float32(0.0), axis=0, return_inverse=True)[1].reshape(-1)
    faces = place[geometry.faces[found.prim_id]]
    row, k = np.nonzero(zero)
    ends = np.sort(np.stack([faces[row, (k + 1) % 3], faces[row, (k + 2) % 3]]), axis=0)
    _, edge, count = np.unique(np.stack([ray[row], *ends]), axis=1, return_inverse=True, return_counts=True)
    zero[row, k] = count[edge.reshape(-1)] > 1

    rows = np.flatnonzero(zero.any(axis=1))
    crossings = np.bincount(ray[~zero.any(axis=1)], minlength=len(found))
    at_corner, row = zero[rows].sum(axis=1) > 1, np.arange(len(rows))
    k = np.where(at_corner, np.argmin(zero[rows], axis=1), np.argmax(zero[rows], axis=1))
    a, b, c = (faces[rows][row, (k + i) % 3] for i in range(3))
    key = np.stack([ray[rows], np.where(at_corner, a, np.minimum(b, c)), np.where(at_corner, a, np.maximum(b, c))], axis=1)
    group, number = np.unique(key, axis=0, return_inverse=True)
    part = np.where(at_corner, _angles(corners[rows], d[rows], k), np.pi) / (2.0 * np.pi)
    turns = np.bincount(number.reshape(-1), part * side[rows], minlength=len(group))
    crossed = np.abs(np.round(turns)).astype(np.int64)
    np.add.at(crossings, group[:, 0], crossed)
    return crossings, np.bincount(group[crossed == 0, 0], minlength=len(found))


def _angles(corners: np.ndarray, d: np.ndarray, k: np.ndarray) -> np.ndarray:
    """(M,) angle at corner k of each triangle, as the ray sees it."""
    row = np.arange(len(k))
    d = d / np.linalg.norm(d, axis=1, keepdims=True)
    sides = [corners[row, (k + i) % 3] - corners[row, k] for i in (1, 2)]
    e, f = (side - (side * d).sum(axis=1, keepdims=True) * d for side in sides)
    return np.arctan2(np.linalg.norm(np.cross(e, f), axis=1), (e * f).sum(axis=1))


def open3d_answers(geometry: Geometry) -> tuple[Callable[..., Any], Callable[..., Any]]:
    """Which points are inside, and how many hits rays have; as trimesh_answers."""
    import open3d

    tensor = open3d.core.Tensor.from_numpy
    scene = open3d.t.geometry.RaycastingScene()
    scene.add_triangles(tensor(geometry.vertices.copy()), tensor(geometry.faces.astype(np.uint32)))
    return (lambda points: scene.compute_occupancy(tensor(points)).numpy() > 0.5,
            lambda origins, directions: scene.count_intersections(tensor(np.concatenate([origins, directions], axis=1))).numpy())


def trimesh_answers(module: str, geometry: Geometry) -> tuple[Callable[..., Any], Callable[..., Any]]:
    import trimesh

    mesh = trimesh.Trimesh(geometry.vertices, geometry.faces, process=False)
    rays = importlib.import_module(f"trimesh.ray.{module}").RayMeshIntersector(mesh)
    return rays.contains_points, lambda origins, directions: np.bincount(rays.intersects_id(origins, directions)[1], minlength=len(origins))


# By name: the package that it needs, and its answers for a geometry.
OTHERS: dict[str, tuple[str, Callable[[Geometry], tuple[Callable[..., Any], Callable[..., Any]]]]] = {
    "Open3D": ("open3d", open3d_answers), "trimesh, Embree": ("embreex", partial(trimesh_answers, "ray_pyembree")),
    "trimesh": ("rtree", partial(trimesh_answers, "ray_triangle"))}


def parts(rows: Sequence[Row], plan: Plan) -> list[Part]:
    total = []
    for what, who in dict.fromkeys((row.what, row.who) for row in rows):
        mine = [row for row in rows if (row.what, row.who) == (what, who)]
        counts = {name: sum(getattr(row, name) for row in mine) for name in ("asked", "wrong", "touching")}
        found = [row.hits if what == "crossings" else row.asked for row in mine]  # what the seconds are divided by
        each = sum(row.microseconds * n for row, n in zip(mine, found, strict=True)) / max(sum(found), 1)
        total.append(Row(what=what, mesh="all", triangles="", who=who, **counts, microseconds=each))
    return [tabled(COLUMNS, total, "All meshes"), tabled(COLUMNS, rows, "By mesh")]
