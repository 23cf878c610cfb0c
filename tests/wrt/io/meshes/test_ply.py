from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest

from tests.data import data_path
from tests.refused import refused
from wrt.io.mesh_file import load_mesh
from wrt.io.meshes.ply import read as read_ply

FORMATS = ("ascii", "binary_little_endian", "binary_big_endian")
POINTS = [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0), (2, 0, 0), (2, 1, 0)]


def ply(form: str, points: list[tuple[float, ...]], faces: list[tuple[int, ...]], *, columns: str = "x y z",
        uvs: list[tuple[float, ...]] | None = None) -> bytes:
    """A PLY file with float columns; `uvs`: texcoord lists of the faces."""
    order = ">" if form.endswith("big_endian") else "<"
    header = ["ply", f"format {form} 1.0", "comment made by a test", f"element vertex {len(points)}"]
    header += [f"property float {name}" for name in columns.split()]
    header += ["element extra 1", "property uchar a", "property double b", f"element face {len(faces)}"]
    header += ["property uchar flag", "property list uchar int vertex_indices"]
    header += ["property list uchar float texcoord"] * (uvs is not None)
    head = ("\n".join([*header, "end_header"]) + "\n").encode()
    rows: list[list[tuple[str, float]]] = [[("f", value) for value in point] for point in points]
    rows.append([("B", 7), ("d", 0.5)])
    for i, face in enumerate(faces):
        row = [("B", 1), ("B", len(face)), *(("i", corner) for corner in face)]
        if uvs is not None:
            row += [("B", len(uvs[i])), *(("f", value) for value in uvs[i])]
        rows.append(row)
    if form == "ascii":
        return head + "".join(" ".join(str(value) for _, value in row) + "\n" for row in rows).encode()
    return head + b"".join(struct.pack(order + "".join(kind for kind, _ in row), *(v for _, v in row)) for row in rows)


def write(folder: Path, data: bytes) -> Path:
    path = folder / "a.ply"
    path.write_bytes(data)
    return path


@pytest.mark.parametrize("form", FORMATS)
@pytest.mark.parametrize(("faces", "triangles"), [
    ([(0, 1, 2), (1, 4, 5)], [[0, 1, 2], [1, 4, 5]]),
    ([(0, 1, 2, 3), (1, 4, 5, 2)], [[0, 1, 2], [0, 2, 3], [1, 4, 5], [1, 5, 2]]),
    ([(0, 1, 2), (1, 4, 5, 2), (0, 2, 3)], [[0, 1, 2], [1, 4, 5], [1, 5, 2], [0, 2, 3]]),
    ([(0, 1), (0, 1, 2), ()], [[0, 1, 2]]),
])
def test_faces_in_the_order_of_the_file(tmp_path: Path, form: str, faces: list, triangles: list) -> None:
    raw = read_ply(write(tmp_path, ply(form, POINTS, faces)))
    assert raw.faces.tolist() == triangles
    assert raw.vertices.tolist() == [list(map(float, point)) for point in POINTS]
    assert raw.normals is None and raw.uvs is None
    assert raw.incomplete == sum(len(face) < 3 for face in faces)


@pytest.mark.parametrize("form", FORMATS)
def test_vertex_normals_and_uvs_stay_with_their_vertex(tmp_path: Path, form: str) -> None:
    rng = np.random.default_rng(1)
    rows = np.round(rng.random((6, 8)) * 64.0) / 64.0
    raw = read_ply(write(tmp_path, ply(form, [tuple(r) for r in rows.tolist()], [(5, 4, 0), (3, 1, 0)],
                                       columns="x y z nx ny nz s t")))
    np.testing.assert_array_equal(raw.normals, rows[:, 3:6])
    np.testing.assert_array_equal(raw.uvs, np.stack([rows[:, 6], 1.0 - rows[:, 7]], axis=1))


@pytest.mark.parametrize("form", FORMATS)
def test_uvs_of_faces_split_vertices(tmp_path: Path, form: str) -> None:
    uvs = [(0, 0, 1, 0, 1, 1), (0, 0, 1, 1, 0.25, 1)]  # vertices 0 and 2 agree in both faces
    raw = read_ply(write(tmp_path, ply(form, POINTS, [(0, 1, 2), (0, 2, 3)], uvs=uvs)))
    assert raw.uvs is not None and len(raw.vertices) == 4
    seam = read_ply(write(tmp_path, ply(form, POINTS, [(0, 1, 2), (0, 2, 3)], uvs=[uvs[0], (0.5, 0, 1, 1, 0.25, 1)])))
    assert seam.uvs is not None and len(seam.vertices) == 5
    corner_uvs = np.array([uvs[0], (0.5, 0, 1, 1, 0.25, 1)]).reshape(2, 3, 2)
    np.testing.assert_array_equal(seam.uvs[seam.faces], np.stack([corner_uvs[..., 0], 1 - corner_uvs[..., 1]], axis=-1))
    np.testing.assert_array_equal(seam.vertices[seam.faces], np.array(POINTS, dtype=float)[[[0, 1, 2], [0, 2, 3]]])


@pytest.mark.parametrize("form", FORMATS)
def test_every_truncation_is_refused(tmp_path: Path, form: str) -> None:
    whole = ply(form, POINTS, [(0, 1, 2), (1, 4, 5, 2)])
    # In text a number cut short is still a number; a whole word must go.
    for end in range(0, len(whole) - 2, 1 if form != "ascii" else 3):
        if form == "ascii" and not whole[end - 1:end + 1].strip() == b"":
            cut = whole[:end].rpartition(b" ")[0]
        else:
            cut = whole[:end]
        path = write(tmp_path, cut)
        with refused(path="a.ply"):
            load_mesh(path)


@pytest.mark.parametrize(("old", "new", "what", "place"), [
    (b"3 1 4 5", b"3 1 4 6", "index 6", "face 0"),
    (b"3 1 4 5", b"3 1 -4 5", "index -4", "face 0"),
    (b"3 1 4 5", b"3 1 4.5 5", "index 4.5", "face 0"),
    (b"3 1 4 5", b"-3 1 4 5", "a list of -3", "face 0"),
    (b"2.0 1.0", b"nan 1.0", "position", "vertex 5"),
    (b"2.0 1.0", b"1e60 1.0", "position", "vertex 5"),
    (b"2.0 1.0", b"2.0 one", "'one' is not a number", "line 20"),
    (b"float z", b"float w", "no vertices with x, y and z", None),
    (b"float z", b"vec3 z", "cannot read", "line 7"),
    (b"list uchar int v", b"list float int v", "cannot read", None),
    (b"vertex_indices", b"corners", "no list vertex_indices", None),
    (b"format ascii 1.0", b"format utf8", "cannot read", "line 2"),
    (b"format ascii 1.0\n", b"", "no line `format`", None),
    (b"vertex 6", b"vertex 99999999999999", "truncated", "element vertex"),
    (b"ply\n", b"PLY?\n", "is not a PLY file", None),
])
def test_errors_name_the_place(tmp_path: Path, old: bytes, new: bytes, what: str, place: str | None) -> None:
    data = ply("ascii", [tuple(map(float, point)) for point in POINTS], [(1, 4, 5)])
    assert data.count(old) == 1
    path = write(tmp_path, data.replace(old, new))
    with refused(None, what, place, path):
        load_mesh(path)


@pytest.mark.parametrize("name", ["medium/stanford_bunny.ply", "large/dragon_871k.ply"])
def test_same_arrays_as_trimesh(name: str) -> None:
    import trimesh

    path = data_path("meshes/" + name)
    raw = read_ply(path)
    other = trimesh.load(path, process=False)
    np.testing.assert_array_equal(raw.faces, other.faces)
    np.testing.assert_array_equal(raw.vertices, np.asarray(other.vertices, dtype=np.float32))


@pytest.mark.parametrize(("old", "new", "what", "place"), [
    (b"element vertex 3", b"element vertex 1000000000000", "1000000000000", "element vertex"),
    (b"element vertex 3", b"element vertex " + b"9" * 5000, "cannot read", "line 4"),
    (b"element face 1", b"element face 1000000000000", "1000000000000", "element face"),
    (b"element vertex", b"element nothing 1000000000000\nelement vertex", "", None),
    (b" 3 0 1 2", b" inf 0 1 2", "inf values", "face 0"),
    (b" 3 0 1 2", b" nan 0 1 2", "nan values", "face 0"),
    (b" 3 0 1 2", b" 1e300 0 1 2", "truncated", "element face"),
])
def test_absurd_counts(old: bytes, new: bytes, what: str, place: str | None, tmp_path: Path) -> None:
    data = ply("ascii", [(0, 0, 0), (1, 0, 0), (0, 1, 0)], [(0, 1, 2)])
    assert old in data
    path = write(tmp_path, data.replace(old, new))
    if not what:  # rows that hold nothing need no room
        assert len(read_ply(path).faces) == 1
        return
    with refused(None, what, place, path):
        load_mesh(path)


def strip_by_hand(strip: list[int]) -> list[tuple[int, ...]]:
    found, run = [], []
    for index in strip:
        run = [] if index < 0 else [*run, index]
        if len(run) > 2:
            a, b, c = run[-3:]
            found.append((a, b, c) if len(run) % 2 else (a, c, b))
    return found


@pytest.mark.parametrize("form", FORMATS)
@pytest.mark.parametrize("strips", [
    [[0, 1, 3, 2]], [[0, 1, 3, 2, -1, 1, 4, 2, 5]], [[0, 1, 3], [1, 4, 2, 5, -1]], [[-1, -1, 0, 1, -1, 3, 2, 0, -1, 5]],
    [[0, 1, 3, -1, 2, 5, 4, 1], [], [2], [0, 1, 2]], [[0, 1]],
])
def test_strips(form: str, strips: list[list[int]], tmp_path: Path) -> None:
    data = ply(form, POINTS, [tuple(strip) for strip in strips]).replace(b"element face", b"element tristrips")
    raw = read_ply(write(tmp_path, data))
    assert raw.faces.tolist() == [list(triangle) for strip in strips for triangle in strip_by_hand(strip)]


def test_strips_come_behind_faces(tmp_path: Path) -> None:
    text = ply("ascii", POINTS, [(0, 1, 2, 3)]).decode()
    head, body = text.split("end_header\n")
    text = f"{head}element tristrips 1\nproperty list int int vertex_indices\nend_header\n{body}7 1 4 2 5 -1 0 1\n"
    raw = read_ply(write(tmp_path, text.encode()))
    assert raw.faces.tolist() == [[0, 1, 2], [0, 2, 3], [1, 4, 2], [4, 5, 2]] and raw.incomplete == 0


def test_a_strip_with_a_wrong_index(tmp_path: Path) -> None:
    data = ply("ascii", POINTS, [(0, 1, 2), (0, 1, -2)]).replace(b"element face", b"element tristrips")
    with refused(None, "index -2", "tristrips 1", "a.ply"):
        load_mesh(write(tmp_path, data))


def test_line_ends_of_windows(tmp_path: Path) -> None:
    data = ply("ascii", POINTS, [(0, 1, 2, 3), (1, 4, 5, 2)]).replace(b"\n", b"\r\n")
    assert read_ply(write(tmp_path, data)).faces.tolist() == [[0, 1, 2], [0, 2, 3], [1, 4, 5], [1, 5, 2]]
    with refused(None, "'x4'", f"line {data.count(10) - 1}"):
        load_mesh(write(tmp_path, data.replace(b" 4 0 1", b" x4 0 1")))
