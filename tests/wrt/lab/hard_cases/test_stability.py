"""The runner of the hard cases: what it reports of the default units, and that it does see what others get wrong."""

from __future__ import annotations

import json
import signal
import sys
from types import SimpleNamespace

import numpy as np
import pytest

from tests.command_line import wrt as run
from tests.refused import refused
from wrt.accel.geometry import Geometry
from wrt.kernels.units.box import RAY_AABB
from wrt.kernels.units.triangle import RAY_TRIANGLE
from wrt.lab.hard_cases import report, stability
from wrt.lab.hard_cases.cases import Verdict, generate
from wrt.lab.hard_cases.contestants import PEERS, Embree, EmbreeFast, Open3D, Own, WarpMesh, own_algorithms


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
    names = {(a.units["triangle"], a.units["box"]) for a in own_algorithms()}
    assert {triangle for triangle, _ in names} == set(RAY_TRIANGLE) and {box for _, box in names} == set(RAY_AABB)


@pytest.mark.parametrize("peer", [WarpMesh, Embree, EmbreeFast])
def test_peers_answer_as_wrt_does_where_it_is_easy(peer) -> None:
    if issubclass(peer, Embree):
        pytest.importorskip("embreex", reason='needs embreex: pip install "wrt[peers]"')
    case = generate("H_scale_1_uniform", 500)
    rival, own = peer(), Own()
    assert rival.prepare(case.geometry) and own.prepare(case.geometry)
    theirs, ours = (a.closest(case.origins, case.directions, case.t_min, case.t_max) for a in (rival, own))
    np.testing.assert_array_equal(theirs.prim_id, ours.prim_id)
    np.testing.assert_allclose(theirs.t, ours.t, rtol=1e-4)
    np.testing.assert_allclose(np.stack([theirs.u, theirs.v]), np.stack([ours.u, ours.v]), atol=1e-3)
    assert not rival.prepare(generate("C_spheres", 10).geometry)  # triangles only


def test_embree_is_asked_in_both_modes() -> None:
    pytest.importorskip("embreex", reason='needs embreex: pip install "wrt[peers]"')
    assert {"embree", "embree_fast"} <= PEERS.keys() and (Embree.name, EmbreeFast.name) == ("Embree robust", "Embree fast")
    case = generate("A_origin_vertices", 2000)
    both = []
    for peer in (Embree(), EmbreeFast()):
        peer.prepare(case.geometry)
        both.append(peer.closest(case.origins, case.directions, case.t_min, case.t_max))
    robust, fast = both
    assert (robust.t != fast.t).mean() > 0.1  # the last bits of most distances
    missed_robust, missed_fast = ((hits.prim_id < 0).sum() for hits in both)
    assert missed_fast > 5 * missed_robust  # of rays at the vertices of a closed sphere: none should be


@pytest.mark.parametrize("peer", [Embree, EmbreeFast])
def test_embree_s_mode_is_asked_for_and_not_left_to_embreex(peer, monkeypatch) -> None:
    scenes = pytest.importorskip("embreex.rtcore_scene", reason='needs embreex: pip install "wrt[peers]"')
    pytest.importorskip("embreex.mesh_construction")  # it looks for the real EmbreeScene when it is first imported
    real, asked = scenes.EmbreeScene, []

    def spy(**options):
        asked.append(options)
        return real(**options)

    monkeypatch.setattr(scenes, "EmbreeScene", spy)
    assert peer().prepare(generate("E_grid", 10).geometry)
    assert asked == [{"robust": peer is Embree}]
    monkeypatch.setattr(scenes, "EmbreeScene", lambda: real())  # as before embreex 4.4
    with refused(what="embreex"):
        peer().prepare(generate("E_grid", 10).geometry)


def test_peers_need_not_keep_to_the_rule_for_ties() -> None:
    row = stability.run_case("G_coincident_uniform", 300, WarpMesh())
    assert row is not None and row.verdict.wrong_prim == 0 and row.verdict.ties > 250


def test_names_and_letters_choose_cases() -> None:
    assert stability.chosen(["E"]) == ["E_grid", "E_beside"] and stability.chosen(["C_spheres"]) == ["C_spheres"]
    with refused("cases", "no hard case 'Q'"):
        stability.chosen(["Q"])


def beyond_the_sample(name: str) -> Verdict:
    return sum(stability.judge_further(name, stability.Plan(rays=1000, sample=300), lambda line: None), Verdict())


def test_rays_beyond_the_sample_are_held_to_what_is_known_of_them() -> None:
    for name, more in (("E_grid", 700), ("C_spheres", 700), ("D_published", 700), ("E_beside", 0), ("G_fan_edges", 7)):
        verdict = beyond_the_sample(name)
        assert verdict.rays == more and verdict.ok
    only_some = beyond_the_sample("F_edge_on")
    assert 100 < only_some.rays < 600  # those exactly in the triangles' planes
    # They are other rays than the sample's, and the same each time.
    assert np.unique(np.concatenate([generate("E_grid", 50, (0, i)).origins for i in (0, 1)]), axis=0).shape[0] > 50


def test_what_is_wrong_beyond_the_sample_is_seen(monkeypatch) -> None:
    class Lossy(Own):
        def closest(self, *arguments):
            hits = super().closest(*arguments)
            hits.prim_id[:5], hits.t[:5] = -1, np.inf
            return hits

    monkeypatch.setattr(stability, "Own", Lossy)
    verdict = beyond_the_sample("B_jittered_uniform")
    assert verdict.misses == 5 and verdict.rays == 700


@pytest.fixture(scope="module")
def result():
    lines: list[str] = []
    plan = stability.Plan(("E_grid", "D_published", "I_rays_not_finite"), rays=60, sample=40, runs=1)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(stability, "SPEED_RAYS", 2000)
        found = stability.run(plan, progress=lines.append)
    assert any("E_grid" in line and "M further rays" in line for line in lines)
    return found, plan


def test_the_report_has_a_row_for_each(result, tmp_path) -> None:
    found, plan = result
    assert {row.algorithm for row in found.rows} == {a.name for a in own_algorithms()} == set(found.speed)
    text = report.text(found, plan, "a machine")
    grid = next(line for line in text.splitlines() if line.startswith("| E_grid") and "| " in line and " watertight |" in line)
    assert [cell.strip() for cell in grid.split("|")[3:8]] == ["60", "40", "0", "0", "0"]
    assert "--rays 60 --sample 40" in text and "| A to H" in text and "refused" in text
    for name in ("stability.html", "nowhere/stability.md"):
        assert run("stability", "E_grid", "-o", tmp_path / name).code == 2


def interrupted_after(count: int, monkeypatch, *options):
    """`stability` on two cases, with Ctrl-C while it is at the row after so many."""
    rows = []
    run_case = stability.run_case

    def interrupting(*arguments):
        if len(rows) == count:
            signal.raise_signal(signal.SIGINT)
        rows.append(run_case(*arguments))
        return rows[-1]

    with monkeypatch.context() as patch:
        patch.setattr(stability, "run_case", interrupting)
        patch.setattr(stability, "SPEED_RAYS", 2000)
        return run("stability", "E_grid", "D_published", "--rays", "60", "--sample", "40", "--runs", "1", *options)


@pytest.mark.parametrize(("rows", "undone"), [(1, ["E_grid", "D_published"]), (len(own_algorithms()), ["D_published"])])
def test_ctrl_c_keeps_the_rows_that_are_done(monkeypatch, tmp_path, rows, undone) -> None:
    path = tmp_path / "stability.md"
    done = interrupted_after(rows, monkeypatch, "-o", path)
    assert done.code == 130 and done.err.endswith("interrupted: the results so far are kept\n") and str(path) in done.out
    for text in (done.out, path.read_text()):
        assert f"Interrupted; not done, or not with all algorithms: {', '.join(undone)}" in text and "A to H" in text
        assert sum(line.lstrip("| ").startswith("E_grid") for line in text.splitlines()) == rows
    told = json.loads(interrupted_after(rows, monkeypatch, "--json").out)
    assert (told["interrupted"], told["undone"], len(told["rows"])) == (signal.SIGINT, undone, rows)


def test_ctrl_c_before_the_first_row_has_nothing_to_keep(monkeypatch) -> None:
    monkeypatch.setattr(stability, "run_case", lambda *arguments: signal.raise_signal(signal.SIGINT))
    monkeypatch.setattr(stability, "SPEED_RAYS", 2000)
    done = run("stability", "E_grid", "--rays", "60", "--sample", "40", "--runs", "1")
    assert done.code == 130 and done.err.endswith("interrupted\n") and "Traceback" not in done.err


def test_speed_is_told_with_its_spread(result) -> None:
    found, _ = result
    assert all(list(speed.mrays_per_second) == sorted(speed.mrays_per_second) for speed in found.speed.values())
    assert found.speed["watertight"].ratio_to_default == (1.0, 1.0, 1.0) and found.speed["watertight"].bytes_per_triangle > 40


def test_a_peer_that_is_not_installed_is_named(monkeypatch) -> None:
    class Nowhere(WarpMesh):
        name, package = "Nowhere", "no_such_package_at_all"

    monkeypatch.setattr(stability, "PEERS", {"nowhere": Nowhere})
    monkeypatch.setattr(stability, "SPEED_RAYS", 2000)
    found = stability.run(stability.Plan(("D_published",), rays=5, sample=5, peers=True, runs=1))
    assert found.not_installed == ["Nowhere"] and "Nowhere: not installed" in report.summary(found)
    assert Own().is_installed() and WarpMesh().is_installed()


def test_open3d_is_asked_by_its_documented_interface(monkeypatch) -> None:
    # Not Open3D itself, but its documented types and shapes; the answers are wrt's own.
    class Tensor:
        def __init__(self, array):
            self.array = array

        from_numpy = classmethod(lambda cls, array: cls(array))

        def numpy(self):
            return self.array

    class RaycastingScene:
        INVALID_ID = 4294967295

        def __init__(self, nthreads=0):
            pass

        def add_triangles(self, vertices, triangles):
            assert vertices.array.dtype == np.float32 and triangles.array.dtype == np.uint32
            self.own = Own()
            self.own.prepare(Geometry(vertices.array, triangles.array.astype(np.int32), np.zeros((0, 4), np.float32)))

        def cast_rays(self, rays, nthreads=0):
            assert rays.array.dtype == np.float32 and rays.array.shape[1] == 6
            hits = self.own.closest(rays.array[:, :3].copy(), rays.array[:, 3:].copy())
            prim_id = np.where(hits.prim_id < 0, self.INVALID_ID, hits.prim_id.astype(np.int64)).astype(np.uint32)
            uvs = np.stack([hits.u, hits.v], axis=1)
            return {"t_hit": Tensor(hits.t), "primitive_ids": Tensor(prim_id), "primitive_uvs": Tensor(uvs)}

    module = SimpleNamespace(core=SimpleNamespace(Tensor=Tensor),
                             t=SimpleNamespace(geometry=SimpleNamespace(RaycastingScene=RaycastingScene)))
    monkeypatch.setitem(sys.modules, "open3d", module)
    row = stability.run_case("E_grid", 200, Open3D())
    assert row is not None and row.verdict.ok and row.verdict.hits == 200
    assert stability.run_case("H_exact_ends", 200, Open3D()) is None  # it has no t_min
