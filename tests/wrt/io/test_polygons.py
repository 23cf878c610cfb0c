from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from wrt.io.mesh_file import triangulate


def area_vectors(points: np.ndarray) -> np.ndarray:
    return 0.5 * np.cross(points[:, 1] - points[:, 0], points[:, 2] - points[:, 0])


def polygon_area(outline: np.ndarray) -> np.ndarray:
    return 0.5 * np.cross(outline, np.roll(outline, -1, axis=0)).sum(axis=0)


@settings(max_examples=60, deadline=None)
@given(st.lists(st.floats(0.2, 1.0), min_size=3, max_size=14), st.integers(0, 2), st.booleans())
def test_simple_polygons_are_covered_once(radii: list[float], axis: int, flip: bool) -> None:
    # A star-shaped outline is simple and often concave: triangles that all face its way and sum up to its area cover it
    # exactly once.
    angle = np.linspace(0.0, 2.0 * np.pi, len(radii), endpoint=False)
    flat = np.stack([radii * np.cos(angle), radii * np.sin(angle), np.full(len(radii), 0.3)], axis=1)
    outline = np.roll(flat[::-1] if flip else flat, axis, axis=1)
    triangles, polygon = triangulate(np.arange(len(radii)), np.array([len(radii)]), outline)
    assert triangles.shape == (len(radii) - 2, 3) and (polygon == 0).all()
    total = polygon_area(outline)
    each = area_vectors(outline[triangles]) @ (total / np.linalg.norm(total))
    assert (each > -1e-12).all()
    np.testing.assert_allclose(each.sum(), np.linalg.norm(total), rtol=1e-9)


def test_a_comb_is_covered_once() -> None:
    teeth = 40
    x = np.arange(2 * teeth)
    top = np.stack([x, np.where(x % 2 == 0, 1.0, 0.05)], axis=1)
    flat = np.concatenate([[[0.0, 0.0], [2 * teeth - 1, 0.0]], top[::-1]])
    outline = np.column_stack([flat, np.zeros(len(flat))])
    triangles, _ = triangulate(np.arange(len(flat)), np.array([len(flat)]), outline)
    each = area_vectors(outline[triangles])[:, 2]
    assert (each >= 0.0).all()
    np.testing.assert_allclose(each.sum(), polygon_area(outline)[2])


def test_order_winding_and_short_polygons() -> None:
    vertices = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [2, 0, 0], [2, 1, 0]], dtype=float)
    corners = np.array([0, 1, 2, 3, 1, 4, 1, 4, 5, 2, 0, 1, 2])
    triangles, polygon = triangulate(corners, np.array([4, 2, 4, 3]), vertices)
    assert polygon.tolist() == [0, 0, 2, 2, 3]
    assert corners[triangles].tolist() == [[0, 1, 2], [0, 2, 3], [1, 4, 5], [1, 5, 2], [0, 1, 2]]
    assert (area_vectors(vertices[corners[triangles]])[:, 2] > 0.0).all()


def test_broken_polygons_end() -> None:
    points = np.array([[0, 0, 0], [1, 1, 0], [1, 0, 0], [0, 1, 0], [np.nan, 0, 0]])
    for corners in ([0, 1, 2, 3], [0, 0, 0, 0, 0], [0, 1, 4, 2, 3]):
        triangles, _ = triangulate(np.array(corners), np.array([len(corners)]), points)
        assert triangles.shape == (len(corners) - 2, 3)
    assert triangulate(np.zeros(0, int), np.zeros(0, int), points)[0].shape == (0, 3)


def test_a_polygon_of_many_corners() -> None:
    """A convex polygon becomes a fan, whatever its size; a concave polygon is covered once."""
    angle = np.linspace(0.0, 2.0 * np.pi, 1_000_000, endpoint=False)
    circle = np.stack([np.cos(angle), np.sin(angle), 0.0 * angle], axis=1)
    assert len(triangulate(np.arange(len(circle)), np.array([len(circle)]), circle)[0]) == len(circle) - 2
    n = 8000
    star = circle[:: len(circle) // n] * np.where(np.arange(n) % 2, 1.0, 0.5)[:, None]
    each = area_vectors(star[triangulate(np.arange(n), np.array([n]), star)[0]])[:, 2]
    assert len(each) == n - 2 and (each > 0.0).all()
    np.testing.assert_allclose(each.sum(), polygon_area(star)[2])


def test_corners_on_straight_edges_are_covered_once() -> None:
    for turn in (0.0, 0.7):
        flat = np.array([[0, 0], [1, 0], [2, 0], [3, 0], [3, 1], [3, 2], [2, 2], [2, 1], [1, 1], [1, 2], [1, 3], [0, 3],
                         [0, 2], [0, 1]])
        outline = np.column_stack([flat @ [[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]], np.ones(len(flat))])
        each = area_vectors(outline[triangulate(np.arange(len(flat)), np.array([len(flat)]), outline)[0]])[:, 2]
        assert (each > -1e-12).all()
        np.testing.assert_allclose(each.sum(), 6.0)
