"""CPU kernels that launch recorded kernels: with the recorded arguments, with another last argument, or for a range."""

from __future__ import annotations

import gc

import numpy as np
import pytest
import warp as wp

from wrt.accel.queries.raw_launches import Launches
from wrt.kernels.launches import Launch, run, run_range, run_with
from wrt.kernels.structs import kernel


@wp.struct
class Log:
    """Log of launches: the number of `entries`, their values in `what`, and how often each index was in a range."""

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
def take_one(log: Log, first: int, end: int):
    i = first + wp.tid()  # A thread too many leaves its mark behind the range.
    log.seen[i] = log.seen[i] + 1


@kernel
def loop(log: Log, note_launch: Launch):
    run(note_launch)
    while log.entries[0] < 4:  # `note` adds an entry.
        run_with(note_launch, log.entries[0])


@kernel
def ranges(take_launch: Launch):
    run_range(take_launch, 3, 20)
    run_range(take_launch, 8, 9)
    run_range(take_launch, 7, 7)


def recorded(kernel: wp.Kernel, *inputs: object) -> wp.Launch:
    return wp.launch(kernel, dim=1, inputs=inputs, device="cpu", record_cmd=True)


def log() -> Log:
    out = Log()
    out.entries, out.what, out.seen = (wp.zeros(n, dtype=wp.int32, device="cpu") for n in (1, 8, 24))
    return out


def test_a_kernel_launches_another_repeatedly() -> None:
    it, launches = log(), Launches()
    of_note = launches.recorded(recorded(note, it, 10.0, 7))
    gc.collect()
    wp.launch(loop, dim=1, inputs=[it, of_note], device="cpu")
    assert it.what.numpy().tolist() == [70, 10, 20, 30, 0, 0, 0, 0]
    wp.launch(loop, dim=1, inputs=[it, of_note], device="cpu")  # The recorded launch has the last argument that it had.
    assert it.what.numpy()[4] == 30 and it.entries.numpy()[0] == 5


@pytest.mark.parametrize(("kernel", "block"), [(take, 5), (take_one, 1)])
def test_a_range_is_taken_by_as_many_threads_as_it_needs(kernel: wp.Kernel, block: int) -> None:
    it, launches = log(), Launches()
    of_take = launches.recorded(recorded(kernel, it, 0, 0), block)
    gc.collect()
    wp.launch(ranges, dim=1, inputs=[of_take], device="cpu")
    expected = np.zeros(24, np.int32)
    expected[3:20] = 1
    expected[8] += 1
    np.testing.assert_array_equal(it.seen.numpy(), expected)


def test_released_launches_free_their_memory() -> None:
    it = log()
    Launches().recorded(recorded(take, it, 0, 0))
    gc.collect()
    gc.disable()  # Objects in reference cycles stay.
    try:
        before = len(gc.get_objects())
        for _ in range(50):
            Launches().recorded(recorded(take, it, 0, 0))
        assert len(gc.get_objects()) < before + 50
    finally:
        gc.enable()
