"""Graphs: each public call is refused by its name while a graph is captured on the CPU, and changes nothing; own kernels are captured."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
import warp as wp

import wrt
from tests.kernel_tools import DEVICE
from wrt.compat.trimesh import RayMeshIntersector
from wrt.scene.shapes import icosphere

N = 100
BALL = icosphere(2)
RAYS = np.random.default_rng(0).normal(size=(2, N, 3)).astype(np.float32) * [[[0.1]], [[1.0]]]
POSE = np.eye(4)
K = np.array([[8.0, 0.0, 4.0], [0.0, 8.0, 4.0], [0.0, 0.0, 1.0]])


class Things:
    """What the calls need, made before the capture."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.rays = RAYS.astype(np.float32)
        self.warp = [wp.array(each, dtype=wp.vec3, device=DEVICE) for each in self.rays]
        self.accel = wrt.build(wrt.Scene.of([BALL]))
        self.bvh2 = wrt.build(BALL, "bvh2")
        self.larger = wp.array(2.0 * BALL.vertices, dtype=wp.vec3, device=DEVICE)
        self.bvh2.refit(wp.array(BALL.vertices, dtype=wp.vec3, device=DEVICE), in_place=True)
        self.instances = wrt.build(wrt.Scene.of([BALL, BALL]), movable=True)
        self.hits = self.accel.closest_hit(*self.warp)
        self.hits_of_instances = self.instances.closest_hit(*self.warp)
        self.hits_on_host = self.accel.closest_hit(*self.rays)
        self.hits_of_mesh = self.bvh2.closest_hit(*self.warp)
        self.out = self.accel.closest_hit(*self.warp)
        self.sensor = wrt.sensors.pinhole(K, (8, 8), POSE)
        self.seen = self.accel.closest_hit(*(wp.array(each, dtype=wp.vec3, device=DEVICE)
                                             for each in (self.sensor.origins, self.sensor.directions)))
        self.pixels = wp.array(np.ones((3, 2)), dtype=wp.vec2d, device=DEVICE)
        self.points = wp.array(np.ones((3, 3)), dtype=wp.vec3, device=DEVICE)
        self.pose = wp.array(POSE[None], dtype=wp.mat44, device=DEVICE)
        self.ranges = wp.array(np.ones(N), dtype=wp.float32, device=DEVICE)
        self.indices = wp.array(BALL.faces.reshape(-1), dtype=wp.int32, device=DEVICE)
        self.far = wp.array(np.ones(64), dtype=wp.float32, device=DEVICE)
        self.wp_mesh = wp.Mesh(wp.array(BALL.vertices, dtype=wp.vec3, device="cpu"),  # a virtual GPU has no wp.Mesh
                               wp.array(BALL.faces.reshape(-1), dtype=wp.int32, device="cpu"))
        self.file, self.scene = folder / "ball.accel", folder / "scene.toml"
        self.bvh2.save(self.file)
        self.tree = self.bvh2.tree()

    def state(self) -> list[bytes]:
        """Return the bytes of what all structures answer, and of the arrays that calls got."""
        answers = [accel.closest_hit(*self.rays) for accel in (self.accel, self.bvh2, self.instances)]
        return [np.asarray(getattr(hits, name)).tobytes() for hits in (*answers, self.out.numpy(), self.hits_of_mesh.numpy())
                for name in ("t", "u", "v", "prim_id")]


Call = Callable[["Things"], Any]
OF_HITS = ("distance", "face", "hit", "instance", "material", "normal", "normals", "object", "point", "point_error", "points",
           "shading_normal")
FUNCTIONS: dict[str, Call] = {
    "build": lambda s: wrt.build(BALL),
    "load_accel": lambda s: wrt.load_accel(s.file, BALL),
    "accel_from_tree": lambda s: wrt.accel_from_tree(BALL, s.tree),
    "DeviceGeometry": lambda s: wrt.DeviceGeometry(s.larger, s.indices),
    "closest_points": lambda s: wrt.closest_points(s.accel, s.rays[0]),
    "signed_distance": lambda s: wrt.signed_distance(s.accel, s.rays[0]),
    "contains": lambda s: wrt.contains(s.accel, s.rays[0]),
    "winding_number": lambda s: wrt.winding_number(s.accel, s.rays[0]),
    "all_hits": lambda s: wrt.all_hits(s.accel, *s.rays),
    "count_hits": lambda s: wrt.count_hits(s.accel, *s.rays),
    "first_hits": lambda s: wrt.first_hits(s.accel, 2, *s.rays),
    "visible": lambda s: wrt.visible(s.accel, *s.warp),
    "profile": lambda s: wrt.profile(wrt.Scene.of([BALL]), size=(8, 8)),
    "inspect": lambda s: wrt.inspect(wrt.Scene.of([BALL]), (1, 1), size=(8, 8)),
    "render": lambda s: wrt.render(wrt.Scene.of([BALL]), size=(8, 8), spp=1),
    "trace": lambda s: wrt.trace(s.accel, *s.rays),
    "walk": lambda s: wrt.walk(s.bvh2, s.rays[0][0], s.rays[1][0]),
    "camera_rays": lambda s: wrt.camera_rays(wrt.Camera(), (8, 8)),
}
METHODS: dict[str, Call] = {
    "OneMesh.closest_hit": lambda s: s.accel.closest_hit(*s.warp, out=s.out),
    "OneMesh.any_hit": lambda s: s.accel.any_hit(*s.rays),
    "OneMesh.refit": lambda s: s.bvh2.refit(s.larger),
    "OneMesh.save": lambda s: s.bvh2.save(s.folder / "new.accel"),
    "OneMesh.snapshot": lambda s: s.bvh2.snapshot,
    "Instances.closest_hit": lambda s: s.instances.closest_hit(*s.warp),
    "Instances.any_hit": lambda s: s.instances.any_hit(*s.warp),
    "Instances.move": lambda s: s.instances.move(0, np.diag([2.0, 2.0, 2.0, 1.0])),
    "Instances.snapshot": lambda s: s.instances.snapshot,
    **{f"Hits.{name}": partial(lambda s, name: getattr(s.hits_of_instances if name == "instance" else s.hits, name), name=name)
       for name in OF_HITS},
    "Hits.uv": lambda s: s.hits.uv,
    "Hits.gradients": lambda s: s.hits_of_mesh.gradients(t=s.ranges),
    "Hits.numpy": lambda s: s.hits.numpy(),
    "Hits.save": lambda s: s.hits.save(s.folder / "hits.csv"),
    "Sensor.depth": lambda s: s.sensor.depth(s.seen),
    "Sensor.range": lambda s: s.sensor.range(s.seen),
    "Sensor.points": lambda s: s.sensor.points(s.seen),
    "sensors.pinhole": lambda s: wrt.sensors.pinhole(K, (8, 8), s.pose),
    "sensors.fisheye": lambda s: wrt.sensors.fisheye(K, (8, 8), s.pose),
    "sensors.lidar": lambda s: wrt.sensors.lidar("os1-32", s.pose),
    "sensors.raster_lidar": lambda s: wrt.sensors.raster_lidar((0.3, 0.3), (8, 8), s.pose),
    "sensors.rotating_lidar": lambda s: wrt.sensors.rotating_lidar([0.0], 8, s.pose),
    "sensors.project": lambda s: wrt.sensors.project(s.points, K),
    "sensors.unproject": lambda s: wrt.sensors.unproject(s.pixels, K),
    "sensors.with_range_noise": lambda s: wrt.sensors.with_range_noise(s.ranges, 0),
}
OTHERS: dict[str, Call] = {  # more forms of the same calls
    "refit of Warp arrays": lambda s: s.bvh2.refit(s.larger, in_place=True),
    "refit of NumPy arrays": lambda s: s.accel.refit(2.0 * BALL.vertices),
    "counters": lambda s: s.accel.closest_hit(*s.rays, counters=True),
    "broadcast": lambda s: s.accel.closest_hit(s.rays[0][0], s.rays[1]),
    "a point of NumPy arrays": lambda s: s.hits_on_host.point,
    "an adapter": lambda s: RayMeshIntersector(trimesh.Trimesh(BALL.vertices, BALL.faces)).intersects_any(*s.rays),
    "wp.Mesh": lambda s: wrt.build(s.wp_mesh),
    "on_a": lambda s: wrt.visible(s.bvh2, *s.warp, on_a=s.hits_on_host.prim_id),
    "winding": lambda s: wrt.signed_distance(s.accel, s.rays[0], sign="winding"),
    "points of ranges": lambda s: s.sensor.points(s.far),
}
CALLS = FUNCTIONS | METHODS | OTHERS
AT_ONCE_ON_GPU = {"camera_rays"}  # arrays of the host in and out
# Calls that a graph of a GPU captures.
ON_GPU = {"visible", "OneMesh.closest_hit", "OneMesh.snapshot", "Instances.snapshot", "Instances.any_hit", "Instances.closest_hit",
          "refit of Warp arrays", "Hits.point", "Hits.points", "Hits.point_error", "Hits.normal", "Hits.normals", "Hits.shading_normal",
          "Hits.uv", "Hits.face", "Hits.object", "Hits.instance", "Hits.material"}


@pytest.fixture(scope="module")
def things(tmp_path_factory: pytest.TempPathFactory) -> Things:
    return Things(tmp_path_factory.mktemp("capture"))


@pytest.mark.parametrize("name", CALLS)
def test_a_call_is_refused_by_its_name_and_changes_nothing(name: str, things: Things) -> None:
    if DEVICE.is_cuda and name in ON_GPU | AT_ONCE_ON_GPU:
        pytest.skip("allowed")
    before, files = things.state(), sorted(things.folder.iterdir())
    with wp.ScopedCapture(DEVICE) as capture, pytest.raises(wrt.InputError) as error:
        CALLS[name](things)
    wp.capture_launch(capture.graph)
    assert "cannot be captured in a graph" in str(error.value) and "wrt.ray_query" in str(error.value)
    if name in FUNCTIONS | METHODS:
        assert name.rpartition(".")[2].removesuffix("s") in str(error.value).split(" cannot")[0]
    assert things.state() == before and sorted(things.folder.iterdir()) == files


def test_own_kernels_are_captured(things: Things) -> None:
    """A graph of an own kernel gives the hits of the rays at its launch, also after a refit in place."""
    query = wrt.ray_query(things.bvh2)

    @wrt.kernel
    def step(world: query.World, origins: wp.array(dtype=wp.vec3), directions: wp.array(dtype=wp.vec3), t: wp.array(dtype=float)) -> None:  # type: ignore[name-defined, valid-type]
        i = wp.tid()
        origins[i] = 0.5 * origins[i]
        t[i] = query.closest_hit(world, query.ray(origins[i], directions[i])).t

    origins, t = wp.clone(things.warp[0]), wp.zeros(N, dtype=float, device=DEVICE)
    wp.load_module(step.module, DEVICE, block_dim=1 if DEVICE.is_cpu else 256)
    with wp.ScopedCapture(DEVICE) as capture:
        wp.launch(step, N, [things.bvh2.world, origins, things.warp[1], t], device=DEVICE)
    for scale in (0.5, 0.25):
        wp.capture_launch(capture.graph)
        assert np.array_equal(t.numpy(), things.bvh2.closest_hit(scale * things.rays[0], things.rays[1]).t)


@pytest.mark.skipif(not DEVICE.is_cuda, reason="graphs of the CPU capture no call")
@pytest.mark.parametrize("name", sorted(ON_GPU))
def test_a_gpu_captures(name: str, things: Things) -> None:
    """A replay computes what was captured: what the call returned changes with its arguments."""
    expected = CALLS[name](things)  # which uploads what the call needs
    with wp.ScopedCapture(DEVICE) as capture:
        got = CALLS[name](things)
    wp.capture_launch(capture.graph)
    if isinstance(got, wp.array):
        assert np.array_equal(got.numpy(), expected.numpy(), equal_nan=True)
