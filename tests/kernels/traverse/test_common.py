"""Traversal: every structure in the registry finds the same hits, to the last bit, as brute force."""

from functools import cache

import numpy as np
import pytest

from tests.kernel_tools import directions, floats, ints, launch, rounded, unit, vec3s, zeros  # isort: skip
from tests.structures import FAMILIES, STRUCTURES, families_first  # isort: skip
import warp as wp

from wrt.accel.geometry import Geometry
from wrt.accel.scenes.build import build
from wrt.accel.snapshot import Structure
from wrt.accel.structures import ACCELERATORS, default_options
from wrt.kernels.query import RayArrays, load_ray
from wrt.kernels.structs import Surfaces, kernel
from wrt.kernels.traverse.common import Units
from wrt.kernels.units.box import RAY_AABB
from wrt.scene.mesh import Mesh
from wrt.scene.shapes import icosphere

TREES = [name for name in STRUCTURES if name != "brute_force"]
WITH_LEAVES = [name for name in TREES if "max_leaf" in default_options(name)]
NO_SPHERES = np.zeros((0, 4), np.float32)


# --- geometry ---------------------------------------------------------------------------------------------------------


def soup(rng, n, size=0.2):
    """Return n random triangles without shared vertices as a Geometry."""
    corners = rng.uniform(-1.0, 1.0, (n, 1, 3)) + size * rng.normal(size=(n, 3, 3))
    return triangles(corners)


def triangles(corners, spheres=NO_SPHERES):
    corners = np.asarray(corners, np.float32).reshape(-1, 3)
    return Geometry(corners, np.arange(len(corners), dtype=np.int32).reshape(-1, 3), np.asarray(spheres, np.float32))


def coincident(rng):
    """Return 60 triangles, each five times, in a shuffled order."""
    corners = rng.uniform(-1.0, 1.0, (60, 1, 3)) + 0.4 * rng.normal(size=(60, 3, 3))
    return triangles(np.repeat(corners, 5, axis=0)[rng.permutation(300)])


def flat(rng):
    """Return triangles with corners on a grid in the plane y = 0.25; many overlap."""
    corners = rng.integers(-8, 9, (400, 3, 3)) / 8.0
    corners[:, :, 1] = 0.25
    return triangles(corners)


def all_equal(_rng):
    return triangles(np.broadcast_to(np.array([[0.0, 0.0, 0.1], [1.0, 0.0, 0.0], [0.0, 1.0, 0.2]]), (200, 3, 3)))


def progression(rng):
    """Return triangles in geometric progression of ratio 3, in size and distance: no split by space is balanced."""
    scale = 3.0 ** np.arange(-30, 30)[:, None, None]
    return triangles(scale * (np.array([1.0, 0.3, 0.1]) + 0.2 * rng.normal(size=(60, 3, 3))))


def tiny_and_huge(rng):
    """Return a dense cluster of size 1e-3 in a room of size 1e3."""
    room = 1000.0 * rng.uniform(-1.0, 1.0, (30, 3, 3))
    cluster = 0.5 + 1e-3 * (rng.uniform(-1.0, 1.0, (500, 1, 3)) + 0.1 * rng.normal(size=(500, 3, 3)))
    return triangles(np.concatenate([room, cluster]))


def mixed(rng):
    """Return triangles and spheres; some spheres are inside each other, and two are equal."""
    spheres = np.concatenate([rng.uniform(-1.0, 1.0, (60, 3)), rng.uniform(0.02, 0.4, (60, 1))], axis=1)
    spheres[7] = spheres[3]
    spheres[9, :3], spheres[9, 3] = spheres[4, :3], 0.5 * spheres[4, 3]
    return triangles(soup(rng, 200).vertices, spheres)


def only_spheres(rng):
    return triangles(np.zeros((0, 3, 3)), mixed(rng).spheres)


GEOMETRIES = {
    "soup": lambda rng: soup(rng, 800),
    "long_thin": lambda rng: triangles(rng.normal(size=(300, 3, 3)) * 10.0 ** rng.uniform(-3, 1, (300, 1, 3))),
    "coincident": coincident, "flat": flat, "all_equal": all_equal, "progression": progression,
    "tiny_and_huge": tiny_and_huge, "mixed": mixed, "only_spheres": only_spheres,
    "none": lambda rng: soup(rng, 0), "one": lambda rng: soup(rng, 1, 1.0), "two": lambda rng: soup(rng, 2, 1.0),
    "one_sphere": lambda rng: triangles(np.zeros((0, 3, 3)), [[0.1, 0.2, 0.3, 0.7]]),
}


def rays_for(geometry, rng, n=6000):
    """Return rays from in and around the geometry, aimed at corners, at points on edges, at random points, and along the axes."""
    points = geometry.vertices.astype(np.float64)
    if len(geometry.spheres):
        points = np.concatenate([points, geometry.spheres[:, :3] + 0.9 * geometry.spheres[:, 3:]])
    if not len(points):
        points = np.zeros((3, 3))
    a, b, c = points[rng.integers(0, len(points), (3, n))]
    target = np.where(rng.random((n, 1)) < 0.3, a, a + rng.random((n, 1)) * (b - a))
    extent = np.abs(points).max() + 1e-30
    near, far = c + 0.1 * extent * rng.normal(size=(n, 3)), 3.0 * extent * rng.normal(size=(n, 3))
    origin = np.where(rng.random((n, 1)) < 0.5, near, far)
    direction = target - origin
    axis = rng.random(n) < 0.25
    direction[axis] = np.eye(3)[rng.integers(0, 3, axis.sum())] * rng.choice([-1.0, 1.0], (axis.sum(), 1))
    origin[axis] = target[axis] - direction[axis] * extent * rng.integers(0, 3, (axis.sum(), 1))
    origin, direction = rounded(origin), rounded(direction)
    direction[~direction.any(axis=1), 0] = 1.0
    return origin, direction


def assert_same_hits(found, expected):
    for name in ("prim_id", "t", "u", "v"):
        a, b = getattr(found, name), getattr(expected, name)
        differ = np.nonzero(a.view(np.int32) != b.view(np.int32))[0]
        assert not len(differ), f"{name} of ray {differ[0]}: {a[differ[0]]!r}, not {b[differ[0]]!r} ({len(differ)} in all)"


# --- every structure against brute force ------------------------------------------------------------------------------


@pytest.mark.parametrize("name", TREES)
@pytest.mark.parametrize("kind", GEOMETRIES)
def test_same_bits_as_brute_force(kind, name):
    rng = np.random.default_rng(1)
    geometry = GEOMETRIES[kind](rng)
    origin, direction = rays_for(geometry, rng)
    reference, tree = build(geometry, "brute_force"), build(geometry, name)
    expected = reference.closest_hit(origin, direction)
    assert_same_hits(tree.closest_hit(origin, direction), expected)
    if len(geometry):
        assert 50 < (expected.prim_id >= 0).sum()

    hit = expected.prim_id >= 0
    lengths = np.where(hit, expected.t, np.float32(1.0)) * rng.choice([0.5, 0.999, 1.0, 1.5], len(origin)).astype(np.float32)
    t_min = (lengths * rng.choice([0.0, 0.9, 1.0], len(origin))).astype(np.float32)
    expected = reference.closest_hit(origin, direction, t_min, lengths)
    assert_same_hits(tree.closest_hit(origin, direction, t_min, lengths), expected)
    for structure in (reference, tree):
        assert np.array_equal(structure.any_hit(origin, direction, t_min, lengths), expected.prim_id >= 0)


@pytest.mark.parametrize("name", WITH_LEAVES)
@pytest.mark.parametrize("max_leaf", [1, 2, 64])
def test_leaf_size_does_not_matter(name, max_leaf):
    rng = np.random.default_rng(2)
    geometry = mixed(rng)
    origin, direction = rays_for(geometry, rng)
    expected = build(geometry, "brute_force").closest_hit(origin, direction)
    assert_same_hits(build(geometry, name, max_leaf=max_leaf).closest_hit(origin, direction), expected)


# Geometries with spheres have kernels of their own. To save compile time, only bvh2 tries every box test with spheres.
@pytest.mark.parametrize("kind, box, name", [
    pytest.param(kind, box, name, marks=[] if box == Units().box or name in FAMILIES else pytest.mark.slow)
    for kind in ("none", "one", "two", "one_sphere", "mixed") for box in RAY_AABB for name in TREES
    if box == Units().box or name == "bvh2" or kind in ("none", "one", "two")])
def test_any_box_test_ends_and_hardly_loses_a_ray(kind, box, name):
    # A small tree has empty boxes, which no test may enter. Looser tests may only lose rays at edges.
    rng = np.random.default_rng(12)
    geometry = GEOMETRIES[kind](rng)
    origin, direction = rays_for(geometry, rng)
    slanted = (direction != 0.0).all(axis=1)
    origin, direction = origin[slanted], direction[slanted]
    expected = build(geometry, "brute_force").closest_hit(origin, direction)
    found = build(geometry, name, box=box).closest_hit(origin, direction)
    differ = found.t != expected.t
    assert differ.mean() <= (0.0 if box == "conservative" else 2e-3)
    assert (found.t[differ] > expected.t[differ]).all()


@pytest.mark.parametrize("name", STRUCTURES)
def test_ties_go_to_the_lower_prim_id(name):
    rng = np.random.default_rng(3)
    geometry = coincident(rng)
    corners = geometry.vertices[geometry.faces].reshape(len(geometry), 9)
    _, first, group = np.unique(corners, axis=0, return_index=True, return_inverse=True)
    origin, direction = rays_for(geometry, rng)
    prim_id = build(geometry, name).closest_hit(origin, direction).prim_id
    hit = prim_id >= 0
    assert hit.sum() > 1000
    assert np.array_equal(prim_id[hit], first[group.ravel()[prim_id[hit]]])


@pytest.mark.parametrize("name", STRUCTURES)
def test_the_segment_is_closed(name):
    rng = np.random.default_rng(4)
    geometry = mixed(rng)
    structure = build(geometry, name)
    origin, direction = rays_for(geometry, rng)
    hits = structure.closest_hit(origin, direction)
    on = hits.prim_id >= 0
    origin, direction, t = origin[on], direction[on], hits.t[on]
    again = structure.closest_hit(origin, direction, t, t)
    assert np.array_equal(again.prim_id, hits.prim_id[on]) and np.array_equal(again.t, t)
    assert structure.any_hit(origin, direction, 0.0, t).all()
    before = np.nextafter(t, np.float32(0.0))
    ahead = t > 0.0
    assert not structure.any_hit(origin[ahead], direction[ahead], 0.0, before[ahead]).any()
    beyond = structure.closest_hit(origin, direction, np.nextafter(t, np.float32(np.inf)))
    assert (beyond.t > t).all()


@pytest.mark.parametrize("name", STRUCTURES)
@pytest.mark.parametrize("kind", ["none", "one", "two", "one_sphere", "soup"])
def test_rays_that_are_not_finite_miss_and_end(kind, name):
    # Comparisons with NaN are false: a ray with a NaN must not enter an empty box and loop for ever.
    structure = build(GEOMETRIES[kind](np.random.default_rng(5)), name)
    rows = []
    for bad in (np.nan, np.inf, -np.inf):
        for axis in range(6):
            row = np.array([0.0, 0.0, -3.0, 0.0, 0.1, 1.0])
            row[axis] = bad
            rows.append(row)
    rows = np.array(rows)
    hits = structure.closest_hit(vec3s(rows[:, :3]), vec3s(rows[:, 3:]))
    assert (hits.prim_id.numpy() == -1).all() and np.isinf(hits.t.numpy()).all()
    assert not structure.any_hit(vec3s(rows[:, :3]), vec3s(rows[:, 3:])).numpy().any()


# --- no ray is lost ---------------------------------------------------------------------------------------------------


def edge_points(mesh, rng, per_edge):
    """Return random points on the edges of a mesh, in float64."""
    ends = np.unique(np.sort(mesh.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1), axis=0)
    a, b = (np.repeat(mesh.positions[ends[:, i]], per_edge, axis=0) for i in range(2))
    return a + rng.random((len(a), 1)) * (b - a)


@pytest.mark.parametrize("name", STRUCTURES)
@pytest.mark.parametrize("placed", ["unit", "stretched", "far", "tiny", "huge"])
def test_a_closed_mesh_is_watertight(placed, name):
    rng = np.random.default_rng(6)
    ball = icosphere(4)
    assert len(ball.faces) == 5120 and len(ball.vertices) == 2562
    scale, move = {"unit": (1.0, 0.0), "stretched": ([3.0, 0.05, 100.0], 0.0), "far": (0.5, [1000.0, -300.0, 77.0]),
                   "tiny": (1e-18, 0.0), "huge": (1e15, 0.0)}[placed]
    mesh = Mesh(ball.vertices.astype(np.float64) * scale + move, ball.faces)
    targets = np.concatenate([mesh.positions, edge_points(mesh, rng, 1)])
    origin = rounded(np.broadcast_to(0.2 * np.array([0.3, -0.2, 0.1]) * scale + move, targets.shape))
    structure = build(mesh, name)
    hits = structure.closest_hit(origin, targets - origin)
    assert (hits.prim_id >= 0).all(), f"{(hits.prim_id < 0).sum()} of {len(targets)} rays left the ball"
    assert structure.any_hit(origin, targets - origin).all()
    # From the center, the float32 directions point exactly at the corners.
    center = rounded(np.broadcast_to(np.zeros(3) * scale + move, (2562, 3)))
    hits = structure.closest_hit(center, mesh.positions - center)
    assert (hits.prim_id >= 0).all() and np.allclose(hits.t, 1.0, rtol=2e-5 if placed == "far" else 2e-6)


@pytest.mark.parametrize("name", STRUCTURES)
def test_a_floor_of_long_triangles_is_watertight(name):
    # Rounding moves the seams between far corners by more than the relative margin of a box test near the origin.
    rng = np.random.default_rng(7)
    x = np.linspace(-4.0, 4.0, 9)
    vertices = np.array([[a, 0.0, z] for a in x for z in (-1000.0, 1000.0)])
    strip = np.arange(8)[:, None] * 2
    faces = np.concatenate([strip + np.array([0, 1, 3]), strip + np.array([0, 3, 2])])
    n = 100_000
    aside = rng.choice([-1.0, 1.0], n) * 10.0 ** rng.uniform(-8, -4, n)
    target = np.stack([rng.choice(x[1:-1], n) + aside, np.zeros(n), rng.uniform(-5.0, 5.0, n)], axis=1)
    direction = np.stack([rng.uniform(-0.3, 0.3, n), -(10.0 ** rng.uniform(-4, -0.5, n)), rng.choice([-1.0, 1.0], n)], axis=1)
    origin = rounded(target - direction * 10.0 ** rng.uniform(-2, 1, (n, 1)))
    direction = rounded(target - origin)
    for turn in range(3):  # The floor, and two walls.
        mesh = Mesh(np.roll(vertices, turn, axis=1), faces)
        hits = build(mesh, name).closest_hit(np.roll(origin, turn, axis=1), np.roll(direction, turn, axis=1))
        assert (hits.prim_id >= 0).all(), f"{(hits.prim_id < 0).sum()} of {n} rays fell through"
        # The seams are off by a few u of the strips' length, and so are the points of the hits.
        assert (np.abs(hits.t - 1.0) * np.linalg.norm(direction, axis=1)).max() < 4.0 * 2.0**-24 * 1000.0


@pytest.mark.parametrize("name", STRUCTURES)
def test_rays_along_the_faces_of_a_grid(name):
    # Axis-parallel rays exactly in the planes and through the corners of a grid of quads: 0 * inf in every box.
    n = 12
    i, j = np.meshgrid(np.arange(n + 1.0), np.arange(n + 1.0), indexing="ij")
    first = (np.arange(n)[:, None] * (n + 1) + np.arange(n)).reshape(-1, 1)
    faces = np.concatenate([first + np.array([0, n + 1, n + 2]), first + np.array([0, n + 2, 1])])
    for axis in range(3):
        flat_grid = np.stack([i, j], axis=-1).reshape(-1, 2)
        vertices = np.insert(flat_grid, axis, 3.0, axis=1)
        structure = build(Mesh(vertices, faces), name)
        half = np.stack(np.meshgrid(np.arange(0.0, n + 0.5, 0.5), np.arange(0.0, n + 0.5, 0.5)), axis=-1).reshape(-1, 2)
        for sign in (-1.0, 1.0):
            for zero in (0.0, -0.0):
                origin = np.insert(half, axis, 3.0 - 5.0 * sign, axis=1)
                direction = np.full(3, zero)
                direction[axis] = sign
                hits = structure.closest_hit(origin, np.broadcast_to(direction, origin.shape))
                assert (hits.prim_id >= 0).all() and (hits.t == 5.0).all()


# --- excluded and refused hits ----------------------------------------------------------------------------------------


@wp.func
def accepts_even_near_edge(surfaces: Surfaces, prim_id: int, u: float, v: float) -> bool:
    return prim_id % 2 == 0 and u < 0.75


@cache
def refusing_kernel(name):
    """Return a kernel over rays that each exclude a triangle, and over a traversal that refuses some hits."""
    structure = Structure(next(cls for cls in ACCELERATORS.values() if cls.name == name))
    struct = structure.struct
    closest = structure.traversal(any_hit=False)
    picky = structure.traversal(any_hit=False, accepts=accepts_even_near_edge)
    picky_any = structure.traversal(any_hit=True, accepts=accepts_even_near_edge)

    @kernel
    def refusing(accel: struct, surfaces: Surfaces, rays: RayArrays, exclude: wp.array(dtype=wp.int32), hits: wp.array2d(dtype=float),
                 prim_ids: wp.array2d(dtype=wp.int32)):
        i = wp.tid()
        ray = load_ray(rays, i)
        hit = picky(accel, surfaces, ray)
        hits[1, i] = hit.t
        prim_ids[1, i] = hit.prim_id
        hit = picky_any(accel, surfaces, ray)
        prim_ids[2, i] = hit.prim_id
        ray.exclude_plus_one = exclude[i] + 1
        hit = closest(accel, surfaces, ray)
        hits[0, i] = hit.t
        prim_ids[0, i] = hit.prim_id

    return refusing


def run_refusing(name, geometry, origin, direction, exclude):
    """Return t of the closest hits with an excluded triangle and of the closest accepted hits, (2, N), and prim_id of both and of any
    accepted hit, (3, N)."""
    n = len(origin)
    rays, surfaces = RayArrays(), Surfaces()
    rays.origin, rays.direction = vec3s(origin), vec3s(direction)
    rays.t_min, rays.t_max = floats(np.zeros(n)), floats(np.full(n, np.inf))
    surfaces.n_triangles = len(geometry.faces)
    t, prim_id = zeros((2, n)), zeros((3, n), wp.int32)
    launch(refusing_kernel(name), n, build(geometry, name).data, surfaces, rays, ints(exclude), t, prim_id)
    return t.numpy(), prim_id.numpy()


# The test of a triangle compares prim_id for all structures; each kernel takes seconds to compile.
@pytest.mark.parametrize("name", families_first())
def test_the_excluded_triangle_is_not_hit(name):
    rng = np.random.default_rng(8)
    geometry = soup(rng, 12, 0.6)
    origin, direction = rays_for(geometry, rng, 4000)
    exclude = rng.integers(-1, 12, 4000)
    (t, _), (hit, _, _) = run_refusing(name, geometry, origin, direction, exclude)
    for left_out in range(-1, 12):
        keep = np.delete(np.arange(12), left_out) if left_out >= 0 else np.arange(12)
        rest = Geometry(geometry.vertices, geometry.faces[keep], NO_SPHERES)
        chosen = exclude == left_out
        expected = build(rest, "brute_force").closest_hit(origin[chosen], direction[chosen])
        prim_id = np.where(expected.prim_id >= 0, keep[expected.prim_id], -1)
        assert np.array_equal(hit[chosen], prim_id) and np.array_equal(t[chosen], expected.t)


@pytest.mark.parametrize("name", families_first())
def test_refused_hits_let_the_ray_on(name):
    rng = np.random.default_rng(9)
    geometry = soup(rng, 40, 0.5)
    origin, direction = rays_for(geometry, rng, 4000)
    (_, t), (_, accepted, dark) = run_refusing(name, geometry, origin, direction, np.full(4000, -1))
    # The reference: the closest hit of the even triangles, without hits with u >= 0.75.
    best_t = np.full(4000, np.inf, np.float32)
    best_id = np.full(4000, -1)
    for prim_id in range(0, 40, 2):
        single = Geometry(geometry.vertices, geometry.faces[prim_id : prim_id + 1], NO_SPHERES)
        hit = build(single, "brute_force").closest_hit(origin, direction)
        better = (hit.prim_id == 0) & (hit.u < 0.75) & (hit.t < best_t)
        best_t[better], best_id[better] = hit.t[better], prim_id
    assert np.array_equal(accepted, best_id) and np.array_equal(t, best_t)
    assert np.array_equal(dark >= 0, best_id >= 0)
    assert (best_id >= 0).sum() > 500


def test_scaling_the_direction_scales_t():
    rng = np.random.default_rng(10)
    geometry = soup(rng, 300)
    origin, direction = rays_for(geometry, rng, 3000)
    structure = build(geometry, "bvh")
    reference = structure.closest_hit(origin, direction)
    for power in (-60, -10, 10, 60):
        hits = structure.closest_hit(origin, direction * 2.0**power)
        assert np.array_equal(hits.prim_id, reference.prim_id)
        assert np.array_equal(hits.t, np.ldexp(reference.t, -power))


def test_far_rays_find_a_small_ball():
    # From 100,000 radii away, rays aimed inside the silhouette hit, and rays aimed clearly outside miss.
    rng = np.random.default_rng(11)
    structure = build(icosphere(3), "bvh")
    away = directions(rng, 2000)
    side = unit(np.cross(away, directions(rng, 2000)))
    origin = rounded(away * 1e5)
    for offset, expected in ((0.9, True), (1.1, False)):
        target = side * offset
        assert (structure.any_hit(origin, target - origin) == expected).all()
