"""The camera and the light that a scene gets where it has none."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import wrt
from tests.refused import refused
from wrt.scene.backgrounds import EnvironmentBackground, GradientBackground
from wrt.scene.cameras import Camera
from wrt.scene.defaults import DARK, FILL, Staging, frame_camera, is_lit, stage
from wrt.scene.lights import DirectionalLight, PointLight
from wrt.scene.materials import Material
from wrt.scene.mesh import Mesh
from wrt.scene.model import Object, Scene, Sphere
from wrt.scene.shapes import quad


def cloud(seed: int, offset=(0.0, 0.0, 0.0), scale=1.0) -> Scene:
    rng = np.random.default_rng(seed)
    vertices = (rng.normal(size=(30, 3)) * rng.uniform(0.1, 5.0, 3)).astype(np.float32)
    transform = np.diag([scale, -scale, scale, 1.0])
    transform[:3, 3] = offset
    mesh = Mesh(vertices, np.arange(30).reshape(10, 3))
    return Scene(objects=(Object(mesh, (Material(),), transform),), spheres=(Sphere(offset, 0.5 * scale, Material()),))


def world_points(scene: Scene) -> np.ndarray:
    thing, sphere = scene.objects[0], scene.spheres[0]
    points = np.c_[thing.mesh.vertices, np.ones(30)] @ thing.transform.T
    direction = np.random.default_rng(0).normal(size=(200, 3))
    direction /= np.linalg.norm(direction, axis=1)[:, None]
    return np.vstack([points[:, :3], sphere.center + sphere.radius * direction])


def filled(scene: Scene, points: np.ndarray, size: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """Where the points are in a picture of frame_camera: lowest and highest (x, y), with the edges of the picture at -1 and 1."""
    camera = frame_camera(scene)
    x, y, z = (np.linalg.inv(camera.camera_to_world) @ np.c_[points, np.ones(len(points))].T)[:3]
    lens = camera.record(size)
    places = np.array([x / -z / lens["tan_x"], y / -z / lens["tan_y"]])
    assert (z < 0.0).all()
    return places.min(axis=1), places.max(axis=1)


@pytest.mark.parametrize("size", [(160, 90), (64, 64), (50, 100)])
@pytest.mark.parametrize("offset, scale", [((0, 0, 0), 1.0), ((1000, -200, 30), 1e-3), ((0, 1e6, 0), 1e4)])
def test_shapes_fill_the_tighter_side_of_any_picture_and_are_centred(size, offset, scale):
    for seed in range(4):
        scene = cloud(seed, offset, scale)
        low, high = filled(scene, world_points(scene), size)
        assert max(high.max(), -low.min()) == pytest.approx(FILL, rel=1e-3)
        assert low == pytest.approx(-high, abs=0.01)


@pytest.mark.parametrize("size", [(160, 90), (50, 100)])
def test_a_sphere_touches_the_same_margin(size):
    center, radius = np.array([3.0, -2.0, 7.0]), 2.5
    scene = Scene(spheres=(Sphere(tuple(center), radius, Material()),))
    direction = np.random.default_rng(0).normal(size=(200_000, 3))
    points = center + radius * direction / np.linalg.norm(direction, axis=1)[:, None]
    low, high = filled(scene, points, size)
    assert max(high.max(), -low.min()) == pytest.approx(FILL, abs=1e-3)


@pytest.mark.parametrize("thin, back", [(0, (1, 0, 0)), (1, (0, 1, 0)), (2, (0, 0, 1))])
def test_a_flat_subject_is_seen_face_on(thin, back):
    sides = [(0, 2, 0), (0, 0, 3)], [(0, 0, -3), (2, 0, 0)], [(2, 0, 0), (0, 3, 0)]
    scene = Scene(objects=(Object(quad((5, 6, 7), *sides[thin]), (Material(),)),))
    camera = frame_camera(scene)
    assert camera.camera_to_world[:3, 2] == pytest.approx(np.array(back))
    assert camera.camera_to_world[:3, 1] == pytest.approx(np.array((0, 0, -1) if thin == 1 else (0, 1, 0)))


def test_a_complete_scene_is_not_touched():
    scene = replace(cloud(3), cameras=(Camera(),), lights=(PointLight((0, 0, 0), (1, 1, 1)),))
    staged, added = stage(scene)
    assert staged is scene and added == []


def test_what_is_missing_is_added_and_said():
    staged, added = stage(cloud(4))
    assert len(staged.cameras) == 1 and len(staged.lights) == 1 and len(added) == 2
    assert "no camera" in added[0] and "no lights" in added[1]
    light, pose = staged.lights[0], staged.cameras[0].camera_to_world
    assert isinstance(light, DirectionalLight) and isinstance(staged.background, GradientBackground)
    along, up, right = (float(np.dot(light.direction, axis)) for axis in (-pose[:3, 2], pose[:3, 1], pose[:3, 0]))
    assert along > 0.7 and up < 0 and right < 0  # it travels into the picture, downwards, from the right
    assert stage(staged)[1] == []


@pytest.mark.parametrize("material, shining", [
    (Material(), False), (Material(kind="mirror"), True), (Material(kind="glass"), True),
    (Material(kind="metallic_roughness", metallic=1.0, roughness=0.1), True),
    (Material(kind="metallic_roughness", metallic=1.0, roughness=1.0), False),
    (Material(kind="metallic_roughness", transmission=1.0, roughness=1.0), True)])
def test_smooth_surfaces_and_glass_get_a_studio_that_can_be_switched_off(material, shining):
    scene = Scene(spheres=(Sphere((0, 0, 0), 1.0, material),))
    staged, added = stage(scene)
    assert isinstance(staged.background, EnvironmentBackground if shining else GradientBackground)
    assert ("studio=False" in added[1]) is shining
    assert isinstance(stage(scene, Staging(studio=False))[0].background, GradientBackground)


def test_the_studio_turns_with_the_camera():
    """A mirror ball looks the same from all around, and reflects the key box in its upper right quarter."""
    pictures = []
    for angle in (0.0, 2.0, -1.3):
        camera = Camera.look_at((4 * np.sin(angle), 1, 4 * np.cos(angle)), (0, 0, 0), fov_y=0.5)
        scene, _ = stage(Scene(spheres=(Sphere((0, 0, 0), 1.0, Material(kind="mirror", albedo=(1, 1, 1))),), cameras=(camera,)))
        pictures.append(wrt.render(scene, size=(20, 20), spp=64).pixels[..., 0])
    assert pictures[1] == pytest.approx(pictures[0], abs=0.15) and pictures[2] == pytest.approx(pictures[0], abs=0.15)
    row, column = np.unravel_index(np.argmax(pictures[0]), (20, 20))
    assert row < 10 <= column and pictures[0].max() > 3.0 * np.median(pictures[0])


@pytest.mark.parametrize("material, lit", [
    (Material(emission=(1, 1, 1)), True), (Material(emission=(1, 1, 1), emits_light=False), False),
    (Material(), False)])
def test_emissive_surfaces_count_as_light_where_they_light_others(material, lit):
    scene = Scene(spheres=(Sphere((0, 0, 0), 1.0, material),))
    assert is_lit(scene) is lit
    assert len(stage(scene)[1]) == (1 if lit else 2)


@pytest.mark.parametrize("seed", range(5))
def test_emission_lights_a_scene_where_it_would_light_a_white_sphere_around_it(seed: int) -> None:
    """By the closed form: all power of a small lamp meets the sphere around the scene, whatever the units."""
    rng = np.random.default_rng(seed)
    scale, two_sided = 10.0 ** rng.uniform(-3, 3), bool(seed % 2)
    far = Sphere((0, 0, 0), scale, Material())  # bounds the scene
    power = DARK * 4.0 * np.pi * scale**2
    edges = rng.normal(size=(2, 3)) * 0.01 * scale
    transform = np.diag([3.0, 3.0, -3.0, 1.0])
    area = 9.0 * np.linalg.norm(np.cross(*edges))
    for factor, lit in ((0.99, False), (1.01, True)):
        radiance = factor * power / area / (1 + two_sided)
        lamp = Material(name="lamp", emission=(radiance,) * 3, two_sided=two_sided)
        quads = Object(quad((0, 0, 0), *edges), (Material(), lamp), transform, face_material=[1, 1])
        scene = Scene(objects=(quads,), spheres=(far,))
        assert is_lit(scene) is lit
        added = stage(scene)[1]
        assert any("no lights but the emission of 'lamp', which is too weak" in each for each in added) is not lit


def test_nothing_to_frame_is_an_error():
    with refused(what="no shapes"):
        stage(Scene())
