"""Kernels that call a box or triangle test several times, and do little else. Two kernels with different numbers of calls differ by the
machine code of the additional tests."""

from functools import cache
from typing import Any

import warp as wp

from wrt.kernels.structs import kernel, size_of
from wrt.kernels.traverse.common import Probe
from wrt.kernels.units.box import RAY_AABB
from wrt.kernels.units.triangle import RAY_TRIANGLE


@cache
def make_box_probe(test: str | None, count: int) -> Any:
    """Make the kernel that sums the results of `count` box tests RAY_AABB[test]; if `test` is None, it sums the boxes' coordinates."""
    unit = RAY_AABB[test] if test is not None else None

    @kernel
    def box_probe(rays: wp.array(dtype=Probe), lo: wp.array(dtype=wp.vec3), hi: wp.array(dtype=wp.vec3),
                  out: wp.array(dtype=wp.float32)):
        i = wp.tid()
        ray = rays[i]
        total = float(0.0)
        for j in range(wp.static(count)):
            a = lo[wp.static(count) * i + j]
            b = hi[wp.static(count) * i + j]
            if wp.static(unit is not None):
                total += wp.static(unit)(ray.box, a, b, ray.ray.t_max)
            else:
                total += a[0] + a[1] + a[2] + b[0] + b[1] + b[2]
        out[i] = total

    return box_probe


def numbers_of(record: Any) -> int:
    """Return the number of 4-byte values of a record that a test reads: all except prim_id."""
    return size_of(record) // 4 - 1


@cache
def make_add_numbers(record: Any) -> Any:
    """Make add_numbers(total, record), which returns `total` plus all floats of a record."""
    layout = record.numpy_dtype()
    prim_id = layout["offsets"][layout["names"].index("prim_id")] // 4

    @wp.func_native(f"""
    float numbers[sizeof(record) / sizeof(float)];
    memcpy(numbers, &record, sizeof(record));
    for (unsigned k = 0; k < sizeof(record) / sizeof(float); ++k) {{
        if (k != {prim_id}) total += numbers[k];
    }}
    return total;
    """)
    def add_numbers(total: float, record: record) -> float: ...

    return add_numbers


@cache
def make_triangle_probe(test: str, count: int, adding: bool = False) -> Any:
    """Make the kernel that sums t, u and v of `count` tests RAY_TRIANGLE[test]; with `adding`, it sums the records' floats instead."""
    unit = RAY_TRIANGLE[test].intersect
    record = RAY_TRIANGLE[test].record
    add_numbers = make_add_numbers(record)

    @kernel
    def triangle_probe(rays: wp.array(dtype=Probe), primitives: wp.array(dtype=record), out: wp.array(dtype=wp.float32)):
        i = wp.tid()
        ray = rays[i]
        total = float(0.0)
        for j in range(wp.static(count)):
            p = primitives[wp.static(count) * i + j]
            if wp.static(not adding):
                hit = wp.static(unit)(ray.box, ray.triangle, ray.ray, p)
                total += wp.where(hit.prim_id == 0, hit.t + hit.u + hit.v, 0.0)
            else:
                total = add_numbers(total, p)
        out[i] = total

    return triangle_probe
