from __future__ import annotations

import contextlib
import re
from pathlib import Path

import numpy as np
import pytest

import wrt
from tests.refused import refused
from wrt.core.errors import SceneWarning
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
    path.write_bytes(text(triangles[:2], "zebra") + text(triangles[2:6], "ant") + text(triangles[6:], "zebra"))
    raw = read_stl(path)
    np.testing.assert_array_equal(raw.vertices[raw.faces].astype(np.float32), triangles)
    assert raw.groups == ("zebra", "ant")
    assert raw.face_group is not None and raw.face_group.tolist() == [0, 0, 1, 1, 1, 1, 0]  # by name


@pytest.mark.parametrize("broken", [
    lambda t: binary(t)[:-1], lambda t: text(t)[:-30], lambda t: text(t)[:8],
    lambda t: text(t).replace(b"solid part\n", b"", 1), lambda t: text(t).replace(b"endloop", b"vertex 1 1 1\nendloop"),
    lambda t: binary(t)[:90], lambda t: binary(t)[:50],
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


def count(data: bytes, triangles: int) -> bytes:
    return data[:80] + triangles.to_bytes(4, "little") + data[84:]


@pytest.mark.parametrize(("change", "read", "warns"), [
    (lambda d: d + b"\n", 7, False), (lambda d: d + bytes(1000), 7, False), (lambda d: d + b"end of part", 7, True),
    (lambda d: count(d, 0), 7, True), (lambda d: count(d, 5), 7, True), (lambda d: count(d, 5) + b"\0", 7, True),
    (lambda d: d[:-50], 0, False), (lambda d: d[:-1], 0, False), (lambda d: count(d, 8), 0, False),
    (lambda d: count(d, 2**32 - 1), 0, False),
    (lambda d: count(d, 0) + b"xyz", 0, False),
])
def test_binary_files_with_another_length_than_announced(triangles, change, read, warns, tmp_path: Path) -> None:
    path = tmp_path / "a.stl"
    for head in (b"solid".ljust(80), b"exported by a test".ljust(80, b"\0")):
        path.write_bytes(change(head + binary(triangles)[80:]))
        expected = f"announces .* triangles .*bytes.*, but has {path.stat().st_size} bytes"
        if not read:
            with refused(None, "announces", path="a.stl") as caught:
                load_mesh(path)
            assert re.search(expected, str(caught.value)) and "line" not in str(caught.value)
            continue
        with pytest.warns(SceneWarning, match=expected) if warns else contextlib.nullcontext():
            raw = read_stl(path)
        np.testing.assert_array_equal(raw.vertices[raw.faces][:5], triangles[:5])
        assert len(raw.faces) == read


@pytest.mark.parametrize(("old", "new"), [
    (b"endloop", b"end loop"), (b"endfacet", b"End  Facet"), (b"endsolid part", b"end solid"), (b"\n", b"\ncolor 0.5 0.5 0.5\n"),
    (b"endloop", b"endloop\nCOLOUR 1 0 0"), (b"\nfacet", b"\n# facet\nfacet"), (b"\n", b"\r\n\r\n"), (b"\n", b"\r"),
    (b"\nouter loop\n", b" OUTER LOOP "),
    (b"\nend", b" end"), (b"0.", b"D+00"), (b"normal 0 0 0", b"normal 1.#IND nan(ind) 0,0"),
    (b"facet normal 0 0 0", b"facet\nnormal 0 0 0"),
    (b"facet normal 0 0 0\n", b"facet\n"), (b"part", b""),
])
def test_spellings_of_text(triangles: np.ndarray, old: bytes, new: bytes, tmp_path: Path) -> None:
    data = text(triangles)
    assert old in data
    data = re.sub(rb" (0\.\d+)(?=\n|\r)", rb" \1D+00", data) if b"D+00" in new else data.replace(old, new)
    for form in (data, data.upper(), data.replace(b"\n", b"\n\t ")):
        (tmp_path / "a.stl").write_bytes(form)
        raw = read_stl(tmp_path / "a.stl")
        np.testing.assert_array_equal(raw.vertices[raw.faces].astype(np.float32), triangles)


@pytest.mark.parametrize(("data", "sizes", "names"), [
    (lambda t: text(t)[:-14], [7], ()), (lambda t: text(t[:2])[:-14] + text(t[2:], "b"), [2, 5], ("part", "b")),
])
def test_a_missing_endsolid_is_told(triangles: np.ndarray, data, sizes: list[int], names: tuple[str, ...], tmp_path: Path) -> None:
    (tmp_path / "a.stl").write_bytes(data(triangles))
    with pytest.warns(SceneWarning, match="a.stl: endsolid is missing 1 times"):
        raw = read_stl(tmp_path / "a.stl")
    np.testing.assert_array_equal(raw.vertices[raw.faces].astype(np.float32), triangles)
    assert raw.groups == names and np.bincount([0] * 7 if raw.face_group is None else raw.face_group).tolist() == sizes


def test_every_truncation_of_text_is_refused_or_told(triangles: np.ndarray, tmp_path: Path) -> None:
    whole = text(triangles[:2])
    for end in range(len(whole) - 6):  # the last bytes are the name of the solid
        (tmp_path / "a.stl").write_bytes(whole[:end])
        with pytest.raises((wrt.InputError, SceneWarning)):
            load_mesh(tmp_path / "a.stl")
