"""Batches of rays: the hits have the bits of the kernel for one ray, for any mixture of rays."""

import ctypes
import mmap

import numpy as np
import pytest

from tests.data import data_path
from tests.refused import refused

from tests.kernel_tools import DEVICE, cpu_only, launch, vec3s, zeros  # isort: skip (starts Warp)
import warp as wp

from wrt.accel.bvh.wide_tree import stack_need
from wrt.accel.geometry import Geometry
from wrt.accel.queries.arguments import rays_of
from wrt.accel.queries.batches import FEWEST, LEAST, MOST, SHARES, new_scratch, parts, tracer
from wrt.accel.queries.rays import rays_on
from wrt.accel.scenes.build import build
from wrt.accel.snapshot import Built, Structure, any_hit_kernel, closest_hit_kernel
from wrt.accel.structures import ACCELERATORS
from wrt.io.mesh_file import load_mesh
from wrt.kernels.query import HitArrays, RenderRays, make_render_rays_kernel
from wrt.kernels.structs import Surfaces
from wrt.kernels.traverse.common import Units
from wrt.kernels.wide.batch import MAX_FAILED, PACKETS
from wrt.kernels.wide.layout import LANES, STACK_SIZE
from wrt.kernels.wide.packets import FAILED, MIXED_FAILED, MIXED_PAUSED, PAUSED
from wrt.kernels.wide.references import EMPTY, leaf_reference
from wrt.kernels.wide.stream import BatchTraversal
from wrt.lab.bench.rays import ray_sets
from wrt.scene.mesh import Mesh
from wrt.scene.shapes import icosphere


def new_hits(n):
    hits = HitArrays()
    hits.t, hits.u, hits.v, hits.prim_id = zeros(n), zeros(n), zeros(n), zeros(n, wp.int32)
    return hits


def one_by_one(accel, o, d, t_min, t_max):
    """Return closest hits and any hits by the kernel for one ray."""
    rays, n = rays_on(accel.device, rays_of(o, d, t_min, t_max)[0]), len(o)
    hits = new_hits(n)
    launch(closest_hit_kernel(accel.structure), n, accel.data, accel.snapshot.surfaces, rays, hits, 0)
    dark = zeros(n, wp.bool)
    launch(any_hit_kernel(accel.structure), n, accel.data, accel.snapshot.surfaces, rays, dark, 0)
    return {name: getattr(hits, name).numpy() for name in ("t", "u", "v", "prim_id")}, dark.numpy()


def assert_same(accel, o, d, t_min=0.0, t_max=np.inf, threads=1):
    assert tracer(accel.structure, False).stream is not None
    expected, dark = one_by_one(accel, o, d, t_min, t_max)
    found = accel.closest_hit(o, d, t_min, t_max, threads=threads)
    for name, values in expected.items():
        np.testing.assert_array_equal(getattr(found, name).view(np.int32), values.view(np.int32), err_msg=name)
    np.testing.assert_array_equal(accel.any_hit(o, d, t_min, t_max, threads=threads), dark)
    return expected["prim_id"]


@pytest.fixture(scope="module")
def sphere():
    return build(Geometry.of(icosphere(4)), "bvh8")


def mixed_rays(n, seed=0):
    """Return coherent runs of rays, of all lengths, between incoherent rays."""
    rng = np.random.default_rng(seed)
    run = np.repeat(np.arange(n), rng.integers(1, 40, n))[:n]
    center, towards = 2.5 * rng.normal(size=(n, 3)), rng.normal(size=(n, 3))
    together = rng.random(n) < 0.6
    o = np.where(together[run, None], center[run] + 0.05 * rng.normal(size=(n, 3)), 2.0 * rng.normal(size=(n, 3)))
    aim = np.where(together[run, None], 0.6 * towards[run] + 0.05 * rng.normal(size=(n, 3)), rng.normal(size=(n, 3)))
    return o.astype(np.float32), (aim - o).astype(np.float32), rng.random(n).astype(np.float32) * 0.5, rng.exponential(2.0, n)


@pytest.mark.parametrize("n", [1, 2, 15, 16, 17, 63, 64, 65, 1000])
def test_any_number_of_rays(sphere, n):
    o, d, t_min, t_max = mixed_rays(n, n)
    prim_id = assert_same(sphere, o, d)
    assert_same(sphere, o, d, t_min, np.maximum(t_max, t_min))
    assert n < 1000 or 0.2 < (prim_id >= 0).mean() < 0.9


def before_a_gap(array):
    """Return a copy. Reading or writing behind its end ends the process."""
    size = -(-array.nbytes // mmap.PAGESIZE) * mmap.PAGESIZE
    pages = mmap.mmap(-1, size + mmap.PAGESIZE)
    end = ctypes.addressof(ctypes.c_char.from_buffer(pages)) + size
    assert ctypes.CDLL(None).mprotect(ctypes.c_void_p(end), ctypes.c_size_t(mmap.PAGESIZE), 0) == 0  # PROT_NONE
    out = np.frombuffer(pages, array.dtype, array.size, size - array.nbytes).reshape(array.shape)
    out[:] = array
    return out


def rays_before_a_gap():
    """Return 65 blocks of 16 rays and another ray, in arrays that kernels read in place."""
    o, d, t_min, t_max = mixed_rays(1041)
    return [before_a_gap(each.astype(np.float32)) for each in (o, d, t_min, np.maximum(t_max, t_min))]


def test_nothing_behind_the_arrays_is_read_or_written(sphere):
    rays = rays_before_a_gap()
    assert_same(sphere, *rays)
    sphere.any_hit(*rays, out=before_a_gap(np.zeros(len(rays[0]), bool)))


def test_an_invalid_ray_that_is_the_first_of_its_packet_is_refused(sphere):
    o, d, _, _ = mixed_rays(4 * LANES)
    o[::LANES] = np.nan
    with refused("origins"):
        sphere.closest_hit(o, d)


@cpu_only
@pytest.mark.parametrize("threads", [1, 2, 3])
def test_more_rays_than_a_launch(sphere, threads):
    free = tracer(sphere.structure, False).workers.free
    free.clear()
    o, d, _, _ = mixed_rays(150_001)
    for _ in range(3):
        assert_same(sphere, o, d, threads=threads)
    assert 1 <= len(free) <= threads  # Working memory is reused.
    assert all(array.ptr % 64 == 0 for worker in free for array in (worker.scratch.packets, worker.scratch.stacks))


@pytest.mark.parametrize("threads", [1, 2, 3, 16])
@pytest.mark.parametrize("n", [FEWEST + 1, 100_000, 150_001, 5_000_000])
def test_launches_are_long_at_first_and_short_in_the_end(n, threads):
    ranges = parts(n, threads, 64)
    first, end = np.array(ranges).T
    assert first[0] == 0 and end[-1] == n and (first[1:] == end[:-1]).all() and (end[:-1] % 64 == 0).all()
    size = end - first
    assert size.max() <= MOST and (np.diff(size) <= 0).all() and size[:-1].min(initial=MOST) >= LEAST
    if threads > 1:
        assert len(ranges) > threads or size[0] == LEAST
        assert size[-1] <= LEAST and size[0] * threads <= max(n / SHARES + 64 * threads, LEAST * threads)


def test_no_rays(sphere):
    none = np.zeros((0, 3), np.float32)
    assert len(sphere.closest_hit(none, none)) == 0 and len(sphere.any_hit(none, none)) == 0


def test_strided_arrays_are_read_with_their_gaps(sphere):
    o, d, _, t_max = mixed_rays(400)
    t_max = t_max.astype(np.float32)
    expected = sphere.closest_hit(o[::2], d[::2], 0.0, t_max[::2])
    assert not vec3s(o)[::2].is_contiguous
    found = sphere.closest_hit(vec3s(o)[::2], vec3s(d)[::2], 0.0, wp.array(t_max, dtype=wp.float32, device=DEVICE)[::2]).numpy()
    np.testing.assert_array_equal(found.prim_id, expected.prim_id)
    np.testing.assert_array_equal(found.t, expected.t)


@pytest.mark.parametrize("kind", ["primary", "shadow", "diffuse", "random"])
def test_the_rays_of_the_benchmarks(sphere, kind):
    rays = ray_sets(sphere, 20_000)[kind]
    assert_same(sphere, rays.origins, rays.directions, 0.0, rays.t_max)


def soup(corners):
    """Return triangles without shared vertices from their corners."""
    return Mesh(corners.reshape(-1, 3).astype(np.float32), np.arange(corners.size // 3, dtype=np.int32).reshape(-1, 3))


def crowd(seed=1):
    """Return many triangles in few places: leaves of several rows, ties in t, thin triangles, triangles without area, and fans, whose
    triangles all have the same box."""
    rng = np.random.default_rng(seed)
    place, fan = rng.normal(size=(6, 3, 3)), rng.random((36, 3, 3))
    fan[:, 0], fan[:, 1] = 0.0, 1.0
    flat = place[:, :1] + [[[0, 0, 0], [1, 0, 0], [2, 0, 0]]]
    thin = rng.normal(size=(200, 1, 3)) + 1e-6 * rng.normal(size=(200, 3, 3))
    corners = np.concatenate([np.repeat(place, 60, axis=0), flat, thin, rng.normal(size=(300, 3, 3)), fan - 2.0, fan])
    return soup(corners)


@pytest.mark.parametrize("max_leaf", [8, 64])
def test_leaves_of_several_rows_and_ties(max_leaf):
    accel = build(Geometry.of(crowd()), "bvh8", max_leaf=max_leaf)
    o, d, t_min, t_max = mixed_rays(20_000, 3)
    prim_id = assert_same(accel, o, d)
    assert_same(accel, o, d, t_min, np.maximum(t_max, t_min))
    assert (np.unique(prim_id) >= 360).any() and (prim_id[prim_id >= 0] < 360).any()


@pytest.mark.parametrize("count", [1, 2, 9])
def test_trees_of_one_leaf(count):
    accel = build(Geometry.of(soup(crowd().vertices[-3 * count :])), "bvh8")
    o, d, _, _ = mixed_rays(3000, 4)
    assert_same(accel, o, d)


def chain(k):
    """Return a tree that needs a whole stack. All but one of a node's k children are leaves of one triangle, and every box is the
    root's."""
    counts = [k] * (STACK_SIZE // (k - 1)) + [STACK_SIZE % (k - 1) + 1] * (STACK_SIZE % (k - 1) > 0)
    children = np.zeros((len(counts), 8), np.int32)
    for i, count in enumerate(counts):
        children[i, 8 - count :] = -1
        children[i, 7] = i + 1 if i + 1 < len(counts) else -1
    n = int((children < 0).sum())
    children[children < 0] = leaf_reference.func(np.arange(n), 1)
    mesh = soup(np.random.default_rng(8).normal(size=(n, 3, 3)))
    nodes = np.zeros((len(counts), 8, 8), np.float32)
    nodes[:, 0:6:2] = np.where(children[:, None] != EMPTY, mesh.vertices.min() - 1.0, np.inf)
    nodes[:, 1:6:2] = np.where(children[:, None] != EMPTY, mesh.vertices.max() + 1.0, -np.inf)
    nodes[:, 6] = children.view(np.float32)
    assert stack_need(children) == STACK_SIZE
    built = Built({"nodes": nodes.reshape(-1)}, np.arange(n, dtype=np.int32), len(counts), n, len(counts))
    return ACCELERATORS["bvh8"].restore(built, Geometry.of(mesh))


@pytest.mark.parametrize("k", [2, 3, 8])
def test_trees_that_need_a_whole_stack(k):
    accel = chain(k)
    for n in (1, 2000):
        o, d, _, _ = mixed_rays(n, 9)
        assert_same(accel, o, d)
    rng = np.random.default_rng(10)
    assert_same(accel, rng.normal(size=(64, 3)) * 0.1 - 5.0, 1.0 + 0.3 * rng.random((64, 3)))


def test_rays_that_are_special(sphere):
    # They run along axes and through vertices, with very long and very short directions, or have empty segments.
    rng = np.random.default_rng(7)
    vertices = sphere.geometry.vertices
    n = 20_000
    o = rng.choice(np.array([0.0, -0.0, 1.0, -1.0, 3.0, -2.5, 1e30]), (n, 3))
    d = np.where(rng.random((n, 1)) < 0.5, vertices[rng.integers(len(vertices), size=n)] - o,
                 rng.choice(np.array([0.0, -0.0, 1.0, -1.0, 1e-40]), (n, 3)))
    d = np.where(d.any(axis=1, keepdims=True), d, 1.0) * rng.choice(np.array([1.0, 1e-25, 1e20]), (n, 1))
    t_max = rng.choice(np.array([np.inf, 0.0, 1.0, -1.0, 1e30]), n)
    with np.errstate(over="ignore"):
        o, d = o.astype(np.float32), np.where(np.isfinite(d.astype(np.float32)), d, 1.0).astype(np.float32)
    d[~d.any(axis=1)] = 1.0
    assert_same(sphere, o, d)
    assert_same(sphere, o, d, 0.0, t_max)


def test_moved_vertices(sphere):
    accel = build(Geometry.of(icosphere(3)), "bvh8")
    accel.refit(accel.geometry.vertices * np.float32([1.0, 2.0, 0.5]))
    o, d, _, _ = mixed_rays(5000)
    assert_same(accel, o, d)


@cpu_only
@pytest.mark.parametrize(("any_hit", "side"), [(False, 1.0), (True, 1.0), (True, -1.0)], ids=["closest", "any", "any, signs differ"])
def test_packets_are_given_up_where_they_fall_apart(any_hit, side):
    # Triangles far smaller than the distance of the rays: the answers are the same before and after.
    accel = build(Geometry.of(icosphere(6)), "bvh8")
    rays = ray_sets(accel, 6_000)["primary"]
    assert_same(accel, rays.origins, rays.directions)
    # Packets of nearly parallel rays that are far from each other fall apart. Packets of neighbouring rays do not.
    n = PACKETS * LANES
    apart = np.random.default_rng(7).uniform(-1.0, 1.0, (n, 2)).astype(np.float32)
    for xy, failed in ((apart, MAX_FAILED - 1), (0.3 + 0.001 * apart, 0)):
        o = np.concatenate([xy, np.full((n, 1), 3.0, np.float32)], axis=1)
        scratch = new_scratch(BatchTraversal.stream_sizes)
        d = np.tile([0.001, 0.001, -1.0], (n, 1)) * np.where(np.arange(n) % 2, side, 1.0)[:, None] ** [1, 1, 0]
        assert_same(accel, o, d)
        rays = rays_on(accel.device, rays_of(o, d, 0.0, np.inf)[0])
        out = wp.zeros(n, dtype=wp.bool, device=DEVICE) if any_hit else new_hits(n)
        inputs = [accel.data, accel.snapshot.surfaces, rays, out, scratch, 0, n]
        wp.launch(tracer(accel.structure, any_hit).kernel, 1, inputs, device=DEVICE)
        report = scratch.report.numpy()
        counted, others = (FAILED, PAUSED), (MIXED_FAILED, MIXED_PAUSED)
        if side < 0.0:
            counted, others = others, counted
        assert report[counted[0]] == failed and (report[counted[1]] > 0) == (failed > 0) and not report[list(others)].any()


def test_units_without_lanes_have_no_stream():
    bvh8 = ACCELERATORS["bvh8"]
    for units in (Units(triangle="moeller_trumbore"), Units(box="plain"), Units(observer="sum"), Units(resumes=True)):
        assert tracer(Structure(bvh8, units), False).stream is None
    assert tracer(Structure(ACCELERATORS["bvh2"]), False).stream is None
    assert tracer(Structure(bvh8, Units(box="minmax")), True).stream is not None


@pytest.mark.slow
@pytest.mark.parametrize("name", ["medium/stanford_bunny.ply", "medium/sponza_dabrovic.obj", "large/conference_331k.ply",
                                  "large/dragon_871k.ply"])
def test_a_million_rays(name):
    accel = build(Geometry.of(load_mesh(data_path(f"meshes/{name}"))), "bvh8")
    for inside in (False, True):
        for rays in ray_sets(accel, 125_000, inside=inside).values():
            assert_same(accel, rays.origins, rays.directions, 0.0, rays.t_max)


def assert_picture_rays_as_one_ray(accel, o, d, t_max, exclude, accepts=None):
    """Trace RenderRays by the kernel for many rays and by the kernel for one ray; return the closest hits' prim_id."""
    rays = RenderRays()
    rays.origin, rays.direction = vec3s(o), vec3s(d)
    rays.t_min, rays.t_max = zeros(len(o)), wp.array(t_max.astype(np.float32), dtype=wp.float32, device=DEVICE)
    rays.exclude = wp.array(exclude, dtype=wp.int32, device=DEVICE)
    structure = accel.structure
    for any_hit in (True, False):
        many = structure.accel.kernels.make_stream(structure.units, any_hit, RenderRays, accepts)
        one = make_render_rays_kernel(structure.struct, structure.traversal(any_hit=any_hit, accepts=accepts), any_hit)
        scratch, answers = new_scratch(BatchTraversal.stream_sizes), []
        for kernel, threads, more in ((many, 1, [scratch]), (one, len(o), [])):
            hits = new_hits(len(o))
            out = zeros(len(o), wp.bool) if any_hit else hits
            wp.launch(kernel, threads, [accel.data, accel.snapshot.surfaces, rays, out, *more, 0, len(o)], device=DEVICE)
            arrays = [out] if any_hit else [hits.t, hits.u, hits.v, hits.prim_id]
            answers.append(np.concatenate([array.numpy().view(np.uint8) for array in arrays]))
        np.testing.assert_array_equal(*answers)
    return hits.prim_id.numpy()


@cpu_only
def test_rays_of_a_picture_leave_out_what_they_start_on():
    """The scene is a mesh with spheres in its leaves."""
    mesh = icosphere(3)
    spheres = np.array([[1.0, 0.2, 0.0, 0.3], [0.0, -1.0, 0.1, 0.25], [0.4, 0.4, 0.9, 0.01]], np.float32)
    accel = build(Geometry(mesh.vertices, mesh.faces, spheres), "bvh8")
    o, d, _, t_max = mixed_rays(4000, 3)
    first = accel.closest_hit(o, d).prim_id
    assert (first >= len(mesh.faces)).any() and (first < 0).any()
    whole, without = (assert_picture_rays_as_one_ray(accel, o, d, t_max, exclude) for exclude in (np.zeros_like(first), first + 1))
    assert (whole != without).any()


@wp.func
def one_in_three(surfaces: Surfaces, prim_id: int, u: float, v: float) -> bool:
    return (wp.cast(u, wp.int32) ^ wp.cast(v, wp.int32) ^ prim_id) % 3 == 0


@cpu_only
def test_hits_that_are_not_accepted_are_passed():
    """Many triangles of a row are hit, and `accepts` often refuses the nearest, as it does for cut-outs."""
    mesh, spheres = crowd(), np.array([[0.5, 0.5, 0.5, 0.2]], np.float32)
    accel = build(Geometry(mesh.vertices, mesh.faces, spheres), "bvh8")
    o, d, _, t_max = mixed_rays(4000, 4)
    nearest = accel.closest_hit(o, d).prim_id
    for exclude in (np.zeros_like(nearest), nearest + 1):
        accepted = assert_picture_rays_as_one_ray(accel, o, d, t_max, exclude, one_in_three)
        assert ((accepted >= 0) & (accepted != nearest)).sum() > 100
