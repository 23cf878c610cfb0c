"""Several worlds in one structure: hits in each world have the bits of a structure over that world alone."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
import pytest
import warp as wp

import wrt
from tests.kernel_tools import DEVICE
from tests.placed import place
from tests.refused import Refusal, refused
from tests.wrt.accel.test_move import matrices
from tests.wrt.core.test_arrays import Library, OnDevice
from wrt.accel.geometry import Geometry
from wrt.accel.instances import Instances
from wrt.core.arrays import to_numpy
from wrt.scene.materials import Material
from wrt.scene.model import Object, Scene, Sphere
from wrt.scene.shapes import icosphere, torus

BALL, RING = icosphere(2), torus(segments=12, tube_segments=8)
COUNTS = (7, 1, 0, 12, 2, 5)
N = 6000


def scenes() -> list[Any]:
    """Return six scenes of 7, 1, 0, 12, 2 and 5 objects, and a mesh."""
    grey = Material()
    return [Scene(tuple(Object(RING if i % 3 else BALL, (grey,), matrix) for i, matrix in enumerate(matrices(count, seed))))
            for seed, count in enumerate(COUNTS)] + [BALL]


def geometry_of(scene: Any) -> Any:
    """Return the geometry of one world alone, made independently."""
    shapes = {id(mesh): Geometry.of(mesh) for mesh in (BALL, RING)}
    things = scene.objects if isinstance(scene, Scene) else (Object(scene, (Material(),)),)
    return place(*((shapes[id(thing.mesh)], thing.transform) for thing in things)) if things else None


@cache
def structure(kind: str = "bvh2") -> Instances:
    accel = wrt.build(scenes(), kind)
    assert isinstance(accel, Instances)
    return accel


def rays() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return origins, directions, and the world of each ray."""
    rng = np.random.default_rng(7)
    origins = rng.normal(scale=6.0, size=(N, 3)).astype(np.float32)
    return origins, (rng.normal(scale=2.0, size=(N, 3)) - origins).astype(np.float32), rng.integers(0, len(COUNTS) + 1, N)


def bits(hits: Any, rows: Any = slice(None)) -> tuple[bytes, ...]:
    return tuple(np.ascontiguousarray(getattr(hits.numpy(), name)[rows]).tobytes() for name in ("t", "u", "v", "prim_id"))


def check_each_world(accel: Instances, kind: str, alone: list[Any]) -> None:
    origins, directions, world = rays()
    hits, occluded = accel.closest_hit(origins, directions, world=world), accel.any_hit(origins, directions, world=world)
    for number, geometry in enumerate(alone):
        mine = np.flatnonzero(world == number)
        if geometry is None:
            assert (hits.prim_id[mine] == -1).all() and np.isinf(hits.t[mine]).all() and not occluded[mine].any()
            continue
        expected = wrt.build(geometry, kind).closest_hit(origins[mine], directions[mine])
        assert bits(hits, mine) == bits(expected) and 3 < (expected.prim_id >= 0).sum() < len(mine)
        assert np.array_equal(occluded[mine], expected.prim_id >= 0)


@pytest.mark.parametrize("kind", ["bvh2", "bvh8"])
def test_each_world_answers_as_if_it_were_alone(kind: str) -> None:
    check_each_world(structure(kind), kind, [geometry_of(scene) for scene in scenes()])


def test_meshes_are_kept_once() -> None:
    geometry: Any = structure().geometry
    assert len(structure().bottoms) == 3 and len(geometry.parts[0]) == 0  # the first is for objects that are not instances
    assert geometry.first_instance.tolist() == [0, 7, 8, 8, 20, 22, 27, 28] and len(structure().snapshot.roots) == 7


def test_worlds_whose_instances_move() -> None:
    accel, alone = wrt.build(scenes(), "bvh2"), scenes()
    assert isinstance(accel, Instances)
    first, places = accel.geometry.first_instance, matrices(3, 9)  # type: ignore[attr-defined]
    moved = [(0, 6), (3, 11), (5, 0)]
    accel.move([first[world] + k for world, k in moved], places)
    accel.move(int(first[6]), places[0])
    for (world, k), matrix in zip(moved, places, strict=True):
        things = list(alone[world].objects)
        things[k] = Object(things[k].mesh, things[k].materials, matrix)
        alone[world] = Scene(tuple(things))
    alone[6] = Scene((Object(BALL, (Material(),), places[0]),))
    check_each_world(accel, "bvh2", [geometry_of(scene) for scene in alone])


def test_one_world_for_all_rays_and_one_world_alone() -> None:
    origins, directions, _ = rays()
    one = wrt.build(scenes()[3:4], "bvh2")
    expected = bits(one.closest_hit(origins, directions))
    assert bits(structure().closest_hit(origins, directions, world=3)) == expected
    assert bits(one.closest_hit(origins, directions, world=0)) == expected
    assert bits(structure().closest_hit(origins[:1], directions[:1], world=np.array([3], np.uint8))) == bits(
        one.closest_hit(origins[:1], directions[:1]))
    assert len(structure().closest_hit(np.zeros((0, 3)), np.zeros((0, 3)), world=[])) == 0


def test_arrays_of_warp_whose_worlds_are_not_looked_at() -> None:
    origins, directions, world = rays()
    expected, bad = structure().closest_hit(origins, directions, world=world), np.arange(N) % 5 == 0
    ids = np.where(bad, np.where(np.arange(N) % 2, -1, 7), world)
    given = [wp.array(each, dtype=wp.vec3, device=DEVICE) for each in (origins, directions)]
    hits = structure().closest_hit(*given, world=wp.array(ids, dtype=wp.int32, device=DEVICE))
    assert isinstance(hits.t, wp.array) and bits(hits, ~bad) == bits(expected, ~bad)
    assert (hits.numpy().prim_id[bad] == -1).all()
    for library in (Library, OnDevice):
        arrays = [library.Tensor(array.numpy() if library is Library else array)  # type: ignore[attr-defined]
                  for array in (*given, wp.array(world, dtype=wp.int32, device=DEVICE))]
        of_tensors = structure().closest_hit(*arrays[:2], world=arrays[2])
        assert isinstance(of_tensors.t, library.Tensor)  # type: ignore[attr-defined]
        for name in ("t", "instance"):
            np.testing.assert_array_equal(to_numpy(getattr(of_tensors, name)), getattr(expected, name))
    again = structure().closest_hit(*given, world=world, out=hits)
    assert again.t is hits.t and bits(again) == bits(expected)


def test_points_and_instances_of_hits() -> None:
    origins, directions, world = rays()
    hits = structure().closest_hit(origins, directions, world=world)
    hit, first = hits.prim_id >= 0, structure().geometry.first_instance  # type: ignore[attr-defined]
    assert np.abs(hits.point - (origins + np.float64(directions) * hits.t[:, None]))[hit].max() < 1e-4
    assert (hits.instance[~hit] == -1).all() and (hits.instance[hit] >= first[world[hit]]).all()
    assert (hits.instance[hit] < first[world[hit] + 1]).all()
    alone = wrt.build(scenes()[3:4], "bvh2").closest_hit(origins[world == 3], directions[world == 3])
    for name in ("normal", "point_error"):
        assert np.array_equal(getattr(hits, name)[world == 3], getattr(alone, name), equal_nan=True)
    assert np.array_equal(hits.instance[world == 3], np.where(alone.prim_id >= 0, alone.instance + first[3], -1))
    assert np.array_equal(hits.object[hit], hits.instance[hit] - first[world[hit]])


def test_a_ray_costs_what_it_costs_in_its_world_alone() -> None:
    origins, directions, world = (each[:300] for each in rays())
    counts = structure().closest_hit(origins, directions, world=world, trace=True).counters
    mine = world == 3
    alone = wrt.build(scenes()[3:4], "bvh2").closest_hit(origins[mine], directions[mine], trace=True).counters
    assert np.array_equal(counts.counts[mine], alone.counts) and counts.nodes[world == 2].max() == 1  # type: ignore[union-attr]


@pytest.mark.parametrize("world, told", [
    (None, ("world", "not be None")), (7, ("world", "0 to 6")),
    (-1, ("world", "0 to 6")),
    (1.0, ("world", "whole number or (2,)")), ([0, 1, 2], ("world", "(2,)")),
    ("first", ("world", "number or (2,)")),
    (wp.zeros(2, dtype=wp.int64, device="cpu"), ("world", "(2,) int32")),
])
def test_worlds_that_are_none(world: Any, told: Refusal) -> None:
    for ask in (structure().closest_hit, structure().any_hit):
        with refused(*told):
            ask(np.zeros((2, 3)), np.ones((2, 3)), world=world)


def test_what_is_no_world() -> None:
    flat = Object(BALL, (Material(),), np.diag([1.0, 1.0, 0.0, 1.0]), name="flat")
    for given, told in (([], ("mesh", "at least one object")), ([Scene()], ("mesh", "at least one object")),
                        ([BALL, Scene(spheres=(Sphere((0, 0, 0), 1.0, Material()),))], (None, "spheres", "world 1", None, "icosphere")),
                        ([Scene((flat,))], (None, "flattened", "world 0: object 'flat'")), ([BALL, 5], ("mesh", "Mesh, a Scene"))):
        with refused(*told):
            wrt.build(given)
    ball = Scene(spheres=(Sphere((0, 0, 0), 1.0, Material()),))
    for scene, where in ((ball, "the scene"), (Scene((flat,)), "object 'flat'")):  # the caller has named no world
        with refused(None, place=where):
            wrt.build(scene, movable=True)
    with refused("world", "structures over worlds"):
        wrt.build(BALL).closest_hit(np.zeros((1, 3)), np.ones((1, 3)), world=0)
