"""Parts of triangles in cells: clipped boxes contain the part, and are hardly larger; the overlap test agrees with clipping."""

import numpy as np
import pytest

from tests.kernel_tools import launch, rounded, unit, vec3s, zeros  # isort: skip (starts Warp)
import warp as wp

from wrt.accel.cells.common import shapes_of
from wrt.accel.geometry import Geometry
from wrt.kernels.build.clip import Shapes, clip_to_cell, meets_cell, triangle_cell
from wrt.kernels.structs import kernel

U = 2.0**-24


@kernel
def clip_all(shapes: Shapes, cell_lo: wp.vec3, cell_hi: wp.vec3, normal: wp.vec3d, offset: wp.float64, lo: wp.array(dtype=wp.vec3),
             hi: wp.array(dtype=wp.vec3)):
    i = wp.tid()
    box = clip_to_cell(shapes, i, cell_lo, cell_hi, normal, offset)
    lo[i] = box.lo
    hi[i] = box.hi


def geometry_of(corners, spheres=()):
    corners = np.asarray(corners, np.float32).reshape(-1, 3)
    faces = np.arange(len(corners), dtype=np.int32).reshape(-1, 3)
    return Geometry(corners, faces, np.asarray(spheres, np.float32).reshape(-1, 4))


def clip(corners, cell_lo, cell_hi, spheres=(), exact=True, plane=(0.0, 0.0, 0.0, 0.0)):
    """Return the box of the part of each triangle, or sphere, in its cell, and above a plane."""
    geometry = geometry_of(corners, spheres)
    n = len(geometry)
    lo, hi = zeros(n, wp.vec3), zeros(n, wp.vec3)
    launch(clip_all, n, shapes_of(geometry, geometry.bounds(), exact), wp.vec3(*cell_lo), wp.vec3(*cell_hi), wp.vec3d(*plane[:3]),
           wp.float64(plane[3]), lo, hi)
    return lo.numpy(), hi.numpy()


def polygon_in(triangle, lo, hi):
    """Return the corners of the part of a triangle in a box, clipped by one half-space after another in float64."""
    polygon = triangle.astype(np.float64)
    for axis in range(3):
        for sign, bound in ((1.0, lo[axis]), (-1.0, hi[axis])):
            polygon = polygon_above(polygon, sign * np.eye(3)[axis], -sign * bound)
    return polygon


def polygon_above(polygon, normal, offset):
    """Return the corners of the part of a polygon where dot(normal, p) + offset >= 0."""
    out = []
    for p, q in zip(np.roll(polygon, 1, axis=0), polygon, strict=True):
        a, b = p @ normal + offset, q @ normal + offset
        if a * b < 0.0:
            out.append((p * b - q * a) / (b - a))
        if b >= 0.0:
            out.append(q)
    return np.array(out).reshape(-1, 3)


def test_the_box_above_a_plane_holds_what_is_there_and_little_more():
    rng = np.random.default_rng(2)
    triangles = rounded(rng.normal(size=(200, 3, 3)))
    cut = 0
    for normal, offset in zip(unit(rng.normal(size=(5, 3))), rng.uniform(-1.0, 1.0, 5), strict=True):
        lo, hi = clip(triangles, [-9.0] * 3, [9.0] * 3, plane=[*normal, offset])
        for i, triangle in enumerate(triangles):
            inside = polygon_above(triangle, normal, offset)
            near = polygon_above(triangle, normal, offset + 1e-5)
            if len(inside):
                assert (lo[i] <= inside.min(axis=0)).all() and (hi[i] >= inside.max(axis=0)).all()
                cut += len(inside) > 3
            if lo[i][0] < hi[i][0]:
                assert (lo[i] >= near.min(axis=0) - 1e-4).all() and (hi[i] <= near.max(axis=0) + 1e-4).all()
    assert cut > 100


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


# --- the overlap test -------------------------------------------------------------------------------------------------


@kernel
def meets(shapes: Shapes, cell_lo: wp.array(dtype=wp.vec3), cell_hi: wp.array(dtype=wp.vec3), out: wp.array(dtype=wp.int32)):
    i = wp.tid()
    out[i] = wp.where(meets_cell(triangle_cell(shapes, i), cell_lo[i], cell_hi[i]), 1, 0)


def met(geometry, cell_lo, cell_hi):
    out = zeros(len(geometry), wp.int32)
    launch(meets, len(geometry), shapes_of(geometry, geometry.bounds()), vec3s(cell_lo), vec3s(cell_hi), out)
    return out.numpy() == 1


CASES = {
    "random": lambda rng, n: rng.uniform(-1.0, 1.0, (n, 3, 3)),
    "small": lambda rng, n: rng.uniform(-1.0, 1.0, (n, 1, 3)) + 0.1 * rng.normal(size=(n, 3, 3)),
    "long": lambda rng, n: rng.normal(size=(n, 3, 3)) * [100.0, 1.0, 1e-3],
    "in_a_plane": lambda rng, n: np.round(8.0 * rng.uniform(-1.0, 1.0, (n, 3, 3))) / 8.0,
    "slivers": lambda rng, n: rng.normal(size=(n, 1, 3)) * rng.uniform(-1, 1, (n, 3, 1)) + 1e-6 * rng.normal(size=(n, 3, 3)),
    "far": lambda rng, n: 500.0 + rng.uniform(-1.0, 1.0, (n, 3, 3)),
}


@pytest.mark.parametrize("case", CASES)
def test_meets_exactly_the_cells_that_clipping_leaves_something_in(case):
    rng = np.random.default_rng(1)
    n = 3000
    corners = CASES[case](rng, n).astype(np.float32)
    geometry = geometry_of(corners)
    lo, hi = geometry.bounds()
    # Cells in and beside the triangle's box; many share a face with it.
    extent = (hi - lo).astype(np.float64)
    cell_lo = (lo + rng.choice([0.0, 0.25, 0.5, 0.75], (n, 3)) * extent).astype(np.float32)
    cell_hi = np.minimum(cell_lo + extent * rng.uniform(0.02, 0.6, (n, 3)), hi).astype(np.float32)
    found = met(geometry, cell_lo, cell_hi)
    inside = np.array([len(polygon_in(corners[i], cell_lo[i], cell_hi[i])) > 0 for i in range(n)])
    # The test pads the triangle. So a cell that is larger by the padding on all sides contains a part of the triangle.
    reach = 1.000001 * np.maximum(corners.min(axis=1) - lo.astype(np.float64), hi.astype(np.float64) - corners.max(axis=1))
    near = np.array([len(polygon_in(corners[i], cell_lo[i] - reach[i], cell_hi[i] + reach[i])) > 0 for i in range(n)])
    assert found[inside].all()
    assert not found[~near].any()
    assert found.sum() > 200 and (~found).sum() > 200


def test_a_cell_without_end_is_met():
    geometry = geometry_of([[0, 0, 0], [1, 0, 0], [0, 1, 0]] * 2)
    cell_lo, cell_hi = np.array([[-np.inf, 0.0, 0.0], [-np.inf] * 3]), np.array([[np.inf, 1.0, 1.0], [np.inf] * 3])
    assert met(geometry, cell_lo, cell_hi).all()
