"""The runner of the hard cases: what it reports of the default units, and that it does see what others get wrong."""

from __future__ import annotations

import numpy as np
import pytest

from wrt.bench import stability
from wrt.bench.algorithms import Embree, Own, WarpMesh, own_algorithms
from wrt.bench.hard_cases import generate
from wrt.errors import InputError
from wrt.kernels.ray_aabb import RAY_AABB
from wrt.kernels.ray_triangle import RAY_TRIANGLE


@pytest.mark.parametrize("name", ["B_jittered_vertices", "C_triangles", "C_spheres", "E_grid", "G_fan_edges"])
def test_the_default_loses_nothing(name: str) -> None:
    row = stability.run_case(name, 500, Own())
    assert row is not None and row.verdict.rays >= 500
    v = row.verdict
    # Duplicates are reported, not held against it: closed triangles that share a vertex are all hit through it.
    assert (v.misses, v.false_hits, v.wrong_prim, v.self_hits) == (0, 0, 0, 0), v.examples
    assert (v.t.over, v.u.over, v.v.over) == (0, 0, 0)


def test_what_is_not_finite_is_refused() -> None:
    for name in ("I_rays_not_finite", "I_mesh_not_finite"):
        row = stability.run_case(name, 100, Own())
        assert row is not None and row.refused is True
        assert stability.run_case(name, 100, WarpMesh()) is None


def test_a_looser_test_is_seen_to_lose_rays() -> None:
    # Rays at vertices: Moeller-Trumbore rounds each triangle by itself.
    row = stability.run_case("A_1e4_vertices", 2000, Own("moeller_trumbore"))
    assert row is not None and row.verdict.misses > 0 and not row.verdict.ok


def test_every_unit_is_put_to_the_cases() -> None:
    names = {(a.triangle, a.box) for a in own_algorithms()}
    assert {triangle for triangle, _ in names} == set(RAY_TRIANGLE) and {box for _, box in names} == set(RAY_AABB)


@pytest.mark.parametrize("peer", [WarpMesh, Embree])
def test_peers_answer_as_wrt_does_where_it_is_easy(peer) -> None:
    if peer is Embree:
        pytest.importorskip("embreex", reason='needs embreex: pip install "wrt[peers]"')
    case = generate("H_scale_1_uniform", 500)
    rival, own = peer(), Own()
    assert rival.prepare(case.geometry) and own.prepare(case.geometry)
    theirs, ours = (a.closest(case.origins, case.directions, case.t_min, case.t_max) for a in (rival, own))
    np.testing.assert_array_equal(theirs.prim_id, ours.prim_id)
    np.testing.assert_allclose(theirs.t, ours.t, rtol=1e-4)
    np.testing.assert_allclose(np.stack([theirs.u, theirs.v]), np.stack([ours.u, ours.v]), atol=1e-3)
    assert not rival.prepare(generate("C_spheres", 10).geometry)  # triangles only


def test_names_and_letters_choose_cases() -> None:
    assert stability.chosen(["E"]) == ["E_grid", "E_beside"] and stability.chosen(["C_spheres"]) == ["C_spheres"]
    with pytest.raises(InputError, match="no hard case 'Q'"):
        stability.chosen(["Q"])


def test_the_report_has_a_row_for_each(tmp_path) -> None:
    row = stability.run_case("E_grid", 50, Own())
    assert row is not None
    path = tmp_path / "stability.md"
    stability.write_report([row], path)
    assert f"| E_grid | watertight | {row.verdict.rays} | 0 | 0 | 0 |" in path.read_text()
    assert len(stability.cells(row)) == len(stability.COLUMNS)
    with pytest.raises(InputError, match=r"use \.md"):
        stability.check_report(tmp_path / "stability.txt")
