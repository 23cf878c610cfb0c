"""Pictures do not depend on the unit of length."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

import wrt
from tests.gltf_files import TRIANGLE
from wrt.scene.backgrounds import ConstantBackground
from wrt.scene.cameras import Camera
from wrt.scene.lights import DirectionalLight, PointLight, SpotLight
from wrt.scene.materials import Material, Texture
from wrt.scene.model import Object, Scene, Sphere
from wrt.scene.settings import Settings
from wrt.scene.shapes import box, icosphere, quad
from wrt.scene.values import BLACK, SMALLEST, WHITE

pytestmark = pytest.mark.filterwarnings("ignore::wrt.core.errors.SceneWarning", "error::RuntimeWarning")
LAMP, CHALK = Material(albedo=BLACK, emission=WHITE, name="lamp"), Material(albedo=WHITE)
SKY = ConstantBackground(WHITE)
PICTURE = Texture(np.random.default_rng(1).integers(90, 166, (8, 8, 4), dtype=np.uint8) | np.uint8(1), srgb=False)
BUMPY = Material(albedo=WHITE, normal_texture=PICTURE)


def moved(y: float) -> np.ndarray:
    matrix = np.eye(4)
    matrix[1, 3] = y
    return matrix


# Parts of a scene above or around a floor of 2 x 2, at the scale s. With the floor alone, the scene is 2 s across.
LIT = {
    "rectangle": lambda s: {"objects": (Object(quad((-s, s, -s), (2 * s, 0, 0), (0, 0, 2 * s)), (LAMP,), name="lamp"),)},
    "mesh": lambda s: {"objects": (Object(icosphere(3, 0.4 * s), (LAMP,), moved(s), name="lamp"),)},
    "sphere": lambda s: {"spheres": (Sphere((0, s, 0), 0.4 * s, LAMP, "lamp"),)},
    "point": lambda s: {"lights": (PointLight((0, s, 0), (s * s,) * 3, "lamp"),)},
    "spot": lambda s: {"lights": (SpotLight((0, s, 0), (0, -1, 0), (s * s,) * 3, 0.2, 0.4, "lamp"),)},
}
UNLIT = {
    "directional": lambda s: {"lights": (DirectionalLight((0.3, -1, 0.2), WHITE),)},
    "background": lambda s: {"background": SKY},
    "lens": lambda s: {"lights": (DirectionalLight((0.3, -1, 0.2), WHITE),), "cameras": (Camera.look_at(
        (0.5 * s, 1.5 * s, 2 * s), (0, 0, 0), fov_y=0.9, aperture_radius=0.1 * s, focus_distance=2 * s),)},
    "glass sphere": lambda s: {"background": SKY, "spheres": (Sphere(
        (0, 0.5 * s, 0), 0.5 * s, Material("glass", albedo=WHITE, absorption=(0.5 / s, 0, 0))),)},
    "glass mesh": lambda s: {"background": SKY, "objects": (Object(
        box((-0.5 * s, 0.1 * s, -0.5 * s), (0.5 * s, s, 0.5 * s)), (Material("glass", albedo=WHITE),)),)},
    "normal map": lambda s: {"lights": (DirectionalLight((1, -1, 0), WHITE),), "objects": (Object(
        quad((-s, 0.1 * s, s), (1.6 * s, 0, -0.8 * s), (-0.8 * s, 0, -1.6 * s)), (BUMPY,)),)},
    "instances": lambda s: {"background": SKY, "lights": (DirectionalLight((1, -1, 0), WHITE),), "objects": tuple(Object(
        PLATE, (BUMPY,), np.diag([s, s, s, 1.0]) @ moved(0.2 + 0.2 * i)) for i in range(3))},
}
PLATE = quad((-0.3, 0, 0.3), (0.5, 0, -0.3), (-0.3, 0, -0.5))


def scene_of(parts: dict, s: float) -> Scene:
    floor = Object(quad((-s, 0, s), (2 * s, 0, 0), (0, 0, -2 * s)), (CHALK,), name="floor")
    camera = Camera.look_at((0.5 * s, 1.5 * s, 2 * s), (0, 0, 0), fov_y=0.9)
    parts = {"cameras": (camera,), **parts, "objects": (floor, *parts.get("objects", ()))}
    return Scene(**parts, settings=Settings(filter="box", max_depth=4))


def picture(scene: Scene) -> np.ndarray:
    film = wrt.render(scene, size=(16, 12), spp=16, instancing="always")
    assert film.stats["not_finite"] == 0
    return film.pixels.astype(np.float64)


@cache
def expected(name: str) -> np.ndarray:
    return picture(scene_of({**LIT, **UNLIT}[name](1.0), 1.0))


def assert_same(name: str, found: np.ndarray) -> None:
    # Scales are no powers of two: roundings differ, and one ray in a thousand falls on the other side of an edge.
    difference = np.abs(found - expected(name)).max(axis=2)
    assert expected(name).max() > 0.02 and np.median(difference) < 1e-5
    assert (difference > 1e-4).mean() < 0.03 and difference.mean() < 1e-3


@pytest.mark.parametrize("name", LIT)
@pytest.mark.parametrize("scale", [0.5001e-15, 1e12])
def test_a_finite_light_is_right_down_to_the_smallest_scene(name: str, scale: float) -> None:
    assert_same(name, picture(scene_of(LIT[name](scale), scale)))


@pytest.mark.parametrize("name", UNLIT)
@pytest.mark.parametrize("scale", [2.0 * SMALLEST, 1e-18])
def test_other_scenes_are_right_down_to_1e_30(name: str, scale: float) -> None:
    assert_same(name, picture(scene_of(UNLIT[name](scale), scale)))


@pytest.mark.parametrize("scale", [2.0 * SMALLEST, 1e-20, 1.0])
def test_a_furnace_of_glass_is_white_at_any_size(scale: float) -> None:
    glass = Sphere((0, 0, 0), scale, Material("glass", albedo=WHITE))
    camera = Camera.look_at((2 * scale, 1.5 * scale, 3 * scale), (0, 0, 0), fov_y=0.6)
    scene = Scene(spheres=(glass,), background=SKY, cameras=(camera,), settings=Settings(filter="box", min_throughput=0.0))
    film = wrt.render(scene, size=(24, 24), spp=4, max_depth=20)
    assert film.pixels.max() <= 1.0 + 1e-5
    assert 1.0 - film.pixels.mean(dtype=np.float64) == pytest.approx(film.stats["lost_throughput_per_sample"], abs=2e-6)


# --- what is small in a scene that is not -----------------------------------------------------------------------------


def test_tiny_shapes_far_from_their_light_are_lit() -> None:
    # The distance of the light counts, not the size of the shapes.
    def lit(scale: float) -> np.ndarray:
        return picture(scene_of({"lights": (PointLight((0, 1e3, 0), (1e6,) * 3),)}, scale))

    assert np.allclose(lit(1e-20), lit(1.0), atol=1e-5) and lit(1.0).max() > 0.3


@pytest.mark.parametrize("scale", [1e-20, 1e-35])
def test_queries_take_any_size(scale: float) -> None:
    mesh = wrt.Mesh((scale * TRIANGLE).astype(np.float32), np.array([[0, 1, 2]], np.int32))
    origin = np.array([[0.25, 0.25, 1.0], [0.75, 0.75, 1.0]]) * scale
    for name in ("bvh", "brute_force", "kdtree"):
        hits = wrt.build(mesh, name).closest_hit(origin.astype(np.float32), np.array([[0, 0, -1.0]] * 2, np.float32))
        assert hits.prim_id.tolist() == [0, -1] and hits.t[0] == pytest.approx(scale, rel=1e-6)
