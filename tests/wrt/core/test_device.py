"""Warp's start, uploads, threads."""

from __future__ import annotations

import os
import subprocess
import sys

import numpy as np
import pytest

from tests.data import ROOT
from tests.refused import refused
from wrt.core.device import describe_devices, memory_of, records, start, upload

import warp as wp  # isort: skip (after wrt.core.device, which silences Warp's banner)



@pytest.mark.parametrize("name", ["nope", "", "cuda:999", "cpu:1", "CPU"])
def test_an_unknown_device_is_refused_with_those_there_are(name: str) -> None:
    with refused("device", "no device", hint="cpu"):
        start(name)


def test_the_cpu_is_there() -> None:
    assert start("cpu").is_cpu and start("cpu") is start("cpu")
    assert describe_devices()[0].startswith("cpu: ") and len(describe_devices()) == 1 + len(wp.get_cuda_devices())
    assert memory_of(start("cpu")) > 2**28


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


@pytest.mark.parametrize("environment", [{"WARP_CACHE_PATH": "/dev/null/cache"}, {"HOME": "/dev/null"}], ids=str)
def test_a_kernel_cache_that_cannot_be_made_is_one_message(environment: dict[str, str]) -> None:
    without = {name: value for name, value in os.environ.items() if name not in ("WARP_CACHE_PATH", "XDG_CACHE_HOME", "HOME")}
    done = subprocess.run([sys.executable, "-m", "wrt", "devices"], cwd=ROOT, capture_output=True, text=True,
                          env={**without, "PYTHONPATH": str(ROOT), **environment})
    assert done.returncode == 2 and done.stdout == "" and done.stderr.count("\n") == 1, done
    assert done.stderr.startswith("error: /dev/null/") and done.stderr.endswith("; set WARP_CACHE_PATH to another folder\n")
