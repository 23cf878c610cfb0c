"""Meshes, scenes, rays and points far from 0 are as accurate as near 0: an origin is subtracted in float64."""

from __future__ import annotations

import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
import warp as wp

import wrt
import wrt.sensors
from wrt.compat.open3d import RaycastingScene
from wrt.compat.trimesh import RayMeshIntersector
from wrt.core.errors import SceneWarning
from wrt.scene.shapes import icosphere

PLACES = {"8 km": (8000.1, -300.3, 45.7), "100 km": (-70000.1, 71000.7, 310.2), "UTM": (529000.123, 5801000.456, 45.7),
          "Earth-centred": (3882161.3, 771041.9, 4985923.4)}


def terrain() -> tuple[np.ndarray, np.ndarray]:
    """Make a square of 50 m with hills."""
    rng, n = np.random.default_rng(0), 60
    x, y = np.meshgrid(np.linspace(-25.0, 25.0, n), np.linspace(-25.0, 25.0, n), indexing="ij")
    z = 3.0 * np.sin(0.2 * x) * np.cos(0.17 * y) + 0.1 * rng.random(x.shape)
    i = (np.arange(n - 1)[:, None] * n + np.arange(n - 1)).reshape(-1)
    faces = np.concatenate([np.stack([i, i + n, i + n + 1], axis=1), np.stack([i, i + n + 1, i + 1], axis=1)])
    return np.stack([x, y, z], axis=-1).reshape(-1, 3), faces


VERTICES, FACES = terrain()
RNG = np.random.default_rng(1)
EYES = RNG.uniform(-20.0, 20.0, (2000, 3)) * [1, 1, 0] + [0, 0, 30]
WAYS = RNG.normal(size=(2000, 3)) * [0.3, 0.3, 0] + [0, 0, -1]
NEAR = wrt.build((VERTICES, FACES))


def exact_t(place: np.ndarray, eyes: np.ndarray, prim_id: np.ndarray) -> np.ndarray:
    """Return t of the rays with the planes of faces, in float64, from the same numbers as the query, minus `place`."""
    corners = (VERTICES + place)[FACES[prim_id]] - place
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return ((corners[:, 0] - (eyes - place)) * normal).sum(axis=1) / (np.float32(WAYS).astype(np.float64) * normal).sum(axis=1)


def error_of_t(accel: Any, place: np.ndarray) -> tuple[float, np.ndarray]:
    eyes = EYES + place
    hits = accel.closest_hit(eyes, WAYS)
    hit = hits.prim_id >= 0
    return float(np.abs(hits.t - exact_t(place, eyes, np.maximum(hits.prim_id, 0)))[hit].max()), hits.prim_id


def as_ply(vertices: np.ndarray, faces: np.ndarray) -> bytes:
    """Return a binary PLY file with positions of float64."""
    head = "".join(f"property double {axis}\n" for axis in "xyz")
    rows = np.zeros(len(faces), [("count", "u1"), ("corners", "<i4", 3)])
    rows["count"], rows["corners"] = 3, faces
    return (f"ply\nformat binary_little_endian 1.0\nelement vertex {len(vertices)}\n{head}element face {len(faces)}\n"
            "property list uchar int vertex_indices\nend_header\n").encode() + vertices.astype("<f8").tobytes() + rows.tobytes()


def structures(place: np.ndarray, folder: Path) -> dict[str, Any]:
    far = VERTICES + place
    mesh = wrt.Mesh(far, FACES)
    matrix = np.eye(4)
    matrix[:3, 3] = place
    (folder / "far.ply").write_bytes(as_ply(far, FACES))
    mesh.save(folder / "far.npz")
    with open(folder / "far.obj", "w") as file:
        file.writelines(f"v {x!r} {y!r} {z!r}\n" for x, y, z in far.tolist())
        file.writelines(f"f {a} {b} {c}\n" for a, b, c in (FACES + 1).tolist())
    moved = wrt.build(wrt.Mesh(VERTICES, FACES), movable=True)
    moved.move(0, matrix)
    back = wrt.build(mesh, movable=True)
    back.move(0, np.eye(4))
    refitted = wrt.build((VERTICES, FACES))
    refitted.refit(far)
    wrt.build(mesh).save(folder / "one.accel", mesh=True)
    return {"arrays": wrt.build((far, FACES)), "bvh2": wrt.build((far, FACES), "bvh2"), "scene": wrt.build(wrt.Scene.of([mesh])),
            "placed": wrt.build(wrt.Scene((wrt.Object(wrt.Mesh(VERTICES, FACES), transform=matrix),))), "moved": moved, "moved back": back,
            "refit": refitted, "ply": wrt.build(folder / "far.ply"), "npz": wrt.build(folder / "far.npz"),
            "obj": wrt.build(folder / "far.obj"), "loaded": wrt.load_accel(folder / "one.accel"),
            "loaded with its mesh": wrt.load_accel(folder / "one.accel", mesh),
            "pickled": pickle.loads(pickle.dumps(back)), "worlds": wrt.build([mesh])}


@pytest.mark.parametrize("name", PLACES)
def test_hits_are_as_accurate_as_near_0(name: str, tmp_path: Path) -> None:
    place = np.array(PLACES[name])
    near, faces = error_of_t(NEAR, np.zeros(3))
    for kind, accel in structures(place, tmp_path).items():
        error, found = error_of_t(accel, place)
        assert error <= 1.5 * near, (kind, error, near)
        assert (found != faces).mean() < 0.002, kind  # at edges, rounding decides


@pytest.mark.parametrize("name", PLACES)
def test_points_and_other_queries(name: str) -> None:
    place = np.array(PLACES[name])
    ball, near = icosphere(3), icosphere(3)
    mesh = wrt.Mesh(ball.vertices + place, ball.faces)
    accel, centred = wrt.build(mesh), wrt.build(near)
    points = np.random.default_rng(2).uniform(-1.5, 1.5, (500, 3))
    points[:50] = 0.999 * near.vertices[:50]
    assert np.array_equal(wrt.contains(accel, points + place), wrt.contains(centred, points))
    assert np.abs(wrt.signed_distance(accel, points + place) - wrt.signed_distance(centred, points)).max() < 1e-6
    assert np.abs(wrt.winding_number(accel, points + place, exact=True) - wrt.winding_number(centred, points, exact=True)).max() < 1e-3
    closest = wrt.closest_points(accel, points + place)
    assert closest.point.dtype == np.float64
    apart = np.linalg.norm(closest.point - (points + place), axis=1)
    assert np.abs(apart - wrt.closest_points(centred, points).distance).max() < 1e-6
    a, b = points[:250], points[250:]
    assert (wrt.visible(accel, a + place, b + place) == wrt.visible(centred, a, b)).mean() > 0.99
    points = points[50:]  # not through corners, where rounding decides
    hits, same = accel.closest_hit(3.0 * points + place, -points), centred.closest_hit(3.0 * points, -points)
    assert hits.point.dtype == np.float64 and np.abs(hits.point - place - same.point).max() < 2e-6
    assert np.array_equal(wrt.count_hits(accel, 3.0 * points + place, -points), wrt.count_hits(centred, 3.0 * points, -points))
    theirs = RayMeshIntersector(trimesh.Trimesh(mesh.positions, mesh.faces, process=False))
    assert np.array_equal(theirs.intersects_first(3.0 * points + place, -points), hits.prim_id)


@pytest.mark.parametrize("name", PLACES)
def test_kernels_take_coordinates_of_the_world(name: str) -> None:
    place = np.array(PLACES[name])
    matrix = np.eye(4)
    matrix[:3, 3] = place
    moved = wrt.build(wrt.Mesh(VERTICES, FACES), movable=True)
    moved.move(0, matrix)
    origins, directions = np.float32(EYES + place), np.float32(WAYS)
    for accel in (wrt.build((VERTICES + place, FACES)), moved):
        query = wrt.ray_query(accel)

        @wrt.kernel
        def trace(world: query.World, o: wp.array(dtype=wp.vec3), d: wp.array(dtype=wp.vec3), t: wp.array(dtype=float)):  # type: ignore
            i = wp.tid()
            t[i] = query.closest_hit(world, query.ray(o[i], d[i])).t  # noqa: B023

        t = wp.empty(len(origins), dtype=float, device="cpu")
        rays = (wp.array(each, dtype=wp.vec3, device="cpu") for each in (origins, directions))
        wp.launch(trace, len(origins), [accel.world, *rays, t], device="cpu")
        hits = accel.closest_hit(origins, directions)
        assert np.array_equal(t.numpy(), hits.t) and hits.hit.any()


@pytest.mark.parametrize("name", PLACES)
def test_open3d_scenes_of_float64(name: str) -> None:
    place, ball = np.array(PLACES[name]), icosphere(3)
    points = np.random.default_rng(2).uniform(-1.5, 1.5, (450, 3))
    found = []
    for at in (np.zeros(3), place):
        scene = RaycastingScene()
        for other in (0.0, 5.0):
            scene.add_triangles(ball.vertices + (at + other), ball.faces)
        rays = np.concatenate([3.0 * points + at, -points], axis=1)
        eye = RaycastingScene.create_rays_pinhole(60.0, at, at + [0.0, 0.5, 4.0], (0, 1, 0), 32, 24)
        found.append({**scene.cast_rays(rays), "at": scene.compute_closest_points(points + at)["points"] - at,
                      "lists": scene.list_intersections(rays)["t_hit"], "counts": scene.count_intersections(rays),
                      "distance": scene.compute_signed_distance(points + at), "inside": scene.compute_occupancy(points + at),
                      "blocked": scene.test_occlusions(rays), "seen": scene.cast_rays(eye)["t_hit"]})
    for key, near in found[0].items():
        assert np.allclose(found[1][key], near, rtol=0.0, atol=2e-5 if key in ("primitive_uvs", "primitive_normals") else 2e-6), key


def test_sensors_and_camera_rays_far_away_keep_their_places() -> None:
    place, pose = np.array(PLACES["UTM"]), np.eye(4)
    pose[:3, :3], pose[:3, 3] = np.diag([1, -1, -1]), place + [0, 0, 40]
    accel, intrinsics = wrt.build((VERTICES + place, FACES)), [[60.0, 0, 31.5], [0, 60.0, 23.5], [0, 0, 1]]
    sensor = wrt.sensors.pinhole(intrinsics, (64, 48), pose)
    pose[:3, 3] = 0, 0, 40
    near = wrt.sensors.pinhole(intrinsics, (64, 48), pose)
    hits, same = accel.closest_hit(*sensor.rays), NEAR.closest_hit(*near.rays)
    assert sensor.origins.dtype == np.float64 and near.origins.dtype == np.float32
    assert np.nanmax(np.abs(sensor.depth(hits) - near.depth(same))) < 1e-5
    assert np.nanmax(np.abs(sensor.points(hits) - place - near.points(same))) < 1e-5
    camera = wrt.Camera.look_at(place + [0, 0, 40], place, up=(0, 1, 0))
    origins, directions = wrt.camera_rays(camera, "64x48")
    assert np.array_equal(origins[0], place + [0, 0, 40]) and accel.any_hit(origins, directions).all()


def test_pictures_far_away_show_the_same() -> None:
    place, pixels = np.array(PLACES["Earth-centred"]), []
    for at in (np.zeros(3), place):
        scene = wrt.Scene((wrt.Object(wrt.Mesh(VERTICES + at, FACES)),), (wrt.Sphere(tuple(at + [0, 0, 8]), 3.0),),
                          (wrt.PointLight(tuple(at + [10, 5, 40]), (3000,) * 3),), (wrt.Camera.look_at(at + [0, -40, 30], at),))
        pixels.append(wrt.render(scene, spp=4, size=(64, 48)).pixels)
    assert np.abs(pixels[0] - pixels[1]).mean() < 1e-3 * pixels[0].mean()


def test_files_far_from_0_keep_all_faces(tmp_path: Path) -> None:
    box = trimesh.creation.box((10, 8, 6)).subdivide_to_size(0.4)
    box.vertices += PLACES["UTM"]
    for suffix in ("ply", "obj", "off"):
        data = as_ply(box.vertices, box.faces) if suffix == "ply" else box.export(file_type=suffix, digits=12).encode()
        (tmp_path / f"far.{suffix}").write_bytes(data)
        mesh = wrt.load_mesh(tmp_path / f"far.{suffix}")
        assert mesh.dropped == 0 and len(mesh.faces) == len(box.faces), suffix
        assert np.abs(mesh.positions[mesh.faces] - box.vertices[box.faces]).max() < 1e-6, suffix


def test_float32_far_away_is_warned_about_once_and_near_0_nothing_changes() -> None:
    far = np.float32(VERTICES + PLACES["UTM"])
    with pytest.warns(SceneWarning, match=r"5.80103e\+06 units from 0, where float32 has steps of 0.5 units") as seen:
        wrt.build((far, FACES))
    assert len(seen) == 1
    with pytest.warns(SceneWarning, match="refit: its float32 vertices lie up to"):
        wrt.build((VERTICES, FACES)).refit(far)
    assert not NEAR.origin.any() and NEAR.closest_hit(EYES, WAYS).point.dtype == np.float32
    assert np.array_equal(NEAR.geometry.vertices, np.float32(VERTICES))


def test_unused_vertices_do_not_count(tmp_path: Path) -> None:
    place = np.array(PLACES["UTM"])
    vertices = np.concatenate([VERTICES + place, [[0.0, 0.0, 0.0]]])
    (tmp_path / "far.ply").write_bytes(as_ply(vertices, FACES))
    for mesh in ((vertices, FACES), tmp_path / "far.ply"):
        assert wrt.build(mesh).origin.any()


def test_what_lies_far_from_the_rest_is_told() -> None:
    ball, place = icosphere(2), np.array(PLACES["UTM"])
    near, far = wrt.Mesh(ball.vertices, ball.faces), wrt.Mesh(ball.vertices + place, ball.faces)
    scene = RaycastingScene()
    scene.add_triangles(near.vertices, near.faces)
    scene.add_triangles(far.positions, far.faces)
    movable = wrt.build(wrt.Scene.of([near, near]), movable=True)
    for make in (lambda: wrt.build(wrt.Scene.of([near, far])), lambda: wrt.build([near, far]), lambda: movable.move(0, as_matrix(place)),
                 lambda: scene.cast_rays(np.zeros((1, 6), np.float32) + [0, 0, 5, 0, 0, -1])):
        with pytest.warns(SceneWarning, match="other shapes lie near 0"):
            make()


def as_matrix(place: np.ndarray) -> np.ndarray:
    matrix = np.eye(4)
    matrix[:3, 3] = place
    return matrix


def test_moves_of_small_and_joined_instances() -> None:
    """The origin is as near to a small instance as to a large one, and is 0 again near 0. A joined object keeps its place."""
    place = np.array(PLACES["Earth-centred"])
    small = wrt.build(wrt.Mesh(0.001 * icosphere(3).vertices, icosphere(3).faces), movable=True)
    small.move(0, as_matrix(place))
    assert np.abs(small.origin - place).max() < 1e-4
    small.move(0, np.eye(4))
    assert not small.origin.any() and small.closest_hit((0.0, 0.0, 1.0), (0.0, 0.0, -1.0)).point.dtype == np.float32
    corner = wrt.Mesh(np.float32([[0, 0, 0], [1, 0, 0], [0, 1, 0]]), np.tile([[0, 1, 2]], (260_000, 1)))
    ball = icosphere(2)
    joined = wrt.Object(wrt.Mesh(ball.vertices + np.float32([3000, 0, 0]), ball.faces), name="joined")
    twins = [wrt.Object(corner, transform=as_matrix(np.array([0.0, y, 0.0])), name=name) for name, y in (("a", 5.0), ("b", -5.0))]
    accel = wrt.build(wrt.Scene((joined, *twins)))
    accel.move(object=["a", "b"], matrix=[as_matrix(np.array([3000.0, y, 0.0])) for y in (5.0, -5.0)])
    hits = accel.closest_hit((3000.0, 0.0, 10.0), (0.1, 0.0, -1.0))
    assert np.allclose(hits.point, [3000.0 + 0.1 * hits.t, 0.0, 10.0 - hits.t], atol=1e-3)


def test_point_error_bounds_the_sum_with_the_origin() -> None:
    """At a far place, the error is that at 0 plus at most a step of float64."""
    place = np.array(PLACES["Earth-centred"])
    accel = wrt.build((VERTICES + place, FACES))
    hits = accel.closest_hit(EYES + place, WAYS)
    centred = wrt.build((accel.geometry.vertices, FACES)).closest_hit(EYES + place - accel.origin, WAYS)
    assert np.array_equal(hits.t, centred.t)
    added = hits.point_error[hits.hit].astype(np.float64) - centred.point_error[hits.hit]
    assert (added > 0.0).all() and added.max() < 1e-8


def test_files_that_round_are_told(tmp_path: Path) -> None:
    far = wrt.Mesh(VERTICES + PLACES["UTM"], FACES)
    for suffix in (".ply", ".stl", ".glb"):
        with pytest.warns(SceneWarning, match="steps of 0.5 units"):
            far.save(tmp_path / f"far{suffix}")
    for suffix in (".npz", ".obj", ".off"):
        far.save(tmp_path / f"far{suffix}")
        assert np.abs(wrt.load_mesh(tmp_path / f"far{suffix}").positions - far.positions).max() < 1e-5
