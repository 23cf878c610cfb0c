"""The hard cases put to anybody's closest hit: each kind of fault is counted as what it is."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import wrt
from tests.refused import Refusal, refused
from wrt.lab.hard_cases.cases import HARD_CASES, generate
from wrt.lab.hard_cases.conformance import EXCLUDED_CASES, Case, Result, case_names, hard_cases


def own(vertices: np.ndarray, faces: np.ndarray, origins: np.ndarray, directions: np.ndarray) -> Any:
    return wrt.build((vertices, faces)).closest_hit(origins, directions)


CASES = ("B_jittered_vertices", "D_published", "G_coincident_uniform", "I_rays_not_finite")


@pytest.mark.filterwarnings("ignore:a mesh. its float32 vertices lie up to")  # D_published is far from 0
def test_wrt_loses_nothing() -> None:
    report = hard_cases(own, CASES, rays=100)
    assert report.ok and [result.case for result in report.results] == list(CASES)
    assert report.results[-1].refused and report.results[-1].note == "refused"
    assert (report.total.rays, report.total.wrong) == (400, 0) and 0.0 < report.total.t_ulp < 100.0
    assert [cell.strip() for cell in str(report).splitlines()[-1].split("|")[1:6]] == ["all", "400", "0", "0", "0"]


def test_each_fault_is_counted() -> None:
    case = Case("B_jittered_uniform", 100)
    part = next(case.parts)
    right = own(part.geometry.vertices, part.geometry.faces, part.origins, part.directions)

    def with_faults(*_: np.ndarray) -> Any:
        t, prim_id = right.t.copy(), right.prim_id.copy()
        prim_id[:7] = -1
        t[10:15] = -1.0
        prim_id[20:23] = (prim_id[20:23] + 240) % 480  # the other side of the sphere
        t[30] *= 0.999
        return t, prim_id

    result = case.result(with_faults)
    assert (result.lost, result.invented, result.wrong_triangle, result.wrong, result.ok) == (7, 8, 0, 15, False)
    assert 2000 < result.t_ulp < 20_000  # 0.001 of 2^24, and half of it for a t just below a power of two
    with pytest.raises(AssertionError, match=r"7 lost, 8 invented, 0 with a wrong triangle\n  ray 0: must hit, is") as said:
        case.check(with_faults)
    assert "each vertex at radius 1 + 5 U" in str(said.value)  # what is hard in it


def test_the_second_hit_is_of_a_wrong_triangle() -> None:
    case = Case("E_grid", 100)

    def second(vertices: np.ndarray, faces: np.ndarray, origins: np.ndarray, directions: np.ndarray) -> Any:
        hits = wrt.all_hits(wrt.build((vertices, faces)), origins, directions)
        beyond = hits.t > hits.t[hits.first[:-1]][hits.ray_id]
        prim_id, t = np.full(len(origins), -1), np.zeros(len(origins))
        prim_id[hits.ray_id[beyond]], t[hits.ray_id[beyond]] = hits.prim_id[beyond], hits.t[beyond]
        return t, prim_id

    result = case.result(second)
    assert result.wrong_triangle > 20 and result.lost > 0 and result.lost + result.wrong_triangle <= 100


def test_a_hit_behind_t_max_is_none() -> None:
    part = generate("D_published", 1)
    assert part.t_max[0] < 1.0
    answer = np.full(20, 1.0), np.zeros(20, np.int64)
    assert Case("D_published", 20).result(lambda *_: answer).ok
    assert Case("D_published", 20).result(lambda *_: (0.5 * answer[0], answer[1])).invented == 20


def test_what_is_raised_is_told_and_input_that_is_not_finite_may_be_refused() -> None:
    def broken(*_: np.ndarray) -> Any:
        raise RuntimeError("no\nmore")

    report = hard_cases(broken, ["D_published", "I_mesh_not_finite"], rays=5)
    assert [(result.note, result.ok) for result in report.results] == [("RuntimeError: no", False), ("refused", True)]
    assert not report.ok and "RuntimeError: no" in str(report) and "RuntimeError" in report._repr_html_()
    with pytest.raises(RuntimeError, match="no"):
        Case("D_published", 5).check(broken)
    Case("I_mesh_not_finite", 5).check(broken)


def test_all_cases_of_triangles_are_asked() -> None:
    assert set(case_names()) == HARD_CASES.keys() - set(EXCLUDED_CASES) and len(case_names()) >= 44
    for name in EXCLUDED_CASES:
        case = generate(name, 20)
        assert len(case.geometry.spheres) or case.t_min.any()
    assert case_names(["C"]) == ["C_triangles"]
    assert Case("G_fan_edges", 1000).rays == 10 and repr(Case("E_grid")) == "E_grid"
    assert not Result("E_grid", 1, lost=1).ok


@pytest.mark.parametrize("call, said", [
    (lambda: Case("E"), ("E", "group")), (lambda: Case("Q"), ("cases", "no hard case 'Q'")), (lambda: Case("E_grid", 0), ("rays", "1")),
    (lambda: hard_cases(own, ["E_grid", "C_spheres"]), ("C_spheres", "not")), (lambda: hard_cases(own, "E_grid", seed=-1), ("seed", "0")),
    (lambda: hard_cases(lambda *_: None, ["E_grid"], 5), ("closest_hit", "return t")),
    (lambda: hard_cases(lambda *_: (np.zeros(4), np.zeros(5, int)), ["E_grid"], 5), ("closest_hit", "t (5,)")),
    (lambda: hard_cases(lambda *_: (np.zeros(5), np.zeros(5)), ["E_grid"], 5), ("closest_hit", "float64")),
])
def test_what_is_refused(call: Any, said: Refusal) -> None:
    with refused(*said):
        call()
