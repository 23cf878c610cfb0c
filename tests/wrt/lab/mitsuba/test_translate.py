"""The translation to Mitsuba against closed forms and float64 NumPy: wrt's own kernels make no more here than the rays of AOVs."""

from __future__ import annotations

import math
import sys
from dataclasses import replace

import numpy as np
import pytest

from tests.refused import refused
from wrt.scene.backgrounds import ConstantBackground, GradientBackground
from wrt.scene.cameras import Camera, FisheyeCamera, OrthographicCamera
from wrt.scene.lights import PointLight
from wrt.scene.materials import Material, Texture
from wrt.scene.mesh import Mesh
from wrt.scene.model import Object, Scene, Sphere
from wrt.scene.settings import Settings

pytest.importorskip("mitsuba", reason='needs Mitsuba 3 (pip install "wrt[peers]")')

from tests.mitsuba_oracle import aov_mitsuba, render_mitsuba, to_mitsuba
from wrt.lab.mitsuba.translate import mitsuba

CORNERS = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], np.float32)
TWO_FACES = np.array([[0, 1, 2], [0, 2, 3]], np.int32)
CORNER_UVS = np.array([[0, 1], [1, 1], [1, 0], [0, 0]], np.float32)  # (0, 0) is the top left
QUAD = Mesh(CORNERS, TWO_FACES, uvs=CORNER_UVS)
FRONT = Camera.look_at((0, 0, 3), (0, 0, 0), fov_y=math.radians(40))
OBLIQUE = Camera.look_at((1.0, 0.7, 2.5), (0.2, 0.1, 0.0), up=(0.2, 1.0, 0.1), fov_y=math.radians(50))
BLACK_MATERIAL = Material(albedo=(0, 0, 0))
WHITE_SKY = ConstantBackground((1, 1, 1))


def placed(x: float = 0.0, y: float = 0.0, z: float = 0.0, scale: float = 1.0) -> np.ndarray:
    matrix = np.diag([scale, scale, scale, 1.0])
    matrix[:3, 3] = x, y, z
    return matrix


def glowing(color, **rest) -> Material:
    return Material(albedo=(0, 0, 0), emission=color, emits_light=False, **rest)


def rotation(axis: int, angle: float) -> np.ndarray:
    i, j = [(1, 2), (2, 0), (0, 1)][axis]
    matrix = np.eye(4)
    matrix[i, i] = matrix[j, j] = math.cos(angle)
    matrix[i, j], matrix[j, i] = -math.sin(angle), math.sin(angle)
    return matrix


def camera_rays(camera: Camera, size) -> tuple[np.ndarray, np.ndarray]:
    """Origin (3,) and unit directions (H, W, 3), float64."""
    width, height = size
    top = math.tan(0.5 * camera.fov_y)
    x = (2.0 * (np.arange(width) + 0.5) / width - 1.0) * top * width / height
    y = (1.0 - 2.0 * (np.arange(height) + 0.5) / height) * top
    directions = np.stack(np.broadcast_arrays(x[None, :], y[:, None], -1.0), axis=-1) @ camera.camera_to_world[:3, :3].T
    return camera.camera_to_world[:3, 3].copy(), directions / np.linalg.norm(directions, axis=-1, keepdims=True)


def plane_hit(camera: Camera, size) -> np.ndarray:
    """Where the rays through the pixel centres meet the plane z = 0, (H, W, 3) float64."""
    origin, directions = camera_rays(camera, size)
    return origin + directions * (-origin[2] / directions[..., 2])[..., None]


def center_pixel(scene: Scene, spp: int = 256, **options) -> tuple[np.ndarray, np.ndarray]:
    """Mean and standard error of a single pixel's worth of very narrow view."""
    narrow = replace(FRONT, fov_y=1e-3)
    result = render_mitsuba(scene, narrow, size=(1, 1), spp=spp, **options)
    return result.pixels[0, 0], np.sqrt(result.variance[0, 0])


# --- the module -------------------------------------------------------------------------------------------------------


def test_missing_mitsuba_is_an_input_error(monkeypatch):
    monkeypatch.setitem(sys.modules, "mitsuba", None)
    with refused(what="Mitsuba 3"):
        to_mitsuba(Scene(cameras=(FRONT,)))


def test_the_callers_variant_is_given_back():
    import mitsuba as mi

    mi.set_variant("scalar_spectral")
    with mitsuba() as inner:
        assert inner.variant() == "scalar_rgb"
    assert mi.variant() == "scalar_spectral"


# --- camera and film --------------------------------------------------------------------------------------------------


def test_an_orthographic_camera_shows_a_ball_where_it_is_and_as_large_as_it_is():
    camera = OrthographicCamera.look_at((1.0, 0.7, 9.5), (0.2, 0.1, 0.0), height=4.0)
    right, up = camera.camera_to_world[:3, :2].T
    center = np.array([0.2, 0.1, 0.0]) + 0.75 * right - 0.5 * up
    glow = Material(albedo=(0, 0, 0), emission=(1, 1, 1))
    scene = Scene(spheres=(Sphere(tuple(center), 0.6, glow),), cameras=(camera,))
    pixels = render_mitsuba(scene, size=(48, 32), spp=64, integrator="path").pixels[..., 0]
    x = ((np.arange(48) + 0.5) / 48 - 0.5) * 6.0
    y = (0.5 - (np.arange(32) + 0.5) / 32) * 4.0
    assert pixels.sum() * (4.0 / 32) ** 2 == pytest.approx(np.pi * 0.6**2, rel=0.01)
    found = [(pixels * x).sum() / pixels.sum(), (pixels.T * y).sum() / pixels.sum()]
    assert found == pytest.approx([0.75, -0.5], abs=0.01)
    aov = aov_mitsuba(scene, size=(48, 32))
    assert np.isfinite(aov.depth).sum() * (4.0 / 32) ** 2 == pytest.approx(np.pi * 0.6**2, rel=0.05)


def test_a_camera_that_mitsuba_has_not_is_refused_but_its_rays_can_be_traced():
    scene = Scene(spheres=(Sphere((0, 0, -5), 1.0, Material()),), cameras=(FisheyeCamera(fov=1.0, name="eye"),))
    with refused(what="not translatable exactly", place="Mitsuba: camera 'eye'"):
        render_mitsuba(scene, size=(8, 8), spp=1)
    depth = aov_mitsuba(scene, size=(33, 33)).depth
    assert depth[16, 16] == pytest.approx(4.0) and np.isinf(depth[0, 0])


# --- rays and AOVs ----------------------------------------------------------------------------------------------------


def test_sphere_aovs_are_the_analytic_ones():
    center, radius, size = np.array([0.3, -0.2, 0.4]), 0.7, (64, 48)
    wall = Object(QUAD, (Material(),), transform=placed(z=-9))
    scene = Scene(objects=(wall,), spheres=(Sphere(center, radius, Material()),), cameras=(OBLIQUE,))
    aov = aov_mitsuba(scene, size=size)
    origin, directions = camera_rays(OBLIQUE, size)
    along = directions @ (center - origin)
    squared = radius**2 - ((center - origin) @ (center - origin) - along**2)
    seen = squared > 1e-4
    depth = along - np.sqrt(np.maximum(squared, 0))
    np.testing.assert_allclose(aov.depth[seen], depth[seen], rtol=2e-5)
    assert (aov.object_id[seen] == 1).all() and (aov.prim_id[seen] == 2).all()
    assert (aov.object_id[squared < -1e-4] != 1).all()
    normal = (origin + depth[..., None] * directions - center) / radius
    np.testing.assert_allclose(aov.geometric_normal[seen], normal[seen], atol=1e-4)
    np.testing.assert_allclose(aov.position[seen], (origin + depth[..., None] * directions)[seen], atol=2e-5)
    u = 0.5 + np.arctan2(-normal[..., 2], normal[..., 0]) / (2 * np.pi)  # from -x around +y
    v = np.arccos(np.clip(normal[..., 1], -1, 1)) / np.pi
    inner = seen & (u > 0.01) & (u < 0.99)
    np.testing.assert_allclose(aov.uv[inner], np.stack([u, v], -1)[inner], atol=2e-3)


@pytest.mark.parametrize("mirrored", [False, True])
def test_objects_are_placed_and_keep_their_outside(mirrored):
    matrix = rotation(1, 0.4) @ np.diag([-1.2 if mirrored else 1.2, 0.6, 0.9, 1.0]) @ rotation(0, 0.3)
    matrix[:3, 3] = 0.1, 0.2, -0.3
    normals = np.array([[0.3, 0, 1], [-0.3, 0.2, 1], [0, 0.4, 1], [0.1, 0, 1]])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    mesh = Mesh(CORNERS, TWO_FACES, normals=normals, uvs=CORNER_UVS)
    wall = Object(QUAD, (Material(),), transform=placed(z=-50))
    scene = Scene(objects=(wall, Object(mesh, (Material(),), transform=matrix)), cameras=(FRONT,))
    aov = aov_mitsuba(scene, size=(48, 32))
    seen = aov.object_id == 1
    assert seen.sum() > 200
    # The inverse transform takes hits back onto the quad, where uv and normals are known.
    local = (aov.position[seen] - matrix[:3, 3]) @ np.linalg.inv(matrix[:3, :3]).T
    np.testing.assert_allclose(local[:, 2], 0, atol=1e-5)
    np.testing.assert_allclose(aov.uv[seen], np.stack([(local[:, 0] + 1) / 2, (1 - local[:, 1]) / 2], -1), atol=1e-5)
    outside = np.linalg.inv(matrix[:3, :3]).T @ [0, 0, 1]
    np.testing.assert_allclose(aov.geometric_normal[seen], np.tile(outside / np.linalg.norm(outside), (seen.sum(), 1)),
                               atol=1e-5)
    face = aov.prim_id[seen] - 2
    upper = local[:, 1] > local[:, 0]
    clear = abs(local[:, 1] - local[:, 0]) > 1e-3
    np.testing.assert_array_equal(face[clear], upper[clear].astype(int))
    world_normals = normals @ np.linalg.inv(matrix[:3, :3])
    world_normals /= np.linalg.norm(world_normals, axis=1, keepdims=True)
    a, b, c = (world_normals[TWO_FACES[upper.astype(int), k]] for k in range(3))
    x, y = (local[:, 0] + 1) / 2, (local[:, 1] + 1) / 2
    mix = np.where(upper[:, None], (1 - y)[:, None] * a + x[:, None] * b + (y - x)[:, None] * c,
                   (1 - x)[:, None] * a + (x - y)[:, None] * b + y[:, None] * c)
    mix /= np.linalg.norm(mix, axis=1, keepdims=True)
    np.testing.assert_allclose(aov.shading_normal[seen][clear], mix[clear], atol=1e-4)


def test_a_zero_normal_is_flat_there():
    tilted = np.tile(np.array([[0.6, 0, 0.8]], np.float32), (4, 1))
    tilted[:3] = 0  # face 0 has no normals at all; face 1 has one at its last corner
    scene = Scene(objects=(Object(Mesh(CORNERS, TWO_FACES, normals=tilted), (Material(),)),), cameras=(FRONT,))
    aov = aov_mitsuba(scene, size=(33, 33))
    first = aov.prim_id == 0
    assert first.sum() > 50
    np.testing.assert_allclose(aov.shading_normal[first], np.tile([0, 0, 1], (first.sum(), 1)), atol=1e-6)


# --- materials --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("integrator", ["path", "whitted"])
def test_a_rough_conductor_counts_each_light_once(integrator):
    silver = Material("conductor", roughness=0.3)
    scene = lambda material: Scene(spheres=(Sphere((0, 0, 0), 0.8, material),), cameras=(FRONT,), background=WHITE_SKY)
    smooth, rough, rougher = (
        center_pixel(scene(replace(silver, roughness=roughness)), spp=2048, integrator=integrator)[0]
        for roughness in (0.0, 0.3, 1.0))
    np.testing.assert_allclose(rough, smooth, rtol=0.02)
    assert (rougher < 0.95 * smooth).all()  # single scattering loses light


@pytest.mark.parametrize("wrap", ["repeat", "clamp", "mirror"])
def test_textures_lie_as_in_gltf(wrap):
    rng = np.random.default_rng(5)
    image = rng.integers(0, 256, (4, 6, 4), dtype=np.uint8)
    transform = np.array([[0.9, 0.4, -0.3], [-0.3, 1.7, 0.2]])
    texture = Texture(image, srgb=True, wrap=(wrap, wrap), uv_transform=transform)
    scene = Scene(objects=(Object(QUAD, (glowing((2, 1, 0.5), emission_texture=texture),)),), cameras=(FRONT,))
    point = plane_hit(FRONT, (45, 45))
    pixels = render_mitsuba(scene, size=(45, 45), spp=25, integrator="whitted").pixels

    encoded = image[..., :3] / 255.0
    linear = np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)
    uv = np.stack([(point[..., 0] + 1) / 2, (1 - point[..., 1]) / 2, np.ones(point.shape[:2])], -1) @ transform.T
    xy = uv * (6, 4) - 0.5
    low = np.floor(xy).astype(int)
    share = xy - low

    def texel(dx, dy):
        index = []
        for i, size in ((low[..., 0] + dx, 6), (low[..., 1] + dy, 4)):
            if wrap == "clamp":
                i = np.clip(i, 0, size - 1)
            elif wrap == "repeat":
                i = i % size
            else:
                i = np.where(i % (2 * size) < size, i % size, size - 1 - i % size)
            index.append(i)
        return linear[index[1], index[0]]

    weight = lambda w: w[..., None]
    upper = weight(1 - share[..., 0]) * texel(0, 0) + weight(share[..., 0]) * texel(1, 0)
    lower = weight(1 - share[..., 0]) * texel(0, 1) + weight(share[..., 0]) * texel(1, 1)
    expected = (weight(1 - share[..., 1]) * upper + weight(share[..., 1]) * lower) * (2, 1, 0.5)
    inside = (abs(point[..., 0]) < 0.95) & (abs(point[..., 1]) < 0.95)
    difference = abs(pixels - expected)[inside]
    assert difference.mean() < 0.01 and np.quantile(difference, 0.99) < 0.12  # a pixel is an average around its centre


def test_each_face_has_its_material():
    materials = (glowing((1, 0, 0)), glowing((0, 1, 0)), glowing((0, 0, 1)))
    scene = Scene(objects=(Object(QUAD, materials, face_material=np.array([2, 0])),), cameras=(FRONT,))
    pixels = render_mitsuba(scene, size=(30, 30), spp=4, integrator="whitted").pixels
    np.testing.assert_array_equal(pixels[20, 22], (0, 0, 1))  # below the diagonal: face 0
    np.testing.assert_array_equal(pixels[10, 8], (1, 0, 0))


def test_blended_surfaces_let_light_through():
    pane = Material(albedo=(0, 0, 0), alpha=0.3, alpha_mode="blend")
    scene = Scene(objects=(Object(QUAD, (pane,)),), cameras=(FRONT,), background=ConstantBackground((1, 2, 3)))
    for integrator in ("whitted", "volpath"):
        mean, error = center_pixel(scene, spp=4096, integrator=integrator)
        assert (abs(mean - 0.7 * np.array([1, 2, 3])) < 5 * error).all()
    # A light behind the pane reaches the floor behind ours by the same share; a cut-out takes all or nothing.
    floor = Object(QUAD, (Material(albedo=(1, 1, 1)),))
    lit = lambda material: Scene(objects=(floor, Object(QUAD, (material,), transform=placed(0.7, 0, 1, 0.3))),
                                 cameras=(FRONT,), lights=(PointLight((1.4, 0, 2), (5, 5, 5)),))
    free = 5 * 2 / (1.4**2 + 2**2) ** 1.5 / math.pi
    for material, share in ((pane, 0.7), (replace(pane, alpha_mode="mask"), 1.0),
                            (replace(pane, alpha=0.6, alpha_mode="mask"), 0.0), (Material(), 0.0)):
        mean, _ = center_pixel(lit(material), spp=64, integrator="whitted")
        np.testing.assert_allclose(mean, share * free, rtol=2e-3)


# --- lights and backgrounds -------------------------------------------------------------------------------------------


def test_a_gradient_is_linear_in_the_height():
    background = GradientBackground(bottom=(1, 0, 0.5), top=(0, 1, 2))
    scene = Scene(cameras=(FRONT,), background=background)
    rng = np.random.default_rng(2)
    with mitsuba() as mi:
        emitter = to_mitsuba(scene).environment()
        for direction in rng.normal(size=(200, 3)):
            direction /= np.linalg.norm(direction)
            si = mi.SurfaceInteraction3f()
            si.wi = (-direction).tolist()
            share = 0.5 * (direction[1] + 1)
            expected = (1 - share) * np.array(background.bottom) + share * np.array(background.top)
            np.testing.assert_allclose(np.array(emitter.eval(si)), expected, atol=1e-5)


# --- what cannot be translated ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(("material", "message"), [
    (Material(specular=(0.1, 0.1, 0.1)), (None, "Blinn-Phong", "Mitsuba: material ''")),
    (Material("metallic_roughness", metallic=1.0, roughness=0.4), (None, "principled", "Mitsuba: material ''")),
    (Material("glass", thin=True, roughness=0.3), (None, "thin pane with roughness", "Mitsuba: material ''")),
    (Material(albedo_texture=Texture(np.zeros((2, 2, 4), np.uint8), wrap=("clamp", "repeat"))), (None, "wrap", "Mitsuba: texture ''")),
    (glowing((1, 2, 3), two_sided=True), (None, "two_sided", "Mitsuba: material ''")),
    (Material(normal_texture=Texture(np.full((2, 2, 4), 128, np.uint8), srgb=False)), (None, "normal texture", "Mitsuba: material ''")),
])
def test_what_is_not_exact_is_refused(material, message):
    scene = Scene(objects=(Object(QUAD, (material,)),), cameras=(FRONT,), background=WHITE_SKY)
    with refused(*message):
        to_mitsuba(scene)


def test_features_that_an_integrator_lacks_are_refused():
    plain = Scene(objects=(Object(QUAD, (Material(),)),), cameras=(FRONT,))
    clear = Material("glass", absorption=(1, 1, 1))
    blades = replace(FRONT, aperture_radius=0.1, blades=6)
    schlick = Scene(objects=(Object(QUAD, (clear,)),), cameras=(FRONT,), settings=Settings(fresnel="schlick"))
    for scene, integrator, message in (
        (replace(plain, ambient=(0.1, 0.1, 0.1)), "path", (None, "ambient", "Mitsuba")),
        (replace(plain, cameras=(blades,)), "path", (None, "blades", "Mitsuba: camera ''")),
        (replace(plain, objects=(Object(QUAD, (clear,)),)), "path", (None, "absorption", "Mitsuba")),
        (replace(plain, objects=(Object(QUAD, (Material(alpha_mode="blend", alpha=0.5),)),)), "direct", (None, "alpha", "Mitsuba")),
        (schlick, "path", (None, "schlick", "Mitsuba")),
        (Scene(objects=(Object(QUAD, (Material("conductor", roughness=0.5),)),), cameras=(FRONT,),
               lights=(PointLight((0, 0, 1), (1, 1, 1)),)), "path", (None, "highlights", "Mitsuba")),
    ):
        with refused(*message):
            to_mitsuba(scene, integrator=integrator)
