"""The hard cases are what they say, the verdict sees planted faults, and the default accelerator passes."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from types import SimpleNamespace

import numpy as np
import pytest

from tests.refused import refused

from tests.kernel_tools import vec3s  # isort: skip (starts Warp)

from wrt.accel.geometry import Geometry
from wrt.accel.queries.accelerator import Accelerator
from wrt.accel.queries.answers import Hits
from wrt.accel.scenes.build import build
from wrt.core.errors import InputError
from wrt.lab.bench.contestants import Own
from wrt.lab.hard_cases.cases import HARD_CASES, HIT, MISS, UNKNOWN, HardCase, Verdict, chunks, generate, judge, judge_all_hits, judge_next
from wrt.lab.hard_cases.common import sphere
from wrt.lab.hard_cases.judge import winding_number
from wrt.lab.hard_cases.stability import respawn
from wrt.lab.oracle.oracle import Reference, reference_of
from wrt.scene.mesh import Mesh

REFUSED = ("I_rays_not_finite", "I_mesh_not_finite")


@cache
def structure(geometry: Geometry) -> Accelerator:
    return build(geometry, "bvh")


def trace(case: HardCase) -> Hits:
    return structure(case.geometry).closest_hit(case.origins, case.directions, case.t_min, case.t_max)


def rays_for(name: str) -> int:
    return 300 if name.startswith("G_fan") else 1500


# --- what the cases are -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", HARD_CASES)
def test_arrays_seeds_and_parts(name: str) -> None:
    case = generate(name, 50, seed=3)
    assert case.name == name and case.notes.startswith(name[0] + ":" if name[0] != "B" and name[0] != "C" else name[0])
    for array in (case.origins, case.directions):
        assert array.shape == (50, 3) and array.dtype == np.float32
    for array in (case.t_min, case.t_max):
        assert array.shape == (50,) and array.dtype == np.float32
    assert case.expected.dtype == np.int8 and set(case.expected) <= {HIT, UNKNOWN, MISS}
    assert case.directions.any(axis=1).all()
    assert case.refused == (name in REFUSED)
    again, other = generate(name, 50, seed=3), generate(name, 50, seed=4)
    np.testing.assert_array_equal(again.directions, case.directions)
    np.testing.assert_array_equal(again.geometry.vertices, case.geometry.vertices)
    assert not np.array_equal(other.origins, case.origins)
    parts = list(chunks(name, 50, seed=3, chunk=20))
    assert [len(part) for part in parts] == [20, 20, 10]
    assert not np.array_equal(parts[0].origins, parts[1].origins)


def test_an_unknown_name_is_refused() -> None:
    with refused(what="no hard case 'A_nowhere'", hint="A_origin_uniform"):
        generate("A_nowhere", 10)


@pytest.mark.parametrize("name", [
    *(name for name in HARD_CASES if name.endswith("_uniform")), "D_among_bad", "E_grid", "E_beside", "I_lengths",
    "I_underflow", "I_denormal", "I_rays_not_finite"])
def test_closed_surfaces_are_closed(name: str) -> None:
    case = generate(name, 30, seed=1)
    assert case.closed
    faces = case.geometry.faces
    faces = faces[np.isfinite(case.geometry.vertices[faces]).all(axis=(1, 2))]
    if name == "D_among_bad":
        faces = faces[: len(sphere(32, 16).faces)]  # the rest is without area, and on its own
    edges, count = np.unique(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=0, return_counts=True)
    back, count_back = np.unique(edges[:, ::-1], axis=0, return_index=True)
    np.testing.assert_array_equal(edges, back)
    np.testing.assert_array_equal(count, count[count_back])
    if case.name not in ("E_grid", "E_beside"):  # there, rays start outside too, or on a face
        usable = np.isfinite(case.origins).all(axis=1)
        winding = winding_number(case, case.origins[usable][:4].astype(np.float64))
        assert np.abs(winding - np.round(winding)).max() < 1e-6 and (np.round(winding) >= 1).all()


def test_theorems_agree_with_the_oracle() -> None:
    for name in HARD_CASES:
        case = generate(name, 4 if name.startswith("G_fan") else 60, seed=5)
        hits = reference_of(case.geometry).all_hits(case.origins, case.directions, case.t_min, case.t_max)
        has_hit = np.isin(np.arange(len(case)), hits.ray)
        assert has_hit[case.expected == HIT].all(), name
        assert not has_hit[case.expected == MISS].any(), name


# --- the default accelerator ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", [name for name in HARD_CASES if name not in REFUSED])
def test_the_default_accelerator_loses_and_invents_no_ray(name: str) -> None:
    case = generate(name, rays_for(name), seed=11)
    verdict = judge(case, trace(case), compared=3 if name == "G_fan_vertices" else len(case))
    assert verdict.ok, verdict.examples
    assert verdict.rays == len(case)
    assert verdict.hits > 0 or (case.expected == MISS).all()
    assert verdict.asked == verdict.hits or name == "G_fan_vertices"


@pytest.mark.parametrize("origin, direction", [
    ((148376.65625, 1234.4288330078125, -223422.0), (-0.953125, -1.1799107789993286, 0.828125)),
    ((148375.265625, 1234.5865478515625, -223423.984375), (0.984375, -1.3419189453125, -0.84375))])
def test_rays_between_the_halves_of_a_parted_edge(origin, direction) -> None:
    case = generate("A_far_edges", 1)
    case = replace(case, origins=np.array([origin], np.float32), directions=np.array([direction], np.float32))
    assert judge(case, trace(case)).misses == 0
    # Without the flips, neighbours of a face whose corners are on a line share an edge only in parts, and round apart.
    parted = replace(case, geometry=sphere(400, 200, 2.0, (148376.0, 1234.0, -223423.0)))
    assert judge(parted, trace(parted)).misses == 1


@pytest.mark.parametrize("name", REFUSED)
def test_what_is_not_finite_is_refused_by_the_host_and_missed_on_the_device(name: str) -> None:
    case = generate(name, 500, seed=1)
    with pytest.raises(InputError, match="finite"):
        trace(replace(case, geometry=Mesh(case.geometry.vertices, case.geometry.faces)))
    for accel in ("bvh", "brute_force"):
        hits = build(case.geometry, accel).closest_hit(vec3s(case.origins), vec3s(case.directions))
        verdict = judge(case, SimpleNamespace(**{name: getattr(hits, name).numpy() for name in ("t", "u", "v", "prim_id")}))
        assert verdict.ok and verdict.hits == (case.expected == HIT).sum() > 0, verdict.examples


@pytest.mark.parametrize("name", ["C_triangles", "C_spheres"])
def test_by_its_offset_alone_a_ray_does_not_hit_what_it_starts_on(name: str) -> None:
    elsewhere, own = 0, Own()
    for case in chunks(name, 10_000, seed=1, chunk=1000):
        own.prepare(case.geometry)
        first, again = respawn(own, case, exclude=False)
        verdict = judge_next(case, first, again)
        assert verdict.ok and verdict.rays == 0, verdict.examples
        elsewhere += int((again >= 0).sum())
    assert elsewhere > 100
    planted = judge_next(case, first, first)
    assert planted.self_hits == (first >= 0).sum() and not planted.ok


# --- the verdict sees what is wrong -----------------------------------------------------------------------------------


def changed(hits: Hits, **arrays: np.ndarray) -> Hits:
    return Hits(**{name: arrays.get(name, getattr(hits, name)).copy() for name in ("t", "u", "v", "prim_id")})


@cache
def ball(name: str = "H_scale_1_uniform") -> tuple[HardCase, Hits]:
    case = generate(name, 400, seed=7)
    return case, trace(case)


def test_a_lost_ray_is_a_miss() -> None:
    case, hits = ball()
    lost = np.arange(400) < 7
    said = changed(hits, prim_id=np.where(lost, -1, hits.prim_id), t=np.where(lost, np.inf, hits.t).astype(np.float32))
    verdict = judge(case, said)
    assert verdict.misses == 7 and not verdict.ok and verdict.examples[0]["row"] == 0
    # The same without the theorem: the oracle finds it.
    verdict = judge(replace(case, expected=np.zeros(400, np.int8)), said)
    assert verdict.misses + verdict.borderline_misses == 7 and verdict.misses >= 6


def test_a_vertex_that_lets_a_ray_out_is_a_miss_though_every_triangle_there_is_borderline() -> None:
    case, hits = ball("H_scale_1_vertices")
    case = replace(case, expected=np.zeros(400, np.int8))
    said = changed(hits, prim_id=np.full(400, -1, np.int32), t=np.full(400, np.inf, np.float32))
    assert judge(case, said).misses == 400
    assert judge(replace(case, closed=False), said).borderline_misses == 400


@pytest.mark.parametrize("change", [
    {"t_max": np.float32(0.01)}, {"t_min": np.float32(50.0)}, {"t": np.float32(np.nan)}, {"t": np.float32(np.inf)},
    {"prim_id": np.int32(1 << 30)}])
def test_hits_outside_of_the_segment_or_of_nothing_are_false(change: dict) -> None:
    case, hits = ball()
    case = replace(case, **{key: np.full(400, value) for key, value in change.items() if key in ("t_min", "t_max")})
    said = changed(hits, **{key: np.full(400, value) for key, value in change.items() if key in ("t", "prim_id")})
    assert judge(case, said).false_hits == 400


def test_another_triangle_is_a_false_hit_and_expected_misses_may_not_hit() -> None:
    case, hits = ball()
    said = changed(hits, prim_id=np.where(np.arange(400) < 9, (hits.prim_id + 1000) % len(case.geometry.faces), hits.prim_id))
    assert judge(case, said).false_hits == 9
    assert judge(replace(case, expected=np.full(400, MISS, np.int8)), hits).false_hits == 400


def test_errors_above_the_bound_are_counted() -> None:
    case, hits = ball()
    reference = reference_of(case.geometry)
    exact, bound = reference.against(case.origins, case.directions, hits.prim_id)
    assert judge(case, hits).t.largest_ratio < 1.0
    row = np.arange(400) < 5
    said = changed(hits, t=np.where(row, exact.t + 1.5 * bound.t, hits.t).astype(np.float32),
                   u=np.where(row, exact.u - 2.0 * bound.u, hits.u).astype(np.float32),
                   v=np.where(row, np.nan, hits.v).astype(np.float32))
    verdict = judge(case, said)
    assert (verdict.t.over, verdict.u.over, verdict.v.over) == (5, 5, 5) and not verdict.ok
    assert 1.2 < verdict.t.largest_ratio < 1.8 and np.isinf(verdict.v.largest_ratio)


@pytest.mark.parametrize("aim", ["uniform", "vertices"])
def test_a_hit_behind_a_nearer_one_is_wrong(aim: str) -> None:
    """Also at vertices, where every triangle is borderline: a closed surface lets no ray through."""
    case = generate(f"G_sheets_{aim}", 200, seed=7)
    half = len(case.geometry.faces) // 2
    outer = Geometry(case.geometry.vertices, case.geometry.faces[half:], case.geometry.spheres)
    said = build(outer, "bvh").closest_hit(case.origins, case.directions)
    said = changed(said, prim_id=said.prim_id + half)
    verdict = judge(case, said)
    assert verdict.wrong_prim == 200 and verdict.false_hits == 0
    assert aim == "uniform" or judge(replace(case, closed=False), said).wrong_prim < 100


def test_of_triangles_that_are_the_same_the_lowest_must_be_told() -> None:
    case = generate("G_coincident_uniform", 300, seed=7)
    hits = trace(case)
    assert judge(case, hits).ties == 300
    corners = np.sort(case.geometry.faces, axis=1)
    last = np.array([np.flatnonzero((corners == corners[p]).all(axis=1))[-1] for p in hits.prim_id], np.int32)
    assert judge(case, changed(hits, prim_id=last)).wrong_prim == 300


def test_verdicts_of_parts_add_up() -> None:
    case, hits = ball()
    lost = changed(hits, prim_id=np.where(np.arange(400) % 10 == 0, -1, hits.prim_id).astype(np.int32))
    parts = Verdict()
    for rows in (slice(0, 150), slice(150, 400)):
        part = replace(case, **{name: getattr(case, name)[rows]
                                for name in ("origins", "directions", "t_min", "t_max", "expected")})
        parts += judge(part, Hits(**{name: getattr(lost, name)[rows] for name in ("t", "u", "v", "prim_id")}))
    whole, parts_dict = judge(case, lost).as_dict(), parts.as_dict()
    assert len(whole.pop("examples")) == len(parts_dict.pop("examples")) == 8
    assert whole == parts_dict and whole["misses"] == 40


def test_percentiles_of_errors() -> None:
    case, hits = ball()
    exact, _ = reference_of(case.geometry).against(case.origins, case.directions, hits.prim_id)
    ulp = np.abs(hits.t - exact.t) / np.spacing(exact.t.astype(np.float32))
    errors = judge(case, hits).t
    assert errors.largest == pytest.approx(ulp.max()) and np.isnan(Verdict().t.p999)
    assert errors.p999 == pytest.approx(np.percentile(ulp, 99.9, method="inverted_cdf"))


def test_the_verdict_on_all_hits() -> None:
    case, _ = ball()
    hits = Reference(case.geometry).all_hits(case.origins, case.directions)
    ray, prim_id, t = hits.ray, hits.prim_id, hits.t.astype(np.float32)
    assert judge_all_hits(case, ray, prim_id, t).ok
    twice = judge_all_hits(case, np.append(ray, ray[:3]), np.append(prim_id, prim_id[:3]), np.append(t, t[:3]))
    assert twice.duplicate_hits == 3
    lost = judge_all_hits(case, ray[5:], prim_id[5:], t[5:])
    assert 4 <= lost.misses <= 5 and lost.duplicate_hits == 0
    wrong = judge_all_hits(case, ray, np.where(np.arange(len(ray)) < 4, prim_id ^ 64, prim_id), t)
    assert wrong.false_hits == 4
    # Two triangles of a mesh on both sides of an edge, one crossing: exactly at a vertex each of them reports it.
    corner = generate("A_far_vertices", 5, seed=1)
    exact = reference_of(corner.geometry).all_hits(corner.origins, corner.directions)
    told = judge_all_hits(corner, exact.ray, exact.prim_id, exact.t.astype(np.float32))
    assert told.duplicate_hits >= 5 and told.misses == told.false_hits == 0
