"""The measures against Warp's compile times take hold, and change no kernel."""

import os
import shutil
import subprocess
import sys
import threading
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from tests.data import ROOT

from tests.kernel_tools import cpu_only, launch, zeros  # isort: skip
import warp as wp

from wrt.core import compiler
from wrt.core.device import preloading, start
from wrt.kernels.structs import kernel

pytestmark = cpu_only


@wp.struct
class Pair:
    a: wp.vec3
    b: float


@kernel
def add_pairs(pairs: wp.array(dtype=Pair), sums: wp.array(dtype=float)):
    i = wp.tid()
    sums[i] = wp.dot(pairs[i].a, pairs[i].a) + pairs[i].b


def compiled(name: str) -> Path:
    """The folder of a kernel's module in the cache."""
    return next(Path(wp.config.kernel_cache_dir).glob(f"wp_{name}_*"))


def test_a_kernel_holds_what_is_called_alone():
    pairs = np.zeros(3, Pair.numpy_dtype())
    pairs["a"], pairs["b"] = [[1.0, 2.0, 3.0]], [1.0, 2.0, 3.0]
    sums = zeros(3)
    launch(add_pairs, 3, wp.array(pairs, dtype=Pair, device="cpu"), sums)
    assert sums.numpy().tolist() == [15.0, 16.0, 17.0]
    (compiled_object,) = compiled("add_pairs").glob("*.o")
    assert b"add_pairs" in compiled_object.read_bytes() and b"adj_atomic_add" not in compiled_object.read_bytes()


def double_each(numbers: wp.array(dtype=float)):
    i = wp.tid()
    numbers[i] = 2.0 * numbers[i]


def double_all(numbers: wp.array(dtype=float)):
    for i in range(numbers.shape[0]):
        numbers[i] = 2.0 * numbers[i]


def test_a_kernel_of_ours_is_written_once(monkeypatch: pytest.MonkeyPatch):
    twice, called = "_cpu_forward_tasks<true>", "static WP_NOINLINE void"
    for function, threads in ((double_each, 5), (double_all, 1)):
        sources = []
        for module in ("wrt.kernels.pretended", "elsewhere"):
            monkeypatch.setattr(function, "__module__", module)
            monkeypatch.setattr(function, "__qualname__", f"{function.__name__}_{module[:3]}")
            made, numbers = kernel(function), wp.array(np.arange(5.0), dtype=float, device="cpu")
            launch(made, threads, numbers)
            assert numbers.numpy().tolist() == [0.0, 2.0, 4.0, 6.0, 8.0]
            sources.append(next(compiled(function.__qualname__).glob("*.cpp")).read_text())
        ours, anybodys = sources
        assert (called in ours) == (threads == 1) and twice not in ours
        assert called not in anybodys and (twice in anybodys) == (threads > 1)


@kernel
def add_halves(numbers: wp.array(dtype=wp.bfloat16), sums: wp.array(dtype=float)):
    i = wp.tid()
    sums[i] = float(numbers[i]) + 0.5


def test_a_kernel_of_bfloat16_has_headers_with_it():
    start("cpu")
    numbers, sums = wp.array([1.0, 2.0, -4.0], dtype=wp.bfloat16, device="cpu"), zeros(3)
    launch(add_halves, 3, numbers, sums)
    assert sums.numpy().tolist() == [1.5, 2.5, -3.5]


def test_headers_are_precompiled_once_for_all_threads_and_processes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Warp's compiler precompiles what it does not find in its folder."""
    cache = tmp_path / "cache"
    cache.mkdir()
    monkeypatch.setattr(wp.config, "kernel_cache_dir", str(cache))
    without, with_it = tmp_path / "without.cpp", tmp_path / "with.cpp"
    without.write_text("#define WP_NO_BFLOAT16\n")
    with_it.write_text("\n")
    given, precompiled, lock = [], [], threading.Lock()

    def build_cpu(obj_path, cpp_path, extra_flags="", use_precompiled_headers=False, pch_dir=None):
        with lock:
            given.append((Path(cpp_path).name, extra_flags, pch_dir))
        if use_precompiled_headers and pch_dir != "Warp's own" and not any(Path(pch_dir).glob("*.pch")):
            threading.Event().wait(0.02)
            (Path(pch_dir) / "made.pch").write_text("headers")
            precompiled.append(extra_flags)
        Path(obj_path).write_text("object")

    def a_process(processor: bytes = b"a") -> None:
        monkeypatch.setattr(compiler, "_whole", set())
        build = SimpleNamespace(build_cpu=build_cpu)
        compiler._compile_well(build, a_runtime(processor))
        options = {"extra_flags": "-O2", "use_precompiled_headers": True, "pch_dir": None}
        with ThreadPoolExecutor(6) as pool:
            list(pool.map(lambda i: build.build_cpu(str(tmp_path / f"{i}.o"), str((without, with_it)[i % 2]), **options), range(6)))
        assert all(compiler.is_whole(tmp_path / f"{i}.o") for i in range(6))
        build.build_cpu(str(tmp_path / "out.o"), str(with_it))  # without headers

    a_process()
    always = "-fpch-instantiate-templates -discard-value-names"
    flags = {"without.cpp": f"{always} -DWP_NO_BFLOAT16= -O2", "with.cpp": f"{always} -O2"}
    assert sorted(precompiled) == sorted(flags.values()) and (*("with.cpp", always + " "), None) in given
    folders = {name: {folder for each, flag, folder in given if each == name and flag == flags[name]} for name in flags}
    kept = {path for path in cache.iterdir()}
    assert [len(each) for each in folders.values()] == [1, 1] and {Path(*each) for each in folders.values()} == kept
    a_process()
    assert len(precompiled) == 2
    (next(iter(kept)) / "made.pch").write_text("damaged")
    a_process()
    assert len(precompiled) == 3 and set(cache.iterdir()) == kept
    for _ in range(2):
        for processor in (b"a", b"b"):  # with one home; Clang refuses the headers of another processor
            a_process(processor)
    assert len(precompiled) == 5 and len(set(cache.iterdir()) - kept) == 2
    shutil.rmtree(cache)  # as for a kernel that is compiled elsewhere
    given.clear()
    a_process()
    assert {folder for _, _, folder in given} == {"Warp's own", None}


def a_runtime(processor: bytes = b"a") -> SimpleNamespace:
    llvm = SimpleNamespace(wp_get_host_cpu_name=lambda: processor, wp_get_host_cpu_features=lambda: b"+avx")
    return SimpleNamespace(get_clang_pch_dir=lambda: "Warp's own", llvm=llvm)


@pytest.mark.parametrize("there", ["nothing", "a file", "a damaged folder", "a link"])
def test_headers_of_another_process_that_was_faster_are_not_moved(there: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """It uses them: Clang tells when a file is gone that it is about to read."""
    monkeypatch.setattr(wp.config, "kernel_cache_dir", str(tmp_path / "cache"))
    (tmp_path / "cache").mkdir()
    given: list[Path] = []

    def build_cpu(obj_path, cpp_path, *, pch_dir, others=0):
        if others:  # as many processes begin and end while this one precompiles
            headers(others - 1)
        (Path(pch_dir) / "made.pch").write_text("headers")

    def headers(others: int) -> None:
        monkeypatch.setattr(compiler, "_whole", set())
        monkeypatch.setattr(compiler, "_lock", threading.Lock())
        given.append(compiler._headers(partial(build_cpu, others=others), {}, ()))
        inodes.append(given[-1].stat().st_ino)

    inodes: list[int] = []
    headers(0)
    folder = given[0]
    shutil.rmtree(folder)
    if there == "a file":
        folder.touch()
    elif there == "a link":
        folder.symlink_to(tmp_path)
    elif there == "a damaged folder":
        folder.mkdir()
        (folder / "seal").touch()
    inodes.clear()
    headers(2)
    assert len(inodes) == 3 and len({*inodes}) == 1 and {*given} == {folder}
    assert list((tmp_path / "cache").iterdir()) == [folder] and compiler._is_sealed(folder)


@kernel
def mixes(sums: wp.array(dtype=float), v: wp.vec3):
    i = wp.tid()
    a = wp.dot(v * 0.5, v + v) * float(i * i) + wp.max(v[0], v[0] * v[1])
    sums[i] = wp.dot(v * 2.0, v + v) + a + float(wp.max(i, 2 * i))


def test_an_overload_is_looked_for_once(monkeypatch: pytest.MonkeyPatch):
    from warp._src.codegen import Adjoint

    asked, plain = [], Adjoint.resolve_func.__wrapped__

    def resolve_func(adj, func, arg_types, kwarg_types, min_outputs):
        asked.append((func.key, arg_types))
        return plain(adj, func, arg_types, kwarg_types, min_outputs)

    written = []
    monkeypatch.setattr(Adjoint, "resolve_func", resolve_func)
    for _ in range(2):
        asked.clear()
        mixes.adj.build(None)
        written.append((list(asked), list(mixes.adj.blocks[0].body_forward)))
        compiler._resolve_once(Adjoint)
    (each, forward), (once, same) = written
    assert forward == same and set(each) == set(once) and len(set(once)) == len(once) < len(each) - 5


def test_a_warp_with_other_insides_is_left_as_it_is():
    plain = SimpleNamespace(build_cpu=lambda source: source)
    before = plain.build_cpu
    compiler._compile_well(plain, a_runtime())
    compiler._compile_well(plain, SimpleNamespace(get_clang_pch_dir=lambda: "Warp's own"))
    compiler._compile_well(SimpleNamespace(), SimpleNamespace())
    for change in (compiler._compile_once, compiler._drop_unused_helpers, compiler._resolve_once):
        change(SimpleNamespace())
    assert plain.build_cpu is before


@kernel
def add_one(numbers: wp.array(dtype=float)):
    numbers[0] += 1.0


@kernel
def add_two(numbers: wp.array(dtype=float)):
    numbers[0] += 2.0


def test_what_is_preloaded_is_loaded_at_the_end_of_the_block(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """A process that is forked after it has no lock that a thread of its parent holds."""
    start("cpu")
    monkeypatch.setattr(wp.config, "kernel_cache_dir", str(tmp_path))
    numbers = zeros(1)
    with pytest.raises(KeyError), preloading(add_one, add_two):
        launch(add_one, 1, numbers)
        raise KeyError
    assert list(compiled("add_two").glob("*.o"))
    shutil.rmtree(tmp_path)  # what is loaded is not looked for
    with preloading(add_one, add_two):
        launch(add_two, 1, numbers)
    assert numbers.numpy().tolist() == [3.0] and not tmp_path.exists()


PRELOADED = """
from wrt.core.device import preload_headers
preload_headers()
"""


def test_headers_are_made_beforehand_where_the_cache_is_empty(tmp_path: Path):
    environment = os.environ | {"WARP_CACHE_PATH": str(tmp_path), "PYTHONPATH": str(ROOT)}
    for _ in range(2):
        done = subprocess.run([sys.executable, "-c", PRELOADED], cwd=ROOT, capture_output=True, text=True, env=environment)
        assert (done.returncode, done.stdout, done.stderr) == (0, "", "")
        assert len(list(tmp_path.glob("*/precompiled-*/*.pch"))) == 1
