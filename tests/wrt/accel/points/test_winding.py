"""Winding numbers of meshes around points."""

from __future__ import annotations

import numpy as np
import pytest

import wrt
from tests.refused import refused
from wrt.scene import shapes


def solid_angles(mesh: wrt.Mesh, points: np.ndarray) -> np.ndarray:
    """Return the sum of solid angles over 4 pi, with one arctangent per triangle."""
    a, b, c = (mesh.vertices[mesh.faces[:, i]].astype(np.float64)[None] - points.astype(np.float32).astype(np.float64)[:, None]
               for i in range(3))
    la, lb, lc = (np.linalg.norm(x, axis=2) for x in (a, b, c))
    below = la * lb * lc + (a * b).sum(2) * lc + (b * c).sum(2) * la + (c * a).sum(2) * lb
    return np.arctan2((a * np.cross(b, c)).sum(2), below).sum(axis=1) / (2.0 * np.pi)


@pytest.mark.parametrize("mesh", [shapes.icosphere(3), shapes.torus(1.0, 0.4, 64, 32), shapes.quad(),
                                  shapes.merged([shapes.icosphere(2), shapes.icosphere(2, 0.5)], "twice")],
                         ids=lambda mesh: mesh.name)
def test_it_is_the_sum_of_the_solid_angles(mesh: wrt.Mesh) -> None:
    points = np.random.default_rng(0).uniform(-1.5, 1.5, (500, 3))
    found = wrt.winding_number(wrt.build(mesh), points, threads=2, exact=True)
    np.testing.assert_allclose(found, solid_angles(mesh, points), rtol=0.0, atol=1e-12)


def test_of_a_closed_mesh_it_is_a_whole_number_and_tells_what_is_inside() -> None:
    accel = wrt.build(shapes.torus(1.0, 0.4, 64, 32))
    points = np.random.default_rng(1).uniform(-1.5, 1.5, (2000, 3))
    found = wrt.winding_number(accel, points, exact=True)
    np.testing.assert_allclose(found, np.round(found), atol=1e-9)
    assert np.array_equal(found > 0.5, wrt.contains(accel, points)) and 0.05 < (found > 0.5).mean() < 0.5


ERROR = 2e-3  # of the tree: twice the largest that was measured


def soup(n: int, size: float, seed: int) -> wrt.Mesh:
    """Make n loose triangles of that size in a cube."""
    rng = np.random.default_rng(seed)
    corners = rng.uniform(-1.0, 1.0, (n, 1, 3)) + size * rng.normal(size=(n, 3, 3))
    return wrt.Mesh(np.float32(corners.reshape(-1, 3)), np.arange(3 * n).reshape(-1, 3))


@pytest.mark.parametrize("mesh", [soup(n, size, n) for n in (0, 1, 2, 8, 9, 17, 2000) for size in (0.02, 1.0)]
                         + [shapes.torus(1.0, 0.4, 64, 32), shapes.merged([shapes.icosphere(4), shapes.icosphere(4, 0.5)], "twice")],
                         ids=lambda mesh: f"{len(mesh.faces)} faces")
def test_the_tree_is_near_the_exact_sum_anywhere_and_at_any_scale(mesh: wrt.Mesh) -> None:
    rng = np.random.default_rng(0)
    points = np.concatenate([rng.uniform(-2.0, 2.0, (500, 3)), 100.0 * rng.normal(size=(100, 3))])
    if len(mesh.faces):
        chosen = mesh.vertices[mesh.faces[rng.integers(len(mesh.faces), size=400)]]
        points = np.concatenate([points, chosen.mean(axis=1) + 1e-3 * rng.normal(size=(400, 3)), chosen[:, 0]])
    expected = wrt.winding_number(wrt.build(mesh), points, exact=True)
    for scale in (1.0, 2.0**-90, 2.0**90):
        found = wrt.winding_number(wrt.build(wrt.Mesh(np.float32(scale) * mesh.vertices, mesh.faces)), scale * points, threads=2)
        np.testing.assert_allclose(found, expected, rtol=0.0, atol=ERROR)


def test_the_tree_does_not_depend_on_threads_and_follows_refits() -> None:
    mesh = shapes.icosphere(4)
    accel, points = wrt.build(mesh), np.random.default_rng(2).uniform(-1.2, 1.2, (1000, 3))
    found = wrt.winding_number(accel, points, threads=1)
    assert np.array_equal(found, wrt.winding_number(accel, points, threads=2))
    accel.refit(0.5 * mesh.vertices)
    np.testing.assert_array_equal(wrt.winding_number(accel, 0.5 * points.astype(np.float32)), found)


def test_distances_to_open_meshes_have_the_sign_of_the_winding_number() -> None:
    ball = shapes.icosphere(4)
    bowl = wrt.build((ball.vertices, ball.faces[ball.vertices[ball.faces].mean(axis=1)[:, 2] < 0.9]))
    points = np.random.default_rng(3).uniform(-1.2, 1.2, (1000, 3))
    signed = wrt.signed_distance(bowl, points, sign="winding")
    assert np.array_equal(np.abs(signed), wrt.closest_points(bowl, points).distance)
    sure = np.abs(np.linalg.norm(points, axis=1) - 1.0) > 0.05
    sure &= points[:, 2] < 0.7
    assert np.array_equal(signed[sure] < 0.0, np.linalg.norm(points, axis=1)[sure] < 1.0)
    with refused(None, "not closed"):
        wrt.signed_distance(bowl, points)
    with refused("sign", hint="crossings"):
        wrt.signed_distance(bowl, points, sign="winged")


def test_parts_add_up_and_turning_faces_around_turns_the_sign() -> None:
    ball = shapes.icosphere(2)
    points = [[0.0, 0.1, 0.2], [3.0, 0.0, 0.0]]
    many = wrt.build(shapes.merged([shapes.icosphere(2, 1.0 + 0.1 * i) for i in range(9)], "many"))
    assert np.round(wrt.winding_number(many, points, exact=True), 9).tolist() == [9.0, 0.0]
    inside_out = wrt.build(wrt.Mesh(ball.vertices, ball.faces[:, ::-1]))
    assert np.round(wrt.winding_number(inside_out, points, exact=True), 9).tolist() == [-1.0, 0.0]


def test_an_open_mesh_is_told_by_half() -> None:
    square = wrt.build(shapes.quad((-1.0, -1.0, 0.0), (2.0, 0.0, 0.0), (0.0, 2.0, 0.0)))
    below, above = wrt.winding_number(square, [[0.0, 0.0, -1e-6], [0.0, 0.0, 1e-6]])
    assert below == pytest.approx(0.5, abs=1e-5) and above == pytest.approx(-0.5, abs=1e-5)


def placed(seed: int, even: bool) -> np.ndarray:
    """Return a matrix that rotates, may mirror, and moves, with even or uneven scales."""
    matrix, rng = np.eye(4), np.random.default_rng(seed)
    matrix[:3, :3] = np.linalg.qr(rng.normal(size=(3, 3)))[0] @ np.diag([0.7, -0.7, 0.7] if even else [0.7, -1.0, 1.4])
    matrix[:3, 3] = rng.normal(size=3) * 0.3
    return matrix


@pytest.mark.parametrize("exact", [False, True])
def test_instances_and_worlds_have_the_numbers_of_the_flat_mesh(exact: bool) -> None:
    """Also mirrored, after moves and of an open mesh; each world has its own."""
    bowl, ball, grey = wrt.Mesh(shapes.icosphere(3).vertices, shapes.icosphere(3).faces[:700]), shapes.icosphere(2), (wrt.Material(),)
    scenes = [wrt.Scene((wrt.Object(bowl, grey, placed(0, True), name="a"), wrt.Object(ball, grey, placed(1, False), name="b"),
                         wrt.Object(ball, grey, placed(seed, False), name="c"))) for seed in (2, 3)]
    points = np.random.default_rng(0).uniform(-1.5, 1.5, (300, 3)).astype(np.float32)
    world = np.random.default_rng(1).integers(0, 2, len(points))
    flat = [wrt.winding_number(wrt.build(scene), points, exact=True) for scene in scenes]
    expected = np.where(world, flat[1], flat[0])
    worlds = wrt.build(scenes)
    found = wrt.winding_number(worlds, points, exact=exact, world=world)
    # Rounding local points moves them by 1e-7, which matters close to the surface alone.
    near = np.abs(wrt.signed_distance(worlds, points, world=world, sign="winding")) < 1e-3
    assert near.sum() < 10 and np.unique(np.round(expected)).size > 1
    np.testing.assert_allclose(found[~near], expected[~near], rtol=0.0, atol=1e-5 if exact else 3.0 * ERROR)
    worlds.move(object="c", world=[0, 1], matrix=np.stack([placed(3, False), placed(2, False)]))
    swapped = wrt.winding_number(worlds, points, exact=exact, world=1 - world)
    np.testing.assert_array_equal(swapped, found)


@pytest.mark.filterwarnings("error")
def test_points_that_are_too_far_from_a_tiny_instance_for_float32_are_outside() -> None:
    scene = wrt.Scene((wrt.Object(shapes.icosphere(1), (wrt.Material(),), np.diag([1e-30, 1e-30, 1e-30, 1.0])),))
    accel = wrt.build(scene, movable=True)
    for exact in (False, True):
        found = wrt.winding_number(accel, [[1e10, 0.0, 0.0], [-1e36, 1e36, 0.0], [0.0, 0.0, 0.0]], exact=exact)
        assert found == pytest.approx([0.0, 0.0, 1.0], abs=ERROR)


def test_corners_nothing_and_what_is_refused() -> None:
    ball = wrt.build(shapes.icosphere(1))
    assert np.isfinite(wrt.winding_number(ball, ball.geometry.vertices)).all()
    edges = wrt.winding_number(wrt.build(shapes.box((-1.0, -1.0, -1.0), (1.0, 1.0, 1.0))), [[1.0, 1.0, 0.25], [-1.0, 0.5, 1.0]])
    assert ((edges > -1e-9) & (edges < 1.0 + 1e-9)).all()
    assert wrt.winding_number(ball, np.zeros((0, 3))).shape == (0,)
    bowl = wrt.Mesh(shapes.icosphere(1).vertices, shapes.icosphere(1).faces[:50])
    with refused("accel", "instance 0 is an open mesh", hint="changes the winding numbers"):
        wrt.winding_number(wrt.build(wrt.Scene((wrt.Object(bowl, (wrt.Material(),), placed(0, False)),)), movable=True), np.zeros((1, 3)))
    with refused("world", "2 worlds"):
        wrt.winding_number(wrt.build([shapes.icosphere(1)] * 2), np.zeros((1, 3)))
    for accel, points, said in ((ball, [[np.nan, 0.0, 0.0]], ("points", "finite")), (ball, [0.0], ("points", "(..., 3)")),
                                ("bvh", [[0.0, 0.0, 0.0]], ("accel", "structure without spheres"))):
        with refused(*said):
            wrt.winding_number(accel, points)  # type: ignore[arg-type]


@pytest.mark.parametrize("exact", [False, True])
def test_an_empty_mesh_winds_around_nothing(exact: bool) -> None:
    accel = wrt.build((np.zeros((1, 3)), np.zeros((0, 3), np.int32)))
    assert wrt.winding_number(accel, np.zeros((2, 3)), exact=exact).tolist() == [0.0, 0.0]
