"""The stack of a traversal: in a thread's local memory or, on CUDA, partly in shared memory.
In the place "shared", the first entries are in the shared memory of a CUDA block; most rays need no more entries (docs/acceleration.md,
"Structure and blocks on a GPU"). Aila and Laine 2009, "Understanding the Efficiency of Ray Traversal on GPUs"; Ylitie, Karras and Laine
2017, "Efficient Incoherent Ray Traversal on GPUs Through Compressed Wide BVHs"."""

from functools import cache
from typing import Any, NamedTuple

import warp as wp

from wrt.kernels.structs import STACK_LENGTH, stack_type

PLACES = ("local", "shared")
SHARED = 64  # Bytes of shared memory per thread. With more, fewer warps would fit on a multiprocessor of a T4.


class Stack(NamedTuple):
    """Functions of a stack. If a thread nests two walks, only one of them may use shared memory."""

    new: Any  # Function () -> entries: the thread's local memory, not initialised.
    shared: Any  # Function () -> shared: the address of the thread's entries in shared memory.
    put: Any  # Function (entries, shared, i, entry): write entry i.
    get: Any  # Function (entries, shared, i) -> entry i.


@cache
def make_uninitialized(length: int, dtype: Any) -> Any:
    """Make uninitialized(), which returns a stack for `length` entries. Kernels of wrt set no entry, others all."""
    assert length <= STACK_LENGTH
    of = f"wp::vec_t<{STACK_LENGTH}, wp::{dtype.__name__}>"

    @wp.func_native(f"alignas({of}) char memory[sizeof({of})]; return *({of}*)memory;")
    def uninitialized() -> stack_type(dtype): ...

    return uninitialized


@cache
def make_stack(place: str, size: int, dtype: Any, entry_bytes: int) -> Stack:
    """Make the functions of a stack with `size` entries of type `dtype`. place: its memory, one of PLACES.
    A walk may split its entries over several stacks, each with one part of every entry. entry_bytes: size of all parts together. Stacks
    that are made with equal arguments share one block of shared memory."""
    vector = stack_type(dtype)
    short = SHARED // entry_bytes if place == "shared" else 0
    at = f"((wp::{dtype.__name__}*)shared)[i * WP_TILE_BLOCK_DIM]"

    def on_cuda(text: str, otherwise: str) -> str:
        """Return C++ that is `text` on CUDA with the place "shared", and `otherwise` elsewhere."""
        return f"\n#if defined(__CUDA_ARCH__)\n    {text}\n#else\n    {otherwise}\n#endif\n" if short else otherwise

    # In shared memory, the entries i of all threads are adjacent, so that the threads of a warp have no bank conflicts.
    @wp.func_native(on_cuda(f"__shared__ wp::{dtype.__name__} first[{short} * WP_TILE_BLOCK_DIM];"
                            " return (wp::uint64)(first + threadIdx.x);", "return 0;"))
    def shared() -> wp.uint64: ...

    @wp.func_native(on_cuda(f"if (i < {short}) {at} = entry; else entries[i] = entry;", "entries[i] = entry;"))
    def put(entries: wp.ref[vector], shared: wp.uint64, i: int, entry: dtype) -> None: ...

    @wp.func_native(on_cuda(f"return i < {short} ? {at} : entries[i];", "return entries[i];"))
    def get(entries: wp.ref[vector], shared: wp.uint64, i: int) -> dtype: ...

    return Stack(make_uninitialized(size, dtype), shared, put, get)


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
