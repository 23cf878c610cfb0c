"""Containers, JSON, URIs: files that are not sound glTF are refused, with the place of the mistake."""

from __future__ import annotations

import json
import struct

import numpy as np
import pytest

from tests.gltf_files import TRIANGLE, load_warned, one_triangle, pack_glb
from tests.refused import refused
from wrt.io.gltf.document import COMPRESSIONS, LeftOut
from wrt.io.gltf.reader import load_gltf
from wrt.io.gltf.schema import Needed, read

GLB = pack_glb(b'{"asset":{"version":"2.0"}}')
TEXT = GLB[20:]


def patched(data: bytes, offset: int, value: int) -> bytes:
    return data[:offset] + struct.pack("<I", value) + data[offset + 4:]


@pytest.mark.parametrize("name, data, what, place", [
    ("a.glb", b"", "is not a .glb file", None),
    ("a.glb", b"glTF", "is truncated", "header"),
    ("a.glb", patched(GLB, 4, 1), "is glTF 1; wrt reads 2.0", "header"),
    ("a.glb", GLB[:-3], "is truncated: it has 45 bytes, but its header announces 48", "header"),
    ("a.glb", patched(GLB, 12, 1000), "is truncated", "chunk 0"),
    ("a.glb", patched(GLB, 16, 7), "no JSON chunk", None),
    ("a.glb", patched(GLB, 8, 12), "no JSON chunk", None),
    ("a.gltf", b"solid cube", "is not valid JSON: Expecting value: line 1 column 1", None),
    ("a.gltf", b"\xff\x00", "is not valid JSON", None),
    ("a.gltf", b"[" * 100000, "is not valid JSON: nested too deeply", None),
    ("a.gltf", b"[]", "is not an object", None),
    ("a.gltf", b'{"asset": {"version": "2.0"}, "scene": NaN}', "must be an integer, got nan", "scene"),
    ("a.gltf", b'{"asset": {"version": "2.0"}, "scene": ' + b"9" * 5000 + b"}", "is not valid JSON", None),
    ("a.gltf", b"{}", "is required", "asset"),
    ("a.gltf", b'{"asset": {"version": "1.0"}}', "is '1.0'; wrt reads 2.0", "asset.version"),
    ("a.gltf", b'{"asset": {"version": "2.1", "minVersion": "2.1"}}', "is '2.1'", "asset.minVersion"),
])
def test_broken_containers(tmp_path, name, data, what, place):
    path = tmp_path / name
    path.write_bytes(data)
    with refused(None, what, place, path):
        load_gltf(path)


def test_missing_file_and_folder(tmp_path):
    for path in (tmp_path / "none.gltf", tmp_path):
        with refused(what="read"):
            load_gltf(path)


def test_both_containers_and_a_byte_order_mark_give_the_same(tmp_path):
    file = one_triangle()
    paths = [file.write(tmp_path, "a.glb"), file.write(tmp_path, "a.gltf")]
    paths.append(tmp_path / "bom.gltf")
    paths[2].write_bytes(b"\xef\xbb\xbf" + paths[1].read_bytes())
    for path in paths:
        assert np.array_equal(load_gltf(path, staged=False).objects[0].mesh.vertices, TRIANGLE)


@pytest.mark.parametrize("name, uri", [
    ("my buffer.bin", "my%20buffer.bin"), ("b.bin", "./b.bin"), ("sub/b.bin", "sub/b.bin"), ("sub/b.bin", "sub\\b.bin"),
    ("é.bin", "%C3%A9.bin"), ("é.bin", "é.bin")])
def test_external_buffers(tmp_path, name, uri):
    file = one_triangle()
    (tmp_path / "sub").mkdir()
    (tmp_path / name).write_bytes(bytes(file.binary) + b"more than byteLength")
    file.json["buffers"] = [{"byteLength": len(file.binary), "uri": uri}]
    scene = load_gltf(file.write(tmp_path, "a.gltf"), staged=False)
    assert np.array_equal(scene.objects[0].mesh.vertices, TRIANGLE)


@pytest.mark.parametrize("uri, message", [
    ("none.bin", "cannot be read: No such file"), (".", "cannot be read"), ("x" * 5000, "cannot be read"), ("%ff", "is no path"),
    ("http://example.org/b.bin", "is no path"), ("C:\\b.bin", "is no path"), ("/etc/hostname", "is no path"), ("", "is no path"),
    ("\\\\server\\share", "is no path"), ("../b.bin", "is no path"), ("a/%2e%2E/../../b.bin", "is no path"), ("a%00.bin", "is no path"),
    ("data:;base64,abc", "cannot be decoded"),
    ("data:,\ud800", "cannot be decoded"), ("data:;base64,a=bc", "cannot be decoded"),
    ("data:,abc", "is truncated: byteLength is 36, but there are 3 bytes"),
    (5, "must be a string, got 5"),
])
def test_bad_uris(tmp_path, uri, message):
    file = one_triangle()
    file.json["buffers"] = [{"byteLength": len(file.binary), "uri": uri}]
    (tmp_path.parent / "b.bin").write_bytes(bytes(file.binary))
    with refused(what=message, path="a.gltf") as error:
        load_gltf(file.write(tmp_path, "a.gltf"))
    assert "buffers[0]" in error.value.place


def test_data_uri_without_base64(tmp_path):
    file = one_triangle()
    escaped = "".join(f"%{byte:02x}" for byte in file.binary)
    file.json["buffers"] = [{"byteLength": len(file.binary), "uri": f"data:application/octet-stream,{escaped}"}]
    assert np.array_equal(load_gltf(file.write(tmp_path, "a.gltf"), staged=False).objects[0].mesh.vertices, TRIANGLE)


def test_buffer_without_data(tmp_path):
    file = one_triangle()
    path = tmp_path / "a.glb"
    document = {**file.json, "buffers": [{"byteLength": 36}]}
    path.write_bytes(pack_glb(json.dumps(document).encode()))
    with refused(what="uri", place="meshes[0].primitives[0].attributes.POSITION: buffers[0]"):
        load_gltf(path)
    path.write_bytes(pack_glb(json.dumps(document).encode(), bytes(file.binary[:20])))
    with refused(what="truncated: byteLength is 36", place="meshes[0].primitives[0].attributes.POSITION: buffers[0]"):
        load_gltf(path)


def test_required_extensions_that_are_not_supported(tmp_path):
    file = one_triangle()
    file.json["extensionsRequired"] = ["KHR_texture_basisu", "KHR_mesh_quantization", "ACME_unheard_of"]
    with refused(what="'ACME_unheard_of', 'KHR_texture_basisu'", place="extensionsRequired", hint="without"):
        load_gltf(file.write(tmp_path))


@pytest.mark.parametrize("name", sorted(COMPRESSIONS))
def test_a_file_that_requires_compressed_meshes_is_refused_with_a_way_out_and_plain_buffers_are_read(tmp_path, name: str):
    file = one_triangle(extensions={name: {"bufferView": 0, "attributes": {"POSITION": 0}}})
    assert len(load_gltf(file.write(tmp_path), staged=False).objects) == 1  # without a warning, which would fail the test
    file.json["extensionsRequired"] = [name, "KHR_mesh_quantization"]
    with refused(what=f"the file needs '{name}'", place="extensionsRequired", hint="gltf-transform copy IN OUT"):
        load_gltf(file.write(tmp_path))


def test_required_extensions_that_are_supported(tmp_path):
    file = one_triangle()
    file.json["extensionsRequired"] = ["KHR_materials_transmission", "KHR_lights_punctual", "KHR_xmp_json_ld", "KHR_implicit_shapes",
                                       "KHR_physics_rigid_bodies", "EXT_mesh_manifold", "GODOT_single_root", "GRIFFEL_bim_data", "VRMC_vrm"]
    assert len(load_gltf(file.write(tmp_path), staged=False).objects) == 1


def test_the_default_look_of_variants_is_shown_even_if_they_are_required(tmp_path):
    file = one_triangle(extensions={"KHR_materials_variants": {"mappings": [{"material": 0, "variants": [0]}]}})
    file.json |= {"extensionsRequired": ["KHR_materials_variants"],
                  "extensions": {"KHR_materials_variants": {"variants": [{"name": "red"}]}}}
    scene, told = load_warned(file.write(tmp_path), staged=False)
    assert len(scene.objects) == 1 and "KHR_materials_variants (mesh" in told[0]


@pytest.mark.parametrize("entry, raw, place", [
    (int, 1.5, "x"), (int, "1", "x"), (int, True, "x"), (int, 1e400, "x"), (3, 2**63, "x"), (float, "x", "x"), (float, False, "x"),
    (float, 1e400, "x"), (0.5, 10**400, "x"), (str, 1, "x"), (bool, 1, "x"), ([float], 3, "x"), ([int], [0, None], "x[1]"),
    ({str: int}, [], "x"), ({str: int}, {"A": "0"}, "x.A"), ((1.0, 1.0), [1.0], "x"), ({"a": Needed(int)}, {"a": None}, "x.a"),
    ({"a": {"b": Needed(int)}}, {"a": {}}, "x.a.b"),
])
def test_wrong_types_are_named(entry, raw, place):
    with refused(place=place):
        read(entry, raw, "x")


def test_integral_floats_are_integers_and_missing_keys_have_defaults():
    assert read(int, 3.0, "x") == 3 and isinstance(read(int, 3.0, "x"), int)
    found = read({"a": {"b": 2.0}, "c": {"d": Needed(int)}, "e": (float,) * 2, "f": (1.0, 2.0), "g": [int]}, {"a": None}, "x")
    assert (found.a.b, found.c, found.e, found.f, found.g) == (2.0, None, None, [1.0, 2.0], [])


def test_left_out_names_each_thing_once_and_cuts_long_lists():
    left_out = LeftOut()
    for i in range(7):
        left_out.add("sheen", "material", f"m{i}")
        left_out.add("sheen", "material", "m0")
    left_out.add("lines", "mesh", "a")
    left_out.add("lines", "mesh", "b")
    left_out.add_extensions({"KHR_lights_punctual": {}, "KHR_xmp": {}, "ACME_x": {}}, "node", "n")
    assert left_out.sentence() == ("sheen (material 'm0', material 'm1', material 'm2', material 'm3', material 'm4' and 2 more), "
                                   "lines (mesh 'a', mesh 'b'), ACME_x (node 'n')")
    assert LeftOut().sentence() == ""
