"""Many rays at a time on the CPU, where a structure's traversal module has a form for them (make_stream)."""

from __future__ import annotations

from functools import cache, partial
from typing import TYPE_CHECKING, Any

import warp as wp

from wrt.device import load_kernel, run_all, thread_count
from wrt.kernels.packets import Scratch

if TYPE_CHECKING:
    from wrt.accel.base import Structure

# Work for a few milliseconds: a launch costs less than 1 % of it, and Ctrl-C is heard soon.
FEWEST, MOST = 16384, 131072


@cache
def stream_kernel(structure: Structure, any_hit: bool) -> Any:
    """The kernel for a structure, or None where it has no other than the one for one ray."""
    make = getattr(structure.accel.kernels, "make_stream", None)
    return make(structure.units, any_hit) if make else None


def scratch(sizes: tuple[int, int, int]) -> Scratch:
    """What one launch works in."""
    out = Scratch()
    out.packets = wp.empty(sizes[0], dtype=wp.float32, device="cpu")
    out.stacks = wp.empty(sizes[1], dtype=wp.uint64, device="cpu")
    out.slots = wp.zeros(sizes[2], dtype=wp.int32, device="cpu")
    return out


def launch_stream(structure: Structure, kernel: Any, inputs: list[Any], n: int, threads: int | None) -> None:
    """Trace rays 0 .. n - 1 with a kernel of stream_kernel. inputs: its first ones, up to `out`."""
    module = structure.accel.kernels
    load_kernel(kernel, wp.get_device("cpu"))
    count = thread_count(threads)
    part = MOST if count == 1 else min(max(n // (4 * count), FEWEST), MOST)
    part -= part % module.stream_block

    def job(first: int) -> Any:
        end = min(first + part, n)
        arguments = [*inputs, scratch(module.stream_sizes), first, end]  # here: two threads must not make structs at a time
        return partial(wp.launch, kernel, dim=-(-(end - first) // module.stream_block), inputs=arguments, device="cpu")

    run_all([job(first) for first in range(0, n, part)], count)
