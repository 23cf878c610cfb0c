"""Kernels of queries and builders, and the memory that they work on: on the CPU without Warp's arrays and launches.

For a few rays or triangles these take longer than the kernel. A Warp array takes 5 us and its launch 20 us; a record made by hand
takes 1 us and its launch 5 us.
"""

from functools import partial

import numpy as np
import warp as wp

from wrt.accel.queries.raw_launches import raw_launch
from wrt.core.device import launch_on, load_kernel, made_once, row_type, upload
from wrt.core.threads import FreeList, run_all
from wrt.core.types import Device, Kernel, WarpArray, WarpType
from wrt.core.warp_private import RawLaunch, argument_types, array_record, record_of, struct_record
from wrt.kernels.warp_private import fields_of

STEP = 16384  # elements of a launch: some milliseconds of work, so that Ctrl-C is answered soon


@made_once
def _free_launches(kernel: Kernel) -> FreeList[RawLaunch]:
    kinds = argument_types(kernel)
    return FreeList(lambda: raw_launch(kernel, *(None if isinstance(kind, wp.array) else kind() for kind in kinds)))


def launch_raw(kernel: Kernel, n: int, *inputs: object, threads: int = 1, step: int = 0) -> None:
    """Launch a kernel on the CPU over n elements, as wrt.core.device.launch does, but with contiguous NumPy arrays, records and structs.

    The caller keeps their memory. An input of None is replaced by the first index of each range of `step` elements.
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


class RawKernel:
    """A kernel whose last argument is the index of a range's first element. Several threads may launch it at a time.

    Parameters
    ----------
    kernel
        Kernel for one element.
    *inputs
        A value of the type of each argument but the last, for a recorded launch.
    step
        Number of elements of a launch.
    """

    def __init__(self, kernel: Kernel, *inputs: object, step: int = STEP) -> None:
        self.kernel, self.inputs, self.step = kernel, inputs, step

    def launch(self, n: int, *inputs: object, threads: int = 1) -> None:
        """Run the kernel on the CPU over n elements: contiguous NumPy arrays, records and Warp structs in.

        The caller keeps their memory.
        """
        launch_raw(self.kernel, n, *inputs, None, threads=threads, step=self.step)


class HostMemory:
    """Memory of kernels on the CPU: NumPy arrays."""

    def empty(self, n: int, kind: WarpType) -> np.ndarray:
        """Return an array of n rows of a Warp type."""
        rows = row_type(kind)
        return np.empty((n, *rows.shape), rows.base)

    def array(self, values: np.ndarray, kind: WarpType) -> np.ndarray:
        """Return values as an array of a Warp type."""
        return np.ascontiguousarray(values, row_type(kind).base)

    def numpy(self, array: np.ndarray) -> np.ndarray:
        """Return an array's values."""
        return array

    def joined(self, parts: list[np.ndarray], kind: WarpType) -> np.ndarray:
        """Return the concatenation of one-dimensional arrays of a Warp type."""
        return np.concatenate([self.empty(0, kind), *parts])

    def struct(self, kind: WarpType, *fields: object) -> object:
        """Return an argument of a struct's type; None is a field that the kernel does not read."""
        return struct_record(kind, fields)

    def launch(self, kernel: RawKernel, n: int, *inputs: object, threads: int) -> None:
        """Run a kernel over n elements."""
        kernel.launch(n, *inputs, threads=threads)


class GpuMemory:
    """Memory of kernels on a GPU: Warp arrays. Methods as those of `HostMemory`."""

    def __init__(self, device: Device) -> None:
        self.device = device

    def empty(self, n: int, kind: WarpType) -> WarpArray:
        return wp.empty(n, dtype=kind, device=self.device)

    def array(self, values: np.ndarray, kind: WarpType) -> WarpArray:
        return upload(values, kind, self.device)

    def numpy(self, array: WarpArray) -> np.ndarray:
        return np.asarray(array.numpy())

    def joined(self, parts: list[WarpArray], kind: WarpType) -> WarpArray:
        out, first = self.empty(sum(map(len, parts)), kind), 0
        for part in parts:
            wp.copy(out, part, dest_offset=first, count=len(part))
            first += len(part)
        return out

    def struct(self, kind: WarpType, *fields: object) -> object:
        out = kind()
        for name, value in zip(fields_of(kind), fields, strict=False):
            if value is not None:
                setattr(out, name, value)
        return out

    def launch(self, kernel: RawKernel, n: int, *inputs: object, threads: int) -> None:
        launch_on(self.device, kernel.kernel, n, *inputs, None)


def kernel_memory(device: Device) -> HostMemory | GpuMemory:
    """Return the memory of kernels on a device."""
    return GpuMemory(device) if device.is_cuda else HostMemory()

