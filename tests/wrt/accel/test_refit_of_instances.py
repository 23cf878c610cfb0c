"""Instances follow a refit of their mesh: hits have the bits of hits in a new structure over the refitted meshes."""

from __future__ import annotations

import pickle
from typing import Any

import numpy as np
import pytest
import warp as wp

import wrt
from tests.kernel_tools import DEVICE, cpu_only
from tests.refused import refused
from tests.wrt.accel.test_move import answers, crowd, matrices, rays, structure, with_a_part_in_the_world
from wrt.accel.geometry import Geometry, InstancedGeometry
from wrt.accel.instances import Instances
from wrt.accel.scenes.build import build
from wrt.scene.mesh import Mesh
from wrt.scene.model import Scene
from wrt.scene.shapes import icosphere, torus

BALL = icosphere(2)


def points_of(vertices: np.ndarray) -> Any:
    return wp.array(np.asarray(vertices, np.float32), dtype=wp.vec3, device=DEVICE)


def new(accel: Any, kind: str, parts: dict[int, np.ndarray]) -> Instances:
    """Build a structure over the geometry of `accel`, with the vertices `parts` of these parts."""
    old = accel.geometry.now()
    meshes = [Geometry(np.float32(parts.get(k, part.vertices)), part.faces, part.spheres) for k, part in enumerate(old.parts)]
    return structure(kind, InstancedGeometry(tuple(meshes), old.part, old.to_world, old.first_prim, old.n_triangles, old.worlds))


def bent(vertices: np.ndarray, seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return np.float32(vertices * rng.uniform(0.5, 3.0, 3) + rng.normal(scale=0.05, size=vertices.shape) + rng.normal(size=3))


@pytest.mark.parametrize("kind", ["bvh8", "bvh2"])
def test_hits_and_points_are_those_of_a_new_structure(kind: str) -> None:
    """The matrices mirror, and instances move before and after a refit, by arrays of both kinds."""
    accel, parts, seen = structure(kind), {}, set()
    copied, before = wrt.build(crowd(), kind), answers(accel)  # type: ignore[arg-type]
    for turn in range(4):
        if turn == 1:
            accel.move([0, 1, 2], matrices(3, 7))
        if turn == 2:
            accel.move(wp.array(matrices(24, 8), dtype=wp.mat44d, device=DEVICE))
        part = turn % 2
        object = int(np.flatnonzero(accel.geometry.part == part)[-1])  # type: ignore[attr-defined]
        parts[part] = bent(crowd().parts[part].vertices, turn)
        data = accel.data
        assert np.isnan(accel.refit(object, points_of(parts[part])).growth)
        assert (accel.data is data) == (turn > 1)
        expected = new(accel, kind, parts)
        assert answers(accel) == answers(expected)
        hits, others = accel.closest_hit(*rays()), expected.closest_hit(*rays())
        for name in ("point", "normal", "point_error", "instance"):
            np.testing.assert_array_equal(getattr(hits, name), getattr(others, name))
        hit = hits.hit
        points = rays()[0][hit] + hits.t[hit, None] * np.float64(rays()[1][hit])
        assert np.abs(hits.point[hit] - points).max() < 1e-4
        seen.add(answers(accel))
    assert len(seen) == 4 and answers(pickle.loads(pickle.dumps(accel))) == answers(accel)
    assert answers(copied) == before
    accel.move(np.arange(24), matrices(24, 9))
    expected = new(accel, kind, parts)
    assert answers(accel) == answers(expected)
    lists, others = (wrt.all_hits(each, *rays(300)) for each in (accel, expected))
    assert np.array_equal(lists.t, others.t) and np.array_equal(lists.prim_id, others.prim_id)


@pytest.mark.parametrize("kind", ["bvh4", "bvh8c"])
def test_worlds_share_a_mesh(kind: str) -> None:
    ring, vertices = torus(), bent(BALL.vertices, 3)
    worlds = wrt.build([Scene.of([BALL, ring]), Scene.of([ring, BALL, BALL])], kind)
    assert isinstance(worlds, Instances)
    world = np.arange(3000) % 2
    worlds.refit(1, points_of(vertices), world=1)
    expected = new(worlds, kind, {int(worlds.geometry.part[0]): vertices})  # type: ignore[attr-defined]
    for _ in range(2):
        hits, others = (each.closest_hit(*rays(), world=world) for each in (worlds, expected))
        assert all(getattr(hits, name).tobytes() == getattr(others, name).tobytes() for name in ("t", "u", "v", "prim_id"))
        assert np.array_equal(hits.object, others.instance - np.where(others.hit, world * 2, 0))
        np.testing.assert_array_equal(hits.point, others.point)
        worlds.refit(1, points_of(vertices), world=1)
    assert np.array_equal(*(wrt.contains(each, rays()[0], world=world) for each in (worlds, expected)))
    assert np.array_equal(*(wrt.closest_points(each, rays()[0], world=world).point for each in (worlds, expected)))
    with refused("world", "2 worlds"):
        worlds.refit(1, points_of(vertices))


@cpu_only
def test_a_graph_captures_a_refit_and_vertices_may_be_nan() -> None:
    accel, points = structure("bvh8"), points_of(crowd().parts[0].vertices)
    first = crowd().parts[0].vertices
    with refused(None, "cannot be captured"), wp.ScopedCapture("cpu"):
        accel.refit(0, points)
    accel.refit(0, points)
    origins, directions = (wp.array(each, dtype=wp.vec3, device="cpu") for each in rays())
    hits = accel.closest_hit(origins, directions)
    with wp.ScopedCapture("cpu") as capture:
        accel.refit(0, points)
        accel.closest_hit(origins, directions, out=hits)
    for vertices in (bent(first, 1), np.where(np.arange(len(first))[:, None] % 9 == 4, np.nan, first), np.nan * first,
                     1e30 * first, np.zeros_like(first), bent(first, 2)):
        points.assign(np.float32(vertices))
        wp.capture_launch(capture.graph)
        for kind in ("bvh8", "bvh2"):
            expected = new(accel, kind, {0: vertices}).closest_hit(*rays())
            assert all(getattr(hits, name).numpy().tobytes() == getattr(expected, name).tobytes() for name in ("t", "u", "v", "prim_id"))
    assert not accel.invalid_moves.numpy().any()


def test_an_instance_after_an_invalid_move_stays_hidden() -> None:
    accel, places = structure("bvh2"), matrices(24, 1)
    places[0, 0, 0] = np.nan
    accel.move(wp.array(places, dtype=wp.mat44d, device=DEVICE))
    before = accel.closest_hit(*rays())
    accel.refit(0, points_of(crowd().parts[0].vertices))
    hits = accel.closest_hit(*rays())
    assert hits.t.tobytes() == before.t.tobytes() and 0 not in hits.instance and accel.invalid_moves.numpy().tolist() == [1] + [0] * 23


def test_small_meshes() -> None:
    """Leaves share primitives, and a mesh has few boxes, one, or none."""
    for count in (0, 1, 5, 60, 70):
        mesh = Geometry(BALL.vertices, BALL.faces[:count], np.zeros((0, 4), np.float32))
        placed = InstancedGeometry((mesh, Geometry.of(BALL)), np.array([0, 1, 0]), np.float64(matrices(3, 2)[:, :3]),
                                   np.array([0, count, count + len(BALL.faces)]), 2 * count + len(BALL.faces))
        for options in ({}, {"builder": "sbvh"}):
            accel, vertices = build(placed, "bvh2", **options), bent(BALL.vertices, count)
            assert isinstance(accel, Instances)
            accel.refit(2, points_of(vertices))
            hits, others = (each.closest_hit(*rays()) for each in (accel, new(accel, "bvh2", {0: vertices})))
            assert hits.t.tobytes() == others.t.tobytes() and hits.prim_id.tobytes() == others.prim_id.tobytes()


def test_what_is_refused_changes_nothing() -> None:
    scene = Scene.of([Mesh(BALL.vertices, BALL.faces, name="ball"), torus()])
    accel, points = wrt.build(scene, movable=True), points_of(BALL.vertices)
    assert isinstance(accel, Instances)
    far = wrt.build(Scene.of([Mesh(BALL.vertices + np.float64([1e8, 0.0, 0.0]), BALL.faces)]), movable=True)
    grid, nan = wrt.build(scene, "grid", movable=True), BALL.vertices.copy()
    nan[3] = np.nan
    for structure_, arguments, told in (
            (accel, ("bal", points), ("object", "unknown object 'bal'")), (accel, (2, points), ("object", "0 to 1")),
            (accel, ([0], points), ("object", "one object")), (accel, ("ball", points[:5]), ("vertices", "must be")),
            (accel, ("ball", BALL.vertices), ("vertices", "Warp array")), (accel, (0, points, 1), ("world", "0 to 0")),
            (far, (0, points), ("object", "near 0")),
            (with_a_part_in_the_world(), (0, points), ("object", "of its own")), (grid, (0, points), (None, "cannot be refitted")),
            (accel, (0, wp.array(BALL.vertices, dtype=wp.vec3d, device=DEVICE)), ("vertices", "vec3")),
            *(((accel, (0, points_of(nan)), ("vertices", "finite")),) if DEVICE == "cpu" else ())):
        before = structure_.snapshot, structure_.bottoms, [each.snapshot for each in structure_.bottoms]  # type: ignore[attr-defined]
        with refused(*told):
            structure_.refit(*arguments)  # type: ignore[attr-defined]
        assert before == (structure_.snapshot, structure_.bottoms, [each.snapshot for each in structure_.bottoms])  # type: ignore
