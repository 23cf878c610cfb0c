"""wrt.compat.trimesh has the results of trimesh's ray class, and correct results where trimesh errs."""

from __future__ import annotations

import copy
import pickle
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import trimesh

import wrt
from tests.refused import refused
from wrt.compat.trimesh import RayMeshIntersector
from wrt.kernels.hit_lists import FEW
from wrt.scene import shapes

DOWN = np.array([[0.0, 0.0, -1.0]])


def random_rays(n: int, reach: float = 1.2) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(0)
    origins = rng.normal(size=(n, 3))
    origins *= 3.0 * reach / np.linalg.norm(origins, axis=1)[:, None]
    return origins, reach * rng.uniform(-1.0, 1.0, (n, 3)) - origins


def lattice() -> tuple[np.ndarray, np.ndarray]:
    """Return rays straight down on a box, also on its edges, corners and the diagonals of its faces."""
    x, y = (each.ravel() for each in np.meshgrid(np.linspace(-0.5, 0.5, 17), np.linspace(-0.5, 0.5, 17)))
    return np.stack([x, y, np.full(len(x), 100.0)], axis=1), np.repeat(DOWN, len(x), axis=0)


def counts(ray: Any, origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
    return np.bincount(ray.intersects_id(origins, directions)[1], minlength=len(origins))


@pytest.mark.parametrize("call", [
    lambda ray, *rays: ray.intersects_id(*rays),
    lambda ray, *rays: ray.intersects_id(*rays, False),
    lambda ray, *rays: ray.intersects_id(*rays, max_hits=3, return_locations=True),
    lambda ray, *rays: ray.intersects_id(*rays, multiple_hits=False, max_hits=0),
    lambda ray, *rays: ray.intersects_location(*rays),
    lambda ray, *rays: ray.intersects_location(ray_origins=rays[0], ray_directions=rays[1], multiple_hits=False),
    lambda ray, *rays: (ray.intersects_first(*rays), ray.intersects_any(*rays)),
    lambda ray, origins, _: (ray.contains_points(0.5 * origins), ray.contains_points(0.1 * origins)),
])
def test_trimesh_says_the_same(call: Callable[..., tuple[np.ndarray, ...]]) -> None:
    peer = pytest.importorskip("trimesh.ray.ray_pyembree")
    torus = shapes.torus(1.0, 0.4, 24, 16)
    mesh = trimesh.Trimesh(torus.vertices + np.array([7.0, -3.0, 0.1]), torus.faces)
    for rays in (random_rays(2000), random_rays(1), (np.zeros((0, 3)), np.zeros((0, 3)))):
        origins, directions = rays[0] + [7.0, -3.0, 0.1], rays[1]
        mine, other = (call(kind(mesh), origins, directions) for kind in (RayMeshIntersector, peer.RayMeshIntersector))
        for a, b in zip(mine, other, strict=True):
            assert a.dtype == b.dtype and a.shape == b.shape and type(a) is np.ndarray
            assert np.allclose(a, b, rtol=0.0, atol=1e-12) if a.dtype == np.float64 else np.array_equal(a, b)


def test_surfaces_in_the_same_place_are_all_there() -> None:
    low, high = trimesh.creation.box(), trimesh.creation.box()
    high.apply_translation([0.0, 0.0, 1.0])  # touches the other box from above
    origins, directions = lattice()
    inside = (np.abs(origins[:, :2]) < 0.5).all(axis=1)
    for pair in ((low, high), (low, low.copy()), (low, trimesh.Trimesh(low.vertices, low.faces[:, ::-1]))):
        assert (counts(RayMeshIntersector(trimesh.util.concatenate(pair)), origins, directions)[inside] == 4).all()


def test_more_hits_than_one_walk_takes_and_no_more_than_asked_for() -> None:
    walls = trimesh.util.concatenate([trimesh.Trimesh(*sheet) for sheet in
                                      ([[[-1, -1, z], [2, -1, z], [-1, 2, z]], [[0, 1, 2]]] for z in range(2 * FEW))])
    origins = np.array([[0.1, 0.1, 99.0], [0.2, 0.1, FEW - 0.5], [5.0, 5.0, 9.0], [0.1, 0.3, 1.5]])
    face, ray, where = RayMeshIntersector(walls).intersects_id(origins, np.repeat(DOWN, 4, axis=0), return_locations=True)
    assert np.array_equal(np.bincount(ray), [2 * FEW, FEW, 0, 2])
    first_seconds = [(ray_id, hit) for hit in range(2 * FEW) for ray_id, n in enumerate([2 * FEW, FEW, 0, 2]) if hit < n]
    assert ray.tolist() == [ray_id for ray_id, _ in first_seconds]
    assert face.tolist() == [(2 * FEW, FEW, 0, 2)[ray_id] - 1 - hit for ray_id, hit in first_seconds]
    assert np.array_equal(where[:, 2], face) and np.allclose(where[:, :2], origins[ray, :2], rtol=0.0, atol=1e-15)
    for most in (-1, 0, 1, 2, FEW, FEW + 1):
        part = RayMeshIntersector(walls).intersects_id(origins, np.repeat(DOWN, 4, axis=0), max_hits=most)
        assert part[1].tolist() == [ray_id for ray_id, hit in first_seconds if hit < most]


def test_locations_have_the_digits_of_float64() -> None:
    rng = np.random.default_rng(1)
    mesh = trimesh.creation.icosphere(3)
    mesh.apply_transform(trimesh.transformations.random_rotation_matrix(rng.random(3)))
    origins, directions = random_rays(1000)
    where, ray, face = RayMeshIntersector(mesh).intersects_location(origins, directions)
    a, b, c = (mesh.vertices[mesh.faces[face, i]].astype(np.longdouble) for i in range(3))
    o, d, normal = origins[ray].astype(np.longdouble), directions[ray].astype(np.longdouble), np.cross(b - a, c - a)
    exact = o + ((a - o) * normal).sum(axis=1, keepdims=True) / (d * normal).sum(axis=1, keepdims=True) * d
    square_on = np.abs((d * normal).sum(axis=1)) > 0.2 * np.sqrt((d * d).sum(axis=1) * (normal * normal).sum(axis=1))
    assert square_on.sum() > 1000 and np.abs(where - exact)[square_on].max() < 2e-14
    corner = mesh.triangles[face[0]][0]  # the point is on the triangle even if the ray misses in float64
    there = RayMeshIntersector(mesh).intersects_location([3.0 * corner], [-corner], multiple_hits=False)[0]
    assert np.abs(there - corner).max() < 1e-6


@pytest.mark.parametrize("scale, move, error", [
    (1.0, 5e6, 1e-7), (1e-30, 0.0, 2e-11), (1e35, 0.0, 2e-11), (1e-200, 0.0, 1e-5), (1e200, 1e201, 1e-5)])  # at the end: by u and v
def test_meshes_far_away_tiny_and_huge(scale: float, move: float, error: float) -> None:
    torus = shapes.torus(1.0, 0.4, 24, 16)
    there = trimesh.Trimesh(scale * np.float64(torus.vertices) + move, torus.faces, process=False)
    here = trimesh.Trimesh((there.vertices - move) / scale, torus.faces, process=False)
    origins, directions = random_rays(1000)
    expected, got = RayMeshIntersector(here), RayMeshIntersector(there)
    assert expected.intersects_any(origins, directions).mean() > 0.2
    for o, d in ((origins, directions), (origins - 1e3 * directions, directions)):
        where, ray, face = expected.intersects_location(o, d, False)
        there_where, there_ray, there_face = got.intersects_location(scale * o + move, d, False)
        assert np.array_equal(there_ray, ray) and np.array_equal(there_face, face)
        assert np.abs((there_where - move) / scale - where).max() < error


def test_rays_from_far_away_meet_what_they_are_aimed_at() -> None:
    mesh = trimesh.creation.icosphere(4)
    rng = np.random.default_rng(2)
    back = rng.normal(size=(mesh.faces.shape[0], 3))
    back *= np.sign((back * mesh.face_normals).sum(axis=1) / np.linalg.norm(back, axis=1) - 0.3)[:, None]
    square_on = (back * mesh.face_normals).sum(axis=1) > 0.3 * np.linalg.norm(back, axis=1)
    for distance in (1.0, 1e6, 1e9):
        first = RayMeshIntersector(mesh).intersects_first(mesh.triangles_center + distance * back, -back)
        assert np.array_equal(first[square_on], np.flatnonzero(square_on))


def test_a_mesh_that_changes_is_asked_as_it_is() -> None:
    mesh = trimesh.creation.box()
    mesh.ray = RayMeshIntersector(mesh)
    down = np.array([[0.1, 0.2, 9.0]]), DOWN
    assert mesh.ray.intersects_location(*down)[0][:, 2].tolist() == [0.5, -0.5] and mesh.contains([[0.0, 0.0, 0.0]])[0]
    mesh.apply_translation([0.0, 0.0, 2.0])
    assert mesh.ray.intersects_location(*down)[0][:, 2].tolist() == [2.5, 1.5] and not mesh.contains([[0.0, 0.0, 0.0]])[0]
    mesh.vertices[:, 2] += 1.0
    assert mesh.ray.intersects_location(*down)[0][:, 2].tolist() == [3.5, 2.5]
    mesh.update_faces(np.arange(12) != mesh.ray.intersects_first(*down)[0])
    assert mesh.ray.intersects_location(*down)[0][:, 2].tolist() == [2.5]


def test_faces_that_cannot_be_hit_keep_their_numbers() -> None:
    box = trimesh.creation.box()
    vertices = np.concatenate([box.vertices, [[np.nan, 0.0, 9.0], [0.0, np.inf, 9.0], [1e300, 0.0, 0.0]]])  # the last: of no face
    faces = np.concatenate([[[0, 1, 1], [8, 0, 1], [2, 9, 3]], box.faces, [[3, 3, 3]]])
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    assert mesh.faces.shape == (16, 3)
    rays = random_rays(200, 0.5)
    first, expected = RayMeshIntersector(mesh).intersects_first(*rays), RayMeshIntersector(box).intersects_first(*rays)
    assert np.array_equal(first, np.where(expected >= 0, expected + 3, -1)) and (first > 0).mean() > 0.2


def test_rays_that_are_none_hit_nothing_and_directions_have_any_length() -> None:
    ray = RayMeshIntersector(trimesh.creation.box())
    bad: Any = [[0, 0, 0], [np.nan, 0, 1], [0, np.inf, 0]]
    origins = np.array([[0.1, 0.2, 9.0]] * 8)
    origins[3:5] = [[np.nan, 0.0, 0.0], [0.1, 0.2, np.inf]]
    directions = np.concatenate([bad, np.repeat(DOWN, 2, axis=0), 1e-300 * DOWN, 1e300 * DOWN, DOWN])
    hit = np.arange(8) > 4
    assert np.array_equal(ray.intersects_any(origins, directions), hit)
    assert np.array_equal(ray.intersects_first(origins, directions) >= 0, hit)
    where, index, _ = ray.intersects_location(origins, directions)
    assert index.tolist() == [5, 6, 7, 5, 6, 7] and np.allclose(where[:, 2], [0.5] * 3 + [-0.5] * 3, atol=1e-6)
    for wrong in (origins[:3], origins[0], origins[:, :2]):
        with refused("ray_origins", "ray_directions"):
            ray.intersects_first(wrong, directions)
    assert [array.shape for array in ray.intersects_location([], [])] == [(0, 3), (0,), (0,)]


def test_a_mesh_without_faces_is_never_hit() -> None:
    for mesh in (trimesh.Trimesh(), trimesh.Trimesh([[0.0, 0.0, 0.0]], np.zeros((0, 3), int), process=False)):
        ray = RayMeshIntersector(mesh)
        assert not ray.intersects_any([[0, 0, 9]], DOWN)[0] and ray.intersects_first([[0, 0, 9]], DOWN).tolist() == [-1]
        assert ray.intersects_location([[0, 0, 9]], DOWN)[0].shape == (0, 3)
        assert ray.contains_points([[0.0, 0.0, 0.0]]).tolist() == [False]


def test_points_inside() -> None:
    mesh = trimesh.creation.box()
    mesh.apply_translation([1e6, 0.0, 0.0])
    points = np.stack(np.meshgrid(*[np.linspace(-0.75, 0.75, 15)] * 3), axis=-1).reshape(-1, 3)  # rays between them run along edges
    clear = np.abs(np.abs(points).max(axis=1) - 0.5) > 1e-6
    inside = RayMeshIntersector(mesh).contains_points(points + [1e6, 0.0, 0.0])
    assert inside.dtype == bool and np.array_equal(inside[clear], (np.abs(points) < 0.5).all(axis=1)[clear])
    ray = RayMeshIntersector(trimesh.creation.box())
    assert ray.contains_points([[np.nan, 0.0, 0.0], [0.0, 0.0, 0.0], [1e300, 0.0, 0.0]]).tolist() == [False, True, False]
    assert ray.contains_points(np.zeros((0, 3))).shape == ray.contains_points([]).shape == (0,)
    with refused("points", "(N, 3)"):
        ray.contains_points([0.0, 0.0, 0.0])


def test_points_inside_of_an_open_mesh_go_by_the_rule_of_trimesh() -> None:
    ball = trimesh.creation.icosphere(3)
    ball.update_faces(np.arange(1280) != 77)
    points = np.random.default_rng(3).uniform(-1.0, 1.0, (500, 3))
    radius = np.linalg.norm(points, axis=1)
    inside = RayMeshIntersector(ball).contains_points(points)
    assert inside[radius < 0.9].mean() > 0.98 and not inside[radius > 1.0].any()


def test_copies_and_pickles_answer_the_same() -> None:
    ray = RayMeshIntersector(trimesh.creation.icosphere(2), scale_to_box=False, threads=1)
    rays = random_rays(100)
    expected = ray.intersects_first(*rays)
    for other in (copy.copy(ray), copy.deepcopy(ray), pickle.loads(pickle.dumps(ray))):
        assert type(other) is RayMeshIntersector and np.array_equal(other.intersects_first(*rays), expected)
    mesh = trimesh.creation.icosphere(2)
    wrt_hits = wrt.build(wrt.Mesh.from_trimesh(mesh)).closest_hit(*rays)  # such a mesh is not shifted: hits have the bits of wrt.build
    assert np.array_equal(wrt_hits.prim_id, expected)


@pytest.mark.parametrize("move", [0.0, 3.7])
def test_points_stay_on_rays_along_an_axis_or_in_a_plane(move: float) -> None:
    """Where a direction is 0, the coordinate of each point is the origin's, so that floor(point / cell) is the ray's cell."""
    mesh = trimesh.creation.icosphere(3)
    mesh.apply_translation([0.0, 0.0, move])
    x, y = (each.ravel() for each in np.meshgrid(np.arange(-9, 10) * 0.1, np.arange(-9, 10) * 0.1))
    origins = np.stack([x, y, np.full(len(x), move + 5.0)], axis=1)
    for directions in (np.tile([0.0, 0.0, -2.0], (len(x), 1)), np.tile([0.0, 0.07, -1.0], (len(x), 1))):
        fixed = directions[0] == 0.0
        for chosen in (slice(None), slice(100, 101)):  # many rays and one
            ray = RayMeshIntersector(mesh)
            for found in (ray.intersects_location(origins[chosen], directions[chosen]),
                          ray.intersects_location(origins[chosen], directions[chosen], multiple_hits=False),
                          ray.intersects_id(origins[chosen], directions[chosen], return_locations=True)[::-1]):
                assert len(found[0]) and np.array_equal(found[0][:, fixed], origins[chosen][found[1]][:, fixed])


JOINT = (np.array([[0, 0, 0], [2, 0, 0], [2, 2, 0], [0, 2, 0], [1, 1, 2], [1, 0, 0]], float),  # a pyramid; the last face closes a T joint
         np.array([[0, 2, 1], [0, 3, 2], [1, 2, 4], [2, 3, 4], [3, 0, 4], [0, 5, 4], [5, 1, 4], [0, 1, 5]]))


@pytest.mark.parametrize("shared", [True, False])
def test_a_joint_that_a_collinear_face_closes_loses_no_ray(shared: bool) -> None:
    vertices, faces = JOINT if shared else (JOINT[0][JOINT[1]].reshape(-1, 3), np.arange(3 * len(JOINT[1])).reshape(-1, 3))
    rng = np.random.default_rng(0)
    to = np.c_[rng.random(20_000) * 2, np.zeros((20_000, 2))]
    origins = rng.uniform(0.8, 1.2, to.shape) * [1, 1, 0.5]
    ray = RayMeshIntersector(trimesh.Trimesh(vertices, faces, process=False))
    face, of = ray.intersects_id(origins, to - origins)
    assert np.array_equal(of, np.arange(len(to))) and set(face) <= {0, 5, 6}
    assert set(ray.intersects_first(origins, to - origins)) <= {0, 5, 6}
    assert wrt.build(wrt.Scene.of([wrt.Mesh(vertices, faces)])).closest_hit(origins, to - origins).hit.all()


@pytest.mark.parametrize("again", [lambda faces: faces, lambda faces: faces[:, ::-1], lambda faces: faces[:3]])
def test_copies_of_faces_have_an_inside(again: Callable[[np.ndarray], np.ndarray]) -> None:
    box = shapes.box()
    mesh = trimesh.Trimesh(box.vertices, np.concatenate([box.faces, again(box.faces)]), process=False)
    points = np.array([[0.1, 0.2, 0.3], [0.1, 0.2, 3.0], [-0.3, 0.1, 0.0]])
    assert RayMeshIntersector(mesh).contains_points(points).tolist() == [True, False, True]
