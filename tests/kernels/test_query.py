"""The kernels over arrays of rays: which entries they write, and the values of a miss."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.kernel_tools import DEVICE, floats, vec3s, zeros  # isort: skip (starts Warp)
from tests.structures import STRUCTURES, families_first  # isort: skip
import warp as wp

from wrt.accel.scenes.build import build
from wrt.accel.snapshot import Structure
from wrt.accel.structures import ACCELERATORS
from wrt.kernels.query import HitArrays, RayArrays, make_any_hit_kernel, make_closest_hit_kernel
from wrt.kernels.structs import Ray, Surfaces, kernel, make_ray
from wrt.kernels.units.triangle import RAY_TRIANGLE
from wrt.scene.mesh import Mesh

TRIANGLE = Mesh([[-1, -1, 0], [1, -1, 0], [0, 1, 0]], [[0, 1, 2]])


def ray_arrays():
    """Ten rays along +z from z = -2. Even rays meet the triangle at t = 2, but the segments of rays 4 and 6 exclude it. Odd rays miss."""
    rays = RayArrays()
    origin = np.zeros((10, 3))
    origin[:, 2] = -2.0
    origin[1::2, 0] = 5.0
    rays.origin = vec3s(origin)
    rays.direction = vec3s(np.broadcast_to([0.0, 0.0, 1.0], (10, 3)))
    t_min, t_max = np.zeros(10), np.full(10, np.inf)
    t_max[4], t_min[6] = 1.5, 2.5
    rays.t_min, rays.t_max = floats(t_min), floats(t_max)
    return rays


def surfaces():
    out = Surfaces()
    out.n_triangles = 1
    return out


@pytest.mark.parametrize("name", STRUCTURES)
def test_only_the_rows_asked_for_are_written(name):
    structure = Structure(ACCELERATORS[name])
    closest = make_closest_hit_kernel(structure.struct, structure.traversal(any_hit=False))
    anything = make_any_hit_kernel(structure.struct, structure.traversal(any_hit=True))
    data = build(TRIANGLE, name).data
    hits = HitArrays()
    hits.t, hits.u, hits.v = (floats(np.full(10, -7.0)) for _ in range(3))
    hits.prim_id = wp.full(10, -7, dtype=wp.int32, device=DEVICE)
    dark = zeros(10, wp.bool)
    wp.launch(closest, dim=7, inputs=[data, surfaces(), ray_arrays(), hits, 2], device=DEVICE)
    wp.launch(anything, dim=7, inputs=[data, surfaces(), ray_arrays(), dark, 2], device=DEVICE)
    hit = np.array([2, 8])
    miss = np.array([3, 4, 5, 6, 7])
    untouched = np.array([0, 1, 9])
    assert (hits.prim_id.numpy()[hit] == 0).all() and (hits.t.numpy()[hit] == 2.0).all()
    assert np.allclose(hits.u.numpy()[hit], 0.25) and np.allclose(hits.v.numpy()[hit], 0.5)
    assert (hits.prim_id.numpy()[miss] == -1).all() and np.isinf(hits.t.numpy()[miss]).all()
    assert (hits.u.numpy()[miss] == 0.0).all() and (hits.v.numpy()[miss] == 0.0).all()
    for array in (hits.t, hits.u, hits.v, hits.prim_id):
        assert (array.numpy()[untouched] == -7).all()
    assert np.array_equal(np.nonzero(dark.numpy())[0], hit)


@settings(max_examples=40, deadline=None)
@given(power=st.integers(-125, 125), triangle=st.sampled_from(list(RAY_TRIANGLE)))
def test_t_scales_with_the_direction_and_nothing_else_does(power, triangle):
    # Components have 8 bits and the scale is a power of two. So the direction is exact down to 2^-133, as a denormal, and up to 2^125.
    rng = np.random.default_rng(power + 200)
    direction = rng.integers(-128, 129, (200, 3)) / 128.0
    direction[:, 2] = 1.0
    origin = np.concatenate([rng.uniform(-1.0, 1.0, (200, 2)), np.full((200, 1), -2.0**-8)], axis=1).astype(np.float32)
    accel = build(TRIANGLE, "bvh", triangle=triangle)
    reference = accel.closest_hit(origin, direction, 2.0**-9, 2.0**-7)
    scale = 2.0**power
    hits = accel.closest_hit(origin, direction * scale, np.float32(2.0**-9 / scale), np.float32(2.0**-7 / scale))
    assert 20 < (reference.prim_id == 0).sum() < 180
    np.testing.assert_array_equal(hits.prim_id, reference.prim_id)
    np.testing.assert_array_equal(hits.t, (reference.t / np.float64(scale)).astype(np.float32))
    np.testing.assert_array_equal(hits.u, reference.u)


LARGEST = np.finfo(np.float32).max


@pytest.mark.parametrize("name", STRUCTURES)
@pytest.mark.parametrize("t_max", [np.inf, LARGEST, 2.0**127])
def test_a_hit_whose_t_is_beyond_float32_is_a_miss(name, t_max):
    # t = 2^128, which is too large; the largest float32; the float32 below it; 2^127; 2^88; 2^140, which is far too large.
    distance = np.array([1.0, 1.0 - 2.0**-24, 1.0 - 2.0**-23, 0.5, 2.0**-40, 2.0**12]) * 2.0**-12
    expected = distance.astype(np.float64) * 2.0**140
    origin = np.stack([0.0 * distance, 0.0 * distance, -distance], axis=1)
    direction = np.tile([0.0, 0.0, 2.0**-140], (6, 1))
    for copies in (1, 16):  # A packet has sixteen equal rays.
        accel = build(TRIANGLE, name)
        o, d = np.repeat(origin, copies, axis=0), np.repeat(direction, copies, axis=0)
        found = np.repeat(expected <= min(t_max, LARGEST), copies)
        hits = accel.closest_hit(o, d, t_max=t_max)
        assert np.array_equal(hits.prim_id >= 0, found) and found.any() and not found.all()
        assert np.array_equal(hits.t, np.where(found, np.repeat(expected, copies), np.inf).astype(np.float32))
        assert np.array_equal(accel.any_hit(o, d, t_max=t_max), found)
        assert not hits.u[~found].any() and not hits.v[~found].any()


@pytest.mark.parametrize("name", STRUCTURES)
def test_any_hit_and_closest_hit_agree_on_rays_of_any_length(name):
    # Two triangles: the t of the hit that is found first may be beyond float32, and the t of the other hit within it.
    rng = np.random.default_rng(4)
    near = np.concatenate([TRIANGLE.vertices, TRIANGLE.vertices + [0.0, 0.0, 3.0]])
    n = 4000
    origin = np.stack([*rng.uniform(-0.6, 0.6, (2, n)), -(10.0 ** rng.uniform(-4, 2, n))], axis=1)
    direction = np.stack([0.1 * rng.normal(size=n), 0.1 * rng.normal(size=n), rng.choice([-1.0, 1.0], n)], axis=1)
    direction = (direction * 2.0 ** rng.uniform(-140, -120, (n, 1))).astype(np.float32)
    direction[~direction.any(axis=1), 2] = 1e-45
    accel = build(Mesh(near, [[0, 1, 2], [3, 4, 5]]), name)
    for t_min, t_max in ((0.0, np.inf), (1e37, np.inf), (0.0, 3e38)):
        hits = accel.closest_hit(origin, direction, t_min, t_max)
        assert np.array_equal(accel.any_hit(origin, direction, t_min, t_max), hits.prim_id >= 0)
        assert np.array_equal(np.isfinite(hits.t), hits.prim_id >= 0)
        assert 500 < (hits.prim_id >= 0).sum() < 3500


@kernel
def ray_defaults(origin: wp.array(dtype=wp.vec3), direction: wp.array(dtype=wp.vec3), out: wp.array(dtype=Ray)):
    i = wp.tid()
    out[i] = wp.where(i == 0, Ray(), make_ray(origin[i], direction[i]))


def test_make_ray_goes_to_infinity_and_excludes_nothing():
    out = zeros(2, Ray)
    wp.launch(ray_defaults, dim=2, inputs=[vec3s(np.ones((2, 3))), vec3s(np.full((2, 3), 2.0)), out], device=DEVICE)
    zero, ray = out.numpy()
    assert (ray["origin"] == 1.0).all() and (ray["direction"] == 2.0).all()
    assert ray["t_min"] == 0.0 and ray["t_max"] == np.inf and ray["exclude_plus_one"] == ray["slot"] == ray["first_prim"] == 0
    assert zero["t_max"] == 0.0 and zero["exclude_plus_one"] == 0


@pytest.mark.parametrize("name", families_first())
def test_a_ray_excludes_no_triangle_by_default(name):
    # In a user's kernel, triangle 0 is hit unless exclude_plus_one = 1 excludes it.
    structure = Structure(ACCELERATORS[name])
    struct, traverse = structure.struct, structure.traversal(any_hit=False)

    @kernel
    def own(accel: struct, known: Surfaces, origin: wp.array(dtype=wp.vec3), prim_id: wp.array(dtype=wp.int32)):
        i = wp.tid()
        direction = wp.vec3(0.0, 0.0, 1.0)
        ray = Ray()
        ray.origin = origin[0]
        ray.direction = direction
        ray.t_max = float(wp.inf)
        if i == 1:
            ray = make_ray(origin[0], direction)
        if i > 1:
            ray.exclude_plus_one = i - 1
        prim_id[i] = traverse(accel, known, ray).prim_id

    found = zeros(4, wp.int32)
    wp.launch(own, dim=4, inputs=[build(TRIANGLE, name).data, surfaces(), vec3s([[0.0, 0.0, -2.0]]), found], device=DEVICE)
    assert found.numpy().tolist() == [0, 0, -1, 0]
