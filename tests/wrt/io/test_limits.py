"""Small files that would take all memory: each is refused, with the number that it demands and the limit."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tests.command_line import wrt as command
from tests.gltf_files import GltfFile, one_triangle
from tests.refused import refused
from wrt.core.errors import SceneWarning
from wrt.io.gltf.reader import load_gltf
from wrt.io.load import load_scene
from wrt.scene.materials import Texture
from wrt.scene.model import Scene
from wrt.scene.shapes import MAX_FACES, icosphere, lathe, teapot, torus, tube
from wrt.scene.values import MAX_OBJECTS

SPHERE = "[[spheres]]\ncenter = [0, 0, 0]\nradius = 1\n"
pytestmark = pytest.mark.filterwarnings("ignore::wrt.core.errors.SceneWarning")


def instanced(count: int, times: int = 1, nodes: int = 1) -> GltfFile:
    """A triangle with `count` instances, whose transforms have no buffer."""
    file = GltfFile()
    one = file.view(np.zeros(3, np.float32).tobytes())
    index = {"bufferView": file.view(b"\0\0\0\0"), "componentType": 5125}
    sparse = {"count": 1, "indices": index, "values": {"bufferView": one}}
    places = file.add("accessors", {"componentType": 5126, "count": count, "type": "VEC3", "sparse": sparse})
    mesh = file.mesh(*[file.primitive()] * times)
    for _ in range(nodes):
        file.node(mesh=mesh, extensions={"EXT_mesh_gpu_instancing": {"attributes": {"TRANSLATION": places}}})
    return file


@pytest.mark.parametrize(("count", "what", "hint"), [
    (10**9, "must be 1 to 4194304", ""),
    (MAX_OBJECTS + 1, f"{MAX_OBJECTS + 1} instances", f"at most {MAX_OBJECTS}"),
])
def test_instances_without_bytes_behind_them(count: int, what: str, hint: str, tmp_path: Path) -> None:
    with refused(what=what, hint=hint):
        load_gltf(instanced(count).write(tmp_path))


def test_nodes_times_instances_are_counted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("wrt.scene.values.MAX_OBJECTS", 100)
    assert len(load_gltf(instanced(50, 2).write(tmp_path)).objects) == 100
    for file in (instanced(50, 3), instanced(40, 1, 3)):
        with refused(hint="at most 100"):
            load_gltf(file.write(tmp_path))
    hidden = instanced(40, 1, 3)  # instances without triangles count, too
    for node in hidden.json["nodes"]:
        node["scale"] = [0, 1, 1]
    with refused(what="120 instances", place="nodes[2].extensions.EXT_mesh_gpu_instancing.attributes"):
        load_gltf(hidden.write(tmp_path))
    one_triangle().write(tmp_path, "a.glb")
    (tmp_path / "a.toml").write_text('include = ["a.glb"' + ', "a.glb"' * 100 + "]")
    with refused(what="101 objects", place="include[100]", path="a.toml"):
        load_scene(tmp_path / "a.toml")
    with refused(what="101 lights"):
        Scene(lights=tuple(load_gltf(one_triangle().write(tmp_path)).lights) * 101)


@pytest.mark.parametrize(("shape", "arguments"), [
    (torus, {"segments": 4096, "tube_segments": 4096}), (teapot, {"segments": 4096}),
    (lathe, {"profile": [(1.0, float(i)) for i in range(2000)], "segments": 4096}),
    (tube, {"points": [(0.0, 0.0, float(i)) for i in range(2000)], "segments": 4096}),
])
def test_shapes_of_too_many_triangles(shape, arguments: dict) -> None:
    with refused("segments", f"at most {MAX_FACES}"):
        shape(**arguments)
    assert 20 * 4**9 <= MAX_FACES and len(icosphere(0).faces) == 20  # within the limit of this argument


@pytest.mark.parametrize("text", [
    "a" + ".a" * 5000 + " = 1", "a = " + "[" * 100_000, "a = " + "{a=" * 100_000, "[" + "a." * 20_000 + "a]",
    "title = " + "0x" + "f" * 100_000, "title = 1" + "0" * 100_000, "settings.spp = 0x" + "f" * 10_000,
    "background.type = 0x" + "f" * 10_000, "settings.filter = [" + "[" * 900 + "]" * 901,
    "".join(f"key{i} = {i}\n" for i in range(20_000)), "[[spheres]]\n" * 20_000,
    "".join(f"materials.m{i} = {{}}\n" for i in range(2000)) + f'{SPHERE}material = "m"\n' * 2000,
    "materials." + "x" * 100_000 + f' = {{}}\n{SPHERE}material = "' + "y" * 100_000 + '"',
], ids=["dots", "brackets", "braces", "header", "hexadecimal", "digits", "spp", "type", "filter",
         "keys", "tables", "names", "long"])
def test_toml_that_is_deep_or_long(text: str, tmp_path: Path) -> None:
    (tmp_path / "a.toml").write_text(text)
    with refused(path="a.toml") as caught:
        load_scene(tmp_path / "a.toml")
    assert len(str(caught.value)) < 30_000


@pytest.mark.parametrize("text", [
    "[" * 200_000, '{"a":' * 200_000, '{"asset": {"version": "2.0"}, "nodes": [{"extras": ' + "[" * 900 + "]" * 900 + "}]}",
    '{"asset": {"version": "2.0"}, "scene": ' + "9" * 4000 + "}", '{"asset": {"version": "' + "2" * 100_000 + '"}}',
    '{"asset": {"version": "2.0"}, "nodes": [' + ",".join(f'{{"children": [{i + 1}]}}' for i in range(20_000)) + ", {}]}",
    '{"asset": {"version": "2.0"}, "extensionsRequired": ["' + "x" * 100_000 + '"]}',
], ids=["brackets", "braces", "extras", "digits", "version", "chain", "extension"])
def test_json_that_is_deep_or_long(text: str, tmp_path: Path) -> None:
    (tmp_path / "a.gltf").write_text(text)
    with refused(path="a.gltf") as caught:
        load_scene(tmp_path / "a.gltf")
    assert len(str(caught.value)) < 30_000


@pytest.mark.parametrize("uri", ["../../etc/passwd", "/etc/passwd", "http://example.org/a.bin", "file:///etc/passwd", "%2e%2e/a",
                                 "..\\a", "C:\\a", "a/../../b", "//host/a", "\\\\host\\a"])
def test_nothing_outside_of_the_folder_is_read(uri: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def read(path: Path) -> bytes:
        assert path == file_path, f"{path} was read"
        return path.read_bytes()

    monkeypatch.setattr("wrt.io.gltf.document.read_file", read)
    for array, item in (("buffers", {"byteLength": 36, "uri": uri}), ("images", {"uri": uri})):
        file = one_triangle()
        file.json[array] = [item]
        if array == "images":
            file.json["textures"] = [{"source": 0}]
            file.json["materials"] = [{"emissiveTexture": {"index": 0}, "emissiveFactor": [1, 1, 1]}]
            file.json["meshes"][0]["primitives"][0]["material"] = 0
        file_path = file.write(tmp_path, "a.gltf")
        if array == "images":  # the picture goes on without it
            with pytest.warns(SceneWarning, match=r"a texture, because images\[0\].uri: "):
                load_gltf(file_path)
            continue
        with refused(path=file_path) as caught:
            load_gltf(file_path)
        assert f"{array}[0].uri: " in caught.value.place


def test_warnings_do_not_grow_with_the_file(tmp_path: Path) -> None:
    file = one_triangle()
    for i in range(2000):
        file.node(name="n" * 1000 + str(i), mesh=0, skin=0)
    file.json["skins"] = [{"joints": [0]}]
    with pytest.warns(SceneWarning, match="skins") as caught:
        load_gltf(file.write(tmp_path))
    assert all(len(str(each.message)) < 10_000 for each in caught)


def test_names_give_the_terminal_no_orders(tmp_path: Path) -> None:
    (tmp_path / "a.toml").write_text('[[spheres]]\ncenter=[0,0,0]\nradius=1\nmaterial="\\u001b[2J\\u0007"\n[materials."\\u001b"]\n')
    result = command("validate", tmp_path / "a.toml")
    assert result.code == 2 and "unknown material" in result.err and "\x1b" not in result.err and "\x07" not in result.err
    file = one_triangle()
    file.json["nodes"][0] |= {"skin": 0, "name": "\x1b[2J"}
    assert "\x1b" not in command("validate", file.write(tmp_path, "\x1b[2J.gltf")).err


@pytest.mark.parametrize("number", [1e31, 1e300, float("inf"), float("nan")])
def test_transforms_of_textures_end_where_the_device_does(number: float) -> None:
    image = np.zeros((1, 1, 4), np.uint8)
    with refused("uv_transform", "2x3 matrix", place="texture"):
        Texture(image, uv_transform=np.array([[1.0, 0.0, 0.0], [0.0, number, 0.0]]))
    assert Texture(image, uv_transform=np.full((2, 3), 1e30)).uv_transform[0, 0] == 1e30
