"""The pixels of the shipped scenes and the hits of all structures have the bits whose hashes are in tests/bits.txt.

A change that alters them on purpose says so in CHANGELOG.md, and updates the file: `python -m tests.bits > tests/bits.txt`.
"""

from pathlib import Path

import pytest

from tests import bits

from tests.kernel_tools import cpu_only  # isort: skip (starts Warp)
import warp as wp

from wrt.accel.structures import ACCELERATORS
from wrt.kernels.structs import kernel


def test_every_shipped_scene_is_held() -> None:
    assert set(bits.stored()) == {"hits"} | {scene.stem for scene in bits.SCENES}


@pytest.mark.parametrize("accel", [name for name in ACCELERATORS if name != "brute_force"])
def test_hits_keep_their_bits(accel: str) -> None:
    assert bits.hits(accel) == bits.stored()["hits"]


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
