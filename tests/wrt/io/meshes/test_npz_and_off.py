"""NumPy archives and OFF files, and the files that `Mesh.save` writes."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import wrt
from tests.refused import refused
from wrt.scene.mesh import Mesh
from wrt.scene.shapes import icosphere

PYRAMID = """# a pyramid
COFF 5 5 0
0 0 0 255 0 0 255   # colours are not read
1 0 0 255 0 0 255
1 1 0 255 0 0 255
0 1 0 255 0 0 255

0.5 0.5 1 0 0 0 255
4 3 2 1 0
3 0 1 4
3 1 2 4 0.5 0.5 0.5
3 2 3 4
3 3 0 4
"""


def test_off(tmp_path: Path) -> None:
    (tmp_path / "a.off").write_text(PYRAMID)
    mesh = wrt.load_mesh(tmp_path / "a.off")
    assert len(mesh.vertices) == 5 and mesh.faces[2:].tolist() == [[0, 1, 4], [1, 2, 4], [2, 3, 4], [3, 0, 4]]
    assert wrt.contains(wrt.build(tmp_path / "a.off"), [[0.5, 0.5, 0.5], [0.5, 0.5, 1.5]]).tolist() == [True, False]
    for old, new, what, place in (("COFF", "ply", "no OFF file", None), ("COFF 5 5", "OFF 5 2000000000", "ends too early", None),
                                  ("3 0 1 4", "3 0 1 5", "none of the 5 vertices", "line 10"), ("3 3 0 4\n", "", "a face is missing", None),
                                  ("3 0 1 4", "3 0 1", "needs 3 corners", "line 10"), ("0.5 0.5 1 ", "0.5 nan 1 ", "finite", "line 8"),
                                  ("0.5 0.5 1 ", "0.5 x 1 ", "numbers", "line 8"), ("4 3 2", "-4 3 2", "corners", "line 9")):
        (tmp_path / "b.off").write_text(PYRAMID.replace(old, new))
        with refused(None, what, place, path="b.off"):
            wrt.load_mesh(tmp_path / "b.off")


@pytest.mark.parametrize("suffix", [".npz", ".ply", ".stl", ".off", ".obj"])
def test_saved_meshes_are_read_again(suffix: str, tmp_path: Path) -> None:
    ball = icosphere(2)
    mesh = Mesh(ball.vertices, ball.faces, ball.vertices, ball.vertices[:, :2] * 0.5 + 0.5)
    if suffix != ".npz":
        pytest.importorskip("trimesh")
    mesh.save(tmp_path / f"a{suffix}")
    again = wrt.load_mesh(tmp_path / f"a{suffix}")
    corners = again.vertices[again.faces]
    np.testing.assert_allclose(corners, mesh.vertices[mesh.faces], atol=1e-6)
    if suffix == ".npz":
        assert corners.tobytes() == mesh.vertices[mesh.faces].tobytes()
        assert again.uvs is not None and again.normals is not None
        np.testing.assert_array_equal(again.uvs, mesh.uvs)


def test_what_npz_refuses(tmp_path: Path) -> None:
    good = {"vertices": np.eye(3), "faces": np.array([[0, 1, 2]])}
    for change, what in (({"faces": np.array([[0, 1, 3]])}, "3 vertices"), ({"faces": np.eye(3)}, "integers"),
                         ({"normals": np.eye(3)[:2]}, "3 rows"), ({"vertices": np.eye(3) * np.nan}, "finite"),
                         ({"uvs": np.eye(3)}, "(N, 2)"), ({"vertices": np.array([None])}, "")):
        np.savez(tmp_path / "a.npz", **(good | change))
        with pytest.raises(wrt.InputError) as caught:
            wrt.load_mesh(tmp_path / "a.npz")
        assert what in str(caught.value) and "a.npz" in str(caught.value)
    for data in (b"", b"PK", b"x" * 100):
        (tmp_path / "a.npz").write_bytes(data)
        with refused(None, "no NumPy archive", path="a.npz"):
            wrt.load_mesh(tmp_path / "a.npz")
    with refused(None, "trimesh does not write", path="a.abc"):
        icosphere(1).save(tmp_path / "a.abc")
