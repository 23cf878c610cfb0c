"""wrt.compat.open3d has the interface and results of Open3D's RaycastingScene, and correct results where Open3D errs."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import trimesh

import wrt
from tests.refused import refused
from tests.wrt.compat.test_trimesh import JOINT
from wrt.compat.open3d import RaycastingScene
from wrt.scene import shapes

BOX = trimesh.creation.box()  # from -0.5 to 0.5
NONE = RaycastingScene.INVALID_ID


def scene_of(*meshes: Any) -> RaycastingScene:
    scene = RaycastingScene()
    assert [scene.add_triangles(np.float32(mesh.vertices), np.uint32(mesh.faces)) for mesh in meshes] == list(range(len(meshes)))
    return scene


def down(xy: Any, z: float = 9.0) -> np.ndarray:
    """Return rays (..., 6) straight down."""
    xy = np.asarray(xy, np.float32)
    return np.concatenate([xy, np.broadcast_to(np.float32([z, 0, 0, -1]), (*xy.shape[:-1], 4))], axis=-1)


def numpy(answer: dict[str, Any]) -> SimpleNamespace:
    return SimpleNamespace(**{name: array.numpy() for name, array in answer.items()})


def lattice() -> np.ndarray:
    """Return points (x, y) inside a box seen from above, also on the diagonals of its faces."""
    return np.stack(np.meshgrid(*[np.linspace(-0.4375, 0.4375, 15)] * 2), axis=-1)


def test_first_hits_of_two_meshes() -> None:
    high = BOX.copy()
    high.apply_translation([1.0, 0.0, 2.0])
    rays = down([[0.1, 0.2], [1.1, 0.3], [7.0, 7.0]])
    rays[0, 3:] *= 4.0
    found = numpy(scene_of(BOX, high).cast_rays(rays))
    assert found.t_hit.tolist() == [2.125, 6.5, np.inf] and found.geometry_ids.tolist() == [0, 1, NONE]
    assert found.primitive_ids[2] == NONE and (found.primitive_ids[:2] < 12).all()
    assert found.primitive_normals.tolist() == [[0.0, 0.0, 1.0], [0.0, 0.0, 1.0], [0.0, 0.0, 0.0]]
    for row, mesh in enumerate((BOX, high)):
        corners, (u, v) = mesh.vertices[mesh.faces[found.primitive_ids[row]]], found.primitive_uvs[row]
        np.testing.assert_allclose([1 - u - v, u, v] @ corners, [*rays[row, :2], mesh.bounds[1, 2]], atol=1e-6)
    assert found.primitive_uvs[2].tolist() == [0.0, 0.0]


def test_at_the_same_distance_the_lowest_ids_are_hit() -> None:
    found = numpy(scene_of(BOX, BOX).cast_rays(down(lattice())))
    assert (found.geometry_ids == 0).all() and len(np.unique(found.primitive_ids)) == 2
    assert (numpy(scene_of(BOX).cast_rays(down(lattice()))).primitive_ids == found.primitive_ids).all()


@pytest.mark.parametrize("shape", [(), (7,), (1, 2, 3), (0,), (4, 0)])
def test_shapes_and_types(shape: tuple[int, ...]) -> None:
    scene, n = scene_of(BOX), int(np.prod(shape))
    rays = np.broadcast_to(down([0.1, 0.2]), (*shape, 6))
    for given in (rays, rays.astype(np.float64), rays.tolist() if n else rays):
        found = numpy(scene.cast_rays(given))
        for name, tail, kind in (("t_hit", (), "f4"), ("geometry_ids", (), "u4"), ("primitive_ids", (), "u4"),
                                 ("primitive_uvs", (2,), "f4"), ("primitive_normals", (3,), "f4")):
            array = getattr(found, name)
            assert array.shape == shape + tail and array.dtype == np.dtype(kind) and type(array) is np.ndarray
        assert (found.t_hit == 8.5).all()
    assert scene.test_occlusions(rays).numpy().dtype == bool and scene.test_occlusions(rays).shape == shape
    counts = scene.count_intersections(rays).numpy()
    assert counts.shape == shape and counts.dtype == np.int32 and (counts == 2).all()
    listed = numpy(scene.list_intersections(rays))
    assert listed.ray_splits.tolist() == list(range(0, 2 * n + 1, 2)) and listed.ray_splits.dtype == np.uint32
    assert listed.t_hit.tolist() == [8.5, 9.5] * n and listed.ray_ids.tolist() == [i // 2 for i in range(2 * n)]
    assert listed.primitive_uvs.shape == (2 * n, 2) and listed.geometry_ids.tolist() == [0] * 2 * n
    occupied = scene.compute_occupancy(rays[..., :3]).numpy()
    assert occupied.shape == shape and occupied.dtype == np.float32 and not occupied.any()
    closest = numpy(scene.compute_closest_points(rays[..., :3]))
    for name, tail, kind in (("points", (3,), "f4"), ("geometry_ids", (), "u4"), ("primitive_ids", (), "u4"),
                             ("primitive_uvs", (2,), "f4"), ("primitive_normals", (3,), "f4")):
        assert getattr(closest, name).shape == shape + tail and getattr(closest, name).dtype == np.dtype(kind)
    for distance in (scene.compute_distance(rays[..., :3]), scene.compute_signed_distance(rays[..., :3])):
        assert distance.numpy().shape == shape and (distance.numpy() == 8.5).all() and distance.numpy().dtype == np.float32


NEARS = 0.0, 2.5, 5.0, -1e-6, -1, -5.0, -np.inf, np.nan
FARS = np.inf, 9, 2.5, 0.5, -1.0, -4.0, -np.inf, np.nan


@pytest.mark.parametrize("of_each", [False, True])
@pytest.mark.parametrize("other", [False, True])
def test_segments_may_begin_below_0(of_each: bool, other: bool) -> None:
    """As in Open3D: what is behind the origin is seen, unless the segment ends below 0. The wall is at t = 2, 2, -3, -3."""
    wall = np.float32([[-9, -9, 0], [9, -9, 0], [0, 9, 0]]), np.uint32([[0, 1, 2]])
    scene: Any = pytest.importorskip("open3d").t.geometry.RaycastingScene() if other else RaycastingScene()
    scene.add_triangles(*wall)
    rays = np.float32([[0, 0, 2, 0, 0, -1], [0, 1, 4, 0, 0, -2], [0, 0, -3, 0, 0, -1], [0, 0, 3, 0, 0, 1]])
    t = np.array([2, 2, -3, -3])
    for near in NEARS:
        for far in FARS if not other else [each for each in FARS if each != -np.inf]:  # Open3D marks hits by tfar = -inf
            ends = {"tnear": near, "tfar": far} if not of_each or other else {"tnear": np.full(4, near), "tfar": np.full(4, far)}
            expected = (near <= t) & (t <= far) & (far >= 0)
            assert np.array_equal(scene.test_occlusions(rays, **ends, nthreads=-1).numpy(), expected), ends


def test_what_is_no_ray_hits_nothing() -> None:
    rays = np.repeat(down([[0.1, 0.2]]), 6, axis=0)
    rays[0, 3:] = 0.0
    rays[1, 0] = np.nan
    rays[3, 4] = np.inf
    rays[4, 0] = -np.inf
    scene, good = scene_of(BOX), np.array([False, False, True, False, False, True])
    found = numpy(scene.cast_rays(rays))
    assert np.array_equal(np.isfinite(found.t_hit), good) and np.array_equal(found.primitive_ids != NONE, good)
    assert np.array_equal(found.primitive_normals[:, 2], good) and not found.primitive_uvs[~good].any()
    assert np.array_equal(scene.test_occlusions(rays).numpy(), good)
    assert np.array_equal(scene.count_intersections(rays).numpy(), 2 * good)
    listed = numpy(scene.list_intersections(rays))
    assert listed.ray_ids.tolist() == [2, 2, 5, 5] and listed.ray_splits.tolist() == [0, 0, 0, 2, 2, 2, 4]


def test_points_inside() -> None:
    hollow = BOX.copy()
    hollow.apply_scale(0.5)
    points = np.stack(np.meshgrid(*[np.linspace(-0.7, 0.7, 9)] * 3), axis=-1)
    farthest = np.abs(points).max(axis=-1)
    clear = np.abs(farthest - 0.5) > 1e-6
    for nsamples in (1, 3):
        inside = scene_of(BOX, hollow).compute_occupancy(points, nsamples=nsamples).numpy()
        assert np.array_equal(inside[clear], ((farthest < 0.5) & (farthest > 0.25))[clear])
    points[0, 0] = np.nan
    assert not scene_of(BOX).compute_occupancy(points).numpy()[0, 0].any()
    for again in (BOX.faces, BOX.faces[:, ::-1]):  # copies of faces have an inside
        twice = scene_of(SimpleNamespace(vertices=BOX.vertices, faces=np.concatenate([BOX.faces, again])))
        assert twice.compute_occupancy([[0.1, 0.2, 0.3], [0.1, 0.2, 3.0]]).numpy().tolist() == [1.0, 0.0]
    open_box = BOX.copy()
    open_box.update_faces(np.arange(12) != 3)
    inside = scene_of(open_box).compute_occupancy(np.full((1, 3), 0.1), nsamples=15).numpy()
    assert inside.tolist() == [1.0]  # most rays meet a face


def test_closest_points_and_distances() -> None:
    high = BOX.copy()
    high.apply_translation([0.0, 0.0, 3.0])
    scene = scene_of(BOX, high)
    points = np.float32([[0.1, 0.2, 0.4], [0.1, 0.2, 2.0], [1.5, 0.2, 0.1], [np.nan, 0.0, 0.0]])
    found = numpy(scene.compute_closest_points(points))
    np.testing.assert_allclose(found.points[:3], [[0.1, 0.2, 0.5], [0.1, 0.2, 2.5], [0.5, 0.2, 0.1]], atol=1e-6)
    assert found.geometry_ids.tolist() == [0, 1, 0, NONE] and found.primitive_ids[3] == NONE
    assert (found.primitive_ids[:3] < 12).all()
    np.testing.assert_allclose(found.primitive_normals, [[0, 0, 1], [0, 0, -1], [1, 0, 0], [0, 0, 0]], atol=1e-6)
    np.testing.assert_allclose(scene.compute_distance(points).numpy(), [0.1, 0.5, 1.0, np.nan], rtol=1e-5)
    np.testing.assert_allclose(scene.compute_signed_distance(points, nsamples=3).numpy(), [-0.1, 0.5, 1.0, np.nan], rtol=1e-5)
    empty = RaycastingScene()
    assert np.isinf(empty.compute_distance(points[:1]).numpy()[0])
    assert empty.compute_closest_points(points[:1])["geometry_ids"].numpy()[0] == NONE


def test_meshes_of_others_are_taken_and_copied() -> None:
    t_mesh = SimpleNamespace(vertex=SimpleNamespace(positions=np.float32(BOX.vertices)),
                             triangle=SimpleNamespace(indices=np.int64(BOX.faces)))
    old = SimpleNamespace(vertices=BOX.vertices, triangles=BOX.faces)
    for mesh in (BOX, t_mesh, old, wrt.Mesh.from_trimesh(BOX)):
        scene = RaycastingScene(nthreads=1, device="CPU:0")
        assert scene.add_triangles(mesh) == 0 and scene.add_triangles(mesh=mesh) == 1
        assert scene.count_intersections(down([0.1, 0.2])).numpy() == 4
    vertices = np.float32(BOX.vertices)
    scene = RaycastingScene()
    scene.add_triangles(vertex_positions=vertices, triangle_indices=BOX.faces)
    vertices += 100.0
    assert scene.count_intersections(down([0.1, 0.2])).numpy() == 2
    scene.add_triangles(vertices, BOX.faces)
    assert scene.cast_rays(down([100.1, 100.2], 200.0))["geometry_ids"].numpy() == 1


def test_faces_that_cannot_be_hit_keep_their_numbers() -> None:
    vertices = np.concatenate([[[np.nan, 0.0, 0.0]], BOX.vertices])
    faces = np.concatenate([[[0, 1, 2], [3, 3, 4]], BOX.faces + 1])
    scene = RaycastingScene()
    scene.add_triangles(vertices, faces)
    assert np.array_equal(numpy(scene.cast_rays(down(lattice()))).primitive_ids,
                          numpy(scene_of(BOX).cast_rays(down(lattice()))).primitive_ids + 2)


def test_a_scene_without_meshes_is_never_hit() -> None:
    scene, rays = RaycastingScene(), down([[0.1, 0.2]])
    found = numpy(scene.cast_rays(rays))
    assert found.t_hit.tolist() == [np.inf] and found.geometry_ids.tolist() == found.primitive_ids.tolist() == [NONE]
    assert scene.count_intersections(rays).numpy().tolist() == scene.compute_occupancy(rays[:, :3]).numpy().tolist() == [0]


def test_rays_of_a_pinhole() -> None:
    looking = RaycastingScene.create_rays_pinhole(fov_deg=90.0, center=[1, 2, 3], eye=[1, 2, 7], up=[0, 2, 0.5], width_px=8,
                                                  height_px=4).numpy()
    assert looking.shape == (4, 8, 6) and looking.dtype == np.float32 and (looking[..., :3] == [1, 2, 7]).all()
    np.testing.assert_allclose(looking[1, 2, 3:], [1.5 / 4, -0.5 / 4, -1.0], atol=1e-7)  # the lowest row is first
    np.testing.assert_allclose(looking[:, :, 3:].mean(axis=(0, 1)), [0, 0, -1], atol=1e-7)
    extrinsic = np.diag([-1.0, 1.0, -1.0, 1.0])
    extrinsic[:3, 3] = [1.0, -2.0, 7.0]
    for intrinsic, shift in (([[4, 0, 4], [0, 4, 2], [0, 0, 1]], 0.0), ([[4, 0, 5], [0, 4, 2], [0, 0, 1]], -0.25)):
        rays = RaycastingScene.create_rays_pinhole(np.array(intrinsic), extrinsic, 8, 4).numpy()
        np.testing.assert_allclose(rays + [0, 0, 0, shift, 0, 0], looking, atol=1e-6)


def test_what_is_refused() -> None:
    scene, pinhole = scene_of(BOX), RaycastingScene.create_rays_pinhole
    for call, told in ((lambda: scene.cast_rays(np.zeros((3, 5))), ("rays", "6)")),
                       (lambda: scene.compute_occupancy(np.zeros(3), nsamples=2), ("nsamples", "odd")),
                       (lambda: scene.test_occlusions(np.zeros((3, 6)), tfar=[1, 2]), ("tfar", "(3,)")),
                       (lambda: scene.add_triangles(np.zeros((3, 3)), [[0, 1, 3]]), ("triangle_indices", "0 to 2")),
                       (lambda: scene.add_triangles(1e35 * np.eye(3), [[0, 1, 2]]), ("vertex_positions", "at most 1e+30")),
                       (lambda: scene.add_triangles(7), ("mesh", "vertices and triangles")),
                       (lambda: pinhole(np.zeros((3, 3)), np.eye(4), 8, 4), ("intrinsic_matrix", "inverse")),
                       (lambda: pinhole(np.eye(3), np.eye(4), 8, 4.5), ("height_px", "whole number")),
                       (lambda: pinhole(0, [0, 0, 0], [0, 0, 1], [0, 1, 0], 8, 4), ("fov_deg", "between 0")),
                       (lambda: pinhole(60, [0, 0, 0], [0, 1, 0], [0, 2, 0], 8, 4), ("center", "eye")),
                       (lambda: RaycastingScene(device="SYCL:0").cast_rays(np.ones((1, 6))), ("device", "no device 'sycl:0'"))):
        with refused(*told):
            call()


def test_open3d_says_the_same() -> None:
    o3d = pytest.importorskip("open3d")
    torus, ball = shapes.torus(1.0, 0.4, 24, 16), shapes.icosphere(2)
    mine, other = RaycastingScene(), o3d.t.geometry.RaycastingScene()
    for mesh in (torus, ball):
        arrays = o3d.core.Tensor(mesh.vertices), o3d.core.Tensor(mesh.faces.astype(np.uint32))
        assert mine.add_triangles(*arrays) == other.add_triangles(*arrays)
    rng = np.random.default_rng(0)
    origins = rng.normal(size=(40, 50, 3))
    rays = o3d.core.Tensor(np.concatenate([origins, rng.uniform(-1, 1, (40, 50, 3)) - origins], axis=2).astype(np.float32))
    pairs = [(mine.cast_rays(rays), other.cast_rays(rays)), (mine.list_intersections(rays), other.list_intersections(rays))]
    points = rays[:, :, :3]
    pairs += [({name: each[name] for name in ("points", "geometry_ids")} for each in  # at an edge either face is right
               (mine.compute_closest_points(points), other.compute_closest_points(points)))]
    pairs += [({"": getattr(mine, name)(given)}, {"": getattr(other, name)(given)}) for name, given in (
        ("test_occlusions", rays), ("count_intersections", rays), ("compute_occupancy", points),
        ("compute_distance", points), ("compute_signed_distance", points))]
    looking = (60.0, [0, 0, 0], [1, 2, 3], [0, 1, 0], 32, 24)
    extrinsic = np.array([[0, 1, 0, 3], [-1, 0, 0, 4], [0, 0, 1, 5], [0, 0, 0, 1.0]])
    matrices = np.array([[40, 0, 16], [0, 41, 12], [0, 0, 1.0]]), extrinsic
    pairs += [({"": kind.create_rays_pinhole(*given)} for kind in (RaycastingScene, o3d.t.geometry.RaycastingScene))
              for given in (looking, (*matrices, 8, 6))]
    for got, expected in pairs:
        assert set(got) == set(expected)
        order = [np.lexsort([each["t_hit"].numpy(), each["ray_ids"].numpy()]) if "ray_ids" in each else slice(None)
                 for each in (got, expected)]  # Open3D does not sort by t
        for name in got:
            a, b = got[name], expected[name]
            assert type(a) is type(b) and a.dtype == b.dtype and a.shape == b.shape
            a, b = a.numpy(), b.numpy()
            if "ray_ids" in got and name != "ray_splits":
                a, b = a[order[0]], b[order[1]]
            np.testing.assert_allclose(a, b, atol=2e-5) if a.dtype == np.float32 else np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize("shared", [True, False])
def test_a_joint_that_a_collinear_face_closes_loses_no_ray(shared: bool) -> None:
    """The coordinates of hits are those in the faces that were added."""
    vertices, faces = JOINT if shared else (JOINT[0][JOINT[1]].reshape(-1, 3), np.arange(3 * len(JOINT[1])).reshape(-1, 3))
    rng = np.random.default_rng(0)
    to = np.c_[rng.random(20_000) * 2, np.zeros((20_000, 2))]
    origins = np.float32(rng.uniform(0.8, 1.2, to.shape) * [1, 1, 0.5])
    rays = np.concatenate([origins, np.float32(to) - origins], axis=1)
    scene = scene_of(BOX.copy().apply_translation([9.0, 0.0, 0.0]), SimpleNamespace(vertices=vertices, faces=faces))
    found = numpy(scene.cast_rays(rays))
    assert (found.geometry_ids == 1).all() and set(found.primitive_ids) <= {0, 5, 6}
    a, b, c = (vertices[faces[found.primitive_ids, i]] for i in range(3))
    u, v = found.primitive_uvs[:, :1], found.primitive_uvs[:, 1:]
    assert np.abs((1 - u - v) * a + u * b + v * c - rays[:, :3] - found.t_hit[:, None] * rays[:, 3:]).max() < 1e-5
