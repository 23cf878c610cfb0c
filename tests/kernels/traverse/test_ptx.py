"""The PTX of the traversals, compiled for Turing: only the function for hard cases has float64 instructions."""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest

from tests import device

from wrt.accel.snapshot import Structure, any_hit_kernel, closest_hit_kernel  # isort: skip (starts Warp)
import warp as wp

from wrt.accel.structures import ACCELERATORS

HARD = "hard_crossing"  # A function of kernels.units.triangle.
HEAD = re.compile(r"\.(entry|func)\s+(?:\([^)]*\)\s*)?([\w$]+)")


@dataclass
class Function:
    """A function in PTX. entry: True for a kernel; double: its statements with float64; called: names of the functions it calls."""

    entry: bool
    double: list[str] = field(default_factory=list)
    called: set[str] = field(default_factory=set)


def functions(ptx: str) -> dict[str, Function]:
    """Return the functions of a module that have a body, by name."""
    text = re.sub(r"//[^\n]*|/\*.*?\*/", "", ptx, flags=re.DOTALL)
    text = re.sub(r'"[^"\n]*"', '""', text)
    out: dict[str, Function] = {}
    for head in HEAD.finditer(text):
        begin, end = text.find("{", head.end()), text.find(";", head.end())
        if begin < 0 or -1 < end < begin:
            continue  # A declaration without a body.
        depth, at = 1, begin + 1
        while depth:
            depth += {"{": 1, "}": -1}.get(text[at], 0)
            at += 1
        out[head[2]] = read(head[1] == "entry", text[begin + 1 : at - 1])
    return out


def read(entry: bool, body: str) -> Function:
    out = Function(entry)
    registers = re.findall(r"\.reg\s+\.f64\s+(%\w+?)<", body)
    named = re.compile("|".join(rf"{name}\d+\b" for name in registers) or r"(?!)")
    for statement in re.split(r"[;{}]", re.sub(r"^\s*[\w$]+:", "", body, flags=re.MULTILINE)):
        words = re.sub(r"^\s*@!?%\w+", "", statement).split()
        if not words or words[0].startswith((".reg", ".param", ".loc", ".local", ".shared", ".pragma", ".file")):
            continue
        if ".f64" in words[0] or named.search(statement):
            out.double.append(" ".join(words))
        if words[0].startswith("call"):
            out.called |= set(re.findall(r"(?<![\w%$])[A-Za-z_$][\w$]*", " ".join(words[1:])))
    return out


MODULE = """
.func (.param .b32 r) hard(.param .b32 a) { .reg .f64 %fd<3>; cvt.f64.f32 %fd1, %f1; st.param.f32 [r], %f2; ret; }
.func declared(.param .b64 a);
.visible .entry kernel(.param .u64 x) // mul.f64
{
    .reg .f64 %d<9>;
    .local .align 8 .f64 unused;
    add.f32 %f1, %f2, %f3;
$L__BB0_2:
    { .param .b32 r0; call.uni (r0), hard, (p0); } // callseq 0
    @%p1 mov.b64 %rd1, %d4;
    @!%p2 fma.rn.f64 %d1, %d2, %d3, %d4;
    setp.lt.f32 %p1, %f642, 0f00000000;
}
"""


def test_statements_with_float64_are_found() -> None:
    """The module is written by hand. It has float64 instructions and registers, also behind a label and a predicate."""
    found = functions(MODULE)
    assert set(found) == {"hard", "kernel"} and found["hard"].double == ["cvt.f64.f32 %fd1, %f1"]
    assert found["kernel"].entry and not found["hard"].entry and "hard" in found["kernel"].called
    assert found["kernel"].double == ["@%p1 mov.b64 %rd1, %d4".split(" ", 1)[1], "fma.rn.f64 %d1, %d2, %d3, %d4"]


@pytest.mark.skipif(device.IS_VIRTUAL, reason="expects what NVRTC writes")
@pytest.mark.parametrize("make", [closest_hit_kernel, any_hit_kernel])
@pytest.mark.parametrize("name", ["bvh", pytest.param("bvh2", marks=pytest.mark.slow)])
def test_float64_is_in_the_function_for_hard_cases_alone(name: str, make: Any, tmp_path: Path) -> None:
    kernel = make(Structure(ACCELERATORS[name]))
    (file,) = wp.compile_aot_module(kernel.module, arch=75, module_dir=tmp_path, use_ptx=True)
    found = functions(Path(file).read_text())
    (entry,) = (each for each in found.values() if each.entry)
    (hard,) = (key for key in found if HARD in key)
    assert hard in entry.called and len(found[hard].double) > 20  # The function exists, and its float64 is found.
    assert {key: each.double for key, each in found.items() if each.double} == {hard: found[hard].double}
