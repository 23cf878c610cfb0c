"""Flat scenes with instances have the same primitives, materials and corners as when all meshes are copied."""

from __future__ import annotations

import numpy as np
import pytest

from wrt.accel.flat_scene import FlatScene
from wrt.accel.scenes.flatten import flatten, flatten_instanced, flatten_joined
from wrt.accel.scenes.instancing import INSTANCING, MIN_SAVED, instanced_meshes
from wrt.scene.materials import Material
from wrt.scene.mesh import Mesh
from wrt.scene.model import Object, Scene, Sphere
from wrt.scene.shapes import box, icosphere, quad, torus

RED, GREEN, BLUE, GREY = (Material(name=name) for name in ("red", "green", "blue", "grey"))


def placed(scale: float, *move: float) -> np.ndarray:
    matrix = np.diag([scale, scale, -scale, 1.0])
    matrix[:3, 3] = move
    return matrix


def mixed_scene() -> Scene:
    """Return a scene with spheres, copied objects, and instances: with one material, with materials by face, and mirrored."""
    ball, ring, cube = icosphere(1), torus(segments=6, tube_segments=4), box()
    which = (np.arange(len(ball.faces)) % 3).astype(np.int32)
    squashed = np.diag([1.0, 1.0, 0.0, 1.0])
    return Scene(
        objects=(
            Object(cube, (GREY,)), Object(ball, (RED,), placed(2.0, 1.0, 2.0, 3.0)), Object(quad(), (BLUE,)),
            Object(cube, (GREEN,)),
            Object(ball, (GREEN, BLUE, RED), placed(-0.5, 9.0, 0.0, 0.0), which), Object(ring, (RED,), placed(3.0, 0.0, -4.0, 0.0)),
            Object(ball, (GREEN, BLUE, RED), np.eye(4), which), Object(ball, (RED,), squashed), Object(ring, (BLUE,)),
        ),
        spheres=(Sphere((0.0, 0.0, 0.0), 1.0, GREEN), Sphere((5.0, 0.0, 0.0), 2.0, GREY)),
    )


def test_the_same_primitives_as_when_all_is_copied() -> None:
    scene = mixed_scene()
    shared = frozenset((id(scene.objects[1].mesh), id(scene.objects[5].mesh)))
    flat, world = flatten_joined(scene), flatten_instanced(scene, shared)
    assert world.geometry.n_triangles == flat.geometry.n_triangles and len(world.geometry) == len(flat.geometry)
    prim_id = np.arange(len(flat.geometry))
    np.testing.assert_array_equal(world.materials(prim_id), flat.prim_material)
    np.testing.assert_array_equal(world.geometry.spheres, flat.geometry.spheres)
    # Copies of mirrored objects have reversed faces: the same corners in another order.
    corners = [np.sort(w.corners(prim_id[:flat.geometry.n_triangles]), axis=1) for w in (flat, world)]
    np.testing.assert_allclose(corners[1], corners[0], atol=1e-5)
    # Each instanced mesh once, and the copies: two boxes, the quad and the squashed ball.
    parts = [len(part.faces) for part in world.geometry.parts]
    assert parts == [2 * 12 + 2 + 80, 80, 48] and len(world.faces) == sum(parts)
    assert world.geometry.part.tolist() == [0, 1, 1, 2, 1, 2]


def test_the_rule_counts_what_copies_would_take() -> None:
    big, small = icosphere(6), icosphere(1)
    assert len(big.faces) < MIN_SAVED
    uses = MIN_SAVED // len(big.faces) + 2
    objects = tuple(Object(mesh, (RED,), placed(1.0, i, 0.0, 0.0)) for mesh in (big, small) for i in range(uses))
    assert instanced_meshes(Scene(objects)) == {id(big)}
    assert instanced_meshes(Scene(objects[2:])) == frozenset()
    assert instanced_meshes(Scene(objects), "always") == {id(big), id(small)}
    assert instanced_meshes(Scene(objects[:1]), "always") == instanced_meshes(Scene(objects), "never") == frozenset()
    with pytest.raises(ValueError, match="instancing must be one of " + ", ".join(INSTANCING)):
        instanced_meshes(Scene(objects), "sometimes")


def shared_world(scene: Scene) -> FlatScene:
    return flatten(scene, instanced_meshes(scene, "always"))


def test_objects_that_cannot_be_instances_are_copied() -> None:
    """A shear by 1e5 and two flattening matrices would make the rounding errors of rays too large."""
    ball, shear, flat = icosphere(1), np.eye(4), np.diag([1.0, 0.0, 1.0, 1.0])
    shear[0, 1] = 1e5
    objects = tuple(Object(ball, (RED,), matrix) for matrix in (np.eye(4), shear, flat, flat, placed(1e-9, 0.0, 0.0, 0.0)))
    world = shared_world(Scene(objects))
    assert world.geometry.part.tolist() == [0, 1, 1] and len(world.geometry.parts[0]) == 3 * 80
    assert shared_world(Scene(objects[1:4])).placed is None


def test_corners_on_a_line_are_parted_in_a_mesh_of_its_own_space_too() -> None:
    """A face without area between two faces is flipped, as in flatten_joined, with its material."""
    corners = np.array([[0, 0, 0], [2, 0, 0], [1, 0, 0], [1, 1, 0], [1, -1, 0]], np.float32)
    mesh = Mesh(corners, np.array([[0, 2, 1], [0, 1, 3], [0, 4, 2], [2, 4, 1]], np.int32))
    which = np.array([0, 1, 2, 2], np.int32)
    turned = np.array([[0.0, 1.0, 0.0, 5.0], [1.0, 0.0, 0.0, 0.0], [0.0, 0.0, -1.0, 0.0], [0.0, 0.0, 0.0, 1.0]])
    scene = Scene(tuple(Object(mesh, (RED, GREEN, BLUE), matrix, which) for matrix in (np.eye(4), turned)))
    flat, world = flatten_joined(scene), shared_world(scene)
    assert world.placed is not None
    prim_id = np.arange(8)
    np.testing.assert_array_equal(world.materials(prim_id), flat.materials(prim_id))
    np.testing.assert_array_equal(np.sort(world.corners(prim_id), axis=1), np.sort(flat.corners(prim_id), axis=1))
    assert (np.linalg.norm(np.cross(*np.diff(world.corners(prim_id), axis=1).transpose(1, 0, 2)), axis=1) > 0.0).all()
