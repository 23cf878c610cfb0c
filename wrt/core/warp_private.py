"""The only file of the host that names Warp's insides: private names, layouts of arguments, texts, names of files, its compiler.
(kernels/warp_private.py is that of device code.)

All of it was read in Warp 1.19 (WORKS_WITH). A Warp with other insides is refused: by `prepare`, which runs when Warp has started,
or by the self-test in wrt.accel.queries.raw_launches. docs/warp.md lists each assumption, its test, and the order of repair."""

from __future__ import annotations

import ctypes
import os
import re
import threading
from collections.abc import Iterable
from functools import cache, wraps
from hashlib import sha256
from inspect import signature
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import warp as wp

from wrt.core.errors import InputError
from wrt.core.kernel_cache import seal, shared_headers

WORKS_WITH = "warp-lang>=1.19,<1.20"  # as in pyproject.toml


def refusal(what: str) -> InputError:
    """The error for a Warp whose insides differ, in `what`, from those of the versions that wrt works with."""
    return InputError(f"Warp {wp.config.version} is not supported, its insides differ ({what}): install '{WORKS_WITH}'")


try:
    from warp._src import build, codegen, context
    from warp._src.types import array_t
except ImportError as error:
    raise refusal(str(error)) from error

# --- structs and arrays, as kernels get them --------------------------------------------------------------------------


def record_of(value: Any) -> Any:
    """Return an instance of a struct, or a Warp array, as a kernel gets it: a ctypes structure, the same one for each call where
    `value` is a struct."""
    return value.__ctype__()


def array_record(array: np.ndarray) -> Any:
    """Return an array of one dimension as a kernel gets it, read where it is. Nothing keeps its memory.

    A Warp array of the same memory, from which Warp would make this record, takes ten times as long to make."""
    return array_t(array.ctypes.data, ndim=1, shape=array.shape, strides=array.strides)


def struct_record(struct: Any, arrays: Iterable[np.ndarray]) -> Any:
    """Return a Warp struct as a kernel gets it, its first fields these arrays of one dimension. Nothing keeps their memory."""
    out = struct.ctype()
    for name, array in zip(struct.vars, arrays, strict=False):
        setattr(out, name, array_record(array))
    return out


def keep(array: Any, memory: Any) -> None:
    """Let a Warp array that was made of an address keep what its memory belongs to."""
    array._ref = memory


def scalar_type(kind: Any) -> Any:
    """Return the Warp type of the numbers of a vector, a matrix or a number."""
    return getattr(kind, "_wp_scalar_type_", kind)


def row_type(kind: Any) -> np.dtype[Any]:
    """Return the NumPy type of a Warp vector, matrix or number."""
    return np.dtype((wp.dtype_to_numpy(scalar_type(kind)), getattr(kind, "_shape_", ())))


# --- launches ---------------------------------------------------------------------------------------------------------


class Recorded(NamedTuple):
    """Addresses of a launch on the CPU. The machine code at `entry` is a C function of two addresses, `bounds` and `args`.

    bounds: the size of the launch. args: a C struct of all arguments; last: the last one of them. keeps: what owns that memory."""

    entry: int
    bounds: int
    args: int
    last: int
    keeps: Any


def recorded(command: Any) -> Recorded:
    """Return the addresses of a launch that wp.launch(..., device="cpu", record_cmd=True) recorded, of one dimension. `bounds` is
    the command's own; the arguments are a copy."""
    bounds, *params = command.params
    assert len(bounds.shape) == 1, "kernels.launches sets bounds of one dimension"
    args = _args_of(*map(type, params))(*params)
    last = ctypes.addressof(args) + getattr(type(args), f"arg_{len(params) - 1}").offset
    entry = ctypes.cast(command.hooks.forward, ctypes.c_void_p).value or 0
    return Recorded(entry, ctypes.addressof(bounds), ctypes.addressof(args), last, (command, bounds, args))


@cache
def _args_of(*types: Any) -> Any:
    """The C struct of arguments of these types; made once for each, since a class is a circle for the collector."""
    return type("Args", (ctypes.Structure,), {"_fields_": [(f"arg_{i}", each) for i, each in enumerate(types)]})


def recording_tape() -> Any:
    """Return the wp.Tape that records, or None. Warp must have started."""
    return context.runtime.tape


# --- kernels and their files ------------------------------------------------------------------------------------------

IN_CACHE = "wp_*"  # names of the folders of modules in the kernel cache
# Names that killed processes leave there: a folder of a compilation; precompiled headers, of wrt or of older versions of Warp.
LEFTOVER = re.compile(r"wp_\w+_p\d+_t\d+|precompiled-.+")
# Texts in lines that Warp's C++ side writes to stderr, past Python.
NO_DRIVER, CUDA_ERROR = b"NVIDIA CUDA driver", b"Warp CUDA error"


def is_own(kernel: Any) -> bool:
    """Whether a kernel is part of wrt, and not a user's."""
    return _is_ours(kernel.func)


def _is_ours(function: Any) -> bool:
    return str(function.__module__).startswith("wrt.")  # None where code was made by exec


def short_name(kernel: Any) -> str:
    """Return the name of a kernel's function, without the names of the functions around it."""
    return str(kernel.key).rsplit("__", 1)[-1]


def module_hash(kernel: Any, block_dim: int | None) -> bytes:
    """Return the hash of all code that a kernel is compiled from, and of its options. block_dim: None for the module's own."""
    return bytes(kernel.module.get_module_hash(block_dim))


def cache_files(kernel: Any, device: Any, block_dim: int) -> list[Path]:
    """Return the paths of a compiled kernel in the cache: its binary, an object file on the CPU, and its metadata."""
    module = kernel.module
    folder = Path(wp.config.kernel_cache_dir) / module.get_module_identifier(block_dim)
    return [folder / module._get_compile_output_name(device, block_dim=block_dim), folder / module._get_meta_name(block_dim)]


def load(kernel: Any, device: Any, block_dim: int) -> None:
    """Compile a kernel, or take it from the cache. Raises errors of Warp (is_warps_error) and of the system."""
    kernel.module.load(device, block_dim=block_dim)


def is_warps_error(error: BaseException) -> bool:
    """Whether it is one of Warp's own where it cannot compile or load a kernel: a plain Exception."""
    return type(error) is Exception


# --- the compiler -----------------------------------------------------------------------------------------------------

# What wrt changes about Warp's compiler changes how long it takes, and no kernel's results. It holds while a module of wrt is
# compiled, and for no other. Each change names the processor time that it saves of a first render of scenes/whitted.toml with an
# empty kernel cache (`render --size 320x180 --spp 4`, 7.2 s).

_REPLACED = {  # what is replaced, and the parameters of Warp 1.19
    ("Adjoint", "resolve_func"): ("adj", "func", "arg_types", "kwarg_types", "min_outputs"),
    ("Module", "_compile"): ("self", "device", "output_dir", "output_name", "output_arch", "use_ptx", "options"),
    ("codegen", "codegen_struct"): ("struct", "device", "indent_size", "include_tile_helpers"),
    ("codegen", "codegen_kernel"): ("kernel", "device", "options"),
    ("codegen", "cpu_linear_contiguous_specialization_candidate"): ("adj", "block_dim"),
    ("build", "build_cpu"): (
        "obj_path", "cpp_path", "mode", "verify_fp", "fast_math", "fuse_fp", "extra_flags", "optimization_level", "verbose",
        "use_precompiled_headers", "pch_dir", "block_dim", "enable_tiles_in_stack_memory", "extra_include_dirs"),
    ("runtime", "get_clang_pch_dir"): (),
}
FLAGS = "-fpch-instantiate-templates", "-discard-value-names"
_here = threading.local()  # own: whether this thread compiles a module of wrt


def prepare() -> None:
    """Change Warp's compiler for the modules of wrt; after wp.init(), before the first kernel is compiled. Raises InputError where
    Warp has other insides than 1.19."""
    owners = {"Adjoint": codegen.Adjoint, "Module": context.Module, "codegen": codegen, "build": build, "runtime": context.runtime}
    for (owner, name), parameters in _REPLACED.items():
        found = getattr(owners[owner], name, None)
        if found is None or tuple(signature(found).parameters) != parameters:
            raise refusal(f"{owner}.{name}")
    if not hasattr(context.runtime, "tape"):
        raise refusal("runtime.tape")
    _mark_own_modules()
    _drop_unused_helpers()
    _compile_once()
    _resolve_once()
    _compile_well()


def _own() -> bool:
    return getattr(_here, "own", False)


def _mark_own_modules() -> None:
    """Let the other changes know whose module a thread compiles."""
    compile_module = context.Module._compile

    @wraps(compile_module)
    def marked(self: Any, *args: Any, **options: Any) -> Any:
        kernels = self._get_live_kernels()
        _here.own = len(kernels) > 0 and all(map(is_own, kernels))
        try:
            return compile_module(self, *args, **options)
        finally:
            _here.own = False

    context.Module._compile = marked


def _drop_unused_helpers() -> None:
    """Saves 0.4 s. Warp 1.19 writes two helpers for gradients beside every struct. They are not `static`, so the compiler keeps
    them in each kernel, although nothing calls them."""
    write = codegen.codegen_struct

    @wraps(write)
    def written(*args: Any, **options: Any) -> str:
        source: str = write(*args, **options)
        return source.replace("\nCUDA_CALLABLE", "\nstatic CUDA_CALLABLE") if _own() else source

    codegen.codegen_struct = written


def _compile_once() -> None:
    """Saves 0.2 s, and more of scenes with a builder's kernels. Warp 1.19 writes a kernel twice: for arrays without gaps, and for
    all. And it compiles each kernel as a function, and again where that is inlined into the loop over threads: a kernel with a
    single thread needs only the function."""
    twice, write = codegen.cpu_linear_contiguous_specialization_candidate, codegen.codegen_kernel

    @wraps(write)
    def written(kernel: Any, device: str, options: Any) -> str:
        source: str = write(kernel, device, options)
        if device == "cpu" and _own() and not kernel.adj.uses_tid:
            function = f"void {kernel.get_mangled_name()}_cpu_kernel_forward("
            source = source.replace(f"static {function}", f"static WP_NOINLINE {function}")
        return source

    codegen.cpu_linear_contiguous_specialization_candidate = lambda adj, block_dim: not _own() and twice(adj, block_dim)
    codegen.codegen_kernel = written


def _resolve_once() -> None:
    """Saves 0.2 s. Warp 1.19 tries one overload of a built-in function after another at each call of it. The types of the arguments
    tell which it is, and ten calls of eleven have had theirs before. (Types that never come again, such as slices, stay known: a
    few of each kernel of wrt.)"""
    plain = codegen.Adjoint.resolve_func
    known: dict[Any, Any] = {}

    @wraps(plain)
    def resolve_func(adj: Any, func: Any, arg_types: Any, kwarg_types: Any, min_outputs: Any) -> Any:
        if not (_is_ours(adj.func) and func.is_builtin()):
            return plain(adj, func, arg_types, kwarg_types, min_outputs)
        call = func, len(func.overloads), arg_types, tuple(kwarg_types.items()), min_outputs
        try:
            found = known.get(call)
        except TypeError:  # a type without a hash
            return plain(adj, func, arg_types, kwarg_types, min_outputs)
        if found is None:
            found = known[call] = plain(adj, func, arg_types, kwarg_types, min_outputs)
        return found

    codegen.Adjoint.resolve_func = resolve_func


def _compile_well() -> None:
    """Saves 6.4 s. Warp 1.19 precompiles its headers in every thread that compiles: here all threads share them (shared_headers).
    FLAGS compile templates of the headers with them, not with each kernel, and give values no names (0.4 s of it); the headers have
    no bfloat16, where the kernel's source says that it needs none (0.4 s). And each object is sealed: LLVM crashes on a damaged
    one, or runs it."""
    compile_object, own_headers = build.build_cpu, context.runtime.get_clang_pch_dir

    @wraps(compile_object)
    def build_cpu(obj_path: str, cpp_path: str, *, extra_flags: str = "", **options: Any) -> None:
        if not _own():
            compile_object(obj_path, cpp_path, extra_flags=extra_flags, **options)
            return
        with open(cpp_path, encoding="utf-8") as source:
            without = source.readline().strip() == "#define WP_NO_BFLOAT16"
        options["extra_flags"] = " ".join([*FLAGS, *(["-DWP_NO_BFLOAT16="] if without else []), extra_flags])
        if options.get("use_precompiled_headers"):

            def precompile(folder: Path) -> None:
                (folder / "empty.cpp").touch()
                compile_object(str(folder / "empty.o"), str(folder / "empty.cpp"), **{**options, "pch_dir": str(folder)})

            try:
                options["pch_dir"] = str(shared_headers(_headers_key(options), precompile, LEFTOVER))
            except OSError:  # a cache that is read-only, and a kernel that is compiled elsewhere
                options["pch_dir"] = own_headers()
        compile_object(obj_path, cpp_path, **options)
        seal(Path(obj_path))

    build.build_cpu = build_cpu
    context.runtime.get_clang_pch_dir = lambda: None if _own() else own_headers()  # it makes a folder in each thread


def _headers_key(options: dict[str, Any]) -> str:
    """A name for headers that are precompiled with these options. What Clang writes names the processor, and paths and times of the
    headers: it refuses that of any other."""
    llvm, user = context.runtime.llvm, os.getuid() if hasattr(os, "getuid") else ""
    processor = llvm.wp_get_host_cpu_name(), llvm.wp_get_host_cpu_features()
    known = _copy_of_warp(), processor, user, sorted({**options, "pch_dir": None}.items())
    return sha256(repr(known).encode()).hexdigest()[:16]


@cache
def _copy_of_warp() -> tuple[Any, ...]:
    """The place of Warp's headers, and their names, sizes and times."""
    native = Path(wp.__file__).resolve().parent / "native"
    return native, *((str(path), path.stat().st_size, path.stat().st_mtime_ns) for path in sorted(native.rglob("*.h")))
