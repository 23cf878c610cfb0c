"""`python -m wrt bench closed`: points inside closed meshes, and rays through corners and edges, by wrt and other libraries."""

import importlib.util
from collections.abc import Callable, Iterator, Sequence
from functools import partial

import numpy as np

from wrt.accel.base import Accelerator
from wrt.accel.geometry import Geometry
from wrt.accel.points.contains import contains, open_edges
from wrt.accel.queries.all_hits import AllHits, all_hits, count_hits
from wrt.accel.scenes.build import build
from wrt.core.errors import InputError
from wrt.io.mesh_file import as_mesh
from wrt.lab.bench.report import Columns, Groups, Part, Row, mesh_name, tabled
from wrt.lab.bench.timing import with_seconds
from wrt.lab.hard_cases import Closed as Plan
from wrt.lab.hard_cases.common import targets, unit_vectors
from wrt.lab.oracle.oracle import Place, Reference, reference_of
from wrt.scene.mesh import Mesh
from wrt.scene.shapes import box, icosphere, lathe, merged, teapot, torus, tube

Answer = Callable[..., np.ndarray]  # Points -> flags of the points inside; or origins, directions -> number of hits of each ray.
CHUNK = 1 << 18  # Points or rays at once.
AT_EDGE = 2.0**-23  # Largest 1 - u - v that float32 rounding may leave on an edge.
# Directions of the rays by which wrt.contains (its first ray), trimesh and Open3D find points inside, and the z axis.
AIMS = np.array([np.random.default_rng(0).normal(size=3), [0.4395064455, 0.617598629942, 0.652231566745], [1.0, 1.0, 1.0],
                 [0.0, 0.0, 1.0]])
TITLE = "Closed meshes: points inside, and crossings"
COLUMNS: Columns = {"test": "{what}", "mesh": "{mesh}", "triangles": "{triangles}", "library": "{who}", "queries": "{asked}",
                    "wrong": "{wrong}", "touching": "{touching}", "us/answer": "{microseconds:.2f}"}
LEGEND = """\
inside: is a point inside? Points lie in the mesh's box. For a third of them, the library's own ray from the point goes through a corner.
wrong: the answer is not that of exact arithmetic. touching: wrong points closer to the surface than 1e-6 of the mesh's size.
crossings: how often does a ray cross the surface? Rays start outside, aim at corners and edges, and leave the mesh. wrong: the number is
odd. touching: rays that touch an outline; other libraries may report one hit there, and it does not count as wrong. wrt answers by
count_hits with crossings. us/answer: microseconds a point or a crossing.
"""


def groups(plan: Plan) -> Groups:
    for mesh in [*made(), *map(as_mesh, plan.meshes)]:
        if open_edges(Geometry.of(mesh)):
            raise InputError("the mesh is not closed: each edge needs two faces of opposite directions", place=mesh.name)
        for measure, n in ((inside_rows, plan.points), (crossing_rows, plan.rays)):
            for who, most in asked(plan, n):
                yield partial(measure, mesh, who, most, plan.seed)


def inside_rows(mesh: Mesh, who: str, n: int, seed: int) -> list[Row]:
    geometry = Geometry.of(mesh)
    answer = partial(contains, build(geometry)) if who == "wrt" else OTHERS[who][1](geometry)[0]
    answer(np.zeros((2, 3), np.float32))
    return [Row(what="inside", who=who, mesh=mesh_name(mesh), triangles=len(geometry.faces),
                **points_wrong(geometry, reference_of(mesh), answer, n, seed))]


def crossing_rows(mesh: Mesh, who: str, n: int, seed: int) -> list[Row]:
    geometry = Geometry.of(mesh)
    accel = build(geometry)
    count = partial(count_hits, accel, crossings=True) if who == "wrt" else OTHERS[who][1](geometry)[1]
    count(np.full((2, 3), 9.0, np.float32), np.ones((2, 3), np.float32))
    return [Row(what="crossings", who=who, mesh=mesh_name(mesh), triangles=len(geometry.faces),
                **crossed(geometry, accel, count, who == "wrt", n, seed))]


def made() -> list[Mesh]:
    """Return seven closed meshes: box, ball, torus, knot, solid of revolution, teapot, and a ball with a hollow."""
    a = np.linspace(0.0, 2.0 * np.pi, 120)
    knot = np.stack([np.sin(a) + 2.0 * np.sin(2.0 * a), np.cos(a) - 2.0 * np.cos(2.0 * a), -np.sin(3.0 * a)], axis=1)
    parts = {"box": box(), "ball": icosphere(5), "torus": torus(), "knot": tube(knot, 0.3, 16),
             "lathe": lathe([(0.0, -1.0), (0.5, -1.0), (0.3, 0.0), (0.8, 1.0), (0.0, 1.0)], 32), "teapot": teapot(24),
             "hollow": merged([icosphere(4), icosphere(4, 0.5)], "")}
    return [Mesh(mesh.vertices, mesh.faces, name=name) for name, mesh in parts.items()]


def asked(plan: Plan, n: int) -> Iterator[tuple[str, int]]:
    """Yield wrt and each installed library with its number of queries: n for wrt, at most plan.others for another library."""
    yield "wrt", n
    for name, (package, _) in OTHERS.items():
        if plan.others and importlib.util.find_spec(package) is not None:
            yield name, min(n, plan.others)


def points_wrong(geometry: Geometry, reference: Reference, answer: Answer, n: int, seed: int) -> dict[str, object]:
    rng, wrong, touching, seconds = np.random.default_rng(seed), 0, 0, 0.0
    for first in range(0, n, CHUNK):
        points = points_in(geometry, rng, min(CHUNK, n - first))
        inside, taken = with_seconds(partial(answer, points))
        seconds += taken
        exactly, on_surface = exactly_inside(reference, points, rng)
        differ = np.flatnonzero((inside != exactly) & ~on_surface)
        wrong += len(differ)
        touching += int((distances(geometry, points[differ]) < 1e-6 * np.ptp(geometry.vertices, axis=0).max()).sum())
    return {"asked": n, "wrong": wrong, "touching": touching, "microseconds": 1e6 * seconds / n}


def points_in(geometry: Geometry, rng: np.random.Generator, n: int) -> np.ndarray:
    """Return (n, 3) float32 points. Two of three are uniform in the mesh's box; from the third, a ray along one of AIMS meets a corner."""
    low, high = geometry.vertices.min(axis=0).astype(np.float64), geometry.vertices.max(axis=0)
    points = rng.uniform(low, high, (n, 3))
    aimed = np.arange(0, n, 3)
    corner = geometry.vertices[geometry.faces[rng.integers(len(geometry.faces), size=len(aimed)), 0]].astype(np.float64)
    along = AIMS[rng.integers(len(AIMS), size=len(aimed))]
    points[aimed] = corner - along * (rng.random((len(aimed), 1)) * 0.5 * (high - low).max())
    return points.astype(np.float32)


def exactly_inside(reference: Reference, points: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Return flags of the points inside, and flags of the points exactly on the surface, where either answer is right: (N,) bool each.
    Count the crossings of a random ray by exact arithmetic. If the ray meets an edge or corner, take another ray."""
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
    """Return the distance from each point to the nearest triangle, (N,)."""
    from trimesh.triangles import closest_point

    corners = geometry.vertices[geometry.faces].astype(np.float64)
    return np.array([np.linalg.norm(closest_point(corners, np.tile(point, (len(corners), 1))) - point, axis=1).min()
                     for point in points.astype(np.float64)])


def crossed(geometry: Geometry, accel: Accelerator, count: Answer, own: bool, n: int, seed: int) -> dict[str, object]:
    """Test n rays that begin and end outside: a ray is wrong if it crosses the surface an odd number of times by `count`.
    own: `count` is wrt's. Another library may report one hit where a ray touches an outline, so such rays are not wrong for it."""
    rng, wrong, touching, hits, seconds = np.random.default_rng(seed), 0, 0, 0, 0.0
    low, high = (bound.astype(np.float64) for bound in (geometry.vertices.min(axis=0), geometry.vertices.max(axis=0)))
    for first in range(0, n, CHUNK):
        size = min(CHUNK, n - first)
        origins = (0.5 * (low + high) + 1.5 * np.linalg.norm(high - low) * unit_vectors(rng, size)).astype(np.float32)
        at = np.where(np.arange(size)[:, None] % 2 == 0, *(targets(geometry, rng, size, aim) for aim in ("vertices", "edges")))
        directions = (at - origins).astype(np.float32)
        crossings, taken = with_seconds(partial(count, origins, directions))
        seconds, hits = seconds + taken, hits + int(crossings.sum())
        touches = crossings_of(geometry, all_hits(accel, origins, directions), directions)[1] > 0
        touching += int(touches.sum())
        wrong += int((crossings % 2 == 1)[~touches | own].sum())
    return {"asked": n, "wrong": wrong, "touching": touching, "hits": hits, "microseconds": 1e6 * seconds / max(hits, 1)}


def crossings_of(geometry: Geometry, found: AllHits, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return how often each ray crosses the surface, and how often it touches the surface without crossing it, (N,) each.
    The faces that a ray hits at one edge or corner are one crossing if their signed angles, seen along the ray, sum to a whole turn. A
    hit counts as on an edge only if both faces of the edge report it: rounding hides whether the weight 1 - u - v is 0."""
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
    """Return the angle in radians at corner k[i] of triangle i, projected along the ray's direction d[i]: (M,)."""
    row = np.arange(len(k))
    d = d / np.linalg.norm(d, axis=1, keepdims=True)
    sides = [corners[row, (k + i) % 3] - corners[row, k] for i in (1, 2)]
    e, f = (side - (side * d).sum(axis=1, keepdims=True) * d for side in sides)
    return np.arctan2(np.linalg.norm(np.cross(e, f), axis=1), (e * f).sum(axis=1))


def open3d_answers(geometry: Geometry) -> tuple[Answer, Answer]:
    """Return two functions of Open3D: points -> flags of the points inside; origins, directions -> number of hits of each ray."""
    import open3d

    tensor = open3d.core.Tensor.from_numpy
    scene = open3d.t.geometry.RaycastingScene()
    scene.add_triangles(tensor(geometry.vertices.copy()), tensor(geometry.faces.astype(np.uint32)))
    return (lambda points: scene.compute_occupancy(tensor(points)).numpy() > 0.5,
            lambda origins, directions: scene.count_intersections(tensor(np.concatenate([origins, directions], axis=1))).numpy())


def embree_answers(geometry: Geometry) -> tuple[Answer, Answer]:
    """Return two functions of trimesh with Embree: points -> flags of the points inside; origins, directions -> number of hits."""
    import trimesh
    from trimesh.ray.ray_pyembree import RayMeshIntersector

    rays = RayMeshIntersector(trimesh.Trimesh(geometry.vertices, geometry.faces, process=False))
    return rays.contains_points, lambda origins, directions: np.bincount(rays.intersects_id(origins, directions)[1], minlength=len(origins))


# Name -> the package that a library needs, and its two functions for a geometry.
OTHERS: dict[str, tuple[str, Callable[[Geometry], tuple[Answer, Answer]]]] = {
    "Open3D": ("open3d", open3d_answers), "trimesh, Embree": ("embreex", embree_answers)}


def parts(rows: Sequence[Row], plan: Plan) -> list[Part]:
    total = []
    for what, who in dict.fromkeys((row.what, row.who) for row in rows):
        mine = [row for row in rows if (row.what, row.who) == (what, who)]
        counts = {name: sum(getattr(row, name) for row in mine) for name in ("asked", "wrong", "touching")}
        found = [row.hits if what == "crossings" else row.asked for row in mine]  # answers, as in row.microseconds
        each = sum(row.microseconds * n for row, n in zip(mine, found, strict=True)) / max(sum(found), 1)
        total.append(Row(what=what, mesh="all", triangles="", who=who, **counts, microseconds=each))
    return [tabled(COLUMNS, total, "All meshes"), tabled(COLUMNS, rows, "By mesh")]
