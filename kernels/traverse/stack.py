"""The stack of a walk: a local vector of the thread, or on CUDA partly in shared memory.
With the place "shared", CUDA keeps the first entries in the block's shared memory; most rays need no more (docs/acceleration.md,
"Structure and blocks on a GPU"). Aila and Laine 2009, "Understanding the Efficiency of Ray Traversal on GPUs"; Ylitie, Karras and Laine
2017, "Efficient Incoherent Ray Traversal on GPUs Through Compressed Wide BVHs"."""

from functools import cache
from typing import Any, NamedTuple

import warp as wp

PLACES = ("local", "shared")
SHARED = 64  # Bytes of shared memory a thread: with more, a T4 would hold fewer warps.


class Stack(NamedTuple):
    """Functions of a stack. Of two nested walks in one thread, at most one may use shared memory."""

    new: Any  # Function () -> the local entries, not initialised.
    shared: Any  # Function () -> the address of the thread's entries in shared memory.
    put: Any  # Function (entries, shared, i, entry).
    get: Any  # Function (entries, shared, i) -> entry.


@cache
def make_uninitialized(length: int, dtype: Any) -> Any:
    """Make an uninitialised vector: Warp sets new ones to 0, and most rays use little of a stack's 512 bytes."""
    of = f"wp::vec_t<{length}, wp::{dtype.__name__}>"

    @wp.func_native(f"alignas({of}) char memory[sizeof({of})]; return *({of}*)memory;")
    def uninitialized() -> wp.types.vector(length, dtype): ...

    return uninitialized


@cache
def make_stack(place: str, size: int, dtype: Any, entry_bytes: int) -> Stack:
    """Make a stack of `size` values of a type; `entry_bytes` counts the parallel stacks of the same walk too. All stacks of one place and
    type share one piece of shared memory."""
    vector = wp.types.vector(size, dtype)
    short = SHARED // entry_bytes if place == "shared" else 0
    at = f"((wp::{dtype.__name__}*)shared)[i * WP_TILE_BLOCK_DIM]"

    def on_cuda(text: str, otherwise: str) -> str:
        """Return C++ with that text for CUDA, if entries are shared."""
        return f"\n#if defined(__CUDA_ARCH__)\n    {text}\n#else\n    {otherwise}\n#endif\n" if short else otherwise

    # Entries of one depth are adjacent: threads of a warp never conflict in a bank.
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
    """Pack an entry of the stack: keys are in the order of t, which is never below 0 nor -0."""
    return (wp.uint64(wp.cast(t, wp.uint32)) << wp.uint64(32)) | wp.uint64(wp.cast(reference, wp.uint32))


@wp.func
def reference_of(key: wp.uint64) -> int:
    return wp.cast(wp.uint32(key & wp.uint64(0xFFFFFFFF)), wp.int32)


@wp.func
def t_of(key: wp.uint64) -> float:
    return wp.cast(wp.uint32(key >> wp.uint64(32)), wp.float32)
