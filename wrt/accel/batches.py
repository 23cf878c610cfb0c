"""A query's rays in launches, spread over threads: one ray at a time, or many, where a structure's traversal module has a form for
them (make_stream)."""

from __future__ import annotations

from functools import partial
from typing import Any

import warp as wp

from wrt.accel.structure import Structure
from wrt.core.device import empty_aligned, load_kernel, made_once, run_all, upload
from wrt.kernels.wide.packets import Scratch

# Rays of a launch, about: work for a few milliseconds, of which the launch costs little, and Ctrl-C is heard soon. Fewer than
# FEWEST in all are not divided.
FEWEST, SOME, MOST = 8192, 32768, 131072
RAYS_PER_LAUNCH = 16384  # one at a time


@made_once
def stream_kernel(structure: Structure, any_hit: bool) -> Any:
    """The kernel for a structure, or None where it has no other than the one for one ray."""
    make = getattr(structure.accel.kernels, "make_stream", None)
    return make(structure.units, any_hit) if make else None


_free: list[Scratch] = []  # a new one costs as much as a thousand rays


def borrow(sizes: tuple[int, int, int]) -> Scratch:
    """What one launch works in; to be put back into _free. One size serves all: there is one kind of stream."""
    try:
        return _free.pop()
    except IndexError:
        out = Scratch()
        # Rows of lanes would else lie in two cache lines each.
        out.packets, out.stacks, out.slots = (upload(empty_aligned((size,), wp.dtype_to_numpy(dtype)), dtype, wp.get_device("cpu"))
                                              for size, dtype in zip(sizes, (wp.float32, wp.uint32, wp.int32), strict=True))
        return out


def rays_per_launch(n: int, threads: int, block: int) -> int:
    """A multiple of `block`, so that all threads have as many launches."""
    if threads == 1 or n <= FEWEST:
        return MOST
    launches = threads * max(round(n / (threads * SOME)), 1)
    return -(-n // (launches * block)) * block


def launch_stream(structure: Structure, kernel: Any, inputs: list[Any], n: int, threads: int) -> None:
    """Trace rays 0 .. n - 1 with a kernel of stream_kernel. inputs: its first ones, up to `out`."""
    module = structure.accel.kernels
    load_kernel(kernel, wp.get_device("cpu"))
    part = rays_per_launch(n, threads, module.stream_block)
    firsts = range(0, n, part)
    # One for each job that runs at a time; other calls, on other threads, borrow others.
    mine = [borrow(module.stream_sizes) for _ in range(min(threads, len(firsts)))]

    def job(first: int) -> None:
        end = min(first + part, n)
        scratch = mine.pop()
        wp.launch(kernel, dim=-(-(end - first) // module.stream_block), inputs=[*inputs, scratch, first, end], device="cpu",
                  record_tape=False)
        mine.append(scratch)

    run_all([partial(job, first) for first in firsts], threads)
    _free.extend(mine)  # not after an error: a thread may still be at work in one


def launch(kernel: Any, inputs: list[Any], n: int, device: Any, threads: int) -> None:
    """Trace rays 0 .. n - 1, one at a time. inputs: the kernel's first ones, up to where the hits go."""
    if device.is_cuda:
        wp.launch(kernel, dim=n, inputs=[*inputs, 0], device=device, record_tape=False)
        return
    load_kernel(kernel, device)

    def job(first: int) -> None:
        wp.launch(kernel, dim=min(RAYS_PER_LAUNCH, n - first), inputs=[*inputs, first], device=device, record_tape=False)

    run_all([partial(job, first) for first in range(0, n, RAYS_PER_LAUNCH)], threads)
