"""The overlap test of triangle and cell, compared with clipping the triangle to the cell in float64."""

import numpy as np
import pytest

from tests.kernel_tools import launch, vec3s, zeros  # isort: skip
import warp as wp

from wrt.accel.geometry import Geometry
from wrt.kernels.build.triangle_cell import meets_cell, triangle_cell
from wrt.kernels.structs import kernel


@kernel
def meets(corners: wp.array(dtype=wp.vec3), lo: wp.array(dtype=wp.vec3), hi: wp.array(dtype=wp.vec3),
          cell_lo: wp.array(dtype=wp.vec3), cell_hi: wp.array(dtype=wp.vec3), out: wp.array(dtype=wp.int32)):
    i = wp.tid()
    triangle = triangle_cell(corners[3 * i], corners[3 * i + 1], corners[3 * i + 2], lo[i], hi[i])
    out[i] = wp.where(meets_cell(triangle, cell_lo[i], cell_hi[i]), 1, 0)


def clipped(polygon, lo, hi):
    """Return the part of a polygon in a closed box (Sutherland and Hodgman)."""
    for axis in range(3):
        for sign, bound in ((1.0, hi[axis]), (-1.0, -lo[axis])):
            out = []
            for k in range(len(polygon)):
                p, q = polygon[k - 1], polygon[k]
                d_p, d_q = bound - sign * p[axis], bound - sign * q[axis]
                if (d_p < 0.0) != (d_q < 0.0):
                    out.append(p + d_p / (d_p - d_q) * (q - p))
                if d_q >= 0.0:
                    out.append(q)
            polygon = out
    return polygon


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
    geometry = Geometry(corners.reshape(-1, 3), np.arange(3 * n, dtype=np.int32).reshape(-1, 3), np.zeros((0, 4), np.float32))
    lo, hi = geometry.bounds()
    # Cells in and beside the triangle's box; many share a face with it.
    extent = (hi - lo).astype(np.float64)
    size = extent * rng.uniform(0.02, 0.6, (n, 3))
    cell_lo = (lo + rng.choice([0.0, 0.25, 0.5, 0.75], (n, 3)) * extent).astype(np.float32)
    cell_hi = np.minimum(cell_lo + size, hi).astype(np.float32)
    out = zeros(n, wp.int32)
    launch(meets, n, vec3s(corners), vec3s(lo), vec3s(hi), vec3s(cell_lo), vec3s(cell_hi), out)
    found = out.numpy() == 1

    pad = np.maximum(corners.min(axis=1) - lo.astype(np.float64), hi.astype(np.float64) - corners.max(axis=1))
    triangle = [list(c) for c in corners.astype(np.float64)]
    inside = np.array([len(clipped(triangle[i], cell_lo[i], cell_hi[i])) > 0 for i in range(n)])
    # The test pads the triangle. So a cell that is larger by the padding on all sides contains a part of the triangle.
    reach = 1.000001 * pad
    near = np.array([len(clipped(triangle[i], cell_lo[i] - reach[i], cell_hi[i] + reach[i])) > 0 for i in range(n)])
    assert found[inside].all()
    assert not found[~near].any()
    assert found.sum() > 200 and (~found).sum() > 200


def test_a_cell_without_end_is_met():
    corners = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 0], [1, 0, 0], [0, 1, 0]], np.float32)
    lo, hi = np.zeros((2, 3)), np.ones((2, 3))
    cell_lo, cell_hi = np.array([[-np.inf, 0.0, 0.0], [-np.inf] * 3]), np.array([[np.inf, 1.0, 1.0], [np.inf] * 3])
    out = zeros(2, wp.int32)
    launch(meets, 2, vec3s(corners), vec3s(lo), vec3s(hi), vec3s(cell_lo), vec3s(cell_hi), out)
    assert out.numpy().tolist() == [1, 1]
