"""Access to contiguous arrays, for loops that the compiler vectorises on one CPU thread.

With sixteen lanes, a vectorised loop takes a tenth of the time. The compiler vectorises a plain Warp loop if
- the loop is a `while` with a counter;
- the loop and the functions that it calls have no branches (wp.where is not a branch);
- the loop accesses arrays by the functions of this file, and reads no table at a computed index;
- vectors of three are made, selected and normalised by component (where_vec3, structs.unit);
- there are no vectors of two: LLVM keeps their two numbers together in a vector of its own;
- the indices into one array differ by constants: else the loop would have to test too many address ranges for overlap.

In C++, an index `stride * i` is vectorised only for the stride 1 (shade/film.h). To list the vectorised loops, add
`-Rpass=loop-vectorize` to wp.config.cpu_compiler_flags.
"""

from typing import Any

import warp as wp


@wp.func_native("return array.data[(long long)i][k];")
def number_of_vec2(array: wp.array(dtype=wp.vec2), i: int, k: int) -> float:
    """Return component k of array[i]."""


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
    """Prefetch the cache line of entry i; for the CPU only."""
