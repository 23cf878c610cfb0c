"""glTF files with features that wrt leaves out, and files of other authors."""

from __future__ import annotations

import ast
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from tests.data import DATA, ROOT, data_path
from tests.gltf_files import TRIANGLE, GltfFile, load_warned, one_triangle, with_light
from tests.refused import refused
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
    things = ["ACME_wind (node 'place')", "KHR_materials_variants (mesh 'thing', file 'file.glb')",
              "skins without JOINTS_0 and WEIGHTS_0 (mesh 'thing')", "COLOR_0 (mesh 'thing')", "motion (file 'file.glb')",
              "ACME_fog (file 'file.glb')"]
    assert messages[0].endswith("not supported and left out: " + ", ".join(things))


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


# --- files by others --------------------------------------------------------------------------------------------------

FILES = sorted(path.relative_to(DATA).as_posix()
               for folder in ("scenes/gltf", "odd") for path in DATA.glob(f"{folder}/**/*.gl*"))
REFUSED = {"odd/empty_nodes.glb": "no triangles", "odd/BoxMeshopt.glb": "the file needs 'EXT_meshopt_compression'"}


def index_counts() -> dict[str, int]:
    """Triangles with instances, by the data set's own index: "N" or "N (M inst)"."""
    counts = {}
    for line in data_path("INDEX.tsv").read_text().splitlines()[1:]:
        name, count = line.split("\t")[:2]
        text = count.split("(")[-1].split(" ")[0] if "inst" in count else count
        if text.isdigit():
            counts[name] = int(text)
    # Counted by a tool that knows neither fans nor EXT_mesh_gpu_instancing. A list of 18 indices, a strip of 6, a fan of 8.
    return counts | {"odd/MeshPrimitiveModes/MeshPrimitiveModes.gltf": 6 + 4 + 6, "odd/SimpleInstancing.glb": 125 * 12}


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
    feature in name for feature in ("Instancing", "MeshPrimitiveModes"))] or ["scenes/gltf"])
@pytest.mark.filterwarnings("ignore::wrt.core.errors.SceneWarning")
def test_world_bounds_agree_with_trimesh(name):
    trimesh = pytest.importorskip("trimesh")
    theirs = trimesh.load(data_path(name), process=False, skip_materials=True).bounds  # trimesh 4.5 refuses emissiveFactor > 1
    ours = load_gltf(data_path(name)).bounds()
    assert np.array(ours) == pytest.approx(theirs, rel=1e-5, abs=1e-5 * np.ptp(theirs, axis=0).max())


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
