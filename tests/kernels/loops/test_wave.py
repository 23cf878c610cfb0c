"""The branch-free functions of vectorised loops: unit vectors, and the choice of one of two vectors."""

from __future__ import annotations

import numpy as np

from tests.kernel_tools import launch, vec3s, zeros  # isort: skip (starts Warp)
import warp as wp

from wrt.kernels.shade.sampling import where_vec3
from wrt.kernels.structs import kernel, unit


@kernel
def unit_kernel(v: wp.array(dtype=wp.vec3), out: wp.array(dtype=wp.vec3), warps: wp.array(dtype=wp.vec3)):
    i = wp.tid()
    out[i] = unit(v[i])
    warps[i] = wp.normalize(v[i])


def test_unit_vectors_without_a_branch() -> None:
    rng = np.random.default_rng(0)
    v = (rng.normal(size=(20_000, 3)) * 10.0 ** rng.uniform(-45, 38, (20_000, 1))).astype(np.float32)
    v[:10], v[10:20], v[20:30, 0], v[30:40, 1] = 0.0, -0.0, np.inf, np.nan
    out, warps = zeros(len(v), wp.vec3), zeros(len(v), wp.vec3)
    launch(unit_kernel, len(v), vec3s(v), out, warps)
    np.testing.assert_array_equal(out.numpy(), warps.numpy())
    assert not out.numpy()[:20].any() and not out.numpy()[30:40].any()


@kernel
def where_kernel(a: wp.array(dtype=wp.vec3), b: wp.array(dtype=wp.vec3), out: wp.array(dtype=wp.vec3)):
    i = wp.tid()
    out[i] = where_vec3(i % 2 == 0, a[i], b[i])


def test_one_of_two_vectors() -> None:
    a, b = np.random.default_rng(1).normal(size=(2, 8, 3)).astype(np.float32)
    out = zeros(8, wp.vec3)
    launch(where_kernel, 8, vec3s(a), vec3s(b), out)
    assert (out.numpy() == np.where(np.arange(8)[:, None] % 2 == 0, a, b)).all()
