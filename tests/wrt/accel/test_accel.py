"""Properties of every acceleration structure in the registry."""

from __future__ import annotations

from fractions import Fraction
from typing import Any

import numpy as np
import pytest

from tests.refused import Refusal, refused

from tests.kernel_tools import DEVICE, launch, rounded, vec3s, zeros  # isort: skip (starts Warp)
import warp as wp

import wrt
from tests.kernels.units.test_box import pad_kernel
from wrt.accel.geometry import Geometry
from wrt.accel.queries.batches import RAYS_PER_LAUNCH
from wrt.accel.scenes.build import build
from wrt.accel.structures import ACCELERATORS
from wrt.core.device import records
from wrt.kernels.structs import Primitive
from wrt.kernels.traverse.common import Units
from wrt.scene.shapes import icosphere, torus

NAMES = sorted({cls.name for cls in ACCELERATORS.values()})
BALL = icosphere(2)


def some_rays(n: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    origin = rounded(3.0 * rng.normal(size=(n, 3)))
    return origin, rounded(rng.normal(size=(n, 3)) * 0.5 - origin)


def test_the_registry_names_what_it_holds() -> None:
    assert ACCELERATORS["bvh"] is ACCELERATORS["bvh8"]  # the default
    for name in NAMES:
        assert ACCELERATORS[name].name == name
        assert type(build(BALL, name)) is ACCELERATORS[name]
    assert wrt.ACCELERATORS is ACCELERATORS


def test_unknown_names_and_devices_are_refused() -> None:
    with refused("accel", "no structure 'quadtree'"):
        build(BALL, "quadtree")
    with refused("device", "no device 'tpu'"):
        build(BALL, device="tpu")
    with refused("max_leaf", "option of brute_force"):
        build(BALL, "brute_force", max_leaf=3)
    with refused("bulder", "option of bvh8", hint="'builder'"):
        build(BALL, bulder="sah")
    with refused("threads"):
        build(BALL, threads=0)


@pytest.mark.parametrize("name", NAMES)
def test_a_class_says_whether_it_follows_vertices(name: str) -> None:
    accel, moved = build(BALL, name), 2.0 * BALL.vertices
    if accel.can_refit:
        accel.refit(moved)
        assert np.array_equal(accel.geometry.vertices, moved)
    else:
        with refused(what="cannot be refitted"):
            accel.refit(moved)


@pytest.mark.parametrize("name", NAMES)
def test_hits_of_a_ball_seen_from_its_center(name: str) -> None:
    rng = np.random.default_rng(1)
    direction = rounded(rng.normal(size=(2000, 3)))
    hits = build(BALL, name).closest_hit(np.zeros((2000, 3)), direction)
    assert hits.t.dtype == np.float32 and hits.prim_id.dtype == np.int32 and hits.u.shape == hits.v.shape == (2000,)
    distance = hits.t * np.linalg.norm(direction, axis=1)  # t is in units of |direction|
    assert (distance > 0.95).all() and (distance <= 1.0 + 1e-6).all()
    corner = BALL.vertices[BALL.faces[hits.prim_id]].astype(np.float64)
    w = np.stack([1.0 - hits.u.astype(np.float64) - hits.v, hits.u, hits.v], axis=1)
    assert np.abs(np.einsum("ni,nij->nj", w, corner) - hits.t[:, None] * direction).max() < 1e-6
    assert w.min() > -1e-6
    assert len(hits) == 2000 and "2000" in repr(hits)


@pytest.mark.parametrize("name", NAMES)
def test_a_miss_is_a_state(name: str) -> None:
    structure = build(BALL, name)
    hits = structure.closest_hit([[5.0, 5.0, 5.0]], [[1.0, 0.0, 0.0]])
    assert np.isinf(hits.t[0]) and hits.prim_id[0] == -1 and hits.u[0] == hits.v[0] == 0.0
    assert not structure.any_hit([[5.0, 5.0, 5.0]], [[1.0, 0.0, 0.0]])[0]


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("n", [0, 1, RAYS_PER_LAUNCH - 1, RAYS_PER_LAUNCH, 2 * RAYS_PER_LAUNCH + 3])
def test_any_number_of_rays_on_any_number_of_threads(n: int, name: str) -> None:
    structure = build(icosphere(0), name)
    origin, direction = some_rays(n)
    one, two = (structure.closest_hit(origin, direction, threads=threads) for threads in (1, 2))
    for field in ("t", "u", "v", "prim_id"):
        assert np.array_equal(getattr(one, field), getattr(two, field)) and len(getattr(one, field)) == n
    dark = structure.any_hit(origin, direction, threads=2)
    assert dark.dtype == np.bool_ and np.array_equal(dark, one.prim_id >= 0)


@pytest.mark.parametrize("name", NAMES)
def test_segments_as_scalars_and_arrays(name: str) -> None:
    structure = build(BALL, name)
    origin, direction = some_rays(500)
    everything = structure.closest_hit(origin, direction)
    ends = np.full(500, 0.5)
    assert np.array_equal(structure.closest_hit(origin, direction, 0.1, 0.5).t,
                          structure.closest_hit(origin, direction, np.full(500, 0.1), ends).t)
    assert np.array_equal(structure.any_hit(origin, direction, t_max=ends), everything.t <= 0.5)
    assert not structure.any_hit(origin, direction, 2.0, 1.0).any()  # an empty segment
    assert not structure.any_hit(origin, direction, 0.0, -1.0).any()


@pytest.mark.parametrize("name", NAMES)
def test_warp_arrays_come_back_as_warp_arrays(name: str) -> None:
    structure = build(BALL, name)
    origin, direction = some_rays(300)
    expected = structure.closest_hit(origin, direction)
    hits = structure.closest_hit(vec3s(origin), vec3s(direction))
    assert all(isinstance(array, wp.array) for array in (hits.t, hits.u, hits.v, hits.prim_id))
    assert np.array_equal(hits.t.numpy(), expected.t) and np.array_equal(hits.prim_id.numpy(), expected.prim_id)
    ends = wp.array(np.full(300, 0.5, np.float32), dtype=wp.float32, device=DEVICE)
    dark = structure.any_hit(vec3s(origin), vec3s(direction), t_max=ends)
    assert isinstance(dark, wp.array) and np.array_equal(dark.numpy(), expected.t <= 0.5)


@pytest.mark.parametrize(("arguments", "message"), [
    (([[0, 0]], [[1, 0, 0]]), ("origins", "(..., 3)")),
    ((0.0, [[1, 0, 0]]), ("origins", "(..., 3)")),
    (([[0, 0, 0]] * 3, [[1, 0, 0], [0, 1, 0]]), ("directions", "broadcasts")),
    (([[0, 0, 0]], [[0, 0, 0]]), ("directions", "row 0")),
    (([[0, np.nan, 0]], [[1, 0, 0]]), ("origins", "row 0")),
    (([[0, 0, 0]], [[1, np.inf, 0]]), ("directions", "finite")),
    (([["a", "b", "c"]], [[1, 0, 0]]), ("origins",)),
    (([[0, 0, 0]], [[1, 0, 0]], -1.0), ("t_min", "NaN or below 0")),
    (([[0, 0, 0]], [[1, 0, 0]], [0.0, 0.0]), ("t_min", "number or (1,)")),
    (([[0, 0, 0]], [[1, 0, 0]], "near"), ("t_min",)),
    (([[0, 0, 0], [1e38, 0, 0]], [[1, 0, 0]] * 2), ("origins", "row 1")),
    (([[0, 0, 10**400]], [[1, 0, 0]]), ("origins", "(..., 3)")),
    ((np.zeros((1, 3), complex), [[1, 0, 0]]), ("origins", "(..., 3)")),
    ((np.zeros((1, 3), bool), [[1, 0, 0]]), ("origins", "(..., 3)")),
    ((np.zeros((1, 3), "datetime64[s]"), [[1, 0, 0]]), ("origins", "(..., 3)")),
    ((np.ma.zeros((1, 3)), [[1, 0, 0]]), ("origins", "masked array")),
    (([[0, 0, 0]], [[1, 0, 0]], True), ("t_min", "number or (1,)")),
    (([[0, 0, 0]], [[1, 0, 0]], 0.0, None), ("t_max",)),
    (([[0, 0, 0]], [[1, 0, 0]], 0.0, 1.0, 1.5), ("threads", "whole number")),
    ((np.zeros((0, 3)), np.zeros((0, 3)), 0.0, 1.0, 1.5), ("threads", "whole number")),
])
@pytest.mark.filterwarnings("error")  # one message, and no other
def test_bad_arguments_are_named(arguments: tuple, message: Refusal) -> None:
    structure = build(BALL, "brute_force")
    for query in (structure.closest_hit, structure.any_hit):
        with refused(*message):
            query(*arguments)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("convert", [
    lambda a: a.astype(np.float64), lambda a: a.astype(np.float16), lambda a: a.astype(np.int64), lambda a: a.astype(">f4"),
    lambda a: a.astype(">i2"), lambda a: a.astype(np.longdouble), lambda a: a.astype(np.uint8), lambda a: a.astype(object),
    lambda a: a.tolist(), lambda a: tuple(map(tuple, a)), np.asfortranarray, lambda a: np.repeat(a, 2, axis=0)[::2],
    lambda a: [[Fraction(int(x)) for x in row] for row in a],
], ids=range(13))
def test_real_numbers_of_any_kind_are_taken(convert: Any) -> None:
    structure = build(BALL, "brute_force")
    origins, directions = np.float32([[3, 2, 1], [0, 0, 0], [3, 0, 5]]), np.float32([[3, 2, 1], [1, 0, 0], [0, 1, 0]])
    expected = structure.closest_hit(origins, directions, 0, 2)
    found = structure.closest_hit(convert(origins), convert(directions), np.int8(0), Fraction(2), np.int64(1))
    for field in ("t", "u", "v", "prim_id"):
        assert np.array_equal(getattr(found, field), getattr(expected, field))
    assert expected.prim_id.tolist()[0] == expected.prim_id.tolist()[2] == -1 < expected.prim_id[1]


def test_origins_may_be_as_far_as_1e37_and_directions_of_any_length() -> None:
    structure = build(BALL, "brute_force")
    hits = structure.closest_hit([[1e37, 0, 0], [-1e37, 1e37, 0], [0, 0, 0]], [[-1e37, 0, 0], [1, 0, 0], [0, 3.4e38, 0]])
    assert hits.t[0] == 1.0 and hits.prim_id[1] == -1 and 0.0 < hits.t[2] < 1e-38


def test_gradients_that_there_are_not_are_refused_and_not_lost_in_silence() -> None:
    structure = build(BALL, "bvh2")
    plain, down = vec3s([[0.0, 0.0, 3.0], [0.0, 0.0, 4.0]]), vec3s([[0.0, 0.0, -1.0]] * 2)
    needed = wp.clone(plain, requires_grad=True)
    end = wp.array(np.float32([9, 9]), dtype=wp.float32, device=DEVICE, requires_grad=True)
    expected = structure.closest_hit(needed, down, t_max=end).t.numpy()  # without a tape no gradients are needed
    for query, arguments, name in ((structure.any_hit, (needed, down), "origins"),
                                   (structure.any_hit, (down, needed), "directions"),
                                   (structure.any_hit, (plain, down, 0.0, end), "t_max"),
                                   (structure.closest_hit, (plain, down, 0.0, end), "t_max")):
        with refused(name, "wp.Tape", hint=f"wp.clone({name}"), wp.Tape():
            query(*arguments)
    with wp.Tape() as tape:
        for rays in ((plain, down), (wp.clone(needed, requires_grad=False), down), (plain.numpy(), down.numpy())):
            assert np.array_equal(structure.closest_hit(*rays).numpy().t, expected)
        structure.closest_hit(plain, down, counters=True)
        build(BALL, "bvh").any_hit(plain, down)
    kernels = [launch[0].key for launch in tape.launches if isinstance(launch, list)]
    assert not [key for key in kernels if "hit" in key or "trace" in key]  # backward() would warn about them


def test_bad_warp_arrays_are_named() -> None:
    structure = build(BALL, "brute_force")
    good = vec3s([[1.0, 0.0, 0.0]])
    with refused("origins", "both be Warp arrays"):
        structure.closest_hit(good, np.ones((1, 3)))
    with refused("origins", "both be Warp arrays"):
        structure.closest_hit(np.ones((1, 3)), good)
    with refused("origins", "of vec3, or (..., 3)"):
        structure.closest_hit(wp.zeros(1, dtype=wp.vec2, device=DEVICE), good)
    with refused("directions", "broadcasts"):
        structure.closest_hit(vec3s(np.ones((3, 3))), vec3s(np.ones((2, 3))))
    with refused("t_max"):
        structure.closest_hit(good, good, t_max=wp.zeros(3, dtype=wp.float32, device=DEVICE))
    for name, value, message in (("t_min", -0.5, ("t_min", "NaN or below 0")), ("t_min", np.nan, ("t_min", "NaN")),
                                 ("t_max", np.nan, ("t_max", "NaN"))):
        with refused(*message):
            structure.closest_hit(good, good, **{name: wp.array([value], dtype=wp.float32, device="cpu")})


@pytest.mark.parametrize("name", NAMES)
def test_the_caller_may_change_arrays_afterwards(name: str) -> None:
    geometry = Geometry(BALL.vertices.copy(), BALL.faces.copy(), np.array([[0.0, 0.0, 2.0, 0.5]], np.float32))
    structure = build(geometry, name)
    origin, direction = some_rays(200)
    before = structure.closest_hit(origin, direction)
    kept = before.t.copy()
    geometry.vertices[:] = 100.0
    geometry.faces[:] = 0
    geometry.spheres[:] = 50.0
    again = structure.closest_hit(origin, direction)
    assert np.array_equal(again.t, kept) and np.array_equal(before.t, kept)
    assert (before.prim_id == len(BALL.faces)).any()


def test_geometry_counts_triangles_then_spheres() -> None:
    spheres = np.array([[4.0, 0.0, 0.0, 0.5], [-4.0, 0.0, 0.0, 0.25]], np.float32)
    geometry = Geometry(BALL.vertices, BALL.faces, spheres)
    n = len(BALL.faces)
    assert len(geometry) == n + 2
    for name in NAMES:
        hits = build(geometry, name).closest_hit([[4, 5, 0], [-4, 5, 0], [0, 5, 0]], [[0, -1, 0]] * 3)
        assert hits.prim_id[:2].tolist() == [n, n + 1] and 0 <= hits.prim_id[2] < n
        assert hits.t[:2].tolist() == [4.5, 4.75] and not hits.u[:2].any() and not hits.v[:2].any()


def test_bounds_are_those_of_the_units_to_the_last_bit() -> None:
    # The host pads boxes for builds, and the device pads boxes that bound t of a hit. If they differed, a hit could lie outside
    # of the box that leads to it.
    rng = np.random.default_rng(3)
    corners = rng.normal(size=(4000, 3, 3)) * 10.0 ** rng.uniform(-8, 8, (4000, 1, 1))
    corners += 10.0 ** rng.uniform(-8, 8, (4000, 1, 3))
    spheres = np.concatenate([rng.normal(size=(500, 3)) * 100.0, 10.0 ** rng.uniform(-6, 4, (500, 1))], axis=1)
    geometry = Geometry(corners.reshape(-1, 3).astype(np.float32), np.arange(12000, dtype=np.int32).reshape(-1, 3),
                        spheres.astype(np.float32))
    lo, hi = geometry.bounds()
    corner = geometry.vertices[geometry.faces]
    center, radius = geometry.spheres[:, :3], geometry.spheres[:, 3:]
    tight_lo = np.concatenate([corner.min(axis=1), center - radius])
    tight_hi = np.concatenate([corner.max(axis=1), center + radius])
    out_lo, out_hi = zeros(4500, wp.vec3), zeros(4500, wp.vec3)
    launch(pad_kernel, 4500, vec3s(tight_lo), vec3s(tight_hi), out_lo, out_hi)
    assert np.array_equal(out_lo.numpy(), lo) and np.array_equal(out_hi.numpy(), hi)
    assert (lo <= tight_lo).all() and (hi >= tight_hi).all()


@pytest.mark.parametrize("name", NAMES)
def test_statistics(name: str) -> None:
    mesh = torus()
    structure = build(mesh, name)
    stats = structure.stats
    assert stats.build_seconds > 0.0 and stats.bytes >= records(Primitive, len(mesh.faces)).nbytes
    if name == "brute_force":
        assert (stats.nodes, stats.leaves, stats.depth, stats.sah_cost) == (0, 0, 0, len(mesh.faces))
    else:
        assert stats.nodes > 0 and stats.leaves > 0 and stats.depth >= 1 and 1.0 < stats.sah_cost < len(mesh.faces) / 4
    assert str(len(mesh.faces)) in repr(structure)


def test_records_of_primitives_are_the_same_on_any_number_of_threads() -> None:
    rng = np.random.default_rng(5)
    n = 80_000  # more records than one job makes
    faces = rng.integers(0, n, (n, 3)).astype(np.int32)
    geometry = Geometry(rng.random((n, 3), np.float32), faces, rng.random((500, 4), np.float32))
    order = rng.permutation(len(geometry)).astype(np.int32)
    units = Units(spheres=True)
    records = geometry.primitives(units, order, threads=3)
    assert records.tobytes() == geometry.primitives(units, order).tobytes()
    np.testing.assert_array_equal(records["prim_id"], order)
    triangle = order < n
    assert triangle.sum() == n
    corners = geometry.vertices[geometry.faces[order[triangle]]]
    for i, name in enumerate(("v1", "v2"), 1):
        np.testing.assert_array_equal(records[name][triangle], corners[:, i])
