"""tests/costs.txt: rays cost the nodes, boxes and triangles that it says, and a higher cost of the default structure is a regression.

`python -m tests.costs` also compares instructions, which needs Valgrind (.ci/run)."""

from __future__ import annotations

import ctypes
import platform

import numpy as np
import pytest

from tests import costs
from tests.device import NAME
from tests.structures import STRUCTURES

OTHERS = [name for name in STRUCTURES if name != "brute_force"]


def test_the_file_has_every_line_of_the_default_structure_and_no_unknown_line() -> None:
    names = {structure: {f"{structure} {mesh} {kind}" for mesh, kind in costs.kinds_of(structure)} for structure in OTHERS}
    assert names[costs.DEFAULT] <= costs.stored().keys() <= set().union(*names.values())


@pytest.mark.parametrize("structure", [name if name in ("bvh8", "bvh2") else pytest.param(name, marks=pytest.mark.slow)
                                       for name in sorted({line.split()[0] for line in costs.stored()})])
def test_counters_are_those_of_the_file(structure: str) -> None:
    stored = costs.stored()
    for name, counters in costs.counted(structure).items():
        np.testing.assert_array_equal(counters, stored[name][:3], name)


def test_a_higher_cost_is_a_regression_of_the_default_structure_only() -> None:
    stored = costs.stored()
    assert list(costs.compared(stored, stored)) == []

    def changed(name: str, column: int, factor: float) -> list[tuple[str, bool]]:
        values = list(stored[name])
        values[column] *= factor
        return list(costs.compared({**stored, name: values}, stored))

    assert [worse for _, worse in changed("bvh8 balls bounce", 0, 1.001)] == [True]
    assert [worse for _, worse in changed("bvh8 balls bounce", 0, 0.99)] == [False]
    assert [worse for _, worse in changed("bvh8 balls any", 3, 1.04)] == [True]
    assert changed("bvh8 balls any", 3, 1.02) == changed("bvh8 balls any", 3, 0.98) == []
    assert [worse for _, worse in changed("bvh2 balls bounce", 0, 2.0)] == [False]
    assert [worse for _, worse in costs.compared({"bvh8 balls new": [np.nan, np.nan, np.nan, 9.0]}, stored)] == [True]


def test_instructions_of_single_calls_are_compared_for_one_version_of_python(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(costs, "versions", lambda: "Python 4.0")
    twice = {name: [*values[:3], 2.0 * values[3]] for name, values in costs.stored().items() if name.endswith(" one")}
    assert twice and [worse for _, worse in costs.compared(twice, costs.stored())] == [False] * len(twice)


@pytest.mark.skipif(platform.machine() != "x86_64" or NAME != "cpu", reason="machine code for x86-64")
def test_without_valgrind_its_requests_do_nothing() -> None:
    words = (ctypes.c_uint64 * 6)(0x1001)  # RUNNING_ON_VALGRIND
    assert costs.Callgrind().call(ctypes.addressof(words)) == 0
