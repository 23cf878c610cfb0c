"""The numbers of launches, copies, waits and allocations of calls on a GPU, and the bytes between host and device."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from types import SimpleNamespace

import numpy as np
import pytest
import warp as wp

import wrt
from tests import device
from tests.data import ROOT
from tests.virtual_gpu import gpus
from wrt.accel.queries import batches
from wrt.renderer import launches as pixels
from wrt.renderer.options import Options
from wrt.renderer.render import Renderer
from wrt.scene import shapes

pytestmark = pytest.mark.skipif(not device.IS_VIRTUAL, reason="run with --device cuda:0")
N = 3000
PIXELS = 48 * 27
FILM = 52 * PIXELS  # bytes


@contextmanager
def counted() -> Iterator[SimpleNamespace]:
    """Count launches, waits, allocations, copies and their bytes in the block; the numbers are set at its end."""
    counts, allocate = gpus().counts, gpus().memory.allocate
    launches, copies, size, waits = counts.launches.copy(), counts.copies.copy(), counts.bytes.copy(), counts.synchronisations
    out = SimpleNamespace(allocations=0)

    def allocated(*sizes: int) -> int:
        out.allocations += 1
        return allocate(*sizes)

    gpus().memory.allocate = allocated
    try:
        yield out
    finally:
        gpus().memory.allocate = allocate
    out.launches, out.waits = (counts.launches - launches).total(), counts.synchronisations - waits
    out.copies, out.bytes = dict(counts.copies - copies), dict(counts.bytes - size)


def some_rays(n: int = N) -> tuple[np.ndarray, np.ndarray]:
    origins = np.random.default_rng(0).normal(size=(n, 3)).astype(np.float32)
    return origins, -origins


@pytest.mark.parametrize(("threads", "launches"), [
    (0, 3),  # A thread traces all samples of a pixel.
    (2048, 5),  # A thread traces one sample; after passes of several samples, a second launch adds them up.
    (PIXELS // 36 + 1, 9),  # As before, with at most four samples in a launch: 36 multiprocessors with few threads.
])
def test_a_picture_is_a_launch_a_pass_and_comes_back_once(threads: int, launches: int, monkeypatch: pytest.MonkeyPatch) -> None:
    renderer = Renderer(wrt.load_scene(ROOT / "scenes/spot.toml"), Options(device="cuda:0"))
    renderer.aim(renderer.prepared.plan.camera, size=(48, 27), spp=16)
    monkeypatch.setattr(pixels, "THREADS_OF_SM", threads)
    with counted() as picture:
        film = renderer.run()
    assert (picture.launches, picture.waits) == (launches, 3)  # passes of 1, 3 and 12 samples of the whole picture, without tiles
    assert picture.copies == {"h2d": 1, "d2h": 8}  # the table of the filter; each of the film's arrays, once
    assert picture.bytes["d2h"] == FILM
    here = wrt.render(ROOT / "scenes/spot.toml", device="cpu", size=(48, 27), spp=16)
    assert film.pixels.tobytes() == here.pixels.tobytes() and film.stats["rays"] == here.stats["rays"]


def test_rays_of_numpy_are_copied_to_the_gpu_and_hits_back() -> None:
    accel = wrt.build(shapes.icosphere(2), "bvh8", device="cuda:0")
    accel.closest_hit(*some_rays())  # the first call of a process makes the arrays of t_min and t_max that all calls share
    with counted() as query:
        accel.closest_hit(*some_rays())
    assert (query.launches, query.waits, query.copies) == (1, 0, {"h2d": 2, "d2h": 4})
    assert query.bytes == {"h2d": 24 * N, "d2h": 16 * N}  # no arrays for t_min and t_max, which are numbers
    with counted() as query:
        accel.any_hit(*some_rays(), t_max=np.full(N, 0.5, np.float32))
    assert query.bytes == {"h2d": 28 * N, "d2h": N} and query.launches == 1


def test_rays_of_warp_stay_on_the_gpu() -> None:
    accel = wrt.build(shapes.icosphere(2), "bvh8", device="cuda:0")
    rays = [wp.array(array, dtype=wp.vec3, device="cuda:0") for array in some_rays()]
    with counted() as query:
        hits = accel.closest_hit(*rays, 0.25, 7.0)
    assert (query.launches, query.waits, query.copies) == (1, 0, {})
    expected = accel.closest_hit(*some_rays(), 0.25, 7.0)
    assert hits.t.numpy().tobytes() == expected.t.tobytes() and (expected.prim_id >= 0).any()


def test_many_rays_of_numpy_are_traced_in_parts(monkeypatch: pytest.MonkeyPatch) -> None:
    accel = wrt.build(shapes.icosphere(2), "bvh8", device="cuda:0")
    ends = np.linspace(0.1, 2.0, N, dtype=np.float32)
    whole = accel.closest_hit(*some_rays(), 0.0, ends)
    monkeypatch.setattr(batches, "MOST_ON_GPU", 1000)
    monkeypatch.setattr(batches, "FEWEST", 100)
    with counted() as query:
        parts = accel.closest_hit(*some_rays(), 0.0, ends)
    assert query.launches == 3
    for name in ("t", "u", "v", "prim_id"):
        assert getattr(parts, name).tobytes() == getattr(whole, name).tobytes()
    assert 0 < (whole.prim_id >= 0).sum() < N


def test_parts_fit_on_the_device(monkeypatch: pytest.MonkeyPatch) -> None:
    there = wp.get_device("cuda:0")
    monkeypatch.setattr(gpus().memory, "limit", gpus().memory.limit - there.free_memory + 30_000)
    assert batches.rays_on_gpu(10, there) == batches.MOST_ON_GPU
    assert batches.rays_on_gpu(1 << 26, there) == batches.FEWEST


def costs(page: str) -> dict[str, list[int]]:
    """Return the table of calls and their costs on a GPU in docs/moving.md."""
    table = page[page.index("| call on a GPU |"):].partition("\n\n")[0].splitlines()[2:]
    rows = ([cell.strip() for cell in row.strip("|").split("|")] for row in table)
    return {name.replace("`", ""): [int(cell) for cell in cells] for name, *cells in rows}


def test_the_page_says_what_each_call_costs_on_a_gpu() -> None:
    """Each call is counted the second time, because the first loads kernels and makes what later calls share."""
    ball = shapes.icosphere(2)
    points, larger = (wp.array(scale * ball.vertices, dtype=wp.vec3, device="cuda:0") for scale in (1.0, 2.0))
    mesh = wrt.DeviceGeometry(points, wp.array(ball.faces.reshape(-1), dtype=wp.int32, device="cuda:0"))
    bvh2 = [wrt.build(mesh, "bvh2", builder="lbvh", device="cuda:0") for _ in range(2)]
    bvh8, fitted = (wrt.build(ball, device="cuda:0") for _ in range(2))
    worlds, in_place = (wrt.build([wrt.Scene.of([ball] * n) for n in (1, 2)], device="cuda:0") for _ in range(2))
    matrices = np.tile(np.eye(4), (3, 1, 1))
    poses = wp.array(matrices, dtype=wp.mat44f, device="cuda:0")
    rays = [wp.array(array, dtype=wp.vec3, device="cuda:0") for array in some_rays()]
    ids = np.arange(N, dtype=np.int32) % 2
    world = wp.array(ids, dtype=wp.int32, device="cuda:0")
    out, of_worlds, t = bvh8.closest_hit(*rays), worlds.closest_hit(*rays, world=world), wp.full(N, 5.0, dtype=float, device="cuda:0")
    moved = wrt.build(wrt.Scene.of([ball] * 3), movable=True, device="cuda:0").closest_hit(*rays)
    camera = wrt.sensors.pinhole(np.diag([4.0, 4.0, 1.0]), (4, 4))
    images = camera.trace(in_place, poses[:2], out=("depth", "object"))
    calls = {
        'wrt.build(geometry, "bvh2", builder="lbvh")': lambda: wrt.build(mesh, "bvh2", builder="lbvh", device="cuda:0"),
        "wrt.build(mesh)": lambda: wrt.build(ball, device="cuda:0"),
        "bvh2.refit(points)": lambda: bvh2[0].refit(larger),
        "bvh2.refit(points, in_place=True)": lambda: bvh2[1].refit(larger, in_place=True),
        "bvh8.refit(points, in_place=True)": lambda: fitted.refit(larger, in_place=True),
        "bvh8.refit(points)": lambda: bvh8.refit(larger),
        "worlds.move(rows, matrices) of NumPy": lambda: worlds.move(np.arange(3), matrices),
        "worlds.move(poses)": lambda: in_place.move(poses),
        "worlds.refit(0, points, world=0)": lambda: in_place.refit(0, larger, world=0),
        "closest_hit(o, d, out=hits)": lambda: bvh8.closest_hit(*rays, out=out),
        "closest_hit(o, d, t_min, t_max, out=hits)": lambda: bvh8.closest_hit(*rays, 0.25, 7.0, out=out),
        "closest_hit(o, d, t_max=t, world=ids, out=hits)": lambda: in_place.closest_hit(*rays, t_max=t, world=world, out=of_worlds),
        "closest_hit(o, d, world=ids) of NumPy": lambda: in_place.closest_hit(*rays, world=ids, out=of_worlds),
        "any_hit(o, d)": lambda: bvh8.any_hit(*rays),
        "wrt.count_hits(accel, o, d)": lambda: wrt.count_hits(bvh8, *rays),
        "wrt.all_hits(accel, o, d)": lambda: wrt.all_hits(bvh8, *rays),
        "hits.point": lambda: out.point,
        "hits.instance, hits.object": lambda: moved.instance,
        "hits.object over worlds": lambda: of_worlds.object,
        "sensor.trace(worlds, poses, out=images)": lambda: camera.trace(in_place, poses[:2], out=images),
    }
    found = {}
    for name, call in calls.items():
        call()
        with counted() as it:
            call()
        found[name] = [it.launches, it.copies.get("h2d", 0), it.copies.get("d2h", 0), it.allocations]
        assert it.waits == 0
    print("\n".join(f"| `{name}` | {' | '.join(map(str, row))} |" for name, row in found.items()))
    assert found == costs((ROOT / "docs/moving.md").read_text(encoding="utf-8"))
