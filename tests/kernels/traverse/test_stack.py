"""The stack of a walk, in shared or local memory: it returns stored values, threads do not share it, and hits are the same."""

from __future__ import annotations

import re
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests import device
from tests.kernel_tools import DEVICE

from wrt.accel.scenes.build import build  # isort: skip (starts Warp)
import warp as wp

import wrt
from tests.placed import place
from wrt.accel.geometry import Geometry
from wrt.core.device import launch_on
from wrt.core.settings import STACKS
from wrt.kernels.headers import STACK_LENGTH
from wrt.kernels.structs import kernel
from wrt.kernels.traverse.bvh2 import ENTRY
from wrt.kernels.traverse.stack import PLACES, SHARED, make_stack
from wrt.scene.mesh import Mesh

SIZE, THREADS, BLOCK = 64, 192, 64
ROOT = Path(__file__).parents[3]


@cache
def make_probe_kernel(where: str) -> Any:
    new, shared_entries, put, get = make_stack(where, SIZE, wp.uint64, 8)

    @kernel
    def probe(out: wp.array2d(dtype=wp.uint64), place_of: wp.array(dtype=wp.uint64), first: int):
        i = first + wp.tid()
        entries = new()
        shared = shared_entries()
        for j in range(SIZE):
            put(entries, shared, j, wp.uint64(1000 * i + j))
        put(entries, shared, 3, wp.uint64(7))
        place_of[i] = shared
        for j in range(SIZE):
            out[i, SIZE - 1 - j] = get(entries, shared, SIZE - 1 - j)

    return probe


def test_vectors_of_a_users_kernel_begin_with_zeros() -> None:
    """Also those of the stack's length: only kernels of wrt leave a stack as the memory is."""
    def count(out: wp.array(dtype=wp.int32)) -> None:  # type: ignore[valid-type]
        i = wp.tid()
        dirty, clean = wp.vector(length=STACK_LENGTH, dtype=wp.int32), wp.vector(length=STACK_LENGTH, dtype=wp.int32)
        for j in range(STACK_LENGTH):
            out[i] = out[i] + clean[j]
            dirty[j] = i + 1
        out[i] = out[i] + dirty[0] - i - 1

    out = wp.zeros(THREADS, dtype=wp.int32, device=DEVICE)
    wp.launch(wrt.kernel(count), THREADS, [out], device=DEVICE)
    assert not out.numpy().any()


def test_no_other_vector_of_device_code_has_the_length_of_a_stack() -> None:
    vectors = re.compile(rf"(?:types\.vector|vec_t<)\W*\(?\s*{STACK_LENGTH}\b|length={STACK_LENGTH}\b")
    assert not [path for path in (ROOT / "kernels").rglob("*.[ph]*") if path.suffix in (".py", ".h") and vectors.search(path.read_text())]


@pytest.mark.parametrize("where", PLACES)
def test_get_returns_what_put_stored_and_threads_do_not_share(where: str, monkeypatch: pytest.MonkeyPatch) -> None:
    out = wp.zeros((THREADS, SIZE), dtype=wp.uint64, device=DEVICE)
    places = wp.zeros(THREADS, dtype=wp.uint64, device=DEVICE)
    monkeypatch.setattr("wrt.core.settings.block_dim", BLOCK)
    launch_on(DEVICE, make_probe_kernel(where), THREADS, out, places, None)
    expected = 1000 * np.arange(THREADS)[:, None] + np.arange(SIZE)
    expected[:, 3] = 7
    assert (out.numpy() == expected).all()
    # A virtual GPU runs threads one after another, which hides writes to another thread's entries. So the test reads the addresses: the
    # first entries of all threads of a block must be adjacent.
    first = places.numpy().reshape(-1, BLOCK).astype(np.int64)
    if DEVICE.is_cuda and where == "shared":
        assert (first - first[:, :1] == 8 * np.arange(BLOCK)).all() and (first > 0).all()
    else:
        assert (first == 0).all()


@pytest.mark.skipif(not device.IS_VIRTUAL, reason="run with --device cuda:0: the CPU has one place")
@pytest.mark.parametrize(("name", "entry", "instances"), [("bvh8", 8, False), ("bvh2", ENTRY, False), ("bvh2", ENTRY, True)])
def test_walks_find_the_same_hits_with_either_stack(name: str, entry: int, instances: bool,
                                                              monkeypatch: pytest.MonkeyPatch) -> None:
    """Overlapping triangles make stacks deeper than shared memory holds; instances run two walks at a time."""
    rng = np.random.default_rng(5)
    corners = (rng.normal(size=(800, 1, 3)) * (0.3, 0.3, 4.0) + rng.normal(size=(800, 3, 3))).astype(np.float32)
    mesh = Geometry.of(Mesh(corners.reshape(-1, 3), np.arange(2400, dtype=np.int32).reshape(-1, 3)))
    turned = np.diag([1.0, -1.0, 0.5, 1.0])
    world: Any = place((mesh, np.eye(4)), (mesh, turned), (mesh, turned @ np.diag([0.9, 1.0, -2.0, 1.0]))) if instances else mesh
    origins = (rng.normal(size=(300, 3)) * 0.5 - (0.0, 0.0, 20.0)).astype(np.float32)
    rays = origins, (rng.normal(size=(300, 3)) * 0.02 + (0.0, 0.0, 1.0)).astype(np.float32)
    ends = rng.uniform(5.0, 30.0, 300).astype(np.float32)
    here, there = (build(world, name, device=each) for each in ("cpu", "cuda:0"))
    hits, occluded = here.closest_hit(*rays), here.any_hit(*rays, 0.0, ends)
    deepest = np.asarray(here.closest_hit(*rays, counters=True).counters.stack)
    assert (hits.prim_id >= 0).any() and occluded.any() and not occluded.all() and (deepest > SHARED // entry).mean() > 0.1
    for stack in STACKS:
        monkeypatch.setattr("wrt.core.settings.stack", stack)
        found = there.closest_hit(*rays)
        assert (there.any_hit(*rays, 0.0, ends) == occluded).all()
        for field in ("t", "u", "v", "prim_id"):
            assert getattr(found, field).tobytes() == getattr(hits, field).tobytes()
