"""Faces without area and vertices without faces leave; everything else stays as it was."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from wrt.errors import InputError
from wrt.mesh_clean import clean

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
    kept = faces[result.face_group]  # the group numbers the faces
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


def test_not_finite_corners_are_left_for_the_mesh_to_report():
    vertices = SQUARE.copy()
    vertices[1, 0] = np.nan
    vertices[2, 1] = np.inf
    assert clean(vertices, [[0, 1, 3], [0, 2, 2]]).dropped == 0


@pytest.mark.parametrize("bad", [4, -1])
def test_index_out_of_range_is_named(bad):
    with pytest.raises(InputError, match=rf"face 1 is \[0, 2, {bad}\], but there are 4 vertices"):
        clean(SQUARE, [[0, 1, 2], [0, 2, bad]])


def test_empty_mesh_stays_empty():
    result = clean(np.zeros((0, 3)), np.zeros((0, 3), np.int32))
    assert result.faces.shape == (0, 3) and result.vertices.shape == (0, 3) and result.dropped == 0
