"""Kernels that hold one unit a number of times and little else: what a unit is in machine code is the difference between two."""

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
    """`count` box tests by RAY_AABB[test], whose results are added up; without a test (None), the six planes are."""
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
    """How many numbers of a record a test reads: all but the prim_id."""
    return size_of(record) // 4 - 1


@cache
def make_add_numbers(record: Any) -> Any:
    """add_numbers(total, record): the numbers that a test reads, added to a total."""
    layout = record.numpy_dtype()
    prim_id = layout["offsets"][layout["names"].index("prim_id")] // 4

    @wp.func_native(source("study/add_numbers.h", PRIM_ID=prim_id))
    def add_numbers(total: float, record: record) -> float: ...

    return add_numbers


@cache
def make_triangle_probe(test: str, count: int, adding: bool = False) -> Any:
    """`count` triangle tests by RAY_TRIANGLE[test], whose t, u and v are added up; `adding`: the numbers of their records are."""
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
