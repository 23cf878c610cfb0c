"""Accessors against closed forms, and against the limits of their views and buffers."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tests.gltf_files import COMPONENT, KIND, GltfFile, load_warned, one_triangle
from tests.refused import refused
from wrt.io.gltf.document import Accessors, Document


def read(file: GltfFile, folder: Path, kind: str, index: int = 0) -> np.ndarray:
    return Accessors(Document(file.write(folder))).read(index, kind, "here")


@pytest.mark.parametrize("dtype", list(COMPONENT))
@pytest.mark.parametrize("width", [1, 2, 3, 4])
def test_every_type_comes_back_as_written(tmp_path, dtype, width):
    rng = np.random.default_rng(width)
    info = np.iinfo(dtype) if dtype != "float32" else None
    values = rng.integers(info.min, info.max, (7, width), endpoint=True) if info else rng.normal(size=(7, width))
    values = values.astype(dtype)
    file = GltfFile()
    file.accessor(values)  # another one before it
    file.accessor(values if width > 1 else values[:, 0], dtype)
    array = read(file, tmp_path, KIND[width], 1)
    assert array.dtype == np.dtype(dtype) and np.array_equal(array, values)


@pytest.mark.parametrize("dtype, integers, floats", [
    ("uint8", [0, 1, 128, 255], [0, 1 / 255, 128 / 255, 1]),
    ("uint16", [0, 1, 32768, 65535], [0, 1 / 65535, 32768 / 65535, 1]),
    ("int8", [-128, -127, 0, 64, 127], [-1, -1, 0, 64 / 127, 1]),
    ("int16", [-32768, -32767, 0, 1, 32767], [-1, -1, 0, 1 / 32767, 1]),
])
def test_normalised_integers(tmp_path, dtype, integers, floats):
    file = GltfFile()
    file.accessor(np.array(integers), dtype, normalized=True)
    array = read(file, tmp_path, "SCALAR")
    assert array.dtype == np.float32
    assert np.array_equal(array[:, 0], np.array(floats, np.float32))  # each is the float32 nearest to the quotient


@pytest.mark.parametrize("dtype", ["uint32", "float32"])
def test_what_cannot_be_normalised(tmp_path, dtype):
    file = GltfFile()
    file.accessor([1, 2], dtype, normalized=True)
    with refused(what="only 8-", place="here: accessors[0].normalized"):
        read(file, tmp_path, "SCALAR")


def test_interleaved_and_unaligned_elements(tmp_path):
    rng = np.random.default_rng(0)
    record = np.zeros(5, dtype=[("pad", "u1"), ("position", "<f4", 3), ("uv", "<u2", 2)])
    record["position"], record["uv"] = rng.normal(size=(5, 3)), rng.integers(0, 65535, (5, 2))
    file = GltfFile()
    view = file.view(record.tobytes(), byteStride=record.itemsize)  # 17 bytes: no element is aligned
    file.add("accessors", {"bufferView": view, "byteOffset": 1, "componentType": 5126, "count": 5, "type": "VEC3"})
    file.add("accessors", {"bufferView": view, "byteOffset": 13, "componentType": 5123, "count": 5, "type": "VEC2"})
    assert np.array_equal(read(file, tmp_path, "VEC3", 0), record["position"])
    assert np.array_equal(read(file, tmp_path, "VEC2", 1), record["uv"])


@pytest.mark.parametrize("dense", [True, False])
@pytest.mark.parametrize("index_type", ["uint8", "uint16", "uint32"])
def test_sparse(tmp_path, dense, index_type):
    base = np.arange(30, dtype=np.float32).reshape(10, 3) if dense else np.zeros((10, 3), np.float32)
    values = -np.arange(9, dtype=np.float32).reshape(3, 3)
    file = GltfFile()
    rows = file.view(b"\7\7" + np.array([1, 4, 9], index_type).tobytes())
    replacement = file.view(values.tobytes())
    file.accessor(base, sparse={
        "count": 3, "indices": {"bufferView": rows, "byteOffset": 2, "componentType": COMPONENT[index_type]},
        "values": {"bufferView": replacement}})
    if not dense:
        del file.json["accessors"][0]["bufferView"]
    expected = base.copy()
    expected[[1, 4, 9]] = values
    assert np.array_equal(read(file, tmp_path, "VEC3"), expected)


def test_sparse_values_are_normalised_too(tmp_path):
    file = GltfFile()
    rows, values = file.view(b"\1"), file.view(b"\xff")
    file.accessor(np.array([51, 51]), "uint8", normalized=True, sparse={
        "count": 1, "indices": {"bufferView": rows, "componentType": 5121}, "values": {"bufferView": values}})
    assert read(file, tmp_path, "SCALAR")[:, 0] == pytest.approx([0.2, 1.0])


def test_arrays_are_read_once_and_are_read_only(tmp_path):
    file = GltfFile()
    file.accessor(np.eye(3))
    accessors = Accessors(Document(file.write(tmp_path)))
    first = accessors.read(0, "VEC3", "")
    assert accessors.read(0, "VEC3", "") is first and not first.flags.writeable


SPARSE = {"count": 1, "indices": {"bufferView": 1, "componentType": 5121}, "values": {"bufferView": 0}}


@pytest.mark.parametrize("changes, what, place", [
    ({"count": 5}, "5 elements reach from byte 0 to 60", "here: accessors[0]"),
    ({"byteOffset": -12}, "4 elements reach from byte -12", "here: accessors[0]"),
    ({"count": 0}, "must be 1 to", "here: accessors[0].count"),
    ({"count": 10**9}, "1000000000 elements reach", "here: accessors[0]"),
    ({"count": "4"}, "must be an integer, got '4'", "accessors[0].count"),
    ({"componentType": 5124}, "must be one of", "here: accessors[0].componentType"),
    ({"type": "VEC9"}, "must be of type VEC3", "here"),
    ({"bufferView": 7}, "is 7", "here: accessors[0].bufferView"),
    ({"bufferView": None, "count": 2**22 + 1}, "must be 1 to 4194304, got 4194305", "here: accessors[0].count"),
    ({"sparse": {**SPARSE, "count": 9}}, "must be 1 to 4, got 9", "here: accessors[0].sparse.count"),
    ({"sparse": {**SPARSE, "indices": {"bufferView": 1, "componentType": 5126}}},
     "must be an unsigned integer type", "here: accessors[0].sparse.indices.componentType"),
    ({"sparse": SPARSE}, "200", "here: accessors[0].sparse.indices"),
    ({"sparse": {**SPARSE, "values": {"bufferView": 0, "byteOffset": 40}}}, "200", "here: accessors[0].sparse.indices"),
    ({"sparse": SPARSE, "bufferView": None, "count": 2**31 - 1}, "must be 1 to", "here: accessors[0].count"),
])
def test_accessors_that_do_not_fit(tmp_path, changes, what, place):
    file = GltfFile()
    file.accessor(np.zeros((4, 3)))
    file.view(bytes([200]))
    file.json["accessors"][0].update(changes)
    with refused(what=what, place=place):
        read(file, tmp_path, "VEC3")


def test_an_accessor_without_data_is_zeros(tmp_path):
    file = GltfFile()
    file.add("accessors", {"componentType": 5126, "count": 5, "type": "VEC3"})
    assert np.array_equal(read(file, tmp_path, "VEC3"), np.zeros((5, 3), np.float32))
    file = one_triangle()
    zeros = file.add("accessors", {"componentType": 5126, "count": 3, "type": "VEC3"})
    file.node(mesh=file.mesh({"attributes": {"POSITION": zeros}}))
    scene, told = load_warned(file.write(tmp_path), staged=False)
    assert len(scene.objects) == 1 and "primitives without a triangle that has an area (mesh 'mesh 1')" in told[0]


@pytest.mark.parametrize("changes, message", [
    ({"byteLength": 10**9}, (None, "which has 48", "here: bufferViews[0]")),
    ({"byteLength": 0}, (None, "at least 1", "here: bufferViews[0].byteLength")),
    ({"buffer": 3}, (None, "3, but there", "here: bufferViews[0].buffer")),
    ({"byteStride": 8}, (None, "8 bytes, but", "here: bufferViews[0].byteStride")),
])
def test_views_that_do_not_fit(tmp_path, changes, message):
    file = GltfFile()
    file.accessor(np.zeros((4, 3)))
    file.json["bufferViews"][0].update(changes)
    with refused(*message):
        read(file, tmp_path, "VEC3")


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_floats_that_are_not_finite(tmp_path, bad):
    file = GltfFile()
    values = np.zeros((4, 3))
    values[2, 1] = bad
    file.accessor(values)
    with refused(what="(1 such elements)", place="here: accessors[0]"):
        read(file, tmp_path, "VEC3")
