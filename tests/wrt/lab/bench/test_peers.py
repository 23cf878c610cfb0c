"""bench peers: rivals answer alike, differences are counted, ratios are of the same runs, and the command says it."""

from __future__ import annotations

import csv
import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from tests.command_line import BOX_OBJ
from tests.command_line import wrt as command
from tests.refused import Refusal, refused
from wrt.accel.geometry import Geometry
from wrt.accel.queries.answers import Hits
from wrt.accel.scenes.build import build
from wrt.core.errors import InputError
from wrt.core.threads import thread_count
from wrt.lab.bench import peer_points, peers
from wrt.lab.bench.instruction_sets import compiled_for
from wrt.lab.bench.peers import Plan, answer, differing, means, searching
from wrt.lab.bench.rays import ray_sets
from wrt.lab.bench.report import Row, run, text
from wrt.lab.hard_cases import tinybvh
from wrt.scene.shapes import icosphere

RIVALS = [name for name, peer in peers.RIVALS.items() if peer.is_installed()]
# The parts of tinybvh's interface that wrt uses, over all triangles without a tree: Moeller and Trumbore 1997 in double precision.
HEADER = """
#include <cmath>
#include <cstdint>
#include <cstring>
#define TINY_BVH_VERSION_MAJOR 1
#define TINY_BVH_VERSION_MINOR 2
#define TINY_BVH_VERSION_SUB 3
#define BVH_FAR 1e30f
#define BVH_USEAVX2
namespace tinybvh {
struct bvhvec3 { float x, y, z; bvhvec3() = default; bvhvec3(float a, float b, float c) : x(a), y(b), z(c) {} };
struct bvhvec4 { float x, y, z, w; };
struct Ray {
    double o[3], d[3]; struct { float t, u, v; uint32_t prim; } hit;
    Ray(bvhvec3 a, bvhvec3 b, float t) : o{a.x, a.y, a.z}, d{b.x, b.y, b.z} {
        double l = std::sqrt(d[0] * d[0] + d[1] * d[1] + d[2] * d[2]); for (double& x : d) x /= l; hit = {t, 0, 0, 0}; }
};
inline void cross(const double* a, const double* b, double* c) { for (int i = 0; i < 3; ++i) {
    int j = (i + 1) % 3, k = (i + 2) % 3; c[i] = a[j] * b[k] - a[k] * b[j]; } }
inline double dot(const double* a, const double* b) { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; }
struct All {
    const bvhvec4* corners; uint32_t n;
    void BuildHQ(const bvhvec4* c, uint32_t count) { corners = c; n = count; }
    int Intersect(Ray& ray) const {
        for (uint32_t i = 0; i < n; ++i) {
            const bvhvec4 *a = corners + 3 * i, *b = a + 1, *c = a + 2;
            double e[3] = {b->x - a->x, b->y - a->y, b->z - a->z}, f[3] = {c->x - a->x, c->y - a->y, c->z - a->z};
            double s[3] = {ray.o[0] - a->x, ray.o[1] - a->y, ray.o[2] - a->z}, p[3], q[3]; cross(ray.d, f, p); cross(s, e, q);
            double det = dot(e, p), u = dot(s, p) / det, v = dot(ray.d, q) / det, t = dot(f, q) / det;
            if (u >= 0 && v >= 0 && u + v <= 1 && t > 0 && t < ray.hit.t) ray.hit = {(float)t, (float)u, (float)v, i};
        }
        return 0;
    }
    bool IsOccluded(const Ray& ray) const { Ray copy = ray; Intersect(copy); return copy.hit.t < ray.hit.t; }
};
typedef All BVH4_CPU; typedef All BVH8_CPU;
}
"""


def made(name: str, first_over_it: float = 1.0, mesh: str = "m", kind: str = "primary", threads: int = 1) -> Row:
    return Row(mesh=mesh, triangles=100, kind=kind, rays=10**6, hit=0.5, name=name, library=name.split(",")[0], build=0.1, mrays=[1.0],
               ns=100.0 * first_over_it, threads=threads, first_over_it=first_over_it, differ=0)


@pytest.fixture
def box(tmp_path: Path) -> Path:
    (tmp_path / "box.obj").write_text(BOX_OBJ)
    return tmp_path / "box.obj"


def test_everybody_answers_alike_on_a_sphere() -> None:
    rows = run(Plan(structures=("bvh", "bvh2"), rays=2000, runs=2))
    names = ["wrt bvh8", "wrt bvh2", *(peers.RIVALS[name].name for name in RIVALS)]
    counts = [1, thread_count(None)] if thread_count(None) > 1 else [1]
    expected = [(kind, threads, name) for kind in ("primary", "shadow", "diffuse", "random") for threads in counts for name in names]
    expected += [("points", threads, each.name) for threads in counts for each in peer_points.LIBRARIES.values()
                 if each.is_installed() and (each.has_threads or threads == 1)]
    assert [(row.kind, row.threads, row.name) for row in rows] == expected
    for row in rows:
        assert row.triangles == 20480 and 0 < row.rays <= 2000 and len(row.seconds) == 2 and min(row.seconds) > 0.0
        assert row.ns == pytest.approx(1e9 * np.median(row.seconds) / row.rays)
        # wrt's own structures never differ; a rival may lose a ray that grazes.
        assert row.differ == 0 if row.name.startswith("wrt") else row.differ <= 0.002 * row.rays
    assert {row.kind: row.hit > 0.2 for row in rows}["primary"]


@pytest.mark.skipif(not any(map(shutil.which, tinybvh.COMPILERS)), reason="needs a C++ compiler")
def test_tinybvh_gets_the_same_rays(tmp_path: Path) -> None:
    """A header whose trees test all triangles in double precision answers as wrt does: rays, segments and hits are passed rightly."""
    (tmp_path / tinybvh.HEADER).write_text(HEADER)
    plan = Plan((icosphere(2),), tinybvh=str(tmp_path), rivals=("warp",), kinds=("primary", "shadow", "diffuse"), rays=500, runs=1,
                threads="one")
    rows = run(plan)
    for kind in plan.kinds:
        names = [(row.name, row.library) for row in rows if row.kind == kind]
        assert names[2:] == [(f"tinybvh BVH{width}_CPU", "tinybvh") for width in (4, 8)]
    assert [row.differ for row in rows if row.library == "tinybvh"] == [0] * 6 and 0.1 < rows[0].hit < 0.9
    assert "tinybvh, best mode" in means(rows) and "tinybvh 1.2.3" in peers.machine(plan)
    geometry, rays = Geometry.of(icosphere(2)), ray_sets(build(Geometry.of(icosphere(2)), "bvh"), 500)["primary"]
    (tree, _), (own, *_) = tinybvh.trees(tmp_path), peers.contestants(plan)
    for algorithm in (tree, own):
        algorithm.prepare(geometry)
    found, truth = (algorithm.closest(rays.origins, 3.0 * rays.directions, 0.0, 1.0) for algorithm in (tree, own))
    np.testing.assert_array_equal(found.prim_id, truth.prim_id)
    for a, b in ((found.t, truth.t), (found.u, truth.u), (found.v, truth.v)):
        np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-5)


def test_what_tinybvh_needs_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    done = command("bench", "peers", "--tinybvh", tmp_path, "--rays", 10, "--runs", 1, "--kinds", "primary", "--rivals", "warp")
    assert done.code == 2 and f"{tmp_path}: has no tiny_bvh.h" in done.err
    (tmp_path / tinybvh.HEADER).write_text("#error broken\n")
    with pytest.raises(InputError, match=r"cannot compile tiny_bvh\.h"):
        tinybvh.library(tmp_path)
    monkeypatch.setenv("PATH", "")
    with pytest.raises(InputError, match="needs a C\\+\\+ compiler"):
        tinybvh.library(tmp_path)


def test_worlds_are_told_apart() -> None:
    rows = run(Plan(kinds=("tiles",), worlds=3, runs=1, threads="one"))
    assert [row.name for row in rows] == ["wrt bvh8, worlds", "Warp mesh_query_ray, sah, a mesh a world"]
    assert {(row.kind, row.mesh, row.rays, row.triangles) for row in rows} == {("tiles", "3 worlds", 3 * 64 * 64, 3 * 3202)}
    assert rows[1].differ <= 3 and 0.3 < rows[0].hit < 0.99


@pytest.mark.parametrize(("flags", "features", "name"), [
    ("-march=native -O3", {"sse2", "avx2", "avx512f"}, "AVX-512"), (None, {"sse2", "avx2"}, "AVX2"), (None, {"neon"}, "NEON"),
    ("-target-cpu x86-64-v3", {"sse2", "avx2", "avx512f"}, "AVX2"), ("-target-cpu neoverse-n1", {"neon"}, "neoverse-n1"),
    ("", {"avx2"}, "the compiler's least instructions"),
])
def test_instruction_sets_are_those_of_the_flags(flags: str | None, features: set[str], name: str) -> None:
    assert compiled_for(flags, frozenset(features)) == name


def test_segments_end_where_they_end(box) -> None:
    # Shadow rays end at the light; a rival that looked beyond would find other walls.
    for row in run(Plan((box,), kinds=("shadow",), rays=2000, runs=1, threads="one")):
        assert row.threads == 1 and row.kind == "shadow" and row.differ <= 2


@pytest.mark.parametrize("rival", RIVALS)
def test_parts_of_the_rays_are_put_together_again(rival: str) -> None:
    geometry = Geometry.of(icosphere(3))
    who = peers.RIVALS[rival]()
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
    seconds = {0: np.array([1.0, 2.0, 4.0]), 1: np.array([2.0, 6.0, 4.0])}
    monkeypatch.setattr(peers, "alternate_on", lambda device, jobs, runs, clock: seconds)
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
    few = "--rays", 300, "--runs", 1, "--rivals", "warp", "--kinds", "random,points", "--threads", "one", "-q"
    for name in ("out.csv", "out.svg", "out.png"):
        assert command("bench", "peers", box, *few, "-o", tmp_path / name).code == 0
    lines = (tmp_path / "out.csv").read_text().splitlines()
    assert f"# command: python -m wrt bench peers {box.name} --rivals warp --kinds random,points --rays 300" in lines[0]
    table = list(csv.DictReader(line for line in lines if not line.startswith("#")))
    assert [(row["kind"], row["name"]) for row in table] == [
        ("random", "wrt bvh8"), ("random", "Warp mesh_query_ray"), ("points", "wrt bvh8")]
    assert all(float(row["ns"]) > 0.0 for row in table)
    assert (tmp_path / "out.svg").read_text().lstrip().startswith("<?xml") and Image.open(tmp_path / "out.png").width > 400
    done = command("bench", "peers", box, "-o", tmp_path / "out.txt")
    assert done.code == 2 and "must be a .md or .json or .csv or .svg or .png file" in done.err
    done = command("bench", "peers", box, "-o", tmp_path / "no" / "out.md")
    assert done.code == 2 and "no/out.md: its folder does not exist" in done.err
