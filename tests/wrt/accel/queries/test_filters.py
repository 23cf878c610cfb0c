"""Rays that pass through bodies and see only some masks, against structures over the objects that are left."""

from __future__ import annotations

import pickle
from functools import cache

import numpy as np
import pytest
import warp as wp

import wrt
from tests.refused import refused
from wrt.accel.instances import Instances
from wrt.scene.model import Object, Scene
from wrt.scene.shapes import icosphere

GREY = (wrt.Material(),)
COUNTS = 9, 6, 1
BODIES = np.array([0, 1, 1, 2, 3, 3, 3, 4, -1, 0, 5, -7, 2, 2, 1, 0], np.int32)
MASKS = np.array([1, 2, 3, 4, 5, 6, 7, -1, 1 << 31, 1, 0, 9, 8, -2, 2, 3]).astype(np.int32)


@cache
def scenes() -> list[Scene]:
    rng, meshes, out = np.random.default_rng(5), [icosphere(0), icosphere(2)], []
    for count in COUNTS:
        things = []
        for i in range(count):
            matrix = np.diag([*rng.uniform(0.5, 1.5, 3), 1.0])
            matrix[:3, 3] = rng.uniform(-2.0, 2.0, 3)
            matrix[0, 0] *= (-1.0) ** i  # mirrored
            things.append(Object(meshes[i % 2], GREY, matrix))
        out.append(Scene(tuple(things)))
    return out


def structure(kind: str) -> Instances:
    accel = wrt.build(scenes(), kind)
    accel.bodies.assign(BODIES)
    accel.masks.assign(MASKS)
    return accel


@cache
def rays(n: int = 3000) -> tuple[np.ndarray, np.ndarray]:
    """Rays of which sixteen at a time have nearly one direction, so that they are packets, and rays of all directions."""
    rng = np.random.default_rng(6)
    start = np.repeat(rng.uniform(-5.0, 5.0, (n // 32, 3)), 16, 0)
    origins = np.concatenate([start, rng.uniform(-3.0, 3.0, (n - len(start), 3))]).astype(np.float32)
    directions = np.concatenate([-start, rng.normal(size=(n - len(start), 3))]) + 0.03 * rng.normal(size=(n, 3))
    return origins, directions.astype(np.float32)


def left(world: int, exclude: int, mask: int) -> list[int]:
    """Return the objects of a world that a ray sees."""
    first = sum(COUNTS[:world])
    some = range(first, first + COUNTS[world])
    return [i - first for i in some if (exclude == -1 or BODIES[i] != exclude) and int(MASKS[i]) & mask & 0xFFFFFFFF]


def expected(kind: str, world: int, exclude: int, mask: int) -> tuple[np.ndarray, np.ndarray]:
    """Return t and the object of the closest hits in a structure over the objects that are left."""
    ids, (o, d) = left(world, exclude, mask), rays()
    if not ids:
        return np.full(len(o), np.inf, np.float32), np.full(len(o), -1)
    hits = wrt.build(Scene(tuple(scenes()[world].objects[i] for i in ids)), kind, movable=True).closest_hit(o, d)
    return hits.t, np.append(ids, -1)[hits.object]


CASES = [(0, 1, -1), (0, 3, -1), (0, -1, 4), (0, 1, 1), (0, -1, 1 << 31), (0, 99, 0xFFFFFFFF),
         (0, -1, 0), (1, 0, -1), (1, 2, 8), (2, 0, -1)]


@pytest.mark.parametrize("kind", ["bvh", "bvh2", "kdtree"])
def test_rays_see_the_objects_that_are_left(kind):
    accel, (o, d) = structure(kind), rays()
    for world, exclude, mask in CASES:
        t, thing = expected(kind, world, exclude, mask)
        hits = accel.closest_hit(o, d, world=world, exclude=exclude, mask=mask)
        assert np.array_equal(hits.t, t) and np.array_equal(hits.object, thing)
        assert np.array_equal(accel.any_hit(o, d, world=world, exclude=exclude, mask=mask), thing >= 0)


@pytest.mark.parametrize("kind", ["bvh", "bvh2"])
def test_a_filter_of_each_ray(kind):
    accel, (o, d), rng = structure(kind), rays(), np.random.default_rng(7)
    case = np.concatenate([np.repeat(rng.integers(len(CASES), size=len(o) // 16), 16), rng.integers(len(CASES), size=len(o) % 16)])
    case[::3] = rng.integers(len(CASES), size=len(case[::3]))
    world, exclude, mask = np.array(CASES).T[:, case]
    every = [expected(kind, *each) for each in CASES]
    t, thing = (np.stack([each[i] for each in every])[case, np.arange(len(o))] for i in range(2))
    for threads in (1, 3):
        hits = accel.closest_hit(o, d, threads=threads, world=world, exclude=exclude, mask=mask)
        assert np.array_equal(hits.t, t) and np.array_equal(hits.object, thing)
    arrays = [wp.array(each.astype(np.int32), dtype=wp.int32, device="cpu") for each in (world, exclude, mask)]
    vectors = [wp.array(each, dtype=wp.vec3, device="cpu") for each in (o, d)]
    device = accel.closest_hit(*vectors, **dict(zip(("world", "exclude", "mask"), arrays, strict=True)))
    assert np.array_equal(device.t.numpy(), t) and np.array_equal(device.object.numpy(), thing)
    shaped = accel.any_hit(o.reshape(30, 100, 3), d.reshape(30, 100, 3), world=world.reshape(30, 100), exclude=exclude.reshape(30, 100),
                           mask=mask.reshape(30, 100))
    assert np.array_equal(shaped.reshape(-1), thing >= 0)
    one = accel.closest_hit(o[0], d[0], world=np.int8(world[0]), exclude=np.int64(exclude[0]), mask=mask[0])
    assert one.t == t[0]


def test_all_hits_and_counts():
    accel, (o, d) = structure("bvh"), rays()
    for world, exclude, mask in CASES:
        every = wrt.all_hits(accel, o, d, world=world)
        seen = np.isin(every.object, left(world, exclude, mask))
        some = wrt.all_hits(accel, o, d, world=world, exclude=exclude, mask=mask)
        assert np.array_equal(some.prim_id, every.prim_id[seen]) and np.array_equal(some.t, every.t[seen])
        counts = np.bincount(every.ray_id[seen], minlength=len(o))
        assert np.array_equal(wrt.count_hits(accel, o, d, world=world, exclude=exclude, mask=mask), counts)
        first = wrt.first_hits(accel, 2, o, d, world=world, exclude=exclude, mask=mask)
        assert np.array_equal(first.prim_id >= 0, counts[:, None] > np.arange(2))
    counted = accel.closest_hit(o, d, world=0, mask=0, counters=True)
    assert (counted.prim_id == -1).all() and not counted.counters.primitives.any()


def test_masks_survive_moves_and_pickle():
    accel, (o, d) = structure("bvh"), rays()
    rows = accel.geometry.to_world.copy()
    rows[:, :, 3] += np.random.default_rng(8).uniform(-1.0, 1.0, (len(rows), 3))
    matrices = np.concatenate([rows, np.broadcast_to([0.0, 0.0, 0.0, 1.0], (len(rows), 1, 4))], axis=1)
    accel.move(matrices)
    thawed, in_place = pickle.loads(pickle.dumps(accel)), structure("bvh")
    in_place.move(wp.array(matrices, dtype=wp.mat44d, device="cpu"))
    for world, exclude, mask in CASES:
        every = wrt.all_hits(accel, o, d, world=world)
        seen = np.isin(every.object, left(world, exclude, mask))
        ray, first = np.unique(every.ray_id[seen], return_index=True)
        t = np.full(len(o), np.inf, np.float32)
        t[ray] = every.t[seen][first]
        for each in (accel, thawed, in_place):
            assert np.array_equal(each.closest_hit(o, d, world=world, exclude=exclude, mask=mask).t, t)


def test_a_filter_in_a_kernel():
    accel, (o, d) = structure("bvh"), rays()
    query = wrt.ray_query(accel, filtered=True)

    @wrt.kernel
    def cast(world: query.World, o: wp.array(dtype=wp.vec3), d: wp.array(dtype=wp.vec3), exclude: int, mask: int,
             t: wp.array(dtype=float), hit: wp.array(dtype=wp.bool)):
        i = wp.tid()
        ray = query.ray(o[i], d[i])
        ray.exclude = exclude
        ray.mask = mask
        t[i] = query.closest_hit(world, ray).t
        hit[i] = query.any_hit(world, ray)

    t, hit = wp.empty(len(o), dtype=float, device="cpu"), wp.empty(len(o), dtype=wp.bool, device="cpu")
    vectors = [wp.array(each, dtype=wp.vec3, device="cpu") for each in (o, d)]
    for _, exclude, mask in CASES[:5]:
        wp.launch(cast, len(o), [accel.world, *vectors, exclude, int(np.int64(mask).astype(np.int32)), t, hit], device="cpu")
        hits = accel.closest_hit(o, d, world=0, exclude=exclude, mask=mask)
        assert np.array_equal(t.numpy(), hits.t) and np.array_equal(hit.numpy(), hits.prim_id >= 0)


def test_the_first_axis_is_the_world():
    accel, (o, d) = structure("bvh"), rays()
    o, d = (each[:2400].reshape(3, 10, 80, 3) for each in (o, d))
    world = np.broadcast_to(np.arange(3)[:, None, None], o.shape[:-1])
    assert np.array_equal(accel.closest_hit(o, d).t, accel.closest_hit(o, d, world=world).t)
    assert np.array_equal(accel.closest_hit(o, d, exclude=1).t, accel.closest_hit(o, d, world=world, exclude=1).t)
    assert np.array_equal(accel.any_hit(o[:, 0, 0], d[:, 0, 0]), accel.any_hit(o[:, 0, 0], d[:, 0, 0], world=[0, 1, 2]))
    assert np.array_equal(wrt.count_hits(accel, o, d), wrt.count_hits(accel, o, d, world=world))
    assert accel.closest_hit(np.zeros((3, 0, 3)), np.zeros((3, 0, 3))).t.shape == (3, 0)
    with refused("world", "(3, ...)"):
        accel.closest_hit(o[:2], d[:2])


@pytest.mark.parametrize(("name", "value", "message"), [
    ("exclude", 1.5, "whole number"), ("exclude", [1, 2], "number or"), ("exclude", -2, "-1 to"), ("exclude", 1 << 31, "-1 to"),
    ("mask", 1 << 32, "must be"), ("mask", "all", ""), ("mask", np.nan, "whole number"),
    ("mask", wp.zeros(4, dtype=wp.float32, device="cpu"), "int32"), ("exclude", wp.zeros(3, dtype=wp.int32, device="cpu"), "as the rays")])
def test_bad_filters(name, value, message):
    accel, o = structure("bvh"), np.ones((4, 3), np.float32)
    with refused(name, message):
        accel.closest_hit(o, o, world=0, **{name: value})
    with refused(name, message):
        wrt.all_hits(accel, o, o, world=0, **{name: value})


def test_structures_without_masks():
    o = np.ones((4, 3), np.float32)
    for accel in (wrt.build(icosphere(1)), wrt.build(Scene.of([icosphere(1)]))):
        with refused("mask", hint="movable=True"):
            accel.any_hit(o, o, mask=1)
    with refused("filtered", hint="movable=True"):
        wrt.ray_query("bvh", filtered=True)
    one = wrt.build(icosphere(1), movable=True)
    assert one.any_hit(o, -o).all() and not one.any_hit(o, -o, exclude=0).any() and one.bodies.numpy().tolist() == [0]


def test_shared_objects_equal_copies_in_each_world():
    (o, d), shared = rays(), Scene((Object(icosphere(3), (wrt.Material(), ), np.diag([4.0, 4.0, 0.25, 1.0]), name="terrain"),
                                    Object(icosphere(1), GREY, name="rock")))
    accel = wrt.build([*scenes(), icosphere(1)], shared=shared)
    world = np.arange(len(o)) % 4
    hits = accel.closest_hit(o, d, world=world)
    for i, own in enumerate((*(each.objects for each in scenes()), (Object(icosphere(1), GREY),))):
        alone = wrt.build(Scene(own + shared.objects), movable=True).closest_hit(o[world == i], d[world == i])
        for name in ("t", "prim_id", "object", "face", "material"):
            assert np.array_equal(getattr(hits, name)[world == i], getattr(alone, name)), name
        assert (alone.object >= len(own)).any()
    parts = accel.geometry.part[accel.geometry.worlds[1:] - 2]
    assert len(set(parts)) == 1  # stored once
    accel.masks.assign(np.where(np.arange(len(accel.masks)) == accel.geometry.worlds[1] - 2, 1, 3))
    assert not (accel.closest_hit(o, d, world=0, mask=2).object == COUNTS[0]).any()
    for bad in ([icosphere(0)], icosphere(0)):
        with refused("shared"):
            wrt.build(bad, shared=Scene((), spheres=(wrt.Sphere((0.0, 0.0, 0.0), 1.0, GREY[0]),)))
