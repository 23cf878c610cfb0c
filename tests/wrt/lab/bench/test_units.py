"""What the default costs beside the others: that the measurement is of what it says."""

from __future__ import annotations

import time
from dataclasses import replace

from tests.refused import refused
from wrt.kernels.units.box import RAY_AABB
from wrt.kernels.units.triangle import RAY_TRIANGLE
from wrt.lab.bench import units
from wrt.lab.bench.report import Row, run, text
from wrt.lab.bench.timing import alternate, quartiles, shown
from wrt.lab.bench.visibility import terrain
from wrt.scene.shapes import icosphere


def test_jobs_run_by_turns_and_the_first_run_is_not_counted() -> None:
    order: list[str] = []
    jobs = {"a": lambda: order.append("a"), "b": lambda: (order.append("b"), time.sleep(0.003))}
    seconds = alternate(jobs, 3)
    assert "".join(order) == "ab" + "ab" + "ba" + "ab"
    assert seconds["a"].shape == (3,) and (seconds["b"] > 0.0029).all() and (seconds["a"] < seconds["b"]).all()
    assert quartiles([5, 1, 2, 3, 4]) == (2.0, 3.0, 4.0) and shown((2.0, 3.0, 4.0)) == "3 [2, 4]"


def test_every_unit_has_a_row_on_every_mesh() -> None:
    small = [icosphere(2), terrain(8), replace(icosphere(1), name="ball")]
    told: list[Row] = []
    plan = units.Plan(small, rays=500, runs=2)
    rows = run(plan, told.extend)
    on_meshes = {(row.mesh, row.rays) for row in rows if "no structure" not in row.mesh}
    assert len(on_meshes) == 6 and told == rows
    names = [*RAY_TRIANGLE, *(f"{box} boxes" for box in list(RAY_AABB)[1:])]
    for place in on_meshes:
        assert [row.unit for row in rows if (row.mesh, row.rays) == place] == names
    assert [row.unit for row in rows if "no structure" in row.mesh] == list(RAY_TRIANGLE)
    for row in rows:
        assert row.extremes[0] <= row.price[0] <= row.price[1] <= row.price[2] <= row.extremes[1]
        assert row.unit != "watertight" or row.price == (1.0, 1.0, 1.0)
    page = text(rows, plan, "here")
    assert "| terrain" in page and "--rays 500 --runs 2" in page


def test_bad_plans_are_refused() -> None:
    with refused("accel", "no structure 'sphere'"):
        units.Plan(accel="sphere")
    with refused("runs", "must be 1"):
        units.Plan(runs=0)
