"""Rows of lanes: the native functions say, bit for bit, what their twins of plain Warp say."""

from functools import cache

import numpy as np
import pytest

from tests.kernel_tools import CPU, floats, ints, launch, vec3s, zeros  # isort: skip (starts Warp)
import warp as wp

from wrt.kernels.lanes import LANE_PAD, make_lanes, make_twins, row_type
from wrt.kernels.ray_aabb import FAR_PAD, box_ray, ray_aabb
from wrt.kernels.structs import Ray, kernel
from wrt.kernels.traverse import Units, make_probe
from wrt.kernels.traverse_wide import lane_ray

WIDTHS = (4, 8)


@cache
def both_kernel(width):
    """Each function by its native form and by its twin: entries and candidates of row i of `rows` for ray i."""
    native, twin = make_lanes(width), make_twins(width)
    row = row_type(width)
    probe_of = make_probe(Units())

    @wp.struct
    class Out:
        entries: wp.array(dtype=row)
        entered: wp.array(dtype=wp.int32)
        candidates: wp.array(dtype=wp.int32)
        lowest: wp.array(dtype=wp.int32)
        value: wp.array(dtype=wp.float32)
        bits: wp.array(dtype=wp.int32)

    def make(unit):
        @kernel
        def run(rows: wp.array(dtype=wp.float32), origin: wp.array(dtype=wp.vec3), direction: wp.array(dtype=wp.vec3),
                t_min: wp.array(dtype=wp.float32), t_max: wp.array(dtype=wp.float32), out: Out):
            i = wp.tid()
            ray = Ray()
            ray.origin = origin[i]
            ray.direction = direction[i]
            ray.t_min = t_min[i]
            ray.t_max = t_max[i]
            lanes = lane_ray(probe_of(ray), LANE_PAD)
            first = i * wp.static(9 * width)
            unit.prefetch(rows, first)
            out.entries[i] = unit.entries(rows, first, lanes)
            mask = unit.entered(rows, first, lanes, t_max[i])
            out.entered[i] = mask
            if mask != 0:
                out.lowest[i] = unit.lowest(mask)
            out.candidates[i] = unit.candidates(rows, first, lanes)
            out.value[i] = unit.value(rows, first + 1)
            out.bits[i] = unit.bits(rows, first + 1)

        return run

    return Out, make(native), make(twin)


def results(width, rows, origin, direction, t_min, t_max):
    out_type, *kernels = both_kernel(width)
    answers = []
    for run in kernels:
        n = len(origin)
        out = out_type()
        out.entries = zeros(n, row_type(width))
        for name in ("entered", "candidates", "lowest", "bits"):
            setattr(out, name, zeros(n, wp.int32))
        out.value = zeros(n)
        launch(run, n, floats(rows.reshape(-1)), vec3s(origin), vec3s(direction), floats(t_min), floats(t_max), out)
        answers.append({name: getattr(out, name).numpy() for name in out._cls.vars})
    return answers


def assert_same(native, twin):
    for name in native:
        np.testing.assert_array_equal(native[name].view(np.int32), twin[name].view(np.int32), err_msg=name)


@pytest.mark.parametrize("width", WIDTHS)
def test_native_functions_equal_their_twins_on_random_rows(width):
    rng = np.random.default_rng(width)
    n = 20_000
    rows = rng.normal(size=(n, 9, width))
    rows[:, 1:6:2] = rows[:, 0:6:2] + np.abs(rng.normal(size=(n, 3, width)))
    t_min = np.where(rng.random(n) < 0.5, 0.0, rng.random(n))
    native, twin = results(width, rows, rng.normal(size=(n, 3)), rng.normal(size=(n, 3)), t_min, t_min + rng.exponential(3.0, n))
    assert_same(native, twin)
    for name in ("entered", "candidates"):
        assert 0.02 < np.unpackbits(native[name].astype(np.uint8)).sum() / (n * width) < 0.98


@pytest.mark.parametrize("width", WIDTHS)
def test_native_functions_equal_their_twins_where_numbers_are_special(width):
    # Planes through the origin, directions with +-0, empty boxes, denormals, overflow, infinities and NaN.
    rng = np.random.default_rng(10 + width)
    n = 40_000
    special = np.array([0.0, -0.0, 1.0, -1.0, 0.5, 1e-40, -1e-40, 3e38, -3e38, np.inf, -np.inf, np.nan], np.float32)
    rows = rng.choice(special, (n, 9, width))
    origin, direction = rng.choice(special[:9], (n, 3)), rng.choice(special[:8], (n, 3))
    ends = np.array([0.0, -0.0, 0.5, 1.0, 1e30, 3.4e38, -np.inf], np.float32)
    native, twin = results(width, rows, origin, direction, rng.choice(ends[:4], n), rng.choice(ends, n))
    assert_same(native, twin)
    assert 0 < native["entered"].astype(bool).mean() < 1


@pytest.mark.parametrize("width", WIDTHS)
def test_lowest_is_the_lowest_bit(width):
    masks = np.arange(1, 1 << width, dtype=np.int32)
    native, twin = make_lanes(width).lowest, make_twins(width).lowest

    @kernel
    def run(mask: wp.array(dtype=wp.int32), a: wp.array(dtype=wp.int32), b: wp.array(dtype=wp.int32)):
        i = wp.tid()
        a[i] = native(mask[i])
        b[i] = twin(mask[i])

    a, b = zeros(len(masks), wp.int32), zeros(len(masks), wp.int32)
    launch(run, len(masks), ints(masks), a, b)
    expected = [bin(mask)[::-1].index("1") for mask in masks]
    assert a.numpy().tolist() == b.numpy().tolist() == expected


@kernel
def scalar_boxes(rows: wp.array(dtype=wp.float32), origin: wp.array(dtype=wp.vec3), direction: wp.array(dtype=wp.vec3),
                 t_max: float, t: wp.array(dtype=wp.float32)):
    i, j = wp.tid()
    ray = Ray()
    ray.origin = origin[i]
    ray.direction = direction[i]
    k = i * 72 + j
    lo = wp.vec3(rows[k], rows[k + 16], rows[k + 32])
    t[i * 8 + j] = ray_aabb(box_ray(ray), lo, wp.vec3(rows[k + 8], rows[k + 24], rows[k + 40]), t_max)


def test_rows_of_boxes_leave_out_none_that_the_box_unit_enters():
    # Flat and thin boxes that lines graze: the last bits decide, and the rows must err to the same side, by no more than LANE_PAD.
    rng = np.random.default_rng(3)
    n, t_max = 50_000, np.float32(3.0)
    assert LANE_PAD >= FAR_PAD * (1.0 + 7.0 * 2.0**-24)
    origin = rng.normal(size=(n, 3)).astype(np.float32)
    direction = rng.normal(size=(n, 3)).astype(np.float32)
    point = origin[:, None] + direction[:, None] * rng.random((n, 8, 1)).astype(np.float32)
    lo = point + np.where(rng.random((n, 8, 3)) < 0.4, 0.0, -rng.random((n, 8, 3)))
    hi = point + np.where(rng.random((n, 8, 3)) < 0.4, 0.0, rng.random((n, 8, 3)))
    rows = np.zeros((n, 9, 8), np.float32)
    rows[:, 0:6:2], rows[:, 1:6:2] = lo.transpose(0, 2, 1), hi.transpose(0, 2, 1)
    native, _ = results(8, rows, origin, direction, np.zeros(n), np.full(n, t_max))
    t = zeros(8 * n)
    wp.launch(scalar_boxes, dim=(n, 8), inputs=[floats(rows.reshape(-1)), vec3s(origin), vec3s(direction), t_max, t], device=CPU)
    t = t.numpy().reshape(n, 8)
    entered = (native["entered"][:, None] >> np.arange(8) & 1).astype(bool)
    assert entered[np.isfinite(t)].all() and 0.02 < np.isinf(t).mean() < 0.98
    assert (entered & np.isinf(t)).mean() < 0.05
    assert np.array_equal(native["entries"][np.isfinite(t)], t[np.isfinite(t)])
