"""Bits are a contract: shipped scenes' pixels and hits are to the last bit what tests/bits.txt holds.

A change that means to alter them says so in CHANGELOG.md, and brings a new tests/bits.txt (`python -m tests.bits`).
"""

from __future__ import annotations

from pathlib import Path

import pytest

from tests import bits
from wrt.accel.structures import ACCELERATORS


def test_every_shipped_scene_is_held() -> None:
    assert set(bits.stored()) == {"library", "hits"} | {scene.stem for scene in bits.SCENES}


@pytest.mark.parametrize("accel", [name for name in ACCELERATORS if name != "brute_force"])
def test_hits_keep_their_bits(accel: str) -> None:
    assert bits.hits(accel) == bits.stored()["hits"]


@pytest.mark.parametrize("scene", bits.SCENES, ids=lambda path: path.stem)
def test_pixels_keep_their_bits(scene: Path) -> None:
    if bits.library() != bits.stored()["library"]:
        pytest.skip("this machine's sin, cos, exp, log, pow, acos or atan2 have other last bits than those of tests/bits.txt")
    assert bits.pixels(scene) == bits.stored()[scene.stem]
