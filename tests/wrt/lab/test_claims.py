"""`bench claims`: walks by other rules and warps that help each other, against plain Python; verdicts, and all claims on small scenes."""

from __future__ import annotations

import json
from collections import deque
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from tests.command_line import wrt
from tests.refused import refused
from tests.rewalk import INF, WalkRay
from tests.rewalk import rays as with_hits
from wrt.accel.bvh.six import Bvh6
from wrt.accel.geometry import Geometry
from wrt.lab.bench.rays import terrain
from wrt.lab.claims import Claims as Plan
from wrt.lab.claims import scenes
from wrt.lab.claims.claim import CLAIMS, Figure, Study
from wrt.lab.claims.counted import helped, parents
from wrt.lab.claims.scenes import PATH, open_scene
from wrt.lab.claims.walks import Rays, Rules, Tree, build_tree, tree_of, walk
from wrt.scene.shapes import icosphere

RULES = [Rules(a, b) for a in (False, True) for b in (False, True)]
BALLS = Geometry(np.concatenate([(0.3 + 0.2 * k) * icosphere(2).vertices + [0.1 * k, 0.0, 0.0] for k in range(4)]).astype(np.float32),
                 np.concatenate([icosphere(2).faces + len(icosphere(2).vertices) * k for k in range(4)]).astype(np.int32),
                 np.zeros((0, 4), np.float32))


@cache
def some_rays(n: int = 96) -> Rays:
    rng = np.random.default_rng(3)
    origins = (1.5 * rng.normal(size=(n, 3))).astype(np.float32)
    directions = (0.4 * rng.normal(size=(n, 3)) - origins).astype(np.float32)
    return Rays(origins, directions, np.where(np.arange(n) % 5 == 0, 0.9, np.inf).astype(np.float32), (np.arange(n) % 3 == 0).astype(int),
                np.zeros(n, int), np.arange(n), np.arange(n) // 32)


@cache
def hits_of() -> list[dict[int, np.float32]]:
    """Return all hits of each ray, by brute force."""
    rays = some_rays()
    return [ray.hits for ray in with_hits(BALLS, rays.origins, rays.directions)]


def twin(tree: Tree, i: int, rules: Rules) -> tuple[list[int], list[int], int]:
    """Traverse with ray i in plain Python: references of the fetches, number of pushes after each, prim_id."""
    rays, wide, width = some_rays(), tree.wide, tree.width
    ray = WalkRay(rays.origins[i], rays.directions[i], np.float32(0.0), rays.t_max[i], hits_of()[i])
    fetches, entered = (list[int]() for _ in range(2))
    waiting = [(np.float32(0.0), 0)]
    while waiting:
        t, reference = waiting.pop()
        if fetches and rules.culled and t > ray.best[0]:
            continue
        fetches.append(reference)
        found = []
        if reference < 0:
            first, count = (-1 - reference) >> 6, (-1 - reference & 63) + 1
            for prim_id in wide.order[first : first + -(-count // width)].reshape(-1)[:count].tolist():
                if prim_id in ray.hits:
                    ray.best = min(ray.best, (ray.hits[prim_id], prim_id))
        else:
            found = [(t, int(child)) for child, lo, hi in zip(wide.children[reference], wide.lo[reference], wide.hi[reference], strict=True)
                     if child and (t := ray.enter(lo, hi)) < INF]
            if rules.ordered:
                found.sort(key=lambda each: (each[0], each[1] % (1 << 32)), reverse=True)
        waiting.extend(found)
        entered.append(len(found))
        if rays.kind[i] == 1 and ray.best[1] < 1 << 31:
            break
    return fetches, entered, ray.best[1] if ray.best[1] < 1 << 31 else -1


@pytest.mark.parametrize("rules", RULES, ids=str)
@pytest.mark.parametrize(("width", "max_leaf", "bits"), [(2, 1, 32), (6, 1, 8), (8, 5, 8)])
def test_a_walk_is_that_of_plain_python(width: int, max_leaf: int, bits: int, rules: Rules) -> None:
    tree = build_tree(BALLS, width, max_leaf, bits)
    log = walk(tree, some_rays(), rules)
    for i in range(len(some_rays())):
        fetches, entered, prim_id = twin(tree, i, rules)
        rows = slice(log.first[i], log.first[i + 1])
        assert log.fetch[rows].tolist() == fetches and log.entered[rows].tolist() == entered
        assert log.counts["prim_id"][i] == prim_id or (some_rays().kind[i] == 1 and prim_id >= 0)


def test_bvh6_counts_what_the_study_counts() -> None:
    accel, rays = Bvh6(BALLS), some_rays()
    counters = accel.closest_hit(rays.origins, rays.directions, 0.0, rays.t_max, counters=True).counters
    assert counters is not None
    rays = rays.part(np.arange(len(rays)))
    rays.kind[...] = 0
    counts = walk(tree_of(BALLS, accel.decoded()), rays, Rules()).counts
    assert np.array_equal(counts["inner"], counters.nodes) and np.array_equal(counts["leaves"], counters.leaves)


def test_lanes_that_help_take_the_oldest_entries() -> None:
    rays, tree = some_rays(), build_tree(BALLS, 6)
    log = walk(tree, rays, Rules(False, False))
    parent = parents(log)
    for fetch, of in enumerate(parent):
        assert log.fetch[fetch] in ([0] if of < 0 else tree.wide.children[log.fetch[of]])
    assert (np.bincount(parent[parent >= 0], minlength=len(parent)) <= log.entered).all()
    for warp, steps in enumerate(helped(log, rays.warp)):
        pool = deque(int(log.first[i]) for i in np.flatnonzero(rays.warp == warp))
        expected = 0
        while pool:
            expected += 1
            for fetch in [pool.popleft() for _ in range(min(32, len(pool)))]:
                pool.extend(np.flatnonzero(parent == fetch)[::-1].tolist())  # the entry pushed last is fetched first
        assert steps == expected


def test_planes_of_fewer_bits_give_larger_boxes_and_the_same_hits() -> None:
    finer, coarser = (build_tree(BALLS, 8, 4, bits).wide for bits in (32, 8))
    exists = finer.exists
    assert (coarser.lo[exists] <= finer.lo[exists]).all() and (coarser.hi[exists] >= finer.hi[exists]).all()
    assert (coarser.hi - coarser.lo)[exists].sum() > (finer.hi - finer.lo)[exists].sum()
    one, two = (walk(build_tree(BALLS, 8, 4, bits), some_rays(), Rules(False, False)).counts for bits in (32, 8))
    assert two["boxes"].sum() >= one["boxes"].sum() and np.array_equal(one["prim_id"], two["prim_id"])


@pytest.fixture
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(scenes.STAND_INS, "bunny", ("ball", lambda: icosphere(4)))
    monkeypatch.setitem(scenes.STAND_INS, "sponza", ("terrain", lambda: terrain(40)))


@pytest.mark.parametrize(("ours", "published", "unit", "ratio", "verdict"), [
    (2.0, 3.0, "nodes", 2.0 / 3.0, "agrees"), (2.0, 3.1, "nodes", 2.0 / 3.1, "differs"), (3.0, 2.0, "nodes", 1.5, "agrees"),
    (50.0, (30.0, 70.0), "%", 1.0, "agrees"), (80.0, (30.0, 50.0), "%", 1.6, "differs"), (1.1, 0.9, "ratio", 1.1 / 0.9, "differs"),
    (0.0, 0.0, "rays", 1.0, "agrees"), (1.0, 0.0, "rays", np.inf, "differs"), (-10.0, (50.0, 70.0), "%", -0.2, "differs")])
def test_a_number_agrees_within_the_factor_and_in_order(ours: float, published: float | tuple[float, float], unit: str, ratio: float,
                                                        verdict: str) -> None:
    figure = Figure("", ours, published, unit)
    assert figure.verdict == verdict and figure.ratio == pytest.approx(ratio)


@pytest.mark.parametrize("name", CLAIMS)
def test_every_claim_says_what_differs_and_why(name: str, small: None) -> None:
    claim = CLAIMS[name]
    figures = list(claim.measure(Study(side=16)))
    assert figures and claim.source and claim.setup and claim.sure in ("read", "quoted", "abstract")
    for figure in figures:
        assert np.isfinite(figure.ours) and figure.what and figure.differences
        assert figure.verdict == "agrees" or any(letter.isdigit() for letter in figure.reason)  # a measurement, not a guess


def test_the_command_takes_a_file_for_a_published_scene(tmp_path: Path, small: None) -> None:
    ball, path, report = icosphere(4), tmp_path / "sponza.obj", tmp_path / "report.md"
    path.write_text("\n".join([*("v " + " ".join(map(str, v)) for v in ball.vertices.tolist()),
                               *("f " + " ".join(map(str, f)) for f in (ball.faces + 1).tolist())]) + "\n")
    arguments = ["bench", "claims", "eight-bits", "--side", "16", "--scene", f"sponza={path}"]
    data = json.loads(wrt(*arguments, "-q", "--json", "-o", report).out)
    assert data["compared"] == 1 and data["rows"][0]["differences"].startswith(f"scene sponza: {len(ball.faces)} triangles, another")
    assert "- **eight-bits**: Grauer" in report.read_text() and " of 1 numbers agree" in report.read_text()
    assert json.loads(wrt(*arguments, "-q", "--json").out)["rows"] == data["rows"]  # nothing is timed
    assert wrt("bench", "claims", "nonsense").code == 2
    for wrong in ("bunny", "bunnny=a.ply"):
        with refused("scene"):
            Plan(scene=(wrong,))


def test_rays_of_paths_start_at_hits_and_stay_in_their_warps(small: None) -> None:
    scene = open_scene("bunny", None, 24)
    rays = scene.workloads[PATH]
    camera = (rays.depth == 0) & (rays.kind == 0)
    assert camera.sum() == 24 * 24 and (np.diff(rays.warp) >= 0).all() and np.bincount(rays.warp).max() <= 32
    hits = scene.accel.closest_hit(rays.origins[camera], rays.directions[camera])
    shadow = (rays.depth == 0) & (rays.kind == 1)
    assert set(rays.pixel[shadow]) == set(rays.pixel[camera][hits.prim_id >= 0])
    block = rays.pixel // 24 // 4 * 3 + rays.pixel % 24 // 8
    assert all(len(set(block[rays.warp == warp])) == 1 for warp in np.unique(rays.warp))
