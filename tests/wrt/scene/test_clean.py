"""Faces without area and vertices without faces are dropped; all else is unchanged."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.refused import refused
from wrt.accel.scenes.flatten import flatten
from wrt.io.mesh_file import load_mesh
from wrt.lab.hard_cases.common import sphere
from wrt.scene.clean import clean, flip_collinear, has_area
from wrt.scene.mesh import Mesh
from wrt.scene.model import Object, Scene

SQUARE = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], np.float32)


def test_sound_mesh_is_unchanged():
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    result = clean(SQUARE, faces, normals=SQUARE, uvs=SQUARE[:, :2], face_group=np.array([4, 5]))
    assert result.dropped == 0
    assert np.array_equal(result.vertices, SQUARE) and np.array_equal(result.faces, faces)
    assert np.array_equal(result.normals, SQUARE) and np.array_equal(result.face_group, [4, 5])


@pytest.mark.parametrize("scale", [1e-38, 1e-20, 1.0, 1e18])
def test_area_neither_underflows_nor_overflows(scale):
    assert clean(SQUARE * np.float32(scale), [[0, 1, 2]]).dropped == 0
    assert clean(SQUARE * np.float32(scale), [[0, 1, 1], [2, 2, 2], [0, 3, 0]]).dropped == 3


def test_faces_that_are_kept_keep_their_corners_and_attributes():
    rng = np.random.default_rng(3)
    vertices = rng.normal(size=(60, 3)).astype(np.float32)
    normals, uvs = rng.normal(size=(60, 3)).astype(np.float32), rng.normal(size=(60, 2)).astype(np.float32)
    faces = rng.integers(0, 40, size=(50, 3))
    group = np.arange(50)
    result = clean(vertices, faces, normals, uvs, group)
    kept = faces[result.face_group]  # the group is the index of the face
    degenerate = (faces[:, 0] == faces[:, 1]) | (faces[:, 1] == faces[:, 2]) | (faces[:, 2] == faces[:, 0])
    assert result.dropped == degenerate.sum() > 0
    for before, after in ((vertices, result.vertices), (normals, result.normals), (uvs, result.uvs)):
        assert np.array_equal(before[kept], after[result.faces])
    assert np.array_equal(np.unique(result.faces), np.arange(len(result.vertices)))


@settings(max_examples=200, deadline=None)
@given(st.lists(st.integers(-1000, 1000), min_size=9, max_size=9), st.sampled_from([1.0, 0.1, 3e-9, 7e11]))
def test_agrees_with_exact_arithmetic(numbers, scale):
    corners = (np.array(numbers, np.float64).reshape(3, 3) * scale).astype(np.float32)
    a, b, c = ([Fraction(float(x)) for x in corner] for corner in corners)
    e, f = [q - p for p, q in zip(a, b, strict=True)], [q - p for p, q in zip(a, c, strict=True)]
    has_area = any(e[i] * f[j] != e[j] * f[i] for i, j in ((0, 1), (1, 2), (2, 0)))
    assert clean(corners, [[0, 1, 2]]).dropped == (0 if has_area else 1)


@pytest.mark.parametrize("bad", [4, -1])
def test_index_out_of_range_is_named(bad):
    with refused("faces", f"[0, 2, {bad}]"):
        clean(SQUARE, [[0, 1, 2], [0, 2, bad]])


def on_a_line(vertices, faces):
    """Return the number of faces with three different corners on one line."""
    a, b, c = (vertices[faces[:, i]].astype(np.float64) for i in range(3))
    apart = (a != b).any(axis=1) & (b != c).any(axis=1) & (c != a).any(axis=1)
    return int((apart & ~np.cross(b - a, c - a).any(axis=1)).sum())


def volume(vertices, faces, center=0.0):
    a, b, c = (vertices[faces[:, i]].astype(np.float64) - center for i in range(3))
    return float((a * np.cross(b, c)).sum())


def area(vertices, faces):
    a, b, c = (vertices[faces[:, i]].astype(np.float64) for i in range(3))
    return 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)


def is_closed(faces):
    """Return True if each edge has a second face with the opposite winding."""
    edges = faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    unique = np.unique(edges, axis=0)
    return len(unique) == len(edges) and np.array_equal(unique, np.unique(edges[:, ::-1], axis=0))


def test_flips_remove_corners_on_a_line_and_nothing_else():
    center = np.array([148376.0, 1234.0, -223423.0])
    rough = sphere(300, 150, 2.0, tuple(center))
    faces, source = flip_collinear(rough.vertices, rough.faces)
    assert on_a_line(rough.vertices, rough.faces) > 500 and on_a_line(rough.vertices, faces) == 0
    assert len(faces) == len(rough.faces) and is_closed(faces) and faces.dtype == np.int32
    assert volume(rough.vertices, faces, center) == pytest.approx(volume(rough.vertices, rough.faces, center), rel=1e-12)
    # Each face with area is the sum of the faces with its index as their source.
    changed = (faces != rough.faces).any(axis=1)
    assert (source[~changed] == np.flatnonzero(~changed)).all() and 500 < changed.sum() < 10_000
    before, after = (area(rough.vertices, f) for f in (rough.faces, faces))
    np.testing.assert_allclose(np.bincount(source, after, len(faces)), before, rtol=1e-9, atol=1e-16)


def test_a_mesh_knows_whether_it_is_clean(tmp_path):
    """A loaded mesh is clean; a scene flips the faces of any other mesh."""
    vertices = np.array([[0, 0, 0], [1, 0, 0], [2, 0, 0], [1, 1, 0], [1, -1, 0]], np.float32)
    rough = Mesh(vertices, np.array([[0, 1, 2], [0, 2, 3], [0, 4, 1], [1, 4, 2]]))
    path = tmp_path / "rough.obj"
    path.write_text("".join(f"v {x} {y} {z}\n" for x, y, z in vertices) + "".join("f {} {} {}\n".format(*face) for face in rough.faces + 1))
    loaded = load_mesh(path)
    rough.save(tmp_path / "rough.npz")
    assert [each.is_clean for each in (rough, loaded, load_mesh(tmp_path / "rough.npz"))] == [False, True, False]
    assert has_area(loaded.vertices, loaded.faces).all() and not has_area(rough.vertices, rough.faces).all()
    for mesh in (rough, loaded):
        flat = flatten(Scene(objects=(Object(mesh),)))
        np.testing.assert_array_equal(flat.faces, flip_collinear(mesh.vertices, mesh.faces)[0])
        assert has_area(flat.vertices, flat.faces).all() and not np.shares_memory(flat.faces, mesh.faces)


@pytest.mark.parametrize("is_loaded", [False, True])
def test_faces_are_flipped_after_the_caller_has_written_to_the_arrays(is_loaded, tmp_path):
    mesh = Mesh(np.array([[0, 0, 0], [2, 0, 0], [1, 1, 0], [1, -1, 0]], np.float32), np.array([[0, 1, 2], [1, 0, 3]]))
    if is_loaded:
        path = tmp_path / "mesh.obj"
        path.write_text("".join("v {} {} {}\n".format(*row) for row in mesh.vertices) + "f 1 2 3\nf 2 1 4\n")
        mesh = load_mesh(path)
    scene = Scene(objects=(Object(mesh),))
    np.testing.assert_array_equal(flatten(scene).faces, mesh.faces)
    mesh.vertices[2, 1] = 0.0  # onto the edge between both faces
    flat = flatten(scene)
    np.testing.assert_array_equal(flat.faces, flip_collinear(mesh.vertices, mesh.faces)[0])
    assert has_area(flat.vertices, flat.faces).all()
    mesh.faces[:] = mesh.faces[:, ::-1]
    np.testing.assert_array_equal(flatten(scene).faces, flip_collinear(mesh.vertices, mesh.faces)[0])


def test_a_chain_of_faces_on_one_line_is_flipped_from_its_outer_end():
    # 0 to 4 on the x axis; below it a fan of flat faces that leads to one longest edge; 5 and 6 close it to the sides.
    vertices = np.array([[x, 0, 0] for x in range(5)] + [[2, 1, 0], [2, -1, 0]], np.float32)
    below = np.array([[6, 1, 0], [6, 2, 1], [6, 3, 2], [6, 4, 3]])
    flat = np.array([[0, 1, 2], [0, 2, 3], [0, 3, 4]])
    faces = np.concatenate([flat, below, [[0, 4, 5]]])
    flipped, source = flip_collinear(vertices, faces)
    assert on_a_line(vertices, flipped) == 0 and len(flipped) == len(faces)
    assert (source[:3] == 7).all() and np.array_equal(flipped[3:7], below)
    # Above the axis each stretch is an edge now, with face 5 on its other side.
    above = {tuple(sorted(face)) for face in flipped[[0, 1, 2, 7]].tolist()}
    assert above == {(0, 1, 5), (1, 2, 5), (2, 3, 5), (3, 4, 5)}
    normals = np.cross(*(vertices[flipped[:, i]] - vertices[flipped[:, 0]] for i in (1, 2)))
    assert (normals[:, 2] > 0.0).all()


def test_what_cannot_be_flipped_is_dropped():
    vertices = np.array([[0, 0, 0], [1, 0, 0], [2, 0, 0], [1, 1, 0], [1, 0, 1], [1, -1, 0]], np.float32)
    alone, closed = [[0, 1, 2]], [[0, 1, 2], [2, 0, 3]]
    assert clean(vertices, alone).dropped == 1
    assert clean(vertices, closed, face_group=np.array([7, 8])).face_group.tolist() == [8, 8]
    assert clean(vertices, closed + [[0, 2, 4]]).dropped == 1  # three faces at one edge: the neighbour is ambiguous
    assert clean(vertices, [[0, 1, 2], [0, 2, 1]]).dropped == 2  # two faces on one line: neither has an area
    assert clean(vertices, [[0, 1, 1], [1, 0, 3]]).dropped == 1  # an edge of length 0 splits no other edge


@settings(max_examples=60, deadline=None)
@given(st.lists(st.integers(0, 60), min_size=9, max_size=9), st.integers(0, 2**32 - 1))
def test_corners_of_very_different_size_are_decided_exactly(powers, seed):
    rng = np.random.default_rng(seed)
    step = rng.uniform(-4.0, 4.0, 3).astype(np.float32).astype(np.float64)
    line = (2.0 ** -np.array(powers[:3], np.float64)[:, None] * step).astype(np.float32)
    assert not has_area(line, np.array([[0, 1, 2]]))[0]
    assert has_area(np.array([[0, 0, 0], [1, 0, 0], [1, 1e-30, 0]], np.float32), np.array([[0, 1, 2], [2, 1, 0]])).all()
    bent = line.copy()
    bent[0, 1] = np.nextafter(bent[0, 1], np.float32(9.0))
    assert has_area(bent, np.array([[0, 1, 2]]))[0] == (len(np.unique(line[1:], axis=0)) == 2 and step[[0, 2]].any())
