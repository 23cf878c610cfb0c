"""The two measures against Warp's compile times take hold, and change no kernel."""

import threading
from pathlib import Path

import numpy as np
import pytest

from tests.kernel_tools import cpu_only, launch, zeros  # isort: skip
import warp as wp

from wrt.core import compiler
from wrt.core.device import load_kernel, start
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


def test_all_threads_share_the_precompiled_headers():
    start("cpu")
    folders = []
    asked = [threading.Thread(target=lambda: folders.append(wp._src.context.runtime.get_clang_pch_dir())) for _ in range(2)]
    for thread in asked:
        thread.start()
    for thread in asked:
        thread.join()
    load_kernel(add_pairs, start("cpu"))
    assert folders[0] == folders[1] and Path(folders[0]).parent == Path(wp.config.kernel_cache_dir)
    assert list(Path(folders[0]).glob("*.pch"))


def test_a_folder_that_cannot_be_made_is_not_needed(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    start("cpu")
    (tmp_path / "file").write_text("")
    monkeypatch.setattr(wp.config, "kernel_cache_dir", str(tmp_path / "file"))
    folder = wp._src.context.runtime.get_clang_pch_dir()
    assert Path(folder).is_dir() and tmp_path not in Path(folder).parents


def test_others_wait_for_the_first_until_the_headers_are_there(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    monkeypatch.setattr(compiler, "_headers", lambda: tmp_path)
    inside, left = threading.Event(), threading.Event()

    def compile_second():
        with compiler.first_with_headers():
            inside.set()
        left.set()

    with compiler.first_with_headers():
        second = threading.Thread(target=compile_second)
        second.start()
        assert not inside.wait(5 * compiler.POLL)
        (tmp_path / "made.pch").write_text("")
        assert inside.wait(30.0)
    assert left.wait(30.0)
    second.join()


def test_where_no_headers_are_made_one_compiles_after_another(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    monkeypatch.setattr(compiler, "_headers", lambda: tmp_path)
    most, now, lock = [0], [0], threading.Lock()

    def compile_one():
        with compiler.first_with_headers():
            with lock:
                now[0] += 1
                most[0] = max(most[0], now[0])
            threading.Event().wait(compiler.POLL)
            with lock:
                now[0] -= 1

    threads = [threading.Thread(target=compile_one) for _ in range(3)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert most == [1]
