"""All hits of a ray: the same hits as a test of every primitive, in order, without loss or repetition."""

from __future__ import annotations

import tracemalloc
from typing import Any

import numpy as np
import pytest
import warp as wp

import wrt
from tests.data import data_path
from tests.kernel_tools import floats, launch, vec3s, zeros
from tests.kernels.every_hit import HitList, make_all_hits_kernel
from tests.refused import Refusal, refused
from tests.structures import families_first
from tests.wrt.accel.test_structures_agree import mixed_rays
from wrt.accel.geometry import Geometry
from wrt.accel.queries.lists import BATCH
from wrt.accel.scenes.build import build
from wrt.kernels.query import RayArrays
from wrt.kernels.traverse.common import Units
from wrt.lab.hard_cases.cases import HARD_CASES, UNKNOWN, HardCase, generate, judge_all_hits
from wrt.lab.hard_cases.common import hard_case
from wrt.scene import shapes

CAPACITY = 64


def soup(rng: np.random.Generator) -> wrt.Mesh:
    """Return 200 triangles, and 20 of them another four times."""
    corners = rng.uniform(-1.0, 1.0, (200, 1, 3)) + 0.4 * rng.normal(size=(200, 3, 3))
    corners = np.concatenate([corners, np.repeat(corners[:20], 4, axis=0)])[rng.permutation(280)]
    return wrt.Mesh(corners.reshape(-1, 3), np.arange(840).reshape(-1, 3))


def rays(rng: np.random.Generator, mesh: wrt.Mesh, n: int) -> tuple[Any, ...]:
    """Return rays from outside and inside: a third towards corners, a third towards edges; directions of lengths 1e-30 to 1e30."""
    a, b, c = (mesh.vertices[mesh.faces[rng.integers(0, len(mesh.faces), n), i]].astype(np.float64) for i in range(3))
    kind = rng.integers(0, 3, (n, 1))
    target = np.where(kind == 0, a, np.where(kind == 1, a + rng.random((n, 1)) * (b - a), (a + b + c) / 3.0))
    origin = np.float32(rng.normal(size=(n, 3)) * rng.choice([0.3, 3.0], (n, 1)))
    length = rng.choice([1.0, 1e-30, 1e30], n, p=[0.8, 0.1, 0.1])
    direction = np.float32((target - origin) * length[:, None])
    t_min = np.where(rng.random(n) < 0.5, 0.0, 0.7) / length
    return origin, direction, np.float32(t_min), np.float32(np.where(rng.random(n) < 0.5, np.inf, 1.5 / length))


def one_by_one(mesh: wrt.Mesh, asked: tuple[Any, ...]) -> list[list[tuple[float, int]]]:
    """Return the sorted (t, prim_id) of each ray's hits, from a test of every primitive without a structure."""
    accel = wrt.build(mesh, "brute_force")
    n = len(asked[0])
    arrays, found = RayArrays(), HitList()
    arrays.origin, arrays.direction, arrays.t_min, arrays.t_max = (
        vec3s(asked[0]), vec3s(asked[1]), floats(asked[2]), floats(asked[3]))
    found.capacity, found.count = CAPACITY, zeros(n, wp.int32)
    found.prim_id, found.t = zeros(n * CAPACITY, wp.int32), zeros(n * CAPACITY)
    launch(make_all_hits_kernel(Units()), n, accel.data.primitives, accel.snapshot.surfaces, arrays, found, 0)
    counts, prim_id, t = (array.numpy() for array in (found.count, found.prim_id, found.t))
    assert counts.max() <= CAPACITY
    rows = [slice(i * CAPACITY, i * CAPACITY + counts[i]) for i in range(n)]
    return [sorted(zip(t[row].tolist(), prim_id[row].tolist(), strict=True)) for row in rows]


@pytest.mark.parametrize("name", families_first())
def test_the_first_hits_are_those_of_testing_all(name: str) -> None:
    rng = np.random.default_rng(0)
    mesh = soup(rng)
    asked = rays(rng, mesh, 3000)
    expected = one_by_one(mesh, asked)
    accel = wrt.build(mesh, name)
    hits = wrt.first_hits(accel, 40, *asked)
    assert 30 < max(map(len, expected)) + 15 and sum(map(len, expected)) > 10_000
    for i, row in enumerate(expected):
        n = min(len(row), 40)
        assert list(zip(hits.t[i, :n].tolist(), hits.prim_id[i, :n].tolist(), strict=True)) == row[:n], i
        assert (hits.prim_id[i, n:] == -1).all() and np.isinf(hits.t[i, n:]).all()
    closest = accel.closest_hit(*asked)
    for field in ("t", "u", "v", "prim_id"):
        assert np.array_equal(getattr(hits, field)[:, 0], getattr(closest, field))


@pytest.mark.parametrize("name", families_first())
def test_the_first_hits_are_those_of_all_however_few_are_asked_for(name: str) -> None:
    rng = np.random.default_rng(4)
    triangle = np.float32([[-1.0, -1.0, 0.0], [2.0, -1.0, 0.0], [-1.0, 2.0, 0.0]])
    heights = np.repeat(rng.permutation(30), rng.integers(1, 12, 30))[:, None]  # sheets, up to 11 of them in one place
    corners = np.repeat(triangle[None], len(heights), axis=0) + heights[:, :, None] * np.float32([0.0, 0.0, 1.0])
    accel = wrt.build(wrt.Mesh(corners.reshape(-1, 3), np.arange(3 * len(corners)).reshape(-1, 3)), name)
    origins = np.concatenate([rng.uniform(-0.5, 0.3, (20, 2)), rng.choice([-1.0, 7.5, 40.0], (20, 1))], axis=1)
    directions = np.where(origins[:, 2:] < 8.0, 1.0, -1.0) * [0.001, 0.002, 1.0]
    whole = wrt.all_hits(accel, origins, directions)
    assert whole.counts.max() > 100
    for k in (1, 2, 3, 7, 8, 9, 30, 63, 64, 65, 500):
        first = wrt.first_hits(accel, k, origins, directions)
        for i in range(20):
            row = slice(whole.first[i], min(whole.first[i + 1], whole.first[i] + k))
            n = row.stop - row.start
            for field in ("t", "u", "v", "prim_id"):
                assert np.array_equal(getattr(first, field)[i, :n], getattr(whole, field)[row]), (k, i, field)
            assert (first.prim_id[i, n:] == -1).all() and np.isinf(first.t[i, n:]).all()


def test_thousands_of_hits_in_one_place() -> None:
    n = 20_000  # one traversal per hit would take minutes for one ray
    corners = np.repeat(np.float32([[[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]]), n, axis=0)
    accel = wrt.build(wrt.Mesh(corners.reshape(-1, 3), np.arange(3 * n).reshape(-1, 3)))
    asked = np.full((100, 3), [0.25, 0.25, 1.0]), np.full((100, 3), [0.0, 0.0, -2.0])
    found = wrt.all_hits(accel, *asked)
    assert np.array_equal(found.prim_id, np.tile(np.arange(n), 100)) and (found.t == 0.5).all()
    assert (wrt.count_hits(accel, *asked) == n).all() and (wrt.count_hits(accel, *asked, crossings=True) == n).all()
    for k in (1, 100, 9000):
        assert np.array_equal(wrt.first_hits(accel, k, *asked).prim_id, np.tile(np.arange(k), (100, 1)))


@pytest.mark.parametrize("mesh", [shapes.torus(1.0, 0.4, 32, 16), soup(np.random.default_rng(6))], ids=["torus", "soup"])
@pytest.mark.parametrize("places", [0, 3], ids=["mesh", "instances"])
@pytest.mark.parametrize("crossings", [False, True])
def test_few_rays_hit_what_they_hit_among_many(mesh: wrt.Mesh, places: int, crossings: bool) -> None:
    """Rays use buffers of earlier calls; rays of the soup can have more hits than these hold."""
    matrices = [np.diag([scale, scale, scale, 1.0]) for scale in 1.0 / (1.0 + np.arange(places))]
    scene = wrt.Scene([wrt.Object(mesh, (wrt.Material(),), matrix) for matrix in matrices])
    accel = wrt.build(scene, movable=True) if places else wrt.build(mesh)
    asked = rays(np.random.default_rng(7), mesh, BATCH + 1)
    among = wrt.all_hits(accel, *asked, crossings=crossings)
    begin = 0
    for n in (1, 0, 3, 550, 585, BATCH):  # 550 and 585 rays have lists of equal length
        begin = min(begin, BATCH + 1 - n)
        few = wrt.all_hits(accel, *(array[begin:begin + n] for array in asked), crossings=crossings)
        rows = slice(among.first[begin], among.first[begin + n])
        assert np.array_equal(few.first, among.first[begin:begin + n + 1] - rows.start)
        for field in ("t", "u", "v", "prim_id"):
            assert np.array_equal(getattr(few, field), getattr(among, field)[rows])
        begin += n


def test_all_hits_are_the_first_ones_without_the_misses() -> None:
    rng = np.random.default_rng(1)
    mesh = soup(rng)
    asked = rays(rng, mesh, 2000)
    accel = wrt.build(mesh)
    found, first = wrt.all_hits(accel, *asked, threads=2), wrt.first_hits(accel, CAPACITY, *asked, threads=1)
    there = first.prim_id >= 0
    assert np.array_equal(found.counts, there.sum(axis=1)) and np.array_equal(found.ray_id, np.nonzero(there)[0])
    for field in ("t", "u", "v", "prim_id"):
        assert np.array_equal(getattr(found, field), getattr(first, field)[there])
    assert np.array_equal(wrt.count_hits(accel, *asked), found.counts) and len(found) == 2000
    assert wrt.count_hits(accel, *asked).dtype == found.counts.dtype == found.ray_id.dtype == np.int64
    assert repr(found) == f"AllHits(2000 rays, {len(found.t)} hits)"


def at_edges(mesh: wrt.Mesh, n: int, rng: np.random.Generator) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Return rays from outside to outside: through corners, through edges, both along the axes, and along edges."""
    low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
    middle, size = (low + high) / 2, np.linalg.norm(high - low)
    corners = mesh.vertices[mesh.faces[rng.integers(len(mesh.faces), size=n)]]
    begin, end = corners[:, 0], corners[:, 1]
    away = rng.normal(size=(n, 3))
    away = (middle + 1.5 * size * away / np.linalg.norm(away, axis=1, keepdims=True)).astype(np.float32)
    halfway = (begin + rng.random((n, 1)) * (end - begin)).astype(np.float32)
    axis = np.eye(3, dtype=np.float32)[np.arange(n) % 3] * rng.choice([-1.0, 1.0], (n, 1)).astype(np.float32)
    along = end - begin
    along /= np.linalg.norm(along, axis=1, keepdims=True)

    def aside(point: np.ndarray) -> np.ndarray:
        return np.where(axis != 0.0, middle - 2.0 * size * axis, point)

    return {"corners": (away, begin - away), "edges": (away, halfway - away), "corners, axes": (aside(begin), axis),
            "edges, axes": (aside((begin + end) / 2), axis), "along edges": (begin - 2.0 * size * along, along)}


def check_even(mesh: wrt.Mesh, n: int) -> None:
    accel = wrt.build(mesh)
    for name, asked in at_edges(mesh, n, np.random.default_rng(2)).items():
        counts = wrt.count_hits(accel, *asked, crossings=True)
        assert (counts % 2 == 0).all(), name
        assert 0.5 < counts.mean() < 10.0, name
        met = (counts < wrt.count_hits(accel, *asked)).mean()
        assert met > 0.1 or name == "edges", name  # rounding to float32 moves a ray beside most edges


CLOSED = [shapes.box(), shapes.icosphere(3), shapes.torus(1.0, 0.4, 64, 32), shapes.teapot(8),
          shapes.merged([shapes.icosphere(2), shapes.icosphere(2, 0.5), shapes.box((0.5, -0.5, -0.5), (1.5, 0.5, 0.5))], "parts")]


@pytest.mark.parametrize("mesh", CLOSED, ids=lambda mesh: mesh.name)
def test_a_closed_surface_is_crossed_an_even_number_of_times_from_outside(mesh: wrt.Mesh) -> None:
    check_even(mesh, 2000)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["meshes/small/cow.obj", "odd/capsule.obj", "meshes/medium/rocker-arm.obj",
                                  "meshes/medium/armadillo_86k.obj", "meshes/large/dragon_871k.ply"])
def test_real_closed_surfaces_are_crossed_an_even_number_of_times(name: str) -> None:
    check_even(wrt.load_mesh(data_path(name)), 200_000)


def test_a_floor_is_crossed_once_wherever() -> None:
    # 8 x 8 squares of 2 triangles each; rays at all corners, edges and diagonals, upwards and downwards.
    lattice = np.stack(np.meshgrid(*[np.arange(9.0)] * 2, [0.0]), axis=-1).reshape(-1, 3)
    at = np.arange(81).reshape(9, 9)
    corners = [part.reshape(-1) for part in (at[:-1, :-1], at[:-1, 1:], at[1:, 1:], at[1:, :-1])]
    faces = np.concatenate([np.stack([corners[i] for i in three], axis=1) for three in ((0, 1, 2), (0, 3, 2))])  # both windings
    floor = wrt.build(wrt.Mesh(lattice, faces))
    points = np.stack(np.meshgrid(*[np.arange(0.25, 8.0, 0.25)] * 2, [0.0]), axis=-1).reshape(-1, 3)
    for way in ([0.0, 0.0, 1.0], [0.0, 0.0, -1.0], [0.25, 0.5, 1.0]):
        asked = points - way, np.broadcast_to(np.float32(way), points.shape)
        assert (wrt.count_hits(floor, *asked, crossings=True) == 1).all()
        found, first = wrt.all_hits(floor, *asked, crossings=True), wrt.first_hits(floor, 2, *asked, crossings=True)
        assert np.array_equal(found.prim_id, first.prim_id[:, 0]) and (first.prim_id[:, 1] == -1).all() and (found.t == 1.0).all()
        assert wrt.count_hits(floor, *asked).max() == 6


def test_no_rays_and_no_triangles() -> None:
    empty = np.zeros((0, 3), np.float32)
    accel = wrt.build(shapes.icosphere(1))
    assert len(wrt.all_hits(accel, empty, empty)) == 0 and wrt.first_hits(accel, 3, empty, empty).t.shape == (0, 3)
    nothing = wrt.build(wrt.Mesh(empty, np.zeros((0, 3), np.int32)))
    assert wrt.count_hits(nothing, [[0.0, 0.0, 0.0]], [[0.0, 0.0, 1.0]]).tolist() == [0]


@pytest.mark.parametrize("call, said", [
    (lambda accel, o: wrt.all_hits("bvh", o, o), ("accel", "structure")),  # type: ignore[arg-type]
    (lambda accel, o: wrt.first_hits(accel, 0, o, o), ("k", "1 to 2147483647")),
    (lambda accel, o: wrt.first_hits(accel, 2**60, o, o), ("k", "1 to 2147483647")),
    (lambda accel, o: wrt.first_hits(accel, 2**31 - 1, np.ones((9, 3)), np.ones((9, 3))), (None, "hits do not fit")),
    (lambda accel, o: wrt.first_hits(accel, 1.5, o, o), ("k", "whole number")),  # type: ignore[arg-type]
    (lambda accel, o: wrt.all_hits(accel, o, o * np.nan), ("directions", "finite")),
    (lambda accel, o: wrt.count_hits(accel, np.ones((3, 3)), np.ones((2, 3))), ("directions", "broadcasts")),
    (lambda accel, o: wrt.count_hits(accel, o, o, t_min=-1.0), ("t_min", "NaN or below 0")),
])
def test_what_is_refused(call: Any, said: Refusal) -> None:
    with refused(*said):
        call(wrt.build(shapes.icosphere(1)), np.ones((2, 3), np.float32))


@pytest.mark.slow
@pytest.mark.parametrize("name", ["meshes/small/suzanne.obj", "meshes/small/cow.obj", "meshes/small/teapot.obj",
                                  "meshes/small/legocar.obj", "odd/capsule.obj", "odd/ADIS16480.STL",
                                  "meshes/medium/rocker-arm.obj", "meshes/medium/stanford_bunny.ply",
                                  "meshes/medium/armadillo_86k.obj", "meshes/medium/sponza_dabrovic.obj"])
def test_on_real_meshes_the_oracle_finds_the_same(name: str) -> None:
    mesh = wrt.load_mesh(data_path(name))
    for seed in range(10):
        judged(hard_case(Geometry.of(mesh), *mixed_rays(mesh, 10_000, seed), UNKNOWN))


@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name in HARD_CASES if "not_finite" not in name])
def test_on_hard_cases_the_oracle_finds_the_same(name: str) -> None:
    case = generate(name, 20 if name == "G_fan_vertices" else 1000, seed=5)  # 20,000 triangles share its vertex
    if len(getattr(case.geometry, "spheres", ())):
        pytest.skip("all_hits asks structures over one mesh, without spheres")
    judged(case)


def judged(case: HardCase) -> None:
    """Check by the oracle: no hit is lost, invented or repeated, and all hits are in order."""
    geometry = case.geometry if isinstance(case.geometry, Geometry) else Geometry.of(case.geometry)
    found = wrt.all_hits(build(geometry), case.origins, case.directions, case.t_min, case.t_max)
    verdict = judge_all_hits(case, found.ray_id, found.prim_id, found.t)
    twice = len(found.t) - len(np.unique(np.stack([found.ray_id, found.prim_id]), axis=1).T)
    assert (verdict.misses, verdict.false_hits, twice) == (0, 0, 0), verdict.examples
    same = np.diff(found.ray_id) == 0
    later = (found.t[1:] > found.t[:-1]) | ((found.t[1:] == found.t[:-1]) & (found.prim_id[1:] > found.prim_id[:-1]))
    assert later[same].all()


@pytest.mark.parametrize("query, accel", [(wrt.all_hits, "bvh"), (wrt.count_hits, "grid")])  # cells of a grid share triangles
def test_long_lists_give_their_memory_back(query: Any, accel: str) -> None:
    walls = wrt.build(shapes.merged([shapes.quad((-1, -1, z), (2, 0, 0), (0, 2, 0)) for z in range(200)], "walls"), accel)
    origins = np.random.default_rng(1).uniform(-0.9, 0.9, (2000, 3)) * (1, 1, 0) - (0, 0, 1)
    for some in (origins, origins[:1]):  # these make the kernels and buffers that stay
        query(walls, some, (0.0, 0.0, 1.0))
    tracemalloc.start()
    try:
        found = query(walls, origins, (0.0, 0.0, 1.0))
        assert (len(found.t) if accel == "bvh" else found.sum()) >= 200 * len(origins)
        del found
        assert tracemalloc.get_traced_memory()[0] < 1e6
    finally:
        tracemalloc.stop()
