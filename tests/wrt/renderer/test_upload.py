"""Upload of a scene to the device's tables: no value is lost, no surface turned inside out, no light counted twice."""

from __future__ import annotations

import warnings

import numpy as np
import pytest

from tests.refused import refused

from tests.kernel_tools import DEVICE, launch, unit, vec3s, zeros  # isort: skip (starts Warp)
import warp as wp

from wrt.accel.scenes.flatten import flatten_joined
from wrt.core.errors import SceneWarning
from wrt.kernels.shade import lights
from wrt.kernels.shade.surface import Triangle, triangle_normal
from wrt.kernels.structs import kernel
from wrt.renderer.upload import (
    LUMINANCE,
    MAX_MESH_LIGHTS,
    TextureTable,
    camera_struct,
    light_records,
    material_records,
    unit_normals,
    upload_scene,
)
from wrt.scene.backgrounds import ConstantBackground, EnvironmentBackground, GradientBackground
from wrt.scene.cameras import Camera
from wrt.scene.materials import ALPHA_MODES, MATERIALS, Checkerboard, Material, Texture, kinds_that_use
from wrt.scene.mesh import Mesh
from wrt.scene.model import Object, Scene, Sphere
from wrt.scene.shapes import box, icosphere, quad

GREY = Material()


def transform(matrix: list[list[float]], move: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> np.ndarray:
    out = np.eye(4)
    out[:3, :3], out[:3, 3] = matrix, move
    return out


def outward_share(mesh: Mesh) -> np.ndarray:
    """Return, for each face, the cosine between its counter-clockwise normal and the direction from the mesh's centre."""
    corner = mesh.vertices[mesh.faces].astype(np.float64)
    normal = unit(np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]))
    return (normal * unit(corner.mean(axis=1) - mesh.vertices.mean(axis=0))).sum(axis=1)


TRANSFORMS = {
    "turned": transform([[0, 0, 1], [1, 0, 0], [0, 1, 0]], (5, -3, 2)),
    "mirrored_in_three": transform([[-2, 0, 0], [0, -2, 0], [0, 0, -2]]),
    "sheared_and_mirrored": transform([[1, 0.7, 0], [0, -1, 0.2], [0, 0, 1]]),
    "tiny": transform(np.diag([1e-12, 1e-12, 1e-12]).tolist()),
}


@pytest.mark.parametrize("name", TRANSFORMS)
def test_outside_stays_outside_and_normals_stay_normal(name: str) -> None:
    ball, matrix = icosphere(2), TRANSFORMS[name]
    world = flatten_joined(Scene(objects=(Object(ball, (GREY,), matrix),)))
    exact = ball.vertices.astype(np.float64) @ matrix[:3, :3].T + matrix[:3, 3]
    assert np.array_equal(world.geometry.vertices, exact.astype(np.float32))  # rounded to float32 once
    placed = Mesh(world.geometry.vertices, world.geometry.faces)
    assert (outward_share(placed) > 0.0).all()
    # The inverse transpose maps a sphere's normals; they stay perpendicular to the surface and point outwards.
    expected = unit(ball.vertices.astype(np.float64) @ np.linalg.inv(matrix[:3, :3]))
    assert np.abs(world.normals - expected).max() < 1e-5
    assert (np.sort(placed.faces, axis=1) == np.sort(ball.faces, axis=1)).all()


def test_objects_are_joined_with_their_materials() -> None:
    red, blue, green = (Material(name=name) for name in ("red", "blue", "green"))
    which = np.array([0, 1] * 6, np.int32)
    scene = Scene(objects=(Object(box(), (red, blue), face_material=which), Object(quad(), (green,)), Object(quad(), (blue,))),
                  spheres=(Sphere((1, 2, 3), 4.0, green), Sphere((0, 0, 0), 1.0, red)))
    assert [m.name for m in scene.materials] == ["red", "blue", "green"]
    world = flatten_joined(scene)
    geometry = world.geometry
    assert world.prim_material.tolist() == [*which.tolist(), 2, 2, 1, 1, 2, 0]
    assert len(geometry) == 12 + 2 + 2 + 2 and geometry.faces.max() == len(geometry.vertices) - 1
    assert np.array_equal(geometry.vertices[geometry.faces[12:14]], quad().vertices[quad().faces])
    assert geometry.spheres.tolist() == [[1, 2, 3, 4], [0, 0, 0, 1]]
    assert world.normals is None and np.array_equal(world.uvs[-4:], quad().uvs)
    smooth = flatten_joined(Scene(objects=(Object(quad(), (red,)), Object(icosphere(0), (red,)))))
    assert smooth.normals is not None and not smooth.normals[:4].any() and smooth.normals[4:].any()


def test_material_records_keep_every_value() -> None:
    picture, board = Texture(np.zeros((2, 3, 4), np.uint8)), Checkerboard()
    a = Material("glass", albedo=(0.1, 0.2, 0.3), ior=1.7, absorption=(4, 5, 6), thin=True, roughness=0.25, alpha=0.5,
                 alpha_mode="blend", albedo_texture=picture, normal_texture=picture, emission_texture=board, normal_scale=-2.0)
    b = Material("metallic_roughness", metallic=0.7, transmission=0.2, emission=(7, 8, 9), two_sided=True,
                 metallic_roughness_texture=Texture(picture.image), alpha_cutoff=0.9)
    table = TextureTable()
    out = material_records((a, b), table)
    assert [list(MATERIALS)[kind] for kind in out["kind"]] == ["glass", "metallic_roughness"]
    assert out["alpha_mode"].tolist() == [ALPHA_MODES.index("blend"), ALPHA_MODES.index("opaque")]
    for row, material in zip(out, (a, b), strict=True):
        for name in ("albedo", "specular", "exponent", "eta", "k", "ior", "absorption", "thin", "metallic", "roughness",
                     "transmission", "emission", "two_sided", "alpha", "alpha_cutoff", "normal_scale"):
            unused = name in kinds_that_use() and not material.uses(name)
            assert np.allclose(row[name], 0.0 if unused else getattr(material, name)) or name == "transmission", name
    assert np.allclose(out["transmission"], [1.0, 0.2])  # glass transmits all light that it does not reflect
    assert out["albedo_texture"].tolist() == [0, -1] and out["normal_texture"].tolist() == [0, -1]
    assert out["emission_texture"][0] == 1 and out["metallic_roughness_texture"].tolist() == [-1, 2]
    assert len(table.rows) == 3 and table.size == 6  # the image that two textures share is stored once
    first = table.records()["first"]
    assert first[0] == first[2] == 0 and table.records()["width"].tolist() == [3, 0, 3]


def lamps(count: int, **rest: float) -> Scene:
    """Return a scene with `count` emissive quads of growing size, each with its own material, and one dark object."""
    objects = [Object(quad((3.0 * i, 0, 0), (1 + i, 0, 0), (0, 1, 0)), (Material(emission=(1.0 + i, 2.0, 0.5), **rest),))
               for i in range(count)]
    return Scene(objects=(Object(box(), (GREY,)), *objects))


def test_each_glowing_object_is_a_light() -> None:
    scene = lamps(3)
    rows, emitters, cdf = light_records(scene, flatten_joined(scene))
    assert (rows["kind"] == list(lights.LIGHTS).index("mesh")).all()
    assert rows["count"].tolist() == [2, 2, 2] and rows["first"].tolist() == [0, 2, 4]
    assert emitters["material"].tolist() == [1, 1, 2, 2, 3, 3] and (emitters["instance"] == 0).all()
    world = flatten_joined(scene)
    for number, corner in enumerate(("v0", "v1", "v2")):
        assert (emitters[corner] == world.vertices[world.faces[12:, number]]).all()
    assert np.allclose(cdf, [0.5, 1.0] * 3)
    assert np.allclose(emitters["pdf_area"], 1.0 / np.repeat([1.0, 2.0, 3.0], 2))  # uniform over each quad
    dark = lamps(3, emits_light=False)
    assert len(light_records(dark, flatten_joined(dark))[0]) == 0


def test_many_emissive_objects_are_one_light_sampled_by_power() -> None:
    count = MAX_MESH_LIGHTS + 4
    scene = lamps(count)
    rows, emitters, cdf = light_records(scene, flatten_joined(scene))
    assert len(rows) == 1 and rows["count"][0] == 2 * count == len(emitters)
    area = 0.5 * (1.0 + np.repeat(np.arange(count), 2))
    power = area * np.repeat([LUMINANCE @ [1.0 + i, 2.0, 0.5] for i in range(count)], 2)
    assert np.allclose(np.diff(cdf, prepend=0.0), power / power.sum(), atol=1e-6)
    assert cdf[-1] == 1.0
    # Density over all triangles: probability of a triangle, divided by its area; its integral is 1.
    assert np.allclose(emitters["pdf_area"], power / power.sum() / area, rtol=1e-5)
    assert (emitters["pdf_area"] * area).sum() == pytest.approx(1.0, rel=1e-5)


@kernel
def normal_kernel(v0: wp.array(dtype=wp.vec3), v1: wp.array(dtype=wp.vec3), v2: wp.array(dtype=wp.vec3),
                  out: wp.array(dtype=wp.vec3)):
    i = wp.tid()
    t = Triangle()
    t.v0 = v0[i]
    t.v1 = v1[i]
    t.v2 = v2[i]
    out[i] = triangle_normal(t)


def test_normals_of_emitters_are_those_of_the_device_to_the_last_bit() -> None:
    rng = np.random.default_rng(3)
    n = 200_000
    corners = (rng.normal(size=(3, n, 3)) + rng.normal(size=(1, n, 3))) * 10.0 ** rng.uniform(-22, 18, (1, n, 1))
    corners = corners.astype(np.float32)
    corners[1, :1000] = corners[0, :1000]  # edges of length 0, collinear edges, and nearly collinear edges
    corners[2, 1000:2000] = 2.0 * corners[1, 1000:2000] - corners[0, 1000:2000]
    corners[2, 2000:3000] = corners[1, 2000:3000] * np.float32(1.0 + 1e-6)
    corners[:, 3000:4000] *= np.float32(1e-38)
    corners[:, 4000:5000, 1] = 0.0
    out = zeros(n, wp.vec3)
    launch(normal_kernel, n, *map(vec3s, corners), out)
    expected = out.numpy()
    assert (unit_normals(*corners).view(np.uint32) == expected.view(np.uint32)).all()
    assert (expected[:1000] == 0.0).all() and (np.linalg.norm(expected, axis=1) > 0.99).mean() > 0.9


def test_emission_that_lights_nothing_is_reported_once() -> None:
    picture = Texture(np.zeros((2, 3, 4), np.uint8))
    glowing = [Material(name="sign", emission=(1, 1, 1), emission_texture=picture),
               Material(name="veil", emission=(1, 1, 1), alpha_mode="blend"), Material(emission=(1, 1, 1), alpha_mode="mask"),
               Material(name="meant", emission=(1, 1, 1), emission_texture=picture, emits_light=False),
               Material(name="lamp", emission=(1, 1, 1)), Material(name="dark", alpha_mode="blend")]
    objects = tuple(Object(quad(), (material,)) for material in glowing)
    with pytest.warns(SceneWarning) as reported:
        upload_scene(Scene(objects=objects), DEVICE)
    assert len(reported) == 1
    assert "seen but lights nothing" in str(reported[0].message) and "materials 'sign', 'veil', '2' (" in str(reported[0].message)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        upload_scene(Scene(objects=objects[3:]), DEVICE)


def test_emitters_without_area_or_light_are_never_chosen() -> None:
    mesh = Mesh([[0, 0, 0], [1, 0, 0], [0, 1, 0], [2, 0, 0]], [[0, 1, 1], [0, 1, 2], [0, 1, 3]])
    scene = Scene(objects=(Object(mesh, (Material(emission=(1, 1, 1)),)),))
    rows, emitters, cdf = light_records(scene, flatten_joined(scene))
    assert rows["count"][0] == 3 and cdf.tolist() == [0.0, 1.0, 1.0] and emitters["pdf_area"].tolist() == [0.0, 2.0, 0.0]
    flat = Scene(objects=(Object(Mesh(mesh.vertices, mesh.faces[[0, 2]]), (Material(emission=(1, 1, 1)),)),))
    assert len(light_records(flat, flatten_joined(flat))[0]) == 0


def test_backgrounds() -> None:
    flat = upload_scene(Scene(background=ConstantBackground((1, 2, 3))), DEVICE).lighting.background
    assert list(flat.bottom) == list(flat.top) == [1, 2, 3]
    gradient = upload_scene(Scene(background=GradientBackground((0, 0, 1), (1, 0, 0))), DEVICE).lighting.background
    assert list(gradient.bottom) == [0, 0, 1] and list(gradient.top) == [1, 0, 0]


@pytest.mark.parametrize("black", [False, True])
def test_environment_tables_cover_every_pixel(black: bool) -> None:
    rng = np.random.default_rng(1)
    image = np.zeros((7, 9, 3), np.float32) if black else (rng.random((7, 9, 3)) ** 8).astype(np.float32)
    b = upload_scene(Scene(background=EnvironmentBackground(image, 2.0, 0.5)), DEVICE).lighting.background
    rows, columns = b.row_cdf.numpy(), b.column_cdf.numpy().reshape(7, 9)
    assert (b.height, b.width, b.scale, b.rotation) == (7, 9, 2.0, 0.5)
    assert rows[-1] == 1.0 and (columns[:, -1] == 1.0).all()
    assert (np.diff(rows, prepend=0.0) > 0.0).all() and (np.diff(columns, axis=1, prepend=0.0) > 0.0).all()
    assert np.array_equal(b.pixels.numpy().reshape(7, 9, 3), image)


def test_a_cut_out_texture_on_a_sphere_is_refused() -> None:
    leaf = Material(alpha_mode="mask", albedo_texture=Checkerboard(), name="leaf")
    with refused(what="needs a mesh", place="sphere 'ball'"):
        upload_scene(Scene(spheres=(Sphere((0, 0, 0), 1.0, leaf, name="ball"),)), DEVICE)


@pytest.mark.parametrize("size", [(640, 360), (10, 30)])
def test_camera_struct(size: tuple[int, int]) -> None:
    camera = Camera.look_at((1, 2, 3), (4, 6, 3), fov_y=0.8, aperture_radius=0.2, focus_distance=7.0, blades=5)
    c = camera_struct(camera, size)
    assert np.allclose(c.origin, [1, 2, 3]) and np.allclose(c.forward, [0.6, 0.8, 0.0], atol=1e-6)
    frame = np.array([c.right, c.up, c.forward])
    assert np.allclose(frame @ frame.T, np.eye(3), atol=1e-6)
    assert np.linalg.det(frame) == pytest.approx(-1.0, abs=1e-6)  # right, up and -forward are right-handed
    assert c.tan_y == pytest.approx(np.tan(0.4)) and c.tan_x == pytest.approx(np.tan(0.4) * size[0] / size[1])
    assert (c.blades, c.focus_distance) == (5, 7.0) and c.aperture_radius == pytest.approx(0.2)
