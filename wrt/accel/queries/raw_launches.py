"""Kernel launches through hand-made argument records, and a self-test before the first such launch.

Warp's own wp.launch takes longer than a small query or a wave of paths. A kernel can also launch other kernels in this way.
"""

import numpy as np
import warp as wp

from wrt.core import device, warp_private
from wrt.core.device import load_kernel, made_once
from wrt.core.types import Kernel, WarpStruct
from wrt.core.warp_private import RawLaunch, Recorded
from wrt.kernels.launch_probe import PER_THREAD, Canary, probe
from wrt.kernels.launches import Launch

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
