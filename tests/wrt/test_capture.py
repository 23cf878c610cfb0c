"""Graphs: while a graph is captured, a public call is recorded, or is refused by its name and changes nothing. A test compares the lists
of calls with all public names."""

from __future__ import annotations

import gc
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
from wrt.accel.base import OneMesh
from wrt.accel.instances import Instances
from wrt.accel.queries.answers import Hits
from wrt.compat.trimesh import RayMeshIntersector
from wrt.scene.shapes import icosphere
from wrt.sensors.sensor import Sensor

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
        self.images = self.sensor.trace(self.accel, wp.array(POSE[None], dtype=wp.mat44, device=DEVICE), out=("depth", "object", "point"))
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
    "OneMesh.any_hit": lambda s: s.accel.any_hit(*s.warp),
    "OneMesh.refit": lambda s: s.bvh2.refit(s.larger),
    "OneMesh.save": lambda s: s.bvh2.save(s.folder / "new.accel"),
    "OneMesh.snapshot": lambda s: s.bvh2.snapshot,
    "Instances.closest_hit": lambda s: s.instances.closest_hit(*s.warp),
    "Instances.any_hit": lambda s: s.instances.any_hit(*s.warp),
    "Instances.move": lambda s: s.instances.move(0, np.diag([2.0, 2.0, 2.0, 1.0])),
    "Instances.refit": lambda s: s.instances.refit(0, s.larger),
    "Instances.snapshot": lambda s: s.instances.snapshot,
    **{f"Hits.{name}": partial(lambda s, name: getattr(s.hits_of_instances if name == "instance" else s.hits, name), name=name)
       for name in OF_HITS},
    "Hits.uv": lambda s: s.hits.uv,
    "Hits.gradients": lambda s: s.hits_of_mesh.gradients(t=s.ranges),
    "Hits.numpy": lambda s: s.hits.numpy(),
    "Sensor.depth": lambda s: s.sensor.depth(s.seen),
    "Sensor.range": lambda s: s.sensor.range(s.seen),
    "Sensor.points": lambda s: s.sensor.points(s.seen),
    "Sensor.trace": lambda s: s.sensor.trace(s.accel, s.pose, out=s.images),
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
    "rays of NumPy": lambda s: s.accel.any_hit(*s.rays),
    "counters": lambda s: s.accel.closest_hit(*s.warp, counters=True),
    "invalid rays": lambda s: s.accel.closest_hit(*s.warp, invalid="miss"),
    "broadcast": lambda s: s.accel.closest_hit(s.warp[0][:1], s.warp[1]),
    "gaps": lambda s: s.accel.closest_hit(s.warp[0][::2], s.warp[1][::2]),
    "a point of NumPy arrays": lambda s: s.hits_on_host.point,
    "an adapter": lambda s: RayMeshIntersector(trimesh.Trimesh(BALL.vertices, BALL.faces)).intersects_any(*s.rays),
    "wp.Mesh": lambda s: wrt.build(s.wp_mesh),
    "on_a": lambda s: wrt.visible(s.bvh2, *s.warp, on_a=s.hits_on_host.prim_id),
    "winding": lambda s: wrt.signed_distance(s.accel, s.rays[0], sign="winding"),
    "points of ranges": lambda s: s.sensor.points(s.far),
}
CALLS = FUNCTIONS | METHODS | OTHERS
# Public names whose work is done in NumPy alone, or that own kernels need.
AT_ONCE = {*"""
    __version__ ray_query kernel ACCELERATORS InputError SceneWarning load_scene load_mesh Film Options Progress Settings
    side_by_side ConstantBackground EnvironmentBackground GradientBackground Camera FisheyeCamera OrthographicCamera PanoramaCamera
    DirectionalLight PointLight SpotLight Checkerboard Material Texture Mesh Object Scene Sphere Motion""".split()}
AT_ONCE |= {f"{kind}.{name}" for kind, names in {
    "OneMesh": "built build_all can_refit data geometry origin restore stats stream tree world",
    "Instances": "bodies data geometry invalid_moves masks name origin restore stats world",
    "Hits": "counters each in_shape shape source warp",
    "Sensor": "axis directions like origins picture rays",
    "sensors": "Images LIDARS LidarModel Sensor"}.items() for name in names.split()}
# On a GPU: arrays of the host in and out; a structure on the CPU; copies of arrays with gaps, which a virtual GPU does not capture.
NOT_ON_GPU = {"camera_rays", "an adapter", "broadcast", "gaps"}
RECORDED = {"OneMesh.any_hit", "OneMesh.closest_hit", "Instances.any_hit", "Instances.closest_hit", "Hits.point", "Hits.points",
            "Hits.point_error", "Hits.normal", "Hits.normals", "Hits.shading_normal", "Hits.uv", "Hits.face", "Hits.object",
            "Hits.instance", "Hits.material", "Sensor.points", "Sensor.trace",
            "refit of Warp arrays"}
if DEVICE.is_cuda:
    RECORDED |= {"visible", "OneMesh.snapshot", "Instances.snapshot"}


@pytest.fixture(scope="module")
def things(tmp_path_factory: pytest.TempPathFactory) -> Things:
    return Things(tmp_path_factory.mktemp("capture"))


def test_every_public_name_is_in_a_list() -> None:
    names = set(wrt.__all__) | {f"sensors.{name}" for name in wrt.sensors.__all__}
    for kind in (OneMesh, Instances, Hits, Sensor):
        names |= {f"{kind.__name__}.{name}" for name in dir(kind) if not name.startswith("_")}
    listed = {*FUNCTIONS, *METHODS, *AT_ONCE}
    assert names == listed, (names - listed, listed - names)


@pytest.mark.parametrize("name", CALLS)
def test_a_call_is_refused_by_its_name_and_changes_nothing(name: str, things: Things) -> None:
    if name in RECORDED or (DEVICE.is_cuda and name in NOT_ON_GPU):
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


@pytest.mark.parametrize("name", sorted(RECORDED))
def test_a_call_is_recorded(name: str, things: Things) -> None:
    """A replay computes what was captured: what the call returned changes with its arguments."""
    expected = CALLS[name](things)  # which uploads what the call needs
    with wp.ScopedCapture(DEVICE) as capture:
        got = CALLS[name](things)
    wp.capture_launch(capture.graph)
    if isinstance(got, wp.array):
        assert np.array_equal(got.numpy(), expected.numpy(), equal_nan=True)


@wp.kernel(enable_backward=False)
def advance(poses: wp.array(dtype=wp.transformf), origins: wp.array(dtype=wp.vec3), directions: wp.array(dtype=wp.vec3)) -> None:  # type: ignore[valid-type]
    i = wp.tid()
    if i < poses.shape[0]:
        turn = wp.quat_from_axis_angle(wp.vec3(0.6, 0.0, 0.8), 0.3 * float(i + 1))
        poses[i] = wp.transform_multiply(wp.transform(wp.vec3(0.05, 0.0, 0.1), turn), poses[i])
    origins[i] = 0.9 * origins[i] + 0.1 * directions[i]
    directions[i] = wp.quat_rotate(wp.quat_rpy(0.1, 0.2, 0.3), directions[i])


@wp.kernel(enable_backward=False)
def swell(points: wp.array(dtype=wp.vec3)) -> None:  # type: ignore[valid-type]
    i = wp.tid()
    points[i] = (1.0 + 0.1 * wp.sin(float(i))) * points[i]


@wp.kernel(enable_backward=False)
def use(t: wp.array(dtype=float), ids: wp.array(dtype=int), hidden: wp.array(dtype=wp.bool), out: wp.array(dtype=float)) -> None:  # type: ignore[valid-type]
    i = wp.tid()
    wp.atomic_add(out, ids[i] + 1, wp.where(hidden[i], 1.0 + wp.min(t[i], 100.0), -1.0))


@pytest.mark.skipif(DEVICE.is_cuda, reason="tests/virtual_gpu/test_graphs.py has it")
@pytest.mark.parametrize(("kind", "form"), [("bvh8", "worlds"), ("bvh8", "instances"), ("bvh8", "mesh"), ("bvh2", "worlds")])
def test_a_step_is_one_graph_of_the_cpu(kind: str, form: str) -> None:
    """Moves or a refit in place, queries and the user's kernels: each replay has the bits of eager calls, also if only the graph keeps the
    arrays that the calls made."""
    scenes = [wrt.Scene.of([BALL] * n) for n in (2, 3)]
    n = 2 * 1500  # more than the buffers of a call with few rays

    class Step:
        def __init__(self) -> None:
            scene = {"worlds": scenes, "instances": scenes[1], "mesh": BALL}[form]
            self.accel: Any = wrt.build(scene, kind, movable=form == "instances")
            rays = np.random.default_rng(4).normal(size=(2, n, 3))
            self.rays = [wp.array(each, dtype=wp.vec3, device="cpu") for each in rays]
            world = wp.array(np.arange(n) % 3, dtype=wp.int32, device="cpu")  # 2 does not exist
            self.options: Any = {"worlds": {"world": world}, "instances": {"exclude": 1, "mask": 3}}.get(form, {})
            self.points = wp.array(BALL.vertices, dtype=wp.vec3, device="cpu")
            self.poses = wp.zeros(5 if form == "worlds" else 3, dtype=wp.transformf, device="cpu")
            self.poses.assign(np.random.default_rng(5).normal(size=(len(self.poses), 7)))
            self.out, self.sums = wp.zeros(400 * 5, dtype=float, device="cpu"), wp.zeros(400 * 5, dtype=float, device="cpu")
            self.hits = self.accel.closest_hit(*self.rays, **self.options)
            self.follow()

        def follow(self) -> None:
            if form == "mesh":
                self.accel.refit(self.points, in_place=True)
            else:
                self.accel.move(self.poses)

        def run(self) -> None:
            wp.launch(advance, n, [self.poses, *self.rays], device="cpu")
            wp.launch(swell, len(self.points), [self.points], device="cpu")
            self.follow()
            self.accel.closest_hit(*self.rays, 0.25, 5.0, out=self.hits, **self.options)
            hidden = self.accel.any_hit(*self.rays, t_max=self.hits.t, **self.options)
            wp.launch(use, n, [self.hits.t, self.hits.prim_id, hidden, self.sums], device="cpu")

    eager, replayed = Step(), Step()
    with wp.ScopedCapture("cpu") as capture:
        replayed.run()
    gc.collect()
    filler = [wp.full(size, -1.0, dtype=float, device="cpu") for size in (1, 1, n // 4, n // 4, n, 2 * n) for _ in range(50)]
    for _ in range(3):
        eager.run()
        wp.capture_launch(capture.graph)
        for name in ("t", "u", "v", "prim_id"):
            assert getattr(replayed.hits, name).numpy().tobytes() == getattr(eager.hits, name).numpy().tobytes()
        assert replayed.sums.numpy().tobytes() == eager.sums.numpy().tobytes()
        assert (eager.hits.prim_id.numpy() >= 0).sum() > n // 20
    assert len(filler) == 300
