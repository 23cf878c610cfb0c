"""Files that require Draco: the meshes that DracoPy compressed, in the accessors' types."""

import sys
from typing import Any

import numpy as np
import pytest

from tests.gltf_files import GltfFile
from tests.refused import refused
from wrt.io.gltf.reader import load_gltf
from wrt.scene.shapes import icosphere

BALL = icosphere(2)
MISSING = "DracoPy is not installed"


def compressed(required: bool = True, damaged: bool = False) -> GltfFile:
    """Return a file with a compressed ball and normals; its accessors have no data if it requires the extension."""
    DracoPy = pytest.importorskip("DracoPy", reason=MISSING)
    normals = BALL.vertices.astype(np.float64)
    data = DracoPy.encode(BALL.vertices, BALL.faces.astype(np.uint32), quantization_bits=16, preserve_order=True, normals=normals)
    ids = {each["attribute_type"]: each["unique_id"] for each in DracoPy.decode(data).attributes}  # 0: position, 1: normal
    file = GltfFile()
    primitive = file.primitive(BALL.vertices, BALL.faces.reshape(-1))
    primitive["attributes"]["NORMAL"] = file.accessor(BALL.vertices)
    view = file.view(data[60:] if damaged else data)
    primitive["extensions"] = {"KHR_draco_mesh_compression": {"bufferView": view, "attributes": {"POSITION": ids[0], "NORMAL": ids[1]}}}
    file.json["extensionsUsed"] = ["KHR_draco_mesh_compression"]
    if required:
        file.json["extensionsRequired"] = ["KHR_draco_mesh_compression"]
        for accessor in file.json["accessors"]:
            del accessor["bufferView"]
    file.node(mesh=file.mesh(primitive))
    return file


def test_a_compressed_mesh_is_the_mesh_within_its_quantization(tmp_path) -> None:
    mesh = load_gltf(compressed().write(tmp_path), staged=False).objects[0].mesh
    assert np.array_equal(mesh.faces, BALL.faces) and mesh.normals is not None
    assert 0.0 < np.abs(mesh.vertices - BALL.vertices).max() < 2.0**-15    # 16 bits over an extent of 2
    assert np.abs(mesh.normals - BALL.vertices).max() < 0.02


def test_a_strip_holds_the_triangles_of_its_data(tmp_path) -> None:
    """The accessor of the indices counts the corners of a strip; Draco itself holds triangles."""
    file = compressed()
    file.json["meshes"][0]["primitives"][0]["mode"] = 5
    file.json["accessors"][1]["count"] = 400
    assert np.array_equal(load_gltf(file.write(tmp_path), staged=False).objects[0].mesh.faces, BALL.faces)


def test_plain_accessors_are_read_if_the_file_has_them(tmp_path) -> None:
    mesh = load_gltf(compressed(required=False).write(tmp_path), staged=False).objects[0].mesh
    assert np.array_equal(mesh.vertices, BALL.vertices)


def broken(change: Any) -> GltfFile:
    file = compressed()
    change(file.json["meshes"][0]["primitives"][0], file.json["accessors"])
    return file


@pytest.mark.parametrize("change, what", [
    (lambda primitive, accessors: accessors[0].update(count=7), "decodes to (162, 3) numbers, but accessors[0] has (7, 3)"),
    (lambda primitive, accessors: primitive.update(mode=6), "mode 4 or 5"),
    (lambda primitive, accessors: primitive["extensions"]["KHR_draco_mesh_compression"]["attributes"].update(NORMAL=77),
     "an attribute of the primitive and of the compressed mesh"),
    (lambda primitive, accessors: primitive["extensions"]["KHR_draco_mesh_compression"].update(bufferView=77), "there are"),
])
def test_what_does_not_fit_is_refused(tmp_path, change: Any, what: str) -> None:
    with refused(what=what):
        load_gltf(broken(change).write(tmp_path))


def test_damaged_data_are_refused(tmp_path) -> None:
    with refused(what="is not a mesh that Draco compressed"):
        load_gltf(compressed(damaged=True).write(tmp_path))


def test_without_the_decoder_the_message_names_the_extra(tmp_path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "DracoPy", None)  # as if it were not installed
    file = GltfFile()
    primitive = file.primitive(BALL.vertices, BALL.faces.reshape(-1))
    primitive["extensions"] = {"KHR_draco_mesh_compression": {"bufferView": file.view(b"DRACO"), "attributes": {"POSITION": 0}}}
    file.json["extensionsRequired"] = ["KHR_draco_mesh_compression"]
    file.node(mesh=file.mesh(primitive))
    with refused(what="a glTF file with Draco compression needs DracoPy", hint='pip install "wrt[draco]"'):
        load_gltf(file.write(tmp_path))
