"""Sensor.trace: images are those of closest_hit on the rays that it makes, which are the rays as arrays; depths agree with closed forms."""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import warp as wp

import wrt
from tests.kernel_tools import DEVICE, cpu_only
from tests.refused import Refusal, refused
from tests.wrt.sensors.test_sensors import SENSORS, K, a_pose, poses
from wrt.scene import shapes
from wrt.sensors import Images, Sensor, pinhole, raster_lidar, rotating_lidar

NAMES = ("t", "u", "v", "prim_id", "depth", "range", "world", "origin", "direction")
OF_SCENES = ("point", "normal", "face", "object", "instance")
SMALL = np.array([[9.0, 0.5, 3.6], [0.0, 8.0, 5.4], [0.0, 0.0, 1.0]])
SENSORS_HERE: dict[str, Callable[..., Sensor[Any]]] = {
    **SENSORS,
    "tiles": lambda pose, **options: pinhole(SMALL, (8, 12), pose, **options),
    "cameras": lambda pose, **options: pinhole(np.stack([SMALL, SMALL * 1.25 - np.diag([0.0, 0.0, 0.25])][: 1 if pose is None else 4] * 2),
                                               (8, 4), pose, **options),
}


def scene_of(seed: int, count: int) -> wrt.Scene:
    rng = np.random.default_rng(seed)
    transforms = np.tile(np.eye(4), (count, 1, 1))
    transforms[:, :3, 3] = rng.normal(0.0, 4.0, (count, 3)) + (3.0, -2.0, 5.0)
    transforms[:, :3, :3] += rng.normal(0.0, 0.3, (count, 3, 3))
    return wrt.Scene(tuple(wrt.Object(shapes.icosphere(2 - i % 2, 2.5), (wrt.Material(),), transform=each)
                           for i, each in enumerate(transforms)))


def structures() -> dict[str, Callable[[], Any]]:
    worlds = [scene_of(i, 3 + i % 2) for i in range(4)]
    return {"mesh": lambda: wrt.build(shapes.icosphere(3, 12.0)), "worlds": lambda: wrt.build(worlds),
            "bvh2": lambda: wrt.build(worlds, "bvh2"), "instances": lambda: wrt.build(scene_of(5, 5), movable=True)}


def same(images: Images, hits: Any, names: tuple[str, ...]) -> None:
    for name in names:
        assert getattr(images, name).numpy().tobytes() == getattr(hits, name).tobytes(), name


@pytest.mark.parametrize("kind", SENSORS_HERE)
@pytest.mark.parametrize("structure", structures())
def test_images_are_those_of_closest_hit(kind: str, structure: str) -> None:
    accel, sensor = structures()[structure](), SENSORS_HERE[kind](poses(4))
    scene = structure != "mesh"
    images = sensor.trace(accel, out=NAMES + OF_SCENES * scene)
    assert images.t.shape == sensor.shape and (scene or images.point is None)
    rays = images.origin.numpy(), images.direction.numpy()
    made = sensor.rays
    for mine, other in zip(rays, made, strict=True):
        longest = np.abs(other).max(axis=-1, keepdims=True)
        assert (np.abs(mine.astype(np.float64) - other) <= 2.0 * np.spacing(longest)).all()
    world = np.arange(4)[:, None, None] if structure in ("worlds", "bvh2") else None
    hits = accel.closest_hit(*rays, world=None if world is None else np.broadcast_to(world, sensor.shape))
    assert 0.02 < hits.hit.mean()
    same(images, hits, ("t", "u", "v", "prim_id", *OF_SCENES * scene))
    assert np.array_equal(images.world.numpy(), np.where(hits.hit, 0 if world is None else world, -1))
    np.testing.assert_allclose(images.depth.numpy(), sensor.depth(hits), rtol=2e-6, atol=1e-6)
    np.testing.assert_allclose(images.range.numpy(), sensor.range(hits), rtol=3e-7)


def numbers(pose: np.ndarray) -> list[float]:
    return [*pose[:3, 3], *wp.quat_from_matrix(wp.mat33f(pose[:3, :3]))]


@pytest.mark.parametrize("form", [
    lambda poses: wp.array([numbers(each) for each in poses], dtype=wp.transformf, device=DEVICE),
    lambda poses: wp.array([numbers(each) for each in poses], dtype=wp.float32, device=DEVICE),
    lambda poses: wp.array(poses, dtype=wp.mat44f, device=DEVICE),
    lambda poses: wp.array(poses[:, :3], dtype=wp.float64, device=DEVICE),
    lambda poses: poses,
])
def test_poses_have_each_form_of_a_move(form: Callable[[np.ndarray], Any]) -> None:
    accel, sensor = structures()["mesh"](), pinhole(SMALL, (8, 12))
    expected = pinhole(SMALL, (8, 12), poses(3)).trace(accel, out=("origin", "direction", "depth"))
    images = sensor.trace(accel, form(poses(3)), out=("origin", "direction", "depth"))
    for name in ("origin", "direction", "depth"):
        np.testing.assert_allclose(getattr(images, name).numpy(), getattr(expected, name).numpy(), rtol=1e-5, atol=2e-6)
    one = sensor.trace(accel, a_pose(1))
    assert one.depth.shape == (12, 8) and one.depth.numpy().tobytes() == expected.depth.numpy()[1].tobytes()


def test_a_wall_that_moves_while_a_lidar_turns() -> None:
    """Each column of a turn has its own pose and its own world: ranges by a closed form in float64."""
    steps, elevations = 32, np.array([-0.2, 0.0, 0.3, 0.4])
    wall = wrt.Object(shapes.quad((0.0, -50.0, -50.0), (0.0, 100.0, 0.0), (0.0, 0.0, 100.0)), (wrt.Material(),))
    accel, walls = wrt.build([wrt.Scene((wall,))] * steps, movable=True), np.tile(np.eye(4), (steps, 1, 1))
    walls[:, 0, 3] = np.linspace(5.0, 9.0, steps)
    accel.move(wp.array(walls, dtype=wp.mat44f, device=DEVICE))
    frames = np.tile(np.eye(4), (steps, 1, 1))
    frames[:, 0, 3] = np.linspace(0.0, 3.0, steps)
    azimuths = -0.5 + np.arange(steps) / steps
    lidar = rotating_lidar(elevations, steps, start=-0.5, turn=1.0, pose=frames, rolling=True)
    expected = (walls[:, 0, 3] - frames[:, 0, 3]) / (np.cos(azimuths) * np.cos(elevations)[:, None])
    for world in (None, np.arange(steps), wp.array(np.arange(steps), dtype=wp.int32, device=DEVICE)):
        images = lidar.trace(accel, out=("range", "depth", "point"), world=world)
        np.testing.assert_allclose(images.range.numpy(), expected, rtol=1e-6)
        np.testing.assert_allclose(images.depth.numpy(), np.broadcast_to(walls[:, 0, 3] - frames[:, 0, 3], expected.shape), rtol=1e-6)
        np.testing.assert_allclose(images.point.numpy()[..., 0], np.broadcast_to(walls[:, 0, 3], expected.shape), rtol=1e-6)
    backwards = lidar.trace(accel, out="range", world=np.arange(steps)[::-1].copy()).range.numpy()
    np.testing.assert_allclose(backwards * (np.cos(azimuths) * np.cos(elevations)[:, None]),
                               np.broadcast_to(walls[::-1, 0, 3] - frames[:, 0, 3], backwards.shape), rtol=1e-6)
    turns = lidar.trace(accel, np.stack([frames, frames]), out="range", world=[3, 4]).range.numpy()
    np.testing.assert_allclose(turns[1], (walls[4, 0, 3] - frames[:, 0, 3]) / (np.cos(azimuths) * np.cos(elevations)[:, None]), rtol=1e-6)


def test_images_follow_moves_in_place() -> None:
    accel = wrt.build([scene_of(i, 3 + i % 2) for i in range(4)])
    sensor, rng, bodies = pinhole(SMALL, (8, 12), poses(4)), np.random.default_rng(0), accel.geometry.to_world.shape[0]
    out = sensor.trace(accel, out=NAMES + OF_SCENES)
    for turn in range(3):
        matrices = np.tile(np.eye(4, dtype=np.float32), (bodies, 1, 1))
        matrices[:, :3, 3] = rng.normal(0.0, 4.0, (bodies, 3)) + (3.0, -2.0, 5.0)
        matrices[:, :3, :3] += rng.normal(0.0, 0.3, (bodies, 3, 3)) - turn * np.diag([1.5, 0.0, 0.0])  # mirrored at last
        accel.move(wp.array(matrices, dtype=wp.mat44f, device=DEVICE))
        assert sensor.trace(accel, out=out) is out
        still = wrt.build([scene_of(i, 3 + i % 2) for i in range(4)])
        still.move(matrices.astype(np.float64))
        world = np.broadcast_to(np.arange(4)[:, None, None], sensor.shape)
        for each in (accel, still):
            hits = each.closest_hit(out.origin.numpy(), out.direction.numpy(), world=world)
            same(out, hits, ("t", "prim_id", *OF_SCENES))


def test_bad_poses_and_worlds_miss_and_rays_end() -> None:
    accel, sensor = wrt.build([wrt.Scene.of([shapes.icosphere(2, 8.0)])] * 3), pinhole(SMALL, (8, 12))
    frames = np.tile(np.eye(4), (3, 1, 1))
    frames[1, 0, 3] = np.nan
    frames[2, :3, :3] = np.inf
    images = sensor.trace(accel, wp.array(frames, dtype=wp.mat44f, device=DEVICE), out=("depth", "object", "point"))
    hit = images.object.numpy() >= 0
    assert hit[0].all() and not hit[1:].any() and np.isposinf(images.depth.numpy()[1:]).all() and np.isnan(images.point.numpy()[1:]).all()
    ids = wp.array([0, -7, 3], dtype=wp.int32, device=DEVICE)
    hit = sensor.trace(accel, np.tile(np.eye(4), (3, 1, 1)), out="prim_id", world=ids).prim_id.numpy() >= 0
    assert hit[0].all() and not hit[1:].any()
    deep = sensor.trace(accel, np.eye(4)[None], world=1).depth.numpy()
    some = sensor.trace(accel, np.eye(4)[None], world=1, t_max=7.0).depth.numpy()
    assert np.array_equal(some, np.where(deep <= 7.0, deep, np.inf)) and np.isinf(some).any() and np.isfinite(some).any()
    assert sensor.trace(accel, wp.empty(0, dtype=wp.transformf, device=DEVICE), world=1).depth.shape == (0, 12, 8)
    far = np.array([3e6, -2e6, 1e6])
    ball = shapes.icosphere(2, 8.0)
    there = wrt.build(wrt.Mesh(ball.vertices.astype(np.float64) + far, ball.faces))
    frames = np.eye(4)
    frames[:3, 3] = far
    assert np.array_equal(sensor.trace(there, frames).depth.numpy(), sensor.trace(wrt.build(ball), np.eye(4)).depth.numpy())


BALLS = [wrt.Scene.of([shapes.icosphere(1)])] * 2


@pytest.mark.parametrize(("arguments", "said"), [
    (lambda: {"poses": wp.zeros(3, dtype=wp.vec3, device=DEVICE)}, ("poses", "(B,) of transformf or mat44f")),
    (lambda: {"poses": wp.zeros((2, 2), dtype=wp.transformf, device=DEVICE)}, ("poses", "(B,) of transformf or mat44f")),
    (lambda: {"poses": wp.zeros((4, 7), dtype=wp.float32, device=DEVICE)[::2]}, ("poses", "must be contiguous")),
    (lambda: {"poses": 2.0 * np.eye(4)}, ("pose", "must be affine")),
    (lambda: {"poses": np.zeros((2, 2, 4, 4)) + np.eye(4)}, ("poses", "(B,) of transformf or mat44f")),
    (lambda: {"out": "colour"}, ("out", "must be Images, or some of depth, range")),
    (lambda: {"out": Images(depth=np.zeros((2, 4, 4), np.float32))}, ("out.depth", "must be a Warp array (2, 4, 4) of float32")),
    (lambda: {"out": Images(object=wp.zeros((2, 4, 4), dtype=wp.float32, device=DEVICE))}, ("out.object", "(2, 4, 4) of int32")),
    (lambda: {"out": Images(depth=wp.zeros((1, 4, 4), dtype=wp.float32, device=DEVICE))}, ("out.depth", "(2, 4, 4) of float32")),
    (lambda: {"world": [0, 2]}, ("world", "must be 0 to 1")),
    (lambda: {"world": [0.0, 1.0]}, ("world", "must be 0 to 1")),
    (lambda: {"world": [0, 1, 0]}, ("world", "must be one, or 2, one for each image")),
    (lambda: {"world": wp.zeros(2, dtype=wp.int64, device=DEVICE)}, ("world", "must be one, or 2, one for each image: int32")),
    (lambda: {"poses": np.tile(np.eye(4), (3, 1, 1))}, ("world", "must be one, or 3, one for each image")),
    (lambda: {"t_max": float("nan")}, ("t_max", "must be finite")),
])
def test_what_is_refused(arguments: Callable[[], dict[str, Any]], said: Refusal) -> None:
    given = {"poses": np.tile(np.eye(4), (2, 1, 1)), **arguments()}
    with refused(*said):
        pinhole(np.diag([4.0, 4.0, 1.0]), (4, 4)).trace(wrt.build(BALLS), **given)


def test_what_a_structure_lacks_is_refused() -> None:
    sensor, ball = raster_lidar((1.0, 1.0), (4, 4)), shapes.icosphere(1)
    with refused("world", "is for structures over worlds"):
        sensor.trace(wrt.build(ball), world=0)
    with refused(None, "hits have no object, because the structure is not over a scene"):
        sensor.trace(wrt.build(ball), out="object")
    with refused("out", "not within float32"):
        sensor.trace(wrt.build(wrt.Mesh(ball.vertices.astype(np.float64) + 1e7, ball.faces)), out="point")
    with refused("poses", "must be one, or 2, one for each camera, got 3"):
        pinhole(np.stack([K, K]), (4, 4)).trace(wrt.build(ball), np.tile(np.eye(4), (3, 1, 1)))


@cpu_only
def test_a_graph_of_the_cpu_traces_the_present_poses() -> None:
    accel, sensor = wrt.build([scene_of(i, 3) for i in range(4)]), raster_lidar((1.0, 1.0), (64, 64))
    ids = wp.array([0, 1, 2, 3, 1], dtype=wp.int32, device=DEVICE)
    frames, now = wp.array(poses(5), dtype=wp.mat44f, device=DEVICE), wp.zeros(5, dtype=wp.mat44f, device=DEVICE)
    out = sensor.trace(accel, now, out=("t", "prim_id", "depth", "object", "point"), world=ids)
    with wp.ScopedCapture(DEVICE) as capture:
        sensor.trace(accel, now, out=out, world=ids)
    for turn in (frames, wp.array(poses(5)[::-1], dtype=wp.mat44f, device=DEVICE)):
        wp.copy(now, turn)
        wp.capture_launch(capture.graph)
        eager = sensor.trace(accel, turn, out=("t", "prim_id", "depth", "object", "point"), world=ids)
        assert (eager.prim_id.numpy() >= 0).mean() > 0.05
        same(out, SimpleNamespace(**{name: array.numpy() for name, array in vars(eager).items() if array is not None}),
             ("t", "prim_id", "depth", "object", "point"))
