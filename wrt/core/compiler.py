"""What wrt changes about Warp's compiler for the CPU, and how it knows a damaged object.

Each change names the processor time that it saves of a first render of scenes/whitted.toml with an empty kernel cache (6.5 s).
Where a release of Warp has other insides, the change is left out (tests/wrt/core/test_compiler.py then says so)."""

from __future__ import annotations

import os
import re
import shutil
import threading
import time
from contextlib import suppress
from functools import cache, wraps
from hashlib import sha256
from inspect import signature
from pathlib import Path
from tempfile import mkdtemp
from typing import Any

import warp as wp

DAY = 86400.0  # seconds: no kernel takes so long to compile
FLAGS = "-fpch-instantiate-templates", "-discard-value-names"
_LEFTOVER = re.compile(r"wp_\w+_p\d+_t\d+|precompiled-.+")
_lock = threading.Lock()
_whole: set[Path] = set()  # folders of headers that this process has looked at
_seals = threading.Event()  # set where objects are sealed


def prepare_compiler() -> None:
    """After wp.init(), before the first kernel is compiled."""
    inside = getattr(wp, "_src", None)
    codegen = getattr(inside, "codegen", None)
    _drop_unused_helpers(codegen)
    _compile_once(codegen)
    _resolve_once(getattr(codegen, "Adjoint", None))
    _compile_well(getattr(inside, "build", None), getattr(getattr(inside, "context", None), "runtime", None))


def _drop_unused_helpers(codegen: Any) -> None:
    """Saves 1.1 s. Warp 1.19 writes two helpers for gradients beside every struct. They are not `static`, so the compiler keeps
    them in each kernel, although nothing calls them."""
    template = getattr(codegen, "struct_template", None)
    if isinstance(template, str):
        codegen.struct_template = template.replace("\nCUDA_CALLABLE", "\nstatic CUDA_CALLABLE")


def _compile_once(codegen: Any) -> None:
    """For wrt's own kernels. Warp 1.19 writes a kernel twice: for arrays without gaps, and for all. Once saves 0.2 s (0.5 s of
    scenes/lens.toml, which has a builder's kernels too). And Warp compiles each kernel as a function, and again where that is
    inlined into the loop over threads. A kernel with a single thread needs only the function, which saves 0.4 s."""
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


def _is_own(adj: Any) -> bool:
    return str(adj.func.__module__).startswith("wrt.")


def _resolve_once(writer: Any) -> None:
    """Saves 0.4 s. Warp 1.19 tries one overload of a built-in function after another at each call of it. The types of the arguments
    tell which it is, and ten calls of eleven have had theirs before."""
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


def _compile_well(build: Any, runtime: Any) -> None:
    """Flags that save 1.7 s: templates of the headers are compiled with them, not with each kernel (0.6 s); values need no names
    (0.4 s); the headers have no bfloat16, where the kernel's source says that it needs none (0.7 s). And each object is sealed with
    its SHA-256, behind all that a linker reads."""
    plain = getattr(build, "build_cpu", None)
    own_headers = getattr(runtime, "get_clang_pch_dir", None)
    name, features = (getattr(getattr(runtime, "llvm", None), f"wp_get_host_cpu_{what}", None) for what in ("name", "features"))
    if plain is None or own_headers is None or name is None or features is None:
        return
    if not {"extra_flags", "pch_dir"} <= set(signature(plain).parameters):
        return

    @wraps(plain)
    def build_cpu(obj_path: str, cpp_path: str, *, extra_flags: str = "", **options: Any) -> Any:
        with open(cpp_path, encoding="utf-8") as source:
            without = source.readline().strip() == "#define WP_NO_BFLOAT16"
        options["extra_flags"] = " ".join([*FLAGS, *(["-DWP_NO_BFLOAT16="] if without else []), extra_flags])
        if options.get("use_precompiled_headers"):
            try:
                options["pch_dir"] = str(_headers(plain, options, (name(), features())))
            except OSError:  # a cache that is read-only, and a kernel that is compiled elsewhere
                options["pch_dir"] = own_headers()
        done = plain(obj_path, cpp_path, **options)
        with open(obj_path, "r+b") as compiled:
            compiled.write(sha256(compiled.read()).digest())
        return done

    build.build_cpu = build_cpu
    runtime.get_clang_pch_dir = lambda: None  # it makes a folder in each thread
    _seals.set()


def _headers(build_cpu: Any, options: dict[str, Any], processor: tuple[bytes, ...]) -> Path:
    """Return the folder of precompiled headers for a compilation with these options. Raises OSError where it cannot be made.

    Saves 2.4 s, and 1.3 s of each later process that compiles: Warp 1.19 precompiles its headers in every thread that compiles.
    Here all threads share them, and all processes of a user with the same copy of Warp on the same kind of processor. What Clang
    writes names the processor, and paths and times of the headers: it refuses that of any other. Headers that nobody has used for a
    day are removed.
    """
    user = os.getuid() if hasattr(os, "getuid") else ""
    key = sha256(repr((_copy_of_warp(), processor, user, sorted({**options, "pch_dir": None}.items()))).encode()).hexdigest()[:16]
    folder = Path(wp.config.kernel_cache_dir) / f"precompiled-{key}"
    with _lock:
        if folder not in _whole or not folder.is_dir():  # the first that asks, or somebody has emptied the cache
            for path in folder.parent.iterdir():
                with suppress(OSError):  # another process was faster
                    if _LEFTOVER.fullmatch(path.name) and path != folder and time.time() - path.lstat().st_mtime > DAY:
                        shutil.rmtree(path)
            if not _is_sealed(folder):
                _precompile_headers(build_cpu, folder, options)
            os.utime(folder)
            _whole.add(folder)
    return folder


@cache
def _copy_of_warp() -> tuple[Any, ...]:
    """The place of Warp's headers, and their names, sizes and times."""
    native = Path(wp.__file__).resolve().parent / "native"
    return native, *((str(path), path.stat().st_size, path.stat().st_mtime_ns) for path in sorted(native.rglob("*.h")))


def _precompile_headers(build_cpu: Any, folder: Path, options: dict[str, Any]) -> None:
    """With an empty source, in a folder aside that is renamed when it is whole. Threads wait for the first; of processes that start
    at once each makes its own, and the first one's stays: it is in use."""
    aside = Path(mkdtemp(prefix=f"{folder.name}-", dir=folder.parent))
    try:
        (aside / "empty.cpp").touch()
        build_cpu(str(aside / "empty.o"), str(aside / "empty.cpp"), **{**options, "pch_dir": str(aside)})
        (aside / "seal").write_bytes(_digest(aside))
        try:
            aside.rename(folder)
        except OSError:
            if not _is_sealed(folder):  # a damaged one, or what is in the way
                folder.rename(folder.with_name(f"{aside.name}-old"))
                aside.rename(folder)
    finally:
        for path in folder.parent.glob(f"{aside.name}*"):
            remove(path)


def _digest(folder: Path) -> bytes:
    return sha256(b"".join(path.read_bytes() for path in sorted(folder.glob("*.pch")))).digest()


def _is_sealed(folder: Path) -> bool:
    try:
        return not folder.is_symlink() and (folder / "seal").read_bytes() == _digest(folder)
    except OSError:
        return False


def remove(path: Path) -> None:
    """Remove a file, a link or a folder that may be there."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)


def is_whole(path: Path) -> bool:
    """Whether a file of the kernel cache is there; of an object, whether its last bytes are the digest of the others. LLVM crashes
    on a damaged object, or runs it."""
    data = path.read_bytes() if path.is_file() else b""
    return len(data) > 0 and (path.suffix != ".o" or not _seals.is_set() or sha256(data[:-32]).digest() == data[-32:])


# To compile it takes nothing but the headers: those of wrt's own kernels, which have these options.
@wp.kernel(module="unique", enable_backward=False, module_options={"fuse_fp": False, "mode": "release"})  # type: ignore[call-arg]
def empty_kernel() -> None:
    pass
