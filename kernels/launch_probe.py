"""The kernel of the self-test in wrt.accel.queries.raw_launches: whether launches arrive as wrt makes them by hand."""

import warp as wp

from wrt.kernels.launches import Launch, run_range
from wrt.kernels.structs import kernel

PER_THREAD = wp.constant(2)  # words that a thread writes


@wp.struct
class Canary:
    """What the kernel writes to, a part of a larger array that tells what is written beside it."""

    words: wp.array(dtype=int)


@kernel
def probe(canary: Canary, given: wp.array(dtype=float), launch: Launch, first: int, end: int):
    """Write given[i] + end to words[i] for first <= i < end. Where `launch` is one of this kernel, that one does it, over this
    range in place of its own."""
    if launch.entry != wp.uint64(0):
        run_range(launch, first, end)
        return
    begin = first + PER_THREAD * wp.tid()  # a thread too many is seen behind the range
    for i in range(begin, begin + PER_THREAD):
        canary.words[i] = int(given[i]) + end
