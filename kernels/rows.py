"""Access to arrays in loops that the compiler vectorises on one CPU thread.

With sixteen lanes, a vectorised loop takes a tenth of the time. The compiler vectorises a plain Warp loop if
- the loop is a `while` with a counter;
- the loop and the functions that it calls have no branches (wp.where is not a branch);
- the loop accesses arrays by the functions of this file, and reads no table at a computed index;
- vectors of three are made, selected and normalised by component (where_vec3, structs.unit);
- there are no vectors of two: LLVM keeps their two numbers together in a vector of its own;
- the indices into one array differ by constants: else the loop would have to test too many address ranges for overlap.

In C++, an index `stride * i` is vectorised only for the stride 1 (shade/film.h). To list the vectorised loops, add
`-Rpass=loop-vectorize` to wp.config.cpu_compiler_flags.

Structs are stored as a structure of arrays. A struct of 9 numbers takes 9 rows of a two-dimensional block; column i holds struct i. A
loop over i then accesses consecutive addresses. In an array of structs, equal fields would be 9 numbers apart. Functions `load` and
`store` are C++ code with one statement per number of the struct (example: tests/kernels/test_rows.py)."""

from functools import cache
from typing import Any, NamedTuple

import warp as wp

from wrt.kernels.warp_private import fields_of


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


def numbers_of(dtype: Any, name: str) -> list[str]:
    """Return C++ expressions for all numbers of a variable `name` of this type, in order: "name.point[0]", "name.point[1]" ..."""
    if hasattr(dtype, "numpy_dtype"):
        return [number for field, kind in fields_of(dtype).items() for number in numbers_of(kind, f"{name}.{field}")]
    size = wp.types.type_size(dtype)
    return [name] if size == 1 else [f"{name}[{k}]" for k in range(size)]


class Rows(NamedTuple):
    """The rows of a block that hold structs (or vectors) of one type. Each number takes 4 bytes and keeps its bits, integers too."""

    dtype: Any
    length: int  # Columns of the block: the number of structs that it holds.
    first: int = 0  # Index of the row with the struct's first number.

    @property
    def end(self) -> int:
        """Index of the row behind the struct's last row."""
        return self.first + len(numbers_of(self.dtype, "value"))

    def field(self, name: str) -> "Rows":
        """Return the rows of one field of the struct."""
        fields = fields_of(self.dtype)
        before = list(fields)[: list(fields).index(name)]
        return Rows(fields[name], self.length, self.first + sum(len(numbers_of(fields[each], "")) for each in before))

    def text(self, line: str, without: tuple[str, ...] = ()) -> str:
        """Return the template `line` once per number of the struct, except in the fields `without`. In the template, {number} is the
        number's C++ expression, {place} its address in column i."""
        left_out = tuple(f"value.{name}{end}" for name in without for end in ("[", ".", ";"))
        return "".join(f"    {line}\n".format(number=number, place=f"rows.data + {row * self.length}ll + i")
                       for row, number in enumerate(numbers_of(self.dtype, "value"), self.first)
                       if not f"{number};".startswith(left_out))

    def load(self, *without: str) -> Any:
        """Make load(rows, i), which returns struct i with 0 in the fields `without`."""
        return make_load(self, without)

    def store(self, *without: str) -> Any:
        """Make store(rows, i, value), which writes struct i except for the fields `without`."""
        return make_store(self, without)


@cache
def make_load(of: Rows, without: tuple[str, ...]) -> Any:
    dtype = of.dtype

    @wp.func_native(of.text("memcpy(&{number}, {place}, 4);", without))
    def fill(rows: wp.array(dtype=wp.float32), i: int, value: wp.ref[dtype]) -> None: ...

    @wp.func
    def load(rows: wp.array(dtype=wp.float32), i: int) -> dtype:
        value = dtype()
        fill(rows, i, value)
        return value

    return load


@cache
def make_store(of: Rows, without: tuple[str, ...]) -> Any:
    dtype = of.dtype

    @wp.func_native(of.text("memcpy({place}, &{number}, 4);", without))
    def store(rows: wp.array(dtype=wp.float32), i: int, value: dtype) -> None: ...

    return store
