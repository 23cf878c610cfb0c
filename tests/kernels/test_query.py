"""The kernels over arrays of rays: which rows they touch, and what a miss leaves behind."""

import numpy as np
import pytest

from tests.kernel_tools import CPU, floats, vec3s, zeros  # isort: skip (starts Warp)
import warp as wp

from wrt.accel import ACCELERATORS, Structure, build
from wrt.kernels.query import HitArrays, RayArrays, make_any_hit_kernel, make_closest_hit_kernel
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
