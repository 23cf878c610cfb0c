"""Kernels with a unit several times and little else: the difference of two kernels is the unit's machine code."""

from functools import cache
from typing import Any

import warp as wp

from wrt.kernels.native import source
from wrt.kernels.structs import Ray, kernel, size_of
from wrt.kernels.units.box import RAY_AABB, BoxRay
from wrt.kernels.units.triangle import RAY_TRIANGLE, TriangleRay


@wp.struct
class ProbeRay:
    """A ray with the set-up of both units."""

    ray: Ray
    box: BoxRay
    triangle: TriangleRay


@cache
def make_box_probe(test: str | None, count: int) -> Any:
    """Make the kernel of `count` box tests by RAY_AABB[test], whose results are summed; None: the planes are summed."""
    unit = RAY_AABB[test] if test is not None else None

    @kernel
    def box_probe(rays: wp.array(dtype=ProbeRay), lo: wp.array(dtype=wp.vec3), hi: wp.array(dtype=wp.vec3),
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
    """Return the numbers of a record that a test reads: all but prim_id."""
    return size_of(record) // 4 - 1


@cache
def make_add_numbers(record: Any) -> Any:
    """Make add_numbers(total, record): the sum of total and the numbers that a test reads."""
    layout = record.numpy_dtype()
    prim_id = layout["offsets"][layout["names"].index("prim_id")] // 4

    @wp.func_native(source("study/add_numbers.h", PRIM_ID=prim_id))
    def add_numbers(total: float, record: record) -> float: ...

    return add_numbers


@cache
def make_triangle_probe(test: str, count: int, adding: bool = False) -> Any:
    """Make the kernel of `count` tests by RAY_TRIANGLE[test], whose t, u, v are summed; adding: the records' numbers are summed."""
    unit = RAY_TRIANGLE[test].intersect
    record = RAY_TRIANGLE[test].record
    add_numbers = make_add_numbers(record)

    @kernel
    def triangle_probe(rays: wp.array(dtype=ProbeRay), primitives: wp.array(dtype=record), out: wp.array(dtype=wp.float32)):
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
