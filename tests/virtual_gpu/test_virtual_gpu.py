"""The virtual GPU without wrt: `python -m pytest --device cuda:0 tests/virtual_gpu`."""

from __future__ import annotations

import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from tests import device
from tests.virtual_gpu import VirtualGpuError, gpus
from tests.virtual_gpu.memory import Memory

from wrt.core.device import record_dtype, start  # isort: skip (before warp: it silences Warp's banner)
import warp as wp

pytestmark = pytest.mark.skipif(not device.IS_VIRTUAL, reason="run with --device cuda:0")


@wp.struct
class Row:
    values: wp.array(dtype=float)


@wp.struct
class Rows:
    row: Row
    rows: wp.array(dtype=Row)
    scale: float


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    return __CUDA_ARCH__ + (blockDim.x == 256) + __ffs(i);
#else
    return -1;
#endif
""")
def on_cuda(i: int) -> int: ...


@wp.kernel(enable_backward=False)
def wave(x: wp.array(dtype=float), out: wp.array(dtype=float)):
    i = wp.tid()
    out[i] = wp.sin(x[i]) * 3.0 + x[i]


@wp.kernel(enable_backward=False)
def scale_rows(given: Rows, out: wp.array(dtype=float)):
    i = wp.tid()
    out[i] = given.scale * given.row.values[i] + given.rows[0].values[i]


@wp.kernel(enable_backward=False)
def note(last: wp.array(dtype=int), count: wp.array(dtype=int), branch: wp.array(dtype=int), at: wp.array2d(dtype=int)):
    i, j = wp.tid()
    last[0] = i
    wp.atomic_add(count, 0, 1)
    wp.atomic_max(count, 1, i)
    branch[i] = on_cuda(8)
    at[i, j] = 10 * i + j


@wp.kernel(enable_backward=False, grid_stride=False)
def number(out: wp.array(dtype=int)):
    out[wp.tid()] = wp.tid()


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    __shared__ int mine[WP_TILE_BLOCK_DIM];
    mine[threadIdx.x] = i;
    return mine[threadIdx.x];
#else
    return -1;
#endif
""")
def through_shared_memory(i: int) -> int: ...


@wp.kernel(enable_backward=False)
def share(out: wp.array(dtype=int)):
    out[wp.tid()] = through_shared_memory(wp.tid())


@wp.kernel(enable_backward=False)
def bound(x: wp.array(dtype=float), y: wp.array(dtype=float), out: wp.array2d(dtype=float)):
    i = wp.tid()
    out[i, 0] = wp.min(x[i], y[i])
    out[i, 1] = wp.max(x[i], y[i])
    out[i, 2] = float(wp.min(wp.float64(x[i]), wp.float64(y[i])))
    out[i, 3] = wp.max(wp.vec2(x[i], y[i]))
    out[i, 4] = wp.min(wp.vec2(x[i], 1.0), wp.vec2(y[i], 1.0))[0]
    out[i, 5] = wp.clamp(y[i], x[i], 1.0)
    out[i, 6] = float(wp.max(int(x[i]), 7))


def noted(n: int = 300) -> list[wp.array]:
    arrays = [wp.zeros(shape, dtype=int, device="cuda:0") for shape in (1, 2, n, (n, 3))]
    wp.launch(note, (n, 3), arrays, device="cuda:0")
    return [array.numpy() for array in arrays]


def test_both_devices_give_the_bits_of_the_cpu() -> None:
    x = np.linspace(-3.0, 3.0, 1001, dtype=np.float32)
    out = []
    for name in ("cpu", "cuda:0", "cuda:1"):
        out.append(wp.zeros(len(x), dtype=float, device=name))
        wp.launch(wave, len(x), [wp.array(x, device=name), out[-1]], device=name)
    assert np.abs(out[0].numpy()).max() > 2.0
    assert all((each.numpy() == out[0].numpy()).all() for each in out)


def test_every_thread_runs_once_in_another_order_each_time() -> None:
    last = set()
    for _ in range(6):
        first, count, branch, at = noted()
        last.add(int(first[0]))
        assert count.tolist() == [900, 299]
        assert set(branch) == {750 + 1 + 4}  # __CUDA_ARCH__ + (block of 256) + __ffs(8)
        assert (at == 10 * np.arange(300)[:, None] + np.arange(3)).all()
    assert len(last) > 3


def test_grids_of_both_kinds() -> None:
    out = wp.zeros(70_000, dtype=int, device="cuda:0")
    wp.launch(number, 70_000, [out], device="cuda:0")
    assert (out.numpy() == np.arange(70_000)).all()
    few = wp.zeros(5000, dtype=float, device="cuda:0")
    wp.launch(wave, 5000, [wp.ones(5000, dtype=float, device="cuda:0"), few], device="cuda:0", max_blocks=3)
    assert (few.numpy() == few.numpy()[0]).all() and few.numpy()[0] > 3.0


def freed() -> wp.array:
    array = wp.zeros(8, dtype=float, device="cuda:0")
    return wp.array(ptr=array.ptr, shape=8, dtype=float, device="cuda:0")


WRONG: dict[str, tuple[Callable[[], wp.array], str]] = {
    "the host's": (lambda: wp.zeros(8, dtype=float, device="cpu"), "memory of the host"),
    "freed": (freed, "device memory that was freed"),
    "another device's": (lambda: wp.zeros(8, dtype=float, device="cuda:1"), "byte 0 of 32 on cuda:1"),
}


@pytest.mark.parametrize("wrong", WRONG)
@pytest.mark.parametrize("place", ["x", "given.row.values", r"given.rows\[0\].values"])
def test_the_error_names_an_array_that_is_not_on_the_device(place: str, wrong: str) -> None:
    bad, (good, out) = WRONG[wrong][0](), (wp.ones(8, dtype=float, device="cuda:0") for _ in range(2))
    given, one = Rows(), Row()
    given.row.values, one.values = (bad if place.endswith(each) else good for each in ("row.values", "].values"))
    given.rows = wp.array([one], dtype=Row, device="cuda:0")
    with pytest.raises(VirtualGpuError, match=f"{place} must be 32 bytes on cuda:0, and is {WRONG[wrong][1]}"):
        wp.launch(*((wave, 8, [bad, out]) if place == "x" else (scale_rows, 8, [given, out])), device="cuda:0")


def test_a_kernel_on_the_cpu_that_gets_an_array_of_a_device() -> None:
    given, there = Rows(), wp.ones(8, dtype=float, device="cuda:1")
    given.row.values = there
    with pytest.raises(VirtualGpuError, match=r"given.row.values must be 32 bytes on the host, and is byte 0 of 32 on cuda:1"):
        wp.launch(scale_rows, 8, [given, wp.ones(8, dtype=float, device="cpu")], device="cpu")


def test_an_array_that_ends_too_soon() -> None:
    there = wp.ones(8, dtype=float, device="cuda:0")
    longer = wp.array(ptr=there.ptr, shape=9, dtype=float, device="cuda:0")
    with pytest.raises(VirtualGpuError, match=r"wave\w*: x must be 36 bytes on cuda:0, and is byte 0 of 32 on cuda:0"):
        wp.launch(wave, 8, [longer, wp.ones(9, dtype=float, device="cuda:0")], device="cuda:0")
    with pytest.raises(VirtualGpuError, match="d2h: the source must be 36 bytes"):
        longer.numpy()


def test_memory_is_given_back_and_begins_unwritten() -> None:
    used = gpus().memory.used(0)
    array = wp.empty(1000, dtype=wp.uint8, device="cuda:0")
    assert gpus().memory.used(0) == used + 1000 == 8 * 2**30 - start("cuda:0").free_memory
    assert (array.numpy() == 0xA5).all()
    del array
    assert gpus().memory.used(0) == used
    with pytest.raises(RuntimeError, match="Failed to allocate"):
        wp.empty(2**30 + 2**8, dtype=wp.float64, device="cuda:1")


@pytest.mark.skipif(sys.platform != "linux", reason="/proc is Linux's")
def test_freed_memory_leaves_nothing_behind() -> None:
    memory, maps = Memory(2**30), Path("/proc/self/maps")
    before = len(maps.read_text().splitlines())
    for _ in range(300):
        memory.free(memory.allocate(5000, 0))
    assert len(maps.read_text().splitlines()) < before + 100  # a process may have some 65,000
    with pytest.raises(RuntimeError, match="is freed, and is device memory that was freed"):
        memory.free(memory.begin + 256)


def test_launches_copies_and_waits_are_counted() -> None:
    before = {"launches": gpus().counts.launches.total(), **gpus().counts.copies, "waits": gpus().counts.synchronisations}
    array = wp.array(np.arange(8.0), dtype=float, device="cuda:0")
    wp.launch(wave, 8, [array, wp.clone(array)], device="cuda:0")
    wp.synchronize_device("cuda:0")
    assert (wp.clone(array, device="cuda:1").numpy() == np.arange(8.0)).all()
    after = {"launches": gpus().counts.launches.total(), **gpus().counts.copies, "waits": gpus().counts.synchronisations}
    assert {key: after[key] - before.get(key, 0) for key in after} == {
        "launches": 1, "h2d": 1, "d2h": 1, "d2d": 1, "p2p": 1, "waits": 1}


def test_structs_are_copied_there_and_back() -> None:
    rows = np.zeros(3, record_dtype(Rows))
    rows["scale"] = [1.0, 2.0, 3.0]
    assert (wp.array(rows, dtype=Rows, device="cuda:0").numpy()["scale"] == rows["scale"]).all()


def test_host_code_that_reads_device_memory_ends() -> None:
    code = """if True:
        from tests.virtual_gpu import install
        install(devices=1)
        import ctypes, faulthandler
        import warp as wp
        faulthandler.enable()
        array = wp.ones(4, dtype=float, device="cuda:0")
        print(array.numpy().sum(), flush=True)
        ctypes.string_at(array.ptr, 4)
    """
    ended = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert ended.stdout.splitlines()[-1] == "4.0" and ended.returncode == -signal.SIGSEGV
    assert 'File "<string>", line 9' in ended.stderr


def test_a_function_that_the_virtual_gpu_lacks_is_an_error() -> None:
    points, indices = (wp.zeros(3, dtype=kind, device="cuda:0") for kind in (wp.vec3, wp.int32))
    with pytest.raises(NotImplementedError, match="a virtual GPU has no wp_mesh_create_device"):
        wp.Mesh(points, indices)


def test_binaries_for_real_gpus_are_still_nvidias(tmp_path: Path) -> None:
    binary = Path(wp.compile_aot_module(wave.module, arch=75, module_dir=tmp_path)[0])
    assert binary.suffix == ".cubin" and binary.read_bytes()[18:20] == b"\xbe\x00"  # EM_CUDA, the machine of an ELF file


def test_threads_of_a_block_have_shared_memory() -> None:
    out = wp.zeros(200, dtype=int, device="cuda:0")
    wp.launch(share, 200, [out], device="cuda:0", block_dim=64)
    assert (out.numpy() == np.arange(200)).all()


def test_negative_zero_is_less_than_zero() -> None:
    """CUDA's fminf and fmaxf order the zeros; Warp's functions for the CPU do not."""
    values = np.array([[0.0, -0.0], [-0.0, 0.0], [2.0, 3.0], [np.nan, 1.0], [1.0, np.nan]], np.float32)
    x, y = (wp.array(np.ascontiguousarray(values[:, i]), dtype=float, device="cuda:0") for i in (0, 1))
    out = wp.zeros((5, 7), dtype=float, device="cuda:0")
    wp.launch(bound, 5, [x, y, out], device="cuda:0")
    found = out.numpy()
    for row, low, high, held in zip(found, (-0.0, -0.0, 2.0, 1.0, 1.0), (0.0, 0.0, 3.0, 1.0, 1.0), (0.0, 0.0, 1.0, 1.0, 1.0),
                                    strict=True):
        assert row[:6].tobytes() == np.array([low, high, low, high, low, held], np.float32).tobytes()
    assert (found[:, 6] == 7.0).all()
