"""What wrt changes about Warp's compiler for the CPU. Both measures save time alone; where a release of Warp has other insides,
they do nothing (tests/wrt/core/test_compiler.py then says so)."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import warp as wp

POLL = 0.02  # seconds
_first = threading.Lock()


def prepare_compiler() -> None:
    """After wp.init(), before the first kernel is compiled."""
    inside = getattr(wp, "_src", None)
    _drop_unused_helpers(getattr(inside, "codegen", None))
    _share_headers(getattr(getattr(inside, "context", None), "runtime", None))


def _drop_unused_helpers(codegen: Any) -> None:
    """Warp 1.19 writes two helpers for gradients beside every struct, which are not `static`: the compiler keeps them in each
    kernel, although nothing calls them. That was 0.5 s of 1.8 for a kernel that shades."""
    template = getattr(codegen, "struct_template", None)
    if isinstance(template, str):
        codegen.struct_template = template.replace("\nCUDA_CALLABLE", "\nstatic CUDA_CALLABLE")


def _headers() -> Path:
    """Where they are, for Warp's release and the processor."""
    return Path(wp.config.kernel_cache_dir) / f"headers-{wp.get_cpu_kernel_cache_key()}"


def _share_headers(runtime: Any) -> None:
    """Warp 1.19 precompiles its headers anew for every thread that compiles, in every process: 3.5 s, when a kernel takes 1 to 3.
    Clang writes that file aside and renames it, and looks whether it fits before it takes it, so that all can share one."""
    own = getattr(runtime, "get_clang_pch_dir", None)
    if own is None or getattr(runtime, "llvm", None) is None:
        return

    def shared() -> str | None:
        folder = _headers()
        try:
            folder.mkdir(exist_ok=True)
        except OSError:
            return own()
        return str(folder)

    runtime.get_clang_pch_dir = shared


@contextmanager
def first_with_headers() -> Iterator[None]:
    """While a kernel is compiled for the CPU. Where the headers are not there yet, the first thread to come makes them, and the
    others wait for that: side by side, each would be slower."""
    mine = False
    while not any(_headers().glob("*.pch")) and not (mine := _first.acquire(blocking=False)):
        time.sleep(POLL)
    try:
        yield
    finally:
        if mine:
            _first.release()
