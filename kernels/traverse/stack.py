"""The stack of a walk. On the CPU, and with the place "local" on CUDA, it is a vector of the thread's own. With the place "shared",
CUDA has its first entries in the memory that a block's threads share, and only what is above them in that vector.

Most rays never have more (docs/acceleration.md, "Structure and blocks on a GPU"). Aila and Laine 2009,
"Understanding the Efficiency of Ray Traversal on GPUs"; Ylitie, Karras and Laine 2017, "Efficient Incoherent Ray Traversal on GPUs
Through Compressed Wide BVHs".
"""

from functools import cache
from typing import Any, NamedTuple

import warp as wp

PLACES = ("local", "shared")
SHARED = 64  # bytes of a thread there: with more, a T4 would hold fewer warps


class Stack(NamedTuple):
    """new(): the entries, of which none is set; shared(): where the thread's first ones are, for put(entries, shared, i, entry) and
    get(entries, shared, i). Of two walks that are under way at a time in one thread, one at most has its stack in shared memory."""

    new: Any
    shared: Any
    put: Any
    get: Any


@cache
def make_uninitialized(length: int, dtype: Any) -> Any:
    """A vector of whatever memory holds: Warp sets every new one to 0, and of a stack's 512 bytes most rays use a few."""

    of = f"wp::vec_t<{length}, wp::{dtype.__name__}>"

    @wp.func_native(f"alignas({of}) char memory[sizeof({of})]; return *({of}*)memory;")
    def uninitialized() -> wp.types.vector(length, dtype): ...

    return uninitialized


@cache
def make_stack(place: str, size: int, dtype: Any, entry_bytes: int) -> Stack:
    """A stack of `size` numbers of that type, alone or beside others, with which an entry has so many bytes. One place and type
    have one piece of shared memory."""
    vector = wp.types.vector(size, dtype)
    short = SHARED // entry_bytes if place == "shared" else 0
    at = f"((wp::{dtype.__name__}*)shared)[i * WP_TILE_BLOCK_DIM]"

    def on_cuda(text: str, otherwise: str) -> str:
        """Return C++ with that text for CUDA, if entries are shared."""
        return f"\n#if defined(__CUDA_ARCH__)\n    {text}\n#else\n    {otherwise}\n#endif\n" if short else otherwise

    # Entries of one depth lie side by side, so that threads of a warp never meet in a bank of the memory.
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
    """An entry of the stack: sorted by t, which is never below 0 nor -0."""
    return (wp.uint64(wp.cast(t, wp.uint32)) << wp.uint64(32)) | wp.uint64(wp.cast(reference, wp.uint32))


@wp.func
def reference_of(key: wp.uint64) -> int:
    return wp.cast(wp.uint32(key & wp.uint64(0xFFFFFFFF)), wp.int32)


@wp.func
def t_of(key: wp.uint64) -> float:
    return wp.cast(wp.uint32(key >> wp.uint64(32)), wp.float32)
