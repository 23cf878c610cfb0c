"""The only file of the virtual GPU with private names of Warp's Python (1.19), and with strings of the C++ that Warp writes.

The methods of driver.Gpus and graphs.Graphs replace Warp's C functions: same names without `wp_`, same arguments. docs/warp.md, "When
Warp changes", says what to adapt first."""

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
LAST_HEADER = '#include "deterministic.h"\n'  # the last header of a CUDA module
BLOCK_DIM = re.compile(r"^#define WP_TILE_BLOCK_DIM (\d+)$", re.MULTILINE)
KERNEL = re.compile(r"\b__global__ void (?:\w+\(\d+\) )?(\w+)\(")
FORWARD = "_cuda_kernel_forward"  # suffix of a kernel's name


def has_started() -> bool:
    return context.runtime is not None


def library() -> Any:
    """Return Warp's C library, or its replacement (driver.Core)."""
    return context.runtime.core


def compiler() -> Any:
    """Return Warp's C library with Clang."""
    return context.runtime.llvm


# --- types ------------------------------------------------------------------------------------------------------------


def is_array(kind: Any) -> bool:
    return bool(matches_array_class(kind, wp.array))


def fields_of(kind: Any) -> Iterator[tuple[str, Any, int]]:
    """Yield the name, type and offset in bytes of each field of a struct; nothing for other types."""
    if isinstance(kind, Struct):
        for name, variable in kind.vars.items():
            yield name, variable.type, getattr(kind.ctype, name).offset


def element_size(kind: Any) -> int:
    """Return the bytes of an element of an array type."""
    return int(type_size_in_bytes(kind.dtype))


def argument_size(kind: Any) -> int:
    """Return the bytes of a kernel's argument of this type."""
    if is_array(kind):
        return ctypes.sizeof(array_t)
    return ctypes.sizeof(kind.ctype) if isinstance(kind, Struct) else int(type_size_in_bytes(kind))


def bounds_size(dimensions: int) -> int:
    """Return the bytes of a kernel's first argument, the bounds of a launch with so many dimensions."""
    return ctypes.sizeof(launch_bounds_t((1,) * dimensions))


def arguments_of(kernel: Any) -> list[tuple[str, Any]]:
    """Return the names and types of a kernel's arguments, without the first."""
    return [(each.label, each.type) for each in kernel.adj.args]


# --- functions that are replaced --------------------------------------------------------------------------------------


def replace(library_of: Callable[[Any, str], Any], name_of: Callable[[str, Any], str], loaded: Callable[[int, Any, int], None],
            on_host: Callable[[str, list[tuple[str, Any, int]]], None]) -> None:
    """Replace functions of Warp; call before Warp starts.

    - library_of(library, path) returns a replacement of the C library that Warp loaded from the path.
    - name_of(name, device) returns the file name of a compiled module for the device, instead of Warp's name.
    - loaded(handle, arguments, dimensions) is called for each kernel that is loaded on a GPU, with names and types of arguments.
    - on_host(kernel, arguments) is called for each launch on the CPU, with name, type and address of each struct or array."""
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
    """Compile C++ to an object file with the CPU's flags; headers: folder for precompiled headers. Return 0, or an error code of
    Clang, which prints the error on stderr."""
    flags = context._resolve_cpu_compiler_flags(None, wp.config.cpu_compiler_flags).split()
    native, given = os.path.join(build.warp_home, "native"), (ctypes.c_char_p * (len(flags) + 1))(*map(str.encode, flags), None)
    return int(compiler().wp_compile_cpp(source.encode(), os.fsencode(name), os.fsencode(native), os.fsencode(path), False, False,
                                         fuse_fp, True, given, level, False, True, os.fsencode(headers), 1))
