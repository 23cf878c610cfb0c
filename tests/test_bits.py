"""The pixels of the shipped scenes, and the hits of all structures and of moving worlds, have the bits whose hashes are in tests/bits.txt.

A change that alters them on purpose says so in CHANGELOG.md, and updates the file: `python -m tests.bits > tests/bits.txt`.
"""

import os
import platform
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from tests import bits

from tests.kernel_tools import cpu_only  # isort: skip (starts Warp)
import warp as wp

from wrt.accel.structures import ACCELERATORS
from wrt.kernels.structs import kernel


def test_every_shipped_scene_is_held() -> None:
    assert set(bits.stored()) == {"hits", "moving_worlds"} | {scene.stem for scene in bits.SCENES}


@pytest.mark.parametrize("accel", [name for name in ACCELERATORS if name != "brute_force"])
def test_hits_keep_their_bits(accel: str) -> None:
    assert bits.hits(accel) == bits.stored()["hits"]


@pytest.mark.parametrize("options", [
    {}, {"order": "reversed"}, {"order": "twice"}, {"order": "in place"}, {"rebuilt": True}, {"threads": 1}, {"kind": "bvh2"},
    *(pytest.param({"kind": kind}, marks=pytest.mark.slow) for kind in ("bvh4", "kdtree", "grid", "octree", "bsp")),
], ids=str)
def test_moving_worlds_have_the_same_depth_and_ids(options: dict[str, Any]) -> None:
    assert bits.moving_worlds(**options) == bits.stored()["moving_worlds"]


@cpu_only
@pytest.mark.skipif(platform.machine() not in ("x86_64", "AMD64"), reason="names a processor with SSE4.2 alone")
def test_moving_worlds_have_the_same_depth_and_ids_without_avx(tmp_path: Path) -> None:
    code = "import warp; warp.config.cpu_compiler_flags = '-target-cpu x86-64-v2'; from tests import bits; print(bits.moving_worlds())"
    result = subprocess.run([sys.executable, "-c", code], cwd=bits.ROOT, capture_output=True, text=True, check=True,
                            env={**os.environ, "WARP_CACHE_PATH": str(tmp_path)})
    assert result.stdout.split()[-1] == bits.stored()["moving_worlds"]


@pytest.mark.parametrize("scene", bits.SCENES, ids=lambda path: path.stem)
def test_pixels_keep_their_bits(scene: Path) -> None:
    assert bits.pixels(scene) == bits.stored()[scene.stem]
    assert not set().union(*map(bits.library_calls, bits.kernels(scene)))  # so that every machine has these bits


@kernel
def call_library(x: wp.array(dtype=float)):
    x[0] = wp.atan2(x[0], 2.0)


@cpu_only
def test_calls_of_the_library_are_seen() -> None:
    assert bits.library_calls(call_library) == {"atan2f"}
