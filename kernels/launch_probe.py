"""Kernel of the self-test in wrt.accel.queries.raw_launches: the test checks that a kernel can launch another kernel."""

import warp as wp

from wrt.kernels.launches import Launch, run_range
from wrt.kernels.structs import kernel

PER_THREAD = wp.constant(2)  # number of words that one thread writes


@wp.struct
class Canary:
    """The words that the kernel writes. They lie inside a larger array, in which the self-test finds stray writes."""

    words: wp.array(dtype=int)


@kernel
def probe(canary: Canary, values: wp.array(dtype=float), launch: Launch, first: int, end: int):
    """Write values[i] + end to words[i] for first <= i < end. If `launch` is set, run that launch for this range instead."""
    if launch.entry != wp.uint64(0):
        run_range(launch, first, end)
        return
    begin = first + PER_THREAD * wp.tid()  # a surplus thread would write behind the range, where the self-test looks
    for i in range(begin, begin + PER_THREAD):
        canary.words[i] = int(values[i]) + end
