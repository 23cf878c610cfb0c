"""Files that require meshopt compression: the arrays that meshopt compressed, quantised or filtered."""

import sys
from typing import Any

import numpy as np
import pytest

from tests.data import data_path
from tests.gltf_files import GltfFile
from tests.refused import refused
from wrt.core.errors import InputError
from wrt.io.gltf.document import MESHOPT as NAMES
from wrt.io.gltf.reader import load_gltf
from wrt.scene.shapes import icosphere

BALL = icosphere(2)
MISSING = "meshopt is not installed"


def packed(file: GltfFile, rows: np.ndarray, mode: str = "ATTRIBUTES", name: str = NAMES[1], filter: str = "NONE", version: int = 0) -> int:
    """Add a compressed buffer view of a fallback buffer without data: rows (N, bytes) uint8, or indices (N,)."""
    meshopt = pytest.importorskip("meshopt", reason=MISSING)
    plain = file.view(meshopt.encode_gltf_buffer(rows, mode, version))
    source = {**file.json["bufferViews"][plain], "byteStride": rows.nbytes // len(rows), "count": len(rows), "mode": mode, "filter": filter}
    stride = {"byteStride": rows.shape[1]} if rows.ndim == 2 else {}
    return file.add("bufferViews", {"buffer": 1, "byteLength": rows.nbytes, **stride, "extensions": {name: source}})


def compressed(name: str = NAMES[1], version: int = 0, mode: str = "TRIANGLES", index: type = np.uint16) -> GltfFile:
    """Return a file with a ball: positions of 16 bits (KHR_mesh_quantization), octahedral normals, exponential texture coordinates."""
    meshopt = pytest.importorskip("meshopt", reason=MISSING)
    file, count = GltfFile(), len(BALL.vertices)
    short = np.zeros((count, 4), np.int16)  # rows are padded to 8 bytes
    short[:, :3] = np.rint(BALL.vertices * 32767.0)
    normals = meshopt.encode_filter_oct(np.concatenate([BALL.vertices, np.ones((count, 1))], axis=1), 4, 8)
    uvs = meshopt.encode_filter_exp(np.abs(BALL.vertices[:, :2]), 15)
    views = [packed(file, rows, name=name, version=version, filter=filter) for rows, filter in (
        (short.view(np.uint8), "NONE"), (normals, "OCTAHEDRAL"), (uvs, "EXPONENTIAL"))]
    types = (("POSITION", 5122, "VEC3"), ("NORMAL", 5120, "VEC3"), ("TEXCOORD_0", 5126, "VEC2"))
    attributes = {attribute: file.add("accessors", {
        "bufferView": view, "componentType": code, "count": count, "type": kind, "normalized": code != 5126})
        for view, (attribute, code, kind) in zip(views, types, strict=True)}
    indices = packed(file, BALL.faces.reshape(-1).astype(index), mode, name)
    primitive = {"attributes": attributes, "indices": file.add("accessors", {
        "bufferView": indices, "componentType": {2: 5123, 4: 5125}[np.dtype(index).itemsize], "count": BALL.faces.size, "type": "SCALAR"})}
    file.node(mesh=file.mesh(primitive))
    file.json["extensionsUsed"] = file.json["extensionsRequired"] = [name, "KHR_mesh_quantization"]
    file.json["buffers"] = [{"byteLength": len(file.binary)}, {"byteLength": 1 << 20, "extensions": {name: {"fallback": True}}}]
    return file


@pytest.mark.parametrize("name, version, mode, index", [
    (NAMES[1], 0, "TRIANGLES", np.uint16), (NAMES[1], 0, "INDICES", np.uint32), (NAMES[0], 1, "TRIANGLES", np.uint32)])
def test_a_compressed_mesh_is_the_mesh_within_its_rounding(tmp_path, name: str, version: int, mode: str, index: type) -> None:
    mesh = load_gltf(compressed(name, version, mode, index).write(tmp_path), staged=False).objects[0].mesh
    # The encoder of triangles may begin a triangle with any of its corners.
    turned = [np.roll(BALL.faces, shift, axis=1) for shift in range(3)]
    assert np.logical_or.reduce([(mesh.faces == faces).all(axis=1) for faces in turned]).all()
    assert np.abs(mesh.vertices - BALL.vertices).max() < 0.51 / 32767.0
    assert np.abs(mesh.normals - BALL.vertices).max() < 0.02 and np.abs(mesh.uvs - np.abs(BALL.vertices[:, :2])).max() < 2.0**-13


def test_a_box_by_gltfpack() -> None:
    pytest.importorskip("meshopt", reason=MISSING)
    scene = load_gltf(data_path("odd/BoxMeshopt.glb"), staged=False)
    mesh = scene.objects[0].mesh
    a, b, c = (mesh.vertices[mesh.faces[:, i]].astype(np.float64) for i in range(3))
    across = np.cross(b - a, c - a)
    assert np.array(scene.bounds()) == pytest.approx(np.array([[-0.5] * 3, [0.5] * 3]), abs=1e-6) and len(mesh.faces) == 12
    assert np.allclose(across / np.linalg.norm(across, axis=1)[:, None], mesh.normals[mesh.faces[:, 0]], atol=1e-6)


def test_plain_buffers_are_read_if_the_file_has_them(tmp_path) -> None:
    file = GltfFile()
    primitive = file.primitive(BALL.vertices, BALL.faces.reshape(-1))
    file.json["bufferViews"][0]["extensions"] = {NAMES[1]: {"buffer": 0, "byteLength": 1, "byteStride": 4, "count": 1, "mode": "?"}}
    file.node(mesh=file.mesh(primitive))
    assert np.array_equal(load_gltf(file.write(tmp_path), staged=False).objects[0].mesh.vertices, BALL.vertices)


@pytest.mark.parametrize("change, what", [
    ({"count": 7}, "7 elements of 8 bytes do not fill the 1296 bytes"), ({"byteStride": 12}, "do not fill"),
    ({"byteLength": 1}, "1 bytes of data are too few for 1296"), ({"byteLength": 60}, "is not data that meshoptimizer compressed"),
    ({"count": -162, "byteStride": -8}, "do not fill"), ({"mode": "TREE"}, "mode must be ATTRIBUTES"),
    ({"filter": "OCTAGONAL"}, "filter must be"), ({"byteOffset": 1 << 30}, "reach outside of buffers[0]"),
    ({"buffer": 9}, "there are 2 buffers"),
    ({"byteOffset": 4}, "is not data that"),
])
def test_what_does_not_fit_is_refused(tmp_path, change: dict[str, Any], what: str) -> None:
    file = compressed()
    file.json["bufferViews"][1]["extensions"][NAMES[1]].update(change)
    with refused(what=what) as caught:
        load_gltf(file.write(tmp_path))
    assert f"bufferViews[1].extensions.{NAMES[1]}" in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.filterwarnings("ignore::wrt.core.errors.SceneWarning")  # texture coordinates are left out
def test_damaged_streams_are_refused_or_read(tmp_path) -> None:
    file, rng, refusals = compressed(), np.random.default_rng(0), 0
    whole = bytes(file.binary)
    for _ in range(150):
        for at in rng.integers(0, len(whole), rng.integers(1, 6)):
            file.binary[at] = rng.integers(0, 256)
        try:
            load_gltf(file.write(tmp_path), staged=False)
        except InputError as error:
            refusals += 1
            assert "\n" not in str(error)
        file.binary[:] = whole
    assert refusals > 20


def test_without_the_decoder_the_message_names_the_extra(tmp_path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "meshopt", None)  # as if it were not installed
    with refused(what="a glTF file with meshopt compression needs meshopt", hint='pip install "wrt[meshopt]"'):
        load_gltf(data_path("odd/BoxMeshopt.glb"))
