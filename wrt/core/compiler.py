"""What wrt changes about Warp's compiler for the CPU. All of it saves time alone; where a release of Warp has other insides, it
does nothing (tests/wrt/core/test_compiler.py then says so)."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from functools import wraps
from inspect import signature
from pathlib import Path
from typing import Any

import warp as wp

POLL = 0.02  # seconds
_first = threading.Lock()


def prepare_compiler(cores: int) -> None:
    """After wp.init(), before the first kernel is compiled; at most `cores` will be compiled at a time."""
    inside = getattr(wp, "_src", None)
    _drop_unused_helpers(getattr(inside, "codegen", None))
    _compile_once(getattr(inside, "codegen", None))
    _resolve_once(getattr(getattr(inside, "codegen", None), "Adjoint", None))
    shared = _share_headers(getattr(getattr(inside, "context", None), "runtime", None))
    _compile_well(getattr(inside, "build", None), threading.BoundedSemaphore(cores), shared)


def _drop_unused_helpers(codegen: Any) -> None:
    """Warp 1.19 writes two helpers for gradients beside every struct, which are not `static`: the compiler keeps them in each
    kernel, although nothing calls them. That was 0.5 s of 1.8 for a kernel that shades."""
    template = getattr(codegen, "struct_template", None)
    if isinstance(template, str):
        codegen.struct_template = template.replace("\nCUDA_CALLABLE", "\nstatic CUDA_CALLABLE")


def _compile_once(codegen: Any) -> None:
    """Of wrt's own kernels, which are large. Warp 1.19 writes one whose threads have an index and which is given arrays twice: for
    arrays without gaps, and for all; that took half as long again. And each is a function that is optimised by itself, and once
    more where it is copied to: into a loop over threads. One that is a single thread need not be there (a tenth of the time)."""
    twice, write = (getattr(codegen, name, None) for name in ("cpu_linear_contiguous_specialization_candidate", "codegen_kernel"))
    if twice is None or write is None:
        return

    def written(kernel: Any, device: str, options: Any) -> Any:
        source = write(kernel, device, options)
        if device == "cpu" and not getattr(kernel.adj, "uses_tid", True) and _is_own(kernel.adj):
            function = f"void {kernel.get_mangled_name()}_cpu_kernel_forward("
            source = source.replace(f"static {function}", f"static WP_NOINLINE {function}")
        return source

    codegen.cpu_linear_contiguous_specialization_candidate = lambda adj, *args: not _is_own(adj) and twice(adj, *args)
    codegen.codegen_kernel = written


def _resolve_once(writer: Any) -> None:
    """Warp 1.19 tries one overload of a built-in function after another at each call of it, which took a third of the time in which
    a source is written. The types of the arguments tell which it is, and ten calls of eleven have had theirs before."""
    plain = getattr(writer, "resolve_func", None)
    if plain is None or list(signature(plain).parameters) != ["adj", "func", "arg_types", "kwarg_types", "min_outputs"]:
        return
    known: dict[Any, Any] = {}

    @wraps(plain)
    def resolve_func(adj: Any, func: Any, arg_types: Any, kwarg_types: Any, min_outputs: Any) -> Any:
        if not func.is_builtin():
            return plain(adj, func, arg_types, kwarg_types, min_outputs)
        call = func, len(func.overloads), arg_types, tuple(kwarg_types.items()), min_outputs
        try:
            found = known.get(call)
        except TypeError:  # a type without a hash
            return plain(adj, func, arg_types, kwarg_types, min_outputs)
        if found is None:
            found = known[call] = plain(adj, func, arg_types, kwarg_types, min_outputs)
        return found

    writer.resolve_func = resolve_func


def _is_own(adj: Any) -> bool:
    return str(adj.func.__module__).startswith("wrt.")


def _compile_well(build: Any, free: threading.Semaphore, shared_headers: bool) -> None:
    """As many at a time as there are cores, while other threads write the sources of what comes next: three on two cores took 1.1
    times as long as two.

    And with flags that Clang's own driver would pass, or that are for what Warp 1.19 precompiles, its headers: without bfloat16,
    where a kernel's source says that it needs none, they take a third less time; templates that they use themselves are compiled
    with them, and not with each kernel (0.04 s of each); and values need no names (a twelfth of a kernel's time)."""
    plain = getattr(build, "build_cpu", None)
    if plain is None or "extra_flags" not in signature(plain).parameters:
        return

    @wraps(plain)
    def build_cpu(obj_path: str, cpp_path: str, *, extra_flags: str = "", **options: Any) -> Any:
        with open(cpp_path, encoding="utf-8") as source:
            without = source.readline().strip() == "#define WP_NO_BFLOAT16"
        flags = ["-fpch-instantiate-templates", "-discard-value-names", *(["-DWP_NO_BFLOAT16="] if without else []), extra_flags]
        waits = shared_headers and options.get("use_precompiled_headers")
        with free, _first_with_headers() if waits else nullcontext():
            return plain(obj_path, cpp_path, extra_flags=" ".join(flags), **options)

    build.build_cpu = build_cpu


def _headers() -> Path:
    """Where they are, for Warp's release and the processor."""
    return Path(wp.config.kernel_cache_dir) / f"precompiled-{wp.get_cpu_kernel_cache_key()}"


def _share_headers(runtime: Any) -> bool:
    """Warp 1.19 precompiles its headers anew for every thread that compiles, in every process: 3.5 s, when a kernel takes 1 to 3.
    Clang writes that file aside and renames it, and looks whether it fits before it takes it, so that all can share one. Returns
    whether they do."""
    own = getattr(runtime, "get_clang_pch_dir", None)
    if own is None or getattr(runtime, "llvm", None) is None:
        return False

    def shared() -> str | None:
        folder = _headers()
        try:
            folder.mkdir(exist_ok=True)
        except OSError:
            return own()
        return str(folder)

    runtime.get_clang_pch_dir = shared
    return True


def headers_missing() -> bool:
    return bool(wp.config.use_precompiled_headers) and not any(_headers().glob("*.pch"))


@wp.kernel(module="unique", enable_backward=False)  # type: ignore[call-arg]
def empty_kernel() -> None:
    """To compile it takes nothing but the headers."""


@contextmanager
def _first_with_headers() -> Iterator[None]:
    """While a kernel is compiled for the CPU. Where the headers are not there yet, the first thread to come makes them, and the
    others wait for that: side by side, each would be slower."""
    mine = False
    while headers_missing() and not (mine := _first.acquire(blocking=False)):
        time.sleep(POLL)
    try:
        yield
    finally:
        if mine:
            _first.release()
