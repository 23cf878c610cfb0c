"""Numbers of arrays without gaps, for loops that run on one CPU thread.

The compiler makes lanes of a plain Warp loop (sixteen where the CPU has them), and it takes a tenth of the time, if
- it is a `while` with a counter;
- it has no branches (wp.where is none), and calls nothing that has;
- it reads and writes arrays by the functions here, and looks up no table at a place that it computes;
- vectors of three are made, chosen from and normalised number by number (where_vec3, structs.unit), and there are none of two: LLVM
  keeps two numbers together, in what it calls an instruction's vector type;
- places in one array differ by constants, or it would have to compare too many ranges. In C++, a place that is a multiple of a
  variable makes lanes for 1 times alone (shade/film.h).
`-Rpass=loop-vectorize` among wp.config.cpu_compiler_flags says which loops are.
"""

from typing import Any

import warp as wp


@wp.func_native("return array.data[(long long)i][k];")
def number_of_vec2(array: wp.array(dtype=wp.vec2), i: int, k: int) -> float:
    """Component k."""


@wp.func_native("array.data[(long long)i] = value;")
def put(array: wp.array(dtype=Any), i: int, value: Any) -> None: ...


@wp.func_native("array.data[(long long)i] = value;")
def put_number(array: wp.array(dtype=wp.float32), i: int, value: float) -> None: ...


@wp.func_native("array.data[(long long)i] = value;")
def put_int(array: wp.array(dtype=wp.int32), i: int, value: int) -> None: ...


@wp.func_native("array.data[(long long)i][k] = value;")
def put_in_vec2(array: wp.array(dtype=wp.vec2), i: int, k: int, value: float) -> None: ...


@wp.func_native("array.data[(long long)i][k] = value;")
def put_in_vec3(array: wp.array(dtype=wp.vec3), i: int, k: int, value: float) -> None: ...


@wp.func_native("__builtin_prefetch(array.data + (long long)i);")
def prefetch(array: wp.array(dtype=Any), i: int) -> None:
    """Prefetch the cache line of entry i (CPU)."""
