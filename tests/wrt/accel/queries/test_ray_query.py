"""Ray queries inside the user's own kernels."""

import ctypes
from collections.abc import Callable
from functools import partial

import numpy as np
import pytest
import warp as wp

import wrt
from tests.kernel_tools import DEVICE, cpu_only, floats, launch, vec3s, zeros
from tests.refused import refused
from tests.wrt.accel.queries.test_all_hits import rays, soup
from wrt.scene import shapes


def make_kernel(query, decorate):
    """Make a kernel that calls closest_hit and any_hit for each ray."""

    def asking(world: query.World, origins: wp.array(dtype=wp.vec3), directions: wp.array(dtype=wp.vec3),
               t_min: wp.array(dtype=float), t_max: wp.array(dtype=float), t: wp.array(dtype=float),
               prim_id: wp.array(dtype=int), occluded: wp.array(dtype=wp.bool)):
        i = wp.tid()
        ray = query.ray(origins[i], directions[i])
        ray.t_min = t_min[i]
        ray.t_max = t_max[i]
        hit = query.closest_hit(world, ray)
        t[i] = hit.t
        prim_id[i] = hit.prim_id
        occluded[i] = query.any_hit(world, ray)

    return decorate(asking)


def answers(kernel, accel, asked):
    t, prim_id, occluded = zeros(len(asked[0])), zeros(len(asked[0]), wp.int32), zeros(len(asked[0]), wp.bool)
    launch(kernel, len(asked[0]), accel.world, vec3s(asked[0]), vec3s(asked[1]), floats(asked[2]), floats(asked[3]), t, prim_id,
           occluded)
    return t.numpy(), prim_id.numpy(), occluded.numpy()


@pytest.mark.parametrize("name", ["bvh", "bvh2", "kdtree"])
def test_a_kernel_has_the_bits_of_closest_hit(name: str) -> None:
    rng = np.random.default_rng(3)
    mesh = soup(rng)
    asked, accel = rays(rng, mesh, 20_000), wrt.build(mesh, name)
    t, prim_id, occluded = answers(make_kernel(wrt.ray_query(name), wrt.kernel), accel, asked)
    hits = accel.closest_hit(*asked)
    assert np.array_equal(t.view(np.int32), hits.t.view(np.int32)) and np.array_equal(prim_id, hits.prim_id)
    assert np.array_equal(occluded, accel.any_hit(*asked)) and 0.2 < occluded.mean() < 0.99


def test_one_query_is_for_all_structures_of_a_kind_and_follows_a_refit() -> None:
    query, accel = wrt.ray_query("bvh"), wrt.build(shapes.icosphere(2))
    assert wrt.ray_query(accel) == query
    kernel = make_kernel(query, wrt.kernel)
    asked = np.zeros((1, 3), np.float32), np.float32([[0.1, 0.2, 3.0]]), np.zeros(1, np.float32), np.full(1, np.inf, np.float32)
    before = answers(kernel, accel, asked)[0][0]
    accel.refit(2.0 * accel.geometry.vertices)
    assert np.isclose(answers(kernel, accel, asked)[0][0], 2.0 * before)


def by_world(query):
    """Make a kernel that finds the closest hit and all further hits of each ray in its world."""

    @wrt.kernel
    def each_world(world: query.World, origins: wp.array(dtype=wp.vec3), directions: wp.array(dtype=wp.vec3),
                   ids: wp.array(dtype=int), t: wp.array(dtype=float), prim_id: wp.array(dtype=int),
                   occluded: wp.array(dtype=wp.bool), count: wp.array(dtype=int)):
        i = wp.tid()
        ray = query.ray(origins[i], directions[i])
        ray.world = ids[i]
        hit = query.closest_hit(world, ray)
        t[i] = hit.t
        prim_id[i] = hit.prim_id
        occluded[i] = query.any_hit(world, ray)
        while hit.prim_id >= 0:
            count[i] += 1
            hit = query.next_hit(world, ray, hit)

    return each_world


@pytest.mark.parametrize("name", ["bvh", "bvh2"])
def test_rays_of_a_kernel_see_worlds_and_instances(name: str) -> None:
    rng = np.random.default_rng(5)
    mesh, moved = soup(rng), np.eye(4)
    moved[:3] = rng.normal(size=(3, 4))
    scene = wrt.Scene([wrt.Object(mesh, wrt.Material()), wrt.Object(mesh, wrt.Material(), transform=moved)])
    accel, n = wrt.build([shapes.icosphere(2), scene], name), 5000
    o, d, *_ = rays(rng, mesh, n)
    ids = rng.integers(-1, 3, n).astype(np.int32)
    t, prim_id, occluded, count = zeros(n), zeros(n, wp.int32), zeros(n, wp.bool), zeros(n, wp.int32)
    ints = wp.array(ids, dtype=wp.int32, device=DEVICE)
    launch(by_world(wrt.ray_query(accel)), n, accel.world, vec3s(o), vec3s(d), ints, t, prim_id, occluded, count)
    hits = accel.closest_hit(o, d, world=ints)
    assert np.array_equal(t.numpy().view(np.int32), hits.t.view(np.int32)) and np.array_equal(prim_id.numpy(), hits.prim_id)
    assert np.array_equal(occluded.numpy(), accel.any_hit(o, d, world=ints)) and 0.2 < occluded.numpy().mean() < 0.9
    expected = wrt.count_hits(wrt.build(shapes.icosphere(2), name), o[ids == 0], d[ids == 0])
    assert np.array_equal(count.numpy()[ids == 0], expected)
    assert not count.numpy()[(ids < 0) | (ids > 1)].any() and (count.numpy()[ids == 1] > 2).any()


@cpu_only
@pytest.mark.parametrize("make, flags, structure", [
    (partial(wp.kernel, enable_backward=False, module="unique"), "", "bvh2"), (wrt.kernel, "-O1", "bvh2"),
    (wrt.kernel, "-ffp-contract=fast", "bvh2"),
    *((wrt.kernel, "-ffast-math", each) for each in ("bvh2", "bvh4", "bvh8", "bvh8c", "kdtree"))])
def test_a_kernel_with_inexact_arithmetic_says_so_and_hits_nothing(make: Callable[..., wp.Kernel], flags: str, structure: str,
        monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]) -> None:
    accel = wrt.build(shapes.icosphere(1), structure)
    asked = np.zeros((1, 3), np.float32), np.ones((1, 3), np.float32), np.zeros(1, np.float32), np.full(1, np.inf, np.float32)
    monkeypatch.setattr(wp.config, "cpu_compiler_flags", f"{wp.config.cpu_compiler_flags} {flags}")
    t, prim_id, occluded = answers(make_kernel(wrt.ray_query(accel), make), accel, asked)
    ctypes.CDLL(None).fflush(None)
    printed = capfd.readouterr().out
    if flags == "-O1":
        assert printed == "" and np.isfinite(t[0]) and prim_id[0] >= 0 and occluded[0]
    else:
        assert "must be made with wrt.kernel, and without fast_math" in printed
        assert (prim_id[0], occluded[0]) == (-1, False) and (np.isinf(t[0]) or "fast" in flags)  # fast maths has no inf


def test_a_world_of_another_kind_is_told_and_hits_nothing(capfd: pytest.CaptureFixture[str]) -> None:
    # Both structs have the same size, so that Warp accepts the argument.
    mesh = shapes.icosphere(1)
    asked = np.zeros((1, 3), np.float32), np.ones((1, 3), np.float32), np.zeros(1, np.float32), np.full(1, np.inf, np.float32)
    kernel = make_kernel(wrt.ray_query("bvh2"), wrt.kernel)
    assert np.isfinite(answers(kernel, wrt.build(mesh, "bvh2"), asked)[0][0])
    assert np.isinf(answers(kernel, wrt.build(mesh, "bvh2", triangle="moeller_trumbore"), asked)[0][0])
    wp.synchronize()
    ctypes.CDLL(None).fflush(None)
    assert "accel.world is of another structure or triangle test" in capfd.readouterr().out


def test_what_is_refused() -> None:
    ball, sphere = wrt.build(shapes.icosphere(1)), wrt.build(wrt.Scene(spheres=(wrt.Sphere((0.0, 0.0, 0.0), 1.0),)))
    for arguments, options, said in ((("bvh",), {"triangle": ["watertight"]}, "triangle"), (("bvh",), {"box": "round"}, "box"),
                                     ((ball,), {"box": "watertight"}, "box"), (("bvg",), {}, "accel"), ((3,), {}, "accel")):
        with refused(said):
            wrt.ray_query(*arguments, **options)
    for ask in (lambda: wrt.ray_query(sphere), lambda: wrt.all_hits(sphere, np.zeros((1, 3)), np.ones((1, 3)))):
        with refused("accel", "without spheres", hint="icosphere"):
            ask()
