"""Sweeps on the workers of an executor: the same rows in the same order."""

from __future__ import annotations

import time
from collections.abc import Iterator
from concurrent.futures import Executor, ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import pytest

from tests.refused import refused
from wrt.core.errors import InputError
from wrt.lab.bench.report import run
from wrt.lab.bench.sweep import by_mesh
from wrt.lab.hard_cases import stability
from wrt.lab.rtcore.meshes import Plan as RtCorePlan
from wrt.scene.shapes import box, icosphere


@pytest.fixture
def pool() -> Iterator[Executor]:
    with ThreadPoolExecutor(3) as threads:
        yield threads


@dataclass(frozen=True)
class Plan:
    meshes: tuple[Any, ...]


def slow_first(plan: Plan) -> list[str]:
    time.sleep(0.1 if str(plan.meshes[0]).endswith("a.ply") else 0.0)
    if str(plan.meshes[0]).endswith("bad.ply"):
        raise InputError("no such file", path=plan.meshes[0])
    return [f"{Path(mesh).name} {i}" for mesh in plan.meshes for i in range(2)]


def test_rows_come_in_the_order_of_the_meshes(pool: Executor, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    told: list[str] = []
    assert by_mesh(slow_first, Plan(("a.ply", Path("b.ply"))), told.append, pool) == ["a.ply 0", "a.ply 1", "b.ply 0", "b.ply 1"]
    assert told == ["a.ply 0", "a.ply 1", "b.ply 0", "b.ply 1"]
    with pytest.raises(InputError, match=f"{tmp_path}/bad.ply: no such file"):  # a worker has a folder of its own
        by_mesh(slow_first, Plan(("a.ply", "bad.ply")), told.append, pool)
    with refused("meshes", "given"):
        by_mesh(slow_first, Plan(()), told.append, pool)


def test_the_model_counts_the_same(pool: Executor) -> None:
    plan = RtCorePlan((icosphere(1), box()), structures=("bvh",), kinds=("primary",), rays=64)
    assert by_mesh(run, plan, lambda row: None, pool) == list(run(plan))


def test_the_hard_cases_come_out_the_same(pool: Executor, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(stability, "measure_speed", lambda algorithms, runs: {})
    monkeypatch.setattr(stability, "CHUNK", 100)
    plan = stability.Plan(("E_grid", "I_rays_not_finite"), rays=350, sample=40, runs=1)
    told: list[stability.CaseRow] = []
    here = stability.run(plan)
    there = stability.run(plan, told.append, executor=pool)
    as_text = [[str(row.as_dict()) for row in rows] for rows in (here.rows, there.rows, told)]  # nan is not nan
    assert as_text[0] == as_text[1] == as_text[2] and here.rows[0].verdict.rays == 350


def test_an_algorithm_that_a_worker_does_not_have(pool: Executor, monkeypatch: pytest.MonkeyPatch) -> None:
    with refused(what="Embree"):
        stability.case_row("E_grid", "Embree", replace(stability.Plan(), rays=10))
