"""Warp's start, uploads, threads."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from tests.command_line import without_compiling
from tests.data import ROOT
from tests.refused import refused
from wrt.core.device import _stderr_without, describe_devices, memory_of, records, start, upload

import warp as wp  # isort: skip (after wrt.core.device, which silences Warp's banner)



@pytest.mark.parametrize("name", ["nope", "", "cuda:999", "cpu:1", "CPU"])
def test_an_unknown_device_is_refused_with_those_there_are(name: str, capfd: pytest.CaptureFixture[str]) -> None:
    with refused("device", "no device", hint="cpu"):
        start(name)
    assert capfd.readouterr().err == ""  # and Warp's C++ code writes nothing


def test_the_cpu_is_there() -> None:
    assert start("cpu").is_cpu and start("cpu") is start("cpu")
    assert describe_devices()[0].startswith("cpu: ") and len(describe_devices()) == 1 + len(wp.get_cuda_devices())
    assert memory_of(start("cpu")) > 2**28


def test_stderr_loses_only_the_lines_that_are_not_wanted(capfd: pytest.CaptureFixture[str]) -> None:
    with _stderr_without(b"unwanted"):
        os.write(2, b"first\nan unwanted line\n")  # as C++ does, past Python
        os.write(2, b"last, without an end")
    assert capfd.readouterr().err == "first\nlast, without an end"
    with pytest.raises(KeyError), _stderr_without(b"unwanted"):
        os.write(2, b"before the error\n")
        raise KeyError
    os.write(2, b"after it\n")
    assert capfd.readouterr().err == "before the error\nafter it\n"


def test_a_process_without_stderr_can_start(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "stderr", None)
    with _stderr_without(b"x"):
        pass


@pytest.mark.parametrize(("array", "dtype", "shape"), [
    (np.arange(12, dtype=np.float64).reshape(4, 3), wp.vec3, (4, 3)),
    (np.arange(12, dtype=np.float32).reshape(3, 4).T, wp.vec3, (4, 3)),  # not contiguous
    (np.arange(5), wp.int32, (5,)),
    (np.zeros((0, 3)), wp.vec3, (0, 3)),
    (np.arange(4, dtype=np.uint8), wp.uint8, (4,)),
])
def test_upload_keeps_the_values(array: np.ndarray, dtype: type, shape: tuple[int, ...]) -> None:
    back = upload(array, dtype, start("cpu")).numpy()
    assert back.shape == shape and np.array_equal(back, array)


def test_upload_never_lets_a_device_write_into_a_frozen_array() -> None:
    open_array, frozen = np.zeros(4, np.float32), np.zeros(4, np.float32)
    frozen.setflags(write=False)
    for array in (open_array, frozen):
        upload(array, wp.float32, start("cpu")).fill_(1.0)
    assert open_array.tolist() == [1.0] * 4  # no copy where none is needed
    assert frozen.tolist() == [0.0] * 4


@wp.struct
class Pair:
    number: wp.int32
    vector: wp.vec3


def test_records_go_up_and_come_back() -> None:
    rows = records(Pair, 3)
    assert rows.shape == (3,) and not rows["number"].any() and not rows["vector"].any()
    rows["number"], rows["vector"][1] = (7, 8, 9), (1, 2, 3)
    back = upload(rows, Pair, start("cpu")).numpy()
    assert np.shares_memory(back, rows)
    assert back["number"].tolist() == [7, 8, 9] and back["vector"][1].tolist() == [1, 2, 3]


FULL_CACHE = """
import resource, sys, numpy as np, wrt
mesh = wrt.Mesh(np.eye(3), np.array([[0, 1, 2]]))
resource.setrlimit(resource.RLIMIT_FSIZE, (int(sys.argv[1]), resource.RLIM_INFINITY))
try:
    print(wrt.build(mesh, "brute_force").closest_hit(np.zeros((1, 3)), np.ones((1, 3))).t)
except wrt.InputError as error:
    print(error)
"""


def test_a_full_disk_under_the_kernel_cache_is_one_message(tmp_path: Path) -> None:
    """LLVM would end the process. A compiled kernel needs no room, unless another kind of processor compiled it."""
    full = "cannot be compiled: there is room for 1.0 MiB, but 16 MiB are needed; set WARP_CACHE_PATH"
    for limit, told in (("1000000", full), ("1000000000", "[0.333"), ("1000000", "[0.333"), ("1000000", full)):
        if told == full:
            for compiled in tmp_path.rglob("*.o"):
                compiled.rename(compiled.with_name(compiled.name.replace(".cpu", ".cpu0")))
        done = subprocess.run([sys.executable, "-c", FULL_CACHE, limit], cwd=ROOT, capture_output=True, text=True, check=True,
                              env=os.environ | {"WARP_CACHE_PATH": str(tmp_path)})
        assert told in done.stdout, done


@pytest.mark.parametrize("environment", [{"WARP_CACHE_PATH": "/dev/null/cache"}, {"HOME": "/dev/null"}], ids=str)
def test_a_kernel_cache_that_cannot_be_made_is_one_message(environment: dict[str, str]) -> None:
    without = {name: value for name, value in os.environ.items() if name not in ("WARP_CACHE_PATH", "XDG_CACHE_HOME", "HOME")}
    done = subprocess.run([sys.executable, "-m", "wrt", "devices"], cwd=ROOT, capture_output=True, text=True,
                          env={**without, "PYTHONPATH": str(ROOT), **environment})
    assert done.returncode == 2 and done.stdout == "" and done.stderr.count("\n") == 1, done
    assert done.stderr.startswith("error: /dev/null/") and done.stderr.endswith("; set WARP_CACHE_PATH to another folder\n")


READ_ONLY_CACHE = """
import ctypes, os, numpy as np, warp, wrt
accel = wrt.build(wrt.Mesh(np.eye(3), np.array([[0, 1, 2]])), "brute_force")
os.chmod(warp.config.kernel_cache_dir, 0o555)
if os.geteuid() == 0:  # permissions do not bind the superuser, but one without capabilities (capset(2), version 3, none set)
    assert ctypes.CDLL(None).capset((ctypes.c_uint32 * 2)(0x20080522, 0), (ctypes.c_uint32 * 6)()) == 0
try:
    print(CALL)
except wrt.InputError as error:
    print(error)
"""


@pytest.mark.skipif(sys.platform != "linux", reason="gives up the superuser's rights as Linux does")
@pytest.mark.parametrize("call", [
    "accel.closest_hit(np.zeros((1, 3)), np.ones((1, 3))).t",
    "wrt.build(wrt.Mesh(np.eye(4, 3), np.array([[0, 1, 2], [1, 2, 3]])), 'bvh8', builder='binned')",  # which has kernels preloaded
])
def test_a_read_only_kernel_cache_without_the_kernel_is_one_message(call: str, tmp_path: Path) -> None:
    done = subprocess.run([sys.executable, "-c", READ_ONLY_CACHE.replace("CALL", call)], cwd=ROOT, capture_output=True, text=True,
                          env=os.environ | {"WARP_CACHE_PATH": str(tmp_path), "PYTHONPATH": str(ROOT)})
    (cache,) = tmp_path.iterdir()
    assert done.stdout == f"{cache}: kernels cannot be compiled: Permission denied; set WARP_CACHE_PATH to another folder\n", done
    assert not list(cache.iterdir()) and without_compiling(done.stderr) == ""


def test_more_rows_than_an_index_reaches_are_refused() -> None:
    rows = np.broadcast_to(np.zeros(3, np.float32), (1 << 31, 3))
    with refused(what="2147483648 rows"):
        upload(rows, wp.vec3, "cpu")
