"""Start of Warp, loading and launching of kernels, and copies of arrays to and from a device."""

import os
import sys
import tempfile
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import wait
from contextlib import contextmanager, nullcontext
from functools import cache, partial, wraps
from math import prod
from pathlib import Path
from typing import Any, ParamSpec, TypeVar
from weakref import WeakKeyDictionary

import numpy as np
import numpy.typing as npt
import warp as wp

from wrt.core import settings, warp_private
from wrt.core.building import loading
from wrt.core.compiling import WATCH
from wrt.core.errors import InputError, warn
from wrt.core.threads import run_all, submit, thread_count, with_stack
from wrt.core.types import Device, Kernel, WarpArray, WarpType

MOST_ROWS = (1 << 31) - 1

if wp.config.log_level == wp.LOG_INFO:  # Warp's default; another level is the user's
    wp.config.log_level = wp.LOG_WARNING


P = ParamSpec("P")
T = TypeVar("T")
_making = threading.RLock()


def made_once(make: Callable[P, T]) -> Callable[P, T]:
    """Cache a function's results. If several threads need the same result at once, one thread calls `make` and the others wait.

    Without a cache, a kernel made twice would be compiled twice, and Warp would take a struct made twice for two different types."""
    known: dict[tuple[object, ...], T] = {}

    @wraps(make)
    def cached(*key: Any) -> T:
        try:
            return known[key]
        except KeyError:
            pass
        with _making:
            if key not in known:
                known[key] = make(*key)  # type: ignore[call-arg]
            return known[key]

    return cached  # type: ignore[return-value]


@made_once
def _start_warp() -> None:
    if not os.environ.get("WARP_CACHE_PATH"):
        os.environ.pop("WARP_CACHE_PATH", None)  # empty: Warp would keep its kernels in the current folder
    with _cache_errors(), _without_driver_message():
        wp.init()
        warp_private.prepare()


@contextmanager
def _without_driver_message() -> Iterator[None]:
    """Remove Warp's line about a missing GPU from what the block writes to file descriptor 2, which C++ code writes to directly."""
    if sys.stderr is None:
        yield
        return
    stderr = os.dup(2)
    with tempfile.TemporaryFile("w+") as buffer:
        os.dup2(buffer.fileno(), 2)
        try:
            yield
        finally:
            os.dup2(stderr, 2)
            os.close(stderr)
            buffer.seek(0)
            sys.stderr.writelines(line for line in buffer if warp_private.NO_DRIVER not in line)


def start(device: str) -> Device:
    """Start Warp and return the device with a name such as "cpu" or "cuda:0".

    Raises InputError for an unknown name, with the known names, if the folder of the kernel cache cannot be made, and in a capture."""
    found = _device(device)
    warp_private.refuse_capture(found)
    return found


@made_once
def _device(device: str) -> Device:
    _start_warp()
    try:
        return wp.get_device(device)
    except Exception as error:  # Warp raises ValueError or RuntimeError, depending on what is wrong with the name
        known = ", ".join(str(d) for d in wp.get_devices())
        raise InputError(f"no device {device!r}", argument="device", hint=f"there is {known}") from error


def describe_devices() -> list[str]:
    """Return a line for each device: its name for `--device`, its hardware, and its threads or its memory."""
    start("cpu")
    lines = [f"cpu: {wp.get_device('cpu').name or 'CPU'}, {thread_count(None)} threads"]
    for device in wp.get_cuda_devices():
        lines.append(f"{device.alias}: {device.name}, {device.total_memory / 2**30:.0f} GiB, sm_{device.arch}")
    return lines


def block_dim(device: Device) -> int:
    """Return the number of threads in a block; on the CPU always 1, as Warp would compile a kernel anew for each block size."""
    return 1 if device.is_cpu else settings.block_dim


def memory_of(device: Device) -> float:
    """Return the free bytes of a GPU, or all bytes of main memory for the CPU; infinite if the system does not report them."""
    if device.is_cuda:
        return float(device.free_memory)
    return float(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")) if hasattr(os, "sysconf") else float("inf")


class _Loaded:
    """Pairs (name of the device, block size) for which a kernel is loaded. Without this record, Warp would read files at each launch."""

    def __init__(self) -> None:
        self.devices: set[tuple[str, int]] = set()
        self.lock = threading.Lock()


_loaded: WeakKeyDictionary[Kernel, _Loaded] = WeakKeyDictionary()


def load_kernel(kernel: Kernel, device: Device) -> None:
    """Compile a kernel, or read it from the cache, before threads launch it. One thread compiles it; the others wait.

    Raises InputError if the cache's folder is full or cannot be written to."""
    loaded, place = _loaded.get(kernel) or _loaded.setdefault(kernel, _Loaded()), (device.alias, block_dim(device))
    if place not in loaded.devices:
        with loading(), loaded.lock, _cache_errors():
            if place not in loaded.devices:
                is_cached = all(path.is_file() for path in warp_private.cache_files(kernel, device, place[1]))
                Path(wp.config.kernel_cache_dir).mkdir(parents=True, exist_ok=True)
                with nullcontext() if is_cached else WATCH.compiling():
                    with_stack(partial(warp_private.load, kernel, device, place[1]))
                loaded.devices.add(place)


@contextmanager
def preloading(*kernels: Kernel) -> Iterator[None]:
    """Load kernels for the CPU on other threads while the block runs. Errors of a kernel are raised when it is launched.

    At the end of the block all kernels are loaded, so that the process may be forked."""
    missing = [kernel for kernel in kernels if kernel not in _loaded]
    if not missing:
        yield
        return
    loads = [submit(load_kernel, kernel, start("cpu")) for kernel in missing]
    try:
        yield
    finally:
        wait(loads)


def preload_headers(kernel: Kernel) -> None:
    """If the cache is empty, compile this small kernel in the background, which precompiles Warp's headers.

    Only for wrt's command line: a process that the user forks meanwhile would wait for ever. Errors are raised by the next kernel."""
    cpu = start("cpu")
    if not any(Path(wp.config.kernel_cache_dir).glob(warp_private.IN_CACHE)):
        submit(partial(load_kernel, kernel, cpu))


@contextmanager
def _cache_errors() -> Iterator[None]:
    """Turn errors of the system and of Warp about the kernel cache into an InputError with a hint."""
    try:
        yield
    except Exception as error:
        if not isinstance(error, OSError | UnicodeError) and not warp_private.is_warps_error(error):
            raise
        why = getattr(error, "strerror", None) or error
        raise InputError(f"kernels cannot be compiled: {why}", hint="set WARP_CACHE_PATH to another folder",
                         path=wp.config.kernel_cache_dir or getattr(error, "filename", None)) from error


def upload(array: np.ndarray, dtype: WarpType, device: Device, read_only: bool = False) -> WarpArray:
    """Return a Warp array of `dtype` with the rows of a NumPy array; on the CPU without a copy if type and layout allow it.

    read_only: no kernel writes to the array, so that it may share the memory of an array that is not writeable, such as a scene's.
    Raises InputError for more rows than the int32 indices of kernels can reach, and in a capture."""
    if len(array) > MOST_ROWS:
        raise InputError(f"{len(array)} rows of {dtype.__name__ if isinstance(dtype, type) else dtype.key} are more than an array"
                         f" on a device can have, 2^31 - 1", hint="a binary tree (bvh2) has the fewest")
    if len(array):
        warp_private.refuse_capture(device)
    if hasattr(dtype, "numpy_dtype"):  # a struct
        assert array.dtype == record_dtype(dtype)
        rows = np.ascontiguousarray(array)
        if device.is_cpu and rows.flags.writeable:
            return _array_at(rows.ctypes.data, dtype, rows.shape, device, rows)
        return _view_as(wp.array(rows.view(np.uint8), dtype=wp.uint8, device=device, copy=True), dtype, array.shape)
    array = np.ascontiguousarray(array, dtype=wp.dtype_to_numpy(warp_private.scalar_type(dtype)))
    if read_only and device.is_cpu:
        return _array_at(array.ctypes.data, dtype, array.shape[:1], device, array)
    return wp.array(array, dtype=dtype, device=device, copy=not array.flags.writeable)


def to_device(array: WarpArray, device: Device) -> WarpArray:
    """Return an array of a query on the structure's device. A copy from another device gets a SceneWarning, and is refused in a capture."""
    if array.device != device:
        warp_private.refuse_capture(device if device.is_cuda else array.device)
        warn(f"each call copies arrays from {array.device} to {device}, where the structure and its hits are: pass arrays on {device},"
             f" or build the structure with device={str(array.device)!r}")
    return array.to(device)


def on_host(array: WarpArray) -> np.ndarray:
    """Return a Warp array, also one of structs, as a NumPy array: the same memory on the CPU, a copy from a GPU."""
    warp_private.refuse_capture(array.device)
    if not hasattr(array.dtype, "numpy_dtype"):
        return np.asarray(array.numpy())
    layout = record_dtype(array.dtype)
    rows: np.ndarray = _view_as(array, wp.uint8, (array.size * layout.itemsize,)).numpy()
    return rows.view(layout).reshape(array.shape)


def _view_as(array: WarpArray, dtype: WarpType, shape: tuple[int, ...]) -> WarpArray:
    return _array_at(array.ptr, dtype, shape, array.device, array)


def _array_at(address: int, dtype: WarpType, shape: tuple[int, ...], device: Device, owner: object) -> WarpArray:
    """Return a Warp array of the memory at an address, whose owner it keeps alive."""
    out = wp.array(ptr=address, dtype=dtype, shape=shape, device=device)
    warp_private.keep(out, owner)
    return out


def empty_aligned(shape: int | tuple[int, ...], dtype: npt.DTypeLike) -> np.ndarray:
    """Return an uninitialised array that begins at a cache line (64 bytes)."""
    size = (shape if isinstance(shape, int) else prod(shape)) * np.dtype(dtype).itemsize
    memory = np.empty(size + 64, np.uint8)
    first = -memory.ctypes.data % 64
    return memory[first : first + size].view(dtype).reshape(shape)


def aligned(array: np.ndarray) -> np.ndarray:
    """Return an array that begins at a cache line: the same array, or a copy."""
    if array.ctypes.data % 64 == 0:
        return array
    out = empty_aligned(array.shape, array.dtype)
    out[...] = array
    return out


@made_once
def record_dtype(struct: WarpType) -> np.dtype:
    """Return the memory layout of a Warp struct as a NumPy type.

    The result is cached, because NumPy parses the layout with `ast`: CPython 3.11 raises SystemError if two threads do so at once."""
    return np.dtype(struct.numpy_dtype())


@cache
def row_type(kind: WarpType) -> np.dtype:
    """Return the NumPy type of a row of a Warp type: a struct, a vector or a number."""
    return record_dtype(kind) if hasattr(kind, "numpy_dtype") else warp_private.row_type(kind)


def records(struct: WarpType, count: int) -> np.ndarray:
    """Return `count` zeroed records with the memory layout of a Warp struct, as a NumPy structured array."""
    return np.zeros(count, dtype=record_dtype(struct))


def launch(kernel: Kernel, n: int, *inputs: object, threads: int = 1, step: int = 0) -> None:
    """Launch a kernel on the CPU, see `launch_on`."""
    launch_on(start("cpu"), kernel, n, *inputs, threads=threads, step=step)


def launch_on(device: Device, kernel: Kernel, n: int, *inputs: object, threads: int = 1, step: int = 0, captured: bool = False) -> None:
    """Launch a kernel over n elements. captured: a graph of the CPU may capture the launch, which then has no ranges.

    With a step, the CPU launches the kernel once for each range of `step` elements, on `threads` threads. An input of None is replaced
    by the first index of the range. On a GPU there is one launch, in blocks of wrt.core.settings.block_dim threads."""
    if n == 0:
        return
    if not (captured and device.is_cpu):
        warp_private.refuse_capture()
    load_kernel(kernel, device)
    recorded = device.is_cpu and warp_private.captures_on_cpu()
    step = step if step and device.is_cpu and not recorded else n

    def job(first: int) -> None:
        wp.launch(kernel, dim=min(step, n - first), device=device, inputs=[first if each is None else each for each in inputs],
                  record_tape=False, block_dim=block_dim(device))

    if recorded:
        job(0)  # on this thread: Warp records no launches of others
    else:
        run_all([partial(job, first) for first in range(0, n, step)], threads)
