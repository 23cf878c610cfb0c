"""--quick: smaller defaults, which one line on stderr lists."""

from __future__ import annotations

from typing import Any

import pytest

from tests import command_line
from wrt.cli.measure import bench
from wrt.lab.bench import Error, Pictures, Queries, Visibility, report
from wrt.lab.claims import Claims
from wrt.lab.hard_cases import Closed, Stability, stability
from wrt.lab.mitsuba import Mitsuba
from wrt.lab.rtcore import RtCore, WhatIf

WITHOUT_FILES = (Queries, Visibility, Closed, Claims)


@pytest.fixture
def measured(monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """Collect the plans that `bench` runs, in their order, without measuring."""
    plans: list[Any] = []

    def noted(plan: Any, reported: Any = None, finished: Any = None) -> list[Any]:
        plans.append(plan)
        return []

    monkeypatch.setattr(report, "run", noted)
    return plans


@pytest.mark.parametrize("plan", [*WITHOUT_FILES, Error, Pictures, Stability, Mitsuba, RtCore, WhatIf])
def test_quick_is_less_than_the_default(plan: Any) -> None:
    defaults = {name: plan.__dataclass_fields__[name].default for name in plan.QUICK}
    assert all(plan.QUICK[name] < default for name, default in defaults.items() if not isinstance(default, str | tuple))
    assert any(plan.QUICK[name] != default for name, default in defaults.items())


def test_stability_quick_lists_its_smaller_defaults(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(stability, "SPEED_RAYS", 2000)
    done = command_line.wrt("stability", "E_grid", "--quick", "--contestants", "bvh8", "--rays", "20", "--sample", "20", "-q")
    assert done.code == 0 and " 20 " in done.out
    assert done.err == f"stability --quick: runs {Stability.QUICK['runs']} instead of {Stability.runs}\n"


@pytest.mark.parametrize("words", [("visibility", "--quick"), ("--quick", "visibility")])
def test_a_bench_keeps_stated_options_and_uses_smaller_defaults(measured: list[Any], words: tuple[str, ...]) -> None:
    done = command_line.wrt("bench", *words, "--runs", "4", "-q")
    assert done.code == 0, done.err
    assert measured == [Visibility(**Visibility.QUICK | {"runs": 4})]
    size = Visibility.QUICK["size"]
    assert done.err.startswith(f"visibility --quick: size {size} instead of {Visibility.size}, ")
    assert f"--size {size} " in done.out and "--runs 4" in done.out  # the command that repeats the measurement


def test_without_a_name_all_benches_run_that_need_no_file(measured: list[Any]) -> None:
    done = command_line.wrt("bench", "--quick")
    assert done.code == 0, done.err
    assert measured == [plan(**plan.QUICK) for plan in WITHOUT_FILES]
    first, *others = done.err.splitlines()
    assert len(others) == len(measured)
    ran = {plan.COMMAND.removeprefix("bench ") for plan in WITHOUT_FILES}
    assert set(first.removeprefix("skipped, without --quick or in need of a file: ").split(", ")) == set(bench.commands) - ran


def test_without_quick_a_bench_needs_a_name(measured: list[Any]) -> None:
    assert command_line.wrt("bench").code == 2 and not measured
    assert command_line.wrt("bench", "visibility", "-q").err == "" and measured == [Visibility()]
