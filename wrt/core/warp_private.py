"""Private parts of Warp: names, layouts of arguments, texts, file names, the compiler. No other module of the host uses them.

Device code uses private parts only in kernels/warp_private.py. All assumptions are about Warp 1.17 to 1.19 (WORKS_WITH): `prepare` and the
self-test in wrt.accel.queries.raw_launches refuse a Warp that differs. docs/warp.md lists each assumption and its test."""

import ctypes
import inspect
import os
import re
import threading
from collections.abc import Iterable
from functools import cache, partial, wraps
from hashlib import sha256
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple, TypeAlias
from weakref import WeakKeyDictionary

import numpy as np
import warp as wp

from wrt.core.compiling import shared_headers
from wrt.core.errors import InputError
from wrt.core.types import Device, Kernel, WarpArray, WarpStruct, WarpType

WORKS_WITH = "warp-lang>=1.17,<1.20"  # as in pyproject.toml
Record: TypeAlias = ctypes.Structure  # a kernel argument in the memory layout of the kernel


def refusal(what: str) -> InputError:
    """Return the error for a Warp whose private part `what` differs from those that wrt knows."""
    return InputError(f"Warp {wp.config.version} is not supported, its insides differ ({what})", hint=f"install '{WORKS_WITH}'")


try:
    from warp._src import build, codegen, context
    from warp._src.types import array_t

    _resolve_options, _live_kernels = context.Module.resolve_options, context.Module._get_live_kernels
    _NOT_GUARANTEED = wp.config.DeterministicMode.NOT_GUARANTEED
except (ImportError, AttributeError) as error:
    raise refusal(str(error)) from error

# --- structs and arrays as kernel arguments ---------------------------------------------------------------------------


def record_of(value: WarpStruct | WarpArray) -> Record:
    """Return a struct instance or an array as a kernel argument. Each call for the same struct returns the same record."""
    record: Record = value.__ctype__()
    return record


def array_record(array: np.ndarray) -> Record:
    """Return a one-dimensional array as a kernel argument, without a copy. The caller keeps the memory alive.

    A Warp array of the same memory takes ten times as long to make."""
    return array_t(array.ctypes.data, ndim=1, shape=array.shape, strides=array.strides)


def struct_record(struct: WarpType, fields: Iterable[object]) -> Record:
    """Return a kernel argument of type `struct` with these first fields: numbers, one-dimensional arrays, or None for an empty one.

    The caller keeps the memory of arrays alive."""
    out: Record = struct.ctype()
    for name, value in zip(struct.vars, fields, strict=False):
        if isinstance(value, np.ndarray):
            setattr(out, name, array_record(value))
        elif value is not None:
            setattr(out, name, record_of(value) if isinstance(value, wp.array) else value)
    return out


def keep(array: WarpArray, memory: object) -> None:
    """Let a Warp array that was made from an address keep `memory`, the owner of the address, alive."""
    array._ref = memory


def scalar_type(kind: WarpType) -> WarpType:
    """Return the Warp type of one component of a vector, matrix or scalar type."""
    return getattr(kind, "_wp_scalar_type_", kind)


def row_type(kind: WarpType) -> np.dtype:
    """Return the NumPy type of a Warp vector, matrix or scalar type."""
    return np.dtype((wp.dtype_to_numpy(scalar_type(kind)), getattr(kind, "_shape_", ())))


# --- launches ---------------------------------------------------------------------------------------------------------


class Recorded(NamedTuple):
    """Addresses of a launch on the CPU. The machine code at `entry` is a C function of the two addresses `bounds` and `args`."""

    entry: int
    bounds: int  # Address of the launch's size.
    args: int  # Address of a C struct of all arguments.
    last: int  # Address of the last argument in the struct.
    owners: tuple[Any, ...]  # The launch, its bounds, the struct of its arguments: they own the memory at these addresses.


def recorded(command: wp.Launch) -> Recorded:
    """Return the addresses of a one-dimensional launch that wp.launch(..., device="cpu", record_cmd=True) recorded.

    `bounds` belongs to the command; the arguments are a copy."""
    bounds, *params = command.params
    assert len(bounds.shape) == 1, "kernels.launches sets bounds of one dimension"
    args = _args_of(*map(type, params))(*params)
    last = ctypes.addressof(args) + getattr(type(args), f"arg_{len(params) - 1}").offset
    entry = ctypes.cast(command.hooks.forward, ctypes.c_void_p).value or 0
    return Recorded(entry, ctypes.addressof(bounds), ctypes.addressof(args), last, (command, bounds, args))


class RawLaunch:
    """A recorded launch on the CPU that gets its arguments as records. Only one thread at a time may use it.

    It calls the machine code as wp.Launch does, but keeps the C struct of all arguments, which wp.Launch makes anew: 0.4 us in place
    of 2.3 us. The caller keeps the memory alive that the records point into."""

    def __init__(self, command: wp.Launch) -> None:
        self.recorded = recorded(command)
        _, self._bounds, self._args, *_ = self.recorded.owners
        self._names = [name for name, _ in self._args._fields_]
        self._run = partial(command.hooks.forward, ctypes.byref(self._bounds), ctypes.byref(self._args))

    def set(self, i: int, record: object) -> None:
        """Set argument i: a record or a number."""
        setattr(self._args, self._names[i], record)

    def set_dim(self, n: int) -> None:
        """Set the number of threads."""
        self._bounds.size = self._bounds.shape[0] = n

    def launch(self) -> None:
        """Run the kernel."""
        self._run()


@cache
def _args_of(*types: type) -> type:
    """Return the C struct of arguments of these types. Cached, because each new class is a reference cycle."""
    return type("Args", (ctypes.Structure,), {"_fields_": [(f"arg_{i}", each) for i, each in enumerate(types)]})


def recording_tape() -> wp.Tape | None:
    """Return the wp.Tape that is recording, or None. Warp must have started."""
    return context.runtime.tape


def captures_on_cpu() -> bool:
    """Return True while a graph is captured on the CPU. Warp then records the launches and copies of this thread and runs none."""
    capture = getattr(context.runtime, "_apic_capture", None)  # None before Warp starts
    return capture is not None and capture.device.is_cpu


def refuse_capture(device: Device | None = None) -> None:
    """Raise InputError, which names the called function of wrt, while a graph is captured on the CPU or on `device`.

    Launches that are not Warp's, and NumPy, would run at once, on old values."""
    if not captures_on_cpu() and not (device is not None and device.is_cuda and device.is_capturing):
        return
    name, frame = "a function of wrt", inspect.currentframe()
    while frame:  # the outermost function of wrt is the one that the user called
        if str(frame.f_globals.get("__name__")).startswith("wrt.") and "<" not in frame.f_code.co_qualname:
            name = frame.f_code.co_qualname
        frame = frame.f_back
    raise InputError(f"{name} cannot be captured in a graph",
                     hint="call it before or after the capture (properties of hits: once before), or pass contiguous Warp arrays to what"
                     " docs/moving.md lists; a kernel of your own with wrt.ray_query can be captured, too")


# --- kernels and their files ------------------------------------------------------------------------------------------

IN_CACHE = "wp_*"  # folders of modules in the kernel cache
NO_DRIVER = "NVIDIA CUDA driver"  # in the line that Warp's C++ code writes to file descriptor 2 at each start without a GPU


def is_own(kernel: Kernel) -> bool:
    """Return True if a kernel is part of wrt and not of the user's program."""
    return str(kernel.func.__module__).startswith("wrt.")  # the module of code made by exec is None


def argument_types(kernel: Kernel) -> list[WarpType]:
    """Return the Warp types of a kernel's arguments, in order."""
    return [kind for name, kind in kernel.func.__annotations__.items() if name != "return"]


def short_name(kernel: Kernel) -> str:
    """Return the name of a kernel's function, without the names of the functions around it."""
    return str(kernel.key).rsplit("__", 1)[-1]


def module_hash(kernel: Kernel, block_dim: int | None) -> bytes:
    """Return the hash of a kernel's code and options. block_dim: None stands for the block size of the kernel's module."""
    return bytes(kernel.module.get_module_hash(block_dim))


def cache_files(kernel: Kernel, device: Device, block_dim: int) -> list[Path]:
    """Return the paths of a compiled kernel in the cache: its binary (an object file on the CPU) and its metadata."""
    module = kernel.module
    folder = Path(wp.config.kernel_cache_dir) / module.get_module_identifier(block_dim)
    return [folder / module._get_compile_output_name(device, block_dim=block_dim), folder / module._get_meta_name(block_dim)]


def load(kernel: Kernel, device: Device, block_dim: int) -> None:
    """Compile a kernel, or load it from the cache. Raises errors of Warp (is_warps_error) and of the system."""
    kernel.module.load(device, block_dim=block_dim)


def is_warps_error(error: BaseException) -> bool:
    """Return True for a plain Exception, which Warp raises if it cannot compile or load a kernel."""
    return type(error) is Exception


# --- the compiler -----------------------------------------------------------------------------------------------------

# Settings that change bits or print lines, with Warp's defaults: modules of wrt are compiled with these, whatever wp.config has.
_CONFIG = {"mode": "release", "optimization_level": None, "verify_fp": False, "verify_autograd_array_access": False, "llvm_cuda": False,
           "enable_vector_component_overwrites": False, "default_grid_stride": True}
_OPTIONS = {"max_unroll": 16, "deterministic": _NOT_GUARANTEED, "deterministic_max_records": 0}
# Flags for the CPU of Warp 1.19. Clang of 1.17 and 1.18 refuses them.
_FLAGS = "" if wp.config.version.startswith(("1.17.", "1.18.")) else (
    "-mllvm=-inline-threshold=9000 -mllvm=-inline-cold-callsite-threshold=3000 -mllvm=-slp-recursion-max-depth=4")
# Modules of wrt keep three kinds of the user's flags: the processor, reports of the compiler, and WRT_CHECK (kernels/wide/lanes.h).
_KEPT_FLAG = re.compile(r"(?<!\S)(?:(?:-target-(?:cpu|feature)[ =]|-m(?:arch|cpu|tune)=|-R)\S+|-DWRT_CHECK)")


def _is_own_module(module: Any) -> bool:
    kernels = _live_kernels(module)
    return len(kernels) > 0 and all(map(is_own, kernels))


def _own_flags(flags: str | None) -> str:
    """Return the flags for the CPU of wrt's modules. flags: wp.config.cpu_compiler_flags."""
    return " ".join([*_KEPT_FLAG.findall("-march=native" if flags is None else flags), *_FLAGS.split()])


@wraps(_resolve_options)
def _own_options(self: Any, config: Any, block_dim: int | None = None) -> dict[str, Any]:
    if not _is_own_module(self):
        return dict(_resolve_options(self, config, block_dim))
    own = SimpleNamespace(**{**vars(config), **_CONFIG, "cpu_compiler_flags": _own_flags(config.cpu_compiler_flags)})
    return {**_resolve_options(self, own, block_dim), **_OPTIONS}


context.Module.resolve_options = _own_options  # at once, because kernels are hashed where they are defined, before Warp starts

# The changes below make Warp's compiler faster, and change no result of a kernel. They act only while a module of wrt is compiled. Each
# names the processor time that it saves in a first render of scenes/whitted.toml with an empty kernel cache (docs/warp.md).

_REPLACED = {  # replaced functions, with their parameters in Warp 1.17 to 1.19
    ("Module", "resolve_options"): ("self", "config", "block_dim"),
    ("Module", "_compile"): ("self", "device", "output_dir", "output_name", "output_arch", "use_ptx", "options"),
    ("codegen", "codegen_struct"): ("struct", "device", "indent_size", "include_tile_helpers"),
    ("build", "build_cpu"): (
        "obj_path", "cpp_path", "mode", "verify_fp", "fast_math", "fuse_fp", "extra_flags", "optimization_level", "verbose",
        "use_precompiled_headers", "pch_dir", "block_dim", "enable_tiles_in_stack_memory", "extra_include_dirs"),
    ("runtime", "get_clang_pch_dir"): (),
}
FLAGS = "-fpch-instantiate-templates", "-discard-value-names"
_here = threading.local()  # own: True while this thread compiles a module of wrt


def prepare() -> None:
    """Change Warp's compiler for the modules of wrt. Call it after wp.init() and before the first kernel is compiled.

    Raises InputError if the replaced functions differ from these."""
    owners = {"Module": context.Module, "codegen": codegen, "build": build, "runtime": context.runtime}
    for (owner, name), parameters in _REPLACED.items():
        found = getattr(owners[owner], name, None)
        if found is None or tuple(inspect.signature(found).parameters) != parameters:
            raise refusal(f"{owner}.{name}")
    for name in ("tape", "_apic_capture"):
        if not hasattr(context.runtime, name):
            raise refusal(f"runtime.{name}")
    _mark_own_modules()
    _drop_unused_helpers()
    _compile_well()
    _share_hashes()


def _own() -> bool:
    return getattr(_here, "own", False)


def _mark_own_modules() -> None:
    """Make `_own` return True while a thread compiles a module of wrt."""
    compile_module = context.Module._compile

    @wraps(compile_module)
    def marked(self: Any, *args: Any, **options: Any) -> Any:
        _here.own = _is_own_module(self)
        try:
            return compile_module(self, *args, **options)
        finally:
            _here.own = False

    context.Module._compile = marked


def _drop_unused_helpers() -> None:
    """Make the gradient helpers of structs `static` (saves 0.4 s), so that the compiler drops the unused ones."""
    write = codegen.codegen_struct

    @wraps(write)
    def written(*args: Any, **options: Any) -> str:
        source: str = write(*args, **options)
        return source.replace("\nCUDA_CALLABLE", "\nstatic CUDA_CALLABLE") if _own() else source

    codegen.codegen_struct = written


def _compile_well() -> None:
    """Share precompiled headers between all threads and processes (saves 6.4 s).

    Warp precompiles its headers in every thread that compiles. With FLAGS, the templates of the headers are compiled once, not with
    each kernel, and values have no names (0.4 of the 6.4 s). A kernel whose source begins with `#define WP_NO_BFLOAT16` gets headers
    without bfloat16 (0.4 s)."""
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
                options["pch_dir"] = str(shared_headers(Path(wp.config.kernel_cache_dir), _headers_key(options), precompile))
            except OSError:  # the cache is read-only, and the kernel is compiled in another folder
                options["pch_dir"] = own_headers()
        compile_object(obj_path, cpp_path, **options)

    build.build_cpu = build_cpu
    context.runtime.get_clang_pch_dir = lambda: None if _own() else own_headers()  # it makes a folder in each thread


def _share_hashes() -> None:
    """Hash each function of wrt once, and not with each kernel that calls it (saves 0.05 s of a warm start). The hashes stay the same.

    If Warp's hasher has another form, it stays as it is."""
    hasher = getattr(context, "ModuleHasher", None)
    compute, known = getattr(hasher, "hash_function", None), WeakKeyDictionary[Any, bytes]()
    if compute is None or tuple(inspect.signature(compute).parameters) != ("self", "func"):
        return

    @wraps(compute)
    def hash_function(self: Any, func: Any) -> bytes:
        found: bytes = known.get(func) or compute(self, func)
        if is_own(func):
            known[func] = found
        return found

    context.ModuleHasher.hash_function = hash_function


def _headers_key(options: dict[str, Any]) -> str:
    """Return a name for headers precompiled with these options.

    The name depends on the processor and on paths and times of the headers: Clang refuses precompiled headers made for others."""
    llvm, user = context.runtime.llvm, os.getuid() if hasattr(os, "getuid") else ""
    processor = llvm.wp_get_host_cpu_name(), llvm.wp_get_host_cpu_features()
    key = _native_headers(), processor, user, sorted({**options, "pch_dir": None}.items())
    return sha256(repr(key).encode()).hexdigest()[:16]


@cache
def _native_headers() -> list[tuple[str, int, int]]:
    """Return path, size in bytes and modification time of each of Warp's headers."""
    native = Path(wp.__file__).resolve().parent / "native"
    return [(str(path), path.stat().st_size, path.stat().st_mtime_ns) for path in sorted(native.rglob("*.h"))]
