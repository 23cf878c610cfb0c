"""glTF scenes: node graph, triangles, instances, cameras and lights."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tests.gltf_files import TRIANGLE, GltfFile, load_warned, one_triangle, with_light
from tests.refused import refused
from wrt.io.gltf.reader import load_gltf
from wrt.scene.cameras import OrthographicCamera
from wrt.scene.lights import DirectionalLight, PointLight, SpotLight
from wrt.scene.model import Scene

SQUARE = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], np.float32)


def load(file: GltfFile, folder: Path) -> Scene:
    """Load the scene without additions; any warning fails the test."""
    return load_gltf(file.write(folder), staged=False)


def matrix_of(node: dict[str, Any]) -> np.ndarray:
    """Return a node's transform by SciPy's rotations, to compare the reader with."""
    matrix = np.eye(4)
    rotation = Rotation.from_quat(node.get("rotation", [0, 0, 0, 1])).as_matrix()
    matrix[:3, :3] = rotation @ np.diag(node.get("scale", [1, 1, 1]))
    matrix[:3, 3] = node.get("translation", [0, 0, 0])
    return matrix


def random_trs(rng: np.random.Generator) -> dict[str, Any]:
    return {"translation": rng.normal(size=3).tolist(), "rotation": rng.normal(size=4).tolist(),
            "scale": (rng.uniform(0.2, 3, 3) * rng.choice([-1, 1], 3)).tolist()}


def face_normals(mesh: Any) -> np.ndarray:
    a, b, c = mesh.vertices[mesh.faces].astype(np.float64).transpose(1, 0, 2)
    return np.cross(b - a, c - a)


# --- the node graph ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(5))
def test_transforms_multiply_along_the_path(tmp_path, seed):
    rng = np.random.default_rng(seed)
    a, b, c = (random_trs(rng) for _ in range(3))
    file = GltfFile()
    mesh = file.mesh(file.primitive())
    leaf = file.node(mesh=mesh, **c)
    middle = file.node(children=[leaf], mesh=mesh, **b)
    file.node(children=[middle], matrix=matrix_of(a).T.ravel().tolist())  # column by column
    outer, inner = load(file, tmp_path).objects
    assert outer.transform == pytest.approx(matrix_of(a) @ matrix_of(b))
    assert inner.transform == pytest.approx(matrix_of(a) @ matrix_of(b) @ matrix_of(c))
    assert np.sign(np.linalg.det(inner.transform)) == np.sign(np.prod([a["scale"], b["scale"], c["scale"]]))


def test_the_default_scene_is_shown(tmp_path):
    file = GltfFile()
    mesh = file.mesh(file.primitive())
    for name in "abc":
        file.node(mesh=mesh, name=name)
    assert [o.name for o in load(file, tmp_path).objects] == ["a", "b", "c"]  # no scenes: every root
    file.json["scenes"] = [{"nodes": [0]}, {"nodes": [2, 1]}]
    assert [o.name for o in load(file, tmp_path).objects] == ["a"]
    file.json["scene"] = 1
    assert [o.name for o in load(file, tmp_path).objects] == ["c", "b"]
    file.json["scene"] = 2
    with refused(what="2, but there", place="scene"):
        load(file, tmp_path)


@pytest.mark.parametrize("children, message", [
    ({0: [1], 1: [2], 2: [0]}, (None, "node graph", "nodes[0]")),
    ({0: [1], 2: [2]}, (None, "node graph", "nodes[2]")),
    ({0: [2], 1: [2]}, (None, "two parents", "nodes[1].children[0]")),
    ({0: [1, 1]}, (None, "two parents", "nodes[0].children[1]")),
    ({0: [7]}, (None, "7, but there", "nodes[0].children[0]")),
    ({0: [0.5]}, (None, "integer", "nodes[0].children[0]")),
])
def test_graphs_that_are_no_forest(tmp_path, children, message):
    file = GltfFile()
    for i in range(3):
        file.node(children=children.get(i, []))
    with refused(*message):
        load(file, tmp_path)


@pytest.mark.parametrize("fields, message", [
    ({"matrix": [1.0] * 15}, (None, "hold 16 numbers", "nodes[0].matrix")),
    ({"matrix": [1.0] * 16}, ("it", "affine", "nodes[0].matrix")),
    ({"scale": [1, "1", 1]}, (None, "number", "nodes[0].scale[1]")),
    ({"rotation": [0, 0, 0, 0]}, (None, "unit quaternion", "nodes[0].rotation")),
    ({"mesh": 3}, (None, "3, but there", "nodes[0].mesh")),
])
def test_wrong_nodes(tmp_path, fields, message):
    file = one_triangle()
    file.json["nodes"][0].update(fields)
    with refused(*message):
        load(file, tmp_path)


def test_a_rotation_may_have_any_length(tmp_path):
    for length in (1e-200, 1e-30, 1.0, 1e200):
        file = one_triangle()
        file.json["nodes"][0]["rotation"] = [0, 0, length, length]
        assert load(file, tmp_path).objects[0].transform @ [1, 0, 0, 1] == pytest.approx([0, 1, 0, 1])


# --- triangles --------------------------------------------------------------------------------------------------------


def zigzag(count: int) -> np.ndarray:
    i = np.arange(count)
    return np.stack([i // 2, -(i % 2), 0 * i], axis=1).astype(np.float32)


@pytest.mark.parametrize("indexed", [True, False])
@pytest.mark.parametrize("count", [3, 4, 9, 10])
def test_strips_face_one_way(tmp_path, count, indexed):
    """Points that alternate between two rails: every triangle has the area 1/2 and must face the side that the first faces."""
    vertices = zigzag(count)
    order = np.random.default_rng(count).permutation(count) if indexed else np.arange(count)
    shuffled = np.empty_like(vertices)
    shuffled[order] = vertices
    file = one_triangle(vertices=shuffled, indices=order if indexed else None, mode=5)
    mesh = load(file, tmp_path).objects[0].mesh
    normals = face_normals(mesh)
    assert len(mesh.faces) == count - 2
    assert normals == pytest.approx(np.tile(normals[0], (count - 2, 1)))
    corners = mesh.vertices[mesh.faces]
    for i in range(count - 2):  # triangle i holds the points i, i + 1, i + 2
        assert sorted(map(tuple, corners[i])) == sorted(map(tuple, vertices[i:i + 3]))


@pytest.mark.parametrize("count", [3, 5, 8])
def test_fans_face_one_way(tmp_path, count):
    angle = np.linspace(0, math.pi, count - 1)
    rim = np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    mesh = load(one_triangle(vertices=np.vstack([[0, 0, 0], rim]), mode=6), tmp_path).objects[0].mesh
    assert len(mesh.faces) == count - 2 and (face_normals(mesh)[:, 2] > 0).all()
    area = 0.5 * (count - 2) * math.sin(math.pi / (count - 2))  # of the polygon
    assert 0.5 * face_normals(mesh)[:, 2].sum() == pytest.approx(area, abs=1e-6)


def test_points_and_lines_are_named_once(tmp_path):
    file = GltfFile()
    file.node(mesh=file.mesh(*(file.primitive(mode=mode) for mode in range(5)), name="mixed"))
    scene, messages = load_warned(file.write(tmp_path), staged=False)
    assert len(scene.objects) == 1
    assert len(messages) == 1 and messages[0].endswith("left out: points (mesh 'mixed'), lines (mesh 'mixed')")


def test_an_incomplete_last_triangle_is_named(tmp_path):
    path = one_triangle(vertices=SQUARE, indices=[0, 1, 2, 0, 2]).write(tmp_path)
    scene, messages = load_warned(path, staged=False)
    assert len(scene.objects[0].mesh.faces) == 1 and "incomplete last triangles (mesh 'thing')" in messages[0]


def test_attributes(tmp_path):
    file = one_triangle()
    mesh = load(file, tmp_path).objects[0].mesh
    assert mesh.normals is None and mesh.uvs is None  # flat, as the specification demands
    attributes = file.json["meshes"][0]["primitives"][0]["attributes"]
    attributes["NORMAL"] = file.accessor([[0, 0, 3], [0, 4, 0], [0, 0, 0]])
    attributes["TEXCOORD_0"] = file.accessor([[0, 0], [255, 51], [0, 255]], "uint8", normalized=True)
    mesh = load(file, tmp_path).objects[0].mesh
    assert np.array_equal(mesh.normals, [[0, 0, 1], [0, 1, 0], [0, 0, 0]])
    assert mesh.uvs == pytest.approx(np.array([[0, 0], [1, 0.2], [0, 1]]))


def test_quantised_mesh(tmp_path):
    """Integer positions that the node's transform brings back, and normalised normals in padded rows."""
    file = GltfFile()
    normals = np.array([[0, 0, 127, 0], [0, -128, 0, 0], [90, 90, 0, 0]], np.int8)
    view = file.view(normals.tobytes(), byteStride=4)
    normal = file.add("accessors", {"bufferView": view, "componentType": 5120, "normalized": True, "count": 3,
                                    "type": "VEC3"})
    position = file.accessor((TRIANGLE * 1000).astype(np.int16), "int16")
    file.node(mesh=file.mesh({"attributes": {"POSITION": position, "NORMAL": normal}}), scale=[1e-3] * 3)
    file.json["extensionsRequired"] = ["KHR_mesh_quantization"]
    thing = load(file, tmp_path).objects[0]
    assert (np.c_[thing.mesh.vertices, np.ones(3)] @ thing.transform.T)[:, :3] == pytest.approx(TRIANGLE)
    half = math.sqrt(0.5)
    assert thing.mesh.normals == pytest.approx(np.array([[0, 0, 1], [0, -1, 0], [half, half, 0]]))


def test_what_is_shared_in_the_file_is_shared_in_the_scene(tmp_path):
    file = GltfFile()
    red, blue = (file.add("materials", {"name": name}) for name in ("red", "blue"))
    first = file.primitive(SQUARE, [0, 1, 2], material=red)
    same = {**first, "material": blue}
    other = {**first, "indices": file.accessor([0, 2, 3], "uint16")}
    mesh = file.mesh(first)
    for index in (mesh, mesh, file.mesh(same), file.mesh(other)):
        file.node(mesh=index)
    a, b, c, d = load(file, tmp_path).objects
    assert a.mesh is b.mesh is c.mesh and a.mesh is not d.mesh
    assert a.materials[0] is b.materials[0] is d.materials[0] and c.materials[0].name == "blue"


def test_instances_share_a_mesh_and_follow_their_node(tmp_path):
    rng = np.random.default_rng(7)
    parent, items = random_trs(rng), [random_trs(rng) for _ in range(6)]
    file = one_triangle()
    unit = [(np.array(i["rotation"]) / np.linalg.norm(i["rotation"])).tolist() for i in items]
    attributes = {"TRANSLATION": file.accessor([i["translation"] for i in items]), "ROTATION": file.accessor(unit),
                  "SCALE": file.accessor([i["scale"] for i in items]), "_ID": file.accessor(np.arange(6), "uint16")}
    file.json["nodes"][0] |= {**parent, "extensions": {"EXT_mesh_gpu_instancing": {"attributes": attributes}}}
    objects = load(file, tmp_path).objects
    assert len(objects) == 6 and len({id(o.mesh) for o in objects}) == 1
    for thing, item in zip(objects, items, strict=True):
        assert thing.transform == pytest.approx(matrix_of(parent) @ matrix_of(item), rel=1e-5, abs=1e-5)


@pytest.mark.parametrize("attributes, message", [
    ({}, (None, "hold accessors", "nodes[0].extensions.EXT_mesh_gpu_instancing.attributes")),
    ({"TRANSLATION": 1, "SCALE": 2}, (None, "hold accessors", "nodes[0].extensions.EXT_mesh_gpu_instancing.attributes")),
    ({"TRANSLATION": 3}, (None, "type VEC3", "nodes[0].extensions.EXT_mesh_gpu_instancing.attributes.TRANSLATION")),
    ({"ROTATION": 3}, (None, "quaternions", "nodes[0].extensions.EXT_mesh_gpu_instancing.attributes.ROTATION")),
])
def test_wrong_instances(tmp_path, attributes, message):
    file = one_triangle()
    for array in (np.zeros((2, 3)), np.zeros((3, 3)), np.zeros((2, 4))):
        file.accessor(array)
    file.json["nodes"][0]["extensions"] = {"EXT_mesh_gpu_instancing": {"attributes": attributes}}
    with refused(*message):
        load(file, tmp_path)


@pytest.mark.parametrize("change, message", [
    (lambda f, p: p.update(indices=f.accessor([0, 1, 3], "uint16")),
     (None, "index 2 is 3", "meshes[0].primitives[0].indices")),
    (lambda f, p: p.update(indices=f.accessor([0, 1, 2], "int16")), (None, "unsigned", "meshes[0].primitives[0].indices")),
    (lambda f, p: p.update(mode=9), (None, "0 to 6", "meshes[0].primitives[0].mode")),
    (lambda f, p: p.update(material=2), (None, "2, but there", "meshes[0].primitives[0].material")),
    (lambda f, p: p.update(attributes="POSITION"), (None, "object", "meshes[0].primitives[0].attributes")),
    (lambda f, p: p["attributes"].update(POSITION=f.accessor([[0, 0, 0], [np.nan, 0, 0], [0, 1, 0]])),
     (None, "element 1", "meshes[0].primitives[0].attributes.POSITION: accessors[1]")),
    (lambda f, p: f.json["accessors"][0].update(count=4),
     (None, "4 elements reach", "meshes[0].primitives[0].attributes.POSITION: accessors[0]")),
    (lambda f, p: f.json.update(meshes={}), (None, "array", "meshes")),
])
def test_wrong_primitives(tmp_path, change, message):
    file = one_triangle()
    change(file, file.json["meshes"][0]["primitives"][0])
    path = file.write(tmp_path)
    with refused(*message, path=path):
        load_gltf(path)


# --- cameras and lights -----------------------------------------------------------------------------------------------


def test_cameras_have_the_pose_of_their_node(tmp_path):
    file = one_triangle()
    camera = file.add("cameras", {"type": "perspective", "name": "lens", "perspective": {"yfov": 0.7, "znear": 0.1}})
    rng = np.random.default_rng(1)
    outer, inner = random_trs(rng), random_trs(rng)
    outer["scale"], inner["scale"] = [2, 2, 2], [5, 5, 5]  # a camera ignores scale
    file.node(children=[file.node(camera=camera, name="left", **inner)], **outer)
    file.node(camera=camera, translation=[0, 0, 9])
    left, right = load(file, tmp_path).cameras
    turn = [Rotation.from_quat(node["rotation"]).as_matrix() for node in (outer, inner)]
    assert left.camera_to_world[:3, :3] == pytest.approx(turn[0] @ turn[1])
    assert left.camera_to_world[:3, 3] == pytest.approx((matrix_of(outer) @ matrix_of(inner))[:3, 3])
    assert (left.name, left.fov_y, right.name) == ("left", 0.7, "lens")
    assert right.camera_to_world @ [0, 0, -9, 1] == pytest.approx([0, 0, 0, 1])  # it looks along -z


def test_an_orthographic_camera_is_as_high_as_its_ymag_says(tmp_path):
    file = one_triangle()
    plan = file.add("cameras", {"type": "orthographic", "orthographic": {"xmag": 3, "ymag": 1.5, "zfar": 9, "znear": 0}})
    file.node(camera=plan, name="plan", translation=[0, 0, 4])
    (camera,) = load(file, tmp_path).cameras
    assert isinstance(camera, OrthographicCamera) and (camera.name, camera.height) == ("plan", 3.0)
    assert camera.camera_to_world[:3, 3].tolist() == [0, 0, 4]


@pytest.mark.parametrize("camera, message", [
    ({"type": "perspective"}, (None, "'perspective'", "cameras[0].type")),
    ({"type": "fisheye"}, (None, "'perspective'", "cameras[0].type")),
    ({"type": "perspective", "perspective": {}}, (None, "required", "cameras[0].perspective.yfov")),
    ({"type": "orthographic", "orthographic": {"ymag": 1}}, (None, "required", "cameras[0].orthographic.xmag")),
    ({"type": "orthographic", "orthographic": {"xmag": 1, "ymag": 0}}, ("height", "", "nodes[1].camera: camera 'camera 0'")),
    ({"type": "perspective", "perspective": {"yfov": 4}}, ("fov_y", "", "nodes[1].camera: camera 'camera 0'")),
])
def test_wrong_cameras(tmp_path, camera, message):
    file = one_triangle()
    file.node(camera=file.add("cameras", camera))
    with refused(*message):
        load(file, tmp_path)


def test_lights(tmp_path):
    half = math.sqrt(0.5)
    pose = {"translation": [1, 2, 3], "rotation": [-half, 0, 0, half], "scale": [7, 7, 7]}  # -z turns to -y
    tint = {"color": [1, 0.5, 0.25], "intensity": 4}
    point = load(with_light({"type": "point", "name": "lamp", **tint}, **pose), tmp_path).lights[0]
    assert point == PointLight((1, 2, 3), (4, 2, 1), "lamp")
    sun = load(with_light({"type": "directional", **tint}, name="sun", **pose), tmp_path).lights[0]
    assert isinstance(sun, DirectionalLight) and sun.irradiance == (4, 2, 1) and sun.name == "sun"
    assert sun.direction == pytest.approx((0, -1, 0))
    cone = {"innerConeAngle": 0.2, "outerConeAngle": 0.5}
    spot = load(with_light({"type": "spot", "spot": cone, **tint}, **pose), tmp_path).lights[0]
    assert isinstance(spot, SpotLight) and spot.position == (1, 2, 3) and spot.intensity == (4, 2, 1)
    assert spot.direction == pytest.approx((0, -1, 0)) and (spot.inner, spot.outer) == (0.2, 0.5)


@pytest.mark.parametrize("light, message", [
    ({"type": "area"}, (None, "point, directional, spot", "extensions.KHR_lights_punctual.lights[0].type")),
    ({}, (None, "required", "extensions.KHR_lights_punctual.lights[0].type")),
    ({"type": "point", "color": [1, 1]}, (None, "hold 3 numbers", "extensions.KHR_lights_punctual.lights[0].color")),
    (3, (None, "object", "extensions.KHR_lights_punctual.lights[0]")),
])
def test_wrong_lights(tmp_path, light, message):
    with refused(*message):
        load(with_light(light), tmp_path)
    assert load_gltf(with_light(light).write(tmp_path), shapes_only=True).objects  # rays need no light
    unused = with_light(light)
    unused.json["nodes"].pop()
    load(unused, tmp_path)


@pytest.mark.parametrize("light, fields, named", [
    ({"type": "spot", "spot": {"outerConeAngle": 1.5707963705062866}}, {"outer": math.pi / 2}, None),  # pi / 2 in float32
    ({"type": "spot", "spot": {"innerConeAngle": 0.50000001, "outerConeAngle": 0.5}}, {"inner": 0.5}, None),
    ({"type": "spot", "spot": {"innerConeAngle": 1, "outerConeAngle": 0.5}}, {"inner": 0.5, "outer": 0.5}, "innerConeAngle"),
    ({"type": "spot", "spot": {"outerConeAngle": 3.14}}, {"outer": math.pi / 2}, "outerConeAngle"),
    ({"type": "spot", "spot": {"innerConeAngle": -0.1, "outerConeAngle": 0}}, {"inner": 0, "outer": 1e-4}, "outerConeAngle"),
    ({"type": "point", "intensity": -1}, {"intensity": (0, 0, 0)}, "color"),
])
def test_values_of_lights_are_clamped_and_named(tmp_path, light, fields, named):
    scene, messages = load_warned(with_light(light).write(tmp_path), staged=False)
    assert {key: getattr(scene.lights[0], key) for key in fields} == fields
    assert len(messages) == bool(named) and (not named or f"{named} outside of" in messages[0])


@pytest.mark.parametrize("scale, light, camera", [
    ([0, 0, 0], {"type": "point"}, False), ([0, 0, 0], {"type": "spot"}, False), ([1, 1, 0], {"type": "directional"}, False),
    ([1, 1, 0], {"type": "point"}, True), ([0, 0, 1], {"type": "spot"}, True), ([0, 1, 1], {"type": "directional"}, True)])
def test_lights_and_cameras_below_a_scale_of_0_are_left_out(tmp_path, scale, light, camera):
    """A light stays where its own direction and position are known: a scale changes nothing else of it."""
    file = with_light(light, camera=0)
    file.add("cameras", {"type": "perspective", "perspective": {"yfov": 1, "znear": 1}})
    file.node(children=[1], scale=scale)
    scene, messages = load_warned(file.write(tmp_path), staged=False)
    kept = camera
    assert len(scene.lights) == kept and ("lights scaled to no volume" in str(messages)) != kept
    assert len(scene.cameras) == (scale == [0, 1, 1]) and ("cameras scaled" in str(messages)) == (scale != [0, 1, 1])


def test_what_a_mesh_does_not_need_cannot_refuse_it(tmp_path):
    rows = np.full((3, 3), np.nan, np.float32)
    for attribute, values, problem in (("NORMAL", rows, "not finite, now 0"), ("TEXCOORD_0", rows[:, :2], "not finite, now 0"),
                                       ("NORMAL", SQUARE, "has 4 elements"), ("TEXCOORD_0", TRIANGLE, "must be of type VEC2"),
                                       ("TANGENT", rows, "TANGENT"), ("COLOR_0", rows, "COLOR_0")):
        file = one_triangle()
        file.json["meshes"][0]["primitives"][0]["attributes"][attribute] = file.accessor(values)
        scene, messages = load_warned(file.write(tmp_path), staged=False)
        assert len(scene.objects) == 1 and (attribute == "TANGENT" or problem in messages[0])
    for found in (scene.objects[0].mesh.normals, scene.objects[0].mesh.uvs):
        assert found is None


def test_a_position_that_no_triangle_uses_may_be_anything(tmp_path):
    file = one_triangle(vertices=[*TRIANGLE, [np.nan, np.inf, 0]], indices=[0, 1, 2])
    assert load(file, tmp_path).objects[0].mesh.vertices.tolist() == TRIANGLE.tolist()


def test_numbers_that_nothing_uses_may_be_nan(tmp_path):
    file = one_triangle()
    file.json["accessors"][0] |= {"min": [math.nan, 0, 0], "max": [math.inf, 0, 0]}
    file.json["nodes"][0]["extras"] = {"weight": math.nan}
    file.add("materials", {"pbrMetallicRoughness": {"metallicFactor": math.nan}})
    file.add("animations", {"channels": [math.nan], "samplers": 3})
    file.node(translation=[math.nan, 0, 0])
    file.json |= {"scenes": [{"nodes": [0]}], "cameras": [{"type": "perspective", "perspective": {"yfov": math.inf}}]}
    scene, messages = load_warned(file.write(tmp_path), staged=False)
    assert len(scene.objects) == 1 and messages[0].endswith("left out: motion (file 'file.glb')")


def test_shapes_need_no_cameras_and_no_extensions_of_materials(tmp_path):
    file = one_triangle()
    file.node(camera=file.add("cameras", {"type": "perspective", "perspective": {"yfov": -7}}))
    file.json["extensionsRequired"] = ["KHR_texture_basisu", "KHR_materials_sheen"]
    assert len(load_gltf(file.write(tmp_path), shapes_only=True).objects) == 1
    with refused(what="KHR_texture_basisu"):
        load(file, tmp_path)


@pytest.mark.parametrize("required", [True, False])
def test_hidden_nodes_hide_all_below_them(tmp_path, required):
    file = with_light({"type": "point"}, camera=0)
    file.add("cameras", {"type": "perspective", "perspective": {"yfov": 1, "znear": 1}})
    hide = {"KHR_node_visibility": {"visible": False}}
    file.node(children=[1, file.node(mesh=0, name="below", extensions={"KHR_node_visibility": {"visible": True}})], extensions=hide)
    file.node(mesh=0, name="shown", extensions={"KHR_node_visibility": {}})
    if required:
        file.json["extensionsRequired"] = ["KHR_node_visibility"]
    scene = load(file, tmp_path)
    assert [thing.name for thing in scene.objects] == ["place", "shown"] and not scene.lights and not scene.cameras


def test_a_light_that_is_not_there(tmp_path):
    file = with_light({"type": "point"})
    del file.json["extensions"]
    with refused(what="0, but there", place="nodes[1].extensions.KHR_lights_punctual.light"):
        load(file, tmp_path)
