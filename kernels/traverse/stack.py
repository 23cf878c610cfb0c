"""The stack of a traversal, in a thread's local memory, and its entries."""

from functools import cache
from typing import Any

import warp as wp

from wrt.kernels.structs import STACK_LENGTH, stack_type


@cache
def make_uninitialized(length: int, dtype: Any) -> Any:
    """Make uninitialized(), which returns a stack for `length` entries. Kernels of wrt set no entry, others all."""
    assert length <= STACK_LENGTH
    of = f"wp::vec_t<{STACK_LENGTH}, wp::{dtype.__name__}>"

    @wp.func_native(f"alignas({of}) char memory[sizeof({of})]; return *({of}*)memory;")
    def uninitialized() -> stack_type(dtype): ...

    return uninitialized


@cache
def make_stack(size: int, dtype: Any) -> Any:
    """Make the functions of a stack with `size` entries: new() -> entries, put(entries, i, entry), get(entries, i) -> entry."""
    vector = stack_type(dtype)

    @wp.func_native("entries[i] = entry;")
    def put(entries: wp.ref[vector], i: int, entry: dtype) -> None: ...

    @wp.func_native("return entries[i];")
    def get(entries: wp.ref[vector], i: int) -> dtype: ...

    return make_uninitialized(size, dtype), put, get


@wp.func
def key_of(t: float, reference: int) -> wp.uint64:
    """Pack t and a reference into a stack entry. Entries sort by t, which must be at least 0 and not -0."""
    return (wp.uint64(wp.cast(t, wp.uint32)) << wp.uint64(32)) | wp.uint64(wp.cast(reference, wp.uint32))


@wp.func
def reference_of(key: wp.uint64) -> int:
    return wp.cast(wp.uint32(key & wp.uint64(0xFFFFFFFF)), wp.int32)


@wp.func
def t_of(key: wp.uint64) -> float:
    return wp.cast(wp.uint32(key >> wp.uint64(32)), wp.float32)
