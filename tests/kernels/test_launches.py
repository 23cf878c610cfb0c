"""Kernels of the CPU that launch others: each as it was recorded, with another last argument, or of a range of rays."""

from __future__ import annotations

import gc

import numpy as np
import pytest
import warp as wp

from wrt.kernels.launches import Launch, run, run_range, run_with
from wrt.kernels.structs import kernel
from wrt.renderer.launches import Launches

BLOCK = 5


@wp.struct
class Log:
    """What was launched: `entries` so far, of `what`, and how often each number was in a range."""

    entries: wp.array(dtype=wp.int32)
    what: wp.array(dtype=wp.int32)
    seen: wp.array(dtype=wp.int32)


@kernel
def note(log: Log, scale: float, what: int):
    log.what[log.entries[0]] = int(scale) * what
    log.entries[0] = log.entries[0] + 1


@kernel
def take(log: Log, first: int, end: int):
    for i in range(first + 5 * wp.tid(), wp.min(first + 5 * wp.tid() + 5, end)):
        log.seen[i] = log.seen[i] + 1


@kernel
def loop(log: Log, note_launch: Launch, take_launch: Launch):
    run(note_launch)
    while log.entries[0] < 4:  # which `note` adds to
        run_with(note_launch, log.entries[0])
    run_range(take_launch, 3, 20)
    run_range(take_launch, 8, 9)
    run_range(take_launch, 7, 7)


def recorded(kernel: wp.Kernel, *inputs: object) -> wp.Launch:
    return wp.launch(kernel, dim=1, inputs=inputs, device="cpu", record_cmd=True)


@pytest.mark.parametrize("collected", [False, True])
def test_a_kernel_launches_others(collected: bool) -> None:
    """Also when nothing but Launches knows of them."""
    log, launches = Log(), Launches()
    log.entries, log.what, log.seen = (wp.zeros(n, dtype=wp.int32, device="cpu") for n in (1, 8, 24))
    of_note = launches.recorded(recorded(note, log, 10.0, 7))
    of_take = launches.recorded(recorded(take, log, 0, 0), BLOCK)
    if collected:
        gc.collect()
    wp.launch(loop, dim=1, inputs=[log, of_note, of_take], device="cpu")
    assert log.what.numpy().tolist() == [70, 10, 20, 30, 0, 0, 0, 0]
    expected = np.zeros(24, np.int32)
    expected[3:20] = 1
    expected[8] += 1
    np.testing.assert_array_equal(log.seen.numpy(), expected)
    wp.launch(loop, dim=1, inputs=[log, of_note, of_take], device="cpu")  # again, with what is left of the first time
    assert log.what.numpy()[4] == 30 and log.entries.numpy()[0] == 5 and log.seen.numpy().sum() == 2 * expected.sum()
