"""Numbers of text files that Python's float does not take, by the reader of each format."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from tests.refused import refused
from wrt.core.errors import SceneWarning
from wrt.io.mesh_file import load_mesh
from wrt.io.text import as_number, without_comment

NAN = ["nan", "-nan(ind)", "NaN(snan)", "nan(0x8000000000000)", "NaNQ", "1.#IND", "-1.#IND00", "1.#QNAN0", "1.#snan",
       "1.#J", "-1.#IO", "1.#R"]
INFINITE = ["inf", "-Infinity", "1.#INF", "-1.#INF00", "1.#INF00e+000", "+1.#inf"]
PLY = """ply
format ascii 1.0
element vertex 3
property float x
property float y
property float z
property float nx
property float ny
property float nz
element face 1
property list uchar int vertex_indices
end_header
{} 0 0 0 0 0
1 0 0 0 0 1
0 1 0 0 0 1
3 0 1 2
"""
POSITION = {  # a file with a word for the first coordinate
    ".obj": "v {} 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", ".ply": PLY, ".off": "OFF 3 1 0\n{} 0 0\n1 0 0\n0 1 0\n3 0 1 2\n",
    ".stl": "solid\nfacet\nouter loop\nvertex {} 0 0\nvertex 1 0 0\nvertex 0 1 0\nendloop\nendfacet\nendsolid\n",
}
NORMAL = {
    ".obj": "v 0 0 0\nv 1 0 0\nv 0 1 0\nvn {} 0 1 # a\nvn 0 0 1\nf 1//1 2//2 3//2\n",
    ".ply": PLY.replace("{} 0 0 0 0 0", "0 0 0 {} 0 1"),
}


@pytest.mark.parametrize("word", NAN + INFINITE)
def test_what_is_not_finite(word: str) -> None:
    for form in (word, word.encode()):
        found = as_number(form)
        assert math.isnan(found) if word in NAN else found == (-math.inf if word[0] == "-" else math.inf)
    assert without_comment(f"v {word} 1# x") == f"v {word} 1 "


@pytest.mark.parametrize("word", NAN + INFINITE)
@pytest.mark.parametrize("suffix", POSITION)
def test_every_reader_knows_it(suffix: str, word: str, tmp_path: Path) -> None:
    path = tmp_path / f"a{suffix}"
    path.write_text(POSITION[suffix].replace("{}", word))
    with refused(None, "finite", path=path):
        load_mesh(path)
    if suffix in NORMAL:
        path.write_text(NORMAL[suffix].replace("{}", word))
        with pytest.warns(SceneWarning, match="1 normals are not finite"):
            mesh = load_mesh(path)
        np.testing.assert_array_equal(mesh.normals, [[0, 0, 0], [0, 0, 1], [0, 0, 1]])


@pytest.mark.parametrize("suffix", POSITION)
def test_exponents_of_fortran(suffix: str, tmp_path: Path) -> None:
    for word, value in (("-1.25D+01", -12.5), ("-5d-1", -0.5), ("-.5D0", -0.5)):
        (tmp_path / f"a{suffix}").write_text(POSITION[suffix].replace("{}", word))
        assert load_mesh(tmp_path / f"a{suffix}").vertices[0].tolist() == [value, 0, 0]


@pytest.mark.parametrize("suffix", POSITION)
@pytest.mark.parametrize("word", ["0,5", "x", "1.#", "1.5f", "nan(", "d", "1..5", "--1"])
def test_other_words_are_refused(suffix: str, word: str, tmp_path: Path) -> None:
    (tmp_path / f"a{suffix}").write_text(POSITION[suffix].replace("{}", word))
    with refused(path=f"a{suffix}") as caught:
        load_mesh(tmp_path / f"a{suffix}")
    assert "line " in str(caught.value) and "number" in str(caught.value)
    if word == "0,5":
        assert "decimal point" in str(caught.value)
