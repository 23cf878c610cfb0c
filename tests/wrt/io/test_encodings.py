"""Text files: each reader takes UTF-8 with or without a byte order mark, and refuses UTF-16 and UTF-32."""

from __future__ import annotations

import codecs
from pathlib import Path

import pytest

from tests.gltf_files import one_triangle
from tests.refused import refused
from wrt.io.load import load_scene

PLY = """ply
format ascii 1.0
element vertex 3
property float x
property float y
property float z
element face 1
property list uchar int vertex_indices
end_header
0 0 0
1 0 0
0 1 0
3 0 1 2
"""
TEXTS = {
    ".obj": "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", ".ply": PLY,
    ".off": "OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n",
    ".stl": "solid a\nfacet\nouter loop\nvertex 0 0 0\nvertex 1 0 0\nvertex 0 1 0\nendloop\nendfacet\nendsolid a\n",
    ".toml": "[materials.m]\n[[quads]]\ncorner = [0, 0, 0]\nedge_u = [1, 0, 0]\nedge_v = [0, 1, 0]\nmaterial = 'm'\n",
}


def texts(folder: Path) -> dict[str, str]:
    return {**TEXTS, ".gltf": one_triangle().write(folder, "a.gltf").read_text()}


@pytest.mark.filterwarnings("ignore::wrt.core.errors.SceneWarning")
@pytest.mark.parametrize("suffix", [*TEXTS, ".gltf"])
def test_the_mark_of_utf_8_changes_nothing_and_others_are_refused(suffix: str, tmp_path: Path) -> None:
    text, path = texts(tmp_path)[suffix], tmp_path / f"b{suffix}"
    path.write_text(text)
    plain, = load_scene(path).objects
    path.write_bytes(codecs.BOM_UTF8 + text.encode())
    marked, = load_scene(path).objects
    assert plain.mesh.vertices.tolist() == marked.mesh.vertices.tolist() and plain.mesh.faces.tolist() == marked.mesh.faces.tolist()
    for encoding in ("utf-16", "utf-32"):
        path.write_bytes(text.encode(encoding))
        with refused(None, "UTF-16", path=f"b{suffix}", hint="UTF-8"):
            load_scene(path)
