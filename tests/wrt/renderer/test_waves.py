"""Waves of samples: they give the same film as tracing one ray at a time, and scenes share their kernels."""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import warp as wp

from tests import both_loops
from tests.both_loops import aovs_of, one_ray_at_a_time
from tests.data import ROOT
from wrt.core.device import start
from wrt.io.load import load_scene
from wrt.kernels.loops import wave
from wrt.renderer import launches as waves
from wrt.renderer.film import OF_AOVS, corners
from wrt.renderer.options import Options
from wrt.renderer.plan import plan_of
from wrt.renderer.prepare import Prepared, prepare
from wrt.scene.backgrounds import GradientBackground
from wrt.scene.cameras import Camera
from wrt.scene.lights import DirectionalLight, PointLight
from wrt.scene.materials import Material, Texture
from wrt.scene.model import Object, Scene, Sphere
from wrt.scene.shapes import icosphere, quad

SCENES = ROOT / "scenes"
TILE = (3, 2, 37, 22)


def made() -> Scene:
    """Return a scene with every kind of texture, on triangles and spheres, in rough, clear and blended materials; and with two lights
    whose shadow rays pass through clear surfaces."""
    rng = np.random.default_rng(7)

    def picture(height: int, width: int, **rest: Any) -> Texture:
        return Texture(rng.integers(0, 256, (height, width, 4), dtype=np.uint8), **rest)

    bumps = Texture(rng.integers([60, 60, 200, 255], [200, 200, 256, 256], (8, 8, 4), dtype=np.uint8), srgb=False)
    parameters, share = picture(16, 8, srgb=False, wrap=("mirror", "clamp")), picture(4, 4, srgb=False)
    painted = Material("metallic_roughness", albedo=(0.9, 0.8, 0.7), metallic=0.7, roughness=0.8, transmission=0.6,
                       albedo_texture=picture(8, 8), metallic_roughness_texture=parameters, transmission_texture=share,
                       normal_texture=bumps, normal_scale=1.5)
    leaf = Material("metallic_roughness", albedo_texture=picture(5, 7, wrap=("clamp", "mirror")), emission=(0.1, 0.2, 0.1),
                    emission_texture=picture(3, 3), emits_light=False, alpha=0.9, alpha_mode="blend")
    plain = Material(albedo=(0.6, 0.6, 0.6))
    ball, pane = icosphere(3), quad((-3, 0, -1.5), (1.5, 0, 0), (0, 1.5, 0.5))
    ball = replace(ball, uvs=(3.0 * ball.vertices[:, :2]).astype(np.float32), normals=ball.vertices)
    pane = replace(pane, uvs=np.float32([[-1, -1], [2, -1], [2, 2], [-1, 2]]))
    floor = quad((-6, -1, 6), (12, 0, 0), (0, 0, -12))
    floor = replace(floor, uvs=(floor.vertices[:, [0, 2]] * 0.7).astype(np.float32))
    objects = (Object(ball, (painted,)), Object(pane, (leaf,)),
               Object(floor, (replace(plain, albedo_texture=picture(32, 16), normal_texture=bumps),)))
    spheres = tuple(Sphere((2.2, -0.2, z), 0.8, material) for z, material in ((0.5, painted), (-1.5, leaf), (2.5, plain)))
    lights = (PointLight((3.0, 4.0, 2.0), (20.0, 20.0, 20.0)), DirectionalLight((-1.0, -2.0, -0.5), (1.0, 1.0, 1.0)))
    camera = Camera.look_at((0.5, 1.5, 6.0), (0.3, -0.2, 0.0), fov_y=0.8)
    sky = GradientBackground((0.2, 0.2, 0.2), (0.5, 0.6, 0.8))
    return Scene(objects=objects, spheres=spheres, lights=lights, background=sky, cameras=(camera,))


def prepared(name: str, aov: tuple[str, ...] = (), **settings: Any) -> Prepared:
    scene = made() if name == "made" else load_scene(SCENES / f"{name}.toml")
    scene = scene.with_settings(size=(48, 27), **settings)
    return prepare(plan_of(scene, Options(device="cpu", threads=1, crop=corners(TILE), aov=aov)), start("cpu"))


def film_of(ready: Prepared, *parts: tuple[int, int], groups: int = 1) -> dict[str, np.ndarray]:
    return both_loops.film_of(ready, TILE, *parts, groups=groups)


def assert_same(one: dict[str, np.ndarray], other: dict[str, np.ndarray]) -> None:
    assert one.keys() == other.keys()
    for name, values in one.items():
        np.testing.assert_array_equal(values.view(np.uint8), other[name].view(np.uint8), err_msg=name)


# Features beside plain surfaces: shadow rays through glass and panes, cut-outs, instances, an image circle, a picture of the
# sky. Each slow one compiles the loop for its scene; tests/test_bits.py holds all their pixels.
@pytest.mark.parametrize(("name", "settings"), [
    ("tinted_shadows", {"max_depth": 3}),
    pytest.param("thin_glass", {"max_depth": 2}, marks=pytest.mark.slow),
    pytest.param("blend", {}, marks=pytest.mark.slow),
    pytest.param("cutout", {"max_depth": 0}, marks=pytest.mark.slow),
    pytest.param("instances", {"max_depth": 1}, marks=pytest.mark.slow),
    pytest.param("textures", {}, marks=pytest.mark.slow),
    pytest.param("frosted", {}, marks=pytest.mark.slow),
    ("made", {"max_depth": 2, "glass_shadows": "tinted"}),
    ("fisheye", {}),
    ("glass_sky", {"max_depth": 2}),
])
def test_the_film_is_that_of_one_ray_at_a_time(name: str, settings: dict[str, Any], monkeypatch: pytest.MonkeyPatch) -> None:
    ready = prepared(name, **settings)
    expected = film_of(one_ray_at_a_time(ready), (0, 5))
    assert expected["rays"].min() > 0 or name == "fisheye"
    if settings:  # some rays were cut
        assert expected["cut_depth"].sum() + expected["cut_throughput"].sum() > 0 and expected["lost of group 0"].sum() > 0.0
    assert_same(film_of(ready, (0, 5)), expected)
    assert_same(film_of(ready, (0, 1), (1, 4)), expected)
    monkeypatch.setattr(waves, "CAPACITY", 67)
    assert_same(film_of(without_buffers(ready), (0, 5)), expected)


def without_buffers(ready: Any) -> Any:
    """Return the prepared scene, whose threads make new working memory."""
    ready.waves.buffers.free.clear()
    return ready


def test_more_samples_a_pixel_than_a_wave_has(monkeypatch: pytest.MonkeyPatch) -> None:
    ready = prepared("fisheye")
    expected = film_of(ready, (0, 150))
    monkeypatch.setattr(waves, "CAPACITY", 64)
    assert_same(film_of(without_buffers(ready), (0, 150)), expected)


def test_more_samples_a_pixel_than_camera_rays_are_made_at_a_time() -> None:
    assert wave.FRESH < 2100 < waves.CAPACITY
    ready = prepared("fisheye")
    assert_same(film_of(ready, (0, 2100)), film_of(ready, (0, 1000), (1000, 1100)))


def filled_with(byte: int) -> Callable[[int, Any], Any]:
    """Return a stand-in for waves.empty, which fills each array with one byte value."""

    def filled(n: int, dtype: Any) -> Any:
        array = wp.empty(n, dtype=dtype, device="cpu")
        ctypes.memset(array.ptr, byte, array.capacity)
        return array

    return filled


@pytest.mark.parametrize("name", ["fisheye", "tinted_shadows", "glass_sky", "made"])
def test_nothing_is_read_before_it_is_written(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Buffers are not cleared between waves, so that they contain values of the last wave."""
    ready = prepared(name)
    films = [film_of(ready, (0, 3))]
    for byte in (0xCD, 0xFF, 0x01):
        monkeypatch.setattr(waves, "empty", filled_with(byte))
        films.append(film_of(without_buffers(ready), (0, 3)))
    for film in films[1:]:
        assert_same(films[0], film)


def test_groups_have_samples_of_their_own() -> None:
    ready = prepared("fisheye")
    film = film_of(ready, (0, 2), groups=2)
    assert_same(film, film_of(one_ray_at_a_time(ready), (0, 2), groups=2))
    assert (film["mean of group 0"] != film["mean of group 1"]).any()


@pytest.mark.parametrize("name", ["fisheye", pytest.param("cutout", marks=pytest.mark.slow)])
def test_aovs_are_those_of_one_ray_at_a_time(name: str) -> None:
    ready = prepared(name, aov=tuple(OF_AOVS))
    films = []
    for way in (ready, one_ray_at_a_time(ready)):
        films.append(aovs_of(way, TILE))
    assert_same(*films)
    assert (films[0]["prim_id"] >= 0).any() and ((films[0]["prim_id"] < 0).any() or name == "cutout")


def test_scenes_share_what_they_have_in_common() -> None:
    """Scenes share the traversal of a structure, and a different max_depth needs no new kernel."""
    of = {name: plan_of(load_scene(SCENES / f"{name}.toml"), Options(device="cpu")).wave_kernels
          for name in ("whitted", "glass_slab", "lens")}
    for name in ("closest_hit", "any_hit", "loop"):
        assert len({getattr(kernels, name) for kernels in of.values()}) == 1, name
    assert of["whitted"].begin is of["glass_slab"].begin is not of["lens"].begin
    assert len({kernels.shade for kernels in of.values()}) == 3
    deeper = load_scene(SCENES / "whitted.toml").with_settings(max_depth=64)
    assert plan_of(deeper, Options(device="cpu")).wave_kernels == of["whitted"]
