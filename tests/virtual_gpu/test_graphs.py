"""CUDA graphs on a virtual GPU: a launch repeats the captured calls; calls that cannot be captured are refused."""

from __future__ import annotations

import re

import numpy as np
import pytest
import warp as wp

import wrt
from tests import device
from tests.data import ROOT
from tests.virtual_gpu import VirtualGpuError, gpus
from wrt.accel.queries.accelerator import Accelerator
from wrt.accel.queries.answers import Hits
from wrt.core.errors import InputError
from wrt.scene.shapes import icosphere

pytestmark = pytest.mark.skipif(not device.IS_VIRTUAL, reason="run with --device cuda:0")
BALL = icosphere(2)
FIELDS = "t", "u", "v", "prim_id"


@wp.kernel(enable_backward=False)
def add(x: wp.array(dtype=float), step: float):
    x[wp.tid()] += step


@wp.kernel(enable_backward=False)
def use(t: wp.array(dtype=float), ids: wp.array(dtype=int), hidden: wp.array(dtype=wp.bool), seen: wp.array(dtype=float)):
    i = wp.tid()
    seen[i] += wp.where(hidden[i], t[i] + float(ids[i]), -1.0)


def test_a_launch_is_recorded_with_its_arguments_and_repeated_by_the_graph() -> None:
    x, y = (wp.zeros(3, dtype=float, device="cuda:0") for _ in range(2))
    wp.launch(add, 3, [x, 1.0], device="cuda:0")
    before = gpus().counts.launches.total()
    with wp.ScopedCapture("cuda:0") as capture:
        for step in (2.0, 3.0):
            wp.launch(add, 3, [x, step], device="cuda:0")
        wp.copy(y, x)
        room = wp.full(3, 7.0, dtype=float, device="cuda:0")  # in memory that belongs to the graph
        wp.launch(add, 3, [room, 1.0], device="cuda:0")
    assert x.numpy().tolist() == [1.0] * 3 and gpus().counts.launches.total() == before
    for expected in (6.0, 11.0):
        wp.capture_launch(capture.graph)
        assert x.numpy().tolist() == y.numpy().tolist() == [expected] * 3 and room.numpy().tolist() == [8.0] * 3
    assert gpus().counts.launches.total() == before + 6


@pytest.mark.parametrize(("what", "message"), [
    (lambda x: x.numpy(), "memory of a device is copied to the host while a graph is captured"),
    (lambda x: x.assign(np.ones(3, np.float32)), "memory of the host is copied to a device"),
    (lambda x: wp.synchronize_stream(wp.get_device("cuda:0").stream), "Cannot synchronize stream while graph capture is active"),
])
def test_copies_and_waits_of_the_host_cannot_be_captured(what, message: str) -> None:
    x = wp.zeros(3, dtype=float, device="cuda:0")
    with pytest.raises(RuntimeError, match=message), wp.ScopedCapture("cuda:0"):
        what(x)
    wp.launch(add, 3, [x, 1.0], device="cuda:0")  # the capture has ended
    assert x.numpy().tolist() == [1.0] * 3


def test_a_launch_of_a_graph_after_its_arrays_are_freed_is_an_error() -> None:
    x = wp.zeros(3, dtype=float, device="cuda:0")
    with wp.ScopedCapture("cuda:0") as capture:
        wp.launch(add, 3, [x, 1.0], device="cuda:0")
    del x
    with pytest.raises(VirtualGpuError, match="x must be 12 bytes on cuda:0, and is device memory that was freed"):
        wp.capture_launch(capture.graph)


def moving(name: str = "bvh2") -> tuple[Accelerator, wp.array, list[wp.array], Hits]:
    accel = wrt.build(BALL, name, device="cuda:0")
    rays = [wp.array(array, dtype=wp.vec3, device="cuda:0") for array in np.random.default_rng(1).normal(size=(2, 500, 3))]
    return accel, wp.array(BALL.vertices, dtype=wp.vec3, device="cuda:0"), rays, accel.closest_hit(*rays)


@pytest.mark.parametrize("name", ["bvh2", "bvh8", "bvh8c"])
def test_a_refit_and_a_query_are_captured_and_follow_the_points(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    accel, points, rays, out = moving(name)
    accel.refit(points, in_place=True)
    copies, waits = gpus().counts.copies.copy(), gpus().counts.synchronisations
    allocated: list[int] = []
    monkeypatch.setattr(gpus().memory, "allocate", lambda *sizes: allocated.extend(sizes))
    accel.refit(points, in_place=True)
    assert gpus().counts.copies - copies == {"d2d": 1} and not allocated and gpus().counts.synchronisations == waits
    monkeypatch.undo()
    copies = gpus().counts.copies.copy()
    with wp.ScopedCapture("cuda:0") as capture:
        accel.refit(points, in_place=True)
        accel.closest_hit(*rays, t_max=5.0, out=out)
    assert gpus().counts.copies == copies
    for scale in (1.5, 0.5):
        points.assign(scale * BALL.vertices)
        launches, copies = gpus().counts.launches.total(), gpus().counts.copies.copy()
        wp.capture_launch(capture.graph)
        assert gpus().counts.launches.total() == launches + 4  # boxes, tree, corners, rays
        assert gpus().counts.copies - copies == {"d2d": 1}
        expected = wrt.build(wrt.Mesh(np.float32(scale) * BALL.vertices, BALL.faces), name, device="cpu").closest_hit(
            rays[0].numpy(), rays[1].numpy(), t_max=5.0)
        for field in FIELDS:
            assert getattr(out, field).numpy().tobytes() == getattr(expected, field).tobytes()
        assert (expected.prim_id >= 0).any()


def test_a_step_of_moves_a_query_and_cameras_stays_on_the_gpu(monkeypatch: pytest.MonkeyPatch) -> None:
    """Eagerly and in a graph: no copy, no allocation, no wait. The graph's hits and images are those of a structure on the CPU."""
    scenes = [[(icosphere(1), 3)], [(icosphere(2), 2), (icosphere(1), 4)]]
    worlds = [wrt.Scene(tuple(wrt.Object(mesh, (wrt.Material(),)) for mesh, n in each for _ in range(n))) for each in scenes]
    accel, rng = wrt.build(worlds, device="cuda:0"), np.random.default_rng(2)
    rays = [wp.array(each, dtype=wp.vec3, device="cuda:0") for each in rng.normal(size=(2, 500, 3))]
    world = wp.array(np.arange(500) % 2, dtype=wp.int32, device="cuda:0")
    bodies, poses = wp.array([7, 1], dtype=wp.int32, device="cuda:0"), wp.zeros(9, dtype=wp.transformf, device="cuda:0")
    some = wp.zeros(2, dtype=wp.mat44f, device="cuda:0")
    out, hidden = accel.closest_hit(*rays, world=world), accel.any_hit(*rays, world=world)
    seen = wp.zeros(500, dtype=float, device="cuda:0")
    camera = wrt.sensors.pinhole([[8.0, 0.0, 5.5], [0.0, 8.0, 3.5], [0.0, 0.0, 1.0]], (12, 8))
    views = wp.zeros(2, dtype=wp.transformf, device="cuda:0")
    pictures = "t", "prim_id", "depth", "range", "object", "face", "point", "normal", "world", "direction"
    images = camera.trace(accel, views, out=pictures)

    def step() -> Hits:
        accel.move(poses)
        accel.move(bodies, some)
        camera.trace(accel, views, out=images)
        hits = accel.closest_hit(*rays, world=world, out=out)
        accel.any_hit(*rays, t_max=out.t, world=world, out=hidden)
        wp.launch(use, 500, [out.t, out.prim_id, hidden, seen], device="cuda:0")
        return hits

    step()
    step()
    allocated: list[int] = []
    monkeypatch.setattr(gpus().memory, "allocate", lambda *sizes: allocated.extend(sizes))
    counts = gpus().counts
    copies, waits, launches = counts.copies.copy(), counts.synchronisations, counts.launches.total()
    step()
    with wp.ScopedCapture("cuda:0") as capture:
        hits = step()
    assert (counts.copies, counts.synchronisations, counts.launches.total(), allocated) == (copies, waits, launches + 9, [])
    monkeypatch.undo()
    for _ in range(2):
        quaternions, matrices = rng.normal(size=(9, 4)), np.tile(np.eye(4), (2, 1, 1)) + 0.2 * rng.normal(size=(2, 4, 4))
        matrices[:, 3] = [0.0, 0.0, 0.0, 1.0]
        poses.assign(np.concatenate([0.5 * rng.normal(size=(9, 3)), quaternions], axis=1))
        some.assign(matrices)
        views.assign([[0.1, 0.2, -5.0, 0.1, -0.1, 0.05, 0.9], [0.0, 0.3, -4.0, 0.0, 0.1, 0.1, 1.0]])
        before, copies, launches = seen.numpy(), counts.copies.copy(), counts.launches.total()
        wp.capture_launch(capture.graph)
        assert counts.copies == copies and counts.launches.total() == launches + 9
        expected = wrt.build(worlds, device="cpu")
        expected.move(wp.array(poses.numpy(), dtype=wp.transformf, device="cpu"))
        expected.move(bodies.to("cpu"), some.to("cpu"))
        found = expected.closest_hit(*(each.numpy() for each in rays), world=world.numpy())
        assert (found.prim_id >= 0).sum() > 50
        for name in FIELDS:
            assert getattr(out, name).numpy().tobytes() == getattr(found, name).tobytes()
        assert np.array_equal(seen.numpy(), before + np.where(found.t < np.inf, found.t + found.prim_id.astype(np.float32), np.float32(-1)))
        assert hits.instance.numpy().tobytes() == found.instance.tobytes() and hits.point.numpy().tobytes() == found.point.tobytes()
        shown = camera.trace(expected, wp.array(views.numpy(), dtype=wp.transformf, device="cpu"), out=pictures)
        assert (shown.object.numpy() >= 0).sum() > 20
        for name in pictures:
            assert getattr(images, name).numpy().tobytes() == getattr(shown, name).numpy().tobytes(), name
        assert np.array_equal(accel.geometry.to_world, expected.geometry.to_world)
    with pytest.raises(InputError, match="must be on cuda:0"):
        accel.move(bodies.to("cpu"), some.to("cpu"))


def test_the_example_in_the_documentation() -> None:
    page = (ROOT / "docs/moving.md").read_text(encoding="utf-8")
    section = page[page.index("## On a GPU") :]
    names = {"wrt": wrt, "mesh": BALL, "moved": 2.0 * BALL.vertices, "rays": np.random.default_rng(1).normal(size=(2, 50, 3))}
    for block in re.findall(r"^```python\n(.*?)^```", section, re.DOTALL | re.MULTILINE):
        exec(block, names)
    origins, directions = names["rays"]
    expected = wrt.build(wrt.Mesh(2.0 * BALL.vertices, BALL.faces), device="cpu").closest_hit(origins, directions)
    assert names["hits"].t.numpy().tobytes() == expected.t.tobytes() and (expected.prim_id >= 0).any()


def test_calls_of_wrt_that_cannot_be_captured() -> None:
    accel, points, _, _ = moving()
    with pytest.raises(InputError, match="a graph cannot capture the first refit in place"), wp.ScopedCapture("cuda:0"):
        accel.refit(points, in_place=True)
    with pytest.raises(InputError, match=r"OneMesh\.refit cannot be captured"), wp.ScopedCapture("cuda:0"):
        accel.refit(points)
    rays = np.ones((2, 5, 3), np.float32)
    for given in (rays, [wp.array(each, dtype=wp.vec3, device="cpu") for each in rays]):
        with pytest.raises(InputError, match=r"Accelerator\.closest_hit cannot be captured"), wp.ScopedCapture("cuda:0"):
            accel.closest_hit(*given)


def test_a_build_on_the_device_copies_back_only_the_costs_of_the_tree() -> None:
    geometry = wrt.DeviceGeometry(wp.array(BALL.vertices, dtype=wp.vec3, device="cuda:0"),
                                  wp.array(BALL.faces.reshape(-1), dtype=wp.int32, device="cuda:0"))
    wrt.build(geometry, "bvh2", builder="lbvh", device="cuda:0")
    counts = gpus().counts
    launches, copies, size = counts.launches.copy(), counts.copies.copy(), counts.bytes.copy()
    accel = wrt.build(geometry, "bvh2", builder="lbvh", device="cuda:0")
    assert (counts.launches - launches).total() == 7 and (counts.bytes - size)["d2h"] == 56 and (counts.copies - copies)["d2h"] == 1
    assert (counts.bytes - size)["h2d"] == 0
    launches, copies, size = counts.launches.copy(), counts.copies.copy(), counts.bytes.copy()
    accel.refit(geometry.points)
    assert (counts.launches - launches).total() == 3 and (counts.bytes - size)["d2h"] == 56 and (counts.bytes - size)["h2d"] == 0
