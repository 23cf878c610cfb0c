"""Which shadow rays can meet what light passes through: the boxes that say so, and the test in lanes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.kernel_tools import DEVICE, directions, launch, vec3s, zeros  # isort: skip (starts Warp)
import warp as wp

from wrt.accel.build import build
from wrt.accel.flatten import world_of
from wrt.accel.geometry import Geometry
from wrt.accel.instancing import instanced_meshes
from wrt.core.device import upload
from wrt.kernels.shade.clear import BOXES, may_pass
from wrt.kernels.shade.shadows import is_opaque
from wrt.kernels.structs import Lighting, Ray, kernel
from wrt.kernels.structs import Material as MaterialRecord
from wrt.kernels.units.box import box_ray, ray_aabb
from wrt.renderer.clear_boxes import clear_boxes, lets_through
from wrt.renderer.upload import TextureTable, material_records, upload_scene
from wrt.scene.materials import Material
from wrt.scene.model import Object, Scene, Sphere
from wrt.scene.shapes import icosphere, quad


@kernel
def pass_kernel(lighting: Lighting, origin: wp.array(dtype=wp.vec3), direction: wp.array(dtype=wp.vec3), t_max: float,
                found: wp.array(dtype=int), expected: wp.array(dtype=int)):
    i = wp.tid()
    ray = Ray()
    ray.origin = origin[i]
    ray.direction = direction[i]
    ray.t_max = t_max
    if may_pass(lighting, ray):
        found[i] = 1
    for k in range(lighting.clear.shape[0] / 6):
        boxes = lighting.clear
        lo = wp.vec3(boxes[k], boxes[BOXES + k], boxes[2 * BOXES + k])
        hi = wp.vec3(boxes[3 * BOXES + k], boxes[4 * BOXES + k], boxes[5 * BOXES + k])
        if ray_aabb(box_ray(ray), lo, hi, ray.t_max) < wp.inf:
            expected[i] = 1


def asked(lighting, origins, directions, t_max=float("inf")):
    """Whether each ray may pass, and whether the box unit says so of any box."""
    found, expected = zeros(len(origins), wp.int32), zeros(len(origins), wp.int32)
    launch(pass_kernel, len(origins), lighting, vec3s(origins), vec3s(directions), t_max, found, expected)
    return found.numpy() != 0, expected.numpy() != 0


@kernel
def opaque_kernel(materials: wp.array(dtype=MaterialRecord), opaque: wp.array(dtype=int)):
    i = wp.tid()
    opaque[i] = wp.where(is_opaque(materials[i]), 1, 0)


GLASS, WALL = Material("glass", ior=1.5), Material(albedo=(0.5, 0.5, 0.5))
PANE = Material(albedo=(0.5, 0.5, 0.5), alpha=0.5, alpha_mode="blend")


WINDOW = Material("metallic_roughness", transmission=0.5, alpha_mode="mask", alpha_cutoff=0.3)


def room(things, spheres=(), scale=1.0):
    """A wide floor, and what stands on it."""
    floor = quad((-50 * scale, 0, -50 * scale), (100 * scale, 0, 0), (0, 0, 100 * scale))
    return Scene(objects=(Object(floor, (WALL,)), *things), spheres=tuple(spheres))


def ball(center, radius, material):
    transform = np.diag([radius, radius, radius, 1.0])
    transform[:3, 3] = center
    return Object(icosphere(3), (material,), transform=transform)


def some_glass(rng, scale=1.0, n=30):
    """Balls, upright and lying panes, and a sphere."""
    places, sizes = scale * rng.uniform(-20, 20, (n, 3)), scale * rng.uniform(0.1, 2.0, n)
    materials = [GLASS, PANE, WALL, WINDOW]
    balls = [ball(places[i], sizes[i], materials[i % 4]) for i in range(n)]
    s = 2.0 * scale
    panes = [Object(quad(scale * rng.integers(-20, 20, 3), *edges), (PANE,)) for edges in (
        ((s, 0, 0), (0, s, 0)), ((0, s, 0), (0, 0, s)), ((0, 0, s), (s, 0, 0))) * 3]
    return room([*balls, *panes], [Sphere((3.0 * scale, 30.0 * scale, scale), 2.0 * scale, GLASS)], scale)


def is_clear(scene):
    return np.array([lets_through(material) for material in scene.materials])


def world_and_lighting(scene, instancing="auto"):
    """On the device of the tests; wrt.renderer.clear_boxes puts them on the CPU alone."""
    on_device = upload_scene(scene, DEVICE, instanced_meshes(scene, instancing))
    boxes = clear_boxes(on_device.world, is_clear(scene))
    on_device.lighting.clear = upload(boxes.ravel(), wp.float32, DEVICE)
    return on_device.world, on_device.lighting


def boxes_of(scene, instancing="auto"):
    return clear_boxes(world_of(scene, instanced_meshes(scene, instancing)), is_clear(scene))


@pytest.mark.parametrize("scale", [1.0, 2.0**-40, 2.0**40])
def test_no_ray_that_meets_glass_is_left_out(scale):
    """Rays towards points of clear triangles, from everywhere, also along axes and within faces, and segments that end there;
    others are mostly left out."""
    rng = np.random.default_rng(1)
    scene = some_glass(rng, scale)
    world, lighting = world_and_lighting(scene)
    prim_id = np.flatnonzero(is_clear(scene)[world.prim_material])
    faces = prim_id[prim_id < len(world.faces)]
    part = Geometry(world.vertices, world.faces[faces], world.geometry.spheres)
    assert 0 < len(faces) < len(world.faces) and len(part.spheres) == 1
    glass = build(part, device=str(DEVICE))
    n = 40_000
    corners = world.vertices[world.faces[rng.choice(faces, n)]].astype(np.float64)
    weights = rng.dirichlet(np.full(3, 0.3), n)
    weights[: n // 4] = np.eye(3)[rng.integers(0, 3, n // 4)]
    target = np.einsum("ni,nij->nj", weights, corners)
    near = target + scale * 1e-3 * rng.normal(size=(n, 3))
    origins = np.where(rng.random((n, 1)) < 0.5, scale * rng.uniform(-60, 60, (n, 3)), near)
    along = rng.random((n, 3)) < 0.2  # components in which they stay where they are
    along[along.all(axis=1)] = False
    origins = np.where(along, target, origins).astype(np.float32)
    for longer in (1.0, rng.uniform(0.5, 4.0, (n, 1))):
        towards = (longer * (target - origins)).astype(np.float32)
        towards[~towards.any(axis=1)] = scale
        for t_max in (np.inf, 1.0):
            found, expected = asked(lighting, origins, towards, t_max)
            hit = glass.any_hit(origins, towards, 0.0, t_max)
            assert np.array_equal(found, expected) and (found >= hit).all() and hit.mean() > 0.2
    everywhere = (scale * rng.uniform(-60, 60, (n, 3))).astype(np.float32), directions(rng, n).astype(np.float32)
    found, expected = asked(lighting, *everywhere)
    assert np.array_equal(found, expected) and (found >= glass.any_hit(*everywhere)).all() and 0.0 < found.mean() < 0.5


def test_boxes_that_end_before_the_ray_begins_and_segments():
    _, lighting = world_and_lighting(some_glass(np.random.default_rng(2)))
    rng = np.random.default_rng(3)
    for t_max in (0.0, 1e-3, 0.1, 1.0, 10.0):
        rays = rng.uniform(-30, 30, (5000, 3)), rng.normal(size=(5000, 3))
        found, expected = asked(lighting, *rays, t_max)
        assert np.array_equal(found, expected) and found.any() and not found.all()


def test_few_things_share_no_box():
    boxes = boxes_of(room([ball((0, 1, 0), 1.0, GLASS)], [Sphere((10.0, 3.0, 0.0), 2.0, GLASS)]))
    low, high = boxes[:3], boxes[3:]
    used = np.isfinite(boxes).all(axis=0)
    assert boxes.shape == (6, BOXES) and 2 <= used.sum() <= BOXES
    assert (low[:, ~used] == np.inf).all() and (high[:, ~used] == -np.inf).all()
    np.testing.assert_allclose(low[:, used].min(axis=1), [-1, 0, -2], atol=2e-2)
    np.testing.assert_allclose(high[:, used].max(axis=1), [12, 5, 2], atol=2e-2)
    assert ((high - low)[:, used].max(axis=0) <= 4.01).all()


@pytest.mark.parametrize("scene", [
    room([]), room([ball((0, 1, 0), 1.0, WALL)]),
    Scene(objects=(Object(icosphere(2), (GLASS,)),)), Scene(spheres=(Sphere((0.0, 0.0, 0.0), 1.0, GLASS),)),
], ids=["nothing", "nothing clear", "all of it", "all of it, a sphere"])
def test_nothing_is_said_where_it_would_not_pay(scene):
    assert boxes_of(scene).shape == (6, 0)
    found, _ = asked(world_and_lighting(scene)[1], np.zeros((3, 3)) + 100.0, np.ones((3, 3)))
    assert found.all()


def test_glass_among_opaque_spheres():
    """Which are part of the scene, too."""
    walls = [Sphere((x, 0.0, z), 1.0, WALL) for x in (-30.0, 0.0, 30.0) for z in (-30.0, 30.0)]
    assert boxes_of(Scene(spheres=(*walls, Sphere((0.0, 0.0, 0.0), 1.0, GLASS)))).shape == (6, BOXES)


def test_nothing_is_said_of_instances():
    mesh = icosphere(1)
    things = [Object(mesh, (GLASS,), transform=np.diag([0.1, 0.1, 0.1, 1.0])) for _ in range(2)]
    assert boxes_of(room(things)).shape == (6, BOXES) and boxes_of(room(things), "always").shape == (6, 0)


def test_many_that_are_all_in_one_place():
    """They cannot be halved; others still are."""
    pane = quad((9, 9, 9), (0, 0, 1), (0, 1, 0))
    boxes = boxes_of(room([ball((0, 1, 0), 1.0, GLASS)] * 2 + [Object(pane, (PANE,))] * 40))
    used = np.isfinite(boxes).all(axis=0)
    on_pane = used & (boxes[0] > 8.0)
    assert used.sum() == BOXES and on_pane.any() and (boxes[3, used & ~on_pane] < 2.0).all()


def test_what_lets_light_through_is_not_opaque():
    """As the device has it (kernels.shade.shadows.is_opaque)."""
    materials = [GLASS, WALL, PANE, WINDOW, replace(WINDOW, transmission=0.0), replace(GLASS, thin=True), Material("mirror"),
                 Material("conductor"), replace(WALL, alpha_mode="mask")]
    records = upload(material_records(tuple(materials), TextureTable()), MaterialRecord, DEVICE)
    opaque = zeros(len(materials), wp.int32)
    launch(opaque_kernel, len(materials), records, opaque)
    assert [lets_through(m) for m in materials] == [value == 0 for value in opaque.numpy()]
