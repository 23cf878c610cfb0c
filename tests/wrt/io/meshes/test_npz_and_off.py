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
    for old, new, what, place in (
            ("COFF", "ply", "no OFF file", None), ("COFF 5 5 0", "4OFF 5 5 0", "no OFF file", None),
            ("COFF 5 5 0", "OFF BINARY", "no OFF file", None), ("COFF 5 5", "OFF 5 2000000000", "ends too early", None),
            ("3 3 0 4\n", "", "ends too early", None),
            ("3 0 1 4", "3 0 1 5", "none of the 5 vertices", "line 10"), ("3 0 1 4", "3 0 1", "needs 4 numbers", "line 10"),
            ("0.5 0.5 1 ", "0.5 nan 1 ", "finite", "line 8"), ("0.5 0.5 1 ", "0.5 x 1 ", "number", "line 8"),
            ("4 3 2", "-4 3 2", "'-4'", "line 9")):
        (tmp_path / "b.off").write_text(PYRAMID.replace(old, new))
        with refused(None, what, place, path="b.off"):
            wrt.load_mesh(tmp_path / "b.off")
    for old, new in (("COFF 5 5 0", "COFF5 5 0"), ("COFF 5 5 0", "STCNOFF5 5"), ("COFF 5 5 0", "off\n# counts\n5 5 0 # of all"),
                     ("COFF 5 5 0", "5 5 0"), ("\n", "\r\n")):
        (tmp_path / "b.off").write_bytes(PYRAMID.replace(old, new).encode())
        other = wrt.load_mesh(tmp_path / "b.off")
        assert mesh.vertices.tolist() == other.vertices.tolist() and mesh.faces.tolist() == other.faces.tolist()


@pytest.mark.parametrize("suffix", [".npz", ".ply", ".stl", ".off", ".obj", ".OBJ"])
@pytest.mark.parametrize("shading", [(), ("normals",), ("uvs",), ("normals", "uvs")])
def test_saved_meshes_are_read_again(suffix: str, shading: tuple[str, ...], tmp_path: Path) -> None:
    if suffix != ".npz":
        pytest.importorskip("trimesh")
    ball = icosphere(2)
    corners = {"normals": ball.vertices, "uvs": ball.vertices[:, :2] * 0.5 + 0.5}
    for scale in (1.0, 1e-6, 5e-9, 1e-30, 1e30):
        mesh = Mesh(ball.vertices * np.float32(scale), ball.faces, **{name: corners[name] for name in shading})
        mesh.save(tmp_path / f"a{suffix}")
        again = wrt.load_mesh(tmp_path / f"a{suffix}")
        assert (again.vertices + 0.0)[again.faces].tobytes() == (mesh.vertices + 0.0)[mesh.faces].tobytes()
        if suffix in (".stl", ".off"):
            continue
        for name in corners:
            assert (getattr(again, name) is not None) == (name in shading)
            if name in shading:
                np.testing.assert_allclose(getattr(again, name)[again.faces], corners[name][mesh.faces], atol=2e-7)


@pytest.mark.parametrize("suffix", [".obj", ".off"])
def test_other_readers_find_the_saved_bits(suffix: str, tmp_path: Path) -> None:
    trimesh = pytest.importorskip("trimesh")
    rng = np.random.default_rng(2)
    vertices = (rng.normal(size=(300, 3)) * 10.0 ** rng.integers(-38, 30, (300, 3))).astype(np.float32)
    mesh = Mesh(vertices, np.arange(300).reshape(-1, 3), icosphere(3).vertices[:300], rng.random((300, 2)))
    mesh.save(tmp_path / f"a{suffix}")
    theirs = trimesh.load(tmp_path / f"a{suffix}", process=False, maintain_order=True)
    assert theirs.vertices[theirs.faces].astype(np.float32).tobytes() == (vertices + 0.0)[mesh.faces].tobytes()


def test_what_npz_refuses(tmp_path: Path) -> None:
    good = {"vertices": np.eye(3), "faces": np.array([[0, 1, 2]])}
    for change, what in (({"faces": np.array([[0, 1, 3]])}, "3 vertices"), ({"groups": np.eye(2)}, "str"),
                         ({"faces": np.eye(3)}, "integers"),
                         ({"normals": np.eye(3)[:2]}, "3 rows"), ({"vertices": np.eye(3) * np.nan}, "finite"),
                         ({"uvs": np.eye(3)}, "(N, 2)"), ({"vertices": np.array([None])}, "")):
        np.savez(tmp_path / "a.npz", **(good | change))
        with pytest.raises(wrt.InputError) as caught:
            wrt.load_mesh(tmp_path / "a.npz")
        assert what in str(caught.value) and "a.npz" in str(caught.value)
    np.savez_compressed(tmp_path / "a.npz", **good)
    whole = (tmp_path / "a.npz").read_bytes()
    begin = whole.index(b"vertices.npy") + 32  # of zlib's data, behind NumPy's extra field
    for data in (b"", b"PK", b"x" * 100, whole[:begin] + b"\xff" * 20 + whole[begin + 20:]):
        (tmp_path / "a.npz").write_bytes(data)
        with refused(None, "no NumPy archive", path="a.npz"):
            wrt.load_mesh(tmp_path / "a.npz")
    with refused(None, "trimesh does not write", path="a.abc"):
        icosphere(1).save(tmp_path / "a.abc")
