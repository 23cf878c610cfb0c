"""Tests of a row of boxes or triangles: the C++ code for the CPU returns the bits of the Warp code for CUDA."""

from functools import cache

import numpy as np
import pytest

from tests.kernel_tools import DEVICE, cpu_only, floats, ints, launch, vec3s, zeros  # isort: skip (starts Warp)
import warp as wp

from tests.kernels.wide.plain_rows import make_plain_rows
from wrt.accel.bvh.compress import compress
from wrt.kernels.query import RayArrays, load_ray
from wrt.kernels.structs import Ray, kernel
from wrt.kernels.traverse.common import Units, make_probe
from wrt.kernels.units.box import FAR_PAD, box_ray, ray_aabb
from wrt.kernels.warp_private import fields_of
from wrt.kernels.wide.lanes import LANE_PAD, lowest, make_native_cull, make_plain_cull, row_type
from wrt.kernels.wide.layout import node_size
from wrt.kernels.wide.nodes import make_native
from wrt.kernels.wide.traverse import lane_ray

WIDTHS = (4, 8)
pytestmark = cpu_only


@cache
def both_kernel(width, compressed):
    """Return the kernel for the results of C++ and Warp code, for node i, row i of triangles and ray i."""
    row = row_type(width)
    probe_of = make_probe(Units())

    @wp.struct
    class Out:
        entries: wp.array(dtype=row)
        entered: wp.array(dtype=wp.int32)
        candidates: wp.array(dtype=wp.int32)

    def make(cull, children):
        @kernel
        def run(nodes: wp.array(dtype=wp.float32), rows: wp.array(dtype=wp.float32), rays: RayArrays, out: Out):
            i = wp.tid()
            ray = load_ray(rays, i)
            lanes = lane_ray(probe_of(ray), LANE_PAD)
            first = i * wp.static(9 * width)
            node = i * wp.static(node_size(width, compressed))
            entries, entered = children(nodes, node, lanes, ray.t_max)
            out.entries[i] = entries
            out.entered[i] = entered
            out.candidates[i] = cull(rows, first, i & wp.static((1 << width) - 1), lanes)  # every mask

        return run

    return (Out, make(make_native_cull(width), make_native(width, compressed)),
            make(make_plain_cull(width), make_plain_rows(width, compressed)))


def results(width, compressed, nodes, rows, rays):
    out_type, *kernels = both_kernel(width, compressed)
    origin, direction, t_min, t_max = rays
    arrays = RayArrays()
    arrays.origin, arrays.direction, arrays.t_min, arrays.t_max = vec3s(origin), vec3s(direction), floats(t_min), floats(t_max)
    answers = []
    for run in kernels:
        n = len(origin)
        out = out_type()
        out.entries = zeros(n, row_type(width))
        out.entered, out.candidates = zeros(n, wp.int32), zeros(n, wp.int32)
        launch(run, n, floats(nodes.reshape(-1)), floats(rows.reshape(-1)), arrays, out)
        answers.append({name: getattr(out, name).numpy() for name in fields_of(out)})
    return answers


def plain_nodes(lo, hi):
    """Return boxes, (n, W, 3), as nodes."""
    n, width, _ = lo.shape
    nodes = np.zeros((n, 8, width), np.float32)
    nodes[:, 0:6:2], nodes[:, 1:6:2] = lo.transpose(0, 2, 1), hi.transpose(0, 2, 1)
    return nodes


def compressed_nodes(rng, n, width, origins):
    """Return nodes of random bytes, with all exponents of steps from 2^-20 to 2^20, and some of their ends."""
    nodes = np.zeros((n, node_size(width, True)), np.float32)
    nodes[:, :3] = origins
    exponents = np.where(rng.random((n, 3)) < 0.1, rng.choice([1, 2, 253, 254], (n, 3)), rng.integers(107, 147, (n, 3)))
    word = (exponents << np.array([0, 8, 16])).sum(axis=1) | rng.integers(0, 1 << width, n) << 24
    nodes[:, 3] = word.astype(np.uint32).view(np.float32)
    nodes[:, 4 : 4 + 6 * width // 4] = rng.integers(0, 256, (n, 6 * width), dtype=np.uint8).view(np.float32)
    return nodes


def assert_same(native, plain, width):
    for name in ("entered", "candidates"):
        np.testing.assert_array_equal(native[name], plain[name], err_msg=name)
    entered = (native["entered"][:, None] >> np.arange(width) & 1).astype(bool)
    np.testing.assert_array_equal(native["entries"][entered].view(np.int32), plain["entries"][entered].view(np.int32))


@pytest.mark.parametrize("compressed", [False, True])
@pytest.mark.parametrize("width", WIDTHS)
def test_both_forms_agree_on_random_rows(width, compressed):
    rng = np.random.default_rng(width)
    n = 20_000
    rows, lo = rng.normal(size=(n, 9, width)), rng.normal(size=(n, width, 3))
    hi = lo + np.abs(rng.normal(size=lo.shape))
    nodes = plain_nodes(lo, hi)
    if compressed:
        nodes = np.zeros((n, node_size(width, True)), np.float32)
        nodes[:, :-width] = compress(lo.astype(np.float32), hi.astype(np.float32), rng.random((n, width)) < 0.8)
    t_min = np.where(rng.random(n) < 0.5, 0.0, rng.random(n))
    rays = rng.normal(size=(n, 3)), rng.normal(size=(n, 3)), t_min, t_min + rng.exponential(3.0, n)
    native, plain = results(width, compressed, nodes, rows, rays)
    assert_same(native, plain, width)
    for name in ("entered", "candidates"):
        assert 0.01 < np.unpackbits(native[name].astype(np.uint8)).sum() / (n * width) < 0.98


@pytest.mark.parametrize("compressed", [False, True])
@pytest.mark.parametrize("width", WIDTHS)
def test_both_forms_agree_where_numbers_are_special(width, compressed):
    # Special values: planes through the origin, directions with +-0, empty boxes, denormals, overflow, infinities and NaN.
    rng = np.random.default_rng(10 + width)
    n = 40_000
    special = np.array([0.0, -0.0, 1.0, -1.0, 0.5, 1e-40, -1e-40, 3e38, -3e38, np.inf, -np.inf, np.nan], np.float32)
    nodes = (compressed_nodes(rng, n, width, rng.choice(special, (n, 3))) if compressed
             else plain_nodes(rng.choice(special, (n, width, 3)), rng.choice(special, (n, width, 3))))
    ends = np.array([0.0, -0.0, 0.5, 1.0, 1e30, 3.4e38, -np.inf], np.float32)
    direction = rng.choice(special[:5], (n, 3))
    direction[~direction.any(axis=1)] = 1.0
    rays = rng.choice(special[:9], (n, 3)), direction, rng.choice(ends[:4], n), rng.choice(ends, n)
    native, plain = results(width, compressed, nodes, rng.choice(special, (n, 9, width)), rays)
    assert_same(native, plain, width)
    assert 0 < native["entered"].astype(bool).mean() < 1


@kernel
def lowest_bits(mask: wp.array(dtype=wp.int32), out: wp.array(dtype=wp.int32)):
    i = wp.tid()
    out[i] = lowest(mask[i])


def test_lowest_is_the_lowest_bit():
    masks = np.arange(1, 256, dtype=np.int32)
    out = zeros(len(masks), wp.int32)
    launch(lowest_bits, len(masks), ints(masks), out)
    assert out.numpy().tolist() == [bin(mask)[::-1].index("1") for mask in masks]


@kernel
def scalar_boxes(rows: wp.array(dtype=wp.float32), origin: wp.array(dtype=wp.vec3), direction: wp.array(dtype=wp.vec3),
                 t_max: float, t: wp.array(dtype=wp.float32)):
    i, j = wp.tid()
    ray = Ray()
    ray.origin = origin[i]
    ray.direction = direction[i]
    k = i * 64 + j
    lo = wp.vec3(rows[k], rows[k + 16], rows[k + 32])
    t[i * 8 + j] = ray_aabb(box_ray(ray), lo, wp.vec3(rows[k + 8], rows[k + 24], rows[k + 40]), t_max)


def test_rows_of_boxes_leave_out_none_that_the_box_unit_enters():
    # Lines graze flat and thin boxes, so that the last bits decide. The rows must err towards entering, by no more than LANE_PAD.
    rng = np.random.default_rng(3)
    n, t_max = 50_000, np.float32(3.0)
    assert LANE_PAD >= FAR_PAD * (1.0 + 7.0 * 2.0**-24)
    origin = rng.normal(size=(n, 3)).astype(np.float32)
    direction = rng.normal(size=(n, 3)).astype(np.float32)
    point = origin[:, None] + direction[:, None] * rng.random((n, 8, 1)).astype(np.float32)
    lo = point + np.where(rng.random((n, 8, 3)) < 0.4, 0.0, -rng.random((n, 8, 3)))
    hi = point + np.where(rng.random((n, 8, 3)) < 0.4, 0.0, rng.random((n, 8, 3)))
    nodes = plain_nodes(lo, hi)
    rays = origin, direction, np.zeros(n), np.full(n, t_max)
    native, _ = results(8, False, nodes, np.zeros((n, 9, 8)), rays)
    t = zeros(8 * n)
    inputs = [floats(nodes.reshape(-1)), vec3s(origin), vec3s(direction), t_max, t]
    wp.launch(scalar_boxes, dim=(n, 8), inputs=inputs, device=DEVICE)
    t = t.numpy().reshape(n, 8)
    entered = (native["entered"][:, None] >> np.arange(8) & 1).astype(bool)
    assert entered[np.isfinite(t)].all() and 0.02 < np.isinf(t).mean() < 0.98
    assert (entered & np.isinf(t)).mean() < 0.05
    assert np.array_equal(native["entries"][np.isfinite(t)], t[np.isfinite(t)])
