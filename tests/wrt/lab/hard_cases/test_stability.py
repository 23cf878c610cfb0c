"""The runner of the hard cases: what it reports of the default tests, and that it does see what others get wrong."""

from __future__ import annotations

import json

import numpy as np
import pytest

from tests.command_line import wrt as run
from tests.refused import refused
from wrt.accel.structures import ACCELERATORS
from wrt.lab.bench import contestants
from wrt.lab.bench.contestants import Embree, Own, contestant
from wrt.lab.bench.report import Row, text
from wrt.lab.bench.report import run as run_study
from wrt.lab.hard_cases import stability
from wrt.lab.hard_cases.cases import Verdict, chosen, generate
from wrt.lab.hard_cases.stability import TESTS, Plan, run_case

LIBRARIES = ("embree", "embree:mode=fast", "warp", "open3d", "mitsuba", "trimesh", "trimesh:engine=numpy")


@pytest.mark.parametrize("name", ["B_jittered_vertices", "C_triangles", "C_spheres", "E_grid", "G_fan_edges"])
def test_the_default_loses_nothing(name: str) -> None:
    row = run_case(name, 500, Own(), compared=None)
    assert row is not None and row.v.rays >= 500
    # Duplicates are reported, not held against it: closed triangles that share a vertex are all hit through it.
    assert (row.v.misses, row.v.false_hits, row.v.wrong_prim, row.v.self_hits) == (0, 0, 0, 0), row.v.examples
    assert (row.v.t.over, row.v.u.over, row.v.v.over) == (0, 0, 0)


def test_a_looser_test_is_seen_to_lose_rays() -> None:
    # Rays at vertices: Moeller-Trumbore rounds each triangle by itself.
    row = run_case("A_1e4_vertices", 2000, contestant("bvh8:triangle=moeller_trumbore"))
    assert row is not None and row.v.misses > 0 and not row.v.ok


@pytest.mark.parametrize("name", LIBRARIES)
def test_libraries_answer_as_wrt_does_where_it_is_easy(name: str) -> None:
    rival, own = contestant(name), Own()
    if reason := rival.missing():
        pytest.skip(reason)
    case = generate("H_scale_1_uniform", 500)
    assert rival.prepare(case.geometry) and own.prepare(case.geometry)
    for away in (0.5, 3.0):  # hits; hits and misses
        rays = np.float32(away) * case.origins, 3.0 * case.directions
        theirs, ours = (each.closest(*rays) for each in (rival, own))
        same = theirs.prim_id == ours.prim_id
        assert same.mean() > 0.99 and theirs.t.shape == (500,) and (away == 0.5) == (theirs.prim_id >= 0).all()
        hit = same & (ours.prim_id >= 0)
        np.testing.assert_allclose(theirs.t[hit], ours.t[hit], rtol=1e-4)
        if theirs.u is not None:
            np.testing.assert_allclose(np.stack([theirs.u, theirs.v])[:, hit], np.stack([ours.u, ours.v])[:, hit], atol=1e-3)
    assert not rival.prepare(generate("C_spheres", 10).geometry)  # triangles only


def test_embree_is_asked_in_both_modes() -> None:
    pytest.importorskip("embreex", reason='needs embreex: pip install "wrt[peers]"')
    case, missed = generate("A_origin_vertices", 2000), {}
    for mode in ("robust", "fast"):
        one = Embree(mode=mode)
        one.prepare(case.geometry)
        missed[mode] = (one.closest(case.origins, case.directions).prim_id < 0).sum()
    assert missed["fast"] > 5 * missed["robust"]  # of rays at the vertices of a closed sphere: none should be


def test_an_error_of_a_library_is_counted_and_may_refuse_what_is_not_finite() -> None:
    class Broken(Embree):
        NAME = "broken"

        def load(self, geometry):
            raise RuntimeError("no\nmore")

    rows = [run_case(name, 5, Broken()) for name in ("D_published", "I_mesh_not_finite")]
    assert [row.note for row in rows if row] == ["RuntimeError: no", "refused"]
    speed = Row(name="broken", mrays=[1.0], ratios=[1.0])
    assert stability.parts([speed, *rows], Plan())[0].lines[0][7] == "1"
    assert run_case("H_exact_ends", 5, Broken()) is None  # it has no t_min


def beyond_the_sample(name: str, own: Own) -> Verdict:
    return sum(stability.judge_further(name, Plan(rays=1000, sample=300), own), Verdict())


def test_rays_beyond_the_sample_are_held_to_what_is_known_of_them() -> None:
    for name, more in (("E_grid", 700), ("C_spheres", 700), ("D_published", 700), ("E_beside", 0), ("G_fan_edges", 7)):
        verdict = beyond_the_sample(name, Own())
        assert verdict.rays == more and verdict.ok
    only_some = beyond_the_sample("F_edge_on", Own())
    assert 100 < only_some.rays < 600  # those exactly in the triangles' planes
    # They are other rays than the sample's, and the same each time.
    assert np.unique(np.concatenate([generate("E_grid", 50, (0, i)).origins for i in (0, 1)]), axis=0).shape[0] > 50


def test_what_is_wrong_beyond_the_sample_is_seen(monkeypatch) -> None:
    class Lossy(ACCELERATORS["bvh8"]):  # type: ignore[misc, name-defined]
        name = "lossy"

        def closest_hit(self, *arguments, **options):
            hits = super().closest_hit(*arguments, **options)
            hits.prim_id[:5], hits.t[:5] = -1, np.inf
            return hits

    monkeypatch.setitem(ACCELERATORS, "lossy", Lossy)
    verdict = beyond_the_sample("B_jittered_uniform", Own("lossy"))
    assert verdict.misses == 5 and verdict.rays == 700


@pytest.fixture(scope="module")
def result():
    plan = Plan(("E_grid", "D_published", "I_rays_not_finite"), (*TESTS, "warp"), rays=60, sample=40, runs=1)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(stability, "SPEED_RAYS", 2000)
        return run_study(plan), plan


def test_the_report_has_a_row_for_each(result) -> None:
    rows, plan = result
    assert {row.name for row in rows if "case" in vars(row)} == {*TESTS, "warp"} == {row.name for row in rows if "mrays" in vars(row)}
    page = text(rows, plan, "a machine")
    lines = [[cell.strip() for cell in line.split("|")[1:-1]] for line in page.splitlines() if line.startswith("|")]
    assert ["E_grid", "bvh8", "60", "40", "0", "0", "0", "0"] in [line[:8] for line in lines]
    assert ["I_rays_not_finite", "bvh8", "refused"] in [line[:3] for line in lines]
    assert ["E", "0 of 60"] in [line[:2] for line in lines] and "--rays 60 --sample 40" in page
    first = next(row for row in rows if row.name == "bvh8")
    assert first.ratios == [1.0]


def test_the_command(monkeypatch, tmp_path) -> None:
    monkeypatch.setattr(stability, "SPEED_RAYS", 2000)
    done = run("stability", "E_grid", "--contestants", "bvh8,bvh8:box=plain", "--rays", "20", "--runs", "1", "--json", "-q",
               "-o", tmp_path / "a.md")
    assert done.code == 0, done.err
    assert [row["v"]["rays"] for row in json.loads(done.out)["rows"] if "case" in row] == [20, 20]
    assert "Wrong rays by group of cases" in (tmp_path / "a.md").read_text()
    for arguments, said in ((("Q",), "no hard case 'Q'"), (("--contestants", "nothing"), "no contestant 'nothing'"),
                            (("--rays", "0"), "rays must be 1 to"), (("-o", tmp_path / "a.html"), "must be a .md")):
        result = run("stability", *arguments)
        assert result.code == 2 and said in result.err
    assert chosen(["E"]) == ["E_grid", "E_beside"]


def test_a_library_that_is_not_installed_is_named(monkeypatch) -> None:
    class Nowhere(Embree):
        NAME, package = "nowhere", "no_such_package_at_all"

    monkeypatch.setitem(contestants.LIBRARIES, "nowhere", Nowhere)
    monkeypatch.setattr(stability, "PEERS", ("nowhere",))
    plan = Plan(peers=True)
    assert stability.machine(plan).endswith("not installed: nowhere") and [one.name for one in stability.contestants(plan)] == list(TESTS)
    with refused("contestants", "nowhere cannot be used"):
        Plan(contestants=("nowhere",))
