"""Replacements of Warp's C functions for CUDA devices. The methods of `Gpus` have the names of the functions in warp/native/warp.h,
without `wp_`. Each call is complete when it returns; errors raise VirtualGpuError at once."""

from __future__ import annotations

import ctypes
import itertools
import os
import threading
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from time import perf_counter
from typing import Any

import numpy as np

from tests.virtual_gpu import warp_private
from tests.virtual_gpu.compiler import SUFFIX, compile_module, entry
from tests.virtual_gpu.graphs import Counts, Graph, Graphs, VirtualGpuError, address, copied
from tests.virtual_gpu.memory import Memory
from tests.virtual_gpu.warp_private import array_t, element_size, fields_of, is_array

CONTEXT = 1 << 8  # handle of the context of cuda:0; that of cuda:1 is one more, and so on
NAME = "virtual GPU"
MOST_BLOCKS = 2**31 - 1  # of a grid in x
# Functions that return a constant.
CONSTANT: dict[str, Any] = {
    "is_cuda_enabled": 1, "cuda_driver_is_initialized": 1, "cuda_device_get_name": NAME.encode(), "cuda_device_get_sm_count": 36,
    "cuda_device_get_max_shared_memory": 48 << 10, "cuda_device_is_uva": 1, "cuda_device_is_mempool_supported": 1,
    "cuda_context_is_primary": 1, "cuda_context_check": 0, "cuda_get_kernel_static_shared_memory": 0, "cuda_stream_is_blocking": 1,
    **dict.fromkeys((
        "cuda_device_get_pageable_memory_access", "cuda_device_get_direct_managed_mem_access_from_host",
        "cuda_device_get_host_native_atomic_supported", "cuda_device_get_managed_memory_supported",
        "cuda_device_get_concurrent_managed_access_supported", "cuda_device_is_ipc_supported", "cuda_device_get_pci_domain_id",
        "cuda_device_get_pci_bus_id", "cuda_device_get_pci_device_id", "cuda_device_set_mempool_release_threshold",
        "cuda_is_peer_access_supported", "cuda_is_peer_access_enabled", "cuda_is_mempool_access_enabled", "cuda_stream_destroy",
        "cuda_stream_register", "cuda_stream_unregister", "cuda_stream_query", "cuda_stream_wait_event", "cuda_stream_wait_stream",
        "cuda_stream_get_priority", "cuda_event_destroy",
        "cuda_event_query"), 0),
}


class Triple(ctypes.Structure):
    _fields_ = [(axis, ctypes.c_uint32) for axis in "xyz"]


class Grid(ctypes.Structure):
    """The struct Grid of device.h."""

    _fields_ = [("blocks", Triple), ("threads", Triple), ("order", ctypes.c_void_p)]


RUN = ctypes.CFUNCTYPE(None, ctypes.c_void_p, ctypes.POINTER(Grid))


@dataclass
class Function:
    """A loaded kernel."""

    name: str
    run: Any  # The C function that runs a grid.
    arguments: list[tuple[str, Any]] = field(default_factory=list)  # Names and types, without the launch's bounds.
    dimensions: int = 1  # Of a launch.


def arrays_of(name: str, kind: Any, at: int) -> Iterator[tuple[str, array_t, int]]:
    """Yield the arrays in a kernel's argument at an address, also those in structs and in arrays of structs: name, array_t of Warp,
    and bytes of an element. An array comes before the arrays in its elements, so that the caller can check first that it is
    readable."""
    if is_array(kind):
        array = array_t.from_address(at)
        yield name, array, element_size(kind)
        if has_arrays(kind.dtype):
            for i in range(array.shape[0]):
                yield from arrays_of(f"{name}[{i}]", kind.dtype, array.data + i * array.strides[0])
    for label, each, offset in fields_of(kind):
        yield from arrays_of(f"{name}.{label}", each, at + offset)


def has_arrays(kind: Any) -> bool:
    """Return whether a type is a struct that contains arrays."""
    return any(is_array(each) or has_arrays(each) for _, each, _ in fields_of(kind))


class Gpus(Graphs):
    """Virtual GPUs. devices: their number; arch: their compute capability, 75 for 7.5; memory: bytes of each device; seed: of the
    random order of a grid's threads, None for ascending order."""

    def __init__(self, real: Any, devices: int, arch: int, seed: int | None, memory: int) -> None:
        self.real, self.devices, self.arch = real, devices, arch
        self.memory, self.counts = Memory(memory), Counts()
        self.random = None if seed is None else np.random.default_rng(seed)
        self.handles, self.objects = itertools.count(1 << 12), dict[int, Any]()
        self.local, self.lock = threading.local(), threading.Lock()
        self.at_work = [threading.Lock() for _ in range(devices)]
        self.streams, self.times, self.active = dict[int, int](), dict[int, float](), dict[int, Graph]()

    # Devices, contexts, streams, events

    def cuda_driver_version(self) -> int:
        return int(self.real.wp_cuda_toolkit_version())

    def cuda_device_get_count(self) -> int:
        return self.devices

    def cuda_device_get_arch(self, device: int) -> int:
        return self.arch

    def cuda_device_get_uuid(self, device: int, out: Any) -> None:
        ctypes.memset(out, device + 1, 16)

    def cuda_device_get_memory_info(self, device: int, free: Any, total: Any) -> None:
        if free is not None:
            free._obj.value = self.memory.limit - self.memory.used(device)
        if total is not None:
            total._obj.value = self.memory.limit

    def cuda_device_get_primary_context(self, device: int) -> int:
        return CONTEXT + device

    def cuda_context_get_device_ordinal(self, context: int) -> int:
        return context - CONTEXT

    @property
    def current(self) -> list[int | None]:
        """The stack of contexts of this thread; the last is current."""
        if not hasattr(self.local, "contexts"):
            self.local.contexts = [None]
        return self.local.contexts  # type: ignore[no-any-return]

    def cuda_context_get_current(self) -> int | None:
        return self.current[-1]

    def cuda_context_set_current(self, context: int | None) -> None:
        self.current[-1] = context

    def cuda_context_push_current(self, context: int) -> None:
        self.current.append(context)

    def cuda_context_pop_current(self) -> None:
        self.current.pop()

    def cuda_context_get_stream(self, context: int) -> int | None:
        return self.streams.get(context)

    def cuda_context_set_stream(self, context: int, stream: Any, sync: int) -> None:
        self.streams[context] = address(stream)

    def cuda_stream_create(self, *args: Any) -> int:
        return next(self.handles)

    def cuda_event_create(self, *args: Any) -> int:
        return next(self.handles)

    def cuda_event_record(self, event: int, *args: Any) -> None:
        self.times[event] = perf_counter()

    def cuda_event_elapsed_time(self, begin: int, end: int) -> float:
        return 1000.0 * (self.times[end] - self.times[begin])

    def cuda_context_synchronize(self, *args: Any) -> bool:
        self.refuse("the host waits for a device")
        with self.lock:
            self.counts.synchronisations += 1
        return True

    cuda_stream_synchronize = cuda_event_synchronize = cuda_context_synchronize

    # Memory

    def alloc_device_default(self, context: int, size: int, *args: Any) -> int:
        at = self.memory.allocate(size, context - CONTEXT)
        if graph := self.active.get(context):
            graph.kept[at] = False
        return at

    def free_device_default(self, context: int, at: Any, *args: Any) -> None:
        for each in (*self.active.values(), *self.objects.values()):
            if isinstance(each, Graph) and address(at) in each.kept:
                each.kept[address(at)] = True
                return
        if address(at):
            self.memory.free(address(at))

    alloc_device_async, free_device_async = alloc_device_default, free_device_default

    def check(self, what: str, at: int, size: int, device: int | None) -> None:
        """Raise VirtualGpuError unless `size` bytes from address `at` are on the device; None: on the host."""
        good = not self.memory.is_device(at) if device is None else self.memory.holds(at, size, device)
        if size and not good:
            place = "the host" if device is None else f"cuda:{device}"
            raise VirtualGpuError(f"{what} must be {size} bytes on {place}, and is {self.memory.describe(at)}")

    def copy(self, kind: str, to: Any, device: int | None, of: Any, other: int | None, size: int) -> bool:
        """Copy `size` bytes from `of` on the device `other` to `to` on `device`; None is the host. kind: the key in Counts."""
        self.check(f"{kind}: the target", address(to), size, device)
        self.check(f"{kind}: the source", address(of), size, other)
        with self.lock:
            self.counts.copies[kind] += 1
            self.counts.bytes[kind] += size
        with self.memory.opened():
            ctypes.memmove(address(to), address(of), size)
        return True

    def memcpy_h2d(self, context: int, to: Any, of: Any, size: int, stream: Any) -> bool:
        self.refuse("memory of the host is copied to a device")
        return self.copy("h2d", to, context - CONTEXT, of, None, size)

    def memcpy_d2h(self, context: int, to: Any, of: Any, size: int, stream: Any) -> bool:
        self.refuse("memory of a device is copied to the host")
        return self.copy("d2h", to, None, of, context - CONTEXT, size)

    def memcpy_d2d(self, context: int, to: Any, of: Any, size: int, stream: Any) -> bool:
        to, of = address(to), address(of)
        return bool(self.do(context, lambda: self.copy("d2d", to, context - CONTEXT, of, context - CONTEXT, size)))

    def memcpy_p2p(self, context: int, to: Any, other: int, of: Any, size: int, stream: Any) -> bool:
        return self.copy("p2p", to, context - CONTEXT, of, other - CONTEXT, size)

    def write(self, what: str, context: int, at: Any, size: int, call: Callable[..., Any], *args: Any) -> Any:
        """Call a function of the host that writes `size` bytes from address `at` of a device (0: not checked)."""
        def now() -> Any:
            self.check(f"{what}: the target", address(at), size, context - CONTEXT)
            with self.memory.opened():
                return call(*args)

        return self.do(context, now)

    def memset_device(self, context: int, at: Any, value: int, size: int, stream: Any) -> bool:
        return bool(self.write("memset", context, at, size, ctypes.memset, address(at), value, size))

    def memtile_device(self, context: int, at: Any, value: Any, size: int, count: int) -> None:
        tile = ctypes.create_string_buffer(ctypes.string_at(address(value), size), size)
        self.write("fill", context, at, size * count, self.real.wp_memtile_host, at, tile, size, count)

    def array_fill_device(self, context: int, *args: Any) -> None:
        self.refuse("an array with gaps is filled")
        with self.memory.opened():
            self.real.wp_array_fill_host(*args)

    def array_copy_device(self, context: int, *args: Any) -> bool:
        self.refuse("an array with gaps is copied")
        with self.lock:
            self.counts.copies["d2d"] += 1
        with self.memory.opened():
            return bool(self.real.wp_array_copy_host(*args))

    def radix_sort_pairs_uint64_device(self, keys: int, values: int, count: int, *args: Any) -> None:
        context = self.current[-1]
        if context is None:
            raise VirtualGpuError("the sort needs a current context (wp.Device.context_guard)")
        self.check("sort: the values", values, 8 * count, context - CONTEXT)
        self.write("sort", context, keys, 16 * count, self.real.wp_radix_sort_pairs_uint64_host, keys, values, count, *args)

    # Modules

    def cuda_compile_program(self, source: bytes, *args: Any) -> int:
        """Compile for the host if the path is a virtual GPU's; else with NVIDIA's compiler, which needs no GPU."""
        arch, fuse_fp, path = args[1], args[11], os.fsdecode(args[15])
        if not path.endswith(SUFFIX):
            nvidias, declared = self.real.wp_cuda_compile_program, warp_private.library().wp_cuda_compile_program
            nvidias.argtypes, nvidias.restype = declared.argtypes, declared.restype
            return int(nvidias(source, *args))
        return compile_module(source.decode(), arch, path, fuse_fp=fuse_fp)

    def cuda_load_module(self, context: int, path: bytes) -> int:
        handle = next(self.handles)
        if warp_private.compiler().wp_load_obj(path, self.module(handle), False):
            raise VirtualGpuError(f"{os.fsdecode(path)} cannot be loaded")
        return handle

    def cuda_unload_module(self, context: int, handle: int) -> None:
        warp_private.compiler().wp_unload_obj(self.module(handle))

    @staticmethod
    def module(handle: int) -> bytes:
        return f"virtual_gpu_{handle}".encode()

    def cuda_get_kernel(self, context: int, handle: int, name: bytes) -> int | None:
        at = warp_private.compiler().wp_lookup(self.module(handle), entry(name.decode()).encode())
        if not at:
            return None
        function = next(self.handles)
        self.objects[function] = Function(name.decode().removesuffix(warp_private.FORWARD), RUN(at))
        return function

    def cuda_configure_kernel_shared_memory(self, function: int, size: int) -> bool:
        if size:
            raise VirtualGpuError(f"{self.objects[function].name} needs dynamic shared memory, which a virtual GPU does not have")
        return True

    # Launches

    def cuda_launch_kernel(self, context: int, handle: int, dim: int, max_blocks: int, block_dim: int, grid_stride: int,
                           cluster_dim: int, shared: int, arguments: Any, *args: Any) -> int:
        """Launch a kernel, with the grid that wp_cuda_launch_kernel chooses (warp/native/warp.cu)."""
        if dim == 0:
            return 0
        function: Function = self.objects[handle]
        threads = block_dim if block_dim > 0 else 256
        needed = -(-dim // threads)
        if grid_stride:
            x = min(needed, max_blocks if max_blocks > 0 else MOST_BLOCKS)
            y = z = 1
        else:
            x = min(needed, (1 << 24) // threads)
            y = min(-(-needed // x), 65535)
            z = -(-needed // (x * y))
        values, held = ctypes.cast(arguments, ctypes.POINTER(ctypes.c_void_p)), list[Any]()
        if self.active.get(context):
            values, held = copied(values, function.dimensions, (kind for _, kind in function.arguments))
        self.do(context, lambda: self.run(function, context, (x, y, z, threads), values, held))
        return 0

    def run(self, function: Function, context: int, size: tuple[int, int, int, int], values: Any, held: list[Any]) -> None:
        """Run a grid of `size` = blocks in x, y and z, and threads per block.

        values: addresses of the arguments, the launch's bounds first; held: copies that the addresses point into, or []."""
        x, y, z, threads = size
        with self.lock:
            order = None if self.random is None else self.random.permutation(x * y * z * threads).astype(np.uint32)
            self.counts.launches[function.name, context - CONTEXT] += 1
        grid = Grid(Triple(x, y, z), Triple(threads, 1, 1), None if order is None else order.ctypes.data)
        with self.at_work[context - CONTEXT], self.memory.opened():
            self.check_arguments(function.name, [(name, kind, values[i + 1]) for i, (name, kind) in enumerate(function.arguments)],
                                 context - CONTEXT)
            function.run(ctypes.addressof(values) if held else address(values), grid)

    def check_arguments(self, kernel: str, arguments: Iterable[tuple[str, Any, int]], device: int | None) -> None:
        """Raise VirtualGpuError with the name of an array that is not on the device (None: the host). arguments: name, type and
        address of each argument."""
        for label, kind, at in arguments:
            for name, array, size in arrays_of(label, kind, at):
                shape, strides = array.shape[:array.ndim], array.strides[:array.ndim]
                if not array.data or 0 in shape:  # an empty array
                    continue
                reach = [(n - 1) * step for n, step in zip(shape, strides, strict=True)]
                first = array.data + sum(min(step, 0) for step in reach)
                self.check(f"{kernel}: {name}", first, sum(map(abs, reach)) + size, device)


class Core:
    """Warp's C library, with the methods of Gpus for functions that need a GPU. Functions for GPUs that Gpus lacks raise an error."""

    def __init__(self, real: Any, gpus: Gpus) -> None:
        self.real, self.gpus = real, gpus

    def __getattr__(self, name: str) -> Any:
        short = name.removeprefix("wp_")
        found: Callable[..., Any]
        if short in CONSTANT:
            def found(*args: Any) -> Any:
                return CONSTANT[short]
        elif hasattr(Gpus, short):
            def found(*args: Any) -> Any:  # not the method itself: Warp writes `argtypes` on it
                return getattr(self.gpus, short)(*args)
        elif short.endswith(("_device", "_device_managed")) or (short.startswith("cuda_") and short != "cuda_toolkit_version"):
            def found(*args: Any) -> Any:
                raise NotImplementedError(f"a virtual GPU has no {name}")
        else:
            found = getattr(self.real, name)
        setattr(self, name, found)
        return found
