"""Every answer of a query has the id of a face within its mesh, beside prim_id, which counts on over the meshes of a scene."""

from __future__ import annotations

import copy
import pickle
from typing import Any

import numpy as np
import pytest
import warp as wp

import wrt
from tests.refused import refused
from wrt.scene import shapes

MESHES = [shapes.icosphere(1), shapes.box((2, -1, -1), (4, 1, 1)), shapes.torus(1.0, 0.4, 12, 8), shapes.icosphere(2)]
RNG = np.random.default_rng(5)
RAYS = np.concatenate([RNG.uniform(-2, 4, (400, 3)), RNG.normal(size=(400, 3))], axis=1).astype(np.float32)


def scenes() -> list[wrt.Scene]:
    """Return a scene that uses a mesh twice, and one with a moved and mirrored object and two spheres."""
    turned = np.diag([-1.0, 1.0, 2.0, 1.0])
    turned[:3, 3] = 3.0, 1.0, 0.0
    grey = (wrt.Material(),)
    balls = tuple(wrt.Sphere((x, 2.0, 0.0), 1.0, grey[0]) for x in (0.0, 3.0))
    places = np.eye(4), turned, turned, np.eye(4)
    objects = tuple(wrt.Object(mesh, grey, place) for mesh, place in zip(MESHES, places, strict=True))
    return [wrt.Scene.of([MESHES[0], MESHES[1], MESHES[0], MESHES[2]]), wrt.Scene(objects, balls)]


def expected(scene: wrt.Scene, prim_id: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return face and object of prim_ids, from lists of all ids in order."""
    counts = [len(thing.mesh.faces) for thing in scene.objects]
    faces = [*(i for n in counts for i in range(n)), *(-1 for _ in scene.spheres), -1]
    objects = [*(k for k, n in enumerate(counts) for _ in range(n)), *(len(counts) + i for i in range(len(scene.spheres))), -1]
    return np.array(faces)[prim_id], np.array(objects)[prim_id]


def answers(accel: Any, scene: wrt.Scene, **world: Any) -> list[Any]:
    found = [accel.closest_hit(RAYS, **world)]
    if not scene.spheres:
        found += [wrt.all_hits(accel, RAYS, **world), wrt.first_hits(accel, 3, RAYS, **world),
                  wrt.first_hits(accel, 2, RAYS.reshape(20, 20, 6), crossings=True, **world),
                  wrt.closest_points(accel, RAYS[:, :3].reshape(20, 20, 3), **world), accel.closest_hit(RAYS, **world)[5:90]]
    return found


@pytest.mark.parametrize("number", [0, 1])
def test_ids_over_a_scene_and_instances(number: int) -> None:
    scene = scenes()[number]
    for accel in (wrt.build(scene), *(() if scene.spheres else (wrt.build(scene, movable=True),))):
        for found in answers(accel, scene):
            face, thing = expected(scene, found.prim_id)
            assert np.array_equal(found.face, face) and np.array_equal(found.object, thing) and found.face.dtype == np.int32
            assert len(np.unique(found.object)) > 2


def test_ids_over_one_mesh_are_prim_ids() -> None:
    for found in answers(wrt.build(MESHES[3]), wrt.Scene.of(MESHES[3:])):
        assert np.array_equal(found.face, found.prim_id) and (found.face >= 0).any()
    warp = wrt.build(MESHES[3]).closest_hit(wp.array(RAYS[:, :3], dtype=wp.vec3), wp.array(RAYS[:, 3:], dtype=wp.vec3))
    assert isinstance(warp.face, wp.array) and np.array_equal(warp.face.numpy(), warp.prim_id.numpy())


@pytest.mark.parametrize("which", [0, 1, 2])
def test_ids_over_worlds(which: int) -> None:
    worlds: list[Any] = [scenes()[0], MESHES[1], wrt.Scene.of([MESHES[3], MESHES[2]])]
    scene = worlds[which] if isinstance(worlds[which], wrt.Scene) else wrt.Scene.of([worlds[which]])
    accel = wrt.build(worlds)
    for found in answers(accel, scene, world=which):
        face, thing = expected(scene, found.prim_id)
        assert np.array_equal(found.face, face) and np.array_equal(found.object, thing) and (face >= 0).any()
    mixed = wrt.all_hits(accel, RAYS, world=np.arange(len(RAYS)) % 3)
    rows = mixed.ray_id % 3 == which
    assert np.array_equal(mixed.face[rows], expected(scene, mixed.prim_id[rows])[0]) and rows.any()


def test_answers_without_points_say_so_and_copies_lose_their_ids() -> None:
    accel = wrt.build(scenes()[0])
    first = wrt.first_hits(accel, 2, RAYS)
    for name in ("point", "normal", "distance"):
        with refused(None, "lists of hits have ids alone"):
            getattr(first, name)
    for found in answers(accel, scenes()[0]):
        for other in (copy.copy(found), pickle.loads(pickle.dumps(found))):
            assert type(other) is type(found) and np.array_equal(other.prim_id, found.prim_id)
            with refused(None, "copies and pickled"):
                _ = other.face
