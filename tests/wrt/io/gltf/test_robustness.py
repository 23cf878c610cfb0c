"""glTF files with features that wrt leaves out, damaged and hostile files, and files of other authors."""

from __future__ import annotations

import ast
import copy
import json
import time
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tests.data import DATA, ROOT, data_path
from tests.gltf_files import TRIANGLE, GltfFile, load_warned, one_triangle, rich_file, with_light
from tests.refused import refused
from wrt.core.errors import InputError, SceneWarning
from wrt.io import gltf
from wrt.io.gltf.document import DEFAULT_LOOK, SUPPORTED_EXTENSIONS
from wrt.io.gltf.meshes import _NOT_TRIANGLES
from wrt.io.gltf.reader import load_gltf

# --- what is left out, and what is added ------------------------------------------------------------------------------


def test_one_warning_names_everything_once(tmp_path):
    file = one_triangle(extensions={"KHR_materials_variants": {"mappings": []}})
    primitive = file.json["meshes"][0]["primitives"][0]
    primitive["attributes"] |= {"COLOR_0": file.accessor(TRIANGLE), "_TEMPERATURE": 0}
    primitive["targets"] = [{"POSITION": 0}]
    file.json["nodes"][0] |= {"skin": 0, "extensions": {"ACME_wind": {}, "MSFT_lod": {"ids": []}}}
    file.node(mesh=0, name="again")
    file.json |= {"skins": [{"joints": [0]}], "animations": [{"name": "walk", "channels": [], "samplers": []}],
                  "extensionsUsed": ["ACME_wind", "KHR_materials_variants", "KHR_never_seen"],
                  "extensions": {"KHR_materials_variants": {"variants": []}, "ACME_fog": {}, "KHR_xmp": {}}}
    scene, messages = load_warned(file.write(tmp_path), staged=False)
    assert len(scene.objects) == 2 and len(messages) == 1
    things = ["ACME_wind (node 'place')", "KHR_materials_variants (mesh 'thing')",
              "skins without JOINTS_0 and WEIGHTS_0 (mesh 'thing')", "COLOR_0 (mesh 'thing')", "motion (animation 'walk')",
              "ACME_fog (file 'file.glb')"]
    assert messages[0].endswith("not supported and left out: " + ", ".join(things))


def test_the_same_warning_names_additions(tmp_path):
    file = one_triangle()
    scene, messages = load_warned(file.write(tmp_path))
    assert len(messages) == 1 and "no camera" in messages[0] and "no lights" in messages[0]
    assert len(scene.cameras) == 1 and len(scene.lights) == 1
    bare = load_gltf(file.write(tmp_path), staged=False)
    assert not bare.cameras and not bare.lights


def test_a_complete_file_is_loaded_without_a_word(tmp_path):
    file = with_light({"type": "point"})
    file.node(camera=file.add("cameras", {"type": "perspective", "perspective": {"yfov": 1, "znear": 1}}))
    scene = load_gltf(file.write(tmp_path))
    assert len(scene.cameras) == len(scene.lights) == len(scene.objects) == 1 and scene.name == "file"


def test_files_without_triangles(tmp_path):
    file = GltfFile()
    with refused(what="scene has no triangles"):
        load_gltf(file.write(tmp_path), staged=False)
    file.node(camera=file.add("cameras", {"type": "perspective", "perspective": {"yfov": 1, "znear": 1}}))
    assert len(load_gltf(file.write(tmp_path), staged=False).cameras) == 1  # of use to a scene file that includes it
    with refused(what="scene has no triangles"):
        load_gltf(file.write(tmp_path))


# --- hostile input ----------------------------------------------------------------------------------------------------


def test_the_rich_file_is_sound(tmp_path):
    scene = load_gltf(rich_file().write(tmp_path))
    assert len(scene.objects) == 4 and len(scene.lights) == 1 and scene.objects[1].materials[0].absorption == (0, 0, 0)


def places(value: Any) -> list[tuple[Any, Any]]:
    """Yield every (container, key) in a JSON value."""
    items = list(value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ())
    return [(value, key) for key, _ in items] + [place for _, child in items for place in places(child)]


JUNK = [None, True, -1, 0, 1, 3, 1.5, 2**31, 10**30, 1e300, -1e-300, "", "x", "VEC3", [], [0], [[]], {}, {"index": 0}]


@pytest.mark.filterwarnings("ignore::wrt.core.errors.SceneWarning")
def test_any_value_may_be_wrong(tmp_path):
    """Replace or remove each value of the JSON in turn: the result is a scene or an InputError."""
    file = rich_file()
    sound = file.json
    rng = np.random.default_rng(0)
    outcomes = {True: 0, False: 0}
    for number in range(len(places(sound))):
        for junk in [*(JUNK[i] for i in rng.choice(len(JUNK), 3, replace=False)), "remove"]:
            file.json = copy.deepcopy(sound)
            container, key = places(file.json)[number]
            if junk == "remove":
                del container[key]
            else:
                container[key] = copy.deepcopy(junk)
            outcomes[is_loaded(file.write(tmp_path))] += 1
    assert min(outcomes.values()) > 50


@pytest.mark.filterwarnings("ignore::wrt.core.errors.SceneWarning")
def test_any_byte_may_be_wrong(tmp_path):
    path = rich_file().write(tmp_path)
    data = path.read_bytes()
    rng = np.random.default_rng(1)
    outcomes = {True: 0, False: 0}
    for _ in range(300):
        damaged = bytearray(data)
        for at in rng.integers(0, len(data), rng.integers(1, 3)):
            damaged[at] = rng.integers(0, 256)
        path.write_bytes(bytes(damaged))
        outcomes[is_loaded(path)] += 1
    for length in range(0, len(data), 37):
        path.write_bytes(data[:length])
        assert not is_loaded(path)
    assert min(outcomes.values()) > 10


def is_loaded(path: Path) -> bool:
    try:
        load_gltf(path)
    except InputError as error:
        assert error.path == path and "\n" not in str(error)
        return False
    return True


# --- files by others --------------------------------------------------------------------------------------------------

FILES = sorted(path.relative_to(DATA).as_posix()
               for folder in ("scenes/gltf", "odd") for path in DATA.glob(f"{folder}/**/*.gl*"))
REFUSED = {"odd/empty_nodes.glb": "no triangles"} | ({} if find_spec("meshopt") else {"odd/BoxMeshopt.glb": "needs meshopt"})


def index_counts() -> dict[str, int]:
    """Triangles with instances, by the data set's own index: "N" or "N (M inst)"."""
    counts = {}
    for line in data_path("INDEX.tsv").read_text().splitlines()[1:]:
        name, count = line.split("\t")[:2]
        text = count.split("(")[-1].split(" ")[0] if "inst" in count else count
        if text.isdigit():
            counts[name] = int(text)
    # Counted by a tool that knows neither fans nor EXT_mesh_gpu_instancing. A list of 18 indices, a strip of 6, a fan of 8.
    return counts | {"odd/MeshPrimitiveModes/MeshPrimitiveModes.gltf": 6 + 4 + 6, "odd/SimpleInstancing.glb": 125 * 12,
                     "odd/BoxMeshopt.glb": 12}


@pytest.mark.parametrize("name", FILES or ["scenes/gltf"])
@pytest.mark.filterwarnings("ignore::wrt.core.errors.SceneWarning")
def test_every_file_loads_with_its_triangles_or_is_refused(name):
    path = data_path(name)
    if name in REFUSED:
        with refused(what=REFUSED[name], path=path):
            load_gltf(path)
        return
    start = time.perf_counter()
    scene = load_gltf(path)
    assert time.perf_counter() - start < 10.0  # far more than it takes: detects Python loops over vertices
    assert sum(len(thing.mesh.faces) + thing.mesh.dropped for thing in scene.objects) == index_counts()[name]
    assert scene.cameras


@pytest.mark.parametrize("name", [name for name in FILES if name not in REFUSED and not any(
    feature in name for feature in ("Instancing", "MeshPrimitiveModes", "Meshopt"))] or ["scenes/gltf"])
@pytest.mark.filterwarnings("ignore::wrt.core.errors.SceneWarning")
def test_world_bounds_agree_with_trimesh(name):
    trimesh = pytest.importorskip("trimesh")
    theirs = trimesh.load(data_path(name), process=False, skip_materials=True).bounds  # trimesh 4.5 refuses emissiveFactor > 1
    ours = load_gltf(data_path(name)).bounds()
    assert np.array(ours) == pytest.approx(theirs, rel=1e-5, abs=1e-5 * np.ptp(theirs, axis=0).max())


def test_shared_spheres_are_stored_once():
    path = data_path("scenes/gltf/MetalRoughSpheresNoTextures.glb")
    with pytest.warns(SceneWarning):
        scene = load_gltf(path)
    stored = {id(thing.mesh): len(thing.mesh.faces) for thing in scene.objects}
    drawn = sum(len(thing.mesh.faces) for thing in scene.objects)
    assert drawn > 50 * sum(stored.values()) and len(scene.materials) >= 98


def test_toy_car_has_its_eight_cameras():
    path = data_path("scenes/gltf/ToyCar/ToyCar.gltf")
    scene, messages = load_warned(path)
    assert "left out: KHR_materials_sheen (material 'Fabric');" in messages[0]
    nodes = [node for node in json.loads(path.read_text())["nodes"] if "camera" in node]
    assert len(scene.cameras) == len(nodes) == 8
    for camera, node in zip(scene.cameras, nodes, strict=True):
        assert camera.name == node["name"]
        assert camera.camera_to_world[:3, 3] == pytest.approx(node["translation"])
        turn = Rotation.from_quat(node["rotation"]).as_matrix()
        assert camera.camera_to_world[:3, :3] == pytest.approx(turn, abs=1e-6)
    paint = next(material for material in scene.materials if material.name == "ToyCar")
    assert paint.clearcoat == 1.0 and paint.clearcoat_texture is not None
    fabric = next(material for material in scene.materials if material.name == "Fabric")
    assert np.array_equal(fabric.albedo_texture.uv_transform, [[3, 0, 0], [0, 3, 0]])
    glass = next(material for material in scene.materials if material.name == "Glass")
    assert glass.transmission == 1 and glass.thin and glass.roughness == 0


def test_dragon_absorbs_and_its_vendor_cousins_are_named():
    scene, messages = load_warned(data_path("scenes/gltf/DragonAttenuation.glb"))
    dragon = next(m for m in scene.materials if m.name == "Dragon with Attenuation")
    assert not dragon.thin
    assert np.exp(-0.155 * np.array(dragon.absorption)) == pytest.approx([0.921, 0.64, 0.064])
    assert "KHR_materials_variants (mesh 'Dragon')" in messages[0]
    assert "NV_materials_mdl" in load_warned(data_path("scenes/gltf/nvpro_cornellBox/cornellBox.gltf"))[1][0]


def named_in(tree: ast.AST) -> Iterator[str]:
    """Yield the constant texts in calls of `left_out.add(...)`, up to the first comma."""
    for call in ast.walk(tree):
        if isinstance(call, ast.Call) and isinstance(call.func, ast.Attribute) and ast.unparse(call.func).endswith("left_out.add"):
            for text in ast.walk(call.args[0]):
                if isinstance(text, ast.Constant) and isinstance(text.value, str):
                    yield text.value.split(",")[0].strip()


def test_the_page_on_materials_names_all_that_is_left_out_and_all_extensions_that_are_read():
    page = (ROOT / "docs" / "materials.md").read_text().replace("`", "")
    named = {text for path in Path(gltf.__path__[0]).glob("*.py") for text in named_in(ast.parse(path.read_text()))}
    assert {"motion", "nearest-neighbour sampling", "textures without an image"} <= named
    assert [text for text in sorted(named | set(_NOT_TRIANGLES.values())) if text not in page] == []
    assert [name for name in sorted(SUPPORTED_EXTENSIONS | DEFAULT_LOOK) if name not in page] == []
