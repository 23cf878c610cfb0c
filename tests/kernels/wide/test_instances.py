"""Batches through instances and worlds: the hits have the bits of the kernel for one ray, for any mixture of rays."""

from functools import cache

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tests.kernel_tools import cpu_only, launch, zeros
from tests.kernels.wide.test_batch import assert_same, before_a_gap, mixed_rays, new_hits, rays_before_a_gap
from tests.refused import refused

import wrt  # isort: skip (after Warp is started)
import warp as wp

from wrt.accel.queries.answers import ANY_HIT_TYPES, HIT_TYPES, answer_arrays
from wrt.accel.queries.arguments import check_world, rays_of
from wrt.accel.queries.batches import Query, new_scratch, trace_one_by_one, tracer, world_tracer
from wrt.accel.scenes.flatten import flatten
from wrt.accel.scenes.instancing import instanced_meshes
from wrt.accel.snapshot import Structure
from wrt.accel.structures import ACCELERATORS
from wrt.kernels.query import RenderRays, make_render_rays_kernel
from wrt.kernels.traverse.common import Units
from wrt.kernels.wide.stream import BatchTraversal
from wrt.scene.shapes import icosphere

pytestmark = cpu_only


def placed(rng, scale):
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.random(random_state=rng.integers(1 << 30)).as_matrix() @ np.diag(scale * rng.choice([-1.0, 1.0], 3))
    matrix[:3, 3] = rng.normal(size=3)
    return matrix


def scene(count, seed, spheres=0):
    """Return balls of two meshes, some of them sheared, mirrored or twice at the same place, and a mesh that fits no other."""
    rng = np.random.default_rng(seed)
    meshes = [icosphere(3), icosphere(2), wrt.Mesh([[-3, -3, -2], [3, -3, -2], [0, 3, -2]], [[0, 1, 2]])]
    objects = [wrt.Object(meshes[i % 2], wrt.Material(), transform=placed(rng, rng.uniform(0.1, 0.4, 3))) for i in range(count)]
    objects += [wrt.Object(each.mesh, wrt.Material(), transform=each.transform) for each in objects[:3]]
    balls = [wrt.Sphere(tuple(rng.normal(size=3)), 0.3, wrt.Material()) for _ in range(spheres)]
    return wrt.Scene([*objects, wrt.Object(meshes[2], wrt.Material())], spheres=balls)


@cache
def one_world(count):
    return wrt.build([scene(count, count)], threads=1)


@pytest.mark.parametrize("count", [1, 7, 60])
@pytest.mark.parametrize("n", [1, 63, 4000])
def test_hits_have_the_bits_of_one_ray(count, n):
    accel = one_world(count)
    o, d, t_min, t_max = mixed_rays(n, n)
    prim_id = assert_same(accel, o, d)
    assert_same(accel, o, d, t_min, np.maximum(t_max, t_min))
    assert n < 1000 or (prim_id >= 0).mean() > 0.1


def test_axis_parallel_rays_and_far_origins():
    accel, (o, d, _, _) = one_world(60), mixed_rays(3000, 5)
    along = np.eye(3, dtype=np.float32)[np.arange(len(o)) % 3] * np.where(np.arange(len(o)) % 2, 1, -1)[:, None]
    assert_same(accel, o, along)
    assert_same(accel, o, np.where(np.arange(len(o))[:, None] % 40 < 20, along * np.float32(-0.0) + d, along))
    assert_same(accel, -4e5 * d, d)
    assert_same(accel, o[:100] * np.float32(1e20), -o[:100])  # rays that test all triangles


@pytest.mark.parametrize("size", [1e-30, 1e-12, 1e12, 1e24])
def test_directions_are_scaled_between_spaces_of_different_size(size):
    rng = np.random.default_rng(3)
    mesh = wrt.Mesh(icosphere(2).vertices * np.float32(size), icosphere(2).faces)
    objects = [wrt.Object(mesh, wrt.Material(), transform=placed(rng, 0.5 / size)) for _ in range(5)]
    accel = wrt.build([wrt.Scene(objects)])
    o, d, t_min, t_max = mixed_rays(1000, 6)
    assert (assert_same(accel, o, d, t_min, np.maximum(t_max, t_min)) >= 0).any()
    assert_same(accel, o, d * np.float32(1e-30))


@pytest.mark.parametrize("kind", ["bvh2", "bvh8"])
@pytest.mark.parametrize("sign", [-1, 1])
def test_a_scene_of_another_size_has_the_same_hits(kind, sign):
    rng, mesh, size, length = np.random.default_rng(9), icosphere(2), 2.0 ** (56 * sign), 2.0 ** (-40 * sign)
    matrices = [placed(rng, rng.uniform(0.1, 0.4, 3)) for _ in range(12)]
    o, d, t_min, _ = mixed_rays(1000, 11)
    worlds = [wrt.Scene([wrt.Object(mesh, wrt.Material(), transform=np.diag([s, s, s, 1.0]) @ matrix) for matrix in matrices])
              for s in (1.0, size)]
    accel = wrt.build(worlds, kind)
    for low in (0.0, t_min):
        ours = accel.closest_hit(o, d, low, world=0)
        scaled = accel.closest_hit(o * np.float32(size), d * np.float32(length), low * np.float32(size / length), world=1)
        np.testing.assert_array_equal(scaled.prim_id, ours.prim_id)
        np.testing.assert_array_equal(scaled.t, ours.t * np.float32(size / length))
        assert (ours.prim_id >= 0).mean() > 0.1


@pytest.mark.parametrize("kind", ["bvh2", "bvh8"])
def test_hits_whose_t_round_to_the_same_number_do_not_depend_on_the_order_of_visits(kind):
    """At t below 2^-126, the hits of several instances have the same t in world space and different ones in their own spaces."""
    rng = np.random.default_rng(5)
    mesh, matrices = icosphere(1), [np.diag([*1e-30 * rng.uniform(0.5, 1.5, 3), 1.0]) for _ in range(8)]
    worlds = [wrt.Scene([wrt.Object(mesh, wrt.Material(), transform=matrix) for matrix in some])
              for some in (matrices, *([matrix] for matrix in matrices))]
    accel, n = wrt.build(worlds, kind), 600
    o = (rng.normal(size=(n, 3)) * 3e-30).astype(np.float32)
    d = ((rng.normal(size=(n, 3)) * 1e-30 - o) * 10.0 ** rng.uniform(37.0, 48.0, (n, 1))).astype(np.float32)
    t_max = np.where(np.arange(n) % 2, np.float32(np.inf), (10.0 ** rng.uniform(-45.0, -40.0, n)).astype(np.float32))
    alone = [accel.closest_hit(o, d, 0.0, t_max, world=1 + i) for i in range(len(matrices))]
    ids = np.stack([np.where(each.prim_id < 0, 1 << 30, each.prim_id + i * len(mesh.faces)) for i, each in enumerate(alone)])
    first = np.lexsort((ids, np.stack([each.t for each in alone])), axis=0)[0]
    found, rows = accel.closest_hit(o, d, 0.0, t_max, world=0), np.arange(n)
    np.testing.assert_array_equal(found.prim_id, np.where(ids.min(axis=0) < 1 << 30, ids[first, rows], -1))
    np.testing.assert_array_equal(found.t, np.stack([each.t for each in alone])[first, rows])
    np.testing.assert_array_equal(accel.any_hit(o, d, 0.0, t_max, world=0), found.prim_id >= 0)
    assert ((found.t > 0.0) & (found.t < 2.0**-126)).sum() > 50


def test_moved_instances():
    accel, rng = wrt.build([scene(30, 1)], threads=1), np.random.default_rng(8)
    o, d, _, _ = mixed_rays(1000, 7)
    for rebuild_at in (np.inf, 0.0):
        accel.move(np.arange(20), np.stack([placed(rng, [0.3, 0.2, 0.1]) for _ in range(20)]), rebuild_at)
        assert_same(accel, o, d)


@pytest.mark.parametrize("together", [1, 16, 50, 4000])
def test_rays_of_several_worlds(together):
    accel = wrt.build([scene(5, 0), icosphere(1), scene(1, 3), scene(20, 4)], threads=1)
    o, d, t_min, t_max = mixed_rays(4000, 9)
    ids = wp.array(np.random.default_rng(0).integers(-1, 6, 4000).repeat(together)[:4000].astype(np.int32), device="cpu")
    rays, worlds = rays_of(o, d, t_min, np.maximum(t_max, t_min))[0], check_world(accel.snapshot, (4000,), ids)
    for types, query in ((HIT_TYPES, accel.closest_hit), (ANY_HIT_TYPES, accel.any_hit)):
        assert world_tracer(accel.structure, types is ANY_HIT_TYPES).stream is not None
        expected = answer_arrays(types, None, (4000,), None)
        trace_one_by_one(accel.snapshot, Query(rays, expected, 1, worlds))
        for threads, some in ((1, slice(None)), (2, slice(None)), (1, slice(705))):  # 705: the last packet has one ray
            found = query(o[some], d[some], t_min[some], np.maximum(t_max, t_min)[some], threads, world=ids[some])
            found = [found.t, found.u, found.v, found.prim_id] if types is HIT_TYPES else [found]
            for mine, theirs in zip(found, expected, strict=True):
                np.testing.assert_array_equal(mine, np.asarray(theirs)[some])
    np.testing.assert_array_equal(accel.any_hit(o, d, world=3), accel.any_hit(o, d, world=np.full(4000, 3)))


def test_nothing_behind_the_arrays_is_read_or_written():
    accel, rays = wrt.build([scene(5, 0), icosphere(1)], threads=1), rays_before_a_gap()
    assert_same(one_world(7), *rays)
    ids = np.random.default_rng(0).integers(0, 2, len(rays[0])).astype(np.int32)
    found = accel.closest_hit(*rays, world=wp.array(before_a_gap(ids), device="cpu", copy=False))
    np.testing.assert_array_equal(found.t, accel.closest_hit(*rays, world=ids).t)


def test_an_invalid_ray_that_is_the_first_of_its_packet_is_refused():
    o, d, _, _ = mixed_rays(64)
    o[::16] = np.nan
    with refused("origins"):
        one_world(7).closest_hit(o, d)


def test_an_empty_world_is_missed():
    accel = wrt.build([scene(3, 0), wrt.Scene([])])
    o, d, _, _ = mixed_rays(200, 2)
    assert not accel.any_hit(o, d, world=1).any() and accel.any_hit(o, d, world=0).any()


@pytest.mark.parametrize("any_hit", [False, True])
def test_rays_of_pictures(any_hit):
    objects = scene(40, 2, spheres=3)
    accel = wrt.build(flatten(objects, instanced_meshes(objects, "always")).geometry)
    assert accel.structure.units.instances and accel.structure.units.spheres
    o, d, _, t_max = mixed_rays(3000, 4)
    first = accel.closest_hit(o, d).prim_id
    rays = RenderRays()
    rays.origin, rays.direction = wp.array(o, dtype=wp.vec3, device="cpu"), wp.array(d, dtype=wp.vec3, device="cpu")
    rays.t_min, rays.t_max = wp.zeros(3000, dtype=wp.float32, device="cpu"), wp.array(t_max, dtype=wp.float32, device="cpu")
    rays.exclude = wp.array(first + 1, dtype=wp.int32, device="cpu")
    structure, answers = accel.structure, []
    one = make_render_rays_kernel(structure.struct, structure.traversal(any_hit=any_hit), any_hit)
    many = structure.accel.stream.make_stream(structure.units, any_hit, RenderRays)
    for kernel, threads, own in ((one, 3000, []), (many, 1, [new_scratch(BatchTraversal.stream_sizes)])):
        out = zeros(3000, wp.bool) if any_hit else new_hits(3000)
        launch(kernel, threads, accel.data, accel.snapshot.surfaces, rays, out, *own, 0, 3000)
        answers.append([out.numpy()] if any_hit else [getattr(out, name).numpy() for name in ("t", "u", "v", "prim_id")])
    for mine, theirs in zip(*answers, strict=True):
        np.testing.assert_array_equal(mine, theirs)
    assert len({*answers[0][-1].tolist()}) > 1


def test_without_a_vectorised_form_one_ray_is_traced_at_a_time():
    units = Units(instances=True)
    for each in (units._replace(observer="sum"), units._replace(triangle="moller_trumbore"), units._replace(box="minmax")):
        assert BatchTraversal().make_stream(each, False) is None
    assert BatchTraversal().make_stream(units, False, RenderRays, accepts=lambda *_: True) is None
    assert tracer(Structure(ACCELERATORS["bvh2"], units), False).stream is None
