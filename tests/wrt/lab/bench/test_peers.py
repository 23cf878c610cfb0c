"""bench peers: rivals answer alike, differences are counted, ratios are of the same runs, and the command says it."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from tests.command_line import BOX_OBJ
from tests.command_line import wrt as command
from tests.refused import Refusal, refused
from wrt.accel.geometry import Geometry
from wrt.accel.queries.answers import Hits
from wrt.accel.scenes.build import build
from wrt.core.threads import thread_count
from wrt.lab.bench import peers
from wrt.lab.bench.peers import Plan, answer, differing, means, searching
from wrt.lab.bench.rays import ray_sets
from wrt.lab.bench.report import Row, run, text
from wrt.lab.hard_cases.contestants import PEERS
from wrt.scene.shapes import icosphere

RIVALS = [name for name, peer in PEERS.items() if peer.is_installed()]


def made(name: str, first_over_it: float = 1.0, mesh: str = "m", kind: str = "primary", threads: int = 1) -> Row:
    return Row(mesh=mesh, triangles=100, kind=kind, rays=10**6, hit=0.5, name=name, build=0.1, mrays=[1.0], threads=threads,
               first_over_it=first_over_it, differ=0)


@pytest.fixture
def box(tmp_path: Path) -> Path:
    (tmp_path / "box.obj").write_text(BOX_OBJ)
    return tmp_path / "box.obj"


def test_everybody_answers_alike_on_a_sphere() -> None:
    rows = run(Plan(structures=("bvh", "bvh2"), rays=2000, runs=2))
    names = ["wrt bvh8", "wrt bvh2", *(PEERS[name].name for name in RIVALS)]
    counts = [1, thread_count(None)] if thread_count(None) > 1 else [1]
    assert [(row.kind, row.threads, row.name) for row in rows] == [
        (kind, threads, name) for kind in ("primary", "shadow", "diffuse", "random") for threads in counts for name in names]
    for row in rows:
        assert row.triangles == 20480 and 0 < row.rays <= 2000 and len(row.seconds) == 2 and min(row.seconds) > 0.0
        # wrt's own structures never differ; a rival may lose a ray that grazes.
        assert row.differ == 0 if row.name.startswith("wrt") else row.differ <= 0.002 * row.rays
    assert {row.kind: row.hit > 0.2 for row in rows}["primary"]


def test_segments_end_where_they_end(box) -> None:
    # Shadow rays end at the light; a rival that looked beyond would find other walls.
    for row in run(Plan((box,), kinds=("shadow",), rays=2000, runs=1, threads="one")):
        assert row.threads == 1 and row.kind == "shadow" and row.differ <= 2


@pytest.mark.parametrize("rival", RIVALS)
def test_parts_of_the_rays_are_put_together_again(rival: str) -> None:
    geometry = Geometry.of(icosphere(3))
    who = PEERS[rival]()
    who.prepare(geometry)
    rays = ray_sets(build(geometry, "bvh"), 997, 0)
    for kind in ("primary", "shadow"):
        one, some = (searching(who, rays[kind], threads)() for threads in (1, 3))
        assert rival == "open3d" or (len(one), len(some)) == (1, -(-len(rays[kind]) // -(-len(rays[kind]) // 12)))
        assert differing(answer(who, rays[kind], some), answer(who, rays[kind], one)) == 0
        dark = answer(who, rays[kind], some)
        assert not rays[kind].any_hit or (len(dark) == len(rays[kind]) and 0 < np.sum(dark) < len(dark))


def test_differing_counts_misses_and_other_places_but_no_ties() -> None:
    def hits(prim_id, t) -> Hits:
        zero = np.zeros(len(prim_id), np.float32)
        return Hits(np.array(t, np.float32), zero, zero, np.array(prim_id, np.int32))

    truth = hits([1, 2, 3, -1, -1], [1.0, 1.0, 1.0, np.inf, np.inf])
    assert differing(truth, truth) == 0
    assert differing(hits([1, 7, 8, -1, 4], [9.0, 1.00001, 1.1, np.inf, 2.0]), truth) == 2  # a tie, another place, a false hit
    assert differing(hits([-1, 2, 3, -1, -1], [np.inf, 1, 1, np.inf, np.inf]), truth) == 1
    assert differing(np.array([True, False]), np.array([True, True])) == 1


def test_means_are_geometric_and_of_each_number_of_threads() -> None:
    rows = [made("wrt"), made("it", 2.0), made("wrt", mesh="n"), made("it", 8.0, "n"), made("wrt", mesh="n", kind="random"),
            made("it", 0.5, "n", "random")]
    assert means(rows) == {"it": {"primary": pytest.approx(4.0), "random": pytest.approx(0.5)}}
    several = [Row(**vars(row) | {"threads": 2}) for row in rows]
    assert means([*rows, *several]) == means(rows) | {"it, 2 threads": means(rows)["it"]}
    page = text(rows, Plan(), "a machine")
    assert "a machine" in page and "| primary |" in page and "4.00" in page and "Geometric means over 2 meshes" in page


def test_ratios_are_medians_of_the_runs(monkeypatch) -> None:
    monkeypatch.setattr(peers, "alternate", lambda jobs, runs, clock: {0: np.array([1.0, 2.0, 4.0]), 1: np.array([2.0, 6.0, 4.0])})
    monkeypatch.setattr(peers, "searching", lambda who, rays, threads: lambda: None)
    monkeypatch.setattr(peers, "answer", lambda who, rays, out: np.array([True]))
    rays = ray_sets(build(Geometry.of(icosphere(0))), 16)["shadow"]
    first, other = peers.compared([None, None], rays, 1, 3)
    assert (first["first_over_it"], other["first_over_it"]) == (1.0, 2.0)


@pytest.mark.parametrize(("options", "message"), [
    ({"rays": 0}, ("rays",)), ({"runs": 0}, ("runs",)), ({"structures": ("x",)}, ("structures", "no structure 'x'")),
    ({"structures": ()}, ("structures",)),
    ({"rivals": ("x",)}, ("rivals", "no rival 'x'")), ({"kinds": ("x",)}, ("kinds", "no kind")),
    ({"threads": "2"}, ("threads", "no number")),
])
def test_wrong_plans_are_refused(options, message: Refusal) -> None:
    with refused(*message):
        Plan(**options)


def test_the_command_prints_and_writes(box, tmp_path) -> None:
    done = command("bench", "peers", box, "--rays", 300, "--runs", 2, "--rivals", "warp", "--kinds", "random", "--json", "-q",
                   "--threads", "one", "-o", tmp_path / "out.md")
    assert done.code == 0, done.err
    told = json.loads(done.out)
    assert [row["name"] for row in told["rows"]] == ["wrt bvh8", "Warp mesh_query_ray"]
    assert "Warp mesh_query_ray" in told["means"] and "differ" in (tmp_path / "out.md").read_text()
    done = command("bench", "peers", box, "-o", tmp_path / "no" / "out.md")
    assert done.code == 2 and "no/out.md: its folder does not exist" in done.err
