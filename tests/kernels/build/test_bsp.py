"""The BSP builder's geometry against convex hulls and known areas: cells cut by planes, and triangles clipped to cells."""

from itertools import pairwise

import numpy as np
import pytest

from tests.kernel_tools import DEVICE, launch, unit  # isort: skip (starts Warp)
import warp as wp
from scipy.spatial import ConvexHull

from wrt.accel.cells.bsp import cells_of, pieces_of
from wrt.kernels.build.bsp import clip_piece
from wrt.kernels.build.bsp_cell import MAX_FACES, MAX_POINTS, Cells, box_cell, cell_area, clip_cell, split_areas
from wrt.kernels.build.bsp_split import BspSplit, Pieces, plane_through
from wrt.kernels.structs import kernel


@kernel
def cut_cell(cells: Cells, lo: wp.vec3d, hi: wp.vec3d, normal: wp.array(dtype=wp.vec3d), offset: wp.array(dtype=wp.float64),
             eps: wp.float64, areas: wp.array(dtype=wp.vec3d)):
    """Cut the box in slot 0 by one plane after another, and keep the part above. areas: predicted (below, above), then clipped."""
    box_cell(cells, 0, lo, hi)
    for i in range(normal.shape[0]):
        n = normal[i]
        d = offset[i]
        predicted = split_areas(cells, 0, n, d, eps)
        clip_cell(cells, 0, 1, -n, -d, eps)
        clip_cell(cells, 0, 2, n, d, eps)
        below = cell_area(cells, 1)
        areas[2 * i] = wp.vec3d(predicted[0], predicted[1], wp.float64(0.0))
        areas[2 * i + 1] = wp.vec3d(below, cell_area(cells, 2), wp.float64(0.0))
        clip_cell(cells, 2, 0, wp.vec3d(), wp.float64(1.0), eps)


def cut(lo, hi, normals, offsets, eps=1e-12):
    """Return predicted and clipped areas, (N, 2) each, and the cells: the rest in slot 0, the last cut's parts in slots 1 and 2."""
    n, cells = len(normals), cells_of(3)
    areas = wp.zeros(2 * n, dtype=wp.vec3d, device=DEVICE)
    launch(cut_cell, 1, cells, wp.vec3d(*lo), wp.vec3d(*hi), wp.array(normals, dtype=wp.vec3d, device=DEVICE),
           wp.array(offsets, dtype=wp.float64, device=DEVICE), wp.float64(eps), areas)
    out = areas.numpy()[:, :2]
    return out[0::2], out[1::2], cells


def faces_of(cells, slot):
    first = cells.first.numpy()[slot * (MAX_FACES + 1) :][: cells.n_faces.numpy()[slot] + 1]
    points = cells.points.numpy()[slot * MAX_POINTS :]
    return [points[a:b] for a, b in pairwise(first)]


def test_a_cube_by_planes_whose_cuts_are_known():
    # A plane across an axis; a plane across the diagonal, whose cut is a hexagon of side sqrt(1/2); a plane that cuts a corner off.
    normals = np.array([[1.0, 0.0, 0.0], unit(np.ones(3)), unit(np.ones(3))])
    offsets = [-0.25, -1.5 / np.sqrt(3.0), -0.5 / np.sqrt(3.0)]
    hexagon, triangle = 0.75 * np.sqrt(3.0), np.sqrt(3.0) / 8.0
    expected = [[3.0, 5.0], [3.0 + hexagon] * 2, [0.375 + triangle, 6.0 - 0.375 + triangle]]
    for n, d, areas in zip(normals, offsets, expected, strict=True):
        predicted, clipped, _ = cut(np.zeros(3), np.ones(3), [n], [d])
        np.testing.assert_allclose(predicted[0], areas, rtol=1e-12)
        np.testing.assert_allclose(clipped[0], areas, rtol=1e-12)


@pytest.mark.parametrize("seed", range(5))
def test_many_cuts_leave_a_convex_cell(seed):
    rng = np.random.default_rng(seed)
    lo, hi = -rng.uniform(0.5, 2.0, 3), rng.uniform(0.5, 2.0, 3)
    normals = unit(rng.normal(size=(20, 3)))
    offsets = rng.uniform(0.05, 0.8, 20)  # The origin stays above every plane.
    predicted, clipped, cells = cut(lo, hi, normals, offsets)
    np.testing.assert_allclose(predicted[:, 1], clipped[:, 1], rtol=1e-9)
    real = clipped[:, 0] > 0.0
    np.testing.assert_allclose(predicted[real, 0], clipped[real, 0], rtol=1e-9)
    assert (predicted[~real, 0] == 0.0).all()
    faces = faces_of(cells, 0)
    hull = ConvexHull(np.concatenate(faces))
    assert np.isclose(clipped[-1, 1], hull.area, rtol=1e-9)
    # The faces are closed and counterclockwise from outside: the cones from the origin to the faces fill the hull.
    volume = sum(np.dot(face[0], np.cross(face[k], face[k + 1])) for face in faces for k in range(1, len(face) - 1)) / 6.0
    assert np.isclose(volume, hull.volume, rtol=1e-9)
    assert all((face @ normals.T + offsets > -1e-12).all() for face in faces)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_plane_in_a_face_leaves_a_part_without_volume(sign):
    # A box of 1 x 2 x 3 and the plane of its high x face, exact or off by a rounding error.
    for noise in (0.0, 1e-15, -1e-15):
        predicted, clipped, _ = cut(np.zeros(3), np.array([1.0, 2.0, 3.0]), [[sign, 0.0, 0.0]], [-sign * (1.0 + noise)])
        whole, flat = 22.0, 12.0
        expected = [whole, flat] if sign > 0.0 else [flat, whole]
        np.testing.assert_allclose(predicted[0], expected, rtol=1e-12)
        np.testing.assert_allclose(clipped[0], expected, rtol=1e-12)


def test_a_cell_without_volume_is_cut():
    # A flat square is cut by its own plane, where both parts are the whole square, and by a plane across it.
    predicted, _, _ = cut(np.zeros(3), np.array([1.0, 1.0, 0.0]), [[0.0, 0.0, 1.0]], [0.0])
    np.testing.assert_allclose(predicted[0], [2.0, 2.0])
    predicted, clipped, _ = cut(np.zeros(3), np.array([1.0, 1.0, 0.0]), [[1.0, 0.0, 0.0]], [-0.25])
    np.testing.assert_allclose(predicted[0], [0.5, 1.5])
    np.testing.assert_allclose(clipped[0], [0.5, 1.5])


def test_a_cell_smaller_than_the_margin_gains_nothing():
    predicted, _, _ = cut(np.zeros(3), np.full(3, 1e-9), [[1.0, 0.0, 0.0]], [-0.5e-9], eps=1e-6)
    np.testing.assert_allclose(predicted[0], [6e-18, 6e-18])


@kernel
def clip(pieces: Pieces, normal: wp.array(dtype=wp.vec3d), point: wp.array(dtype=wp.vec3d), out: wp.array(dtype=wp.int32)):
    """Cut piece 3 i into the pieces 3 i + 1 (below the plane) and 3 i + 2 (above)."""
    i = wp.tid()
    split = plane_through(normal[i], point[i])
    size = clip_piece(pieces, 3 * i, 3 * i + 1, 100 * i + 20, split, 0)
    out[i] = clip_piece(pieces, 3 * i, 3 * i + 2, size, split, 1)


def polygon_area(points):
    return 0.5 * np.linalg.norm(np.cross(points[1:-1] - points[0], points[2:] - points[0]).sum(axis=0))


def test_clipped_triangles_keep_their_area():
    rng = np.random.default_rng(1)
    n = 200
    corners = rng.normal(size=(n, 3, 3))
    inside = np.einsum("ni,nij->nj", rng.dirichlet(np.ones(3), n), corners)
    pieces = pieces_of(3 * n, 100 * n)
    for name in ("prim_id", "first", "count", "lo", "hi", "ball", "extent", "points"):
        getattr(pieces, name).zero_()
    pieces.first.numpy()[::3], pieces.count.numpy()[::3] = 100 * np.arange(n), 3
    pieces.points.numpy().reshape(n, 100, 3)[:, :3] = corners
    end = wp.zeros(n, dtype=wp.int32, device=DEVICE)
    launch(clip, n, pieces, wp.array(rng.normal(size=(n, 3)), dtype=wp.vec3d, device=DEVICE),
           wp.array(inside, dtype=wp.vec3d, device=DEVICE), end)
    first, count, points = pieces.first.numpy(), pieces.count.numpy(), pieces.points.numpy()
    assert (count[1::3] >= 3).all() and (count[2::3] >= 3).all() and (count[1::3] + count[2::3] == end.numpy() % 100 - 20).all()
    for i in range(n):
        parts = [points[first[k] : first[k] + count[k]] for k in (3 * i + 1, 3 * i + 2)]
        assert np.isclose(sum(polygon_area(p) for p in parts), polygon_area(corners[i]), rtol=1e-9)
        for k, part in zip((3 * i + 1, 3 * i + 2), parts, strict=True):
            assert (pieces.lo.numpy()[k] == part.min(axis=0)).all() and (pieces.hi.numpy()[k] == part.max(axis=0)).all()
            ball = pieces.ball.numpy()[k]
            assert (np.linalg.norm(part - ball[:3], axis=1) <= ball[3]).all()


@kernel
def write_planes(normal: wp.array(dtype=wp.vec3d), point: wp.array(dtype=wp.vec3d), out: wp.array(dtype=wp.vec4d)):
    i = wp.tid()
    split = BspSplit()
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
