"""Little address space (ulimit -v): told before it is felt. OpenBLAS and LLVM end the process where they get none, and Warp's
libraries and threads need more of it than of memory. Imports nothing that needs any."""

from __future__ import annotations

import os
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext, suppress

from wrt.core.errors import InputError
from wrt.core.memory import address_space

# Bytes, measured with Python 3.11, NumPy 2.4, Warp 1.19 on Linux, and some to spare.
MODULES = 170 << 20  # NumPy, Pydantic and the like, without
BLAS_THREAD = 40 << 20  # which OpenBLAS starts for each core when NumPy is imported, and when SciPy is
SCIPY = 60 << 20  # likewise without
BLAS_THREADS = 64  # at most, in NumPy's wheels
WARP = 512 << 20  # warp.so and warp-clang.so (measured: 356), and a small picture with what writes it
STACK = 8 << 20  # of a thread, where its limit (ulimit -s) is none
LLVM = 160 << 20  # while it compiles the largest kernel (measured: 100), and a small scene is built meanwhile
ARENAS = -8  # M_ARENA_MAX of <malloc.h>
_compiler = threading.Lock()


def require_modules() -> None:
    """Before wrt imports them: raise InputError where the address space does not suffice."""
    if is_limited() and "numpy" not in sys.modules:
        _require_with_blas(MODULES, "NumPy and what else is imported")
        _settle()


def _settle() -> None:
    """See that threads take little address space, and that OpenBLAS has what it needs: later, if none is left, it would try for
    ever."""
    import ctypes

    with suppress(AttributeError, OSError, TypeError):  # another C library, which reserves nothing
        ctypes.CDLL(None).mallopt(ARENAS, 1)  # glibc would reserve 64 MiB for each thread
    import numpy as np

    _ = np.ones((256, 256)) @ np.ones((256, 256))  # its first large product takes a buffer, and keeps it


def require_scipy() -> None:
    """Raise InputError where it does not suffice for SciPy, if that is still to be imported."""
    if "scipy" not in sys.modules:
        _require_with_blas(SCIPY, "SciPy")


def require_warp(threads: int) -> None:
    """Raise InputError where it does not suffice for Warp and so many threads."""
    require(WARP + threads * _stack(), "Warp")
    if is_limited():
        _settle()


@contextmanager
def room_to_compile() -> Iterator[None]:
    """For a compilation; where the address space is limited, there is one at a time. Raises InputError where too little is left."""
    with _compiler if is_limited() else nullcontext():
        require(LLVM, "compiling a kernel")
        yield


def is_limited() -> bool:
    return address_space() < float("inf")


def _require_with_blas(needed: float, what: str) -> None:
    threads = min(_blas_threads(), BLAS_THREADS)
    require(needed + threads * BLAS_THREAD, what, "; OPENBLAS_NUM_THREADS=1 makes it less" if threads > 1 else "")


def require(needed: float, what: str, way_out: str = "") -> None:
    """Raise InputError, which tells both numbers, where `what` takes more bytes of address space than are left."""
    if needed > (left := address_space()):
        raise InputError(f"{what} takes {needed / 2**20:.0f} MiB of address space, and {left / 2**20:.0f} are left: raise its limit"
                         f" (ulimit -v){way_out}")


def is_out_of_memory(error: Exception) -> bool:
    """Whether it is Python's, or what Python and Warp raise where the system gives them no thread or no array."""
    return isinstance(error, MemoryError) or str(error).startswith(("can't start new thread", "Failed to allocate"))


def told_limit() -> str:
    """What to add to such an error: nothing where the address space is not limited."""
    return f" ({address_space() / 2**20:.0f} MiB of address space are left: raise its limit, ulimit -v)" if is_limited() else ""


def _blas_threads() -> int:
    """How many OpenBLAS will start."""
    for name in ("OPENBLAS_NUM_THREADS", "GOTO_NUM_THREADS", "OMP_NUM_THREADS"):
        if os.environ.get(name, "").isdecimal() and int(os.environ[name]) > 0:
            return min(int(os.environ[name]), os.cpu_count() or 1)
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else (os.cpu_count() or 1)


def _stack() -> int:
    try:
        import resource

        soft = resource.getrlimit(resource.RLIMIT_STACK)[0]
    except ImportError:
        return STACK
    return STACK if soft == resource.RLIM_INFINITY else soft
