"""Pictures against Mitsuba 3, which shares no code with wrt: first hits exactly, light within the noise of both."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

import wrt
from tests.data import data_path
from tests.mitsuba_oracle import aov_mitsuba, render_mitsuba
from wrt.scene.backgrounds import EnvironmentBackground
from wrt.scene.cameras import Camera
from wrt.scene.defaults import frame_camera
from wrt.scene.lights import DirectionalLight, PointLight, SpotLight
from wrt.scene.materials import CONDUCTORS, Checkerboard, Material
from wrt.scene.model import Object, Scene, Sphere
from wrt.scene.settings import Settings
from wrt.scene.shapes import box, quad, torus

pytest.importorskip("mitsuba", reason='needs Mitsuba 3: pip install "wrt[peers]"')

SIZE = (160, 90)
MESHES = {
    "meshes/small/legocar.obj": None,
    "meshes/medium/stanford_bunny.ply": None,
    "meshes/medium/armadillo_86k.obj": None,
    "meshes/medium/sponza_dabrovic.obj": ((-11.0, 6.0, 0.6), (10.0, 4.0, 0.0)),
    "meshes/large/conference_331k.ply": None,
}


@cache
def first_hits(name: str):
    """wrt's and Mitsuba's first hits through the pixels' centres, flat normals, and the rays' directions."""
    mesh = replace(wrt.load_mesh(data_path(name)), normals=None)
    scene = Scene(objects=(Object(mesh, (Material(),)),))
    pose = MESHES[name]
    camera = frame_camera(scene) if pose is None else Camera.look_at(*pose, fov_y=math.radians(70))
    scene = replace(scene, cameras=(camera,))
    film = wrt.render(scene, size=SIZE, spp=1, max_depth=0, aov=("depth", "normal", "prim_id"))
    return film.aov, aov_mitsuba(scene, size=SIZE), wrt.camera_rays(camera, SIZE)[1].reshape(*SIZE[::-1], 3)


def silhouettes(depth: np.ndarray) -> np.ndarray:
    """Pixels next to which (or in which) the depth jumps by more than 1 %, or ends."""
    padded = np.pad(np.where(np.isfinite(depth), depth, 1e30), 1, mode="edge").astype(np.float64)
    shifts = [padded[i : i + depth.shape[0], j : j + depth.shape[1]] for i in range(3) for j in range(3)]
    return np.max(shifts, axis=0) > 1.01 * np.min(shifts, axis=0)


@pytest.mark.parametrize("name", MESHES)
def test_depth_agrees_at_every_pixel_but_silhouettes(name: str) -> None:
    ours, theirs, _ = first_hits(name)
    assert np.isfinite(ours["depth"]).mean() > 0.03
    with np.errstate(invalid="ignore"):
        close = (ours["depth"] == theirs.depth) | (np.abs(ours["depth"] - theirs.depth) <= 1e-5 * theirs.depth)
    edge = silhouettes(theirs.depth)
    assert not (~close & ~edge).any()
    assert (~close).mean() < 1e-3  # silhouettes are many in a fine mesh, but few of their pixels may differ


@pytest.mark.parametrize("name", MESHES)
def test_normals_agree_at_every_pixel_but_edges(name: str) -> None:
    ours, theirs, directions = first_hits(name)
    hit = (ours["prim_id"] >= 0) & (theirs.prim_id >= 0)
    facing = np.where((theirs.geometric_normal * directions).sum(-1, keepdims=True) > 0.0, -1.0, 1.0)
    difference = np.linalg.norm(ours["normal"] - facing * theirs.geometric_normal, axis=-1)
    same = hit & (ours["prim_id"] == theirs.prim_id)
    assert difference[same].max() < 1e-3  # slivers: their flat normal is ill-conditioned in float32
    assert np.percentile(difference[same], 99) < 2e-6
    # Where two triangles lie on one another, Mitsuba takes either, by the processor's instruction set; so does it at an edge.
    one_plane = hit & (difference < 1e-6) & np.isclose(ours["depth"], theirs.depth, rtol=3e-7, atol=0.0)
    assert ((ours["prim_id"] != theirs.prim_id) & ~one_plane).mean() < 2e-3
    assert (ours["prim_id"] <= theirs.prim_id)[one_plane].mean() > 0.99  # wrt takes the lowest index, but for the rounding of t


def placed(mesh: wrt.Mesh, material: Material, *, at: tuple[float, ...], scale: float = 1.0, turn: float = 0.0) -> Object:
    """A mesh turned about x (radians), scaled, and moved."""
    c, s = math.cos(turn), math.sin(turn)
    matrix = np.eye(4)
    matrix[:3, :3] = scale * np.array([[1, 0, 0], [0, c, -s], [0, s, c]])
    matrix[:3, 3] = at
    return Object(mesh, (material,), transform=matrix)


CAMERA = Camera.look_at((0.4, 1.0, 4.0), (0.0, 0.3, 0.0), fov_y=math.radians(40))
GLASS = Material("glass", albedo=(1.0, 1.0, 1.0), ior=1.5)
FLOOR = placed(quad((-1, -1, 0), (2, 0, 0), (0, 2, 0)), Material(albedo=(0.9, 0.9, 0.9), albedo_texture=Checkerboard(scale=4)),
               at=(0.0, -0.7, 0.0), scale=6.0, turn=-math.pi / 2)


def specular_scene() -> Scene:
    """Glass, mirror, gold, absorption and a thin pane under a picture of surroundings; nothing diffuse."""
    image = np.random.default_rng(0).uniform(0.0, 1.0, (8, 16, 3)) ** 3
    gold = dict(zip(("eta", "k"), CONDUCTORS["gold"], strict=True))
    thin = Material("glass", thin=True, albedo=(1, 1, 1))
    pane = placed(quad((-1, -1, 0), (2, 0, 0), (0, 2, 0)), thin, at=(0.2, 1.0, 0.3), scale=0.4)
    ring = placed(torus(), GLASS, at=(-1.1, -0.3, 1.0), scale=0.35, turn=0.4)
    return Scene(
        spheres=(Sphere((-1, 0.2, -0.5), 0.7, GLASS), Sphere((0.6, 0, -0.5), 0.7, Material("mirror", albedo=(0.9, 0.8, 0.7))),
                 Sphere((1.2, 0.3, 0.6), 0.4, Material("conductor", **gold)),
                 Sphere((0, 0.2, 1.2), 0.3, Material("glass", albedo=(0.8, 0.9, 1.0), absorption=(1.0, 2.0, 3.0)))),
        objects=(pane, ring), cameras=(CAMERA,), background=EnvironmentBackground(image, scale=2.0, rotation=0.6),
        settings=Settings(max_depth=20, min_throughput=0.0, filter="box"))


def thin_lens_scene() -> Scene:
    """Diffuse surfaces under one light of each kind, through a lens."""
    lamp = placed(quad((-1, -1, 0), (2, 0, 0), (0, 2, 0)), Material(albedo=(0, 0, 0), emission=(8, 7, 6)), at=(0.5, 2.5, 0.3),
                  scale=0.5, turn=math.pi / 2 + 0.2)
    lights = (PointLight((-2, 3, 2), (6, 6, 6)), SpotLight((2, 3, 2), (-2, -3, -2), (20, 20, 10), 0.1, 0.5),
              DirectionalLight((1, -1, -1), (0.3, 0.3, 0.5)))
    crate = placed(box(), Material(albedo=(0.6, 0.6, 0.2)), at=(-1.6, -0.3, 0.8), scale=0.6)
    return Scene(
        objects=(FLOOR, lamp, crate), lights=lights,
        spheres=(Sphere((-0.8, 0, 0), 0.6, Material(albedo=(0.8, 0.2, 0.2))),
                 Sphere((0.9, 0, -1.5), 0.6, Material(albedo=(0.2, 0.8, 0.2))),
                 Sphere((0.3, -0.2, 1.2), 0.4, Material(albedo=(0.2, 0.2, 0.8)))),
        cameras=(Camera(CAMERA.camera_to_world, CAMERA.fov_y, aperture_radius=0.12, focus_distance=3.6),),
        settings=Settings(max_depth=6, filter="box"))


def whitted_scene() -> Scene:
    """Both together, with an emissive sphere, ambient light and a rough metal."""
    specular, diffuse = specular_scene(), thin_lens_scene()
    lamp = Sphere((0.2, -0.4, 1.5), 0.25, Material(emission=(2, 3, 4), albedo=(0.1, 0.1, 0.1)))
    return replace(specular, objects=diffuse.objects + specular.objects, spheres=(*specular.spheres, lamp),
                   lights=diffuse.lights, ambient=(0.05, 0.06, 0.07),
                   settings=Settings(max_depth=12, min_throughput=0.0, filter="box"))


@pytest.mark.parametrize(("make", "integrator", "size", "spp"), [
    (specular_scene, "volpath", (64, 36), 512), (thin_lens_scene, "direct", (64, 36), 512),
    (whitted_scene, "whitted", (48, 27), 256)])
def test_light_agrees(make, integrator: str, size: tuple[int, int], spp: int) -> None:
    scene = make()
    ours = wrt.render(scene, size=size, spp=spp)
    theirs = render_mitsuba(scene, size=size, spp=spp, integrator=integrator)
    # In the mean to 0.5 %, each colour by itself ...
    np.testing.assert_allclose(ours.pixels.mean((0, 1)), theirs.pixels.mean((0, 1)), rtol=5e-3)
    # ... and per pixel within the noise: the difference over its standard error is about a standard normal number. Its mean
    # is a little above 0 where light comes in rare bright samples, since a pixel that missed them underrates its variance.
    variance = theirs.variance + ours.variance
    noisy = variance > 1e-8
    z = ((ours.pixels - theirs.pixels) / np.sqrt(np.where(noisy, variance, 1.0)))[noisy]
    assert noisy.mean() > 0.2
    assert abs(z.mean()) < 0.2
    assert 0.5 < z.std() < 1.2  # below 1: the variance of a low-discrepancy sequence is less than its samples say
    assert (np.abs(z) > 5.0).mean() < 2e-3
    np.testing.assert_allclose(ours.pixels[~noisy], theirs.pixels[~noisy], rtol=2e-2, atol=1e-3)
