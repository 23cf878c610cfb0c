"""Count the instructions of box and triangle tests for Turing, and registers, stack and code of traversals for Turing and Hopper.

The counts come from compiled binaries, without a GPU. They are static: how often an instruction stands in the code, not how often it
runs."""

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import warp as wp

from wrt.accel.structure import Structure, any_hit_kernel, closest_hit_kernel
from wrt.accel.structures import ACCELERATORS
from wrt.core import cuda
from wrt.core.device import start
from wrt.core.errors import InputError
from wrt.core.types import Kernel
from wrt.kernels.study.unit_probes import make_box_probe, make_triangle_probe, numbers_of
from wrt.kernels.traverse.common import Units
from wrt.kernels.units.box import RAY_AABB
from wrt.kernels.units.triangle import RAY_TRIANGLE
from wrt.lab.bench.report import Part, tabled
from wrt.lab.rtcore.cubin import CLASSES, KernelCode, read_cubin

ARCH = 75  # Compute capability of Turing.
ARCHS = (75, 90)  # Architectures of the traversals: Turing, Hopper.
REGISTERS = 65536  # Registers of an SM, in four parts; a warp allocates blocks of 256.
SMS = {75: (64 << 10, 16, 32), 90: (228 << 10, 32, 64)}  # Architecture -> shared bytes, most blocks and most warps of an SM.
QUERIES = {"closest hit": closest_hit_kernel, "any hit": any_hit_kernel}
# Tests in a probe kernel. For these numbers the compiler does not unroll the loop over the grid, so each test stands in the code once.
FEW, MANY = 8, 16
# Additions in the probe kernels. A kernel with tests also sums their results: one addition for a box, three and a selection for a
# triangle. A kernel that only reads has one addition for each number that it reads.
BOX_NUMBERS, BOX_RESULTS, TRIANGLE_RESULTS = 6, 1, 4


@dataclass(frozen=True)
class UnitCode:
    """Number of instructions of one test by class (cubin.CLASSES), without loads of its data. unit: "box" or "triangle"; test: its name."""

    unit: str
    test: str
    classes: dict[str, float]

    @property
    def instructions(self) -> float:
        return sum(self.classes.values())


def compiled(kernel: Kernel, arch: int = ARCH, block_dim: int | None = None) -> KernelCode:
    """Compile a kernel and return its machine code, by default for Turing and the module's block size."""
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
    """Return the most warps that an SM holds at a time, as registers, shared memory and numbers of blocks and warps allow."""
    shared, blocks, most = SMS[arch]
    warps = block_dim // 32
    by_registers = 4 * (REGISTERS // 4 // (-(-code.registers * 32 // 256) * 256))
    return warps * min(by_registers // warps, shared // max(code.shared, 1), blocks, most // warps)


def per_unit(few: KernelCode, many: KernelCode) -> dict[str, float]:
    """Return the instructions by class of one test, from kernels with FEW and MANY tests. Raise InputError if a loop is unrolled."""
    if few.operations()["STG"] != 1 or many.operations()["STG"] != 1:
        raise InputError("this compiler unrolls the probe kernels, so that the instructions of one test cannot be separated")
    a, b = few.classes(), many.classes()
    return {name: (b[name] - a[name]) / (MANY - FEW) for name in (*CLASSES, "other")}


def box_unit(test: str) -> UnitCode:
    unit, adding = (per_unit(compiled(make_box_probe(name, FEW)), compiled(make_box_probe(name, MANY))) for name in (test, None))
    return UnitCode("box", test, without_probe(unit, adding, BOX_NUMBERS - BOX_RESULTS))


def triangle_unit(test: str) -> UnitCode:
    unit, adding = (per_unit(*(compiled(make_triangle_probe(test, count, only_reads)) for count in (FEW, MANY)))
                    for only_reads in (False, True))
    return UnitCode("triangle", test, without_probe(unit, adding, numbers_of(RAY_TRIANGLE[test].record) - TRIANGLE_RESULTS))


def without_probe(unit: dict[str, float], adding: dict[str, float], additions: int) -> dict[str, float]:
    """Return a test's instructions by class: `unit` of its probe, less `adding` of a kernel that only reads and adds, plus `additions`."""
    return {name: unit[name] - adding[name] + (additions if name == "fp32" else 0) for name in unit}


def units() -> list[UnitCode]:
    """Compile every box test and triangle test; this takes half a minute."""
    return [box_unit(test) for test in RAY_AABB] + [triangle_unit(test) for test in RAY_TRIANGLE]


def traversals(names: Sequence[str]) -> dict[tuple[str, str, str, int], KernelCode]:
    """Compile the query kernels in the default block size; return (structure, query, memory of the stack, architecture) -> code."""
    return {(name, query, stack, arch): compiled(make(Structure(ACCELERATORS[name], Units(stack=stack))), arch, cuda.block_dim)
            for name in names for query, make in QUERIES.items() for stack in cuda.STACKS for arch in ARCHS}


LEGEND = """\
Counts are static: a ray runs fewer instructions, because the watertight test refuses most triangles early. Its fp64 instructions (1/32
of fp32's rate on Turing) serve hard cases only. They stand once in a kernel, in a function: traversals include them, the test only calls
them. Counts of the tests exclude loading the box or triangle, the stack and the loop."""


def tables(units: Sequence[UnitCode], codes: dict[tuple[str, str, str, int], KernelCode]) -> list[Part]:
    shown = [name for name in (*CLASSES, "other") if any(abs(unit.classes[name]) > 0.01 for unit in units)]
    lines = [(name, query, stack, f"sm_{arch}", str(code.registers), str(code.stack), str(code.shared),
              str(resident_warps(code, arch, cuda.block_dim)), str(len(code.opcodes())),
              *(str(code.classes()[each]) for each in (*CLASSES, "other"))) for (name, query, stack, arch), code in codes.items()]
    return [
        tabled({"unit": "{unit}", "test": "{test}", "instructions": lambda unit: f"{unit.instructions:.0f}",
                **{name: f"{{classes[{name}]:.0f}}" for name in shown}}, units),
        Part("", "", ("traversal", "query", "stack", "architecture", "registers", "local bytes", "shared bytes/block", "warps/SM",
                      "instructions", *CLASSES, "other"), lines),
        Part("", LEGEND)]
