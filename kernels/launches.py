"""Launches made by a CPU kernel: a loop over kernels without Python, and without its lock.
Warp does not document how it calls a CPU kernel: a C function of two addresses, of the launch's size (launch_bounds_t) and of its
arguments. The self-test of wrt.accel.queries.raw_launches checks it."""

import warp as wp


@wp.struct
class Launch:
    """A CPU kernel with its arguments, by addresses that wrt.accel.queries.raw_launches keeps alive. One thread at a time may use it."""

    entry: wp.uint64  # Address of the machine code.
    bounds: wp.uint64  # Address of the launch's size.
    args: wp.uint64  # Address of the arguments.
    tail: wp.uint64  # Address of the last argument.
    block: int  # Rays of each thread, for a kernel that takes a range of them.


@wp.func_native("""
    ((void (*)(void*, void*))launch.entry)((void*)launch.bounds, (void*)launch.args);
""")
def run(launch: Launch) -> None:
    """Run with the arguments set before."""


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
    """Run with this last argument, an int."""
    set_last(launch, last)
    run(launch)


@wp.func
def run_range(launch: Launch, first: int, end: int):
    """Run for rays first .. end - 1, the kernel's last two arguments."""
    set_range(launch, first, end)
    run(launch)
