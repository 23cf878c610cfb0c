"""Machine code for Turing: operations have their names, and a unit has the instructions of its parts."""

from __future__ import annotations

from pathlib import Path

import pytest
import warp as wp

from tests.refused import refused
from wrt.accel.structure import Structure, closest_hit_kernel
from wrt.accel.structures import ACCELERATORS
from wrt.kernels.traverse.common import Units
from wrt.kernels.traverse.stack import PLACES, SHARED
from wrt.lab.bench.report import markdown
from wrt.lab.rtcore.cubin import CLASSES, OPERATIONS, KernelCode, read_cubin
from wrt.lab.rtcore.instructions import box_unit, compiled, per_unit, resident_warps, tables


@wp.kernel(module="unique", enable_backward=False)
def floats(a: wp.array(dtype=wp.float32), b: wp.array(dtype=wp.float32), n: wp.array(dtype=wp.int32)):  # type: ignore[valid-type]
    i = wp.tid()
    a[i] = wp.min(a[i] * b[i], 3.0) + wp.sqrt(b[i] * 2.0 + a[i])
    n[i] = wp.min(n[i] ^ 21, 7) + int(b[i] * 1.5)


@wp.kernel(module="unique", enable_backward=False)
def doubles(a: wp.array(dtype=wp.float64), b: wp.array(dtype=wp.float64)):  # type: ignore[valid-type]
    i = wp.tid()
    a[i] = wp.where(a[i] < b[i], a[i] * b[i], a[i] * a[i] + b[i]) + b[i]


def test_operations_have_their_names() -> None:
    single, double = compiled(floats).operations(), compiled(doubles).operations()
    for name in ("FMUL", "FMNMX", "FADD", "FFMA", "MUFU", "LOP3", "IMNMX", "F2I", "LDG", "STG", "EXIT"):
        assert single[name] > 0, name
    assert not any(name.startswith("D") for name in single)
    for name in ("DMUL", "DFMA", "DADD", "DSETP"):
        assert double[name] > 0, name
    assert not any(name.startswith("0x") for name in (*single, *double))
    assert len(OPERATIONS) == sum(len(each) for each in CLASSES.values())  # no number in two classes


def test_a_box_test_is_six_differences_and_seven_products() -> None:
    """Six planes, each (plane - origin) * inv_dir, one product for the pad; no branch, no division, nothing in float64."""
    unit = box_unit("conservative")
    assert 13 <= unit.classes["fp32"] < 60 and abs(unit.instructions - unit.classes["fp32"]) < 1.0  # a move now and then
    assert unit.classes["control"] == unit.classes["fp64"] == unit.classes["special"] == 0.0
    assert "conservative" in markdown(tables([unit], {}))


def test_a_kernel_whose_body_stands_twice_is_refused() -> None:
    twice = compiled(floats)
    assert twice.operations()["STG"] > 1
    with refused(what="separated"):
        per_unit(twice, twice)


def test_classes_are_of_all_instructions(tmp_path: Path) -> None:
    (binary,) = wp.compile_aot_module(doubles.module, arch=75, module_dir=tmp_path)
    (code,) = read_cubin(Path(binary).read_bytes()).values()
    assert sum(code.classes().values()) == len(code.opcodes()) <= len(code.code) // 16


@pytest.mark.parametrize(("registers", "shared", "arch", "block", "warps"), [
    (80, 0, 75, 64, 24), (80, 0, 75, 256, 24), (72, 0, 75, 64, 28), (72, 0, 75, 256, 24), (84, 0, 75, 64, 20), (80, 0, 90, 64, 24),
    (16, 0, 75, 32, 16), (16, 0, 75, 64, 32), (16, 0, 90, 32, 32), (16, 0, 90, 64, 64), (80, 4352, 75, 64, 24),
    (80, 6400, 75, 64, 20), (80, 6400, 90, 64, 24)])
def test_warps_of_an_sm_by_hand(registers: int, shared: int, arch: int, block: int, warps: int) -> None:
    assert resident_warps(KernelCode("", b"", registers, 0, shared), arch, block) == warps


def test_what_a_stack_in_shared_memory_costs() -> None:
    """Neither registers nor warps; the memory that it is given; some instructions."""
    here, there = (compiled(closest_hit_kernel(Structure(ACCELERATORS["bvh"], Units(stack=place))), 75, 64) for place in PLACES)
    assert PLACES == ("local", "shared") and here.operations()["LDS"] == 0 < there.operations()["LDS"]
    assert there.shared - here.shared == 64 * SHARED and there.stack == here.stack
    assert resident_warps(there, 75, 64) == resident_warps(here, 75, 64) >= 24
    assert len(there.opcodes()) < 1.03 * len(here.opcodes()) and there.operations()["LD"] == there.operations()["ST"] == 0
