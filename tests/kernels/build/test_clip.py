"""Clipping for builders: the clipped box contains the part of the triangle in the cell, and is hardly larger."""

import numpy as np
import pytest

from tests.kernel_tools import ints, launch, rounded, zeros  # isort: skip (starts Warp)
import warp as wp

from wrt.accel.cells.kdtree_build import clippable
from wrt.accel.geometry import Geometry
from wrt.kernels.build.clip import clip_references

U = 2.0**-24


def clip(corners, cell_lo, cell_hi, spheres=(), exact=True):
    """Return the box of the part of each triangle, or sphere, in its cell."""
    corners = np.asarray(corners, np.float32).reshape(-1, 3, 3)
    faces = np.arange(3 * len(corners), dtype=np.int32).reshape(-1, 3)
    geometry = Geometry(corners.reshape(-1, 3), faces, np.asarray(spheres, np.float32).reshape(-1, 4))
    shapes, _ = clippable(geometry, *geometry.bounds(), exact)
    n = len(geometry)
    lo, hi = zeros(n, wp.vec3), zeros(n, wp.vec3)
    launch(clip_references, n, shapes, ints(np.arange(n)), wp.vec3(*cell_lo), wp.vec3(*cell_hi), lo, hi)
    return lo.numpy(), hi.numpy()


def polygon_in(triangle, lo, hi):
    """Return the corners of the part of a triangle in a box, clipped by one half-space after another in float64."""
    polygon = triangle.astype(np.float64)
    for axis in range(3):
        for sign, bound in ((1.0, lo[axis]), (-1.0, hi[axis])):
            out = []
            for p, q in zip(np.roll(polygon, 1, axis=0), polygon, strict=True):
                a, b = sign * (p[axis] - bound), sign * (q[axis] - bound)
                if a * b < 0.0:
                    out.append((p * b - q * a) / (b - a))
                if b >= 0.0:
                    out.append(q)
            polygon = np.array(out).reshape(-1, 3)
    return polygon


@pytest.mark.parametrize("scale, move", [(1.0, 0.0), (1e-12, 0.0), (1e12, 0.0), (1.0, 300.0)])
def test_the_box_holds_what_is_in_the_cell_and_little_more(scale, move):
    rng = np.random.default_rng(1)
    triangles = rounded(scale * (rng.uniform(-1.0, 1.0, (400, 1, 3)) + rng.normal(size=(400, 3, 3))) + move)
    triangles[::9, :, 1] = triangles[::9, :1, 1]  # In planes perpendicular to an axis.
    triangles[::11, 2] = triangles[::11, 1]  # Without area.
    cut = 0
    for _ in range(6):
        ends = np.sort(rounded(scale * rng.uniform(-1.5, 1.5, (2, 3)) + move), axis=0)
        lo, hi = clip(triangles, *ends)
        for i, triangle in enumerate(triangles):
            inside = polygon_in(triangle, *ends)
            pad = 64.0 * U * np.ptp(triangle, axis=0).max() + 8.0 * U * np.abs(triangle).max()
            near = polygon_in(triangle, ends[0] - pad, ends[1] + pad)
            if len(inside):
                low, high = inside.min(axis=0), inside.max(axis=0)
                assert (lo[i] <= np.maximum(low, ends[0])).all() and (hi[i] >= np.minimum(high, ends[1])).all()
                cut += len(inside) > 3
            if lo[i][0] < hi[i][0]:
                assert (lo[i] >= ends[0]).all() and (hi[i] <= ends[1]).all() and (lo[i] < hi[i]).all()
                assert len(near) and (lo[i] >= near.min(axis=0) - 2.0 * pad).all() and (hi[i] <= near.max(axis=0) + 2.0 * pad).all()
            else:
                assert np.isposinf(lo[i]).all() and np.isneginf(hi[i]).all()
    assert cut > 200


def test_a_triangle_in_the_wall_between_two_cells_is_in_both():
    # If only one cell listed it, rays that rounding moves to the other cell would miss it.
    wall = [[0.0, -1.0, -1.0], [0.0, 1.0, -1.0], [0.0, 0.0, 1.0]]
    for cell_lo, cell_hi in (([-1, -2, -2], [0, 2, 2]), ([0, -2, -2], [1, 2, 2])):
        lo, hi = clip(wall, cell_lo, cell_hi)
        assert lo[0][0] < hi[0][0] and hi[0][0] - lo[0][0] < 1e-5


def test_a_diagonal_triangle_is_not_in_the_corner_that_only_its_box_reaches():
    diagonal = [[0.0, 0.0, 0.0], [4.0, 4.0, 0.0], [4.0, 4.0, 1.0]]
    corner = [3.0, 0.0, 0.0], [4.0, 1.0, 1.0]
    assert not clip(diagonal, *corner)[0][0][0] < np.inf
    for box_only in (clip(diagonal, *corner, exact=False), clip([], *corner, spheres=[[2.0, 2.0, 0.5, 2.0]])):
        np.testing.assert_array_equal(np.stack(box_only)[:, 0], corner)
