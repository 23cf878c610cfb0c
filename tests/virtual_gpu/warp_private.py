"""The only file of the virtual GPU that names private names of Warp's Python (1.19), and texts of the sources that it writes.

Warp's C functions, which it replaces, are the methods of driver.Gpus and graphs.Graphs, by their names without `wp_`, with their
arguments; docs/warp.md, "When Warp changes", tells the order of repair."""

from __future__ import annotations

import ctypes
import os
import re
from collections.abc import Callable, Iterator
from typing import Any

import warp as wp
from warp._src import build, context
from warp._src.codegen import Struct
from warp._src.types import array_t, launch_bounds_t, matches_array_class, type_size_in_bytes

__all__ = ["array_t"]

VERSION = "1.19."
LAST_HEADER = '#include "deterministic.h"\n'  # of a CUDA module
BLOCK_DIM = re.compile(r"^#define WP_TILE_BLOCK_DIM (\d+)$", re.MULTILINE)
KERNEL = re.compile(r"\b__global__ void (?:\w+\(\d+\) )?(\w+)\(")
FORWARD = "_cuda_kernel_forward"  # behind a kernel's name


def has_started() -> bool:
    return context.runtime is not None


def library() -> Any:
    """Warp's C library, or what stands in for it (driver.Core)."""
    return context.runtime.core


def compiler() -> Any:
    """Warp's C library that has Clang in it."""
    return context.runtime.llvm


# --- types ------------------------------------------------------------------------------------------------------------


def is_array(kind: Any) -> bool:
    return bool(matches_array_class(kind, wp.array))


def fields_of(kind: Any) -> Iterator[tuple[str, Any, int]]:
    """Of each field of a struct its name, its type and its offset; nothing of another type."""
    if isinstance(kind, Struct):
        for name, variable in kind.vars.items():
            yield name, variable.type, getattr(kind.ctype, name).offset


def element_size(kind: Any) -> int:
    """Bytes of an element of an array of that type."""
    return int(type_size_in_bytes(kind.dtype))


def argument_size(kind: Any) -> int:
    """Bytes of an argument of a kernel."""
    if is_array(kind):
        return ctypes.sizeof(array_t)
    return ctypes.sizeof(kind.ctype) if isinstance(kind, Struct) else int(type_size_in_bytes(kind))


def bounds_size(dimensions: int) -> int:
    """Bytes of the first argument, the size of the launch."""
    return ctypes.sizeof(launch_bounds_t((1,) * dimensions))


def arguments_of(kernel: Any) -> list[tuple[str, Any]]:
    """The names and types of a kernel's arguments behind the first."""
    return [(each.label, each.type) for each in kernel.adj.args]


# --- functions that are replaced --------------------------------------------------------------------------------------


def replace(library_of: Callable[[Any, str], Any], name_of: Callable[[str, Any], str], loaded: Callable[[int, Any, int], None],
            on_host: Callable[[str, list[tuple[str, Any, int]]], None]) -> None:
    """Before Warp starts. library_of: what stands in for the C library that was loaded from a path; name_of: the file for a device
    in place of Warp's; loaded: is told the handle of a kernel on a GPU, the names and types of its arguments, and the dimensions of
    its launches; on_host: is told of each launch on the CPU the kernel's name, and name, type and address of its arguments."""
    load_dll, output_name = context.Runtime.load_dll, context.Module._get_compile_output_name
    get_hooks, invoke = context.ModuleExec.get_kernel_hooks, context.invoke

    def load(self: Any, path: str) -> Any:
        return library_of(load_dll(self, path), path)

    def named(self: Any, device: Any, *args: Any, **kwargs: Any) -> str:
        return name_of(output_name(self, device, *args, **kwargs), device)

    def described(self: Any, kernel: Any) -> Any:
        hooks = get_hooks(self, kernel)
        if self.device.is_cuda:
            loaded(hooks.forward, arguments_of(kernel), kernel.adj.kernel_dim)
        return hooks

    def invoked(kernel: Any, hooks: Any, params: Any, adjoint: bool) -> Any:
        given = zip(arguments_of(kernel), params[1:], strict=False)
        on_host(kernel.key, [(name, kind, ctypes.addressof(value)) for (name, kind), value in given
                             if isinstance(value, ctypes.Structure)])
        return invoke(kernel, hooks, params, adjoint)

    context.Runtime.load_dll = load
    context.invoke = invoked
    context.Module._get_compile_output_name = named
    context.ModuleExec.get_kernel_hooks = described


def compile_for_host(source: str, name: str, path: str, headers: str, *, fuse_fp: bool, level: int) -> int:
    """Compile C++ to an object file with the CPU's flags, and Warp's headers precompiled in a folder. Zero, or an error, which
    Clang has told on stderr."""
    flags = context._resolve_cpu_compiler_flags(None, wp.config.cpu_compiler_flags).split()
    native, given = os.path.join(build.warp_home, "native"), (ctypes.c_char_p * (len(flags) + 1))(*map(str.encode, flags), None)
    return int(compiler().wp_compile_cpp(source.encode(), os.fsencode(name), os.fsencode(native), os.fsencode(path), False, False,
                                         fuse_fp, True, given, level, False, True, os.fsencode(headers), 1))
