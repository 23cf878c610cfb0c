"""Conversion of cameras between scene and viewport: no camera is mirrored, tilted or scaled."""

from __future__ import annotations

import math
import warnings
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tests.wrt.viewer.test_refine import CAMERA, SCENE
from wrt.core.errors import SceneWarning
from wrt.io.load import load_scene
from wrt.scene.cameras import Camera, CameraKind, FisheyeCamera, OrthographicCamera, PanoramaCamera
from wrt.scene.model import Scene
from wrt.viewer.camera import camera_toml, from_viewport, orbited_point, unit_of, up_of


def random_camera(seed: int, scale: float = 1.0) -> Camera:
    rng = np.random.default_rng(seed)
    pose = np.eye(4)
    pose[:3, :3] = Rotation.random(random_state=seed).as_matrix()
    pose[:3, 3] = rng.normal(size=3) * scale
    return Camera(pose, fov_y=rng.uniform(0.1, 2.5), aperture_radius=0.1 * scale, focus_distance=scale * rng.uniform(0.01, 9.0),
                  blades=5, blade_rotation=rng.uniform(-3.0, 3.0))


@pytest.mark.parametrize("seed", range(8))
def test_a_viewport_has_its_camera(seed: int) -> None:
    """viser's axes are x to the right, y down, z forward; SciPy computes their quaternion."""
    camera, unit = random_camera(seed), 0.25 * (seed + 1)
    right, up, back = camera.camera_to_world[:3, :3].T
    x, y, z, w = Rotation.from_matrix(np.stack([right, -up, -back], axis=1)).as_quat()
    viewport = SimpleNamespace(wxyz=(w, x, y, z), position=camera.camera_to_world[:3, 3] / unit, fov=camera.fov_y)
    found = from_viewport(CAMERA, viewport, unit)
    np.testing.assert_allclose(found.camera_to_world, camera.camera_to_world, atol=1e-12)
    assert found.fov_y == camera.fov_y and found.aperture_radius == CAMERA.aperture_radius


@pytest.mark.parametrize(("seed", "scale"), [(0, 1.0), (1, 1e-4), (2, 1e6), (3, 1.0), (4, 30.0)])
def test_a_scene_file_has_the_camera_that_was_written(tmp_path: Path, seed: int, scale: float) -> None:
    camera = random_camera(seed, scale)
    if seed == 3:
        camera = replace(camera, blades=0, aperture_radius=0.0)
    path = tmp_path / "scene.toml"
    path.write_text("[materials.m]\n[[spheres]]\ncenter = [0, 0, 0]\nradius = 1\nmaterial = \"m\"\n" + camera_toml(camera, "seen"))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", SceneWarning)
        found = load_scene(path).camera("seen")
    np.testing.assert_allclose(found.camera_to_world[:3, :3], camera.camera_to_world[:3, :3], atol=1e-11)
    np.testing.assert_array_equal(found.camera_to_world[:3, 3], camera.camera_to_world[:3, 3])
    for name in ("fov_y", "aperture_radius", "focus_distance", "blades"):
        assert getattr(found, name) == pytest.approx(getattr(camera, name), rel=1e-14)
    assert not camera.blades or math.isclose(found.blade_rotation, camera.blade_rotation, rel_tol=1e-14)


@pytest.mark.parametrize("camera", [OrthographicCamera(height=3.25), FisheyeCamera(fov=3.0), PanoramaCamera()])
def test_other_kinds_turn_and_are_written_too(tmp_path: Path, camera: CameraKind) -> None:
    turned = from_viewport(camera, SimpleNamespace(wxyz=(0.6, 0.0, 0.8, 0.0), position=np.array([1.0, 2.0, 3.0]), fov=0.9), 2.0)
    assert turned.camera_to_world[:3, 3].tolist() == [2.0, 4.0, 6.0] and turned.as_in_files() == camera.as_in_files()
    path = tmp_path / "scene.toml"
    path.write_text('[background]\ntype = "gradient"\n' + camera_toml(turned, "seen"))
    found = load_scene(path).camera("seen")
    assert type(found) is type(camera) and found.as_in_files() == pytest.approx(camera.as_in_files(), rel=1e-14)
    np.testing.assert_allclose(found.camera_to_world, turned.camera_to_world, atol=1e-11)


def test_the_up_axis_of_the_viewport() -> None:
    upright = Camera.look_at((3, 2, 1), (0, 0, 0))
    assert up_of(upright).tolist() == [0.0, 1.0, 0.0]
    for camera in (Camera.look_at((0, 5, 0), (0, 0, 0), up=(0, 0, -1)), Camera.look_at((3, 2, 1), (0, 0, 0), up=(0, 0, 1)),
                   Camera.look_at((3, 2, 1), (0, 0, 0), up=(0, -1, 0))):
        np.testing.assert_array_equal(up_of(camera), camera.camera_to_world[:3, 1])


def test_the_orbited_point() -> None:
    np.testing.assert_allclose(orbited_point(SCENE, CAMERA), CAMERA.camera_to_world[:3] @ (0, 0, -4.0, 1))  # the point in focus
    assert unit_of(SCENE, CAMERA) == pytest.approx(4.0)
    plain = Camera.look_at((3, 2, 50), (0, 0, 0))  # the camera has no focus
    middle = np.mean(SCENE.bounds(), axis=0)
    point = orbited_point(SCENE, plain)
    assert (middle - point) @ plain.camera_to_world[:3, 2] == pytest.approx(0.0, abs=1e-9)
    away = Camera.look_at((3, 2, 50), (3, 2, 60))
    assert unit_of(SCENE, away) == unit_of(Scene(), away) == 1.0
