"""The PTX of the traversals, compiled for Turing: only the function for hard cases has float64 instructions."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest

from tests import device

from wrt.accel.snapshot import Structure, any_hit_kernel, closest_hit_kernel  # isort: skip (starts Warp)
import warp as wp

from wrt.accel.structures import ACCELERATORS

HARD = "hard_crossing"  # A function of kernels.units.triangle.


def with_float64(ptx: str) -> dict[str, int]:
    """Return the functions with float64 instructions, and the number of these instructions. Functions end with a line "}"."""
    out = {}
    for text in re.split(r"^}$", ptx, flags=re.MULTILINE):
        head, _, body = text.partition("\n{\n")
        double = re.findall(r"^\s*(?:@!?%\w+\s+)?\w[\w.]*\.f64\b", body, re.MULTILINE)
        if double:
            (name,) = re.findall(r"\.(?:entry|func)\s+(?:\([^)]*\)\s*)?([\w$]+)", head)[-1:]
            out[name] = len(double)
    return out


@pytest.mark.skipif(device.IS_VIRTUAL, reason="expects what NVRTC writes")
@pytest.mark.parametrize("make", [closest_hit_kernel, any_hit_kernel])
@pytest.mark.parametrize("name", ["bvh", pytest.param("bvh2", marks=pytest.mark.slow)])
def test_float64_is_in_the_function_for_hard_cases_alone(name: str, make: Any, tmp_path: Path) -> None:
    kernel = make(Structure(ACCELERATORS[name]))
    (file,) = wp.compile_aot_module(kernel.module, arch=75, module_dir=tmp_path, use_ptx=True)
    ((function, count),) = with_float64(Path(file).read_text()).items()
    assert HARD in function and count > 20
