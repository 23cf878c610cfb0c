"""Features that a scene turns on, and the tables of pixel filters."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from wrt.kernels.shade.features import Features
from wrt.renderer.film import filter_icdf
from wrt.renderer.plan import STACK_STEP, describe, features_of, switches
from wrt.scene.backgrounds import ConstantBackground, EnvironmentBackground, GradientBackground
from wrt.scene.cameras import Camera
from wrt.scene.lights import DirectionalLight, PointLight, SpotLight
from wrt.scene.materials import Checkerboard, Material, Texture
from wrt.scene.model import Object, Scene, Sphere
from wrt.scene.settings import FILTERS, Settings
from wrt.scene.shapes import icosphere, quad

PICTURE = Texture(np.zeros((2, 2, 4), np.uint8))
BLACK = Material(albedo=(0.0, 0.0, 0.0))
GREY = Material()
POINT = PointLight((0, 1, 0), (1, 1, 1))
SKY = ConstantBackground((1.0, 1.0, 1.0))


def scene_of(*materials: Material, mesh: Any = None, spheres: tuple[Material, ...] = (), **rest: Any) -> Scene:
    rest.setdefault("settings", Settings(filter="box"))
    return Scene(objects=tuple(Object(mesh or quad(), (m,)) for m in materials),
                 spheres=tuple(Sphere((0, 0, 0), 1.0, m) for m in spheres), **rest)


def on(scene: Scene, camera: Camera | None = None) -> set[str]:
    """Return the features that a scene turns on, without "diffuse", which nearly every scene here has."""
    on_off = switches(features_of(scene, camera or Camera()))
    return {name for name, value in on_off.items() if value and name != "diffuse"}


def test_a_black_opaque_scene_needs_nothing() -> None:
    assert on(scene_of(BLACK)) == set() and on(scene_of()) == set()
    assert on(scene_of(BLACK, lights=(POINT,), background=SKY)) == set()  # a black surface reflects no light
    assert features_of(scene_of(BLACK), Camera()) == Features(materials=("diffuse",))
    assert features_of(scene_of(), Camera()) == Features()


@pytest.mark.parametrize(("scene", "expected"), [
    (scene_of(GREY), set()),
    (scene_of(GREY, lights=(POINT,)), {"point_lights"}),
    (scene_of(GREY, lights=(DirectionalLight((0, -1, 0), (1, 1, 1)),)), {"directional_lights"}),
    (scene_of(GREY, lights=(SpotLight((0, 1, 0), (0, -1, 0), (1, 1, 1)),)), {"spot_lights"}),
    (scene_of(GREY, Material(emission=(1, 1, 1))), {"emission", "mesh_lights"}),
    (scene_of(GREY, Material(emission=(1, 1, 1), emits_light=False)), {"emission"}),
    (scene_of(GREY, spheres=(Material(emission=(1, 1, 1)),)), {"emission", "sphere_lights", "spheres"}),
    (scene_of(GREY, background=SKY), {"sky_light"}),
    (scene_of(GREY, background=GradientBackground()), {"gradient", "sky_light"}),
    (scene_of(GREY, background=GradientBackground((0, 0, 0), (0, 0, 0))), {"gradient"}),
    (scene_of(BLACK, background=EnvironmentBackground(np.ones((1, 2, 3), np.float32))), {"environment"}),
    (scene_of(GREY, background=EnvironmentBackground(np.ones((1, 2, 3), np.float32))), {"environment", "sky_light"}),
    (scene_of(GREY, ambient=(0.1, 0, 0)), {"ambient"}),
    (scene_of(GREY, ambient=(0.1, 0, 0), ambient_occlusion=0.5), {"ambient_occlusion"}),
    (scene_of(BLACK, ambient=(0.1, 0, 0), ambient_occlusion=0.5), {"ambient"}),
    (scene_of(GREY, ambient_occlusion=0.5), set()),
    (scene_of(Material("mirror")), {"mirror", "reflection"}),
    (scene_of(Material("mirror"), lights=(POINT,), background=SKY), {"mirror", "reflection"}),
    (scene_of(Material("conductor")), {"conductor", "reflection"}),
    (scene_of(Material("conductor", roughness=0.5), lights=(POINT,)),
     {"conductor", "reflection", "rough", "highlight", "point_lights"}),
    (scene_of(Material("glass")), {"glass", "reflection", "refraction"}),
    (scene_of(Material("glass", absorption=(0, 1, 0))), {"glass", "reflection", "refraction", "absorption"}),
    (scene_of(Material("glass", thin=True), GREY),
     {"glass", "reflection", "refraction", "thin_glass", "transparent_shadows"}),
    (scene_of(Material("glass"), GREY, settings=Settings(filter="box", glass_shadows="tinted")),
     {"glass", "reflection", "refraction", "tinted_shadows", "transparent_shadows"}),
    (scene_of(Material("glass"), settings=Settings(filter="box", fresnel="schlick")),
     {"glass", "reflection", "refraction", "schlick"}),
    (scene_of(Material("metallic_roughness", albedo=(0, 0, 0))), {"metallic_roughness", "reflection"}),
    (scene_of(Material("metallic_roughness", albedo=(0, 0, 0), transmission=0.5)),
     {"metallic_roughness", "reflection", "refraction", "transmission"}),
    (scene_of(Material("metallic_roughness", albedo=(0, 0, 0), specular_factor=0.5)), {"metallic_roughness", "reflection", "specular"}),
    (scene_of(Material("metallic_roughness", albedo=(0, 0, 0), clearcoat=0.5)), {"metallic_roughness", "reflection", "clearcoat"}),
    (scene_of(Material("metallic_roughness", albedo=(0, 0, 0), clearcoat_roughness=0.5)), {"metallic_roughness", "reflection"}),
    (scene_of(Material("metallic_roughness", albedo=(0, 0, 0), clearcoat=0.5, clearcoat_roughness=0.5, clearcoat_texture=PICTURE)),
     {"metallic_roughness", "reflection", "clearcoat", "rough", "highlight", "textures"}),
    (scene_of(Material(clearcoat=0.5, specular_factor=0.5)), set()),  # its kind of material uses neither
    (scene_of(Material(specular=(0.1, 0, 0))), {"highlight"}),
    (scene_of(Material(alpha_mode="mask")), {"cutout"}),
    (scene_of(Material(alpha_mode="blend"), lights=(POINT,)), {"blend", "point_lights", "transparent_shadows"}),
    (scene_of(BLACK, mesh=icosphere(0)), {"smooth"}),
    (scene_of(Material(albedo_texture=PICTURE)), {"textures"}),
    (scene_of(Material(albedo_texture=Checkerboard())), {"checkerboards"}),
    (scene_of(Material("metallic_roughness", albedo=(0, 0, 0), metallic_roughness_texture=PICTURE)),
     {"metallic_roughness", "reflection", "textures", "parameter_textures"}),
    (scene_of(Material(metallic_roughness_texture=PICTURE)), {"textures"}),  # its kind of material does not use this texture
    (scene_of(Material(normal_texture=PICTURE)), {"textures", "normal_maps"}),
    (scene_of(BLACK, settings=Settings(filter="gaussian")), {"filter"}),
    (scene_of(BLACK, settings=Settings(filter="box", sampler="independent")), {"independent"}),
    (scene_of(BLACK, settings=Settings(filter="box", fresnel="schlick", glass_shadows="tinted")), set()),
])
def test_each_thing_turns_on_its_switches_and_no_other(scene: Scene, expected: set[str]) -> None:
    assert on(scene) == expected


def test_the_camera_decides_on_lens_and_blades() -> None:
    scene = scene_of(BLACK)
    assert on(scene, Camera(aperture_radius=0.1)) == {"lens"}
    assert on(scene, Camera(aperture_radius=0.1, blades=5)) == {"lens", "blades"}
    assert on(scene, Camera(blades=5)) == set()  # a pinhole has no blades


def test_depth_changes_the_kernel_only_where_many_more_rays_wait() -> None:
    for material, waits in ((GREY, False), (Material("mirror"), False), (Material("glass"), True)):
        by_depth = {depth: features_of(scene_of(material, settings=Settings(max_depth=depth)), Camera()) for depth in range(65)}
        assert (by_depth[2] != by_depth[20]) == waits
        assert by_depth[2] == by_depth[8] == by_depth[14]  # neighbouring depths share a kernel
        assert len(set(by_depth.values())) == (5 if waits else 1)
        assert len({replace(features, stack_size=1) for features in by_depth.values()}) == 1


KINDS = [GREY, Material("mirror"), Material("glass"), Material(alpha_mode="blend"), Material("conductor"),
         Material("metallic_roughness", transmission=1.0), Material("glass", alpha_mode="blend")]


@settings(max_examples=60, deadline=None)
@given(st.sets(st.sampled_from(range(len(KINDS)))), st.integers(0, 64))
def test_pending_rays_always_fit_on_the_stack(chosen: set[int], max_depth: int) -> None:
    features = features_of(scene_of(*(KINDS[i] for i in chosen), settings=Settings(max_depth=max_depth)), Camera())
    children = features.reflection + features.refraction + features.blend
    # The integrator's loop if every ray has all its children: the last child pushed is popped first, and goes deepest. The ray that
    # goes straight on is pushed first and does not increase the depth (a few in a row here).
    stack, most = [(0, 0)], 1
    visited = 0
    while stack and visited < 3000:
        depth, passed = stack.pop()
        visited += 1
        if features.blend and passed < 3:
            stack.append((depth, passed + 1))
        if depth < max_depth:
            stack += [(depth + 1, 0)] * (children - features.blend)
        most = max(most, len(stack))
    assert most <= features.stack_size < most + STACK_STEP + 3 and (features.stack_size == 1 or children > 1)


@pytest.mark.parametrize("name", FILTERS)
def test_filters_by_their_inverse_distribution(name: str) -> None:
    table = filter_icdf(name).astype(np.float64)
    if name == "box":
        assert not table.any()
        return
    assert (np.diff(table) > 0.0).all() and np.allclose(table, -table[::-1], atol=1e-6)
    assert table[0] == -1.5 and table[-1] == 1.5
    # Samples drawn with the table have the filter's variance, which the test integrates independently.
    x = np.linspace(-1.5, 1.5, 200_001)
    if name == "gaussian":
        density = np.exp(-(x**2) / (2.0 * 0.5**2)) - np.exp(-(1.5**2) / (2.0 * 0.5**2))
    else:
        n = (x + 1.5) / 3.0
        density = sum(a * np.cos(2.0 * np.pi * k * n) * (-1) ** k for k, a in enumerate((0.35875, 0.48829, 0.14128, 0.01168)))
    assert density.min() > -1e-9
    density /= density.sum()
    xi = (np.arange(100_000) + 0.5) / 100_000
    drawn = np.interp(xi * (len(table) - 1), np.arange(len(table)), table)
    assert drawn.std() == pytest.approx(np.sqrt((density * x**2).sum()), rel=5e-4)
    for edge in (-1.0, -0.3, 0.2, 0.9):
        assert (drawn < edge).mean() == pytest.approx(density[x < edge].sum(), abs=2e-3)


def test_describe_counts_and_names() -> None:
    ball = icosphere(1)
    named = Material("glass", name="bottle")
    scene = Scene(objects=(Object(ball, (named,)), Object(ball, (GREY,), np.diag([2.0, 2.0, 2.0, 1.0]))),
                  spheres=(Sphere((0, 5, 0), 1.0, named),), lights=(POINT,), cameras=(Camera(name="front"), Camera()))
    found = describe(scene)
    assert (found["triangles"], found["unique_triangles"], found["objects"], found["spheres"]) == (160, 80, 2, 1)
    assert found["materials"] == ["bottle (glass)", "1 (diffuse)"] and found["cameras"] == ["front", "1"]
    assert np.allclose(found["bounds_high"], [2.0, 6.0, 2.0], atol=0.1)
    assert found["features"] == switches(features_of(scene, scene.camera()))
