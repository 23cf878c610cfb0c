"""Launches made by a CPU kernel: a kernel that launches other kernels in a loop needs neither Python nor its global lock.
Warp calls a CPU kernel as a C function with two addresses: of the launch size (launch_bounds_t), and of the arguments. Warp does not
document this. The self-test of wrt.accel.queries.raw_launches checks it."""

import warp as wp

from wrt.kernels.structs import kernel


@wp.struct
class Launch:
    """Addresses of a CPU kernel and of its arguments. wrt.accel.queries.raw_launches keeps the memory alive that they point to.
    Only one thread at a time may use a Launch, because it changes the arguments."""

    entry: wp.uint64  # Address of the machine code.
    bounds: wp.uint64  # Address of the launch's size.
    args: wp.uint64  # Address of the arguments.
    tail: wp.uint64  # Address of the last argument.
    block: int  # Number of rays that one thread processes, for run_range.


@wp.func_native("""
    ((void (*)(void*, void*))launch.entry)((void*)launch.bounds, (void*)launch.args);
""")
def run(launch: Launch) -> None:
    """Run the kernel with its present arguments."""


@wp.func_native("*(int*)launch.tail = last;")
def set_last(launch: Launch, last: int) -> None: ...


@wp.func_native("""
    int* const range = (int*)launch.tail - 1;
    range[0] = first;
    range[1] = end;
    auto* const bounds = (wp::launch_bounds_t<1>*)launch.bounds;
    bounds->size = bounds->shape[0] = (end - first + launch.block - 1) / launch.block;
""")
def set_range(launch: Launch, first: int, end: int) -> None: ...


@wp.func
def run_with(launch: Launch, last: int):
    """Run the kernel with the int `last` as its last argument."""
    set_last(launch, last)
    run(launch)


@wp.func
def run_range(launch: Launch, first: int, end: int):
    """Run the kernel for rays first .. end - 1; `first` and `end` are its last two arguments."""
    set_range(launch, first, end)
    run(launch)


# --- the self-test's kernel, which shows that a kernel can launch another one ------------------------------------------

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
