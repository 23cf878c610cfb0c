from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import wrt
from tests.data import data_path
from tests.refused import refused
from wrt.core.errors import SceneWarning
from wrt.io.mesh_file import load_mesh
from wrt.io.meshes.obj import read as read_obj
from wrt.scene.mesh import smooth
from wrt.scene.shapes import icosphere

SQUARE = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\n"


def write(folder: Path, text: str) -> Path:
    path = folder / "a.obj"
    path.write_text(text)
    return path


def test_corners_become_vertices(tmp_path: Path) -> None:
    raw = read_obj(write(tmp_path, SQUARE + "vt 0 0\nvt 1 0.25\nvn 0 0 1\nvn 0 0 -1\n"
                                            "f 1/1/1 2/2/1 3/2/1\nf 1/1/2 3/2/2 4/1/2\n"))
    assert raw.faces.shape == (2, 3) and len(raw.vertices) == 6  # 1 and 3 appear with two normals each
    corners = raw.vertices[raw.faces]
    assert corners[0].tolist() == [[0, 0, 0], [1, 0, 0], [1, 1, 0]]
    assert corners[1].tolist() == [[0, 0, 0], [1, 1, 0], [0, 1, 0]]
    assert raw.normals is not None and raw.uvs is not None
    assert raw.normals[raw.faces][:, :, 2].tolist() == [[1, 1, 1], [-1, -1, -1]]
    assert raw.uvs[raw.faces][0].tolist() == [[0.0, 1.0], [1.0, 0.75], [1.0, 0.75]]  # v is flipped


def test_relative_indices_equal_absolute_ones(tmp_path: Path) -> None:
    absolute = read_obj(write(tmp_path, SQUARE + "vn 0 0 1\nf 1//1 2//1 3//1\n" + SQUARE + "f 5 6 7 8\n"))
    relative = read_obj(write(tmp_path, SQUARE + "vn 0 0 1\nf -4//-1 -3//-1 -2//-1\n" + SQUARE + "f -4 -3 -2 -1\n"))
    for name in ("vertices", "faces", "normals"):
        np.testing.assert_array_equal(getattr(absolute, name), getattr(relative, name))


def test_odd_spelling(tmp_path: Path) -> None:
    text = ("v\t0  0 0 # first\n v 1 0 0 1 0 0\r\nv 1 1 \\\n 0\n\n"
            "f  1// 2//\t3//  # face\nf 1/ 2 3\nl 1 2\ns off\nfoo bar\n")
    raw = read_obj(write(tmp_path, text))
    assert raw.vertices[raw.faces[0]].tolist() == [[0, 0, 0], [1, 0, 0], [1, 1, 0]]
    assert len(raw.faces) == 2 and raw.normals is None and raw.uvs is None


def test_corners_without_normal_get_zero(tmp_path: Path) -> None:
    raw = read_obj(write(tmp_path, SQUARE + "vn 0 0 2\nf 1//1 2//1 3//1\nf 1 3 4\n"))
    assert raw.normals is not None
    assert raw.normals[raw.faces][:, :, 2].tolist() == [[2, 2, 2], [0, 0, 0]]


@pytest.mark.parametrize(("lines", "names", "index"), [
    ("f 1 2 3\nf 1 3 4\n", (), None),
    ("usemtl red\nf 1 2 3\nusemtl blue stone\nf 1 3 4 2\nusemtl red\nf 2 3 4\n", ("red", "blue stone"), [0, 1, 1, 0]),
    ("f 1 2 3\ng a b\nf 1 3 4\n", ("", "a b"), [0, 1]),
    ("o box\ng side\nusemtl m\nusemtl n\nf 1 2 3\n", ("n",), [0]),
    ("o box\nf 1 2 3\no lid\nf 1 3 4\n", ("box", "lid"), [0, 1]),
    ("g late\ng x\ng first\nf 1 2 3\ng late\nf 1 3 4\ng x\n", ("late", "first"), [1, 0]),  # x has no faces; else the file's order
])
def test_groups(tmp_path: Path, lines: str, names: tuple[str, ...], index: list[int] | None) -> None:
    raw = read_obj(write(tmp_path, SQUARE + lines))
    assert raw.groups == names
    assert (raw.face_group.tolist() if raw.face_group is not None else None) == index


@pytest.mark.parametrize(("faces", "absent"), [
    ("f 1//1 2//2 3//3\n", "vn"), ("f 1/7 2/7 3/7\n", "vt"), ("f -4/-4/-4 -3/-3/-3 -2/-2/-2\n", "vt and vn"),
])
def test_indices_of_absent_lines_are_left_out(tmp_path: Path, faces: str, absent: str) -> None:
    with pytest.warns(SceneWarning, match=f"a.obj: the indices of {absent} in its faces are left out") as told:
        mesh = load_mesh(write(tmp_path, SQUARE + faces))
    assert len(told) == 1 and mesh.normals is None and mesh.uvs is None
    assert mesh.vertices[mesh.faces].tolist() == [[[0, 0, 0], [1, 0, 0], [1, 1, 0]]]


@pytest.mark.parametrize(("lines", "line", "says"), [
    ("f 1 2 5\n", 5, "index 5 is not in 1 to 4"),
    ("f 1 2 0\n", 5, "index 0"),
    ("\nf 1 2 -5\n", 6, "index -5"),
    ("vt 0 0\nf 1/1 2/2 3/1\n", 6, "vt index 2"), ("f 1//-1 2//-1 3//-1\nvn 0 0 1\n", 5, "vn index -1"),
    ("f 1/x 2/x 3/x\n", 5, "vt index x"),
    ("f 1//2 2//2 3//2\nvn 0 0 1\n", 5, "vn index 2"),
    ("f 1 2 three\n", 5, "three"),
    ("f 1/2/3/4 2 3\n", 5, "1/2/3/4"),
    ("f /1 2 3\n", 5, "/1"),
    ("f 1.5 2 3\n", 5, "1.5"),
    ("v 1 2\nf 1 2 3\n", 5, "v needs 3 numbers, got 2"),
    ("v 1 2 x\nf 1 2 3\n", 5, "'x'"),
    ("vt\nf 1 2 3\n", 5, "vt needs 2"),
    ("v nan 0 0\nf 1 2 5\n", 5, "not finite"),
    ("v 0 0 1e39\nf 1 2 5\n", 5, "not finite"),
])
def test_errors_name_file_and_line(tmp_path: Path, lines: str, line: int, says: str) -> None:
    path = write(tmp_path, SQUARE + lines)
    with refused(None, says, f"line {line}", path):
        load_mesh(path)


def test_a_bad_position_that_no_face_uses_does_no_harm(tmp_path: Path) -> None:
    assert len(read_obj(write(tmp_path, "v nan 0 0\n" + SQUARE + "f 2 3 4\n")).faces) == 1


def test_same_triangles_as_trimesh() -> None:
    import trimesh

    path = data_path("meshes/small/cow.obj")
    raw = read_obj(path)
    other = trimesh.load(path, process=False, maintain_order=True)
    # trimesh puts the second halves of quads last, so compare the sets of triangles.
    def key(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
        rows = np.asarray(vertices, dtype=np.float32)[faces].reshape(-1, 3, 3)
        turn = np.argmin(rows[..., 0] + 1e-3 * rows[..., 1] + 1e-6 * rows[..., 2], axis=1)
        rows = rows[np.arange(len(rows))[:, None], (turn[:, None] + np.arange(3)) % 3].reshape(-1, 9)
        return rows[np.lexsort(rows.T)]
    np.testing.assert_array_equal(key(raw.vertices, raw.faces), key(other.vertices, other.faces))


@pytest.mark.parametrize("index", ["99999999999999999999", "9" * 5000, "-" + "9" * 5000])
def test_indices_of_any_length_are_reported(index: str, tmp_path: Path) -> None:
    with refused(what="face corner '", place="line 5", path="a.obj") as caught:
        load_mesh(write(tmp_path, f"{SQUARE}f 1 2 {index}\n"))
    assert len(str(caught.value)) < 300 + len(str(tmp_path))


@pytest.mark.parametrize("text", ["f 1 2 \\\n3 \\\n4\n",
                                  "f 1 2 \\\n \\\n\\\n 3 4", "f 1 2 3 4\\", "f 1 2 3 \\\n4\\\n", "f 1 2\\\r\n3 4\r\n"])
def test_continued_lines(text: str, tmp_path: Path) -> None:
    (tmp_path / "a.obj").write_bytes((SQUARE + text).encode())
    assert read_obj(tmp_path / "a.obj").faces.tolist() == [[0, 1, 2], [0, 2, 3]]


def test_many_corners_and_relative_ones(tmp_path: Path) -> None:
    corners = " ".join(f"{i % 4 + 1}//{i % 2 + 1}" for i in range(300))
    relative = " ".join(f"-{i % 4 + 1}" for i in range(300))
    raw = read_obj(write(tmp_path, f"{SQUARE}vn 0 0 1\nvn 0 1 0\ng a\nf {corners}\ng b\nf {relative} # {corners}\nf 1 2 3\n"))
    assert raw.groups == ("a", "b") and len(raw.faces) == 298 + 298 + 1
    for bad, message in (("v 1 x 0\n", (None, "'x' is not a number", "line 5")), ("f 1 2 -9 4\n", (None, "face corner '-9'", "line 5"))):
        with refused(*message):
            load_mesh(write(tmp_path, SQUARE + bad + SQUARE))


@pytest.mark.parametrize("text", ["# C:\\models\\\n" + SQUARE, SQUARE.replace("0 1 0", "0 1 0 # C:\\\\", 1), SQUARE + "g a # C:\\\n",
                                  SQUARE.replace("v 1 0 0", "v 1 \\\n0 0# C:\\"), SQUARE + "# a\n#\\\r\n", SQUARE + "v 5 5 5 \\# x\n"])
def test_a_comment_that_ends_in_a_backslash_continues_nothing(text: str, tmp_path: Path) -> None:
    raw = read_obj(write(tmp_path, text + "f 1 2 3 4\n"))
    assert raw.vertices[raw.faces].tolist() == [[[0, 0, 0], [1, 0, 0], [1, 1, 0]], [[0, 0, 0], [1, 1, 0], [0, 1, 0]]]


@pytest.mark.parametrize(("written", "name"), [
    ("red\t# again", "red"), ("red#1", "red#1"), ("#FF0000 # red", "#FF0000"), ("Material #25", "Material #25"),
    ("a b #", "a b"), ("# none", ""), ("a#b \\\n c # d", "a#b   c"), ("a \\\n # C:\\", "a"),
])
def test_names_lose_comments_but_keep_their_hash(written: str, name: str, tmp_path: Path) -> None:
    assert read_obj(write(tmp_path, f"{SQUARE}usemtl {written}\nf 1 2 3\n")).groups == (name,)


RIDGE = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nv 2 0 1\nv 2 1 1\n"
LEFT, RIGHT, BETWEEN = [0, 0, 1], [-(0.5**0.5), 0, 0.5**0.5], [-0.38268343, 0, 0.92387953]


@pytest.mark.parametrize(("lines", "first", "second"), [
    ("s 1\nf 1 2 3 4\nf 2 5 6 3\n", BETWEEN, BETWEEN), ("s 1\nf 1 2 3 4\ns 2\nf 2 5 6 3\n", LEFT, RIGHT),
    ("s 1 # one\nf 1 2 3 4\ns off\nf 2 5 6 3\n", LEFT, [0, 0, 0]), ("f 1 2 3 4\ns on\nf 2 5 6 3\n", [0, 0, 0], RIGHT),
    ("s 1\nf 1 2 3 4\ns 0\ns 1\ng b\nf 2 5 6 3\n", BETWEEN, BETWEEN),
    ("vn 1 0 0\ns 7\nf 1//1 2//1 3//1 4//1\nf 2 5 6 3\n", [1, 0, 0], BETWEEN),
    ("vt 0 0\nvt 1 1\ns 1\nf 1/1 2/1 3/1 4/1\nf 2/2 5/2 6/2 3/2\n", BETWEEN, BETWEEN),
    ("s 3\nf 1 2\nf 1 2 3 4\nf 2 5 6 3\n", BETWEEN, BETWEEN),
])
def test_smoothing_groups(lines: str, first: list[float], second: list[float], tmp_path: Path) -> None:
    """The normals of both faces at their common edge: the average within a group (two squares: equal angles), except where vn are given."""
    mesh = load_mesh(write(tmp_path, RIDGE + lines))
    assert mesh.normals is not None and len(mesh.faces) == 4
    at_edge = (mesh.vertices[mesh.faces] == [1, 0, 0]).all(axis=2)
    for faces, expected in ((slice(0, 2), first), (slice(2, 4), second)):
        found = mesh.normals[mesh.faces[faces]][at_edge[faces]]
        np.testing.assert_allclose(found, [expected] * len(found), atol=1e-6)
    plain = load_mesh(write(tmp_path, RIDGE + "".join(line + "\n" for line in lines.splitlines() if line[0] != "s")))
    np.testing.assert_array_equal(mesh.vertices[mesh.faces], plain.vertices[plain.faces])


@pytest.mark.parametrize("lines", ["f 1 2 3 4\n", "s off\nf 1 2 3 4\ns 0\nf 2 5 6 3\n", "s\nf 1 2 3 4\n", "s 1\ns off\nf 1 2 3 4\n"])
def test_no_smoothing_group_leaves_facets(lines: str, tmp_path: Path) -> None:
    normals = load_mesh(write(tmp_path, RIDGE + lines)).normals
    assert normals is None or not normals.any()


def test_one_group_equals_smooth_and_shares_vertices(tmp_path: Path) -> None:
    ball = icosphere(2)
    wrt.Mesh(ball.vertices, ball.faces).save(path := tmp_path / "a.obj")
    path.write_text(path.read_text().replace("f ", "s 1\nf ", 1))
    mesh = load_mesh(path)
    np.testing.assert_array_equal(mesh.faces, ball.faces)
    np.testing.assert_allclose(mesh.normals, smooth(wrt.Mesh(ball.vertices, ball.faces)).normals, atol=1e-7)


def test_smoothing_groups_far_from_0(tmp_path: Path) -> None:
    """Survey coordinates: the normals are those of the same surface near 0."""
    near = load_mesh(write(tmp_path, RIDGE + "s 1\nf 1 2 3 4\nf 2 5 6 3\n"))
    lines = [line.split() for line in RIDGE.splitlines()]
    moved = "".join(f"v {int(x) + 529000.125} {int(y) + 5801000.25} {z}\n" for _, x, y, z in lines)
    far = load_mesh(write(tmp_path, moved + "s 1\nf 1 2 3 4\nf 2 5 6 3\n"))
    np.testing.assert_allclose(far.normals, near.normals, atol=1e-6)
