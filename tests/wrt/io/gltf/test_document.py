"""Containers, JSON, URIs: files that are not sound glTF are refused, with the place of the mistake."""

from __future__ import annotations

import base64
import json
import struct

import numpy as np
import pytest

from tests.gltf_files import TRIANGLE, load_warned, one_triangle, pack_glb
from tests.refused import refused
from wrt.io.gltf.document import LeftOut
from wrt.io.gltf.reader import load_gltf
from wrt.io.gltf.schema import Needed, read

GLB = pack_glb(b'{"asset":{"version":"2.0"}}')
TEXT = GLB[20:]


def patched(data: bytes, offset: int, value: int) -> bytes:
    return data[:offset] + struct.pack("<I", value) + data[offset + 4:]


@pytest.mark.parametrize("name, data, message", [
    ("a.glb", b"", (None, "is not a .glb file")),
    ("a.glb", b"glTF", (None, "is truncated", "header")),
    ("a.glb", b"GLTF" + GLB[4:], (None, "is not a .glb file")),
    ("a.glb", patched(GLB, 4, 1), (None, "is glTF 1; wrt reads 2.0", "header.version")),
    ("a.glb", GLB[:-3], (None, "is truncated: 48 bytes according to its header, but there are 45", "header.length")),
    ("a.glb", patched(GLB, 12, 1000), (None, "is truncated", "chunk 0")),
    ("a.glb", patched(GLB, 16, 7), (None, "must be JSON", "chunk 0")),
    ("a.glb", patched(GLB, 8, 12), (None, "must be JSON", "chunk 0")),
    ("a.gltf", b"", (None, "is not valid JSON")),
    ("a.gltf", b"solid cube", (None, "is not valid JSON: Expecting value: line 1 column 1")),
    ("a.gltf", b'{"asset": {"version": "2.0"}', (None, "is not valid JSON")),
    ("a.gltf", b"\xff\x00", (None, "is not a glTF file: not UTF-8")),
    ("a.gltf", b"[" * 100000, (None, "is not valid JSON: nested too deeply")),
    ("a.gltf", b"[]", (None, "is not an object")),
    ("a.gltf", b'{"asset": {"version": "2.0"}, "scene": NaN}', (None, "must be an integer, got nan", "scene")),
    ("a.gltf", b'{"asset": {"version": "2.0"}, "scene": ' + b"9" * 5000 + b"}", (None, "is not valid JSON")),
    ("a.gltf", b"{}", (None, "must be a string", "asset.version")),
    ("a.gltf", b'{"asset": {"version": "1.0"}}', (None, "is '1.0'; wrt reads 2.0", "asset.version")),
    ("a.gltf", b'{"asset": {"version": "2.1", "minVersion": "2.1"}}', (None, "is '2.1'", "asset.minVersion")),
])
def test_broken_containers(tmp_path, name, data, message):
    path = tmp_path / name
    path.write_bytes(data)
    with refused(*message, path=path):
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
    ("none.bin", "cannot read 'none.bin': No such file"),
    ("http://example.org/b.bin", "is an address"),
    ("file:///etc/hostname", "is an address"),
    ("C:\\b.bin", "is an address"),
    ("/etc/hostname", "is an absolute path"),
    ("\\\\server\\share", "is an absolute path"),
    ("../b.bin", "leaves the folder"),
    ("a/%2e%2E/../../b.bin", "leaves the folder"),
    ("a%00.bin", "control character"),
    ("", "is empty"),
    ("%ff", "is not UTF-8"),
    (".", "cannot read '.'"),
    ("x" * 5000, "cannot read"),
    ("data:application/octet-stream;base64", "without a comma"),
    ("data:;base64,abc", "cannot be decoded"),
    ("data:;base64,ab!=", "cannot be decoded"),
    ("data:,\ud800", "cannot be decoded"), ("data:;base64,\ud800", "cannot be decoded"), ("data:;base64,a=bc", "cannot be decoded"),
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


@pytest.mark.parametrize("required, what, hint", [
    (["MSFT_texture_dds", "KHR_mesh_quantization"], "MSFT_texture_dds", "no decoder"),
    (["KHR_texture_basisu"], "KHR_texture_basisu", "no decoder"),
    (["KHR_materials_sheen", "ACME_unheard_of"], "'ACME_unheard_of', 'KHR_materials_sheen'", ""),
])
def test_required_extensions_that_are_not_supported(tmp_path, required, what, hint):
    file = one_triangle()
    file.json["extensionsRequired"] = required
    with refused(what=what, place="extensionsRequired", hint=hint):
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


def test_extras_of_any_type_and_unknown_keys_are_passed_over(tmp_path):
    file = one_triangle(extras=[1, "two"], unheardOf=3)
    file.json["extras"] = 5
    file.json["nodes"][0]["extras"] = "text"
    assert len(load_gltf(file.write(tmp_path), staged=False).objects) == 1


def test_base64_with_wrapped_lines_is_refused_not_misread(tmp_path):
    file = one_triangle()
    text = base64.encodebytes(bytes(file.binary)).decode()
    file.json["buffers"] = [{"byteLength": len(file.binary), "uri": f"data:;base64,{text}\n=broken"}]
    with refused(what="decoded", place="meshes[0].primitives[0].attributes.POSITION: buffers[0].uri"):
        load_gltf(file.write(tmp_path, "a.gltf"))


def test_left_out_names_each_thing_once_and_cuts_long_lists():
    left_out = LeftOut()
    for i in range(7):
        left_out.add("sheen", "material", f"m{i}")
        left_out.add("sheen", "material", "m0")
    left_out.add("lines", "mesh", "a")
    left_out.add("lines", "mesh", "b")
    left_out.add_extensions({"KHR_lights_punctual": {}, "KHR_xmp": {}, "ACME_x": {}}, "node", "n")
    assert left_out.sentence() == ("sheen (materials 'm0', 'm1', 'm2', 'm3', 'm4' and 2 more), "
                                   "lines (meshes 'a', 'b'), ACME_x (node 'n')")
    assert LeftOut().sentence() == ""
