"""The camera and the light that a scene gets where it has none."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.refused import refused
from wrt.scene.backgrounds import ConstantBackground, GradientBackground
from wrt.scene.cameras import Camera
from wrt.scene.defaults import DARK, bounding_sphere, frame_camera, is_lit, stage
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


@pytest.mark.parametrize("aspect", [16 / 9, 1.0, 0.5])
@pytest.mark.parametrize("offset, scale", [((0, 0, 0), 1.0), ((1000, -200, 30), 1e-3), ((0, 1e6, 0), 1e4)])
def test_whole_sphere_is_in_view_and_fills_it(aspect, offset, scale):
    scene = cloud(1, offset, scale)
    camera = frame_camera(scene, aspect)
    center, radius = bounding_sphere(scene)
    points = world_points(scene)
    assert np.linalg.norm(points - center, axis=1).max() == pytest.approx(radius, rel=1e-3)

    # Directions that graze the sphere must lie within the picture; the tightest of them close to its edge.
    view = np.linalg.inv(camera.camera_to_world)
    distance = np.linalg.norm(camera.camera_to_world[:3, 3] - center)
    to_center = view @ np.append(center, 1.0)
    assert to_center[:2] == pytest.approx([0, 0], abs=1e-6 * distance) and to_center[2] == pytest.approx(-distance)
    tangent = np.tan(np.arcsin(radius / distance))
    edge = np.tan(camera.fov_y / 2) * min(aspect, 1.0)
    assert 0.9 * edge < tangent < edge
    assert camera.fov_y == pytest.approx(np.radians(40))


def test_view_is_three_quarter_from_above():
    back = frame_camera(cloud(2)).camera_to_world[:3, 2]
    assert (back > 0.2).all()  # from the right, from above, from the front (+z)


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


def test_a_background_counts_as_light():
    assert is_lit(replace(cloud(5), background=ConstantBackground((0.1, 0.1, 0.1))))
    assert not is_lit(replace(cloud(5), background=ConstantBackground()))


def test_nothing_to_frame_is_an_error():
    with refused(what="no shapes"):
        stage(Scene())
