"""The kernels over arrays of rays: which rows they touch, and what a miss leaves behind."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.kernel_tools import CPU, floats, vec3s, zeros  # isort: skip (starts Warp)
import warp as wp

from wrt.accel import ACCELERATORS, Structure, build
from wrt.kernels.query import HitArrays, RayArrays, make_any_hit_kernel, make_closest_hit_kernel
from wrt.kernels.ray_triangle import RAY_TRIANGLE
from wrt.kernels.structs import Surfaces
from wrt.mesh import Mesh

TRIANGLE = Mesh([[-1, -1, 0], [1, -1, 0], [0, 1, 0]], [[0, 1, 2]])
STRUCTURES = sorted({cls.name: cls for cls in ACCELERATORS.values()}.items())


def ray_arrays():
    """Ten rays along +z from z = -2: even ones meet the triangle at t = 2, odd ones pass it, two have segments too short."""
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


@pytest.mark.parametrize(("name", "cls"), STRUCTURES)
def test_only_the_rows_asked_for_are_written(name, cls):
    structure = Structure(cls)
    closest = make_closest_hit_kernel(structure.struct, structure.traversal(any_hit=False))
    anything = make_any_hit_kernel(structure.struct, structure.traversal(any_hit=True))
    data = build(TRIANGLE, name).data
    hits = HitArrays()
    hits.t, hits.u, hits.v = (floats(np.full(10, -7.0)) for _ in range(3))
    hits.prim_id = wp.full(10, -7, dtype=wp.int32, device=CPU)
    dark = zeros(10, wp.bool)
    wp.launch(closest, dim=7, inputs=[data, surfaces(), ray_arrays(), hits, 2], device=CPU)
    wp.launch(anything, dim=7, inputs=[data, surfaces(), ray_arrays(), dark, 2], device=CPU)
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
    # Powers of two, components of 8 bits: the direction is exact down to 2^-133, as a denormal, and up to 2^125.
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


def test_a_hit_whose_t_is_beyond_float32_is_a_miss_but_dark():
    accel = build(TRIANGLE, "bvh")
    origin, direction = [[0.0, 0.0, -2.0], [0.0, 0.0, -2.0**-40]], [[0.0, 0.0, 2.0**-140]] * 2
    hits = accel.closest_hit(origin, direction)
    assert hits.prim_id.tolist() == [-1, 0] and hits.t.tolist() == [np.inf, 2.0**100]
    assert accel.any_hit(origin, direction).tolist() == [True, True]
