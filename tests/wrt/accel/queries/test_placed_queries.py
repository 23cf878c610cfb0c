"""Queries over instances and worlds return the bits of the same queries over the same triangles in one mesh."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

import wrt
from tests.refused import refused
from wrt.accel.instances import Instances
from wrt.scene.mesh import Mesh
from wrt.scene.model import Object, Scene
from wrt.scene.shapes import icosphere

GREY, RED = wrt.Material(), wrt.Material(albedo=(0.8, 0.1, 0.1))
STRUCTURES = ("bvh", "bvh2", "kdtree")


def exact(values: np.ndarray) -> np.ndarray:
    """Round to multiples of 1/64: the placements below then map coordinates without rounding."""
    return (np.round(np.asarray(values) * 64.0) / 64.0).astype(np.float32)


def matrix(seed: int, scale: float) -> np.ndarray:
    """Scale by a power of two and move by whole numbers: no query rounds otherwise than in world space."""
    out = np.diag([scale, scale, scale, 1.0])
    out[:3, 3] = np.random.default_rng(seed).integers(-1, 2, 3)
    return out


def turned(scene: Scene) -> Scene:
    """Return the scene with all its objects turned, and scaled differently along the axes."""
    rng = np.random.default_rng(3)
    return replace(scene, objects=tuple(replace(each, transform=each.transform @ affine(rng)) for each in scene.objects))


def affine(rng: np.random.Generator) -> np.ndarray:
    out = np.eye(4)
    rotation, _ = np.linalg.qr(rng.normal(size=(3, 3)))  # without scipy, which queries do not need
    out[:3, :3] = np.linalg.det(rotation) * rotation @ np.diag(rng.uniform(0.5, 2.0, 3))
    return out


@cache
def scenes() -> list[Scene]:
    """Three worlds: overlapping balls with two materials, one ball, and nothing."""
    ball = icosphere(2)
    mesh = Mesh(exact(ball.vertices), ball.faces, name="ball")
    small = Mesh(exact(icosphere(1).vertices), icosphere(1).faces, name="small")
    objects = [Object(mesh if i % 2 else small, (RED if i % 3 else GREY,), matrix(i, 2.0 ** (i % 3 - 1)), name=f"body {i}")
               for i in range(7)]
    return [Scene(tuple(objects), name="first"), Scene((Object(mesh, (RED,), matrix(9, 1.0)),)), Scene()]


@cache
def structures(accel: str = "bvh") -> tuple[Instances, list[wrt.accel.base.OneMesh]]:
    return wrt.build(scenes(), accel), [wrt.build(scene, accel) for scene in scenes()]


def rays(n: int = 1500) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rays and their worlds. Many hit edges and corners."""
    rng = np.random.default_rng(5)
    origins = exact(rng.uniform(-4, 4, (n, 3)))
    return origins, exact(rng.uniform(-1, 1, (n, 3))) - origins + np.float32(1 / 128), rng.integers(0, 3, n)


@pytest.mark.parametrize("accel", STRUCTURES)
@pytest.mark.parametrize("crossings", [False, True])
def test_lists_equal_those_of_the_flat_mesh(accel: str, crossings: bool) -> None:
    worlds, flat = structures(accel)
    origins, directions, world = rays()
    found = wrt.all_hits(worlds, origins, directions, crossings=crossings, world=world)
    counts = wrt.count_hits(worlds, origins, directions, crossings=crossings, world=world)
    first = wrt.first_hits(worlds, 3, origins, directions, crossings=crossings, world=world)
    assert found.counts.max() > 8, "no list exceeds the first capacity"
    for w, one in enumerate(flat):
        rows = world == w
        expected = wrt.all_hits(one, origins[rows], directions[rows], crossings=crossings)
        assert np.array_equal(found.counts[rows], expected.counts)
        assert np.array_equal(counts[rows], expected.counts)
        mine = rows[found.ray_id]
        firsts = wrt.first_hits(one, 3, origins[rows], directions[rows], crossings=crossings)
        for name in ("t", "u", "v", "prim_id"):
            assert getattr(found, name)[mine].tobytes() == getattr(expected, name).tobytes(), name
            assert getattr(first, name)[rows].tobytes() == getattr(firsts, name).tobytes(), name


def test_lists_of_directions_of_any_length() -> None:
    """The local direction is scaled by a power of two: t stays that of the caller's direction."""
    worlds, _ = structures()
    tiny = [Scene((Object(scenes()[0].objects[1].mesh, (GREY,), np.diag([2.0**-70, 2.0**-70, 2.0**-70, 1.0])),))]
    accel, joined = wrt.build(tiny), wrt.build(tiny[0])
    origins = exact(np.random.default_rng(1).uniform(-0.5, 0.5, (64, 3))) * np.float32(2.0**-70)
    for length in (2.0**-100, 1.0, 2.0**20):
        directions = exact(np.random.default_rng(2).uniform(-1, 1, (64, 3))) * np.float32(length)
        found, expected = wrt.all_hits(accel, origins, directions), wrt.all_hits(joined, origins, directions)
        assert np.array_equal(found.counts, expected.counts)
        assert np.array_equal(found.prim_id, expected.prim_id)
        np.testing.assert_allclose(found.t, expected.t, rtol=1e-5)
    with refused("world"):
        wrt.all_hits(worlds, origins, origins + 1)


def test_first_hit_is_the_closest_hit() -> None:
    """Also of turned bodies, whose hits differ from the flat mesh in their last bits."""
    worlds = wrt.build([turned(scene) for scene in scenes()])
    origins, directions, world = rays(3000)
    closest, lists = (worlds.closest_hit(origins, directions, world=world), wrt.all_hits(worlds, origins, directions, world=world))
    hit = closest.prim_id >= 0
    assert np.array_equal(hit, lists.counts > 0)
    for name in ("t", "u", "v", "prim_id"):
        assert getattr(lists, name)[lists.first[:-1][hit]].tobytes() == getattr(closest, name)[hit].tobytes(), name
    assert (np.diff(lists.t)[np.diff(lists.ray_id) == 0] >= 0.0).all()


@pytest.mark.parametrize("accel", ["bvh", "bvh8c"])
def test_closest_points_equal_those_of_the_flat_mesh(accel: str) -> None:
    """Also of turned and unevenly scaled bodies, because corners in world space are those of the flat mesh."""
    points, _, world = rays(1200)
    for all_scenes in (scenes(), [turned(scene) for scene in scenes()]):
        worlds = wrt.build(all_scenes, accel)
        found = wrt.closest_points(worlds, points, world=world)
        for w, scene in enumerate(all_scenes):
            expected = wrt.closest_points(wrt.build(scene, accel), points[world == w])
            for name in ("distance", "point", "u", "v", "prim_id"):
                assert getattr(found, name)[world == w].tobytes() == getattr(expected, name).tobytes(), name


@pytest.mark.parametrize("swapped", [False, True])
def test_of_instances_at_the_same_distance_the_first_has_the_closest_point(swapped: bool) -> None:
    """Two objects have the same square. The second also has a far triangle, so its box is closer to all points, and visited first.
    From far points, distances in the space of an object are rounded by more than the margin of its corners."""
    square = [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]
    faces, far = [[0, 1, 2], [0, 2, 3]], [[1e5, 0, 1], [1e5, 1, 1], [1e5, 0, 0]]
    meshes = [Mesh(square, faces), Mesh([*square, *far], [*faces, [4, 5, 6]])]
    place = np.diag([0.3, 0.3, 0.3, 1.0])
    place[:3, 3] = 1.7, -2.3, 0.9
    accel = wrt.build([Scene(tuple(Object(mesh, (GREY,), place) for mesh in meshes[:: -1 if swapped else 1]))])
    rng = np.random.default_rng(0)
    above = np.concatenate([rng.uniform(0.1, 0.9, (1000, 2)), 10.0 ** rng.uniform(0.0, 7.0, (1000, 1))], axis=1)
    found = wrt.closest_points(accel, above * 0.3 + place[:3, 3], world=0)
    assert (found.prim_id < 2).all()
    np.testing.assert_allclose(found.distance, 0.3 * above[:, 2], rtol=1e-6)


def test_inside_by_parity_over_instances() -> None:
    worlds, flat = structures()
    points, _, world = rays(2000)
    points = (points * np.float32(0.5)).astype(np.float32)
    inside, distance = wrt.contains(worlds, points, world=world), wrt.signed_distance(worlds, points, world=world)
    assert inside.any()
    for w, one in enumerate(flat):
        assert np.array_equal(inside[world == w], wrt.contains(one, points[world == w]))
        assert distance[world == w].tobytes() == wrt.signed_distance(one, points[world == w]).tobytes()


def test_visible_over_worlds() -> None:
    worlds, flat = structures()
    a, b, world = rays(2000)
    seen = wrt.visible(worlds, a, b, world=world)
    for w, one in enumerate(flat):
        assert np.array_equal(seen[world == w], wrt.visible(one, a[world == w], b[world == w]))
    with refused("world"):
        wrt.visible(worlds, a, b)
