"""Weights and planes of the BSP tree's builder: surface areas of parts of a box against known areas and convex hulls."""

from itertools import product

import numpy as np
import pytest

from tests.kernel_tools import DEVICE, launch, unit  # isort: skip (starts Warp)
import warp as wp
from scipy.spatial import ConvexHull

from wrt.kernels.build.cell_splits import plane_through
from wrt.kernels.build.clip import areas_of_parts
from wrt.kernels.structs import kernel


@kernel
def measure(lo: wp.vec3, hi: wp.vec3, planes: wp.array(dtype=wp.vec4d), out: wp.array(dtype=wp.vec2d)):
    i = wp.tid()
    plane = planes[i]
    out[i] = areas_of_parts(wp.vec3d(lo), wp.vec3d(hi), wp.vec3d(plane[0], plane[1], plane[2]), plane[3])


def areas(lo, hi, planes):
    """Return the surface areas (below, above) of the parts of a box on both sides of planes (normal, offset), (N, 2)."""
    out = wp.zeros(len(planes), dtype=wp.vec2d, device=DEVICE)
    launch(measure, len(planes), wp.vec3(*lo), wp.vec3(*hi), wp.array(np.asarray(planes, np.float64), dtype=wp.vec4d, device=DEVICE), out)
    e = np.asarray(hi, np.float64) - lo
    return out.numpy() * 2.0 * (e[0] * e[1] + e[1] * e[2] + e[2] * e[0])


def test_a_cube_by_planes_whose_cuts_are_known():
    # A plane across an axis; a plane across the diagonal, whose cut is a hexagon of side sqrt(1/2); a plane that cuts a corner off.
    root = 1.0 / np.sqrt(3.0)
    planes = [[1.0, 0.0, 0.0, -0.25], [root, root, root, -1.5 * root], [root, root, root, -0.5 * root], [-1.0, 0.0, 0.0, 0.25]]
    hexagon, triangle = 0.75 * np.sqrt(3.0), np.sqrt(3.0) / 8.0
    expected = [[3.0, 5.0], [3.0 + hexagon] * 2, [0.375 + triangle, 6.0 - 0.375 + triangle], [5.0, 3.0]]
    np.testing.assert_allclose(areas(np.zeros(3), np.ones(3), planes), expected, rtol=1e-12)
    assert (areas(np.zeros(3), np.ones(3), [[1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 1.0, -1.5]]) == 0.0).all()  # they miss the inside


@pytest.mark.parametrize("seed", range(3))
def test_parts_of_boxes_have_the_areas_of_their_hulls(seed):
    rng = np.random.default_rng(seed)
    lo = np.float32(-rng.uniform(0.2, 2.0, 3))
    hi = np.float32(rng.uniform(0.2, 2.0, 3))
    planes = np.concatenate([unit(rng.normal(size=(50, 3)) * 10.0 ** rng.uniform(-6, 0, (50, 3))), rng.uniform(-0.2, 0.2, (50, 1))], axis=1)
    corners = np.array(list(product(*zip(lo.astype(np.float64), hi, strict=True))))
    edges = [(a, b) for a in corners for b in corners if ((a != b).sum() == 1)]
    for found, (*normal, offset) in zip(areas(lo, hi, planes), planes, strict=True):
        cut = [a + (a @ normal + offset) / ((a - b) @ normal) * (b - a) for a, b in edges
               if (a @ normal + offset < 0.0) != (b @ normal + offset < 0.0)]
        for side, sign in zip(found, (-1.0, 1.0), strict=True):
            part = np.concatenate([corners[sign * (corners @ normal + offset) >= 0.0], cut])
            assert np.isclose(side, ConvexHull(part).area, rtol=1e-6)


@kernel
def write_planes(normal: wp.array(dtype=wp.vec3d), point: wp.array(dtype=wp.vec3d), out: wp.array(dtype=wp.vec4d)):
    i = wp.tid()
    split = plane_through(normal[i], point[i])
    out[i] = wp.vec4d(split.normal[0], split.normal[1], split.normal[2], split.offset)


def test_planes_are_what_float32_holds():
    rng = np.random.default_rng(2)
    normal, point = rng.normal(size=(100, 3)) * 10.0 ** rng.uniform(-20, 20, (100, 1)), rng.normal(size=(100, 3))
    out = wp.zeros(100, dtype=wp.vec4d, device=DEVICE)
    launch(write_planes, 100, wp.array(normal, dtype=wp.vec3d, device=DEVICE), wp.array(point, dtype=wp.vec3d, device=DEVICE), out)
    plane = out.numpy()
    assert (plane == plane.astype(np.float32)).all()
    np.testing.assert_allclose(plane[:, :3], unit(normal), atol=1e-7)
    assert np.abs((plane[:, :3] * point).sum(axis=1) + plane[:, 3]).max() < 3e-7
