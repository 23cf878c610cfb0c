"""Instances: every two-level structure finds the closest of all instances' hits, and loses no ray."""

from functools import cache

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tests.kernel_tools import rounded, unit
from tests.placed import place
from tests.structures import families_first
from wrt.accel.geometry import Geometry, InstancedGeometry, NumberedGeometry, inverse_of
from wrt.accel.scenes.build import build
from wrt.kernels.traverse.bvh2 import Bvh2Node
from wrt.scene.shapes import icosphere, torus

NO_SPHERES = np.zeros((0, 4), np.float32)
NODE_BYTES = Bvh2Node.numpy_dtype()["itemsize"]


def matrix(rng, scale=2.0, far=20.0, shear=True):
    """Return a random affine map: rotations, scales up to 10^scale along rotated axes, mirroring and a translation."""
    out = np.eye(4)
    turn = Rotation.random(2, random_state=int(rng.integers(1 << 30))).as_matrix()
    out[:3, :3] = turn[0] @ np.diag(10.0 ** rng.uniform(-scale, scale, 3) * rng.choice([-1.0, 1.0], 3))
    if shear:
        out[:3, :3] = out[:3, :3] @ turn[1]
    out[:3, 3] = far * rng.normal(size=3)
    return out


@cache
def crowd():
    """Return overlapping instances of a ball and a torus, three with the same matrix, and a part in world space with spheres."""
    rng = np.random.default_rng(1)
    ball, ring = Geometry.of(icosphere(2)), Geometry.of(torus(segments=12, tube_segments=8))
    matrices = [matrix(rng, 0.7, 4.0) for _ in range(24)]
    matrices[5] = matrices[4] = matrices[6]
    placed = place(*((ball if i % 3 else ring, m) for i, m in enumerate(matrices)))
    corners = rounded(rng.uniform(-6.0, 6.0, (60, 1, 3)) + rng.normal(size=(60, 3, 3))).astype(np.float32).reshape(-1, 3)
    spheres = np.concatenate([rng.uniform(-5.0, 5.0, (20, 3)), rng.uniform(0.1, 1.0, (20, 1))], axis=1).astype(np.float32)
    n = placed.n_triangles
    # Half of the part's triangles have prim_ids below those of the instances, half above.
    first = placed.first_prim + 30
    numbers = np.concatenate([np.arange(30), np.arange(n + 30, n + 80)]).astype(np.int32)
    world = NumberedGeometry(corners, np.arange(180, dtype=np.int32).reshape(-1, 3), spheres, prim_ids=numbers)
    return InstancedGeometry((world, *placed.parts), np.concatenate([[0], placed.part + 1]),
                             np.concatenate([np.eye(4)[None, :3], placed.to_world]), np.concatenate([[0], first]), n + 60)


def rays(n, seed, reach=12.0):
    rng = np.random.default_rng(seed)
    origins, targets = rng.normal(size=(n, 3)) * reach, rng.normal(size=(n, 3)) * 4.0
    directions = (targets - origins) * 10.0 ** rng.uniform(-3, 3, (n, 1))
    axis = np.arange(n) % 7 == 0
    directions[axis] = np.eye(3)[rng.integers(0, 3, axis.sum())] * rng.choice([-1.0, 1.0], (axis.sum(), 1))
    return origins.astype(np.float32), directions.astype(np.float32)


def rows_times(rows, v, w):
    """Return the rows times (v, w) in float64, summed in the device's order and rounded once."""
    v = v.astype(np.float64)
    return np.stack([r[0] * v[:, 0] + r[1] * v[:, 1] + r[2] * v[:, 2] + r[3] * w for r in rows], axis=1).astype(np.float32)


def expected(geometry, origins, directions, t_min, t_max):
    """Return t, prim_id, u, v by brute force over every instance. At equal t, the lowest prim_id is hit."""
    n = len(origins)
    best = {"t": np.full(n, np.inf, np.float32), "prim_id": np.full(n, -1)} | {k: np.zeros(n, np.float32) for k in "uv"}
    for part, rows, first in zip(geometry.part, inverse_of(geometry.to_world), geometry.first_prim, strict=True):
        shape = geometry.parts[part]
        hits = build(Geometry(shape.vertices, shape.faces, shape.spheres), "brute_force").closest_hit(
            rows_times(rows, origins, 1.0), rows_times(rows, directions, 0.0), t_min, t_max)
        numbers = getattr(shape, "prim_ids", np.arange(len(shape)) + first)
        prim_id = np.where(hits.prim_id >= 0, numbers[hits.prim_id], -1)
        better = (prim_id >= 0) & ((hits.t < best["t"]) | ((hits.t == best["t"]) & (prim_id < best["prim_id"])))
        for name, values in (("t", hits.t), ("prim_id", prim_id), ("u", hits.u), ("v", hits.v)):
            best[name] = np.where(better, values, best[name])
    return best


@cache
def crowd_expected(part):
    origins, directions = rays(4000, 2)
    whole = expected(crowd(), origins, directions, 0.0, np.inf)
    if part:
        rng = np.random.default_rng(3)
        t_max = np.where(whole["prim_id"] >= 0, whole["t"], np.float32(1.0)) * rng.choice([0.9, 1.0, 1.5], 4000).astype(np.float32)
        t_min = (t_max * rng.choice([0.0, 0.5, 1.0], 4000)).astype(np.float32)
        return origins, directions, t_min, t_max, expected(crowd(), origins, directions, t_min, t_max)
    return origins, directions, 0.0, np.inf, whole


@pytest.mark.parametrize("name", families_first())
def test_hits_are_the_closest_of_all_instances_to_the_last_bit(name):
    accel = build(crowd(), name)
    for part in (False, True):
        origins, directions, t_min, t_max, truth = crowd_expected(part)
        hits = accel.closest_hit(origins, directions, t_min, t_max)
        for field, values in truth.items():
            np.testing.assert_array_equal(getattr(hits, field), values, err_msg=field)
        if name in ("brute_force", "bvh2"):
            np.testing.assert_array_equal(accel.any_hit(origins, directions, t_min, t_max), truth["prim_id"] >= 0)
        which = np.unique(np.searchsorted(crowd().first_prim, truth["prim_id"][truth["prim_id"] >= 0]))
        assert len(which) > 20 and (truth["prim_id"] >= crowd().n_triangles).any()


@cache
def ball_tree():
    """Return one structure for all tests of closed balls. Each test sets its transformation."""
    return Geometry.of(icosphere(3))


PLACES = {
    "turned": lambda rng: matrix(rng, 0.0, 0.0, shear=False),
    "turned_far": lambda rng: matrix(rng, 0.0, 1e5, shear=False),
    "stretched": lambda rng: matrix(rng, 3.0, 0.0, shear=False),
    "sheared_far": lambda rng: matrix(rng, 1.5, 1e3),
    "tiny": lambda rng: np.diag([1e-12, 1e-12, 1e-12, 1.0]) @ matrix(rng, 1.0, 0.0),
    "huge_far": lambda rng: np.diag([1e12, 1e12, 1e12, 1.0]) @ matrix(rng, 1.0, 1e3),
}


@pytest.mark.parametrize("kind", PLACES)
def test_no_ray_leaves_a_closed_mesh_that_was_transformed(kind):
    """Rays start at several points inside. They are aimed at every vertex, every edge's middle and random points, for many maps."""
    ball, rng = ball_tree(), np.random.default_rng(5)
    v = ball.vertices.astype(np.float64)
    edges = np.unique(np.sort(ball.faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1), axis=0)
    goals = np.concatenate([v, v[edges].mean(axis=1), v[edges[:, 0]] * 0.3 + v[edges[:, 1]] * 0.7])
    tested = 0
    for _ in range(8):
        m = PLACES[kind](rng)
        accel = build(place((ball, m)), "bvh2")
        origin = (0.5 * unit(rng.normal(size=(len(goals), 3))) * rng.random((len(goals), 1))) @ m[:3, :3].T + m[:3, 3]
        origin = rounded(origin)
        inside = np.linalg.norm((origin - m[:3, 3]) @ np.linalg.inv(m[:3, :3]).T, axis=1) < 0.9  # Rounding may move an origin out.
        directions = (goals @ m[:3, :3].T + m[:3, 3] - origin)[inside].astype(np.float32)
        hits = accel.closest_hit(origin[inside], directions)
        assert (hits.prim_id < 0).sum() == 0
        assert np.abs(hits.t - 1.0).max() < 0.05  # Mostly the rounding of the origin, where the map squeezes.
        tested += len(directions)
    assert tested > 15_000


def fine_cube(n):
    """Return the cube from -0.5 to 0.5 with n by n squares on each face. Its triangles' boxes are small for any rotation."""
    steps = np.linspace(-0.5, 0.5, n + 1)
    a, b = (x.ravel() for x in np.meshgrid(steps, steps))
    corner = np.arange(n * (n + 1)).reshape(n, n + 1)[:, :n].ravel()
    square = np.stack([corner, corner + 1, corner + n + 2, corner, corner + n + 2, corner + n + 1], axis=1).reshape(-1, 3)
    vertices, faces = [], []
    for axis in range(3):
        for side in (-0.5, 0.5):
            faces.append(square + len(vertices) * len(a))
            vertices.append(np.insert(np.stack([a, b], axis=1), axis, side, axis=1))
    return np.concatenate(vertices), np.concatenate(faces).astype(np.int32)


def test_a_far_mesh_is_hit_exactly_where_its_own_structure_is():
    """Rays pass the edges of a cube, nearly along the world's axes, from 1e4 to 1e6 sizes away. The cube fills its world box, but is
    rotated in its own space. There the rounding of the ray is far larger than the boxes' padding. Without the margin that `enter` adds,
    many hits would be lost."""
    (vertices, faces), rng = fine_cube(24), np.random.default_rng(6)
    for power in (4, 5, 6):
        m = np.eye(4)
        m[:3, :3] = np.diag(10.0 ** rng.uniform(-0.3, 0.3, 3)) @ Rotation.random(random_state=power).as_matrix()
        turned = Geometry(rounded(vertices @ np.linalg.inv(m[:3, :3]).T).astype(np.float32), faces, NO_SPHERES)
        placed = place((turned, m))
        chosen = rng.uniform(-0.5, 0.5, (4000, 3))
        chosen[np.arange(4000), rng.integers(0, 3, 4000)] = 0.5 * rng.choice([-1.0, 1.0], 4000)
        away = np.eye(3)[rng.integers(0, 3, 4000)] + 10.0**-power * 0.1 * rng.normal(size=(4000, 3))
        origins = rounded(3.0 * 10.0**power * away)
        directions = rounded(chosen + 1e-7 * 10.0**power * rng.normal(size=(4000, 3)) - origins)
        truth = expected_of_one(placed, np.zeros(4000, int), origins, directions)
        assert 500 < np.isfinite(truth).sum() < 3900
        np.testing.assert_array_equal(build(placed, "bvh2").closest_hit(origins, directions).t, truth)


def test_rays_that_graze_the_instances_boxes_are_not_lost():
    """The instances are flat, with boxes as thin as the mesh. Rays run in the planes of the boxes' faces, and at their edges."""
    corners = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], np.float32)
    square = Geometry(corners, np.array([[0, 1, 2], [0, 2, 3]], np.int32), NO_SPHERES)
    rng = np.random.default_rng(7)
    turns = Rotation.random(300, random_state=1).as_matrix() * 10.0 ** rng.uniform(-2, 2, (300, 1, 1))
    placed = place(*((square, np.block([[t, 50.0 * rng.normal(size=(3, 1))], [np.zeros((1, 3)), 1.0]])) for t in turns))
    which = rng.integers(0, 300, 20_000)
    u, v = rng.random((2, 20_000))
    # Half of the targets lie on the diagonal that the two triangles share, half anywhere.
    v = np.where(np.arange(20_000) % 2, u, v)[:, None]
    goal = np.stack([u, v[:, 0], np.zeros(20_000), np.ones(20_000)], axis=1)
    world = np.einsum("nij,nj->ni", placed.to_world[which], goal)
    origins = rounded(world + rng.normal(size=(20_000, 3)) * 10.0 ** rng.uniform(-1, 3, (20_000, 1)))
    directions = rounded(world - origins)
    hits = build(placed, "bvh2").closest_hit(origins, directions)
    truth = expected_of_one(placed, which, origins, directions)
    inside = truth < np.inf  # Rounding moves some targets near the square's border outside.
    assert inside.mean() > 0.98
    assert (hits.t[inside] <= truth[inside]).all()


def expected_of_one(geometry, which, origins, directions):
    """Return t of the hit in the instance that each ray is aimed at."""
    out = np.full(len(which), np.inf, np.float32)
    alone = build(geometry.parts[0], "bvh2")
    for i, rows in enumerate(inverse_of(geometry.to_world)):
        mine = which == i
        out[mine] = alone.closest_hit(rows_times(rows, origins[mine], 1.0), rows_times(rows, directions[mine], 0.0)).t
    return out


def test_counters_are_those_of_both_levels():
    ball = ball_tree()
    near, far = np.eye(4), np.eye(4)
    far[0, 3] = 1000.0
    accel, alone = build(place((ball, near), (ball, far)), "bvh2"), build(ball, "bvh2")
    origins, directions = rays(300, 8, 3.0)
    both, one = (a.closest_hit(origins, directions, trace=True).counters for a in (accel, alone))
    entered = one.nodes > 0
    assert entered.all() and (both.probes == 1).all()
    # The upper level has one node, whose leaves are the two instances. Only rays along x meet the far instance.
    visits = both.leaves - one.leaves
    once = (visits == 1) & (np.abs(directions[:, 0]) < 0.9 * np.abs(directions).max(axis=1))
    assert once.sum() > 20
    for name, extra in (("nodes", 1), ("boxes", 2), ("box_operations", 1), ("primitives", 0)):
        np.testing.assert_array_equal(getattr(both, name)[once], getattr(one, name)[once] + extra)
    base = int(accel.data.bases.numpy()[0])
    assert base >= NODE_BYTES
    for i in np.nonzero(once)[0]:
        trace, plain = (c.address[c.first[i]:c.first[i + 1]] for c in (both, one))
        assert trace.tolist() == [0, *(plain + base).tolist()]
    assert both.counts["stack"].max() >= one.counts["stack"].max()


def test_rays_that_are_not_finite_end_and_miss():
    accel = build(crowd(), "bvh2")
    import warp as wp

    bad = np.array([[np.nan, 0, 0], [0, 0, 0], [np.inf, 0, 0]], np.float32)
    d = np.array([[1, 0, 0], [np.nan, 1, 0], [1, 0, 0]], np.float32)
    hits = accel.closest_hit(wp.array(bad, dtype=wp.vec3, device="cpu"), wp.array(d, dtype=wp.vec3, device="cpu"))
    assert (hits.prim_id.numpy() == -1).all() and np.isinf(hits.t.numpy()).all()
