"""Access to arrays without gaps, for loops that run in lanes on one CPU thread.

The compiler vectorises a plain Warp loop, sixteen lanes on some CPUs and a tenth of the time, if
- it is a `while` with a counter;
- it has no branches (wp.where is none), and calls nothing that branches;
- it accesses arrays by the functions here, and no table at a computed index;
- vectors of three are made, selected and normalised by component (where_vec3, structs.unit), and there are none of two: LLVM keeps two
  numbers together, as a vector of its own;
- indices in one array differ by constants, or too many ranges would have to be compared. In C++, an index that is a multiple of a variable
  is vectorised only for multiples of 1 (shade/film.h).

Add `-Rpass=loop-vectorize` to wp.config.cpu_compiler_flags to see which loops are vectorised.
"""

from typing import Any

import warp as wp


@wp.func_native("return array.data[(long long)i][k];")
def number_of_vec2(array: wp.array(dtype=wp.vec2), i: int, k: int) -> float:
    """Component k of entry i."""


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
