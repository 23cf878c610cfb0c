"""Queries run on Warp's current stream, which waits for the stream of tensors; the tensors' stream waits for the results."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import warp as wp

import wrt
from tests import device
from tests.virtual_gpu import gpus, warp_private
from tests.virtual_gpu.graphs import address
from wrt.accel.queries.answers import Hits
from wrt.scene.shapes import icosphere

pytestmark = pytest.mark.skipif(not device.IS_VIRTUAL, reason="run with --device cuda:0")
THEIRS = 12345  # the current stream of the tensors' library
Log = list[tuple[Any, ...]]


class Tensor:
    """A tensor on a GPU with the two methods of DLPack: `__dlpack__` lets the reader's stream wait for the stream of the tensor."""

    def __init__(self, array: wp.array, log: Log) -> None:
        self.array, self.log = array, log

    def __dlpack__(self, stream: int) -> Any:
        self.log.append(("wait", stream, THEIRS))
        return self.array.__dlpack__(stream=-1)

    def __dlpack_device__(self) -> Any:
        return self.array.__dlpack_device__()

    def __array_namespace__(self) -> Any:
        return SimpleNamespace(from_dlpack=lambda array: Tensor(wp.from_dlpack(array.__dlpack__(stream=THEIRS)), self.log))


@pytest.fixture
def log(monkeypatch: pytest.MonkeyPatch) -> Log:
    """Launches by stream, and waits of a stream for another one, in order."""
    out: Log = []
    launch, library = gpus().cuda_launch_kernel, warp_private.library()
    monkeypatch.setattr(gpus(), "cuda_launch_kernel", lambda *args: (out.append(("launch", address(args[9]))), launch(*args))[1])
    monkeypatch.setattr(library, "wp_cuda_stream_wait_stream", lambda *args: out.append(("wait", *map(address, args[:2]))))
    return out


def test_a_query_runs_on_the_current_stream_and_waits_for_that_of_tensors(log: Log) -> None:
    accel = wrt.build(icosphere(2), device="cuda:0")
    rays = [wp.array(each, dtype=wp.vec3, device="cuda:0") for each in np.random.default_rng(0).normal(size=(2, 500, 3))]
    expected, t = accel.closest_hit(*rays), wp.full(500, 3.0, dtype=float, device="cuda:0")
    second, synchronisations = wp.Stream("cuda:0"), gpus().counts.synchronisations
    log.clear()
    with wp.ScopedStream(second, sync_enter=False):
        accel.any_hit(*rays)
        assert log == [("launch", second.cuda_stream)]
        log.clear()
        found = accel.closest_hit(*(Tensor(each, log) for each in rays), t_max=Tensor(t, log))
        before, after = ("wait", second.cuda_stream, THEIRS), ("wait", THEIRS, second.cuda_stream)
        assert log == [before] * 3 + [("launch", second.cuda_stream)] + [after] * 4
        log.clear()
        out = Hits(*(Tensor(wp.empty(500, dtype=kind, device="cuda:0"), log) for kind in (float, float, float, int)))
        again = accel.closest_hit(*(Tensor(each, log) for each in rays), out=out)
        assert log == [before] * 6 + [("launch", second.cuda_stream)] + [after] * 4
    assert gpus().counts.synchronisations == synchronisations
    t = expected.t.numpy()
    assert np.array_equal(out.t.array.numpy(), t) and again.t.array.ptr == out.t.array.ptr
    assert np.array_equal(found.t.array.numpy(), np.where(t <= 3.0, t, np.inf)) and (t <= 3.0).any()
