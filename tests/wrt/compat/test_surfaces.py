"""The adapters count surface crossings as exact integer arithmetic does."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import trimesh

import wrt
from wrt.compat.open3d import RaycastingScene
from wrt.compat.trimesh import RayMeshIntersector
from wrt.scene import shapes

PLACES = [(1.0, 0.0), (0.01, 0.0), (300.0, 0.0), (1.0, 1.0), (1.0, -5.0), (1.0, 100.0), (7.0, -1e3), (1.0, 1e3), (1e-4, 0.01),
          (1e5, 1e7)]  # size of a mesh, and its distance from the origin
MESHES = [shapes.box(), shapes.icosphere(1), shapes.torus(1.0, 0.4, 8, 6),
          shapes.merged([shapes.icosphere(1), shapes.box((0.4, -0.3, -0.3), (1.6, 0.3, 0.3))], "overlapping")]
ROUNDING = 1e-5  # relative to the size: closer to an edge or plane than this, float32 cannot decide


def shuffled(mesh: wrt.Mesh, size: float, away: float, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Return vertices and faces of a scaled and shifted mesh. Each face begins at a random corner and has a random winding. Half of
    the meshes have separate corners for each face."""
    vertices = np.float32(size * np.float64(mesh.vertices) + away * rng.normal(size=3))
    faces = np.array([np.roll(face, rng.integers(3))[::rng.choice([-1, 1])] for face in rng.permutation(mesh.faces)])
    if rng.random() < 0.5:
        vertices, faces = vertices[faces].reshape(-1, 3), np.arange(3 * len(faces)).reshape(-1, 3)
    return vertices, faces


def rays_at(vertices: np.ndarray, faces: np.ndarray, n: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Return float32 rays from inside and outside towards faces, corners and edges, and along the axes through corners."""
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    middle, size = (low + high) / 2.0, (high - low).max()
    a, b, c = vertices[faces[rng.integers(len(faces), size=n)]].astype(np.float64).transpose(1, 0, 2)
    kind = rng.integers(4, size=(n, 1))
    target = np.select([kind == 0, kind == 1], [0.5 * a + 0.3 * b + 0.2 * c, a + rng.random((n, 1)) * (b - a)], a)
    axis = np.eye(3)[rng.integers(3, size=n)] * rng.choice([-1.0, 1.0], (n, 1))
    origins = middle + size * rng.normal(size=(n, 3)) * rng.choice([0.1, 0.3, 2.0], (n, 1))
    origins = np.float32(np.where(kind == 3, np.where(axis != 0.0, middle - 2.0 * size * axis, a), origins))
    return origins, np.float32(np.where(kind == 3, axis, target - origins))


def dot(a: Any, b: Any) -> Any:
    return a[..., 0] * b[..., 0] + a[..., 1] * b[..., 1] + a[..., 2] * b[..., 2]


def cross(a: Any, b: Any) -> Any:
    return np.stack([a[..., i] * b[..., j] - a[..., j] * b[..., i] for i, j in ((1, 2), (2, 0), (0, 1))], axis=-1)


def seen(origins: Any, directions: Any, corners: Any) -> tuple[Any, Any]:
    """Return, for N rays and F triangles, six times the volume of two tetrahedra: of the ray's direction and each edge, (N, F, 3), and
    of the ray's origin and the triangle, (N, F)."""
    a, b, c = (corners[None, :, i] - origins[:, None] for i in range(3))
    d = directions[:, None]
    return np.stack([dot(d, cross(b, c)), dot(d, cross(c, a)), dot(d, cross(a, b))], axis=-1), dot(a, cross(b, c))


whole = np.frompyfunc(lambda x: int(math.ldexp(x, 149)), 1, 1)  # a float32 times 2^149, exactly


def exact_counts(origins: np.ndarray, directions: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """Count the triangles whose interior each ray crosses."""
    sides, volume = seen(*(whole(array.astype(np.float64)) for array in (origins, directions, corners)))
    through = (sides > 0).all(axis=-1) | (sides < 0).all(axis=-1)
    return (through & (volume * sides.sum(axis=-1) > 0)).sum(axis=1)


def sure(origins: np.ndarray, directions: np.ndarray, corners: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the masks of rays that pass all edges, and of origins that lie off all planes, by more than ROUNDING."""
    origins, directions, corners = (array.astype(np.float64) for array in (origins, directions, corners))
    sides, volume = seen(origins, directions, corners)
    size = np.abs(corners[None] - origins[:, None, None]).max(axis=(1, 2, 3))
    area = np.linalg.norm(cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    past = np.abs(sides).min(axis=(1, 2)) > ROUNDING * size**2 * np.linalg.norm(directions, axis=1)
    return past, (np.abs(volume) >= ROUNDING * size[:, None] * area).all(axis=1)


def adapters(vertices: Any, faces: Any, origins: Any, directions: Any) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return, for each adapter, the number of hits of each ray, and whether the ray hits anything. All arrays are float32."""
    vertices, faces, origins = np.float32(vertices), np.asarray(faces), np.float32(origins)
    directions = np.broadcast_to(np.float32(directions), origins.shape)
    scene, ray = RaycastingScene(), RayMeshIntersector(trimesh.Trimesh(vertices, faces, process=False))
    scene.add_triangles(vertices, faces)
    rays = np.concatenate([origins, directions], axis=1)
    listed = {name: array.numpy() for name, array in scene.list_intersections(rays).items()}
    counts, n = scene.count_intersections(rays).numpy(), len(origins)
    assert np.array_equal(np.diff(listed["ray_splits"].astype(int)), counts)
    later = np.diff(listed["t_hit"]) >= 0.0
    assert later[np.diff(listed["ray_ids"].astype(int)) == 0].all()
    _, of, face = ray.intersects_location(origins, directions)
    assert len(np.unique(np.stack([of, face]), axis=1).T) == len(of)  # no face twice
    return [(counts, scene.test_occlusions(rays).numpy()), (np.bincount(of, minlength=n), ray.intersects_any(origins, directions))]


@pytest.mark.filterwarnings("ignore:mesh of add_triangles. its float32 vertices:wrt.SceneWarning")
@pytest.mark.parametrize("mesh", MESHES, ids=lambda mesh: mesh.name)
def test_counts_of_closed_meshes_are_exact(mesh: wrt.Mesh) -> None:
    rng = np.random.default_rng(0)
    seen_inside, seen_sure = [], []
    for size, away in PLACES:
        vertices, faces = shuffled(mesh, size, away, rng)
        origins, directions = rays_at(vertices, faces, 200, rng)
        corners = vertices[faces]
        past, off = sure(origins, directions, corners)
        exact = exact_counts(origins, directions, corners)
        inside = exact_counts(origins, np.broadcast_to(rng.normal(size=3).astype(np.float32), origins.shape), corners) % 2 == 1
        for counts, hit in adapters(vertices, faces, origins, directions):
            assert np.array_equal(counts > 0, hit)
            assert np.array_equal(counts[off] % 2 == 1, inside[off]), (size, away)
            assert np.array_equal(counts[past & off], exact[past & off]), (size, away)
            if mesh is MESHES[0]:  # convex, however its corners are rounded
                assert (counts[off] <= np.where(inside[off], 1, 2)).all()
        seen_inside += inside[off].tolist()
        seen_sure += past[off].tolist()
    assert 0.04 < np.mean(seen_inside) < 0.8 and 0.1 < np.mean(seen_sure) < 0.9 and len(seen_sure) > 1000


def test_an_open_sheet_is_hit_once_wherever() -> None:
    turn = 2.0 * np.pi * np.arange(5) / 5
    fan = np.float32(np.stack([np.append(0.0, np.cos(turn)), np.append(0.0, np.sin(turn)), np.zeros(6)], axis=1))
    faces = np.array([np.roll([0, 1 + i, 1 + (i + 1) % 5], i % 3) for i in range(5)])  # they begin at different corners
    beside = np.float32(10.0) ** np.arange(-10, 0)
    corners = fan[1:]
    x, y = (np.concatenate([each, corners[:, i], 0.5 * corners[:, i]]) for i, each in enumerate((beside, 0.0 * beside)))
    origins = np.float32(np.stack([x, y, 1.0 + 0.0 * x], axis=1))
    for counts, hit in adapters(fan, faces, origins, [[0.0, 0.0, -1.0]]):
        assert hit.all() and (counts == 1).all()  # at the outline too
    square = [[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]]
    for counts, _ in adapters(square, [[0, 1, 2], [2, 1, 3]], [[2.6, 2.0, 3.7]], [[-1.6, -2.0, -3.7]]):
        assert counts.tolist() == [1]


def test_where_a_closed_mesh_is_only_touched_it_is_entered_and_left() -> None:
    box = trimesh.creation.box()
    rng = np.random.default_rng(1)
    along = rng.uniform(-0.4, 0.4, (500, 1)) * [0.0, 0.0, 1.0]
    touched = np.array([0.5, 0.5, 0.0]) + along  # points of an edge
    direction = np.array([1.0, -1.0, 0.25])  # the rest of the ray is outside of the box
    for counts, hit in adapters(box.vertices, box.faces, touched - 4.0 * direction, direction):
        assert np.array_equal(counts, 2 * hit) and hit.mean() > 0.5
    vertices = np.concatenate([box.vertices, [[3.0, 0.0, 0.0], [4.0, 0.0, 0.0], [3.0, 1.0, 0.0]]])
    for counts, hit in adapters(vertices, np.concatenate([box.faces, [[8, 9, 10]]]), touched - 4.0 * direction, direction):
        assert np.array_equal(counts > 0, hit) and set(counts[hit]) <= {1, 2}  # a single face is open, so that a touch is one hit


def test_corners_that_differ_in_the_last_bit_are_one() -> None:
    # A globe of the Earth in millimetres: each of its slices has corners of its own at the poles, 1e-6 apart.
    up, around = np.meshgrid(np.linspace(0.0, np.pi, 19), np.linspace(0.0, 2.0 * np.pi, 37), indexing="ij")
    vertices = 6.4e9 * np.stack([np.sin(up) * np.cos(around), np.sin(up) * np.sin(around), np.cos(up)], axis=-1).reshape(-1, 3)
    at = np.arange(19 * 37).reshape(19, 37)
    a, b, c, d = (part.reshape(-1) for part in (at[:-1, :-1], at[1:, :-1], at[1:, 1:], at[:-1, 1:]))
    faces = np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])
    assert 1e-7 < np.ptp(vertices[at[18], 0]) < 1e-5
    rng = np.random.default_rng(2)
    origins = rng.normal(0.0, 5e8, (200, 3))
    for pole in (at[0], at[18]):
        target = vertices[rng.choice(pole, 200)]
        ray = RayMeshIntersector(trimesh.Trimesh(vertices, faces, process=False))
        assert np.bincount(ray.intersects_id(origins, target - origins)[1], minlength=200).tolist() == [1] * 200
        for counts, _ in adapters(vertices, faces, origins, target - origins):
            assert (counts == 1).all()


@pytest.mark.parametrize("mesh", MESHES, ids=lambda mesh: mesh.name)
def test_a_ray_from_on_the_surface_counts_what_it_hits(mesh: wrt.Mesh) -> None:
    rng = np.random.default_rng(3)
    ends = np.float32(mesh.vertices)[mesh.faces[rng.integers(len(mesh.faces), size=2000)]]
    origins = np.select([rng.random((2000, 1)) < 0.5], [ends[:, 0]], 0.5 * (ends[:, 0] + ends[:, 1]))  # corners and edges
    target = mesh.vertices[rng.integers(len(mesh.vertices), size=2000)]
    moving = (target != origins).any(axis=1)
    for counts, hit in adapters(mesh.vertices, mesh.faces, origins[moving], (target - origins)[moving]):
        assert np.array_equal(counts > 0, hit) and 0.1 < hit.mean()
