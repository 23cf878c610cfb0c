"""Kernel launches on the CPU through hand-made argument records, and a self-test before the first such launch.

For a few rays or triangles, Warp's own arrays and launches take longer than the kernel: a Warp array takes 5 us and its launch 20 us; a
record made by hand takes 1 us and its launch 5 us. A kernel can also launch other kernels in this way.
"""

from collections.abc import Sequence
from functools import partial

import numpy as np
import warp as wp

from wrt.core import device, warp_private
from wrt.core.device import load_kernel, made_once, row_type
from wrt.core.threads import FreeList, run_all
from wrt.core.types import Kernel, WarpStruct
from wrt.core.warp_private import RawLaunch, Recorded, argument_types, array_record, record_of, struct_record
from wrt.kernels.launches import PER_THREAD, Canary, Launch, probe
from wrt.kernels.warp_private import fields_of

STEP = 16384  # elements of a launch: some milliseconds of work, so that Ctrl-C is answered soon
SMALL = 1024  # Up to this number of rays, a copy is faster than kernel records of the caller's arrays.
GUARD = -0x21524111  # initial value of the self-test's memory
GUARDS = 64  # words before and behind the self-test's arrays, because a launch with wrong arguments may read or write there


class Launches:
    """Maker of records of launches, for kernels that launch other kernels. It keeps alive the memory that the records point into."""

    def __init__(self) -> None:
        self.owners: list[object] = []

    def recorded(self, command: wp.Launch, block: int = 1) -> WarpStruct:
        """Convert wp.launch(..., device="cpu", record_cmd=True) to a kernels.launches.Launch. Raises InputError if the self-test fails."""
        check_raw_launches()
        return self.of(warp_private.recorded(command), block)

    def of(self, launch: Recorded, block: int) -> WarpStruct:
        """Convert a recorded launch without the self-test."""
        self.owners.append(launch.owners)
        record = Launch()
        record.entry, record.bounds, record.args, record.tail = launch.entry, launch.bounds, launch.args, launch.last
        record.block = block
        return record


def raw_launch(kernel: Kernel, *inputs: object) -> RawLaunch:
    """Record a launch of one thread with values of the arguments' types. Raises InputError if the self-test fails."""
    check_raw_launches()
    load_kernel(kernel, wp.get_device("cpu"))
    command = wp.launch(kernel, dim=1, inputs=list(inputs), device="cpu", record_cmd=True, record_tape=False)
    return RawLaunch(command)


@made_once
def _free_launches(kernel: Kernel) -> FreeList[RawLaunch]:
    kinds = argument_types(kernel)
    return FreeList(lambda: raw_launch(kernel, *(None if isinstance(kind, wp.array) else kind() for kind in kinds)))


def launch_raw(kernel: Kernel, n: int, *inputs: object, threads: int = 1, step: int = 0) -> None:
    """Launch a kernel on the CPU over n elements, as wrt.core.device.launch does, but with contiguous NumPy arrays, records and structs.

    The caller keeps their memory. An input of None is replaced by the first index of each range of `step` elements. Several threads may
    launch a kernel at a time.
    """
    if n == 0:
        return
    load_kernel(kernel, wp.get_device("cpu"))
    records = [array_record(each) if isinstance(each, np.ndarray) else record_of(each) if hasattr(each, "__ctype__") else each
               for each in inputs]
    free = _free_launches(kernel)

    def job(first: int) -> None:
        command = free.take()
        for i, record in enumerate(records):
            command.set(i, first if record is None else record)
        command.set_dim(min(step or n, n - first))
        command.launch()
        free.give(command)

    run_all([partial(job, first) for first in range(0, n, step or n)], threads)


class RowKernel:
    """A CPU kernel over rows: from some arrays of a struct, the given ones, it computes a row of each other array.

    Few rows go through buffers and a launch that later calls reuse, which takes a tenth of the time of records for new arrays.

    Parameters
    ----------
    kernel
        Kernel whose last two arguments are a struct of one-dimensional arrays and the index of a range's first row.
    given
        Number of the struct's arrays, the first ones, that `rows` gets.
    step
        Number of rows of a launch.
    """

    def __init__(self, kernel: Kernel, given: int, step: int = STEP) -> None:
        self.kernel, self.given, self.step = kernel, given, step
        *self.types, self.struct, _ = argument_types(kernel)
        self.row_types = [row_type(field.dtype) for field in fields_of(self.struct).values()]
        self._free = FreeList(lambda: FewRows(self))

    def rows(self, n: int, given: Sequence[np.ndarray], *inputs: object, threads: int = 1) -> list[np.ndarray]:
        """Return the computed arrays, of n rows each. inputs: records or structs, the kernel's arguments before the struct."""
        if n <= SMALL and all(len(array) <= SMALL for array in given):
            return self._free.run(lambda few: few.rows(n, given, inputs))
        arrays = [np.ascontiguousarray(array, kind.base) for array, kind in zip(given, self.row_types, strict=False)]
        out = [np.empty((n, *kind.shape), kind.base) for kind in self.row_types[self.given:]]
        launch_raw(self.kernel, n, *inputs, struct_record(self.struct, (*arrays, *out)), None, threads=threads, step=self.step)
        return out


class FewRows:
    """Buffers of SMALL rows and a recorded launch of a RowKernel. One thread uses it at a time.

    out: buffers for the computed rows, of at least SMALL rows; None for new ones.
    """

    def __init__(self, kernel: RowKernel, out: Sequence[np.ndarray] | None = None) -> None:
        buffers = [np.empty((SMALL, *kind.shape), kind.base) for kind in kernel.row_types]
        self.given, self.out = buffers[:kernel.given], out or buffers[kernel.given:]
        self.inputs: list[object] = [None] * len(kernel.types)  # of the last launch
        unset = (None if isinstance(kind, wp.array) else kind() for kind in kernel.types)
        self.launch = raw_launch(kernel.kernel, *unset, kernel.struct(), 0)
        self.launch.set(len(self.inputs), struct_record(kernel.struct, [*self.given, *self.out]))

    def compute(self, n: int, given: Sequence[np.ndarray], inputs: Sequence[object]) -> None:
        """Compute the first n rows of `out`."""
        for buffer, array in zip(self.given, given, strict=True):
            buffer[:len(array)] = array
        for i, value in enumerate(inputs):
            record = record_of(value) if hasattr(value, "__ctype__") else value
            if record is not self.inputs[i]:
                self.launch.set(i, record)
                self.inputs[i] = record
        self.launch.set_dim(n)
        self.launch.launch()

    def rows(self, n: int, given: Sequence[np.ndarray], inputs: Sequence[object]) -> list[np.ndarray]:
        self.compute(n, given, inputs)
        return [array[:n].copy() for array in self.out]


def preload_headers() -> None:
    """Start precompiling Warp's headers, by means of the self-test's kernel (wrt.core.device.preload_headers)."""
    device.preload_headers(probe)


def check_raw_launches() -> None:
    """Test hand-made launches, once per process. Raises InputError that names the versions of Warp that wrt supports."""
    load_kernel(probe, wp.get_device("cpu"))
    _test_once()


@made_once
def _test_once() -> None:
    memory, source = np.full(256, GUARD, np.int32), np.arange(256, dtype=np.float32)
    try:
        for what, passes in (("records of arrays", _has_records), ("arguments of launches", _has_arguments),
                             ("launches by kernels", _launches_itself)):
            if not passes(memory, source):
                raise warp_private.refusal(what)
    except (AttributeError, TypeError) as error:
        raise warp_private.refusal(str(error)) from error


def _has_records(memory: np.ndarray, source: np.ndarray) -> bool:
    """Return whether hand-made records of arrays equal the records that Warp makes. This runs before any launch."""
    constant = np.ndarray(source.shape, np.float32, source, strides=(0,))
    for array in (source[8:], constant):
        same = wp.array(ptr=array.ctypes.data, dtype=wp.float32, shape=array.shape, strides=array.strides, device="cpu")
        if bytes(warp_private.array_record(array)) != bytes(warp_private.record_of(same)):
            return False
    canary: WarpStruct = Canary()
    canary.words = wp.array(memory, dtype=wp.int32, device="cpu", copy=False)
    return bytes(warp_private.struct_record(Canary, [memory])) == bytes(warp_private.record_of(canary))


def _has_arguments(memory: np.ndarray, source: np.ndarray) -> bool:
    """Return whether a launch receives hand-made arguments and the size that set_dim sets."""
    first, end = 3, 11
    raw = _raw(memory, source, Launch())
    raw.set(3, first)
    raw.set(4, end)
    raw.set_dim((end - first) // PER_THREAD)
    raw.launch()
    return _wrote(memory, source, first, end)


def _launches_itself(memory: np.ndarray, source: np.ndarray) -> bool:
    """Return whether a kernel that launches another kernel sets the range: the last two arguments, and the size of the launch."""
    first, end = 20, 42
    launches = Launches()
    raw = _raw(memory, source, launches.of(_raw(memory, source, Launch()).recorded, PER_THREAD))
    raw.set(3, first)
    raw.set(4, end)
    raw.launch()
    return _wrote(memory, source, first, end)


def _raw(memory: np.ndarray, source: np.ndarray, launch: WarpStruct) -> RawLaunch:
    """Record a launch of `probe` with one thread and hand-made records of both arrays, without GUARDS words at either end."""
    raw = RawLaunch(wp.launch(probe, dim=1, inputs=[Canary(), None, launch, 0, 0], device="cpu", record_cmd=True, record_tape=False))
    raw.set(0, warp_private.struct_record(Canary, [memory[GUARDS:-GUARDS]]))
    raw.set(1, warp_private.array_record(source[GUARDS:-GUARDS]))
    return raw


def _wrote(memory: np.ndarray, source: np.ndarray, first: int, end: int) -> bool:
    """Return whether the kernel wrote the words [first, end) and no others; reset the memory."""
    expected = np.full_like(memory, GUARD)
    expected[GUARDS + first : GUARDS + end] = source[GUARDS + first : GUARDS + end] + end
    written, memory[:] = memory.copy(), GUARD
    return np.array_equal(written, expected)
