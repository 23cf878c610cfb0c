from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tests.refused import refused
from wrt.io.mesh_file import load_mesh
from wrt.io.meshes.stl import read as read_stl


def binary(triangles: np.ndarray) -> bytes:
    rows = np.zeros(len(triangles), dtype=[("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
    rows["corners"] = triangles
    return b"solid".ljust(80) + len(triangles).to_bytes(4, "little") + rows.tobytes()


def text(triangles: np.ndarray, name: str = "part") -> bytes:
    lines = [f"solid {name}"]
    for corners in triangles.tolist():
        lines += ["facet normal 0 0 0", "outer loop", *(f" vertex {x!r} {y!r} {z!r}" for x, y, z in corners),
                  "endloop", "endfacet"]
    return ("\n".join([*lines, f"endsolid {name}"]) + "\n").encode()


@pytest.fixture
def triangles() -> np.ndarray:
    return np.random.default_rng(3).random((7, 3, 3)).astype(np.float32)


@pytest.mark.parametrize("form", [binary, text])
def test_triangles_in_the_order_of_the_file(tmp_path: Path, triangles: np.ndarray, form) -> None:
    path = tmp_path / "a.stl"
    path.write_bytes(form(triangles))
    raw = read_stl(path)
    np.testing.assert_array_equal(raw.vertices[raw.faces].astype(np.float32), triangles)
    assert raw.groups == ()


def test_solids_become_groups(tmp_path: Path, triangles: np.ndarray) -> None:
    path = tmp_path / "a.stl"
    path.write_bytes(text(triangles[:2], "zebra") + text(triangles[2:], "ant"))
    raw = read_stl(path)
    np.testing.assert_array_equal(raw.vertices[raw.faces].astype(np.float32), triangles)
    assert raw.groups == ("zebra", "ant")
    assert raw.face_group is not None and raw.face_group.tolist() == [0, 0, 1, 1, 1, 1, 1]


def test_facet_normals_do_not_matter(tmp_path: Path, triangles: np.ndarray, capfd, caplog) -> None:
    path = tmp_path / "a.stl"
    path.write_bytes(text(triangles).replace(b"normal 0 0 0", b"normal -nan(ind) 0 x"))
    np.testing.assert_array_equal(read_stl(path).vertices.astype(np.float32), triangles.reshape(-1, 3))
    assert capfd.readouterr() == ("", "") and not caplog.records


@pytest.mark.parametrize("broken", [
    lambda t: binary(t)[:-1], lambda t: binary(t) + b"x", lambda t: binary(t)[:90], lambda t: binary(t)[:50],
    lambda t: text(t)[:-20], lambda t: text(t)[:200], lambda t: text(t) + text(t)[:300],
    lambda t: text(t).replace(b"vertex 0.", b"vertex x", 1), lambda t: b"\x89PNG\r\n\x1a\n" + bytes(range(256)),
    lambda t: b"solid\nendsolid\nvertex 1 2 3", lambda t: b"endsolid a\nsolid a\nvertex 1 2 3\nendsolid",
])
def test_junk_is_refused(tmp_path: Path, triangles: np.ndarray, broken) -> None:
    path = tmp_path / "a.stl"
    path.write_bytes(broken(triangles))
    with refused(path="a.stl"):
        load_mesh(path)


@pytest.mark.parametrize("value", [np.nan, np.inf])
@pytest.mark.parametrize("form", [binary, text])
def test_positions_must_be_finite(tmp_path: Path, triangles: np.ndarray, value: float, form) -> None:
    triangles[4, 1, 2] = value
    path = tmp_path / "a.stl"
    path.write_bytes(form(triangles))
    with refused(what="not finite", place="triangle 4", path="a.stl"):
        load_mesh(path)
