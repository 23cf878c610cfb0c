"""Moved instances: hits have the bits of hits in a new structure."""

from __future__ import annotations

import pickle
from collections.abc import Callable
from fractions import Fraction
from typing import Any, cast

import numpy as np
import pytest
import warp as wp
from scipy.spatial.transform import Rotation

import wrt
from tests.data import ROOT
from tests.kernel_tools import cpu_only
from tests.placed import place
from tests.refused import Refusal, refused
from tests.wrt.accel.queries.test_threads import at_a_time
from wrt.accel.geometry import Geometry, InstancedGeometry, NumberedGeometry, inverse_of
from wrt.accel.instances import Instances
from wrt.accel.queries.all_hits import all_hits, count_hits
from wrt.accel.scenes.build import build
from wrt.core.device import on_host
from wrt.scene.materials import Material
from wrt.scene.mesh import Mesh
from wrt.scene.model import Object, Scene, Sphere
from wrt.scene.shapes import icosphere, torus


def matrices(n: int, seed: int) -> np.ndarray:
    """Return matrices (n, 4, 4) that rotate, stretch and translate; some also mirror."""
    rng = np.random.default_rng(seed)
    out = np.tile(np.eye(4), (n, 1, 1))
    out[:, :3, :3] = Rotation.random(n, random_state=seed).as_matrix() * (10.0 ** rng.uniform(-0.4, 0.2, (n, 1, 3)))
    out[::3, :3, 0] *= -1.0
    out[:, :3, 3] = rng.normal(scale=3.0, size=(n, 3))
    return out


def crowd(n: int = 24) -> InstancedGeometry:
    ball, ring = Geometry.of(icosphere(2)), Geometry.of(torus(segments=12, tube_segments=8))
    return place(*((ring if i % 3 else ball, matrix) for i, matrix in enumerate(matrices(n, 1))))


def structure(kind: str = "bvh2", geometry: InstancedGeometry | None = None) -> Instances:
    accel = build(geometry or crowd(), kind)
    assert isinstance(accel, Instances)
    return accel


def rays(n: int = 3000) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(5)
    origins = rng.normal(scale=8.0, size=(n, 3)).astype(np.float32)
    return origins, (rng.normal(scale=3.0, size=(n, 3)) - origins).astype(np.float32)


def answers(accel: Any) -> tuple[bytes, ...]:
    hits = accel.closest_hit(*rays())
    assert 0.3 < (hits.prim_id >= 0).mean() < 1.0
    return *(array.tobytes() for array in (hits.t, hits.u, hits.v, hits.prim_id)), accel.any_hit(*rays()).tobytes()


def anew(accel: Instances, kind: str = "bvh2") -> Instances:
    geometry: Any = accel.geometry
    return structure(kind, geometry)


@pytest.mark.parametrize("kind", ["bvh2", "bvh8"])
def test_hits_are_those_of_a_new_structure(kind: str) -> None:
    accel, places = structure(kind), matrices(24, 2)
    seen = {answers(accel)}
    for some in (3, [0], [1, 23, 7], slice(None)):
        rows = np.arange(24)[some]
        accel.move(rows, places[some])
        assert np.array_equal(accel.geometry.to_world[rows], places[some][..., :3, :])  # type: ignore[attr-defined]
        seen.add(answers(accel))
        assert answers(accel) == answers(anew(accel, kind))
    accel.move([4, 5], places[[8, 8]])  # three instances coincide: the hit has the lowest prim_id
    assert answers(accel) == answers(anew(accel, kind)) not in seen and len(seen) == 5


def test_trees_are_fitted_and_where_that_costs_too_much_built_anew() -> None:
    accel, far = structure(), crowd().to_world.copy()
    order = accel._top.order.copy()
    assert accel.move(2, far[2]).growth == pytest.approx(1.0, abs=0.02)
    far[:, :, 3] = np.random.default_rng(3).permutation(far[:, :, 3])
    fitted = accel.move(np.arange(24), far)
    assert fitted.growth > 1.3 and not fitted.rebuilt and np.array_equal(accel._top.order, order)
    before = answers(accel)
    rebuilt = accel.move(0, far[0], rebuild_at=1.2)
    assert rebuilt.rebuilt and not np.array_equal(accel._top.order, order) and answers(accel) == before
    assert accel.move(0, far[0]).growth == 1.0
    assert accel.stats.nodes == structure().stats.nodes and accel.stats.bytes == structure().stats.bytes


def test_points_of_hits_are_where_the_instance_is_and_was() -> None:
    accel = structure()
    before = accel.closest_hit(*rays())
    point, instance = before.point, before.instance
    accel.move(np.arange(24), matrices(24, 4))
    after = accel.closest_hit(*rays())
    for hits in (before, after):
        hit = hits.prim_id >= 0
        expected = rays()[0][hit] + hits.t[hit, None] * np.float64(rays()[1][hit])
        assert np.abs(hits.point[hit] - expected).max() < 1e-4
    assert np.array_equal(before.point, point, equal_nan=True) and np.array_equal(before.instance, instance)
    assert np.abs(after.normal[after.prim_id >= 0] - anew(accel).closest_hit(*rays()).normal[after.prim_id >= 0]).max() == 0.0


def test_nothing_to_move_and_one_that_is_alone() -> None:
    accel = structure()
    before = answers(accel)
    accel.move([], np.zeros((0, 4, 4)))
    assert answers(accel) == before
    one = structure(geometry=place((Geometry.of(icosphere(3)), np.eye(4))))
    down = np.float32([[0.1, 0.2, 9.0]]), np.float32([[0.0, 0.0, -1.0]])
    near, matrix = one.closest_hit(*down).t, np.eye(4)
    matrix[2, 3] = 2.0
    one.move(0, matrix)
    assert one.closest_hit(*down).t == pytest.approx(near - 2.0, abs=1e-6)


def with_a_part_in_the_world() -> Instances:
    placed = crowd(3)
    world = NumberedGeometry(*(np.zeros(shape, dtype) for shape, dtype in (((3, 3), "f4"), ((1, 3), "i4"), ((0, 4), "f4"))), None,
                             np.array([placed.n_triangles], np.int32))
    return structure(geometry=InstancedGeometry((world, *placed.parts), np.append(0, placed.part + 1),
                                                np.concatenate([np.eye(4)[None, :3], placed.to_world]),
                                                np.append(0, placed.first_prim), placed.n_triangles + 1))


@pytest.mark.parametrize("instance, matrix, told", [
    (3, np.zeros(3), ("matrix", "(4, 4)")),
    ([1, 2], np.eye(4), ("matrix", "(2, 4, 4)")),
    ([[1], [1, 2]], np.eye(4), ("instance", "whole number")),
    (3, "no", ("matrix", "(4, 4)")),
    (4, np.eye(4), ("instance", "0 to 3")), (-1, np.eye(4), ("instance", "0 to 3")),
    (0.5, np.eye(4), ("instance", "whole number")), ([2, 2], np.tile(np.eye(4), (2, 1, 1)), ("instance", "index twice")),
    (0, np.eye(4), ("instance", "0 cannot move")),
    (1, np.diag([1.0, 1.0, 0.0, 1.0]), ("matrix", "not flatten")),
    (1, np.full((3, 4), np.nan), ("matrix", "finite")), (1, 2.0 * np.eye(4), ("matrix", "affine")),
    (1, np.diag([1e25, 1e25, 1e25, 1.0]), ("matrix", "farther than 1e")),
])
def test_what_is_refused_changes_nothing(instance: Any, matrix: Any, told: Refusal) -> None:
    accel = with_a_part_in_the_world()
    before = accel.snapshot
    with refused(*told):
        accel.move(instance, matrix)
    assert accel.snapshot is before


def test_moved_by_turns_while_others_ask() -> None:
    """Each result is that of one of the two places."""
    accel, places = structure(), [matrices(24, seed) for seed in (2, 3)]
    known: list[tuple[bytes, ...]] = []
    for place_of in places:
        accel.move(np.arange(24), place_of)
        known.append(answers(accel)[:4])
    ended: list[bool] = []

    def flip() -> None:
        while not ended:
            for place_of in places:
                accel.move(np.arange(24), place_of)

    def ask() -> None:
        try:
            for _ in range(30):
                assert answers(accel)[:4] in known
        finally:
            ended.append(True)

    jobs: list[Callable[[], None]] = [flip, flip, ask]
    at_a_time(*jobs)
    assert known[0] != known[1]


def test_over_a_scene_an_instance_is_an_object() -> None:
    """The first object and a middle object are joined, so that rows of geometry.to_world differ from indices of objects."""
    grey, ball, large = (Material(),), icosphere(1), icosphere(5)
    alone = {0: icosphere(2), 4: ball}
    scene = Scene(tuple(Object(alone.get(k, large), grey, shifted(10.0 * k)) for k in range(20)),
                  spheres=(Sphere((-10.0, 0.0, 0.0), 1.0, grey[0]),))
    accel = build(scene)
    assert isinstance(accel, Instances) and len(accel.geometry.part) < 20  # type: ignore[attr-defined]
    origins, down = np.float32([[10.0 * k, 0.0, 5.0] for k in (*range(20), -1)]), np.float32([[0.0, 0.0, -1.0]] * 21)
    before = accel.closest_hit(origins, down)
    assert before.object.tolist() == before.instance.tolist() == list(range(21))
    for k in range(20):
        if k in alone:
            with refused("instance", f"instance {k}"):
                accel.move(k, shifted(1000.0))
            continue
        accel.move(k, shifted(1000.0))
        assert np.flatnonzero(np.isinf(accel.closest_hit(origins, down).t)).tolist() == [k]
        accel.move(int(before.instance[k]), shifted(10.0 * k))
        assert np.array_equal(accel.closest_hit(origins, down).t, before.t)
    with refused("instance", "20 cannot move"):
        accel.move(20, shifted(1000.0))
    with refused("instance", "0 to 20"):
        accel.move(21, shifted(1000.0))


def shifted(x: float) -> np.ndarray:
    matrix = np.eye(4)
    matrix[0, 3] = x
    return matrix


def test_move_by_name() -> None:
    floor, robot = (Object(mesh, (Material(),), name=name) for mesh, name in ((torus(), "floor"), (icosphere(1), "robot")))
    scene, matrix = Scene((floor, robot, robot)), np.diag([2.0, 2.0, 2.0, 1.0])
    accel = build(Scene((floor, robot)), movable=True)
    assert isinstance(accel, Instances)
    accel.move(object="robot", matrix=matrix)
    assert np.array_equal(accel.geometry.to_world[1], matrix[:3])
    worlds = build([Scene((robot, floor)), scene, Scene((floor, robot))])
    worlds.move(object="floor", world=[0, 2], matrix=np.stack([matrix, 2.0 * matrix - np.diag([0.0, 0.0, 0.0, 1.0])]))
    worlds.move(object=2, world=1, matrix=matrix)
    worlds.move("floor", matrix, world=1)
    worlds.move(["robot", "floor"], np.stack([np.eye(4), matrix]), world=[0, 1])
    scales = worlds.geometry.to_world[:, 0, 0].tolist()
    assert scales == [1.0, 2.0, 2.0, 1.0, 2.0, 4.0, 1.0]
    for more, told in (
            ({"object": "robt", "world": 0}, ("object", "unknown object 'robt'")), ({"object": "robot"}, ("world", "3 worlds")),
            ({"object": "robot", "world": 1}, ("object", "2 objects are called")), ({"object": 2, "world": 0}, ("object", "0 to 1")),
            ({"object": 1.5, "world": 0}, ("object", "0 to 1")), ({"object": "robot", "world": 3}, ("world", "0 to 2")),
            ({"object": ["robot"] * 3, "world": [0, 2]}, ("world", "3 worlds")),
            ({"object": np.array([[0, 1], [1, 0]]), "world": 0}, ("object", "or (R,) of them")),
            ({"object": [["robot"]], "world": 0}, ("object", "or (R,) of them")), ({"object": True, "world": 0}, ("object", "0 to 1")),
            ({"object": [False], "world": 0}, ("object", "0 to 1")), ({"object": {0}, "world": 0}, ("object", "0 to 1")),
            ({"object": wp.array([0, 1], dtype=wp.int32, device="cpu"), "world": 0}, ("object", "must be a name")),
            *(({"object": "robot", "world": 0, "rebuild_at": limit}, ("rebuild_at", "must be")) for limit in ("x", np.nan, -1, None)),
            ({"instance": "robt", "world": 0}, ("object", "unknown object 'robt'")), ({"instance": "robot"}, ("world", "3 worlds")),
            ({"instance": "robot", "object": 0}, (None, "instance and matrix")), ({"instance": 99}, ("instance", "0 to 6, got 99")),
            ({"instance": 0, "object": 0}, (None, "instance and matrix")), ({"instance": 0, "world": 0}, (None, "instance and matrix"))):
        with refused(*told):
            worlds.move(matrix=matrix, **more)  # type: ignore[call-overload]
    with refused("object", hint="did you mean 'robot'?"):
        worlds.move(object="robt", world=0, matrix=matrix)


def test_an_object_that_was_read_from_a_file_has_the_files_name() -> None:
    """An object that has the name itself comes first."""
    parts = [Mesh(icosphere(1).vertices, icosphere(1).faces, name=name) for name in ("parts/robot.ply", "floor.v2", "floor")]
    accel, matrix = build(Scene.of(parts), movable=True), np.eye(4)
    for name, instance in (("robot", 0), ("parts/robot.ply", 0), ("floor", 2), ("floor.v2", 1)):
        matrix[0, 3] += 10.0
        accel.move(object=name, matrix=matrix)
        hits = accel.closest_hit([[matrix[0, 3], 0.0, 5.0]], [[0.0, 0.0, -1.0]])
        assert hits.instance[0] == instance


# --- moves in place ---------------------------------------------------------------------------------------------------

ROWS = ("transformf", "mat44f", "rows of 3", "float64")


def in_rows(poses: np.ndarray, kind: str, device: Any) -> wp.array:
    """Return matrices (R, 4, 4) as a Warp array; of `transformf` only rotations and translations."""
    if kind == "transformf":
        turned = Rotation.from_matrix(poses[:, :3, :3]).as_quat()
        return wp.array(np.concatenate([poses[:, :3, 3], turned], axis=1), dtype=wp.transformf, device=device)
    if kind == "mat44f":
        return wp.array(poses, dtype=wp.mat44f, device=device)
    return wp.array(poses[:, :3] if kind == "rows of 3" else poses, dtype=float if kind == "rows of 3" else wp.float64, device=device)


def worlds_of(kind: str, worlds: int = 5) -> Instances:
    grey, meshes = (Material(),), (icosphere(2), torus(segments=12, tube_segments=8))
    scenes = [Scene(tuple(Object(meshes[(k + world) % 2], grey) for k in range(2 + world))) for world in range(worlds)]
    accel = build(scenes, kind)
    assert isinstance(accel, Instances)
    return accel


def lists_and_hits(accel: Any, worlds: int) -> list[bytes]:
    origins, directions = rays(2000)
    some = {"world": np.arange(2000) % worlds} if worlds > 1 else {}
    hits, lists = accel.closest_hit(origins, directions, **some), all_hits(accel, origins, directions, **some)
    assert (hits.prim_id >= 0).mean() > 0.05 and len(lists.t) > 100
    found = [hits.t, hits.u, hits.v, hits.prim_id, hits.point, hits.normal, hits.instance, accel.any_hit(origins, directions, **some),
             count_hits(accel, origins, directions, **some), lists.t, lists.prim_id, lists.instance]
    return [np.asarray(each).tobytes() for each in found]


@pytest.mark.parametrize("rows", ROWS)
@pytest.mark.parametrize("kind", ["bvh2", "bvh8"])
def test_moves_in_place_have_the_hits_of_a_new_structure(kind: str, rows: str) -> None:
    for accel, worlds in ((structure(kind), 1), (worlds_of(kind), 5)):
        n = len(cast(Any, accel.geometry).part)
        poses = matrices(n, 5)
        if rows == "transformf":
            poses[:, :3, :3] = Rotation.random(n, random_state=5).as_matrix()
        elif rows == "float64":
            poses[:, :3, :3] @= np.random.default_rng(1).uniform(-1.0, 1.0, (n, 3, 3)) + 2.0 * np.eye(3)  # sheared
        given = in_rows(poses, rows, accel.device)
        assert np.isnan(accel.move(given).growth)
        data = accel.data
        for some in (range(n), [3, 1], [n - 1]):
            accel.move(wp.array(some, dtype=wp.int32, device=accel.device), in_rows(poses[list(some)], rows, accel.device))
            geometry = cast(Any, accel.geometry)
            np.testing.assert_allclose(geometry.to_world, poses[:, :3], atol=1e-5)
            assert lists_and_hits(accel, worlds) == lists_and_hits(Instances.restore(
                accel.bottoms, geometry.now(), accel.snapshot.attributes, str(accel.device), None), worlds)
            poses[0, :3, 3] += 1.0
            accel.move(wp.array([0], dtype=wp.int32, device=accel.device), in_rows(poses[:1], rows, accel.device))
        assert accel.data is data and not accel.invalid_moves.numpy().any()
        before = lists_and_hits(accel, worlds)
        assert lists_and_hits(pickle.loads(pickle.dumps(accel)), worlds) == before
        accel.move(accel.geometry.to_world)  # type: ignore[union-attr]  # not in place, from NumPy
        assert accel.data is not data and lists_and_hits(accel, worlds) == before


def test_an_invalid_move_in_place_hides_the_instance_until_it_moves_again() -> None:
    accel, poses = structure("bvh8"), np.float32(matrices(24, 6))
    everything = range(24)
    accel.move(in_rows(poses, "mat44f", accel.device))
    whole = answers(accel)
    bad = poses.copy()
    bad[2, 0, 3], bad[5, 1, 1], bad[7, :3, :3], bad[8, 2, 3], bad[9, :3, :2] = np.nan, np.inf, 0.0, 1e19, poses[9, :3, 1:3]
    given = in_rows(bad, "mat44f", accel.device)
    with refused("matrix", "matrix of instance 2"):
        accel.move(given, check=True)
    assert answers(accel) == whole
    accel.move(given)
    assert {i: int(code) for i, code in enumerate(accel.invalid_moves.numpy()) if code} == dict.fromkeys((2, 5, 7, 8, 9), 1)
    assert not {2, 5, 7, 8, 9} & set(accel.closest_hit(*rays()).instance) and np.isfinite(cast(Any, accel.geometry).to_world).all()
    accel.move(wp.array([99, -1, 9], dtype=wp.int32, device=accel.device), in_rows(poses[[0, 1, 9]], "mat44f", accel.device))
    accel.move(0, poses[0], rebuild_at=0.0)  # a new tree keeps the hidden instances
    assert set(accel.closest_hit(*rays()).instance) >= {*everything} - {2, 5, 7, 8} and answers(accel) != whole
    accel.move(in_rows(poses, "mat44f", accel.device))
    assert answers(accel) == whole and not accel.invalid_moves.numpy().any()


@pytest.mark.parametrize("ids, given, told", [
    (None, lambda poses: wp.array(poses[:3], dtype=wp.mat44f), ("matrix", "(24,) of transformf or mat44f")),
    (None, lambda poses: wp.array(poses, dtype=wp.mat44h), ("matrix", "of transformf or mat44f")),
    (None, lambda poses: wp.array(poses[:, 0, :3], dtype=wp.vec3), ("matrix", "of transformf or mat44f")),
    (None, lambda poses: wp.array(np.tile(poses, (2, 1, 1)), dtype=wp.mat44f)[::2], ("matrix", "must be contiguous")),
    (np.float32([0.0]), lambda poses: wp.array(poses[:1], dtype=wp.mat44f), ("instance", "(R,) of int32")),
    (np.int64([0]), lambda poses: wp.array(poses[:1], dtype=wp.mat44f), ("instance", "(R,) of int32")),
    (np.int32([0, 1]), lambda poses: wp.array(poses[:1], dtype=wp.mat44f), ("matrix", "(2,) of transformf")),
    (np.int32([0, 24]), lambda poses: wp.array(poses[:2], dtype=wp.mat44f), ("instance", "0 to 23, got 24")),
    (np.int32([3, 3]), lambda poses: wp.array(poses[:2], dtype=wp.mat44f), ("instance", "same index twice")),
])
def test_arrays_that_a_move_in_place_refuses(ids: np.ndarray | None, given: Callable[[np.ndarray], wp.array], told: Refusal) -> None:
    accel, poses = structure(), np.float32(matrices(24, 6))
    with wp.ScopedDevice(accel.device):
        accel.move(in_rows(poses, "mat44f", accel.device))
        before = answers(accel)
        with refused(*told):
            accel.move(*([] if ids is None else [wp.array(ids)]), given(matrices(24, 7)), check=True)
        with refused("rebuild_at"):
            accel.move(given(poses), rebuild_at=2.0)
    assert answers(accel) == before


@cpu_only
def test_a_graph_of_the_cpu_captures_a_move_in_place() -> None:
    accel, poses = worlds_of("bvh8"), in_rows(np.tile(np.eye(4), (20, 1, 1)), "transformf", "cpu")
    origins, directions = (wp.array(each, dtype=wp.vec3, device="cpu") for each in rays(500))
    t, query = wp.zeros(500, dtype=float, device="cpu"), wrt.ray_query(accel)

    @wrt.kernel
    def trace(world: query.World, origins: wp.array(dtype=wp.vec3), directions: wp.array(dtype=wp.vec3), t: wp.array(dtype=float)):  # type: ignore
        i = wp.tid()
        ray = query.ray(origins[i], directions[i])
        ray.world = i % 5
        t[i] = query.closest_hit(world, ray).t

    with refused(None, "the first move in place"), wp.ScopedCapture("cpu"):
        accel.move(poses)
    accel.move(poses)
    with refused(None, "cannot be captured"), wp.ScopedCapture("cpu"):
        accel.move(poses, check=True)
    with wp.ScopedCapture("cpu") as capture:
        accel.move(poses)
        wp.launch(trace, 500, [accel.world, origins, directions, t], device="cpu")
    seen = set()
    for seed in (1, 2):
        poses.numpy()[:, :3] = np.random.default_rng(seed).normal(scale=2.0, size=(20, 3))
        wp.capture_launch(capture.graph)
        expected = worlds_of("bvh8")
        expected.move(np.arange(20), cast(Any, accel.geometry).to_world)
        assert np.array_equal(t.numpy(), expected.closest_hit(*rays(500), world=np.arange(500) % 5).t)
        seen.add(t.numpy().tobytes())
    assert len(seen) == 2


def fused(a: float, b: float, c: float) -> float:
    """Return a b + c, rounded once."""
    return float(Fraction(a) * Fraction(b) + Fraction(c))


def inverted(matrix: np.ndarray) -> np.ndarray:
    """Invert (3, 4) in float64 with the steps of kernels.build.moves: Gauss with row exchanges, then the translation."""
    m, b, t = matrix[:, :3].tolist(), np.eye(3).tolist(), matrix[:, 3].tolist()
    for k in range(2):
        p = max(range(k, 3), key=lambda i, k=k: abs(m[i][k]))  # type: ignore[misc]  # the first of equal ones
        m[k], m[p], b[k], b[p] = m[p], m[k], b[p], b[k]
        for i in range(k + 1, 3):
            m[i][k] = m[i][k] * (1.0 / m[k][k])
        if k == 0:
            for i in (1, 2):
                m[i][1] -= m[i][0] * m[0][1]
    m[1][2] -= m[1][0] * m[0][2]
    m[2][2] -= m[2][0] * m[0][2] + m[2][1] * m[1][2]
    for j in range(3):
        b[1][j] -= m[1][0] * b[0][j]
        b[2][j] = fused(-b[1][j], m[2][1], b[2][j] - m[2][0] * b[0][j])
        b[2][j] *= 1.0 / m[2][2]
        b[1][j] = (1.0 / m[1][1]) * (b[1][j] - m[1][2] * b[2][j])
        b[0][j] = (1.0 / m[0][0]) * (b[0][j] - m[0][2] * b[2][j] - m[0][1] * b[1][j])
    return np.array([[*row, -fused(row[2], t[2], fused(row[0], t[0], row[1] * t[1]))] for row in b])


def test_placements_have_the_bits_of_plain_python() -> None:
    """Those of numpy.linalg.inv depend on the processor, because OpenBLAS has several kernels."""
    geometry = crowd(200)
    accel = structure(geometry=geometry)
    placed = on_host(accel.data.placements)
    rows, to_world = np.stack([placed[f"local_{axis}"] for axis in "xyz"], axis=1), geometry.to_world[accel.snapshot.order]
    assert np.array_equal(rows, [inverted(each) for each in to_world])
    np.testing.assert_allclose(rows, inverse_of(to_world), rtol=1e-12, atol=1e-12)


def test_the_example_in_the_documentation() -> None:
    page = (ROOT / "docs/moving.md").read_text(encoding="utf-8")
    names: dict[str, Any] = {"wrt": wrt, "scene": Scene.of([icosphere(1), torus()])}
    exec(page[page.index("**Moving in place.**") :].split("```python\n")[1].split("```")[0], names)
    assert np.array_equal(names["worlds"].geometry.to_world, np.tile(np.c_[np.eye(3), [0.0, 0.0, 1.0]], (128, 1, 1)))
