"""The way to the device: Warp's start, kernels, and the only place that uploads arrays."""

from __future__ import annotations

import contextlib
import errno
import os
import shutil
import sys
import tempfile
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import wait
from contextlib import contextmanager
from functools import partial, wraps
from math import prod
from pathlib import Path
from typing import Any, TypeVar
from weakref import WeakKeyDictionary

import numpy as np
import warp as wp

from wrt.core import cuda, warp_private
from wrt.core.errors import InputError
from wrt.core.kernel_cache import is_whole, remove
from wrt.core.seconds import loading
from wrt.core.threads import run_all, submit, thread_count, with_stack

MOST_ROWS = (1 << 31) - 1
ROOM_TO_COMPILE = 16 << 20  # bytes of disk: sources and object of a kernel, with much to spare
FILES_TO_COMPILE = 64  # likewise, files and folders

if wp.config.log_level == wp.LOG_INFO:  # Warp's default; another level is the user's
    wp.config.log_level = wp.LOG_WARNING


T = TypeVar("T")
_making = threading.RLock()


def made_once(make: Callable[..., T]) -> Callable[..., T]:
    """functools.cache for what several threads may ask for first: one of them makes it, and the others wait for that one.

    Two kernels of the same code would be compiled twice, and two structs of the same fields are different types to Warp.
    """
    known: dict[tuple[Any, ...], T] = {}

    @wraps(make)
    def asked(*key: Any) -> T:
        try:
            return known[key]
        except KeyError:
            pass
        with _making:
            if key not in known:
                known[key] = make(*key)
            return known[key]

    return asked


@contextmanager
def _stderr_without(text: bytes) -> Iterator[None]:
    """Hold stderr back during the block, and let it out again without the lines that have `text` in them: Warp's C++ side
    writes past Python."""
    try:
        held = tempfile.TemporaryFile()
    except OSError:
        held = None
    if held is None or sys.stderr is None:  # nowhere to write; or closed by the caller
        yield
        return
    sys.stderr.flush()
    with held:
        stderr = os.dup(2)
        os.dup2(held.fileno(), 2)
        try:
            yield
        finally:
            os.dup2(stderr, 2)
            os.close(stderr)
            held.seek(0)
            if kept := b"".join(line for line in held.read().splitlines(keepends=True) if text not in line):
                with contextlib.suppress(OSError):  # a full disk
                    os.write(2, kept)


@made_once
def _start_warp() -> None:
    with _stderr_without(warp_private.NO_DRIVER), _cache_told():  # where there is no GPU, it says so each time
        if not os.environ.get("WARP_CACHE_PATH"):
            os.environ.pop("WARP_CACHE_PATH", None)  # empty: Warp would keep its kernels in the current folder
        wp.init()
        warp_private.prepare()


@made_once
def start(device: str) -> Any:
    """Start Warp and return its device of that name ("cpu", "cuda:0"). Raises InputError that lists those there are, and where the
    kernel cache cannot be made."""
    _start_warp()
    try:
        with _stderr_without(warp_private.CUDA_ERROR):  # told by the InputError below
            return wp.get_device(device)
    except Exception as error:  # Warp raises ValueError or RuntimeError, depending on what is wrong with the name
        known = ", ".join(str(d) for d in wp.get_devices())
        raise InputError(f"no device {device!r}; there is {known}") from error


def describe_devices() -> list[str]:
    """One line a device: its name for `--device`, and what it is."""
    start("cpu")
    lines = [f"cpu: {wp.get_device('cpu').name or 'CPU'}, {thread_count(None)} threads"]
    for device in wp.get_cuda_devices():
        lines.append(f"{device.alias}: {device.name}, {device.total_memory / 2**30:.0f} GiB, sm_{device.arch}")
    return lines


def block_dim(device: Any) -> int:
    """Threads of a block of a launch: on the CPU one; the module's default block size would be compiled for nothing."""
    return 1 if device.is_cpu else cuda.block_dim


def memory_of(device: Any) -> float:
    """Bytes that a GPU has free; of the CPU, all of the machine's main memory. Infinite where the system does not tell."""
    if device.is_cuda:
        return float(device.free_memory)
    try:
        return float(os.sysconf("SC_PAGE_SIZE")) * os.sysconf("SC_PHYS_PAGES")
    except (AttributeError, ValueError, OSError):
        return float("inf")


class _Loaded:
    """On which devices (their names) and with which blocks a kernel is loaded; Warp would look at files again each time."""

    def __init__(self) -> None:
        self.devices: set[tuple[str, int]] = set()
        self.lock = threading.Lock()


_loaded: WeakKeyDictionary[Any, _Loaded] = WeakKeyDictionary()


def load_kernel(kernel: Any, device: Any) -> None:
    """Compile a kernel, or take it from the cache, before threads launch it. One thread compiles it; others that ask wait.

    Raises InputError where the cache's folder has no room or cannot be written to.
    """
    loaded, place = _loaded.get(kernel) or _loaded.setdefault(kernel, _Loaded()), (device.alias, block_dim(device))
    if place not in loaded.devices:
        with loading(), loaded.lock:
            if place not in loaded.devices:
                with_stack(partial(_load, kernel, device, place[1]))
                loaded.devices.add(place)


@contextmanager
def preloading(*kernels: Any) -> Iterator[None]:
    """Kernels for the CPU that this thread comes to in the block: those not in the cache are compiled beside each other. Errors are
    told where it comes to them. At the end of the block all have been loaded: a process may be forked after it."""
    missing = [kernel for kernel in kernels if kernel not in _loaded]
    if not missing:
        yield
        return
    loads = [submit(load_kernel, kernel, start("cpu")) for kernel in missing]
    try:
        yield
    finally:
        wait(loads)


def preload_headers(kernel: Any) -> None:
    """Begin to precompile Warp's headers with this small kernel, where the cache is empty: beside what comes before the first
    other kernel. For a process of wrt's own: one that was forked meanwhile would wait for ever. Errors are told where a kernel
    cannot be compiled."""
    cpu = start("cpu")
    if not any(Path(wp.config.kernel_cache_dir).glob(warp_private.IN_CACHE)):
        submit(partial(load_kernel, kernel, cpu))


def _load(kernel: Any, device: Any, block_dim: int) -> None:
    """Load a kernel; what of it is damaged in the cache is compiled anew."""
    with _cache_told():
        files = warp_private.cache_files(kernel, device, block_dim)
        folder, sealed = files[0].parent, warp_private.is_own(kernel)
        before = [path for path in (files if folder.is_dir() else [folder]) if os.path.lexists(path)]
        with contextlib.suppress(Exception):  # told below, if it happens again
            if all(is_whole(path, sealed) for path in files):
                warp_private.load(kernel, device, block_dim)
                return
        for path in before:  # not what another process has compiled since
            remove(path)
        folder.parent.mkdir(parents=True, exist_ok=True)
        _require_room_to_compile(folder.parent)
        warp_private.load(kernel, device, block_dim)


@contextmanager
def _cache_told() -> Iterator[None]:
    """What the system refuses Warp's cache, and what Warp cannot make or load there, is told with the way out."""
    try:
        yield
    except Exception as error:
        if not isinstance(error, OSError | UnicodeError) and not warp_private.is_warps_error(error):
            raise
        reason = "its name is not UTF-8" if isinstance(error, UnicodeError) else getattr(error, "strerror", None) or error
        raise InputError(f"kernels cannot be compiled: {reason} (WARP_CACHE_PATH names another folder)",
                         wp.config.kernel_cache_dir or getattr(error, "filename", None)) from error


def _require_room_to_compile(cache: Path) -> None:
    """Raise OSError where there is no room for a kernel: LLVM ends the process on a full disk."""
    room = float(shutil.disk_usage(cache).free)
    with contextlib.suppress(ImportError):
        import resource

        most = resource.getrlimit(resource.RLIMIT_FSIZE)[0]
        room = min(room, float("inf") if most == resource.RLIM_INFINITY else most)
    if room < ROOM_TO_COMPILE:
        raise OSError(errno.ENOSPC, f"room for {room / 2**20:.1f} MiB, and {ROOM_TO_COMPILE >> 20} are needed")
    if hasattr(os, "statvfs") and (disk := os.statvfs(cache)).f_files and disk.f_favail < FILES_TO_COMPILE:
        raise OSError(errno.ENOSPC, f"room for {disk.f_favail} files, and {FILES_TO_COMPILE} are needed")


def upload(array: np.ndarray, dtype: Any, device: Any) -> Any:
    """A Warp array of `dtype` (a Warp type or struct) from rows of a NumPy array; on the CPU without a copy if it fits. Raises
    InputError for more rows than kernels, whose indices are int32, can reach; the bytes of a row do not count."""
    if len(array) > MOST_ROWS:
        raise InputError(f"{len(array)} rows of {dtype.__name__ if isinstance(dtype, type) else dtype.key} are more than an array"
                         f" on a device can have, 2^31 - 1; a binary tree (bvh2) has the fewest")
    if hasattr(dtype, "numpy_dtype"):  # a struct
        assert array.dtype == record_dtype(dtype)
        rows = np.ascontiguousarray(array).view(np.uint8)
        return _seen_as(wp.array(rows, dtype=wp.uint8, device=device, copy=not rows.flags.writeable), dtype, array.shape)
    array = np.ascontiguousarray(array, dtype=wp.dtype_to_numpy(warp_private.scalar_type(dtype)))
    # A frozen NumPy array (a scene's) cannot be aliased: Warp wants to be able to write.
    return wp.array(array, dtype=dtype, device=device, copy=not array.flags.writeable)


def on_host(array: Any) -> np.ndarray:
    """A Warp array, also of structs, as a NumPy array: of the same memory on the CPU, a copy of what is on a GPU."""
    if not hasattr(array.dtype, "numpy_dtype"):
        return np.asarray(array.numpy())
    layout = record_dtype(array.dtype)
    rows: np.ndarray = _seen_as(array, wp.uint8, (array.size * layout.itemsize,)).numpy()
    return rows.view(layout).reshape(array.shape)


def _seen_as(array: Any, dtype: Any, shape: tuple[int, ...]) -> Any:
    """A Warp array of the same memory, which it keeps."""
    out = wp.array(ptr=array.ptr, dtype=dtype, shape=shape, device=array.device)
    warp_private.keep(out, array)
    return out


def empty_aligned(shape: int | tuple[int, ...], dtype: Any) -> np.ndarray:
    """An array in memory that begins where a cache line does."""
    size = (shape if isinstance(shape, int) else prod(shape)) * np.dtype(dtype).itemsize
    memory = np.empty(size + 64, np.uint8)
    first = -memory.ctypes.data % 64
    return memory[first : first + size].view(dtype).reshape(shape)


@made_once
def record_dtype(struct: Any) -> np.dtype:
    """The memory layout of a Warp struct.

    NumPy parses it by way of `ast`, and CPython 3.11 raises SystemError where two threads do so at the same time. Warp would parse
    it again for each array: `upload` makes and `on_host` reads arrays of structs without that.
    """
    return np.dtype(struct.numpy_dtype())


def records(struct: Any, count: int) -> np.ndarray:
    """`count` zeroed records with the memory layout of a Warp struct, as a NumPy structured array."""
    return np.zeros(count, dtype=record_dtype(struct))


def launch(kernel: Any, n: int, *inputs: Any, threads: int = 1, step: int = 0) -> None:
    """As `launch_on` the CPU."""
    launch_on(start("cpu"), kernel, n, *inputs, threads=threads, step=step)


def launch_on(device: Any, kernel: Any, n: int, *inputs: Any, threads: int = 1, step: int = 0) -> None:
    """Launch a kernel over n; with a step, on the CPU over ranges of so many, on that many threads: the first of each is the input
    that is None. On a GPU it is one launch over all of n, in blocks of wrt.core.cuda.block_dim threads."""
    if n == 0:
        return
    load_kernel(kernel, device)
    step = step if step and device.is_cpu else n

    def job(first: int) -> None:
        wp.launch(kernel, dim=min(step, n - first), device=device, inputs=[first if each is None else each for each in inputs],
                  record_tape=False, block_dim=block_dim(device))

    run_all([partial(job, first) for first in range(0, n, step)], threads)
