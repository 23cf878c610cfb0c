"""Several threads use one structure at the same time: each query has the same result as alone."""

from __future__ import annotations

import sys
import threading
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import warp as wp

import wrt
from tests.placed import place
from wrt.accel.geometry import Geometry
from wrt.accel.instances import Instances
from wrt.accel.queries.accelerator import Accelerator
from wrt.accel.queries.answers import Hits
from wrt.accel.queries.batches import RAYS_PER_LAUNCH
from wrt.accel.scenes.build import build, load_accel
from wrt.accel.structures import ACCELERATORS
from wrt.core.device import made_once
from wrt.core.errors import InputError
from wrt.scene.cameras import Camera
from wrt.scene.lights import PointLight
from wrt.scene.materials import Material
from wrt.scene.model import Object, Scene
from wrt.scene.shapes import icosphere

BALL = icosphere(3)
SHAPES = BALL.vertices, (BALL.vertices * np.float32([1.0, 0.5, 0.8])).astype(np.float32)
REFITTED = sorted({cls.name for cls in ACCELERATORS.values() if cls.can_refit})


def some_rays(n: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    origins = (2.0 * rng.normal(size=(n, 3))).astype(np.float32)
    return origins, (0.3 * rng.normal(size=(n, 3)) - origins).astype(np.float32)


def moved(*offset: float) -> np.ndarray:
    matrix = np.eye(4)
    matrix[:3, 3] = offset
    return matrix


def structure(name: str) -> Accelerator:
    """Build a structure over a ball, or, for "instances NAME", over two instances of the ball."""
    geometry = Geometry.of(BALL)
    if name.startswith("instances"):
        return build(place((geometry, np.eye(4)), (geometry, moved(1.5, 0.0, 0.0))), name.split()[1])
    return build(geometry, name)


def bits(hits: Hits) -> tuple[bytes, ...]:
    arrays = [hits.t, hits.u, hits.v, hits.prim_id]
    if hits.counters is not None:
        arrays += [hits.counters.counts, hits.counters.first, hits.counters.address, hits.counters.size]
    return tuple(array.tobytes() for array in arrays)


@pytest.fixture
def often() -> Iterator[None]:
    """Make Python switch between threads as often as possible."""
    before = sys.getswitchinterval()
    sys.setswitchinterval(1e-5)
    yield
    sys.setswitchinterval(before)


def at_a_time(*jobs: Callable[[], None]) -> None:
    """Run each job on its own thread, start all jobs at the same time, and raise the first error."""
    errors: list[BaseException] = []
    barrier = threading.Barrier(len(jobs))

    def run(job: Callable[[], None]) -> None:
        try:
            barrier.wait()
            job()
        except BaseException as error:
            errors.append(error)

    threads = [threading.Thread(target=run, args=(job,)) for job in jobs]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    if errors:
        raise errors[0]


@pytest.mark.parametrize("name", ["bvh8", "bvh2", "kdtree", "instances bvh8", "instances bvh2"])
def test_counters_and_traces_are_those_of_the_call(name: str, often: None) -> None:
    accel = structure(name)
    asked = [some_rays(20 + 31 * i, i) for i in range(8)]
    ways: list[dict[str, Any]] = [{}, {"counters": True}, {"trace": True}]
    alone = [[bits(accel.closest_hit(*rays, **way)) for way in ways] for rays in asked]
    dark = [accel.any_hit(*rays).tobytes() for rays in asked]
    wrong = []

    def ask(i: int) -> None:
        for k in range(20):
            way = (i + k) % 3
            if bits(accel.closest_hit(*asked[i], threads=1 + k % 2, **ways[way])) != alone[i][way]:
                wrong.append((i, k))
            if accel.any_hit(*asked[i]).tobytes() != dark[i]:
                wrong.append((i, k))

    at_a_time(*(lambda i=i: ask(i) for i in range(8)))  # type: ignore[misc]
    assert not wrong
    assert len(accel.data.recorder.counts or ()) == len(accel.data.recorder.fetches or ()) == 0  # the structure keeps nothing of a call


@pytest.mark.parametrize("name", REFITTED)
def test_what_is_asked_during_refits_is_of_one_shape(name: str, often: None) -> None:
    ball = icosphere(1)  # small, because brute force tests all of its triangles
    shapes = ball.vertices, (ball.vertices * np.float32([1.0, 0.5, 0.8])).astype(np.float32)
    accel, rays = build(ball, name), some_rays(3 * RAYS_PER_LAUNCH)
    known = []
    for vertices in shapes:
        accel.refit(vertices)
        known.append((bits(accel.closest_hit(*rays)), accel.any_hit(*rays).tobytes(), bits(accel.closest_hit(*rays, trace=True))))
    assert all(a != b for a, b in zip(*known, strict=True))
    done, seen = threading.Event(), []

    def flip() -> None:
        for i in range(100_000):
            accel.refit(shapes[i % 2])
            if done.is_set():
                break

    def ask() -> None:
        try:
            for _ in range(3):
                seen.append((bits(accel.closest_hit(*rays)), 0))
                seen.append((accel.any_hit(*rays, threads=1).tobytes(), 1))
                seen.append((bits(accel.closest_hit(*rays, trace=True)), 2))
        finally:
            done.set()

    at_a_time(flip, ask)
    assert len(seen) == 9
    for answer, which in seen:
        assert answer in (known[0][which], known[1][which]), "a mixture of two shapes"


def test_refits_come_one_after_another_and_what_is_saved_is_whole(tmp_path: Any, often: None) -> None:
    accel, rays = build(BALL, "bvh2"), some_rays(500)
    geometries = [Geometry(vertices, BALL.faces, np.zeros((0, 4), np.float32)) for vertices in SHAPES]
    costs, answers = [], []
    for vertices in SHAPES:
        costs.append(accel.refit(vertices).growth)
        answers.append((accel.built.arrays["nodes"].tobytes(), bits(accel.closest_hit(*rays))))
    path, growths = tmp_path / "ball.accel", []

    def flip(which: int) -> None:
        growths.extend((which, accel.refit(SHAPES[which]).growth) for _ in range(30))

    def save() -> None:
        for _ in range(10):
            accel.save(path)
            found = []
            for geometry, answer in zip(geometries, answers, strict=True):
                try:
                    loaded = load_accel(path, geometry)
                except InputError as error:
                    assert "another mesh" in str(error)
                else:
                    found.append((loaded.built.arrays["nodes"].tobytes(), bits(loaded.closest_hit(*rays))) == answer)
            assert found == [True]

    at_a_time(lambda: flip(0), lambda: flip(1), save)
    assert len(growths) == 60 and all(growth == costs[which] for which, growth in growths)
    now = accel.snapshot
    assert now.stats.sah_cost == now.built.sah_cost and now.geometry is accel.geometry


def test_instances_stay_where_they_were_when_their_structure_is_refitted() -> None:
    accel, rays = structure("instances bvh2"), some_rays(2000)
    assert isinstance(accel, Instances)
    before = bits(accel.closest_hit(*rays, trace=True))
    for scale in (2.0, 3.0, 4.0):  # replaced arrays are freed, and their memory is reused
        accel.bottoms[0].refit(scale * BALL.vertices)
    junk = [wp.full(1 << 14, 1e30, dtype=wp.float32, device="cpu") for _ in range(100)]
    assert bits(accel.closest_hit(*rays, trace=True)) == before and junk


def test_a_thing_is_made_once() -> None:
    made: list[int] = []
    slow = threading.Event()

    @made_once
    def make(key: int) -> object:
        made.append(key)
        slow.wait(0.2)
        return object()

    got: list[object] = []
    at_a_time(*[lambda: got.append(make(1))] * 8)
    assert made == [1] and len(set(map(id, got))) == 1 and make(2) is not got[0]


def test_a_failure_is_not_kept() -> None:
    tries: list[int] = []

    @made_once
    def make() -> int:
        tries.append(1)
        if len(tries) == 1:
            raise KeyError("not yet")
        return 5

    with pytest.raises(KeyError):
        make()
    assert make() == make() == 5 and len(tries) == 2


def test_scenes_are_rendered_on_several_threads() -> None:
    camera, other = (Camera.look_at(position, (0, 0, 0)) for position in ((0, 1, 4), (3, 0, 2)))
    scene = Scene(Object(BALL, Material()), lights=PointLight((2, 5, 3), 50), cameras=camera)
    scenes = [scene, scene.with_settings(max_depth=2), replace(scene, cameras=other)]
    alone = [wrt.render(each, size=(24, 16), spp=2).pixels.tobytes() for each in scenes]
    assert len(set(alone)) > 1

    def draw(i: int) -> None:
        for k in range(i, i + 3):
            assert wrt.render(scenes[k % 3], size=(24, 16), spp=2, threads=2).pixels.tobytes() == alone[k % 3]

    at_a_time(*(lambda i=i: draw(i) for i in range(4)))  # type: ignore[misc]
