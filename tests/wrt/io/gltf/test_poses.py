"""Skinned meshes and morph targets of glTF files, as they stand without animation."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import wrt
from tests.gltf_files import TRIANGLE, GltfFile, load_warned, one_triangle
from tests.refused import refused
from tests.wrt.io.gltf.test_reader import face_normals, load, matrix_of, random_trs
from wrt.scene.mesh import Mesh

FIRST = np.array([[1, 0, 0, 0]] * 3, np.float32)


def skinned(joints: Any = FIRST * 0, weights: Any = FIRST, inverse: Any = None,
            poses: tuple[dict[str, Any], ...] = ({"scale": [0.01] * 3},),
            dtype: str = "float32", normals: Any = None) -> GltfFile:
    """Return a file with a skinned triangle, whose node is moved by 10, and with a joint for each of `poses`, below a common parent."""
    file = one_triangle()
    attributes = file.json["meshes"][0]["primitives"][0]["attributes"]
    attributes |= {"JOINTS_0": file.accessor(joints, "uint8"),
                   "WEIGHTS_0": file.accessor(weights, dtype, **({} if dtype == "float32" else {"normalized": True}))}
    if normals is not None:
        attributes["NORMAL"] = file.accessor(normals)
    nodes = [file.node(**pose) for pose in poses]
    file.node(children=nodes, translation=[0, 0, 3])
    skin = {"joints": nodes}
    if inverse is not None:
        skin["inverseBindMatrices"] = file.accessor([matrix.T.ravel() for matrix in inverse])
    file.json["nodes"][0] |= {"skin": file.add("skins", skin), "translation": [10, 0, 0]}
    return file


def only(file: GltfFile, folder: Path) -> Mesh:
    (thing,) = load(file, folder).objects
    assert np.array_equal(thing.transform, np.eye(4))
    return thing.mesh


def test_the_joints_place_a_skinned_mesh_and_its_own_node_does_not(tmp_path):
    file = skinned()
    expected = TRIANGLE * np.float32(0.01) + [0, 0, 3]
    assert only(file, tmp_path).positions == pytest.approx(expected)
    file.json["nodes"][0]["scale"] = [0, 0, 0]
    assert only(file, tmp_path).positions == pytest.approx(expected)
    hits = wrt.build(file.write(tmp_path)).closest_hit([0.002, 0.002, 9], [0, 0, -1])
    assert hits.t == pytest.approx(6.0)


@pytest.mark.parametrize("dtype", ["float32", "uint8"])
@pytest.mark.parametrize("seed", range(3))
def test_positions_and_normals_follow_the_mean_of_the_joints(tmp_path, seed, dtype):
    rng = np.random.default_rng(seed)
    poses = tuple(random_trs(rng) for _ in range(3))
    inverse = [matrix_of(random_trs(rng)).astype(np.float32) for _ in poses]
    joints, weights = rng.integers(0, 3, (3, 4)), rng.uniform(0.1, 1, (3, 4))
    weights = np.rint(weights * 200) if dtype == "uint8" else weights
    joints[0, 3], weights[0, 3] = 99, 0  # the joint of a weight of 0 may be anything
    normals = rng.normal(size=(3, 3)).astype(np.float32)
    mesh = only(skinned(joints, weights, inverse, poses, dtype, normals), tmp_path)
    parent = matrix_of({"translation": [0, 0, 3]})
    for i in range(3):
        matrix = sum(w * (parent @ matrix_of(poses[j]) @ inverse[j]) for j, w in zip(joints[i], weights[i], strict=True) if w)
        matrix = matrix / weights[i].sum()
        assert mesh.positions[i] == pytest.approx((matrix @ [*TRIANGLE[i], 1])[:3], rel=1e-5, abs=1e-5)
        normal = np.linalg.inv(matrix[:3, :3]).T @ normals[i]
        assert mesh.normals[i] == pytest.approx(normal / np.linalg.norm(normal), abs=1e-4)


def test_weights_without_a_sum_stand_for_the_first_joint_and_joints_that_mirror_turn_the_faces(tmp_path):
    mesh = only(skinned(weights=FIRST * 0, poses=({"scale": [-1, 1, 1]},)), tmp_path)
    assert sorted(mesh.vertices.tolist()) == [[-1, 0, 3], [0, 0, 3], [0, 1, 3]]
    assert face_normals(mesh)[0] == pytest.approx([0, 0, 1])


def test_eight_joints_and_a_primitive_without_joints(tmp_path):
    file = skinned(weights=FIRST * 0.5, poses=({}, {"translation": [0, 4, 0]}))
    first = file.json["meshes"][0]["primitives"][0]
    first["attributes"] |= {"JOINTS_1": file.accessor(FIRST, "uint16"), "WEIGHTS_1": file.accessor(FIRST * 0.5)}
    file.json["meshes"][0]["primitives"].append({"attributes": {"POSITION": first["attributes"]["POSITION"]}})
    scene, messages = load_warned(file.write(tmp_path), staged=False)
    assert scene.objects[0].mesh.vertices == pytest.approx(TRIANGLE + [0, 2, 3])
    assert scene.objects[1].transform[:3, 3].tolist() == [10, 0, 0] and "skins without JOINTS_0" in messages[0]


@pytest.mark.parametrize("change, message", [
    (lambda f: f.json["nodes"][0].update(skin=4), (None, "is 4, but there are 1 skins")),
    (lambda f: f.json["skins"][0].update(joints=[9]), (None, "is 9, but there are 3 nodes", "skins[0].joints[0]")),
    (lambda f: f.json["skins"][0].update(joints=[]), (None, "one joint or more", "skins[0].joints")),
    (lambda f: f.json["skins"][0].update(inverseBindMatrices=0), (None, "type MAT4", "skins[0].inverseBindMatrices")),
    (lambda f: f.json["accessors"][1].update(count=2), (None, "but POSITION has 3")),
])
def test_wrong_skins(tmp_path, change, message):
    file = skinned()
    change(file)
    with refused(*message):
        load(file, tmp_path)


# --- morph targets ----------------------------------------------------------------------------------------------------


def test_morph_targets_with_the_weights_of_the_mesh_or_of_its_node(tmp_path):
    file = one_triangle()
    primitive = file.json["meshes"][0]["primitives"][0]
    up, side = file.accessor(TRIANGLE * 0 + [0, 0, 5]), file.accessor(TRIANGLE * 0 + [127, 0, 0], "int8", normalized=True)
    rows, values = file.view(bytes([2])), file.view(np.float32([0, 7, 0]).tobytes())
    sparse = file.add("accessors", {"componentType": 5126, "count": 3, "type": "VEC3", "sparse": {
        "count": 1, "indices": {"bufferView": rows, "componentType": 5121}, "values": {"bufferView": values}}})
    primitive["targets"] = [{"POSITION": up}, {"POSITION": side}, {"POSITION": sparse}, {"POSITION": 99}]
    expected = {None: [0, 0, 0, 0], (1.0,): [0, 0, 5, 0], (0.5, -2.0, 1.0, 0.0): [-2, 0, 2.5, 7]}
    file.node(mesh=0, weights=[0, 1, 0, 0], translation=[0, 0, 1])
    for weights, (x, y, z, third) in expected.items():
        if weights:
            file.json["meshes"][0]["weights"] = list(weights)
        first, second = load(file, tmp_path).objects
        assert first.mesh.vertices == pytest.approx(TRIANGLE + [x, y, z] + np.outer([0, 0, 1], [0, third, 0]))
        assert second.mesh.vertices == pytest.approx(TRIANGLE + [1, 0, 0])  # the node's own weights come first


def test_normals_and_skins_of_a_morphed_mesh(tmp_path):
    file = skinned(normals=TRIANGLE * 0 + [0, 0, 1])
    file.json["meshes"][0]["primitives"][0]["targets"] = [{"POSITION": file.accessor(TRIANGLE), "NORMAL": file.accessor(
        TRIANGLE * 0 + [0, 6, 0])}]
    file.json["nodes"][0]["weights"] = [0.5]
    mesh = only(file, tmp_path)
    assert mesh.positions == pytest.approx(TRIANGLE * 0.015 + [0, 0, 3])
    assert mesh.normals == pytest.approx(np.array([[0, 3, 1]] * 3) / np.sqrt(10))


def test_a_target_that_does_not_fit(tmp_path):
    file = one_triangle()
    file.json["meshes"][0] |= {"weights": [1]}
    file.json["meshes"][0]["primitives"][0]["targets"] = [{"POSITION": file.accessor(TRIANGLE[:2])}]
    with refused(what="has 2 elements"):
        load(file, tmp_path)
