"""The steered camera: no move tilts, mirrors or scales it, reset returns, and its TOML table has the camera."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tests.wrt.viewer.test_refine import CAMERA, SCENE
from wrt.core.errors import InputError
from wrt.io.load import load_scene
from wrt.scene.cameras import Camera, CameraKind, FisheyeCamera, OrthographicCamera, PanoramaCamera
from wrt.scene.model import Scene
from wrt.viewer.camera import MOVED, Pose, Steering, camera_toml, orbited_point, pose_of

KINDS = (CAMERA, OrthographicCamera(CAMERA.camera_to_world, height=3.25), FisheyeCamera(CAMERA.camera_to_world, fov=3.0),
         PanoramaCamera(CAMERA.camera_to_world))


def random_camera(seed: int, scale: float = 1.0) -> Camera:
    rng = np.random.default_rng(seed)
    pose = np.eye(4)
    pose[:3, :3] = Rotation.random(random_state=seed).as_matrix()
    pose[:3, 3] = rng.normal(size=3) * scale
    return Camera(pose, fov_y=rng.uniform(0.1, 2.5), aperture_radius=0.1 * scale, focus_distance=scale * rng.uniform(0.5, 9.0),
                  blades=5, blade_rotation=rng.uniform(-3.0, 3.0))


def project(pose: Pose, point: np.ndarray) -> np.ndarray:
    """Return the place of a point in a perspective picture, in heights of the picture from its middle: to the right and down."""
    assert isinstance(pose.camera, Camera)
    x, y, z = pose.camera.camera_to_world[:3, :3].T @ (point - pose.camera.camera_to_world[:3, 3])
    return np.array([x, -y]) / (-z * 2.0 * math.tan(0.5 * pose.camera.fov_y))


@pytest.mark.parametrize("camera", KINDS, ids=lambda camera: camera.kind)
def test_moves_keep_the_target_in_the_middle_and_the_horizon_level(camera: CameraKind) -> None:
    rng, pose = np.random.default_rng(1), pose_of(SCENE, camera)
    for _ in range(300):
        kind = str(rng.choice(list(MOVED)))
        pose = MOVED[kind](pose, rng.uniform(-0.3, 0.3, 3).tolist())
        matrix = pose.camera.camera_to_world
        np.testing.assert_allclose(matrix[:3, :3].T @ matrix[:3, :3], np.eye(3), atol=1e-9)
        assert abs(matrix[1, 0]) < 1e-9 and matrix[1, 1] > 0.0 and np.linalg.det(matrix[:3, :3]) > 0.0
        np.testing.assert_allclose(pose.target, matrix[:3] @ (0.0, 0.0, -pose.distance, 1.0), rtol=1e-6, atol=1e-6)


def test_each_move_does_what_it_says() -> None:
    pose = pose_of(SCENE, CAMERA)
    eye = CAMERA.camera_to_world[:3, 3]
    half = MOVED["orbit"](pose, [1.0, 0.0])  # half a turn about +y through the target
    np.testing.assert_allclose(half.camera.camera_to_world[:3, 3], pose.target + (eye - pose.target) * [-1.0, 1.0, -1.0], atol=1e-9)
    assert MOVED["orbit"](pose, [0.0, 0.1]).camera.camera_to_world[1, 3] > eye[1]  # the scene follows the hand: the camera rises
    steep = MOVED["orbit"](pose, [0.0, 50.0]).camera.camera_to_world
    assert math.degrees(math.asin(steep[1, 2])) == pytest.approx(89.0)
    drag = np.array([0.2, -0.1])
    np.testing.assert_allclose(project(MOVED["pan"](pose, drag), pose.target), drag, atol=1e-9)
    near = MOVED["dolly"](pose, [-math.log(2.0)])
    assert near.distance == pytest.approx(0.5 * pose.distance) and np.allclose(near.target, pose.target)
    flat = MOVED["dolly"](pose_of(SCENE, KINDS[1]), [math.log(2.0)]).camera
    assert isinstance(flat, OrthographicCamera) and flat.height == pytest.approx(6.5)
    ahead = MOVED["walk"](pose, [0.0, 0.0, 0.25]).camera.camera_to_world[:3, 3]
    np.testing.assert_allclose(ahead, eye + 0.25 * (pose.target - eye), atol=1e-9)
    with pytest.raises(InputError):
        for _ in range(2000):
            pose = MOVED["walk"](MOVED["dolly"](pose, [2.0]), [1.0, 1.0, 1.0])


def test_reset_returns_to_the_camera_that_was_chosen() -> None:
    top = replace(CAMERA, camera_to_world=Camera.look_at((0, 5, 1), (0, 0, 0)).camera_to_world, name="top")
    steering = Steering(replace(SCENE, cameras=(CAMERA, top)), CAMERA)
    start = steering.pose
    assert steering.names == ("camera 0", "top") and steering.name == "camera 0"
    steering.move("orbit", [0.1, 0.0, 0.0])
    steering.change(fov_y=0.5)
    assert steering.pose is not start and isinstance(steering.pose.camera, Camera) and steering.pose.camera.fov_y == 0.5
    steering.reset()
    assert steering.pose is start
    steering.choose("top")
    steering.move("pan", [0.1, 0.0, 0.0])
    steering.reset()
    assert steering.name == "top" and steering.pose.camera is top


@pytest.mark.parametrize("camera", (random_camera(0), random_camera(1, 1e-4), random_camera(2, 1e6), *KINDS[1:]), ids=str)
def test_a_scene_file_has_the_camera_that_was_written(tmp_path: Path, camera: CameraKind) -> None:
    path = tmp_path / "scene.toml"
    path.write_text('[background]\ntype = "gradient"\n' + camera_toml(pose_of(SCENE, camera), "seen"))
    found = load_scene(path).camera("seen")
    assert type(found) is type(camera) and found.as_in_files() == pytest.approx(camera.as_in_files(), rel=1e-6)
    scale = np.abs(camera.camera_to_world).max()
    np.testing.assert_allclose(found.camera_to_world, camera.camera_to_world, rtol=1e-6, atol=1e-9 * scale)


def test_the_orbited_point() -> None:
    np.testing.assert_allclose(orbited_point(SCENE, CAMERA), CAMERA.camera_to_world[:3] @ (0, 0, -4.0, 1))  # the point in focus
    assert pose_of(SCENE, CAMERA).distance == pytest.approx(4.0)
    plain = Camera.look_at((3, 2, 50), (0, 0, 0))  # the camera has no focus
    middle = np.mean(SCENE.bounds(), axis=0)
    point = orbited_point(SCENE, plain)
    assert (middle - point) @ plain.camera_to_world[:3, 2] == pytest.approx(0.0, abs=1e-9)
    away = Camera.look_at((3, 2, 50), (3, 2, 60))
    assert pose_of(SCENE, away).distance == pose_of(Scene(), away).distance == 1.0
