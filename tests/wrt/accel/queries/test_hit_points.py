"""Points, normals, texture coordinates and ids of hits agree with exact arithmetic."""

from __future__ import annotations

import copy
import pickle
from decimal import Decimal, localcontext
from fractions import Fraction
from typing import Any

import numpy as np
import pytest
import warp as wp

import wrt
from tests.kernel_tools import DEVICE, unit, vec3s
from tests.placed import place
from tests.refused import refused
from wrt.accel.geometry import Geometry
from wrt.accel.instances import Instances
from wrt.accel.queries.hit_points import HitPoints
from wrt.accel.scenes.flatten import flatten, flatten_joined
from wrt.accel.structures import ACCELERATORS
from wrt.core.arrays import to_numpy
from wrt.scene import shapes
from wrt.scene.materials import Material
from wrt.scene.model import Object, Scene, Sphere

N = 700
PROPERTIES = [name for name, value in vars(HitPoints).items() if isinstance(value, property) and name != "shape"]


def triangles(rng: np.random.Generator, kind: str) -> np.ndarray:
    """Return the corners of 60 triangles, (60, 3, 3)."""
    corners = rng.uniform(-1.0, 1.0, (60, 1, 3)) + 0.5 * rng.normal(size=(60, 3, 3))
    if kind == "needles":
        way = corners[:, 1] - corners[:, 0]
        width = 10.0 ** rng.uniform(-7.0, -2.0, (60, 1))
        corners[:, 2] = corners[:, 0] + rng.random((60, 1)) * way + width * rng.normal(size=(60, 3))
    return {"far": corners + [3e5, -1e6, 2e4], "tiny": 1e-30 * corners, "huge": 1e15 * corners}.get(kind, corners)


def aimed(rng: np.random.Generator, corners: np.ndarray, kind: str) -> tuple[np.ndarray, np.ndarray]:
    """Return rays towards points on the triangles. Kind "grazing": nearly in the planes of the triangles."""
    chosen = corners[rng.integers(0, len(corners), N)]
    target = (rng.dirichlet((1.0, 1.0, 1.0), N)[:, :, None] * chosen).sum(axis=1)
    size = np.abs(chosen - chosen.mean(axis=1, keepdims=True)).max(axis=(1, 2))[:, None]
    way = size * rng.normal(size=(N, 3)) * rng.choice([1.0, 30.0], (N, 1))
    if kind == "grazing":
        along = chosen[:, 1] - chosen[:, 0] + rng.random((N, 1)) * (chosen[:, 2] - chosen[:, 0])
        way = along + 10.0 ** rng.uniform(-9.0, -2.0, (N, 1)) * size * rng.normal(size=(N, 3))
    origin = np.float32(target - way)
    return origin, np.float32((target - origin) * rng.choice([1.0, 1e-6, 1e6], (N, 1)))


def exact(row: Any) -> list[Fraction]:
    return [Fraction(float(x)) for x in row]


def dot(a: list[Fraction], b: list[Fraction]) -> Fraction:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def cross(a: list[Fraction], b: list[Fraction]) -> list[Fraction]:
    return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]


def minus(a: list[Fraction], b: list[Fraction]) -> list[Fraction]:
    return [x - y for x, y in zip(a, b, strict=True)]


def meeting(corners: list[list[Fraction]], origin: list[Fraction], direction: list[Fraction]) -> list[Fraction] | None:
    """Return the intersection point of a ray and a triangle; None if they have no point or several points in common."""
    edges = minus(corners[1], corners[0]), minus(corners[2], corners[0])
    normal = cross(*edges)
    slope = dot(normal, direction)
    if slope == 0:
        return None
    t = dot(normal, minus(corners[0], origin)) / slope
    point = [o + t * d for o, d in zip(origin, direction, strict=True)]
    way = minus(point, corners[0])
    u, v = dot(normal, cross(way, edges[1])), dot(normal, cross(edges[0], way))
    return point if u >= 0 and v >= 0 and u + v <= dot(normal, normal) else None


def placed_corners(matrix: np.ndarray, corners: np.ndarray) -> list[list[Fraction]]:
    rows = [exact(row) for row in matrix]
    return [[dot(row[:3], exact(corner)) + row[3] for row in rows] for corner in corners]


def worst(hits: Any, corners_of: Any, origin: np.ndarray, direction: np.ndarray) -> tuple[int, float]:
    """Return the number of hits that have an exact point, and the largest ratio of an error to its bound."""
    point, error, found, most = hits.point, hits.point_error, 0, 0.0
    for i in np.nonzero(hits.prim_id >= 0)[0]:
        true = meeting(corners_of(hits.prim_id[i]), exact(origin[i]), exact(direction[i]))
        if true is not None:
            found += 1
            off = [abs(a - b) / c for a, b, c in zip(exact(point[i]), true, exact(error[i]), strict=True)]
            most = max(most, float(max(off)))
    return found, most


@pytest.mark.filterwarnings("ignore:.* float32 vertices lie up to")
@pytest.mark.parametrize("kind", ["plain", "needles", "far", "tiny", "huge", "grazing"])
def test_the_true_point_is_within_the_bound(kind: str) -> None:
    rng = np.random.default_rng(0)
    corners = np.float32(triangles(rng, kind))
    accel = wrt.build((corners.reshape(-1, 3), np.arange(180).reshape(-1, 3)))
    origin, direction = aimed(rng, corners.astype(np.float64), kind)
    hits = accel.closest_hit(origin, direction)
    found, most = worst(hits, lambda prim_id: [exact(corner) for corner in corners[prim_id]], origin, direction)
    assert found > 0.25 * N and most <= 1.0
    hit = hits.prim_id >= 0
    step = np.maximum(np.abs(hits.point[hit]), 1e-44) * 2.0**-24
    if kind != "grazing":  # most are as exact as float32 can be
        assert np.median(hits.point_error[hit] / step) < 1.01 and most > 0.3
    assert np.isnan(hits.point[~hit]).all() and np.isnan(hits.point_error[~hit]).all()


def turned(rng: np.random.Generator, scale: np.ndarray) -> np.ndarray:
    matrix = np.eye(4)
    matrix[:3] = np.linalg.qr(rng.normal(size=(3, 3)))[0] * scale @ np.eye(3, 4)
    matrix[:3, 3] = rng.uniform(-3.0, 3.0, 3)
    return matrix


def test_of_instances_the_true_point_is_within_the_bound_too() -> None:
    rng = np.random.default_rng(1)
    corners = np.float32(triangles(rng, "plain"))
    part = Geometry.of(wrt.Mesh(corners.reshape(-1, 3), np.arange(180).reshape(-1, 3)))
    matrices = [turned(rng, scale) for scale in rng.uniform(0.3, 2.0, (4, 3)) * [[1.0], [1.0], [-1.0], [1e-3]]]
    accel = wrt.build(place(*((part, matrix) for matrix in matrices)))
    origin = np.float32(rng.normal(size=(N, 3)) * 6.0)
    direction = np.float32(rng.normal(size=(N, 3)) * 2.0 - origin)
    hits = accel.closest_hit(origin, direction)
    found, most = worst(hits, lambda i: placed_corners(matrices[i // 60][:3], corners[i % 60]), origin, direction)
    assert found > 0.2 * N and 0.3 < most <= 1.0
    hit = hits.prim_id >= 0
    assert np.array_equal(hits.instance, np.where(hit, hits.prim_id // 60, -1)) and len(np.unique(hits.instance)) > 3
    normal = hits.normal
    for i in np.nonzero(hit)[0][:60]:
        matrix, triangle = matrices[hits.prim_id[i] // 60], corners[hits.prim_id[i] % 60].astype(np.float64)
        outside = np.linalg.inv(matrix[:3, :3]).T @ np.cross(triangle[1] - triangle[0], triangle[2] - triangle[0])
        np.testing.assert_allclose(normal[i], unit(outside), atol=2e-6)


def test_on_spheres_the_true_point_is_within_the_bound() -> None:
    rng = np.random.default_rng(2)
    balls = np.float32(np.concatenate([rng.uniform(-3.0, 3.0, (8, 3)), rng.uniform(0.2, 1.0, (8, 1))], axis=1))
    accel = wrt.build(Geometry(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.int32), balls))
    origin = np.float32(10.0 * rng.normal(size=(N, 3)))
    aim = balls[rng.integers(0, 8, N)]
    direction = np.float32(aim[:, :3] + aim[:, 3:] * unit(rng.normal(size=(N, 3))) * rng.choice([0.9, 1.0 - 1e-7], (N, 1)) - origin)
    hits = accel.closest_hit(origin, direction)
    point, error, most, found = hits.point, hits.point_error, Decimal(0), 0
    with localcontext() as context:
        context.prec = 60
        for i in np.nonzero(hits.prim_id >= 0)[0]:
            ball = exact(balls[hits.prim_id[i]])
            o, d = exact(origin[i]), exact(direction[i])
            way = minus(o, ball[:3])
            b, dd = dot(way, d), dot(d, d)
            square = b * b - dd * (dot(way, way) - ball[3] ** 2)
            if square < 0:
                continue
            root = (Decimal(square.numerator) / Decimal(square.denominator)).sqrt()
            ends = [(Decimal(int(-b.numerator)) / Decimal(b.denominator) + sign * root)
                    / (Decimal(dd.numerator) / Decimal(dd.denominator)) for sign in (-1, 1)]
            t = min(ends, key=lambda end: abs(end - Decimal(float(hits.t[i]))))
            found += 1
            for axis in range(3):
                true = Decimal(float(origin[i, axis])) + t * Decimal(float(direction[i, axis]))
                most = max(most, abs(true - Decimal(float(point[i, axis]))) / Decimal(float(error[i, axis])))
    assert found > 0.8 * N and 0.3 < most <= 1
    hit = hits.prim_id >= 0
    away = unit(point[hit] - balls[hits.prim_id[hit], :3])
    np.testing.assert_allclose(hits.normal[hit], away, atol=1e-5)
    np.testing.assert_array_equal(hits.shading_normal[hit], hits.normal[hit])


RED, GREEN, BLUE = (Material(name=name) for name in ("red", "green", "blue"))


def scene() -> Scene:
    ball = shapes.icosphere(2)
    uvs = np.float32(0.5 + 0.25 * ball.vertices[:, :2])
    ball = wrt.Mesh(ball.vertices, ball.faces, ball.vertices, uvs)
    moved, mirrored = np.eye(4), np.diag([0.5, -0.7, 0.6, 1.0])
    moved[:3, 3], mirrored[:3, 3] = (2.5, 0.0, 0.0), (-2.0, 0.3, 0.0)
    by_face = (np.arange(len(ball.faces)) % 2).astype(np.int32)
    return Scene((Object(shapes.box(), (BLUE,), np.diag([0.5, 0.5, 0.5, 1.0])), Object(ball, (RED, GREEN), moved, by_face),
                  Object(ball, (GREEN,), mirrored)), (Sphere((0.0, 2.0, 0.0), 0.6, RED),))


def asked(n: int = 4000) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(3)
    origin = np.float32(rng.normal(size=(n, 3)) * [5.0, 5.0, 5.0])
    return origin, np.float32(rng.normal(size=(n, 3)) * [1.5, 0.7, 0.3] - origin)


@pytest.mark.parametrize("instances", [False, True])
def test_what_a_scene_says_of_a_hit(instances: bool) -> None:
    given = scene()
    accel = wrt.build(given)
    if instances:
        world = flatten(given, frozenset([id(given.objects[1].mesh)]))
        accel = Instances(ACCELERATORS["bvh"], world.geometry, world, device=DEVICE.alias)
    flat, hits = flatten_joined(given), accel.closest_hit(*asked())
    hit = hits.prim_id >= 0
    prim_id, point = hits.prim_id[hit], hits.point[hit].astype(np.float64)
    assert np.array_equal(hits.material[hit], flat.prim_material[prim_id]) and (hits.material[~hit] == -1).all()
    which = np.searchsorted([0, 12, 332, 652], prim_id, side="right") - 1
    assert np.array_equal(hits.object[hit], which) and np.bincount(which).min() > 50 and (hits.object[~hit] == -1).all()
    for number, thing in enumerate(given.objects[1:], 1):  # uvs and normals of the unit ball are functions of its points
        chosen = which == number
        inverse = np.linalg.inv(thing.transform)
        local = point[chosen] @ inverse[:3, :3].T + inverse[:3, 3]
        np.testing.assert_allclose(hits.uv[hit][chosen], 0.5 + 0.25 * local[:, :2], atol=1e-4)
        smooth = unit(unit(local) @ inverse[:3, :3])
        assert (hits.shading_normal[hit][chosen] * smooth).sum(axis=1).min() > 0.98
        assert (hits.normal[hit][chosen] * smooth).sum(axis=1).min() > 0.9
    assert np.abs(np.linalg.norm(hits.shading_normal[hit], axis=1) - 1.0).max() < 1e-6
    assert np.isnan(hits.uv[~hit]).all() and np.isnan(hits.shading_normal[~hit]).all() and np.isnan(hits.normal[~hit]).all()
    if instances:
        assert np.array_equal(hits.instance, hits.object)


def test_warp_arrays_give_warp_arrays_and_the_same_bits() -> None:
    origin, direction = asked(300)
    accel = wrt.build(scene())
    hits, of_warp = accel.closest_hit(origin, direction), accel.closest_hit(vec3s(origin), vec3s(direction))
    for name in PROPERTIES:
        if name != "instance":
            array = getattr(of_warp, name)
            assert isinstance(array, wp.array) and array.device == DEVICE
            np.testing.assert_array_equal(to_numpy(array), getattr(hits, name))
    np.testing.assert_array_equal(of_warp.numpy().point, hits.point)


def test_points_at_outlines_are_on_the_surface() -> None:
    """Some rays towards corners miss the body by a rounding error: they meet the planes of its faces outside of the faces."""
    ball = shapes.icosphere(3)
    rng = np.random.default_rng(4)
    origin = np.float32(3.0 * rng.normal(size=(20_000, 3)))
    hits = wrt.build(ball).closest_hit(origin, np.float32(ball.vertices[rng.integers(0, len(ball.vertices), 20_000)] - origin))
    hit = hits.prim_id >= 0
    assert hit.sum() > 15_000 and np.linalg.norm(hits.point[hit].astype(np.float64), axis=1).max() < 1.0 + 2e-7
    assert 1e-6 < hits.point_error[hit].max() < 1e-3  # as large as the move onto the triangle


def test_hits_are_of_the_shape_that_was_asked() -> None:
    ball = shapes.icosphere(2)
    accel = wrt.build(ball)
    origin, direction = [[0.1, 0.2, 5.0]], [[0.0, 0.0, -1.0]]
    before = accel.closest_hit(origin, direction)
    accel.refit(2.0 * ball.vertices)
    after = accel.closest_hit(origin, direction)
    assert abs(np.linalg.norm(before.point) - 1.0) < 0.03 and abs(np.linalg.norm(after.point) - 2.0) < 0.06


def test_after_refits_in_place_points_are_of_the_last_shape() -> None:
    ball = shapes.icosphere(2)
    accel, points = wrt.build(ball, "bvh2"), vec3s(ball.vertices)
    for size in (1.5, 2.0):
        points.assign((size * ball.vertices).astype(np.float32))
        accel.refit(points, in_place=True)
        hits = accel.closest_hit([[0.1, 0.2, 5.0]], [[0.0, 0.0, -1.0]])
        assert hits.point[0, 2] == pytest.approx(5.0 - hits.t[0], abs=1e-5) and hits.point[0, 2] > 0.9 * size


def test_what_is_not_there() -> None:
    origin, direction = asked(5)
    hits = wrt.build((np.eye(3), [[0, 1, 2]])).closest_hit(origin, direction)
    np.testing.assert_array_equal(hits.shading_normal, hits.normal)
    for name, what, hint in (("uv", "no texture coordinates", "hits.u"), ("object", "not over a scene", "wrt.Scene.of"),
                             ("material", "not over a scene", "wrt.Scene.of"), ("instance", "no instances", "movable=True")):
        with refused(what=what, hint=hint):
            getattr(hits, name)
    with refused(what="have no rays"):
        _ = wrt.first_hits(wrt.build(shapes.icosphere(1)), 2, origin, direction).point
    assert wrt.build(scene()).closest_hit(np.zeros((0, 3)), np.zeros((0, 3))).point.shape == (0, 3)


def test_a_prim_id_of_another_structure_is_a_miss() -> None:
    origin, direction = asked(2000)
    small, large = wrt.build((np.eye(3), [[0, 1, 2]])), wrt.build(shapes.icosphere(3))
    hits = small.closest_hit(origin, direction)
    large.closest_hit(origin, direction, out=hits)
    assert hits.prim_id.max() > 1 and np.isnan(hits.point[hits.prim_id > 0]).all()


# --- ids --------------------------------------------------------------------------------------------------------------


MESHES = [shapes.icosphere(1), shapes.box((2, -1, -1), (4, 1, 1)), shapes.torus(1.0, 0.4, 12, 8), shapes.icosphere(2)]
RNG = np.random.default_rng(5)
RAYS = np.concatenate([RNG.uniform(-2, 4, (400, 3)), RNG.normal(size=(400, 3))], axis=1).astype(np.float32)


def scenes() -> list[wrt.Scene]:
    """Return a scene that uses a mesh twice, and one with a moved and mirrored object and two spheres."""
    turned = np.diag([-1.0, 1.0, 2.0, 1.0])
    turned[:3, 3] = 3.0, 1.0, 0.0
    grey = (wrt.Material(),)
    balls = tuple(wrt.Sphere((x, 2.0, 0.0), 1.0, grey[0]) for x in (0.0, 3.0))
    places = np.eye(4), turned, turned, np.eye(4)
    objects = tuple(wrt.Object(mesh, grey, place) for mesh, place in zip(MESHES, places, strict=True))
    return [wrt.Scene.of([MESHES[0], MESHES[1], MESHES[0], MESHES[2]]), wrt.Scene(objects, balls)]


def expected(scene: wrt.Scene, prim_id: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return face and object of prim_ids, from lists of all ids in order."""
    counts = [len(thing.mesh.faces) for thing in scene.objects]
    faces = [*(i for n in counts for i in range(n)), *(-1 for _ in scene.spheres), -1]
    objects = [*(k for k, n in enumerate(counts) for _ in range(n)), *(len(counts) + i for i in range(len(scene.spheres))), -1]
    return np.array(faces)[prim_id], np.array(objects)[prim_id]


def answers(accel: Any, scene: wrt.Scene, **world: Any) -> list[Any]:
    found = [accel.closest_hit(RAYS, **world)]
    if not scene.spheres:
        found += [wrt.all_hits(accel, RAYS, **world), wrt.first_hits(accel, 3, RAYS, **world),
                  wrt.first_hits(accel, 2, RAYS.reshape(20, 20, 6), crossings=True, **world),
                  wrt.closest_points(accel, RAYS[:, :3].reshape(20, 20, 3), **world), accel.closest_hit(RAYS, **world)[5:90]]
    return found


@pytest.mark.parametrize("number", [0, 1])
def test_ids_over_a_scene_and_instances(number: int) -> None:
    scene = scenes()[number]
    for accel in (wrt.build(scene), *(() if scene.spheres else (wrt.build(scene, movable=True),))):
        for found in answers(accel, scene):
            face, thing = expected(scene, found.prim_id)
            assert np.array_equal(found.face, face) and np.array_equal(found.object, thing) and found.face.dtype == np.int32
            assert len(np.unique(found.object)) > 2


def test_ids_over_one_mesh_are_prim_ids() -> None:
    for found in answers(wrt.build(MESHES[3]), wrt.Scene.of(MESHES[3:])):
        assert np.array_equal(found.face, found.prim_id) and (found.face >= 0).any()
    warp = wrt.build(MESHES[3]).closest_hit(wp.array(RAYS[:, :3], dtype=wp.vec3), wp.array(RAYS[:, 3:], dtype=wp.vec3))
    assert isinstance(warp.face, wp.array) and np.array_equal(warp.face.numpy(), warp.prim_id.numpy())


@pytest.mark.parametrize("which", [0, 1, 2])
def test_ids_over_worlds(which: int) -> None:
    worlds: list[Any] = [scenes()[0], MESHES[1], wrt.Scene.of([MESHES[3], MESHES[2]])]
    scene = worlds[which] if isinstance(worlds[which], wrt.Scene) else wrt.Scene.of([worlds[which]])
    accel = wrt.build(worlds)
    for found in answers(accel, scene, world=which):
        face, thing = expected(scene, found.prim_id)
        assert np.array_equal(found.face, face) and np.array_equal(found.object, thing) and (face >= 0).any()
    mixed = wrt.all_hits(accel, RAYS, world=np.arange(len(RAYS)) % 3)
    rows = mixed.ray_id % 3 == which
    assert np.array_equal(mixed.face[rows], expected(scene, mixed.prim_id[rows])[0]) and rows.any()


def test_answers_without_points_say_so_and_copies_lose_their_ids() -> None:
    accel = wrt.build(scenes()[0])
    first = wrt.first_hits(accel, 2, RAYS)
    for name in ("point", "normal", "distance"):
        with refused(None, "lists of hits have ids alone"):
            getattr(first, name)
    for found in answers(accel, scenes()[0]):
        for other in (copy.copy(found), pickle.loads(pickle.dumps(found))):
            assert type(other) is type(found) and np.array_equal(other.prim_id, found.prim_id)
            with refused(None, "copies and pickled"):
                _ = other.face
