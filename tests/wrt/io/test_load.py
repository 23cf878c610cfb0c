from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.gltf_files import encode, one_triangle
from tests.refused import refused
from wrt.accel.scenes.flatten import flatten_joined
from wrt.core.errors import InputError, SceneWarning
from wrt.io.load import load_scene, schema
from wrt.scene.backgrounds import EnvironmentBackground, GradientBackground
from wrt.scene.lights import DirectionalLight, PointLight, SpotLight
from wrt.scene.materials import CONDUCTORS, Checkerboard, Texture
from wrt.scene.model import Scene
from wrt.scene.settings import Settings

CAMERA = "[cameras.main]\nposition = [0, 0, 5]\ntarget = [0, 0, 0]\n"
SUN = '[[lights]]\ntype = "directional"\ndirection = [0, -1, 0]\nirradiance = 1\n'
TRIANGLES = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\n"


def load(folder: Path, text: str) -> Scene:
    path = folder / "scene.toml"
    path.write_text(text)
    return load_scene(path)


def errors(folder: Path, text: str) -> list[str]:
    """Return the lines of the InputError for the text, without the file and the number of errors."""
    with pytest.raises(InputError) as caught:
        load(folder, text)
    message = str(caught.value)
    path = str(folder / "scene.toml")
    assert message.startswith(path + ": ")
    lines = message[len(path) + 2:].split("\n  ")
    if len(lines) > 1:
        assert lines[0] == f"{len(lines) - 1} errors"
    return lines[1:] or lines


def gltf(folder: Path) -> None:
    """Write model.glb: a triangle of a material "paint", moved by 1, a camera, and lights of each kind."""
    file = one_triangle(material=0)
    file.json |= {"materials": [{"name": "paint"}], "cameras": [{"type": "perspective", "perspective": {"yfov": 0.5, "znear": 0.1}}]}
    file.json["nodes"][0]["translation"] = [1, 0, 0]
    file.node(camera=0, translation=[0, 0, 3], name="eye")
    kinds = [{"type": kind, "intensity": 3.0} for kind in ("point", "directional", "spot")]
    file.json["extensions"] = {"KHR_lights_punctual": {"lights": kinds}}
    for i in range(3):
        file.node(translation=[1, 2, 3], extensions={"KHR_lights_punctual": {"light": i}})
    file.write(folder, "model.glb")


# --- the scene holds everything that the file says -------------------------------------------------------------------------


def test_settings_cameras_and_light(tmp_path: Path) -> None:
    scene = load(tmp_path, """
title = "a test"
ambient = 0.25
[settings]
size = [320, 200]
spp = 4
filter = "gaussian"
[cameras.near]
position = [0, 1, 4]
target = [0, 1, 0]
fov_y = 30
aperture_radius = 0.5
blades = 6
blade_rotation = 90
[cameras.lens]
position = [0, 0, 0]
target = [0, 0, -3]
focal_length = 0.05
sensor_height = 0.024
f_number = 2
[cameras.matrix]
matrix = [0, 0, 1, 7, 0, 1, 0, 8, -1, 0, 0, 9, 0, 0, 0, 1]
[background]
type = "gradient"
top = [0, 0, 1]
[[lights]]
type = "point"
position = [1, 2, 3]
intensity = 5
[[lights]]
type = "spot"
position = [0, 5, 0]
direction = [0, -2, 0]
intensity = [1, 2, 3]
inner = 10
outer = 20
[[lights]]
type = "directional"
direction = [3, 0, 0]
irradiance = 2
[[lights]]
type = "rectangle"
corner = [0, 4, 0]
edge_u = [1, 0, 0]
edge_v = [0, 0, 1]
radiance = [4, 3, 2]
two_sided = true
""")
    assert scene.name == "a test" and scene.ambient == (0.25, 0.25, 0.25)
    assert scene.settings == Settings(size=(320, 200), spp=4, max_depth=8, filter="gaussian")
    near, lens, matrix = scene.cameras
    assert [camera.name for camera in scene.cameras] == ["near", "lens", "matrix"]
    assert near.fov_y == pytest.approx(math.radians(30)) and near.focus_distance == pytest.approx(4)
    assert (near.aperture_radius, near.blades) == (0.5, 6) and near.blade_rotation == pytest.approx(math.pi / 2)
    assert lens.aperture_radius == pytest.approx(0.0125) and lens.focus_distance == 3.0
    assert lens.fov_y == pytest.approx(2 * math.atan(0.012 / (0.05 * 3 / 2.95)))
    assert matrix.camera_to_world[:3, 3].tolist() == [7, 8, 9] and matrix.camera_to_world[:3, 2].tolist() == [1, 0, 0]
    assert isinstance(scene.background, GradientBackground) and scene.background.top == (0, 0, 1)
    assert scene.background.bottom == GradientBackground().bottom
    point, spot, sun = scene.lights
    assert point == PointLight((1, 2, 3), (5, 5, 5), name="lights[0]")
    assert sun == DirectionalLight((1, 0, 0), (2, 2, 2), name="lights[2]")
    assert spot == SpotLight((0, 5, 0), (0, -1, 0), (1, 2, 3), inner=math.radians(10), outer=math.radians(20), name="lights[1]")
    panel, = scene.objects
    assert panel.materials[0].emission == (4, 3, 2) and panel.materials[0].two_sided
    assert panel.materials[0].albedo == (0, 0, 0)
    corners = panel.mesh.vertices[panel.mesh.faces]
    assert (np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])[:, 1] < 0).all()  # it shines down


def test_materials_and_shapes(tmp_path: Path) -> None:
    (tmp_path / "t.png").write_bytes(encode(np.arange(24, dtype=np.uint8).reshape(2, 3, 4)))
    scene = load(tmp_path, CAMERA + SUN + """
[materials.gold]
kind = "conductor"
metal = "gold"
roughness = 0.25
[materials.window]
kind = "glass"
absorption = [1, 2, 3]
ior = 1.25
[materials.board]
albedo_texture = { checkerboard = { color_a = 1, color_b = [0, 0.5, 0], scale = 8 } }
[materials.print]
albedo_texture = { file = "t.png", wrap = ["clamp", "repeat"], scale = [2, 3], offset = [0.5, 0], rotation = 90 }
normal_texture = { file = "t.png" }
alpha_mode = "mask"
[materials.unused]
[[spheres]]
center = [1, 2, 3]
radius = 2
material = "gold"
[[quads]]
corner = [0, 0, 0]
edge_u = [1, 0, 0]
edge_v = [0, 2, 0]
material = "board"
[[boxes]]
low = [0, 0, 0]
high = [1, 1, 1]
material = "window"
transform = { translate = [5, 0, 0], rotate = [0, 90, 0], scale = 2 }
[[meshes]]
shape = { kind = "torus", radius = 2 }
material = "print"
""")
    gold, = [sphere.material for sphere in scene.spheres]
    assert (gold.eta, gold.k) == CONDUCTORS["gold"] and gold.roughness == 0.25 and gold.name == "gold"
    board, window, painted = (thing.materials[0] for thing in scene.objects)
    assert isinstance(board.albedo_texture, Checkerboard)
    assert board.albedo_texture == Checkerboard((1, 1, 1), (0, 0.5, 0), 8)
    assert (window.kind, window.ior, window.absorption) == ("glass", 1.25, (1, 2, 3))
    texture, normal = painted.albedo_texture, painted.normal_texture
    assert isinstance(texture, Texture) and isinstance(normal, Texture)
    assert texture.srgb and not normal.srgb and texture.image is normal.image
    assert texture.wrap == ("clamp", "repeat") and normal.wrap == ("repeat", "repeat")
    assert texture.image.tolist() == np.arange(24).reshape(2, 3, 4).tolist()
    np.testing.assert_array_equal(texture.uv_transform, [[0, 3, 0.5], [-2, 0, 0]])
    # A corner (0, 0, 1) of the box: scaled to (0, 0, 2), turned to (2, 0, 0), moved to (7, 0, 0).
    np.testing.assert_array_equal(scene.objects[1].transform @ [0, 0, 1, 1], [7, 0, 0, 1])
    low, high = scene.objects[2].mesh.vertices.min(axis=0), scene.objects[2].mesh.vertices.max(axis=0)
    np.testing.assert_allclose(high - low, [4.7, 0.7, 4.7], atol=1e-5)


@pytest.mark.parametrize(("transform", "point", "image"), [
    ("rotate = [90, 90, 0]", [0, 1, 0], [1, 0, 0]),  # x first: y goes to z; then about y: z goes to x
    ("rotate = [0, 90, 90]", [0, 0, 1], [0, 1, 0]),  # about y: z goes to x; then about z: x goes to y
    ("axis = [2, 2, 2], angle = 120", [1, 0, 0], [0, 1, 0]),
    ("axis = [0, 0, 1], angle = 30", [2, 0, 0], [math.sqrt(3), 1, 0]),
    ("scale = [1, 2, -3], translate = [1, 1, 1]", [1, 1, 1], [2, 3, -2]),
    ("matrix = [1, 0, 0, 4, 0, 0, -1, 5, 0, 1, 0, 6, 0, 0, 0, 1]", [1, 2, 3], [5, 2, 8]),
])
def test_transforms(tmp_path: Path, transform: str, point: list[float], image: list[float]) -> None:
    scene = load(tmp_path, CAMERA + SUN + '[materials.m]\n[[meshes]]\nshape = { kind = "prism" }\nmaterial = "m"\n'
                 + f"transform = {{ {transform} }}\n")
    np.testing.assert_allclose(scene.objects[0].transform @ [*point, 1], [*image, 1], atol=1e-12)


def test_no_more_than_twenty_mistakes_are_listed(tmp_path: Path) -> None:
    with pytest.raises(InputError) as caught:
        load(tmp_path, CAMERA + "[[spheres]]\n" * 10 + "".join(f"wrong_{i} = 1\n" for i in range(5)))
    head, *lines = str(caught.value).split("\n  ")
    assert head.endswith("35 errors") and len(lines) == 21 and lines[-1] == "and 15 more"


def test_instances_of_a_mesh_are_placed_before_its_transform(tmp_path: Path) -> None:
    table = '[materials.m]\n[[meshes]]\nshape = { kind = "prism" }\nmaterial = "m"\n'
    scene = load(tmp_path, CAMERA + SUN + table + "transform = { rotate = [0, 90, 0] }\n"
                 "instances = [{ translate = [1, 0, 0] }, { scale = 2 }, {}]\n")
    assert len({id(thing.mesh) for thing in scene.objects}) == 1
    images = [thing.transform @ [1, 0, 0, 1] for thing in scene.objects]
    np.testing.assert_allclose(images, [[0, 0, -2, 1], [0, 0, -2, 1], [0, 0, -1, 1]], atol=1e-12)
    with refused(place="meshes[0]: instances[1]"):
        load(tmp_path, CAMERA + SUN + table + "instances = [{}, { matrix = [1,0,0,0, 0,1,0,0, 0,0,0,0, 0,0,0,1] }]\n")


def including(folder: Path, transform: str) -> tuple[Scene, Scene]:
    gltf(folder)
    plain = load(folder, 'include = ["model.glb"]\n')
    return plain, load(folder, f'[[include]]\nfile = "model.glb"\ntransform = {{ {transform} }}\n')


def test_an_included_file_is_moved_as_a_whole(tmp_path: Path) -> None:
    # Twice as large, then y to z and z to -y, then 10 along x: (x, y, z) is at (2 x + 10, -2 z, 2 y).
    plain, scene = including(tmp_path, "scale = 2, rotate = [90, 0, 0], translate = [10, 0, 0]")
    geometry = flatten_joined(scene).geometry
    assert geometry.vertices[geometry.faces[0]].tolist() == [[12, 0, 0], [14, 0, 0], [12, 0, 2]]
    point, sun, spot = scene.lights
    assert isinstance(point, PointLight) and isinstance(sun, DirectionalLight) and isinstance(spot, SpotLight)
    assert point.position == spot.position == (12, -6, 4)
    assert sun.direction == spot.direction == (0, 1, 0)  # each shone along -z
    assert (point.intensity, sun.irradiance, spot.intensity, spot.outer) == (
        plain.lights[0].intensity, plain.lights[1].irradiance, plain.lights[2].intensity, plain.lights[2].outer)
    camera, = scene.cameras
    assert camera.camera_to_world.tolist() == [[1, 0, 0, 10], [0, 0, -1, -6], [0, 1, 0, 0], [0, 0, 0, 1]]
    assert camera.name == "eye" and camera.fov_y == plain.cameras[0].fov_y


def test_an_included_file_may_be_mirrored(tmp_path: Path) -> None:
    plain, scene = including(tmp_path, "scale = [-1, 1, 1]")
    before, after = flatten_joined(plain).geometry, flatten_joined(scene).geometry
    normals = [np.cross(*(np.diff(g.vertices[g.faces[0]], axis=0))) for g in (before, after)]
    assert normals[0].tolist() == normals[1].tolist() == [0, 0, 1]  # its outside stays outside
    assert after.vertices[:, 0].min() == -2 and np.linalg.det(scene.cameras[0].camera_to_world) == pytest.approx(1.0)


def test_unread_materials_of_an_obj_file_are_reported_once(tmp_path: Path) -> None:
    path = tmp_path / "two.obj"
    path.write_text("mtllib x.mtl\n" + TRIANGLES + "usemtl a\nf 1 2 3\nusemtl b\nf 1 2 4\nmtllib y.mtl\nusemtl a\nf 1 3 4\n")
    with pytest.warns(SceneWarning) as caught:
        load_scene(path)
    told = " ".join(str(each.message) for each in caught)
    assert len(caught) == 1 and told.count("its 2 parts are all light grey (.mtl files are not read): a TOML scene") == 1
    assert told.count(".mtl") == 1


def test_environment(tmp_path: Path) -> None:
    from wrt.picture.image import write_image

    image = np.random.default_rng(0).random((4, 8, 3)).astype(np.float32)
    write_image(tmp_path / "sky.exr", image)
    scene = load(tmp_path, CAMERA + '[background]\ntype = "environment"\nfile = "sky.exr"\nscale = 2\nrotation = 45\n')
    assert isinstance(scene.background, EnvironmentBackground)
    np.testing.assert_array_equal(scene.background.image, image)
    assert scene.background.scale == 2 and scene.background.rotation == pytest.approx(math.pi / 4)


def test_mesh_materials(tmp_path: Path) -> None:
    (tmp_path / "m.obj").write_text(TRIANGLES + "usemtl a\nf 1 2 3\nf 1 1 2\nusemtl b\nf 1 2 4\nusemtl c\nf 1 3 4\n")
    scene = load(tmp_path, CAMERA + SUN + """
[materials.red]
[materials.green]
[[meshes]]
file = "m.obj"
material = "red"
[[meshes]]
file = "m.obj"
materials = { b = "green" }
material = "red"
smooth = true
[[meshes]]
file = "m.obj"
parts = [{ first = 3, count = 1, material = "green" }, { first = 0, count = 3, material = "red" }]
""")
    def names(i: int) -> list[str]:
        thing = scene.objects[i]
        index = thing.face_material if thing.face_material is not None else np.zeros(len(thing.mesh.faces), int)
        return [thing.materials[k].name for k in index]
    assert names(0) == ["red", "red", "red"]
    assert names(1) == ["red", "green", "red"]
    assert names(2) == ["red", "red", "green"]  # triangle 1 of the file has no area, but is counted
    assert scene.objects[0].mesh.normals is None and scene.objects[1].mesh.normals is not None
    assert scene.objects[0].materials[0] is scene.objects[1].materials[0]


def test_a_mesh_file_is_loaded_once(tmp_path: Path) -> None:
    (tmp_path / "m.obj").write_text(TRIANGLES + "f 1 2 3\n")
    scene = load(tmp_path, CAMERA + SUN + "[materials.m]\n" + 3 * '[[meshes]]\nfile = "m.obj"\nmaterial = "m"\n'
                 + 2 * '[[meshes]]\nfile = "./m.obj"\nmaterial = "m"\nsmooth = true\n')
    assert len({id(thing.mesh) for thing in scene.objects}) == 2


def test_smooth_false_makes_flat(tmp_path: Path) -> None:
    scene = load(tmp_path, CAMERA + SUN + "[materials.m]\n" + "".join(
        f'[[meshes]]\nshape = {{ kind = "torus" }}\nmaterial = "m"\n{smooth}\n' for smooth in ("", "smooth = false")))
    assert scene.objects[0].mesh.normals is not None and scene.objects[1].mesh.normals is None


def test_include(tmp_path: Path) -> None:
    gltf(tmp_path)
    scene = load(tmp_path, 'include = ["model.glb"]\n' + CAMERA + """
[materials.mine]
[[spheres]]
center = [0, 0, 0]
radius = 1
material = "paint"
[[boxes]]
low = [0, 0, 0]
high = [1, 1, 1]
material = "mine"
""" + SUN)
    assert [camera.name for camera in scene.cameras] == ["main", "eye"]
    assert isinstance(scene.lights[0], DirectionalLight) and isinstance(scene.lights[1], PointLight)
    assert [len(thing.mesh.faces) for thing in scene.objects] == [12, 1]
    assert scene.spheres[0].material is scene.objects[1].materials[0]

    scene = load(tmp_path, 'include = ["model.glb"]\n[override.paint]\nkind = "mirror"\nalbedo = 0.5\n')
    material, = scene.objects[0].materials
    assert (material.kind, material.albedo, material.name) == ("mirror", (0.5, 0.5, 0.5), "paint")


# --- what is wrong ----------------------------------------------------------------------------------------------------


# For each mistake, where the message must say it is.
MISTAKES = [
    ('titel = "x"', "titel"),
    ("[settings]\nspp = 1.5", "settings.spp"),
    ('[settings]\nfilter = "gausian"', "settings.filter"),
    ("[settings]\nsize = [32, 40000]", "settings.size[1]"),
    ("[materials.m]\nior = 1.5", "materials.m"),
    ("[materials.m]\nrougness = 1", "materials.m.rougness"),
    ('[materials."a b"]\nalpha = 2', 'materials."a b".alpha'),
    ('[materials.m]\nkind = "glass"\nior = 0.5', "materials.m.ior"),
    ('[materials.m]\nkind = "conductor"\nmetal = "gold"\nk = 3', "materials.m"),
    ('[materials.m]\nkind = "conductor"\nmetal = "brass"', "materials.m.metal"),
    ("[materials.m]\nalbedo = true", "materials.m.albedo"),
    ("[materials.m]\nalbedo = [0, 0, inf]", "materials.m.albedo[2]"),
    ("[materials.m]\nthin = 1", "materials.m.thin"),
    ("[materials.m]\nalbedo_texture = {}", "materials.m.albedo_texture"),
    ('[materials.m]\nnormal_texture = { checkerboard = {}, file = "" }', "materials.m.normal_texture.checkerboard"),
    ('[materials.m]\nalbedo_texture = { checkerboard = {}, scale = 2 }', "materials.m.albedo_texture"),
    ('[materials.m]\nalbedo_texture = { file = "no.png" }', "materials.m.albedo_texture"),
    ('[materials.m]\nalbedo_texture = { file = "scene.toml" }', "materials.m.albedo_texture"),
    ('[materials.m]\nalbedo_texture = { file = "no.png", matrix = [1, 0, 0, 0, 1, 0], scale = 2 }', "materials.m.albedo_texture"),
    ('[materials.m]\nalbedo_texture = { file = "no.png", wrap = ["clamp", "none"] }', "materials.m.albedo_texture.wrap[1]"),
    ("ambient = 9223372036854775808", "ambient"), ("[settings]\nspp = -99999999999999999999", "settings.spp"),
    ("materials = 5", "materials"), ("spheres = 5", "spheres"), ("spheres = [5]", "spheres[0]"),
    ('[materials.m]\n[[spheres]]\nmaterial = "m"\ncenter = [0, 0, 0]\nradius = "1"', "spheres[0].radius"),
    ('[materials.m]\n[[spheres]]\nmaterial = "m"\nradius = 1', "spheres[0].center"),
    ('[materials.m]\n[[spheres]]\nmaterial = "n"\ncenter = [0, 0, 0]\nradius = 1', "spheres[0]"),
    ("[cameras.a]\nposition = [0, 0, 0]", "cameras.a"),
    ("[cameras.a]", "cameras.a"),
    ('[cameras.a]\ntype = "fishey"', "cameras.a.type"),
    ("[cameras.a]\nposition = [0, 0, nan]\ntarget = [0, 0, 1]", "cameras.a.position[2]"),
    ("[cameras.a]\nposition = [0, 0, 1]\ntarget = [0, 0]", "cameras.a.target"),
    ("[cameras.a]\nfov_y = 180\nposition = [0, 0, 0]\ntarget = [0, 0, 1]", "cameras.a.fov_y"),
    ("[cameras.a]\nposition = [0, 0, 0]\ntarget = [0, 0, 0]", "cameras.a"),
    ("[cameras.a]\nposition = [0, 0, 0]\ntarget = [0, 1, 0]", "cameras.a"),
    ("[cameras.a]\nposition = [0, 0, 0]\ntarget = [0, 0, 1]\nfocal_length = 2", "cameras.a"),
    ("[cameras.a]\nposition = [0, 0, 0]\ntarget = [0, 0, 1]\nf_number = 2", "cameras.a"),
    ("[cameras.a]\nposition = [0, 0, 0]\nmatrix = [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]", "cameras.a"),
    ("[cameras.a]\nposition = [0, 0, 9]\ntarget = [0, 0, 1]\nfocal_length = 2\nsensor_height = 1", "cameras.a"),
    ('include = ["m.obj"]', "include[0]"), ('include = ["none.glb"]', "include[0]"), ("include = [3]", "include[0]"),
    ("include = 'a.glb'", "include"), ("[[include]]\ntransform = {}", "include[0].file"),
    ("[[include]]\nfile = 'a.glb'\nplace = 1", "include[0].place"),
    ("[[include]]\nfile = 'a.glb'\ntransform = {scale = 0}", "include[0]"),
    ("[override.m]", "override.m"),
    ('[background]\ntype = "gradiant"', "background.type"), ("[background]", "background.type"),
    ('[background]\ntype = "environment"\nfile = "none.hdr"', "background"),
    ('[[meshes]]\nfile = "m.obj"', "meshes[0]"),
    ('[materials.m]\n[[meshes]]\nmaterial = "m"', "meshes[0]"),
    ('[materials.m]\n[[meshes]]\nmaterial = "m"\nfile = "none.ply"', "meshes[0]"),
    ('[materials.m]\n[[meshes]]\nmaterial = "m"\nshape = { kind = "torus", radius = -1 }', "meshes[0].shape.radius"),
    ('[materials.m]\n[[meshes]]\nmaterial = "m"\nshape = { kind = "tube", points = [[0, 0, 0]] }', "meshes[0].shape.points"),
    ('[materials.m]\n[[meshes]]\nfile = "m.obj"\nmaterials = { wal = "m" }', "meshes[0]"),
    ('[materials.m]\n[[meshes]]\nfile = "m.obj"\nmaterials = { wall = "m" }', "meshes[0]"),
    ('[materials.m]\n[[meshes]]\nfile = "m.obj"\nparts = [{ first = 1, count = 2, material = "m" }]', "meshes[0]"),
    ('[materials.m]\n[[meshes]]\nfile = "m.obj"\nmaterials = { wall = "n" }\nmaterial = "m"', "meshes[0]"),
    ('[materials.m]\n[[meshes]]\nfile = "m.obj"\nmaterial = "m"\ntransform = { scale = [1, 0, 1] }', "meshes[0]"),
    ('[materials.m]\n[[meshes]]\nfile = "m.obj"\nmaterial = "m"\ntransform = { axis = [1, 0, 0] }', "meshes[0].transform"),
    ('[materials.m]\n[[meshes]]\nfile = "m.obj"\nmaterial = "m"\ninstances = []', "meshes[0].instances"),
    (f'[materials.m]\n[[meshes]]\nfile = "m.obj"\nmaterial = "m"\ntransform = {{ matrix = {[0] * 15 + [1]} }}', "meshes[0]"),
    ('[materials.m]\n[[boxes]]\nlow = [0, 0, 0]\nhigh = [0, 1, 1]\nmaterial = "m"', "boxes[0]"),
    ("[[lights]]\nposition = [0, 0, 0]", "lights[0].type"),
    ('[[lights]]\ntype = "spot"\nposition = [0, 0, 0]\ndirection = [0, 1, 0]\nintensity = 1\ninner = 50', "lights[0]"),
    ('[[lights]]\ntype = "directional"\ndirection = [0, 0, 0]\nirradiance = 1', "lights[0]"),
]


@pytest.mark.parametrize(("text", "place"), MISTAKES)
def test_a_mistake_is_reported_at_its_place(tmp_path: Path, text: str, place: str) -> None:
    (tmp_path / "m.obj").write_text(TRIANGLES + "usemtl wall\nf 1 2 3\nusemtl roof\nf 1 2 4\n")
    line, = errors(tmp_path, text)
    assert line.startswith(f"{place}: ")


def test_all_mistakes_are_listed_with_what_would_be_right(tmp_path: Path) -> None:
    lines = errors(tmp_path, 'titel = "x"\n[settings]\nspp = 1.5\nfilter = "gausian"\n[background]\ntype = "gradiant"\n'
                   '[materials.glass]\nkind = "glass"\nior = 0.5\n[[spheres]]\nradius = 1\ncenter = [0, 0]\nmaterial = "glas"\n')
    for line, right in zip(sorted(lines), ("'gradient'", ">= 1", "'gaussian'", "whole number", "3 values", "'title'"),
                           strict=True):
        assert right in line


@pytest.mark.parametrize(("data", "place"), [
    (b"a = 1\nb = [1,\n c]\n", "line 3, column 2"), (b'a = """x', "end of document"),
    (b"a = \n", "line 1, column 5"),
    (b'a = "\xff"', None), (b"a = " + b"[" * 5000 + b"]" * 5000, None),
    (b"a = 1\na = 2\n", "line 2, column 6"), (b"a = " + b"9" * 5000, None),
])
def test_files_that_are_not_toml(tmp_path: Path, data: bytes, place: str | None) -> None:
    path = tmp_path / "scene.toml"
    path.write_bytes(data)
    with refused(place=place, path=path):
        load_scene(path)


def test_paths_that_are_no_scene(tmp_path: Path) -> None:
    (tmp_path / "folder.toml").mkdir()
    (tmp_path / "a.blend").write_text("")
    formats = ".toml, .gltf, .glb, .npz, .obj, .off, .ply, .stl"
    for name, what in (("none.toml", formats), ("folder.toml", "no regular file"), ("a.blend", formats), ("none", formats)):
        with refused(None, what, path=name):
            load_scene(tmp_path / name)


# --- what is added ----------------------------------------------------------------------------------------------------


def test_scene_without_camera_or_light_is_staged(tmp_path: Path) -> None:
    ball = '[materials.m]\n[[spheres]]\ncenter = [3, 0, 0]\nradius = 1\nmaterial = "m"\n'
    with pytest.warns(SceneWarning, match=r"scene\.toml: .*no camera.*no lights") as caught:
        scene = load(tmp_path, ball)
    assert len(caught) == 1 and len(scene.cameras) == 1 and scene.lights
    with pytest.warns(SceneWarning, match="no camera") as caught:
        scene = load(tmp_path, ball + SUN)
    assert "no lights" not in str(caught[0].message) and len(scene.lights) == 1
    with pytest.warns(SceneWarning, match="no lights"):
        load(tmp_path, ball + CAMERA)
    for light in (SUN, '[background]\ntype = "gradient"\n'):
        load(tmp_path, ball + CAMERA + light)  # a warning would be an error here
    assert errors(tmp_path, "") == ["the scene has no shapes"]


@pytest.mark.parametrize("up, top", [("x", 0), ("y", 1), ("z", 2)])
def test_the_up_axis_of_a_bare_mesh_appears_upright_and_its_floor_is_below(tmp_path: Path, up: str, top: int) -> None:
    corners = np.array([(1, 2, 4), (3, 5, 9), (2, 7, 5)])
    (tmp_path / "m.obj").write_text("".join(f"v {x} {y} {z}\n" for x, y, z in corners) + "f 1 2 3\n")
    with pytest.warns(SceneWarning, match="grey floor"):
        scene = load_scene(tmp_path / "m.obj", up=up, floor=True)
    thing, floor = scene.objects
    axes = thing.transform[:3, :3]
    assert np.array_equal(axes @ np.eye(3)[top], (0, 1, 0)) and np.linalg.det(axes) == 1.0
    height = floor.mesh.vertices[:, 1]
    assert np.ptp(height) == 0.0 and height[0] == pytest.approx(corners[:, top].min(), abs=1e-3)
    assert height[0] < corners[:, top].min()


def test_up_and_floor_are_refused_for_scene_files_and_wrong_values(tmp_path: Path) -> None:
    (tmp_path / "a.toml").write_text("")
    for wrong in ({"up": "z"}, {"floor": True}):
        with refused(*wrong, "mesh files alone"):
            load_scene(tmp_path / "a.toml", **wrong)
    with refused("up", "one of x, y, z"):
        load_scene(tmp_path / "a.toml", up="w")


# --- the schema -------------------------------------------------------------------------------------------------------


def test_schema_describes_every_field() -> None:
    document = schema()
    json.dumps(document)
    tables: dict[str, Any] = {"": document, **document["$defs"]}
    assert len(tables) > 20
    for name, table in tables.items():
        assert table["additionalProperties"] is False and table["description"], name
        for field, described in table["properties"].items():
            assert described.get("description") or "const" in described, f"{name}.{field}"
