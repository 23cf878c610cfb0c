"""Kernel of the self-test in wrt.accel.queries.raw_launches, which checks launches made by hand."""

import warp as wp

from wrt.kernels.launches import Launch, run_range
from wrt.kernels.structs import kernel

PER_THREAD = wp.constant(2)  # words written by one thread


@wp.struct
class Canary:
    """The words that the kernel writes, inside a larger array that shows stray writes."""

    words: wp.array(dtype=int)


@kernel
def probe(canary: Canary, given: wp.array(dtype=float), launch: Launch, first: int, end: int):
    """Write given[i] + end to words[i] for first <= i < end; if `launch` is set, let it do so for this range."""
    if launch.entry != wp.uint64(0):
        run_range(launch, first, end)
        return
    begin = first + PER_THREAD * wp.tid()  # a surplus thread is seen behind the range
    for i in range(begin, begin + PER_THREAD):
        canary.words[i] = int(given[i]) + end
