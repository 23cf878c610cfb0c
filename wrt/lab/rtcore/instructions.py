"""The units in machine code for Turing: instructions of a box test and of a triangle test; registers, stack and code of
traversals, also for Hopper.

Read from the binary, without a GPU. The counts are static: of the code that there is, not of what a ray runs through.
"""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import warp as wp

from wrt.accel.structure import Structure, any_hit_kernel, closest_hit_kernel
from wrt.accel.structures import ACCELERATORS
from wrt.core import cuda
from wrt.core.device import start
from wrt.core.errors import InputError
from wrt.kernels.study.unit_probes import make_box_probe, make_triangle_probe, numbers_of
from wrt.kernels.traverse.common import Units
from wrt.kernels.units.box import RAY_AABB
from wrt.kernels.units.triangle import RAY_TRIANGLE
from wrt.lab.bench.report import Columns, Part, Row, tabled
from wrt.lab.rtcore.cubin import CLASSES, KernelCode, read_cubin

ARCH = 75
ARCHS = (75, 90)  # of the traversals
REGISTERS = 65536  # of an SM, in four parts; a warp gets them by 256
SMS = {75: (64 << 10, 16, 32), 90: (228 << 10, 32, 64)}  # by architecture: shared bytes, blocks and warps that an SM has room for
QUERIES = {"closest hit": closest_hit_kernel, "any hit": any_hit_kernel}
FEW, MANY = 8, 16  # so many that the compiler holds the body once, and does not unroll the loop over the grid around it
# What a kernel with a unit does to add up its own results: one addition for a box, three and a selection for a triangle. One that
# only adds up what it reads has an addition for each number.
BOX_NUMBERS, BOX_RESULTS, TRIANGLE_RESULTS = 6, 1, 4


@dataclass(frozen=True)
class UnitCode:
    """unit: "box" or "triangle"; test: its name in the table; classes: instructions by class (cubin.CLASSES), fetching the box or
    the record from memory and its address left out."""

    unit: str
    test: str
    classes: dict[str, float]

    @property
    def instructions(self) -> float:
        return sum(self.classes.values())


def compiled(kernel: Any, arch: int = ARCH, block_dim: int | None = None) -> KernelCode:
    """The kernel's machine code, by default for Turing and Warp's own blocks."""
    start("cpu")
    before = wp.get_module_options(kernel.module)["block_dim"]
    wp.set_module_options({"block_dim": block_dim or before}, kernel.module)
    try:
        with tempfile.TemporaryDirectory() as folder:
            (binary,) = wp.compile_aot_module(kernel.module, arch=arch, module_dir=folder)
            (code,) = read_cubin(Path(binary).read_bytes()).values()
    finally:
        wp.set_module_options({"block_dim": before}, kernel.module)
    return code


def resident_warps(code: KernelCode, arch: int, block_dim: int) -> int:
    """How many warps an SM holds at a time: what registers, shared memory and blocks leave room for."""
    shared, blocks, most = SMS[arch]
    warps = block_dim // 32
    by_registers = 4 * (REGISTERS // 4 // (-(-code.registers * 32 // 256) * 256))
    return warps * min(by_registers // warps, shared // max(code.shared, 1), blocks, most // warps)


def of_one(few: KernelCode, many: KernelCode) -> dict[str, float]:
    """What one unit more adds to a kernel, by class. Raises InputError where the compiler holds the body more than once."""
    if few.operations()["STG"] != 1 or many.operations()["STG"] != 1:
        raise InputError("this compiler unrolls the kernels that hold the units: their instructions cannot be told apart")
    a, b = few.classes(), many.classes()
    return {name: (b[name] - a[name]) / (MANY - FEW) for name in (*CLASSES, "other")}


def box_unit(test: str) -> UnitCode:
    unit = of_one(compiled(make_box_probe(test, FEW)), compiled(make_box_probe(test, MANY)))
    adding = of_one(compiled(make_box_probe(None, FEW)), compiled(make_box_probe(None, MANY)))
    return UnitCode("box", test, less(unit, adding, BOX_NUMBERS - BOX_RESULTS))


def triangle_unit(test: str) -> UnitCode:
    unit = of_one(compiled(make_triangle_probe(test, FEW)), compiled(make_triangle_probe(test, MANY)))
    adding = of_one(compiled(make_triangle_probe(test, FEW, True)), compiled(make_triangle_probe(test, MANY, True)))
    return UnitCode("triangle", test, less(unit, adding, numbers_of(RAY_TRIANGLE[test].record) - TRIANGLE_RESULTS))


def less(unit: dict[str, float], adding: dict[str, float], adds: int) -> dict[str, float]:
    """The unit without what a kernel that only reads the same numbers has too; `adds`: its own additions, which stay."""
    return {name: unit[name] - adding[name] + (adds if name == "fp32" else 0) for name in unit}


def units() -> list[UnitCode]:
    """Every box test and triangle test of the tables; compiles two kernels for each, which takes half a minute."""
    return [box_unit(test) for test in RAY_AABB] + [triangle_unit(test) for test in RAY_TRIANGLE]


def traversals(names: Sequence[str]) -> dict[tuple[str, str, str, int], KernelCode]:
    """The queries' kernels in the default's blocks, by structure, query, place of the stack and architecture."""
    return {(name, query, stack, arch): compiled(make(Structure(ACCELERATORS[name], Units(stack=stack))), arch, cuda.block_dim)
            for name in names for query, make in QUERIES.items() for stack in cuda.STACKS for arch in ARCHS}


SOFTWARE_LEGEND = """\
Static counts of the code that there is: the watertight test refuses most triangles early. Its fp64, at 1/32 of the rate of fp32 on
Turing, is for hard cases and stands once in a kernel, in a function: the traversals count it, the unit only calls it. Fetching the
box or the triangle, the stack and the loop are left out of the units."""


def tables(units: Sequence[UnitCode], codes: dict[tuple[str, str, str, int], KernelCode]) -> list[Part]:
    shown = [name for name in (*CLASSES, "other") if any(abs(unit.classes[name]) > 0.01 for unit in units)]
    lines = [(name, query, stack, f"sm_{arch}", str(code.registers), str(code.stack), str(code.shared),
              str(resident_warps(code, arch, cuda.block_dim)), str(len(code.opcodes())),
              *(str(code.classes()[each]) for each in (*CLASSES, "other"))) for (name, query, stack, arch), code in codes.items()]
    return [
        tabled({"unit": "{unit}", "test": "{test}", "instructions": lambda unit: f"{unit.instructions:.0f}",
                **{name: f"{{classes[{name}]:.0f}}" for name in shown}}, units),
        Part("", "", ("traversal", "query", "stack", "for", "registers", "local bytes", "shared bytes of a block", "warps of an SM",
                      "instructions", *CLASSES, "other"), lines),
        Part("", SOFTWARE_LEGEND)]


# --- what software needs for the same rays ----------------------------------------------------------------------------

LANES_PER_SECOND = 28 * 128 * 1.582e9  # GTX 1080 Ti: instructions of a lane, see wrt.lab.rtcore.parameters.PARAMETERS
CLAIMED = 1.1e9  # rays a second that NVIDIA says it traces


@cache
def default_units() -> tuple[UnitCode, UnitCode]:
    """Compiles them for Turing."""
    return box_unit("conservative"), triangle_unit("watertight")


def software(name: str, boxes: float, triangles: float, busy: float) -> Row:
    """boxes, triangles: tests a ray, by the default units; busy: SIMT efficiency. Gives instructions of both units, a ray;
    rays_per_second: at most, of a GTX 1080 Ti that does nothing else; share: of the instructions that its claimed rays leave for
    each ray, lanes that wait counted in. The triangle test is counted as a whole, although most triangles are
    refused early: an upper bound; fetching, stack and loop are not: together a rough figure."""
    box, triangle = default_units()
    instructions = boxes * box.instructions + triangles * triangle.instructions
    speed = LANES_PER_SECOND * busy / instructions
    return Row(name=name, instructions=instructions, busy=busy, rays_per_second=speed, share=CLAIMED / speed)


SOFTWARE: Columns = {
    "rays": "{name}", "instructions": "{instructions:.0f}", "SIMT": "{busy:.0%}",
    "of a lane, with those that wait": lambda row: f"{row.instructions / row.busy:.0f}",
    "of what 1.1 Grays/s leave": "{share:.0%}", "Grays/s at most": lambda row: f"{row.rays_per_second / 1e9:.2f}"}
