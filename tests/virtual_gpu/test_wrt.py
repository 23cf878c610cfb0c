"""wrt on virtual GPUs: `python -m pytest --device cuda:0 tests/virtual_gpu`. Here is what shows most for the least time; all other
tests run on `--device` too."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import wrt
from tests import bits, device
from tests.data import ROOT
from tests.virtual_gpu import gpus
from wrt.accel.structures import ACCELERATORS

pytestmark = pytest.mark.skipif(not device.IS_VIRTUAL, reason="run with --device cuda:0")
PICTURE = {"spp": 2, "size": (48, 27), "seed": 5}
SCENE = ROOT / "scenes" / "spot.toml"
STRUCTURES = sorted({kind.name for kind in ACCELERATORS.values()} - {"brute_force"})
QUICK = ("bvh8", "kdtree")


@pytest.mark.parametrize("accel", [name if name in QUICK else pytest.param(name, marks=pytest.mark.slow) for name in STRUCTURES])
def test_hits_have_the_bits_of_the_cpu(accel: str) -> None:
    before = gpus().counts.launches.total()
    assert bits.hits(accel) == bits.stored()["hits"]
    assert gpus().counts.launches.total() == before + 3


@pytest.mark.parametrize("scene", [path if path == SCENE else pytest.param(path, marks=pytest.mark.slow) for path in bits.SCENES],
                         ids=lambda path: path.stem)
def test_pixels_have_the_bits_of_the_cpu(scene: Path) -> None:
    before = gpus().counts.launches.total()
    there, here = (wrt.render(scene, device=name, aov="depth", **PICTURE) for name in ("cuda:0", "cpu"))
    assert gpus().counts.launches.total() > before
    assert there.pixels.tobytes() == here.pixels.tobytes() and there.pixels.max() > 0.0
    assert there.aov["depth"].tobytes() == here.aov["depth"].tobytes()


def test_two_devices_share_a_picture() -> None:
    one = wrt.render(SCENE, device="cuda:0", **PICTURE)
    before = gpus().counts.launches.copy()
    two = wrt.render(SCENE, devices=["cuda:0", "cuda:1"], tile_size=16, **PICTURE)
    assert {number for _, number in gpus().counts.launches - before} == {0, 1}
    assert np.array_equal(one.pixels, two.pixels) and one.pixels.max() > 0.0
